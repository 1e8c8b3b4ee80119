"""SHELL: every key of a file with type, unit, range, default, meaning and example, and the JSON schema for editors.

Both are read from the pydantic models that check the files. A key's meaning is the docstring below its field. It is read from
the source when it is asked for: no process of a fleet pays for it at its start.
"""

import ast
import inspect
import json
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from shoal.config.controller import Live
from shoal.config.experiment import EXPERIMENTS, Experiment
from shoal.config.loader import Section, sections_of, toml_value
from shoal.config.vehicle import VEHICLES, Vehicle

SCHEMAS = Path(__file__).parent / "schemas"
ROOTS: dict[str, type[Section]] = {"experiment": Experiment, "vehicle": Vehicle}  # kinds of files, and of schemas
SHORT_EXAMPLE = 60  # characters; of the values that shipped files have, one that is not longer is shown if there is one
# Endings of keys, the longer first where one ends in another.
UNITS = {
    "_rad_per_n": "rad/N", "_us_per_s": "us/s", "_per_s2": "1/s^2", "_per_s": "1/s", "_kg_m2": "kg m^2", "_mps": "m/s",
    "_mbps": "Mbit/s", "_radps": "rad/s", "_rad": "rad", "_kg": "kg", "_nm": "N m", "_ms": "ms", "_us": "us", "_hz": "Hz",
    "_px": "px", "_wh": "Wh", "_gb": "GB", "_m": "m", "_s": "s", "_n": "N", "_v": "V", "_w": "W",
}  # fmt: skip


@dataclass(frozen=True)
class KeyEntry:
    name: str  # dotted, as `--set` takes it; N is an index of a list
    when: str  # the kind of path that has it; empty for all other keys
    type: str
    unit: str  # empty if it has none, or if the meaning tells the units of a list's entries
    allowed: str  # range of the value, or of each entry of a list; empty if there is none
    default: str  # as TOML; "required", or empty where leaving it out has a meaning of its own
    live: bool  # may change in flight
    meaning: str
    example: str  # as a line of TOML or after `--set`


@dataclass(frozen=True)
class KeyTable:
    """The keys of one section, in the file's order."""

    name: str  # dotted; empty for the top of the file
    meaning: str
    entries: tuple[KeyEntry, ...]


@cache
def meanings(model: type[Section]) -> dict[str, str]:
    """Docstrings below the fields of a model and of the models that it inherits from."""
    docstrings: dict[str, str] = {}
    for cls in reversed([c for c in model.__mro__ if issubclass(c, Section) and c is not Section]):
        (body,) = ast.parse(inspect.getsource(cls)).body
        assert isinstance(body, ast.ClassDef)
        for field, below in zip(body.body, body.body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
                docstrings[ast.unparse(field.target)] = inspect.cleandoc(str(below.value.value)).replace("\n", " ")
    return docstrings


def schema(kind: str) -> dict[str, Any]:
    """JSON schema (2020-12) of the files of one kind of ROOTS. It knows types and ranges; what keys demand of one another only
    the programs check."""
    root = ROOTS[kind]
    document = root.model_json_schema()
    for model in _models(root):
        described = document if model is root else document["$defs"][model.__name__]
        described["description"] = inspect.getdoc(model)
        for key, value in described.get("properties", {}).items():
            value.pop("title", None)
            value["description"] = meanings(model).get(key, "")
            if isinstance(value.get("default"), dict):
                del value["default"]  # of a section: its keys have theirs
    if root is Experiment:
        for key in ("vehicle", "camera"):  # read from files, and settings laid over them
            table = document["properties"][key]
            reference = {"$ref": table.pop("$ref")}
            like = {"type": "object", "properties": {"like": {"type": "string"}}, "required": ["like"]}
            table["anyOf"] = [{"type": "string"}, like, reference]
        document["$defs"]["RobotConfig"]["required"].remove("node_m")  # formation.shape gives one
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **document}


def schema_line(kind: str) -> str:
    """First line of a file of that kind, from which editors know where its keys are described. Shipped files have it with a
    path relative to themselves."""
    return f"#:schema {(SCHEMAS / f'{kind}.schema.json').resolve().as_uri()}"


@cache
def hints(model: type[Section], name: str) -> dict[str, str]:
    """Dotted key, meaning, range and default of each key of one section, in one text. Quick: only the source is read."""
    described = model.model_json_schema()["properties"]
    texts = {}
    for key, value in described.items():
        entry = _entry(key, "", value | {"description": meanings(model).get(key, "")}, "default" not in value, False, [])
        allowed = f" Allowed: {entry.allowed}{f' {entry.unit}' if entry.unit else ''}." if entry.allowed else ""
        default = f" Default: {entry.default}." if entry.default and entry.default != "required" else ""
        texts[f"{name}.{key}" if name else key] = f"{name}.{key}: {entry.meaning}{allowed}{default}"
    return texts


def tables(kind: str) -> list[KeyTable]:
    """All keys of the files of one kind, section by section."""
    described = schema(kind)
    return list(_tables(ROOTS[kind], described, described["$defs"], "", "", _shipped(kind)))


def _tables(
    model: type[BaseModel], described: dict[str, Any], defs: dict[str, Any], prefix: str, when: str, shipped: list[Any]
) -> Iterator[KeyTable]:
    """The section's own keys, then its sections. A path of a robot's own is the formation's section again."""
    entries, below = [], []
    for name, field in model.model_fields.items():
        sections = sections_of(field.annotation)
        again = prefix.endswith("N.") and name == "path"
        separate = model is Experiment and name == "vehicle"  # has files of its own
        if sections and not again and not separate:
            below.append((name, sections, "tuple" in str(field.annotation)))
        else:
            value = described["properties"][name]
            live = any(isinstance(mark, Live) for mark in field.metadata)
            required = name in described.get("required", ())
            entries.append(_entry(prefix + name, when, value, required, live, shipped))
    yield KeyTable(prefix.rstrip(".").removesuffix(".N"), described["description"], tuple(entries))
    for name, sections, repeated in below:
        for section in sections:
            kind = defs[section.__name__]["properties"].get("kind", {}).get("const", "")
            inner = f"{prefix}{name}.{'N.' if repeated else ''}"
            yield from _tables(section, defs[section.__name__], defs, inner, kind, shipped)


def _entry(name: str, when: str, value: dict[str, Any], required: bool, live: bool, shipped: list[Any]) -> KeyEntry:
    """One key's row: type, unit, allowed values, default, example."""
    default = value.get("default")
    used = [*value.get("examples", ()), *_examples(name, when, shipped)]
    example = min(used, key=lambda one: max(len(json.dumps(one)), SHORT_EXAMPLE), default=default)
    return KeyEntry(
        name,
        when,
        _type(value),
        next((unit for ending, unit in UNITS.items() if name.endswith(ending)), ""),
        _allowed(value),
        "required" if required else "" if default is None else toml_value(default),
        live,
        value["description"],
        f"{name.replace('.N', '.0')}={toml_value(example)}" if example is not None else "",
    )


def _models(root: type[Section]) -> Iterator[type[Section]]:
    """A section's class, and those of all sections within it."""
    yield root
    for field in root.model_fields.values():
        for section in sections_of(field.annotation):
            if issubclass(section, Section):
                yield from _models(section)


def _bare(value: dict[str, Any]) -> dict[str, Any]:
    """The schema without the choice of leaving the key out."""
    choices = [choice for choice in value.get("anyOf", ()) if choice.get("type") != "null"]
    return choices[0] if len(choices) == 1 else value


def _type(value: dict[str, Any]) -> str:
    """The type of a value in words, from its JSON schema."""
    value = _bare(value)
    if "const" in value or "enum" in value:
        return " or ".join(json.dumps(choice) for choice in value.get("enum", [value.get("const")]))
    if "anyOf" in value:
        return " or ".join(dict.fromkeys(_type(choice) for choice in value["anyOf"]))
    if value.get("type") == "array":
        if "prefixItems" in value:
            kinds = [_type(item) for item in value["prefixItems"]]
            return f"list of {len(kinds)} {_plural(kinds[0])}" if len(set(kinds)) == 1 else f"[{', '.join(kinds)}]"
        return f"list of {_plural(_type(value['items']))}"
    return {"number": "number", "integer": "integer", "boolean": "true or false", "string": "text"}.get(
        value.get("type", ""), "table"
    )


def _plural(kind: str) -> str:
    return kind.replace("list of", "lists of") if kind.startswith("list of") else kind if kind.startswith("[") else f"{kind}s"


def _allowed(value: dict[str, Any]) -> str:
    """The range of a value in words: of a number, or of each entry of a list."""
    value = _bare(value)
    if "anyOf" in value:
        return _allowed(value["anyOf"][0])
    if value.get("type") == "array":
        return _allowed_entries(value)
    if "pattern" in value:
        return f"matches {value['pattern']}"
    bounds = (("exclusiveMinimum", ">"), ("minimum", ">="), ("exclusiveMaximum", "<"), ("maximum", "<="))
    return " and ".join(f"{sign} {value[key]:g}" for key, sign in bounds if value.get(key) is not None)


def _allowed_entries(value: dict[str, Any]) -> str:
    """The range of each entry of a list, and how many there may be."""
    is_fixed = "prefixItems" in value
    ranges = [_allowed(item) for item in (value["prefixItems"] if is_fixed else [value["items"]])]
    inside = ranges[0] if len(set(ranges)) == 1 else ", ".join(one or "any" for one in ranges)
    if inside and not inside.startswith("each ") and "," not in inside:
        inside = f"each {inside}"
    fewest, most = value.get("minItems", 0), value.get("maxItems")
    length = ""
    if not is_fixed and most:
        length = f"{fewest} to {most} of them"
    elif not is_fixed and fewest:
        length = f"{fewest} or more of them"
    return "; ".join(part for part in (inside, length) if part)


@cache
def _shipped(kind: str) -> list[Any]:
    """The tables of all shipped files of a kind, the pool first."""
    folder = {"experiment": EXPERIMENTS, "vehicle": VEHICLES}[kind]
    files = sorted(folder.glob("*.toml"), key=lambda path: (path.stem != "pool", path.stem))
    return [tomllib.loads(path.read_text(encoding="utf-8")) for path in files]


def _examples(name: str, when: str, shipped: list[Any]) -> Iterator[Any]:
    """Values that shipped files give a key."""
    for table in shipped:
        holders = [table]
        for part in name.split(".")[:-1]:
            if part != "N":
                holders = [holder[part] for holder in holders if isinstance(holder.get(part), dict | list)]
                holders = [item for holder in holders for item in (holder if isinstance(holder, list) else [holder])]
        for holder in holders:
            value = holder.get(name.rpartition(".")[2])
            if value is not None and (not when or holder["kind"] == when):
                yield value

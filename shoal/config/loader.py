"""SHELL: load a TOML file into a checked pydantic model; every complaint names file, key, value and what is allowed."""

import difflib
import json
import re
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Self, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, ValidationError

from shoal.errors import ConfigError
from shoal.system.regular_files import read_regular

MOST_BYTES = 1024 * 1024  # of a file; a path of 30,000 waypoints has no more. A parsed file takes a hundred times its size
MOST_PARTS = 16  # of a dotted key; the parser's memory grows with the square of it, and no key of ours has more than five

_PART = r"""(?:[\w-]+|"[^"\n]*"|'[^'\n]*')"""
_LONG_KEY = re.compile(rf"(?<![\w-]){_PART}(?:[ \t]*\.[ \t]*{_PART}){{{MOST_PARTS},}}")


class Section(BaseModel):
    """A table of a configuration file: frozen, and with no room for misspelt keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """A copy with other values. What was computed of the original's values, its hash for example, is not the copy's."""
        copied = super().model_copy(update=update, deep=deep)
        for name in copied.__dict__.keys() - type(self).model_fields.keys():
            del copied.__dict__[name]
        return copied


S = TypeVar("S", bound=Section)


def read_toml(path: Path) -> dict[str, Any]:
    """Parse a TOML file. Raises ConfigError naming the file, and the line where it stops being TOML; also for one that is
    larger, or has longer keys, than any of ours: it may take all memory. A byte order mark, as some editors write it, is
    skipped."""
    try:
        return parse_toml(read_regular(path, MOST_BYTES).decode("utf-8-sig"), str(path))
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None


def parse_toml(text: str, source: str) -> dict[str, Any]:
    """Parse TOML that came from `source`. Raises ConfigError as `read_toml` does."""
    if len(text) > MOST_BYTES:
        raise ConfigError(f"{source}: cannot be read: larger than {MOST_BYTES} bytes")
    try:
        return _parsed(text.replace("\r\n", "\n"))
    except (ValueError, RecursionError) as error:  # beside its own error the parser lets these out: huge numbers, deep nesting
        raise ConfigError(f"{source}: not valid TOML: {error}") from None


def _parsed(text: str) -> dict[str, Any]:
    """TOML, parsed. Raises ValueError or RecursionError for what is none, and for keys of too many parts."""
    match = _LONG_KEY.search(text)
    if match is not None:
        line = text.count("\n", 0, match.start()) + 1
        raise ValueError(f"a key of more than {MOST_PARTS} parts (at line {line})")
    return tomllib.loads(text)


def check(model: type[S], table: dict[str, Any], source: str) -> S:
    """Validate `table` (from `source`) as `model`, types to the letter: `"3"` and `true` are no numbers. Raises ConfigError
    with one line per problem."""
    try:
        return model.model_validate(_frozen(table), strict=True)
    except ValidationError as error:
        lines = [_explain(problem, model) for problem in error.errors()]
        raise ConfigError("\n".join(f"{source}: {line}" for line in lines)) from None
    except RecursionError:
        raise ConfigError(f"{source}: a value is nested too deep: tables in tables, or lists in lists") from None


def _frozen(value: Any) -> Any:
    """TOML's lists as the tuples that frozen sections hold."""
    if isinstance(value, dict):
        return {key: _frozen(item) for key, item in value.items()}
    return tuple(map(_frozen, value)) if isinstance(value, list | tuple) else value


def apply_setting(table: dict[str, Any], setting: str) -> None:
    """Apply one setting `key.sub=value` to a parsed table, in place. The value is read as TOML, else taken as text. Raises
    ConfigError that begins with the setting."""
    key, equals, text = setting.partition("=")
    if not equals or not key.strip():
        raise ConfigError(f"{setting}: has no value: write it as key=value")
    try:
        parsed = _parsed(f"v = {text}")
    except (ValueError, RecursionError):
        parsed = {"v": text}
    if len(parsed) > 1:
        raise ConfigError(f"{setting!r}: holds more than one key (allowed: one; give each by itself)")
    value = parsed["v"]
    *parents, last = key.strip().split(".")
    node: Any = table
    for i, name in enumerate(parents):
        node = _child(node, name, setting, ".".join(parents[:i]))
    if isinstance(node, list):
        node[_list_index(node, last, setting)] = value
    elif isinstance(node, dict):
        node[last] = value
    else:
        raise ConfigError(f"{setting}: {'.'.join(parents)} is a value, not a table")


def toml_value(value: Any) -> str:
    """A value as TOML in one line, as `apply_setting` reads it. Numbers, texts, lists, true and false are written as in
    JSON."""
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{key} = {toml_value(inner)}' for key, inner in value.items())} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    return json.dumps(value)


def _child(node: Any, name: str, setting: str, where: str) -> Any:
    """The part `name` of a table or list that a setting leads through; a table that is missing is made. Raises ConfigError."""
    if isinstance(node, list):
        return node[_list_index(node, name, setting)]
    if isinstance(node, dict):
        return node.setdefault(name, {})
    raise ConfigError(f"{setting}: {where} is a value, not a table")


def _list_index(node: list[Any], name: str, setting: str) -> int:
    """The index of a list's entry that a setting names. Raises ConfigError."""
    if name.isdecimal() and int(name) < len(node):
        return int(name)
    allowed = f"0 to {len(node) - 1}" if node else "none, the list is empty"
    raise ConfigError(f"{setting}: {name!r} is no index of a list of {len(node)} (allowed: {allowed})")


_IN_WORDS = {
    "model_type": "must be a table",
    "model_attributes_type": "must be a table",
    "tuple_type": "must be a list",
    "too_short": "must be a list of at least {min_length}",
    "too_long": "must be a list of at most {max_length}",
}


def nearest(name: str, allowed: Iterable[str]) -> str:
    """The allowed name that a person may have meant, as a question behind an error's text; empty if none is like it."""
    similar = difflib.get_close_matches(name, list(allowed), n=1)
    return f"; did you mean {similar[0]}?" if similar else ""


def _explain(problem: Any, model: type[Section]) -> str:
    """One pydantic problem as `key = value: what is allowed`."""
    key, holder = _locate(model, problem["loc"])
    context = problem.get("ctx", {})
    message = _IN_WORDS.get(problem["type"], "").format_map(context) or problem["msg"].removeprefix("Value error, ")
    if problem["type"] == "extra_forbidden":
        near = nearest(key.rpartition(".")[2], holder.model_fields)
        return f"{key}: unknown key{near} (allowed here: {', '.join(sorted(holder.model_fields))})"
    if problem["type"] == "missing":
        return f"{key}: missing, and it has no default"
    if problem["type"] in ("union_tag_not_found", "union_tag_invalid"):
        kind = context["discriminator"].strip("'")
        if kind not in problem["input"]:
            return f"{key}.{kind}: missing, and it has no default"
        return f"{key}.{kind} = {_as_written(problem['input'][kind])}: must be one of {context['expected_tags']}"
    if not problem["loc"]:
        return message
    if not isinstance(problem["input"], dict):
        return f"{key} = {_as_written(problem['input'])}: {message}"
    return f"{key}: {message}"


def _as_written(value: Any) -> str:
    """A value for people: lists as lists, and not a screenful."""
    text = repr(list(value) if isinstance(value, tuple) else value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _locate(model: type[BaseModel], loc: tuple[int | str, ...]) -> tuple[str, type[BaseModel]]:
    """The dotted key, as it stands in the file, of a pydantic location, and the section that holds it.

    Below a union pydantic inserts the name of the variant that was tried, which the file does not have.
    """
    parts: list[str] = []
    holder, sections = model, [model]
    for part in loc:
        if isinstance(part, int):
            parts.append(str(part))
        elif len(sections) > 1:
            sections = [variant for variant in sections if _is_variant(variant, part)]
        elif sections:
            parts.append(part)
            holder = sections[0]
            field = holder.model_fields.get(part)
            sections = sections_of(field.annotation) if field is not None else []
    return ".".join(parts), holder


def sections_of(annotation: Any) -> list[type[BaseModel]]:
    """The models that a field's type is made of: one, or the variants of a union."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [section for argument in get_args(annotation) for section in sections_of(argument)]


def _is_variant(section: type[BaseModel], tag: str) -> bool:
    return any(tag in get_args(field.annotation) for field in section.model_fields.values())

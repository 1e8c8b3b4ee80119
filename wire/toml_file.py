"""SHELL: load a TOML file into a checked pydantic model; every complaint names file, key, value and what is allowed."""

import tomllib
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError


class ConfigError(Exception):
    """A configuration that cannot be used. The message is for the person who wrote the file."""


class Section(BaseModel):
    """A table of a configuration file: frozen, and with no room for misspelt keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


S = TypeVar("S", bound=Section)


def read_toml(path: Path) -> dict[str, Any]:
    """Parse a TOML file. Raises ConfigError naming the file, and the line where it stops being TOML."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from None


def check(model: type[S], table: dict[str, Any], source: str) -> S:
    """Validate `table` (from `source`) as `model`. Raises ConfigError with one line per problem."""
    try:
        return model.model_validate(table)
    except ValidationError as error:
        lines = [_explain(problem, model) for problem in error.errors()]
        raise ConfigError("\n".join(f"{source}: {line}" for line in lines)) from None


def apply_setting(table: dict[str, Any], setting: str) -> None:
    """Apply one `--set key.sub=value` to a parsed table, in place. The value is read as TOML, else taken as text."""
    key, equals, text = setting.partition("=")
    if not equals or not key.strip():
        raise ConfigError(f"--set {setting}: write it as key=value, for example --set duration_s=30")
    try:
        value = tomllib.loads(f"v = {text}")["v"]
    except tomllib.TOMLDecodeError:
        value = text
    *parents, last = key.strip().split(".")
    node: Any = table
    for i, name in enumerate(parents):
        node = _child(node, name, setting, ".".join(parents[:i]))
    if isinstance(node, list):
        node[_list_index(node, last, setting)] = value
    elif isinstance(node, dict):
        node[last] = value
    else:
        raise ConfigError(f"--set {setting}: {'.'.join(parents)} is a value, not a table")


def _child(node: Any, name: str, setting: str, where: str) -> Any:
    if isinstance(node, list):
        return node[_list_index(node, name, setting)]
    if isinstance(node, dict):
        return node.setdefault(name, {})
    raise ConfigError(f"--set {setting}: {where} is a value, not a table")


def _list_index(node: list[Any], name: str, setting: str) -> int:
    if name.isdigit() and int(name) < len(node):
        return int(name)
    raise ConfigError(f"--set {setting}: {name!r} is no index of a list of {len(node)} (allowed: 0 to {len(node) - 1})")


def _explain(problem: Any, model: type[Section]) -> str:
    """One pydantic problem as `key = value: what is allowed`."""
    key = ".".join(str(part) for part in problem["loc"]) or "(the whole file)"
    if problem["type"] == "extra_forbidden":
        return f"{key}: unknown key (allowed here: {', '.join(_siblings(model, problem['loc']))})"
    if problem["type"] == "missing":
        return f"{key}: missing, and it has no default"
    message = problem["msg"].removeprefix("Value error, ")
    if problem["loc"] and not isinstance(problem["input"], dict):
        return f"{key} = {problem['input']!r}: {message}"
    return f"{key}: {message}"


def _siblings(model: type[BaseModel], loc: tuple[int | str, ...]) -> list[str]:
    """Names of the fields that stand beside the misspelt one at `loc`."""
    current: type[BaseModel] = model
    for part in loc[:-1]:
        found = _submodel(current, part)
        if found is None:
            continue  # a list index, or the tag of a union
        current = found
    return sorted(field.alias or name for name, field in current.model_fields.items())


def _submodel(model: type[BaseModel], part: int | str) -> type[BaseModel] | None:
    field = model.model_fields.get(str(part))
    pending: list[Any] = [field.annotation] if field is not None else []
    while pending:
        candidate = pending.pop()
        if isinstance(candidate, type) and issubclass(candidate, BaseModel):
            return candidate
        pending.extend(getattr(candidate, "__args__", ()))
    return None

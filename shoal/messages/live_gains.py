"""The gains that can be changed in flight: the keys of `controller` that controller.py marks LIVE, number by number, with
bounds.

Station, page and robots read the table off the same fields that check the experiment file, so there is one place that says
what a gain is and how large it may be. Lists go by entries: `controller.mpc.q.0`. Pure.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, get_args, get_origin

import numpy as np
from pydantic.fields import FieldInfo

from shoal.config.controller import ControllerConfig, Live
from shoal.config.loader import Section, apply_setting, check
from shoal.errors import ConfigError
from shoal.messages.messages import Tuning

ROOT = "controller"


class _File(Section):
    """A model of the file, so that error messages name keys as they stand in an experiment file."""

    controller: ControllerConfig


@dataclass(frozen=True)
class TunableParameter:
    """One number that can be changed in flight, with its bounds. `above`: `least` itself is not allowed; `below`: nor is
    `most`."""

    key: str
    value: float
    least: float
    most: float
    above: bool
    below: bool


def tunable_parameters(controller: ControllerConfig) -> tuple[TunableParameter, ...]:
    """All parameters that have an effect with this law, with their present values."""
    without_effect = _prefixes_without_effect(controller)
    return tuple(parameter for parameter in _within(ROOT, controller) if not parameter.key.startswith(without_effect))


def _prefixes_without_effect(controller: ControllerConfig) -> tuple[str, ...]:
    """Prefixes of the keys that have no effect with the controller's law, because only other laws use them."""
    match controller.law:
        case "eso-mpc-article":
            return (f"{ROOT}.nmpc.",)
        case "nmpc":
            return (f"{ROOT}.mpc.q.", f"{ROOT}.mpc.r.", f"{ROOT}.estimator.yaw_bandwidth_radps")
        case _:
            return (f"{ROOT}.nmpc.", f"{ROOT}.mpc.")


def _within(prefix: str, section: Section) -> Iterator[TunableParameter]:
    """The parameters of a section, and of the sections in it, that may change in flight."""
    for name, field in type(section).model_fields.items():
        key, value = f"{prefix}.{name}", getattr(section, name)
        if isinstance(value, Section):
            yield from _within(key, value)
        elif not any(isinstance(mark, Live) for mark in field.metadata):
            continue
        elif isinstance(value, tuple):
            for k, (entry, hint) in enumerate(zip(value, get_args(field.annotation), strict=True)):
                yield _parameter(f"{key}.{k}", entry, FieldInfo.from_annotation(hint).metadata)
        else:
            yield _parameter(key, value, field.metadata)


def _parameter(key: str, value: float, marks: list[Any]) -> TunableParameter:
    """A parameter with the bounds that pydantic checks: its marks have an attribute of the bound's name."""
    bound = {name: float(getattr(mark, name)) for name in ("ge", "gt", "le", "lt") for mark in marks if hasattr(mark, name)}
    least, most = bound.get("gt", bound.get("ge", -np.inf)), bound.get("lt", bound.get("le", np.inf))
    return TunableParameter(key, value, least, most, "gt" in bound, "lt" in bound)


def tuning(controller: ControllerConfig) -> Tuning:
    """The gains of a controller as a message. Equal values always have the same id."""
    gains = tunable_parameters(controller)
    text = json.dumps([(parameter.key, parameter.value) for parameter in gains])
    name = hashlib.sha256(text.encode()).hexdigest()[:8]
    return Tuning(name, tuple(parameter.key for parameter in gains), np.array([parameter.value for parameter in gains]))


def tuned(controller: ControllerConfig, values: Mapping[str, float]) -> ControllerConfig:
    """The controller with other gains. Raises ConfigError naming key, value and what is allowed."""
    allowed = {parameter.key for parameter in tunable_parameters(controller)}
    table: dict[str, Any] = {ROOT: controller.model_dump(mode="json")}
    for key, value in values.items():
        if key not in allowed:
            raise ConfigError(f"{key}: cannot be changed in flight (allowed: {', '.join(_names(allowed))})")
        apply_setting(table, f"{key}={float(value)!r}")
    return check(_File, table, "gains").controller


def _names(keys: set[str]) -> list[str]:
    """Keys for an error message, sorted: a list by its own key, without those of its entries."""
    return sorted({key.rpartition(".")[0] if key.rpartition(".")[2].isdecimal() else key for key in keys})


def values_of(settings: Sequence[str]) -> dict[str, float]:
    """The values that `key=value` settings change, a list entry by entry. Raises ConfigError for a value that is no number."""
    values: dict[str, float] = {}
    for setting in settings:
        table: dict[str, Any] = {}
        apply_setting(table, setting)
        key = setting.partition("=")[0].strip()
        value: Any = table
        for name in key.split("."):
            value = value[name]
        entries = {f"{key}.{k}": entry for k, entry in enumerate(value)} if isinstance(value, list) else {key: value}
        for name, entry in entries.items():
            if isinstance(entry, bool) or not isinstance(entry, int | float):
                raise ConfigError(f"{name} = {entry!r}: must be a number")
            values[name] = float(entry)
        wrong = _wrong_length(key, value)
        if wrong:
            raise ConfigError(wrong)
    return values


def _wrong_length(key: str, value: object) -> str:
    """The reason to refuse a value for a key that holds a list of another length, or ""; a shorter list would be mixed with
    the present values."""
    section: Any = ControllerConfig
    for name in key.split(".")[1:]:
        field = section.model_fields.get(name) if isinstance(section, type) and issubclass(section, Section) else None
        if field is None:
            return ""
        section = field.annotation
    length = len(get_args(section)) if get_origin(section) is tuple else 0
    if not length or (isinstance(value, list) and len(value) == length):
        return ""
    return f"{key} = {value}: must be {length} numbers, or one of them by its place: {key}.0 to {key}.{length - 1}"


def of_message(controller: ControllerConfig, message: Tuning) -> ControllerConfig:
    """The controller with a message's gains. Raises ConfigError for gains that are not allowed, and for a message that does
    not fit together, or whose id is not that of its gains."""
    if len(message.keys) != len(message.values) or len(set(message.keys)) != len(message.keys):
        raise ConfigError(
            f"tuning {message.id}: {len(message.keys)} keys and {len(message.values)} values do not fit together"
        )
    tuned_controller = tuned(controller, dict(zip(message.keys, message.values.tolist(), strict=True)))
    if tuning(tuned_controller).id != message.id:
        raise ConfigError(f"tuning {message.id}: with these values it is {tuning(tuned_controller).id}")
    return tuned_controller

"""SHELL: an experiment as a file for people: the keys that differ from what a file without them gives, each with its meaning
as a comment.

Loading the file gives the same experiment. `dump_experiment` writes every key instead, for a run's own record.
"""

from collections.abc import Iterator, Set
from pathlib import Path
from typing import Any

import numpy as np

from shoal.config.experiment import Experiment, checked_experiment
from shoal.config.formation_shapes import shape_nodes
from shoal.config.key_reference import meanings, schema_line
from shoal.config.loader import Section, parse_toml, toml_value
from shoal.config.vehicle import VEHICLES, Vehicle, load_vehicle

WIDE = 127  # of a line; with a longer comment it stands above its key


def commented(experiment: Experiment) -> str:
    """The experiment as TOML, in the order of the shipped files, without the keys that have their default.

    A key's default may depend on other keys, for example on the control law. So the text is read again, and keys that would
    get another value are added, until it gives the same experiment.
    """
    title, needed, missed = f"# {experiment.title or experiment.name}", set[str](), {""}
    while missed - needed:
        needed |= missed
        text = "\n".join([schema_line("experiment"), title, "", *_lines(experiment, "", needed, set())]) + "\n"
        again = checked_experiment(parse_toml(text, experiment.name), Path(experiment.name))
        missed = set(_other_keys(_dumped(experiment), _dumped(again), ""))
    return text


def _other_keys(one: Any, other: Any, name: str) -> Iterator[str]:
    """Dotted keys whose values differ between two tables, and the keys of the tables around them. Entries of a list have the
    list's key."""
    if one == other:
        return
    yield name
    if isinstance(one, dict) and isinstance(other, dict):
        for key in one.keys() & other.keys():
            yield from _other_keys(one[key], other[key], f"{name}.{key}" if name else key)
    elif isinstance(one, list | tuple) and isinstance(other, list | tuple):
        for mine, theirs in zip(one, other, strict=False):
            yield from _other_keys(mine, theirs, name)


def _lines(section: Section, name: str, needed: Set[str], commented_keys: set[str]) -> Iterator[str]:
    """Lines of a section: its own keys, then its sections. A key that is in `commented_keys` has had its comment."""
    below: list[tuple[str, Any]] = []
    for key, value in _different(section, name, needed).items():
        dotted = f"{name}.{key}" if name else key
        if isinstance(value, Section) or (isinstance(value, tuple) and value and isinstance(value[0], Section)):
            below.append((dotted, value))
            continue
        line = f"{key} = {toml_value(value)}"
        comment = meanings(type(section)).get(key, "") if dotted not in commented_keys else ""
        commented_keys.add(dotted)
        if comment and len(line) + len(comment) + 4 > WIDE:
            yield f"# {key}: {comment}"
        yield f"{line}  # {comment}" if comment and len(line) + len(comment) + 4 <= WIDE else line
    for dotted, value in below:
        for one in value if isinstance(value, tuple) else (value,):
            yield ""
            yield f"[[{dotted}]]" if isinstance(value, tuple) else f"[{dotted}]"
            yield from _lines(one, dotted, needed, commented_keys)


def _different(section: Section, name: str, needed: Set[str]) -> dict[str, Any]:
    """The values that a file has to give: those without a default, those that differ from it, and the `needed` ones."""
    values = {}
    for key, field in type(section).model_fields.items():
        value = getattr(section, key)
        is_needed = field.is_required() or (f"{name}.{key}" if name else key) in needed
        if value is not None and (is_needed or _dumped(value) != _dumped(field.get_default(call_default_factory=True))):
            values[key] = value
    if isinstance(section, Experiment):
        values["vehicle"] = _shipped_name(section.vehicle) or section.vehicle
        if _has_shape(section):
            values["robots"] = tuple(robot.model_copy(update={"node_m": None}) for robot in section.robots)
    return values


def _dumped(value: Any) -> Any:
    """A section as plain tables; any other value as it is."""
    return value.model_dump() if isinstance(value, Section) else value


def _shipped_name(vehicle: Vehicle) -> str:
    """Name of the shipped vehicle that is the same as this one; empty if there is none."""
    return next(
        (file.stem for file in sorted(VEHICLES.glob("*.toml")) if _dumped(load_vehicle(file.stem)) == _dumped(vehicle)), ""
    )


def _has_shape(experiment: Experiment) -> bool:
    """True if all robots are at the nodes of the formation's shape: then the shape says so."""
    formation = experiment.formation
    if formation.shape is None:
        return False
    nodes = shape_nodes(formation.shape, len(experiment.robots), formation.spacing_m)
    return np.array_equal(nodes, [robot.node_m for robot in experiment.robots])

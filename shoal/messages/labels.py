"""Titles, units and column names of message fields, as they stand beside the fields.

The page's plots, the report's figures and the columns of exported tables all take them from here.
"""

import dataclasses
from collections.abc import Iterator
from functools import cache
from typing import Annotated, Any, NamedTuple, get_args, get_origin, get_type_hints

from shoal.messages.schema import nested_message


class LabelPart(NamedTuple):
    """One number of an array: its column in tables, its title and its unit."""

    column: str
    title: str
    unit: str


class Label(NamedTuple):
    """A field as people see it. An array has a title for all of it and parts for its numbers."""

    title: str
    unit: str = ""
    parts: tuple[LabelPart, ...] = ()
    prefix: str = ""  # of the parts' columns in tables

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns of an array's numbers in tables."""
        return tuple(self.prefix + part.column for part in self.parts)


POSE = (  # pool frame
    LabelPart("x_m", "x", "m"),
    LabelPart("y_m", "y", "m"),
    LabelPart("z_m", "depth", "m"),
    LabelPart("yaw_rad", "yaw", "rad"),
)
VELOCITY = (  # body frame
    LabelPart("surge_mps", "surge", "m/s"),
    LabelPart("sway_mps", "sway", "m/s"),
    LabelPart("heave_mps", "heave", "m/s"),
    LabelPart("yaw_radps", "yaw rate", "rad/s"),
)
ACCELERATION = (  # body frame
    LabelPart("surge_mps2", "surge", "m/s²"),
    LabelPart("sway_mps2", "sway", "m/s²"),
    LabelPart("heave_mps2", "heave", "m/s²"),
    LabelPart("yaw_radps2", "yaw", "rad/s²"),
)
WRENCH = (  # the last one of vehicles with side thrust alone
    LabelPart("surge_n", "surge", "N"),
    LabelPart("heave_n", "heave", "N"),
    LabelPart("yaw_nm", "yaw", "N m"),
    LabelPart("sway_n", "sway", "N"),
)
CHANNELS = (  # or thrusters 5 to 8
    *(LabelPart(f"thruster_{k}_us", f"thruster {k}", "us") for k in range(1, 5)),
    *(LabelPart(f"ankle_{k}_us", f"ankle {k}", "us") for k in range(1, 5)),
)


def columns(*names: str) -> Label:
    """The label of an array that only tables show."""
    return Label("", parts=tuple(LabelPart(name, "", "") for name in names))


@cache
def labels(cls: Any) -> dict[str, Label]:
    """The labels of a message's fields, by their names."""
    hints = get_type_hints(cls, include_extras=True)
    noted = {f.name: get_args(hints[f.name])[1:] for f in dataclasses.fields(cls) if get_origin(hints[f.name]) is Annotated}
    return {name: note for name, notes in noted.items() for note in notes if isinstance(note, Label)}


def plotted(cls: Any, path: str = "") -> Iterator[tuple[str, str, str]]:
    """Every number of a message that has a title, also in messages within it: its path (`control.wrench.0`), title, unit."""
    hints, labels_by_name = get_type_hints(cls), labels(cls)
    for f in dataclasses.fields(cls):
        label = labels_by_name.get(f.name, Label(""))
        nested = nested_message(hints[f.name])
        if nested is not None:
            yield from plotted(nested, f"{path}{f.name}.")
        elif label.parts and label.title:
            for k, part in enumerate(label.parts):
                yield f"{path}{f.name}.{k}", f"{label.title}: {part.title}", part.unit
        elif label.title:
            yield path + f.name, label.title, label.unit

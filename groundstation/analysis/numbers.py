"""Numbers of a report, in one style: three digits, lengths in mm, angles in degrees, shares in per cent. Pure."""

import math

from groundstation.analysis.statistics import NOTHING, three

SHOWN_AS = {"m": ("mm", 1e3), "rad": ("deg", 180.0 / math.pi), "fraction": ("%", 100.0)}


def mm(value_m: float | None) -> str:
    """A length in mm."""
    return three(value_m, 1e3)


def deg(value_rad: float | None) -> str:
    """An angle in degrees."""
    return three(value_rad, 180.0 / math.pi)


def with_unit(value: float | None, unit: str) -> str:
    """A value with the unit it is shown in; a number of things, which has none, as it is."""
    if value is None:
        return NOTHING
    name, factor = SHOWN_AS.get(unit, (unit, 1.0))
    return f"{three(value, factor)} {name}" if unit else f"{value:g}"

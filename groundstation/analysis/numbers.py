"""Numbers for people, in one style: three digits, lengths in mm, angles in degrees, shares in per cent. Pure."""

import math

NOTHING = "–"
MOST_PLACES = 4
SHOWN_AS = {"m": ("mm", 1e3), "rad": ("deg", 180.0 / math.pi), "fraction": ("%", 100.0)}


def three(value: float | None, factor: float = 1.0) -> str:
    """Three significant digits of value times factor, never in powers of ten; a dash for what is not known."""
    if value is None or not math.isfinite(value):
        return NOTHING
    scaled = value * factor
    if scaled == 0.0:
        return "0"
    power = int(f"{scaled:.2e}".partition("e")[2])  # after rounding: 99.96 is 100
    places = min(max(0, 2 - power), MOST_PLACES)
    return f"{scaled:.{places}f}"


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

"""Content of figures over time, apart from their form: plotting.py draws it on paper, templates/plots.js in a page. Pure."""

import base64
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from shoal.frames import Array

MOST_POINTS = 6000  # of a curve in a page; beyond that only what can be seen at all is kept
SHOW_LIMIT_FROM = 0.4  # of the limit: below it the limit is told in words, so that the curve is not squashed


@dataclass(frozen=True, eq=False)
class Curve:
    """One curve over time."""

    label: str
    time_s: Array
    values: Array
    colour: str
    style: str = "-"  # matplotlib's: "-", "--", ":", or "." for dots


@dataclass(frozen=True, eq=False)
class Panel:
    """One plot over time: its axis label with unit, its curves, the least range of values worth showing (noise at the last
    bit must not fill the plot), and what the curves are compared with."""

    label: str
    lines: Sequence[Curve]
    least: float = 0.01
    limit: float | None = None  # drawn at both signs, or told in words where the curves stay far from it
    unit: str = ""  # of the limit
    floor: float | None = None  # a value that the curves must not come below, and the axis begins at 0
    band: tuple[float, float] | None = None  # a range of values without effect

    @property
    def reaches_limit(self) -> bool:
        """True if the curves come so near the limit that it is drawn."""
        largest = max((float(np.nanmax(np.abs(line.values), initial=0.0)) for line in self.lines), default=0.0)
        return self.limit is not None and largest >= SHOW_LIMIT_FROM * self.limit


@dataclass(frozen=True, eq=False)
class TimePlot:
    """Panels over one time axis, one above the other."""

    panels: Sequence[Panel]
    mark_s: float | None = None  # an instant to mark
    height_in: float = 1.35  # of a panel
    histogram: bool = False  # on paper: how often each value occurs, beside the first panel

    @property
    def is_empty(self) -> bool:
        """True if there is not a single value to plot."""
        return not any(np.isfinite(line.values).any() for panel in self.panels for line in panel.lines)


@dataclass(frozen=True)
class Bar:
    """A stretch of time in which something holds."""

    begin_s: float
    length_s: float
    colour: str
    label: str = ""


@dataclass(frozen=True)
class BarPlot:
    """Named rows of bars over one time axis, and instants to mark in a row of their own below."""

    rows: Sequence[tuple[str, Sequence[Bar]]]
    begin_s: float
    end_s: float
    marks: Sequence[tuple[str, str, Sequence[float]]] = ()  # matplotlib's sign, its meaning, and when


@dataclass(frozen=True)
class PaperFigure:
    """A figure that is no plot over time: how it is drawn on paper of a width in inches."""

    draw: Callable[[float], Figure]


def embedded(plot: TimePlot | BarPlot) -> dict[str, Any]:
    """A plot for plots.js. Numbers are little-endian float32 in base64; panels share the arrays of their times."""
    if isinstance(plot, BarPlot):
        marks = [(meaning, list(times)) for _, meaning, times in plot.marks]
        rows = [(name, [asdict(bar) for bar in bars]) for name, bars in plot.rows]
        return {"rows": rows, "marks": marks, "begin": plot.begin_s, "end": plot.end_s}
    times: dict[str, int] = {}
    panels = [_panel(panel, times) for panel in plot.panels]
    return {"times": list(times), "panels": panels, "mark": plot.mark_s, "height": round(96 * plot.height_in)}


def _panel(panel: Panel, times: dict[str, int]) -> dict[str, Any]:
    """A panel as the page draws it; `times` numbers the time axes, which lines share."""
    lines = []
    for line in panel.lines:
        time_s, values = thin(line.time_s, line.values)
        time_index = times.setdefault(_float32(time_s), len(times))
        lines.append(
            {"label": line.label, "colour": line.colour, "style": line.style, "time": time_index, "values": _float32(values)}
        )
    limit = panel.limit if panel.reaches_limit else None
    limit_text = f"limit ±{panel.limit:g} {panel.unit}" if panel.limit is not None and limit is None else ""
    return {
        "label": panel.label, "lines": lines, "least": panel.least, "limit": limit, "told": limit_text,
        "floor": panel.floor, "band": panel.band,
    }  # fmt: skip


def _float32(values: Array) -> str:
    return base64.b64encode(np.asarray(values, dtype="<f4").tobytes()).decode("ascii")


def thin(time_s: Array, values: Array) -> tuple[Array, Array]:
    """A curve with no more points than can be seen: of each stretch only its lowest and its highest, in order."""
    stretches = MOST_POINTS // 2
    if len(values) <= 2 * stretches:
        return time_s, values
    edges = np.linspace(0, len(values), stretches + 1).astype(int)
    kept: list[int] = []
    for first, last in pairwise(edges.tolist()):
        part = values[first:last]
        if np.isfinite(part).any():
            kept += sorted({first + int(np.nanargmin(part)), first + int(np.nanargmax(part))})
        else:
            kept.append(first)  # keeps the gap a gap
    return time_s[kept], values[kept]

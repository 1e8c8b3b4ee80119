"""Style of the report's figures, and the few plots that they consist of. Pure: figures in, SVG text out.

What a line means never hangs on its colour
alone (references are dashed, truth is dotted, limits are grey).
"""

import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from wire.frames import Array

GREY, LIGHT = "#767676", "#D9D9D9"
WIDTH_IN = 7.2
# Fixed margins: every figure's axis begins at the same place, and no layout engine has to draw everything twice to find out.
LEFT_IN, RIGHT_IN, TOP_IN, BOTTOM_IN, GAP_IN = 0.85, 0.12, 0.34, 0.48, 0.20
MOST_POINTS = 3000  # of a line; beyond that only what can be seen at all is kept
MOST_LABELS = 8
SHOW_LIMIT_FROM = 0.4  # of the limit: below it the limit is told in words, so that the curve is not squashed

STYLE: Any = {  # Any: matplotlib types its keys as one literal of hundreds of names
    "svg.fonttype": "none",  # text stays text: small, sharp, searchable
    "font.family": "sans-serif",
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.titlelocation": "left",
    "axes.labelsize": 9.0,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.6,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#E6E6E6",
    "grid.linewidth": 0.6,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": "#333333",
    "ytick.labelcolor": "#333333",
    "lines.linewidth": 1.1,
    "axes.formatter.useoffset": False,
    "legend.frameon": False,
    "legend.markerscale": 4.0,
    "legend.fontsize": 8.5,
}


@dataclass(frozen=True, eq=False)
class Curve:
    """One curve over time."""

    label: str
    time_s: Array
    values: Array
    colour: str
    style: str = "-"


@dataclass(frozen=True, eq=False)
class Panel:
    """One plot over time: its axis label with unit, its curves, the least range of values worth showing (noise at the last
    bit must not fill the plot), and a limit to compare with (drawn at both signs)."""

    label: str
    lines: Sequence[Curve]
    least: float = 0.01
    limit: float | None = None
    unit: str = ""


def stack(panels: Sequence[Panel], mark_s: float | None = None, height_in: float = 1.35) -> Figure | None:
    """Plots over one time axis, one above the other; None if there is not a single value to plot."""
    if not any(np.isfinite(line.values).any() for panel in panels for line in panel.lines):
        return None
    with mpl.rc_context(STYLE):
        gaps_in = GAP_IN * (len(panels) - 1)
        figure = Figure(figsize=(WIDTH_IN, TOP_IN + BOTTOM_IN + gaps_in + height_in * len(panels)))
        grid = figure.subplots(len(panels), 1, sharex=True, squeeze=False, gridspec_kw={"hspace": GAP_IN / height_in})
        place(figure)
        for axes, panel in zip(grid[:, 0], panels, strict=True):
            for line in panel.lines:
                axes.plot(*thin(line.time_s, line.values), line.style, color=line.colour, label=line.label, alpha=0.85)
            axes.set_ylabel(panel.label)
            _limit(axes, panel)
            low, high = axes.get_ylim()
            if high - low < panel.least:
                axes.set_ylim((low + high - panel.least) / 2.0, (low + high + panel.least) / 2.0)
            if mark_s is not None and axes.get_xlim()[1] > mark_s:
                axes.axvline(mark_s, color=GREY, linewidth=0.7, linestyle=(0, (1, 2)))
            axes.margins(x=0.01)
        grid[-1, 0].set_xlabel("time since the start [s]")
        legend(figure, grid[0, 0])
    return figure


def place(figure: Figure) -> None:
    """Give the axes their margins, and their labels one line."""
    width_in, height_in = figure.get_size_inches()
    figure.subplots_adjust(
        left=LEFT_IN / width_in, right=1 - RIGHT_IN / width_in, top=1 - TOP_IN / height_in, bottom=BOTTOM_IN / height_in
    )
    first = figure.axes[0]
    for axes in figure.axes:
        if axes.get_position().x0 == first.get_position().x0:
            axes.yaxis.set_label_coords((0.18 - LEFT_IN) / (axes.get_position().width * width_in), 0.5)


def legend(figure: Figure, axes: Axes) -> None:
    """One legend above everything, if it is short enough to be read."""
    handles, labels = axes.get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    if 1 <= len(unique) <= MOST_LABELS:
        columns = min(len(unique), 6)
        left = (LEFT_IN - 0.1) / figure.get_size_inches()[0]
        figure.legend(
            list(unique.values()), list(unique), loc="upper left", bbox_to_anchor=(left, 1.0), ncols=columns, borderaxespad=0.2
        )


def _limit(axes: Axes, panel: Panel) -> None:
    if panel.limit is None:
        return
    largest = max((float(np.nanmax(np.abs(line.values), initial=0.0)) for line in panel.lines), default=0.0)
    if largest >= SHOW_LIMIT_FROM * panel.limit:
        for sign in (1.0, -1.0):
            axes.axhline(sign * panel.limit, color=GREY, linewidth=0.8, linestyle="--")
    else:
        axes.set_title(f"limit ±{panel.limit:g} {panel.unit}", loc="right", fontsize=8.0, color=GREY, pad=2.0)


def time_and_histogram(
    label: str, lines: Iterable[Curve], limit: float | None = None, limit_label: str = "", height_in: float = 2.2
) -> Figure | None:
    """Dots over time beside how often each value occurs; None without values."""
    lines = [line for line in lines if np.isfinite(line.values).any()]
    if not lines:
        return None
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, TOP_IN + BOTTOM_IN + height_in))
        left, right = figure.subplots(1, 2, width_ratios=(3, 1), sharey=True, gridspec_kw={"wspace": 0.06})
        place(figure)
        for line in lines:
            # thousands of dots: as a picture inside the SVG
            left.plot(
                line.time_s, line.values, ".", color=line.colour, markersize=2.0, alpha=0.6, rasterized=True, label=line.label
            )
        everything = np.concatenate([line.values[np.isfinite(line.values)] for line in lines])
        edges = np.histogram_bin_edges(everything, bins=min(40, max(10, int(np.sqrt(everything.size)))))
        for line in lines:
            right.hist(line.values[np.isfinite(line.values)], edges, orientation="horizontal", color=line.colour, alpha=0.55)
        if limit is not None and float(everything.max()) >= SHOW_LIMIT_FROM * limit:
            for axes in (left, right):
                axes.axhline(limit, color=GREY, linewidth=0.8, linestyle="--")
            left.text(
                0.01, limit, f" {limit_label}", transform=left.get_yaxis_transform(), va="bottom", fontsize=8.0, color=GREY
            )
        left.set_ylim(bottom=0.0)
        left.margins(x=0.01)
        left.set(ylabel=label, xlabel="time since the start [s]")
        right.set(xlabel="how often")
        right.locator_params(axis="x", nbins=3)
        legend(figure, left)
    return figure


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


def to_svg(figure: Figure, name: str) -> str:
    """The figure as an inline SVG element, the same for the same figure; `name` keeps its ids apart from other figures'."""
    text = io.StringIO()
    with mpl.rc_context({**STYLE, "svg.hashsalt": name}):
        figure.savefig(text, format="svg", dpi=144, metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    svg = text.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    return re.sub(r'<g id="[^"]*"', "<g", svg)  # nothing refers to groups, and their ids repeat from figure to figure

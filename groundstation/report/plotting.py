"""Style of the report's figures, and the few plots that they consist of. Pure: figures in, SVG text out.

The meaning of a line never depends on its colour alone: references are dashed, truth is dotted, limits are grey.
"""

import io
import re
from collections.abc import Iterable
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import text_to_path

from groundstation.report.drawing import BarPlot, Panel, PaperFigure, TimePlot, thin

GREY, LIGHT = "#767676", "#D9D9D9"
WIDTH_IN, COLUMN_IN = 7.2, 3.5  # of two columns of most journals, and of one
# Fixed margins: every figure's axis begins at the same place, and no layout engine has to draw everything twice to find out.
LEFT_IN, RIGHT_IN, TOP_IN, BOTTOM_IN, GAP_IN = 0.85, 0.12, 0.34, 0.48, 0.20
MOST_LABELS = 8
ROW_IN = 0.22  # of a bar plot
LEGEND_ROW_IN = 0.19
LEGEND_GAP_EM = 2.0  # of the font's size, as matplotlib has it between columns
LEGEND_BESIDE_EM = 2.8 + LEGEND_GAP_EM  # a handle and its pad
LABELS_TO = 0.2  # of the figure's width: where the names of the rows end
TIME_LABEL = "time since the start [s]"

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


def picture(drawing: TimePlot | BarPlot | PaperFigure | None, width_in: float = WIDTH_IN) -> Figure | None:
    """Draw a figure; None if there is nothing to plot. `width_in` is for a picture and a stack of panels; other drawings have
    their own width."""
    if drawing is None or (isinstance(drawing, TimePlot) and drawing.is_empty):
        return None
    with mpl.rc_context(STYLE):
        if isinstance(drawing, PaperFigure):
            return drawing.draw(width_in)
        if isinstance(drawing, BarPlot):
            return _bars(drawing)
        return _time_and_histogram(drawing) if drawing.histogram else stack(drawing, width_in)


def on_page(drawing: PaperFigure, name: str) -> str:
    """A picture for a page: as an SVG element of two columns' width, which is shown, and in a template that of one column,
    which paper.js saves."""
    with mpl.rc_context(STYLE):
        wide, narrow = to_svg(drawing.draw(WIDTH_IN), name), to_svg(drawing.draw(COLUMN_IN), f"{name}, narrow")
    return f'{wide}<template data-columns="1">{narrow}</template>'


def stack(plot: TimePlot, width_in: float) -> Figure:
    """Draw panels below one another on one axis of time."""
    gaps_in = GAP_IN * (len(plot.panels) - 1)
    figure = Figure(figsize=(width_in, TOP_IN + BOTTOM_IN + gaps_in + plot.height_in * len(plot.panels)))
    gap = {"hspace": GAP_IN / plot.height_in}
    grid = figure.subplots(len(plot.panels), 1, sharex=True, squeeze=False, gridspec_kw=gap)
    set_margins(figure)
    for axes, panel in zip(grid[:, 0], plot.panels, strict=True):
        for line in panel.lines:
            axes.plot(*thin(line.time_s, line.values), line.style, color=line.colour, label=line.label, alpha=0.85)
        axes.set_ylabel(panel.label)
        _draw_limits(axes, panel)
        low, high = axes.get_ylim()
        if high - low < panel.least:
            axes.set_ylim((low + high - panel.least) / 2.0, (low + high + panel.least) / 2.0)
        if plot.mark_s is not None and axes.get_xlim()[1] > plot.mark_s:
            axes.axvline(plot.mark_s, color=GREY, linewidth=0.7, linestyle=(0, (1, 2)))
        axes.margins(x=0.01)
    grid[-1, 0].set_xlabel(TIME_LABEL)
    legend(figure, grid[0, 0])
    return figure


def set_margins(figure: Figure) -> None:
    """Set the fixed margins around a figure's axes, and align the vertical labels of the left column of axes."""
    width_in, height_in = figure.get_size_inches()
    figure.subplots_adjust(
        left=LEFT_IN / width_in, right=1 - RIGHT_IN / width_in, top=1 - TOP_IN / height_in, bottom=BOTTOM_IN / height_in
    )
    first = figure.axes[0]
    for axes in figure.axes:
        if axes.get_position().x0 == first.get_position().x0:
            axes.yaxis.set_label_coords((0.18 - LEFT_IN) / (axes.get_position().width * width_in), 0.5)


def legend(figure: Figure, axes: Axes) -> None:
    """Draw one legend above all axes, if it has at most MOST_LABELS entries. The figure becomes taller where its rows need
    more room."""
    handles, labels = axes.get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    if 1 <= len(unique) <= MOST_LABELS:
        width_in, height_in = figure.get_size_inches()
        columns = min(len(unique), legend_columns(unique, width_in))
        above_in, below_in = (1.0 - figure.subplotpars.top) * height_in, figure.subplotpars.bottom * height_in
        more_in = max(LEGEND_ROW_IN * -(-len(unique) // columns) + 0.06 - above_in, 0.0)
        figure.set_size_inches(width_in, height_in + more_in)
        figure.subplots_adjust(top=1.0 - (above_in + more_in) / (height_in + more_in), bottom=below_in / (height_in + more_in))
        left = (LEFT_IN - 0.1) / width_in
        figure.legend(
            list(unique.values()), list(unique), loc="upper left", bbox_to_anchor=(left, 1.0), ncols=columns, borderaxespad=0.2
        )


def legend_columns(labels: Iterable[str], width_in: float) -> int:
    """Number of columns that a legend with these labels has in a figure `width_in` wide: all are as wide as the widest."""
    size_pt, widest_pt = STYLE["legend.fontsize"], 0.0
    font = FontProperties(family=STYLE["font.family"], size=size_pt)
    for label in labels:
        widest_pt = max(widest_pt, text_to_path.get_text_width_height_descent(label, font, ismath=False)[0])
    entry_pt = widest_pt + LEGEND_BESIDE_EM * size_pt
    return max(1, int((72.0 * (width_in - LEFT_IN - RIGHT_IN) + LEGEND_GAP_EM * size_pt) / entry_pt))


def _draw_limits(axes: Axes, panel: Panel) -> None:
    """Draw the limits, the floor and the band that a panel's curves are compared with."""
    if panel.reaches_limit and panel.limit is not None:
        for sign in (1.0, -1.0):
            axes.axhline(sign * panel.limit, color=GREY, linewidth=0.8, linestyle="--")
    elif panel.limit is not None:
        axes.set_title(f"limit ±{panel.limit:g} {panel.unit}", loc="right", fontsize=8.0, color=GREY, pad=2.0)
    if panel.band is not None:
        axes.axhspan(*panel.band, color=LIGHT, alpha=0.6, linewidth=0.0, zorder=0)
    if panel.floor is not None:
        axes.axhline(panel.floor, color=GREY, linewidth=0.8, linestyle="--")
        axes.set_ylim(bottom=0.0)


def _time_and_histogram(plot: TimePlot) -> Figure:
    """Draw one panel as dots over time, and beside it the histogram of its values."""
    (panel,) = plot.panels
    lines = [line for line in panel.lines if np.isfinite(line.values).any()]
    figure = Figure(figsize=(WIDTH_IN, TOP_IN + BOTTOM_IN + plot.height_in))
    left, right = figure.subplots(1, 2, width_ratios=(3, 1), sharey=True, gridspec_kw={"wspace": 0.06})
    set_margins(figure)
    everything = np.concatenate([line.values[np.isfinite(line.values)] for line in lines])
    edges = np.histogram_bin_edges(everything, bins=min(40, max(10, int(np.sqrt(everything.size)))))
    for line in lines:
        # thousands of dots: as a picture inside the file
        dots = {"color": line.colour, "markersize": 2.0, "alpha": 0.6, "rasterized": True, "label": line.label}
        left.plot(line.time_s, line.values, ".", **dots)
        right.hist(line.values[np.isfinite(line.values)], edges, orientation="horizontal", color=line.colour, alpha=0.55)
    for axes in (left, right):
        if panel.reaches_limit and panel.limit is not None:
            axes.axhline(panel.limit, color=GREY, linewidth=0.8, linestyle="--")
    left.set_ylim(bottom=0.0)
    left.margins(x=0.01)
    left.set(ylabel=panel.label, xlabel=TIME_LABEL)
    right.set(xlabel="how often")
    right.locator_params(axis="x", nbins=3)
    legend(figure, left)
    return figure


def _bars(plot: BarPlot) -> Figure:
    """Draw named rows of bars on one axis of time, and below them a row of marks."""
    names = [*(name for name, _ in plot.rows), *(["faults"] if plot.marks else [])]
    figure = Figure(figsize=(WIDTH_IN, TOP_IN + BOTTOM_IN + ROW_IN * (len(names) + 1)))
    axes = figure.subplots()
    set_margins(figure)
    figure.subplots_adjust(left=LABELS_TO)
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0.0, labelcolor=GREY)
    axes.set_xlabel(TIME_LABEL)
    for row, (_, bars) in enumerate(plot.rows):
        for colour, label in dict.fromkeys((bar.colour, bar.label) for bar in bars):
            spans = [(bar.begin_s, bar.length_s) for bar in bars if (bar.colour, bar.label) == (colour, label)]
            axes.broken_barh(spans, (row - 0.38, 0.76), color=colour, label=label or None)
    for sign, meaning, times in plot.marks:
        places = [len(plot.rows)] * len(times)
        for line in axes.plot(times, places, sign, color="black", markersize=5, linestyle="", label=meaning):
            line.set_clip_on(False)  # whole at the edges too
    axes.set_xlim(plot.begin_s, plot.end_s)
    with mpl.rc_context({"legend.markerscale": 1.0}):
        legend(figure, axes)
    return figure


def to_svg(figure: Figure, name: str) -> str:
    """The figure as an inline SVG element, the same for the same figure; `name` keeps its ids apart from other figures'."""
    text = io.StringIO()
    with mpl.rc_context({**STYLE, "svg.hashsalt": name}):
        figure.savefig(text, format="svg", dpi=144, metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    svg = text.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    return re.sub(r'<g id="[^"]*"', "<g", svg)  # nothing refers to groups, and their ids repeat from figure to figure

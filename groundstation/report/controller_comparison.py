"""Table and figures of a comparison: means over seeds with their intervals. Pure; compare_report.py writes."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.textpath import TextPath
from matplotlib.ticker import FormatStrFormatter, NullFormatter

from groundstation.analysis.comparison import SETTLED_S, Comparison, FlightMetrics, Traces, Variant
from groundstation.analysis.statistics import NOTHING, Interval, mean
from groundstation.palette import COLOURS, colour
from groundstation.report.drawing import Curve, Panel, PaperFigure, TimePlot
from groundstation.report.plotting import (
    BOTTOM_IN,
    GREY,
    LEGEND_ROW_IN,
    RIGHT_IN,
    STYLE,
    TIME_LABEL,
    TOP_IN,
    WIDTH_IN,
    legend,
    stack,
)

NAMES_IN = 1.75  # the most room for the variants' names
ROW_IN = 0.27
SOLID, DASHED = "-", "--"
PLAIN = FormatStrFormatter("%g")  # of logarithmic axes


@dataclass(frozen=True)
class Column:
    """A figure of the table: its heading, which one it is, in what unit, and how much of that unit is one in the JSON."""

    heading: str
    key: str
    unit: str
    scale: float


COLUMNS = (
    Column("whole run", "rms_m", "mm", 1000.0),
    Column("after 20 s", "rms_after_20s_m", "mm", 1000.0),
    Column("largest", "max_after_20s_m", "mm", 1000.0),
    Column("yaw", "rms_yaw_after_20s_rad", "mrad", 1000.0),
    Column("formation, whole", "formation_rms_m", "mm", 1000.0),
    Column("formation", "formation_after_20s_m", "mm", 1000.0),
    Column("input change", "input_step_rms", "% of limit", 100.0),
    Column("wanted beyond", "wanted_beyond", "% of steps", 100.0),
    Column("most wanted", "wanted_most", "limits", 1.0),
)


STEP_HEADINGS = ("control step, median [µs]", "control step, 99 % [µs]")


def step_cells(variant: Variant) -> list[str]:
    """Median and 99th percentile of the control step's processor time: means over the flights in which it was measured."""
    times = [flight.step_us for flight in variant.flights if flight.step_us is not None]
    if not times:
        return [NOTHING, NOTHING]
    return [str(mean([one.median for one in times])), str(mean([one.p99 for one in times]))]


def seeds_of(comparison: Comparison) -> str:
    """Number of seeds and which they are: `n = 10 seeds (1 to 10)`."""
    seeds = [flight.seed for flight in comparison.variants[0].flights]
    if len(seeds) == 1:
        return f"n = 1 seed ({seeds[0]})"
    return f"n = {len(seeds)} seeds ({seeds[0]} to {seeds[-1]})"


def column(variant: Variant, key: str) -> list[float]:
    """A figure of all flights, in the order of their seeds."""
    return [float(getattr(flight.figures, key)) for flight in variant.flights]


def ratio(variant: Variant, to: Variant) -> Interval:
    """Geometric mean of one variant's RMS after 20 s over another's on the same seeds, with its confidence interval."""
    both = zip(column(variant, "rms_after_20s_m"), column(to, "rms_after_20s_m"), strict=True)
    logs = mean([math.log(a / b) for a, b in both])
    return Interval(math.exp(logs.value), *(None if end is None else math.exp(end) for end in (logs.low, logs.high)))


def cells(comparison: Comparison) -> list[tuple[str, list[str]]]:
    """The table: a row per variant, its cells as text, the ratio first."""
    first = comparison.variants[0]
    rows = []
    for variant in comparison.variants:
        times = "1" if variant is first else str(ratio(variant, first))
        figures = [mean([c.scale * v for v in column(variant, c.key)]) for c in COLUMNS]
        rows.append((variant.name, [times, *map(str, figures)]))
    return rows


def failures(comparison: Comparison) -> list[str]:
    """Failures to read before the figures: flights that were not flown under way, and robots that came too close."""
    return [
        f"{variant.name}, seed {flight.seed}: {failure}"
        for variant in comparison.variants
        for flight in variant.flights
        for failure in _failures_of(flight.figures, comparison.separation_m)
    ]


def _failures_of(figures: FlightMetrics, least_m: float) -> Iterator[str]:
    if figures.under_way < 1.0:
        yield f"under way in {100.0 * figures.under_way:.1f} % of the control steps only"
    if figures.min_separation_m is not None and figures.min_separation_m < least_m:
        yield f"two robots came to {figures.min_separation_m:.3f} m of one another (allowed: {least_m:g} m)"


def closest(comparison: Comparison) -> list[tuple[str, float]]:
    """Per variant the least distance of two robots in all flights; none for a single robot."""
    return [
        (variant.name, min(apart))
        for variant in comparison.variants
        if (apart := [d for flight in variant.flights if (d := flight.figures.min_separation_m) is not None])
    ]


# --- figures


def errors(comparison: Comparison) -> PaperFigure:
    """Every flight as a dot, means with their intervals, on logarithmic axes."""
    return PaperFigure(partial(_errors, comparison))


def _errors(comparison: Comparison, width_in: float) -> Figure:
    """A panel for each RMS: a row for each variant, with a dot for each flight, their mean and its interval."""
    keys = [c for c in COLUMNS if c.key in ("rms_m", "rms_after_20s_m", "formation_after_20s_m")]
    keys = keys if len(comparison.robots) > 1 else keys[:2]
    figure, grid = _axis_rows(comparison, len(keys), width_in)
    for axes, c in zip(grid, keys, strict=True):
        for i, variant in enumerate(comparison.variants):
            values = c.scale * np.maximum(column(variant, c.key), 1e-6)
            tone = colour(i)
            axes.plot(values, np.full(len(values), i), "o", color=tone, markersize=4.0, alpha=0.4, markeredgewidth=0.0)
            centre = mean(values.tolist())
            if centre.low is not None and centre.high is not None:
                axes.plot([centre.low, centre.high], [i, i], color=tone, linewidth=1.6)
            axes.plot(centre.value, i, "|", color=tone, markersize=11, markeredgewidth=1.8)
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(PLAIN)
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_xlabel(f"RMS, {c.heading} [{c.unit}]")
    return figure


def demands(comparison: Comparison) -> PaperFigure:
    """Share of control steps in which more was wanted than is allowed, and how much input changes."""
    return PaperFigure(partial(_demands, comparison))


def _demands(comparison: Comparison, width_in: float) -> Figure:
    """Bars for each variant: the share of steps in which more was wanted than the limits allow, and the change per step."""
    figure, (left, right) = _axis_rows(comparison, 2, width_in, TOP_IN)
    beyond_limits = (("wanted_too_large", "too large", -0.2, COLOURS[1]), ("wanted_too_fast", "too fast", 0.2, COLOURS[4]))
    for i, variant in enumerate(comparison.variants):
        for key, name, shift, tone in beyond_limits:
            share = mean([100.0 * v for v in column(variant, key)])
            label = name if i == 0 else ""  # in the legend once
            left.barh(i + shift, share.value, 0.36, color=tone, xerr=_bars(share), ecolor=GREY, label=label)
        wear = mean([100.0 * v for v in column(variant, "input_step_rms")])
        right.barh(i, wear.value, 0.6, color=colour(i), xerr=_bars(wear), ecolor=GREY)
    left.set_xlabel("wanted beyond limits [% of steps]")
    right.set_xlabel("RMS change per step [% of limit]")
    legend(figure, left)
    for axes in (left, right):
        axes.set_xlim(left=0.0)
    return figure


def _bars(interval: Interval) -> list[list[float]] | None:
    """Lengths below and above a value, as matplotlib takes them; None for a value without an interval."""
    if interval.low is None or interval.high is None:
        return None
    return [[max(interval.value - interval.low, 0.0)], [max(interval.high - interval.value, 0.0)]]  # of equal values: rounding


def _axis_rows(comparison: Comparison, count: int, width_in: float, top_in: float = 0.15) -> tuple[Figure, Sequence[Axes]]:
    """A figure whose axes share a row per variant; on one column's width one below the other."""
    rows, names = len(comparison.variants), [variant.name for variant in comparison.variants]
    down, across = (1, count) if width_in == WIDTH_IN else (count, 1)
    each_in = ROW_IN * rows
    figure = Figure(figsize=(width_in, top_in + down * (BOTTOM_IN + each_in)))
    grid = figure.subplots(down, across, sharey=True, squeeze=False).ravel()
    height_in = float(figure.get_size_inches()[1])
    figure.subplots_adjust(
        left=min(max(map(_width_in, names)) + 0.1, NAMES_IN) / width_in,
        right=1 - RIGHT_IN / width_in,
        top=1 - top_in / height_in,
        bottom=BOTTOM_IN / height_in,
        wspace=0.08,
        hspace=BOTTOM_IN / each_in,
    )
    grid[0].set_yticks(range(rows), names)
    grid[0].set_ylim(rows - 0.5, -0.5)
    for axes in grid:
        axes.tick_params(axis="y", length=0)
    return figure, list(grid)


def _width_in(name: str) -> float:
    """Width of a name beside an axis."""
    return float(TextPath((0.0, 0.0), name, size=STYLE["font.size"]).get_extents().width) / 72.0


def course(comparison: Comparison) -> PaperFigure | None:
    """Distance from the reference over time, on the first seed."""
    return PaperFigure(partial(_course, comparison)) if _traced(comparison) else None


def _course(comparison: Comparison, width_in: float) -> Figure:
    """The legend stands beside the axes, or above them on one column's width."""
    beside = width_in == WIDTH_IN
    above_in = 0.1 if beside else 0.1 + LEGEND_ROW_IN * len(_traced(comparison))
    figure = Figure(figsize=(width_in, 3.4 if beside else 2.4 + above_in))
    height_in = float(figure.get_size_inches()[1])
    axes = figure.subplots()
    left, right = 0.8 / width_in, 0.69 if beside else 1 - RIGHT_IN / width_in
    figure.subplots_adjust(left=left, right=right, top=1 - above_in / height_in, bottom=BOTTOM_IN / height_in)
    for i, (variant, traces) in enumerate(_traced(comparison)):
        values = np.maximum(1000.0 * np.array(traces.error_m), 1e-2)
        time_s = traces.error_period_s * np.arange(len(values))
        axes.plot(time_s, values, SOLID if i < len(COLOURS) else DASHED, color=colour(i), label=variant.name)
    axes.axvline(SETTLED_S, color=GREY, linewidth=0.7, linestyle=(0, (1, 2)))
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(PLAIN)
    axes.set(xlabel=TIME_LABEL, ylabel="RMS distance [mm]")
    axes.margins(x=0.01)
    figure.legend(loc="upper left", bbox_to_anchor=(right if beside else left, 0.985), borderaxespad=0.0)
    return figure


def wanted(comparison: Comparison) -> PaperFigure | None:
    """Surge of the robot that wanted most, per law: wanted (thin) and applied, with the limit."""
    traced_variants = [(v, t) for v, t in _traced(comparison) if "-without-" not in v.name and not v.name.startswith("mpc-")]
    return PaperFigure(partial(_surge_figure, comparison, traced_variants)) if traced_variants else None


def _surge_figure(comparison: Comparison, traced_variants: Sequence[tuple[Variant, Traces]], width_in: float) -> Figure:
    """Surge that was wanted and applied over time, of each variant's robot that wanted most."""
    panels = []
    for _, traces in traced_variants:
        most = int(np.argmax([np.abs(each).max() for each in traces.wanted_n]))
        time_s = np.array([traces.input_period_s * k for k in range(len(traces.wanted_n[most]))])
        lines = [
            Curve("wanted", time_s, np.array(traces.wanted_n[most]), COLOURS[1]),
            Curve("applied", time_s, np.array(traces.applied_n[most]), COLOURS[0]),
        ]
        panels.append(Panel("surge [N]", lines, limit=comparison.surge_limit_n, unit="N"))
    figure = stack(TimePlot(panels, height_in=1.0), width_in)
    for axes, (variant, _) in zip(figure.axes, traced_variants, strict=True):
        axes.set_title(variant.name, loc="center", fontsize=8.5, pad=2.0)
    return figure


def _traced(comparison: Comparison) -> list[tuple[Variant, Traces]]:
    return [(v, v.flights[0].traces) for v in comparison.variants if v.flights and v.flights[0].traces is not None]

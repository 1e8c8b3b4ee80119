"""The report's figures of what happened when: modes and faults, limits and slack, links, and where the time goes. Pure."""

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from groundstation.analysis.series import HOPS, Mask, RobotSeries, Series, active_limits
from groundstation.palette import COLOURS, colour
from groundstation.report.plotting import BOTTOM_IN, GREY, STYLE, TOP_IN, WIDTH_IN, Curve, Panel, legend, place, stack
from wire.frames import Array
from wire.messages.messages import Mode

ROW_IN = 0.22
MOST_ROWS = 24
LABELS_TO = 0.2  # of the figure's width: where the rows' names end
WINDOW_S = 1.0  # of the medians that show where time goes
TONES = {
    Mode.DISARMED: "#D9D9D9", Mode.ARMED: "#E69F00", Mode.TRACKING: "#009E73", Mode.HOLDING: "#56B4E9", Mode.DRIVEN: "#CC79A7",
    Mode.STOPPED: "#000000", Mode.FAULT: "#D55E00",
}  # fmt: skip


def timeline(series: Series) -> Figure | None:
    """Each robot's mode over time, and faults as they were noticed and, in simulation, made."""
    known = [(robot, r.states) for robot, r in series.robots.items() if len(r.states.time_s)][:MOST_ROWS]
    if not known:
        return None
    begin_s = min(float(states.time_s[0]) for _, states in known)
    end_s = max(float(states.time_s[-1]) for _, states in known)
    within = [h for h in series.timeline_events if begin_s <= h.time_s <= end_s]
    noticed = [h.time_s for h in within if h.fault]
    made = [h.time_s for h in within if h.text.startswith("fault") and not h.fault]
    with mpl.rc_context({**STYLE, "legend.markerscale": 1.0}):
        figure, axes = _rows([*(f"robot {robot}" for robot, _ in known), "faults"])
        for row, (_, states) in enumerate(known):
            for mode, tone in TONES.items():
                spans = spans_of(states.time_s, np.asarray(states.mode == mode))
                if spans:
                    axes.broken_barh(spans, (row - 0.38, 0.76), color=tone, label=mode.name.lower())
        for at_s, sign, name in ((noticed, "v", "noticed"), (made, "x", "made, or over")):
            if at_s:
                axes.plot(at_s, [len(known)] * len(at_s), sign, color="black", markersize=5, linestyle="", label=name)
        axes.set_xlim(begin_s, end_s + 1e-3)
        legend(figure, axes)
    return figure


def limits(series: Series) -> Figure | None:
    """Times at which a limit held an input back, and plans that entered another robot's space."""
    rows: list[tuple[str, RobotSeries, Mask, int]] = []
    for index, (robot, r) in enumerate(series.robots.items()):
        flown = r.states.tracking & (r.states.time_s <= series.end_s)
        for name, active in active_limits(series, r).items():
            if (active & flown).any():
                rows.append((f"{robot}: {name}", r, np.asarray(active & flown), index))
    if not rows:
        return None
    with mpl.rc_context(STYLE):
        figure, axes = _rows([name for name, *_ in rows[:MOST_ROWS]])
        for row, (_, r, active, index) in enumerate(rows[:MOST_ROWS]):
            axes.broken_barh(spans_of(r.states.time_s, active), (row - 0.38, 0.76), color=colour(index))
        axes.set_xlim(0.0, max(series.end_s, 0.1))
    return figure


def slack(series: Series) -> Figure | None:
    """By how much plans entered the space of others."""
    each = enumerate(series.robots.items())
    lines = [_shown(series, r, f"robot {robot}", 1e3 * r.states.slack_m, i) for i, (robot, r) in each]
    return stack([Panel("slack [mm]", lines, least=1.0)])


def links(series: Series) -> Figure | None:
    """Share of the boards' messages that was lost."""
    each = enumerate(series.robots.items())
    lines = [_shown(series, r, f"robot {robot}", 100.0 * r.states.board_loss, i) for i, (robot, r) in each]
    return stack([Panel("lost within 5 s [%]", lines, least=1.0)])


def latency_budget(series: Series) -> Figure | None:
    """Shares of the time from the exposure to the PWM: medians of all robots, second by second."""
    times = np.concatenate([r.states.time_s for r in series.robots.values()])
    hops = np.concatenate([r.states.hops_ms for r in series.robots.values()])
    known = np.isfinite(hops).all(axis=1) & (times >= 0.0) & (times <= series.end_s)
    if not known.any():
        return None
    window = (times[known] / WINDOW_S).astype(int)
    seconds = np.unique(window)
    medians = np.array([np.median(hops[known][window == second], axis=0) for second in seconds])
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, TOP_IN + BOTTOM_IN + 1.8))
        axes = figure.subplots()
        place(figure)
        axes.stackplot((seconds + 0.5) * WINDOW_S, medians.T, labels=HOPS, colors=COLOURS[: len(HOPS)], alpha=0.8)
        axes.set(xlabel="time since the start [s]", ylabel="median [ms]")
        axes.margins(x=0.01)
        legend(figure, axes)
    return figure


def _shown(series: Series, r: RobotSeries, label: str, values: Array, index: int) -> Curve:
    inside = (r.states.time_s >= 0.0) & (r.states.time_s <= series.end_s)
    return Curve(label, r.states.time_s[inside], values[inside], colour(index))


def _rows(names: Sequence[str]) -> tuple[Figure, Axes]:
    """One axis of time with a named row for each."""
    figure = Figure(figsize=(WIDTH_IN, TOP_IN + BOTTOM_IN + ROW_IN * (len(names) + 1)))
    axes = figure.subplots()
    place(figure)
    figure.subplots_adjust(left=LABELS_TO)
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0.0, labelcolor=GREY)
    axes.set_xlabel("time since the start [s]")
    return figure, axes


def spans_of(time_s: Array, active: Mask) -> list[tuple[float, float]]:
    """Beginning and length of each stretch in which something holds; up to the next control step."""
    step_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.05
    edges = np.flatnonzero(np.diff(np.concatenate([[0], active.astype(int), [0]]))).tolist()
    stretches = zip(edges[::2], edges[1::2], strict=True)
    return [(float(time_s[first]), float(time_s[last - 1] - time_s[first]) + step_s) for first, last in stretches]

"""The report's figures of what happened when: modes and faults, limits and slack, links, and where the time goes. Pure."""

import numpy as np

from groundstation.analysis.series import HOPS, Mask, RobotSeries, Series, active_limits
from groundstation.analysis.timeline import is_injection
from groundstation.palette import COLOURS, colour
from groundstation.report.drawing import Bar, BarPlot, Curve, Panel, TimePlot
from shoal.frames import Array
from shoal.messages.messages import Guidance, Mode

MOST_ROWS = 24
WINDOW_S = 1.0  # of the medians that show where time goes
TONES = {
    Mode.DISARMED: "#D9D9D9", Mode.ARMED: "#E69F00", Mode.TRACKING: "#009E73", Mode.HOLDING: "#56B4E9", Mode.DRIVEN: "#CC79A7",
    Mode.STOPPED: "#000000", Mode.FAULT: "#D55E00",
}  # fmt: skip
ALONG_PATH = {Guidance.JOINING: "#8FD6BF", Guidance.GIVING_WAY: "#F0E442", Guidance.RETURNING: "#C3DB5E"}  # while TRACKING


def _bars(time_s: Array, holds: Array, tone: str, name: str) -> list[Bar]:
    """A bar for each span of time in which something holds."""
    return [Bar(from_s, length_s, tone, name) for from_s, length_s in spans_of(time_s, np.asarray(holds))]


def timeline(series: Series) -> BarPlot | None:
    """Each robot's mode and guidance state over time, and faults as they were noticed and, in simulation, made."""
    robot_states = [(robot, r.states) for robot, r in series.robots.items() if len(r.states.time_s)][:MOST_ROWS]
    if not robot_states:
        return None
    begin_s = min(float(states.time_s[0]) for _, states in robot_states)
    end_s = max(float(states.time_s[-1]) for _, states in robot_states)
    rows = []
    for robot, states in robot_states:
        is_tracking = states.mode == Mode.TRACKING
        guidance_states = states.of(lambda s: s.guidance)
        bars: list[Bar] = []
        for mode, tone in TONES.items():
            bars += _bars(states.time_s, states.mode == mode, tone, mode.name.lower())
        for guidance, tone in ALONG_PATH.items():
            name = guidance.name.lower().replace("_", " ")
            bars += _bars(states.time_s, is_tracking & (guidance_states == guidance), tone, name)
        rows.append((f"robot {robot}", bars))
    events = [event for event in series.timeline_events if begin_s <= event.time_s <= end_s]
    faults_s = [event.time_s for event in events if event.fault]
    injections_s = [event.time_s for event in events if is_injection(event)]
    marks = []
    if faults_s:
        marks.append(("v", "noticed", faults_s))
    if injections_s:
        marks.append(("x", "injected, or over", injections_s))
    return BarPlot(rows, begin_s, end_s + 1e-3, marks)


def limits(series: Series) -> BarPlot | None:
    """Times at which a limit held an input back, and plans that entered another robot's space."""
    rows = []
    for index, (robot, r) in enumerate(series.robots.items()):
        under_way = r.states.tracking & (r.states.time_s <= series.end_s)
        for name, active in active_limits(series, r).items():
            spans = spans_of(r.states.time_s, np.asarray(active & under_way))
            if spans:
                rows.append((f"{robot}: {name}", [Bar(from_s, length_s, colour(index)) for from_s, length_s in spans]))
    return BarPlot(rows[:MOST_ROWS], 0.0, max(series.end_s, 0.1)) if rows else None


def slack(series: Series) -> TimePlot:
    """Distance by which plans entered the space of others."""
    each = enumerate(series.robots.items())
    lines = [_shown(series, r, f"robot {robot}", 1e3 * r.states.control(lambda c: c.slack_m), i) for i, (robot, r) in each]
    return TimePlot([Panel("slack [mm]", lines, least=1.0)])


def links(series: Series) -> TimePlot:
    """Share of the boards' messages that was lost."""
    each = enumerate(series.robots.items())
    lines = [_shown(series, r, f"robot {robot}", 100.0 * r.states.board(lambda b: b.loss), i) for i, (robot, r) in each]
    return TimePlot([Panel("lost within 5 s [%]", lines, least=1.0)])


def latency_budget(series: Series) -> TimePlot | None:
    """Shares of the time from the exposure to the PWM: medians of all robots, second by second."""
    times = np.concatenate([r.states.time_s for r in series.robots.values()])
    hops = np.concatenate([r.states.hops_ms for r in series.robots.values()])
    is_counted = np.isfinite(hops).all(axis=1) & (times >= 0.0) & (times <= series.end_s)
    if not is_counted.any():
        return None
    window = (times[is_counted] / WINDOW_S).astype(int)
    seconds = np.unique(window)
    medians = np.array([np.median(hops[is_counted][window == second], axis=0) for second in seconds])
    middles_s = (seconds + 0.5) * WINDOW_S
    lines = [Curve(name, middles_s, medians[:, k], COLOURS[k % len(COLOURS)]) for k, name in enumerate(HOPS)]
    return TimePlot([Panel("median [ms]", lines)], height_in=1.8)


def _shown(series: Series, r: RobotSeries, label: str, values: Array, index: int) -> Curve:
    inside = (r.states.time_s >= 0.0) & (r.states.time_s <= series.end_s)
    return Curve(label, r.states.time_s[inside], values[inside], colour(index))


def spans_of(time_s: Array, active: Mask) -> list[tuple[float, float]]:
    """Beginning and length of each stretch in which something holds; up to the next control step."""
    step_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.05
    edges = np.flatnonzero(np.diff(np.concatenate([[0], active.astype(int), [0]]))).tolist()
    stretches = zip(edges[::2], edges[1::2], strict=True)
    return [(float(time_s[first]), float(time_s[last - 1] - time_s[first]) + step_s) for first, last in stretches]

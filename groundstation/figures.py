"""The report's figures: the article's, and those that a tired engineer needs to see what went wrong. Pure."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle as Disc
from matplotlib.patches import Rectangle

from groundstation.colours import colour
from groundstation.evaluation import SETTLED_S
from groundstation.figures_timeline import latency_budget, limits, links, slack, timeline
from groundstation.plotting import (
    BOTTOM_IN,
    GREY,
    LEFT_IN,
    LIGHT,
    RIGHT_IN,
    STYLE,
    TOP_IN,
    WIDTH_IN,
    Line,
    Panel,
    legend,
    place,
    stack,
    time_and_histogram,
)
from groundstation.series import THRUSTERS, RobotSeries, Series
from wire.frames import Array, wrap_angle

MOST_PULSE_PANELS = 6
TALLEST_IN = 6.5
SNAPSHOT_S = 20.0  # how often the formation is drawn into the plan of the pool
FLAT_M = 0.05  # a path that changes its depth by less than this is best seen from above
MOST_3D_STEP = 5  # every so many control steps are enough for a picture in perspective


@dataclass(frozen=True)
class Kind:
    """A figure of the report: its short name, its title, what to see in it, and how it is drawn (None: no data)."""

    name: str
    title: str
    caption: str
    draw: Callable[[Series], Figure | None]


def references(series: Series) -> Figure | None:
    """The planned paths seen from above, and their headings over time (the article's Figure 9)."""
    known = {robot: r.reference for robot, r in series.robots.items() if np.isfinite(r.reference).all() and len(r.reference)}
    if not known:
        return None
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, TOP_IN + BOTTOM_IN + 2.4))
        above, heading = figure.subplots(1, 2, gridspec_kw={"wspace": 0.28})
        place(figure)
        for index, robot in enumerate(series.robots):
            if robot in known:
                x, y, _, yaw_rad = known[robot].T
                above.plot(x, y, "--", color=colour(index), label=f"reference {robot}")
                above.plot(x[0], y[0], marker="*", color=colour(index), markersize=9, linestyle="")
                heading.plot(series.time_s, yaw_rad, "--", color=colour(index))
        above.set(xlabel="x [m]", ylabel="y [m], downwards")
        above.set_aspect("equal", adjustable="datalim")
        above.invert_yaxis()
        heading.set(xlabel="time since the start [s]", ylabel="heading [rad]")
        heading.yaxis.set_label_coords(-0.14, 0.5)
        legend(figure, above)
    return figure


def space(series: Series) -> Figure | None:
    """Paths in three dimensions, if the robots dive (Figures 10, 13 and 15)."""
    known = {robot: r for robot, r in series.robots.items() if np.isfinite(r.truth[:, :3]).all() and len(r.truth)}
    if not known or max(float(np.ptp(r.reference[:, 2])) for r in known.values()) < FLAT_M:
        return None
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, 4.0))
        axes: Any = figure.add_subplot(projection="3d")  # Any: mpl_toolkits ships no types
        figure.subplots_adjust(left=0.0, right=0.94, top=1.0, bottom=0.06)
        for index, robot in enumerate(series.robots):
            if robot in known:
                r, tone = known[robot], colour(index)
                axes.plot(*r.reference[::MOST_3D_STEP, :3].T, "--", color=tone, linewidth=0.9, alpha=0.7)
                axes.plot(*r.truth[::MOST_3D_STEP, :3].T, color=tone, label=f"robot {robot}")
                axes.plot(*r.truth[:1, :3].T, marker="o", color=tone, markersize=5, linestyle="")
        for row in _snapshots(series):
            corners = np.array([r.truth[row, :3] for r in known.values()])
            axes.plot(*np.vstack([corners, corners[:1]]).T, color=GREY, linewidth=0.7)
        axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="depth [m]")
        axes.invert_yaxis()  # both, so that depth goes down and the pool's frame stays right-handed
        axes.invert_zaxis()
        axes.set_box_aspect((2.0, 1.0, 0.8), zoom=1.25)
        figure.legend(loc="upper left", ncols=6, borderaxespad=0.2)
    return figure


def _snapshots(series: Series) -> range:
    """Rows at which the formation is drawn."""
    return range(0, len(series.time_s), max(1, round(SNAPSHOT_S / series.experiment.controller.period_s)))


def paths(series: Series) -> Figure | None:
    """Paths in the pool, seen from above (the article's Figure 30)."""
    known = [r.truth for r in series.robots.values() if np.isfinite(r.truth[:, :2]).any()]
    if not known:
        return None
    length, width, _ = series.experiment.pool.size_m
    with mpl.rc_context(STYLE):
        low, high = _extent(series)
        inside_in = (WIDTH_IN - LEFT_IN - RIGHT_IN) * float((high - low)[1] / (high - low)[0])
        figure = Figure(figsize=(WIDTH_IN, TOP_IN + BOTTOM_IN + min(inside_in, TALLEST_IN)))
        axes = figure.subplots()
        place(figure)
        if series.experiment.sim.plant.walls:
            axes.add_patch(Rectangle((-length / 2, -width / 2), length, width, fill=False, edgecolor=GREY, linewidth=1.5))
        for island in series.experiment.islands:
            axes.add_patch(Disc(island.position_m, island.radius_m, facecolor=LIGHT, edgecolor=GREY, hatch="///"))
        for index, (robot, r) in enumerate(series.robots.items()):
            _path(axes, robot, r, colour(index), series.experiment.vehicle.radius_m)
        for row in _snapshots(series):
            corners = np.array([r.truth[row, :2] for r in series.robots.values()])
            closed = np.vstack([corners, corners[:1]])
            axes.plot(closed[:, 0], closed[:, 1], color=LIGHT, linewidth=0.8, zorder=1)
        axes.set(xlabel="x [m]", ylabel="y [m], downwards as seen from above", aspect="equal")
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(high[1], low[1])
        legend(figure, axes)
    return figure


def _path(axes: Axes, robot: int, r: RobotSeries, tone: str, radius_m: float) -> None:
    """Reference dashed with a star at its start, path solid from a circle to a square, as in the article."""
    axes.plot(r.reference[:, 0], r.reference[:, 1], "--", color=tone, linewidth=0.9, alpha=0.7)
    axes.plot(r.truth[:, 0], r.truth[:, 1], color=tone, label=f"robot {robot}")
    axes.plot(*r.reference[0, :2], marker="*", color=tone, markersize=9, linestyle="")
    there = np.flatnonzero(np.isfinite(r.truth[:, 0]))
    if not len(there):
        return
    first, last = r.truth[there[0]], r.truth[there[-1]]
    axes.plot(*first[:2], marker="o", color="white", markeredgecolor=tone, markersize=6, linestyle="")
    axes.plot(*last[:2], marker="s", color=tone, markersize=6, linestyle="")
    axes.add_patch(Disc((last[0], last[1]), radius_m, facecolor=tone, alpha=0.10, edgecolor=tone))
    tip = last[:2] + radius_m * np.array([np.cos(last[3]), np.sin(last[3])])
    axes.plot([last[0], tip[0]], [last[1], tip[1]], color=tone, linewidth=1.0)


def _extent(series: Series) -> tuple[Array, Array]:
    """Corners of what is worth showing: the pool, or what lies around the paths when the pool is far larger."""
    points = np.vstack([np.vstack([r.truth[:, :2], r.reference[:, :2]]) for r in series.robots.values()])
    half = np.array(series.experiment.pool.size_m[:2]) / 2.0
    room = 2.0 * series.experiment.vehicle.radius_m
    low, high = np.nanmin(points, axis=0) - room, np.nanmax(points, axis=0) + room
    if np.all(2.0 * half < 3.0 * (high - low).max()):
        low, high = np.minimum(low, -half), np.maximum(high, half)
    edge = 0.03 * (high - low).max()
    return low - edge, high + edge


def tracking_errors(series: Series) -> Figure | None:
    """Tracking error of each robot per axis (Figure 31)."""
    return _axis_errors(
        series, {f"robot {n}": r.error for n, r in series.robots.items()}, [f"{axis} error [m]" for axis in "xyz"]
    )


def formation_errors(series: Series) -> Figure | None:
    """Formation error of each pair per axis (Figure 32)."""
    pairs = {f"pair {a}-{b}": series.pair_error(a, b) for a, b in combinations(series.robots, 2)}
    return _axis_errors(series, pairs, ("x error [m]", "y error [m]", "z error [m]", "yaw error [rad]"))


def _axis_errors(series: Series, errors: dict[str, Array], names: Sequence[str]) -> Figure | None:
    return stack(
        [
            Panel(
                name,
                [Line(label, series.time_s, error[:, axis], colour(i)) for i, (label, error) in enumerate(errors.items())],
            )
            for axis, name in enumerate(names)
        ],
        mark_s=SETTLED_S,
    )


def yaw(series: Series) -> Figure | None:
    """Heading error twice: to the path's tangent, and to the heading that was commanded."""
    tangent = [Line(f"robot {n}", series.time_s, r.error[:, 3], colour(i)) for i, (n, r) in enumerate(series.robots.items())]
    commanded = []
    for i, (robot, r) in enumerate(series.robots.items()):
        error = wrap_angle(r.truth_at_states[:, 3] - r.states.eta_command[:, 3])
        commanded.append(_flown(series, r, f"robot {robot}", error, i))
    return stack([Panel("tangent [rad]", tangent), Panel("command [rad]", commanded)], mark_s=SETTLED_S)


def inputs(series: Series) -> Figure | None:
    """What the controllers asked for; where the law knows no limits, dotted what it would have asked for without."""
    bounds = series.experiment.vehicle.limits.wrench
    wanted = None if series.experiment.controller.law == "eso-mpc" else lambda r: r.states.wrench_wanted
    return _wrench(series, lambda r: r.states.wrench, bounds, "", wanted)


def input_steps(series: Series) -> Figure | None:
    """How much each control step changed it: chatter is wear."""
    bounds = series.experiment.vehicle.limits.wrench_step
    return _wrench(series, lambda r: r.states.wrench_step, bounds, "step of ")


def _wrench(
    series: Series,
    values: Callable[[RobotSeries], Array],
    bounds: tuple[float, ...],
    prefix: str,
    dotted: Callable[[RobotSeries], Array] | None = None,
) -> Figure | None:
    def lines(axis: int) -> list[Line]:
        each = list(enumerate(series.robots.items()))
        under = [(dotted, ", wanted", ":")] if dotted is not None else []
        return [
            _flown(series, r, f"robot {n}{suffix}", of(r)[:, axis], i, style)
            for of, suffix, style in [*under, (values, "", "-")]
            for i, (n, r) in each
        ]

    panels = [
        Panel(
            f"{prefix}{name} [{unit}]",
            lines(axis),
            limit=bounds[axis],
            unit=unit,
        )
        for axis, (name, unit) in enumerate((("surge", "N"), ("heave", "N"), ("yaw", "N m")))
    ]
    return stack(panels)


def _flown(series: Series, r: RobotSeries, label: str, values: Array, index: int, style: str = "-") -> Line:
    """A curve over the control steps of the run, broken where the robot was not under way."""
    inside = (r.states.time_s >= 0.0) & (r.states.time_s <= series.end_s)
    shown = np.where(r.states.tracking, values, np.nan)
    return Line(label, r.states.time_s[inside], shown[inside], colour(index), style)


def pulses(series: Series) -> Figure | None:
    """Pulses to the thrusters, one plot per robot; the grey band is the dead zone."""
    curve = np.array(series.experiment.vehicle.thruster.curve)
    dead = curve[curve[:, 1] == 0.0, 0]
    legs = series.experiment.vehicle.legs.position_m
    names = [f"{'front' if ahead > 0 else 'rear'} {'right' if starboard > 0 else 'left'}" for ahead, starboard in legs]
    panels = [
        Panel(
            f"robot {robot} [µs]",
            [_flown(series, r, names[k], r.states.pulse_us[:, k], k) for k in range(THRUSTERS)],
            least=100.0,
        )
        for robot, r in list(series.robots.items())[:MOST_PULSE_PANELS]
    ]
    figure = stack(panels)
    if figure is not None:
        for axes in figure.axes:
            axes.axhspan(float(dead.min()), float(dead.max()), color=LIGHT, alpha=0.6, linewidth=0.0, zorder=0)
    return figure


def disturbance(series: Series) -> Figure | None:
    """Estimated disturbance against the true one."""
    panels = []
    for axis, (name, unit) in enumerate((("surge", "m/s²"), ("sway", "m/s²"), ("heave", "m/s²"), ("yaw", "rad/s²"))):
        lines = []
        for i, (robot, r) in enumerate(series.robots.items()):
            lines.append(_flown(series, r, f"robot {robot}, true", r.disturbance_at_states[:, axis], i, ":"))
            lines.append(_flown(series, r, f"robot {robot}, estimated", r.states.disturbance[:, axis], i))
        panels.append(Panel(f"{name} [{unit}]", [line for line in lines if np.isfinite(line.values).any()]))
    return stack(panels, height_in=1.2)


def step_times(series: Series) -> Figure | None:
    """How long a control step took on the robot."""
    lines = []
    for i, (robot, r) in enumerate(series.robots.items()):
        lines.append(_flown(series, r, f"robot {robot}", np.where(r.states.step_us > 0.0, r.states.step_us, np.nan), i))
    budget_us = 0.5e6 * series.experiment.controller.period_s
    return time_and_histogram("control step [µs]", lines, budget_us, "budget: half a period")


def latency(series: Series) -> Figure | None:
    """From the middle of an exposure to the PWM that answers it."""
    lines = []
    for i, (robot, r) in enumerate(series.robots.items()):
        known = np.where(r.states.exposure_to_pwm_ms > 0.0, r.states.exposure_to_pwm_ms, np.nan)
        lines.append(_flown(series, r, f"robot {robot}", known, i))
    limit = series.experiment.limits.exposure_to_pwm_p99_ms
    return time_and_histogram("exposure to PWM [ms]", lines, limit, "limit of p99")


def frame_times(series: Series) -> Figure | None:
    """How long the localizer worked on a frame."""
    inside = (series.frame_ms[:, 0] >= 0.0) & (series.frame_ms[:, 0] <= series.end_s)
    time_s, took_ms = series.frame_ms[inside].T
    return time_and_histogram("frame [ms]", [Line("localizer", time_s, took_ms, colour(0))])


def pose_error(series: Series) -> Figure | None:
    """How far off the localizer was, in the plane and in heading."""
    place, heading = [], []
    for i, (robot, r) in enumerate(series.robots.items()):
        inside = (r.pose_time_s >= 0.0) & (r.pose_time_s <= series.end_s)
        time_s, error = r.pose_time_s[inside], r.pose_error[inside]
        place.append(Line(f"robot {robot}", time_s, 1e3 * np.hypot(error[:, 0], error[:, 1]), colour(i)))
        heading.append(Line(f"robot {robot}", time_s, error[:, 2], colour(i)))
    return stack([Panel("place [mm]", place, least=1.0), Panel("heading [rad]", heading)])


def separation(series: Series) -> Figure | None:
    """Distance of the robots' centres; the dashed line is 2 R, which they must not come below."""
    lines = [
        Line(f"pair {a}-{b}", series.time_s, series.separation_m(a, b), colour(i))
        for i, (a, b) in enumerate(combinations(series.robots, 2))
    ]
    figure = stack([Panel("distance [m]", lines)], height_in=1.8)
    if figure is not None:
        axes = figure.axes[0]
        axes.axhline(2.0 * series.experiment.safety.radius_m, color=GREY, linewidth=0.8, linestyle="--")
        axes.set_ylim(bottom=0.0)
    return figure


FIGURES = (
    Kind(
        "timeline",
        "Modes and faults",
        "What each robot was doing. Triangles: a fault was noticed (in words below). Crosses: made or over, in simulation.",
        timeline,
    ),
    Kind(
        "references", "Planned paths", "Seen from above, from their stars, and the heading of the path's tangent.", references
    ),
    Kind(
        "paths",
        "Paths in the pool",
        "Seen from above. Dashed: reference, from its star. Solid: robot, from circle to square; the disc is its hull. "
        "Grey lines join the formation every 20 s.",
        paths,
    ),
    Kind("space", "Paths in space", "Dashed: reference. Grey lines join the formation every 20 s; depth goes down.", space),
    Kind("tracking", "Tracking errors", "Robot minus reference. The dotted line is at 20 s.", tracking_errors),
    Kind("formation", "Formation errors", "Distance vector of a pair minus that of its references.", formation_errors),
    Kind("yaw", "Heading errors", "To the path's tangent, and to the heading commanded (with crab angle).", yaw),
    Kind("inputs", "Control inputs", "Surge, heave and yaw asked for, with their limits.", inputs),
    Kind("steps", "Input steps", "Change per control step. Smooth is part of good: chatter wears thrusters out.", input_steps),
    Kind("limits", "Active limits", "When a limit held an input back, or a plan entered another robot's space.", limits),
    Kind("slack", "Slack", "By how much a robot's plan enters the space of another.", slack),
    Kind("pulses", "Thruster pulses", "The grey band is the thrusters' dead zone.", pulses),
    Kind(
        "disturbance",
        "Disturbance",
        "Acceleration that the model does not explain: estimated, and true (dotted).",
        disturbance,
    ),
    Kind("step-times", "Control step", "Time of a whole control step on the robot.", step_times),
    Kind("latency", "Exposure to PWM", "From the middle of an exposure to the PWM that answers it.", latency),
    Kind(
        "latency-budget",
        "Where the time goes",
        "From exposure to PWM, hop by hop. Time on the wire counts with the wait for the control step.",
        latency_budget,
    ),
    Kind("frame-times", "Localizer", "Processing time of a camera frame.", frame_times),
    Kind("pose-error", "Localizer's error", "Located minus true pose.", pose_error),
    Kind("links", "Links to the boards", "Share of each board's messages that did not arrive.", links),
    Kind("separation", "Separation", "Distance between centres; dashed: 2 R.", separation),
)

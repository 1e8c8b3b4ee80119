"""The report's figures of where robots went: planned paths, paths seen from above, and in space. Pure."""

from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle as Disc
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from groundstation.analysis.series import RobotSeries, Series
from groundstation.palette import colour
from groundstation.report.drawing import PaperFigure
from groundstation.report.plotting import (
    BOTTOM_IN,
    GREY,
    LEFT_IN,
    LIGHT,
    RIGHT_IN,
    TIME_LABEL,
    TOP_IN,
    WIDTH_IN,
    legend,
    legend_columns,
    set_margins,
)
from shoal.config.simulation import Drifter
from shoal.frames import Array

TALLEST_IN = 6.5
SNAPSHOT_S = 20.0  # how often the formation is drawn into the plan of the pool
FLAT_M = 0.05  # a path that changes its depth by less than this is best seen from above
MOST_3D_STEP = 5  # every so many control steps are enough for a picture in perspective


def references(series: Series) -> PaperFigure | None:
    """The planned paths seen from above, and their headings over time (the article's Figure 9)."""
    tracks = {robot: r.reference for robot, r in series.robots.items() if np.isfinite(r.reference).all() and len(r.reference)}
    return PaperFigure(partial(_references, series, tracks)) if tracks else None


def _references(series: Series, tracks: dict[int, Array], width_in: float) -> Figure:
    """Side by side, or one below the other on one column's width."""
    rows = 1 if width_in == WIDTH_IN else 2
    figure = Figure(figsize=(width_in, TOP_IN + rows * (BOTTOM_IN + 2.4)))
    gaps = {"wspace": 0.28} if rows == 1 else {"hspace": BOTTOM_IN / 2.4}
    above, heading = figure.subplots(rows, 3 - rows, gridspec_kw=gaps)
    set_margins(figure)
    for index, robot in enumerate(series.robots):
        if robot in tracks:
            x, y, _, yaw_rad = tracks[robot].T
            above.plot(x, y, "--", color=colour(index), label=f"reference {robot}")
            above.plot(x[0], y[0], marker="*", color=colour(index), markersize=9, linestyle="")
            heading.plot(series.time_s, np.degrees(yaw_rad), "--", color=colour(index))
    above.set(xlabel="x [m]", ylabel="y [m], downwards")
    above.set_aspect("equal", adjustable="datalim")
    above.invert_yaxis()
    heading.set(xlabel=TIME_LABEL, ylabel="heading [deg]")
    if rows == 1:
        heading.yaxis.set_label_coords(-0.14, 0.5)
    legend(figure, above)
    return figure


def space(series: Series) -> PaperFigure | None:
    """Paths in three dimensions, if the robots dive (Figures 10, 13 and 15)."""
    by_robot = {robot: r for robot, r in series.robots.items() if np.isfinite(r.truth[:, :3]).all() and len(r.truth)}
    if not by_robot or max(float(np.ptp(r.reference[:, 2])) for r in by_robot.values()) < FLAT_M:
        return None
    return PaperFigure(partial(_space, series, by_robot))


def _space(series: Series, by_robot: dict[int, RobotSeries], width_in: float) -> Figure:
    """References and true paths in three dimensions, with the formation at some instants."""
    figure = Figure(figsize=(width_in, 0.2 + 3.8 * max(width_in / WIDTH_IN, 0.65)))
    axes: Any = figure.add_subplot(projection="3d")  # Any: mpl_toolkits ships no types
    figure.subplots_adjust(left=0.0, right=1.0 - 0.43 / width_in, top=1.0, bottom=0.06)
    for index, robot in enumerate(series.robots):
        if robot in by_robot:
            r, tone = by_robot[robot], colour(index)
            axes.plot(*r.reference[::MOST_3D_STEP, :3].T, "--", color=tone, linewidth=0.9, alpha=0.7)
            axes.plot(*r.truth[::MOST_3D_STEP, :3].T, color=tone, label=f"robot {robot}")
            axes.plot(*r.truth[:1, :3].T, marker="o", color=tone, markersize=5, linestyle="")
    for row in _snapshots(series):
        corners = np.array([r.truth[row, :3] for r in by_robot.values()])
        axes.plot(*np.vstack([corners, corners[:1]]).T, color=GREY, linewidth=0.7)
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="depth [m]")
    if width_in < WIDTH_IN:
        for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
            axis.set_major_locator(MaxNLocator(4))
    axes.invert_yaxis()  # both, so that depth goes down and the pool's frame stays right-handed
    axes.invert_zaxis()
    axes.set_box_aspect((2.0, 1.0, 0.8), zoom=1.25 if width_in == WIDTH_IN else 1.0)
    labels = [f"robot {robot}" for robot in by_robot]
    figure.legend(loc="upper left", ncols=legend_columns(labels, width_in), borderaxespad=0.2)
    return figure


def paths(series: Series) -> PaperFigure | None:
    """Paths in the pool, seen from above (the article's Figure 30)."""
    has_paths = any(np.isfinite(r.truth[:, :2]).any() for r in series.robots.values())
    return PaperFigure(partial(_paths, series)) if has_paths else None


def _paths(series: Series, width_in: float) -> Figure:
    """References and true paths from above, with walls, islands, drifters and the formation at some instants."""
    length, width, _ = series.experiment.pool.size_m
    low, high = _extent(series)
    inside_in = (width_in - LEFT_IN - RIGHT_IN) * float((high - low)[1] / (high - low)[0])
    figure = Figure(figsize=(width_in, TOP_IN + BOTTOM_IN + min(inside_in, TALLEST_IN)))
    axes = figure.subplots()
    set_margins(figure)
    if series.experiment.pool.walls:
        axes.add_patch(Rectangle((-length / 2, -width / 2), length, width, fill=False, edgecolor=GREY, linewidth=1.5))
    for island in series.experiment.islands:
        axes.add_patch(Disc(island.position_m, island.radius_m, facecolor=LIGHT, edgecolor=GREY, hatch="///"))
    for ball in series.experiment.sim.drifters:
        _drifter(axes, ball, series.end_s)
    for index, (robot, r) in enumerate(series.robots.items()):
        _path(axes, robot, r, colour(index), series.experiment.vehicle.radius_m)
    for row in _snapshots(series):
        corners = np.array([r.truth[row, :2] for r in series.robots.values()])
        closed = np.vstack([corners, corners[:1]])
        axes.plot(closed[:, 0], closed[:, 1], color=LIGHT, linewidth=0.8, zorder=1)
    axes.set(xlabel="x [m]", ylabel="y [m], downwards", aspect="equal")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(high[1], low[1])
    legend(figure, axes)
    return figure


def _drifter(axes: Axes, ball: Drifter, end_s: float) -> None:
    """A simulated ball where it came into the water, and its way from there."""
    if ball.from_s > end_s:
        return
    begin = np.array(ball.start_m[:2])
    end = begin + (end_s - ball.from_s) * np.array(ball.velocity_mps[:2])
    axes.add_patch(Disc((float(begin[0]), float(begin[1])), ball.radius_m, facecolor="#B22222", alpha=0.7, label="obstacle"))
    if not np.array_equal(begin, end):
        axes.plot(*np.array([begin, end]).T, color="#B22222", linewidth=0.9, linestyle=":")


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


def _snapshots(series: Series) -> range:
    """Rows at which the formation is drawn."""
    return range(0, len(series.time_s), max(1, round(SNAPSHOT_S / series.experiment.controller.period_s)))


def _extent(series: Series) -> tuple[Array, Array]:
    """Corners of the part to show: the pool, or the surroundings of the paths when the pool is far larger."""
    points = np.vstack([np.vstack([r.truth[:, :2], r.reference[:, :2]]) for r in series.robots.values()])
    half = np.array(series.experiment.pool.size_m[:2]) / 2.0
    room = 2.0 * series.experiment.vehicle.radius_m
    low, high = np.nanmin(points, axis=0) - room, np.nanmax(points, axis=0) + room
    if np.all(2.0 * half < 3.0 * (high - low).max()):
        low, high = np.minimum(low, -half), np.maximum(high, half)
    edge = 0.03 * (high - low).max()
    return low - edge, high + edge

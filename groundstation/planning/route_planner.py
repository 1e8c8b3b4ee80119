"""The shortest way around islands for a whole formation, as waypoints for a spline. Pure.

A formation that keeps its orientation hits a round island where one of its nodes does: seen from the formation's centre that
is a disc around (island - node), as wide as island, hull and clearance. One that turns with the path is a disc of its own. So
the formation becomes a point among discs, and the shortest way is found on the visibility graph of polygons around them, by A*
that looks at edges only when it comes to them. Walls shrink the rectangle that the point may be in.
"""

import heapq
import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter1d

from groundstation.planning.paths import curve_through
from wire.frames import Array

CORNERS = 24  # of the polygon around a disc: a way around it is 0.6 % longer than along it
SMOOTHER = (1.0, 0.7, 0.5, 0.3, 0.15, 0.05)  # of what was asked for: as smooth as it goes
SPARE_M = (0.02, 0.1, 0.2, 0.4)  # smoothing cuts corners: how much further from islands the way is sought, tried in turn
SPACING_M = 0.25  # of waypoints along the way: straight lines then stay straight under the spline
CHECK_M = 0.02  # spacing of the points at which the spline is looked at
REACH = 4.5  # standard deviations, and half a sample for rounding, after which a Gaussian is cut off
TOUCHING = 1.0 - 1e-9


class NoRoute(ValueError):
    """There is no way, or an end of it is not free."""


def route(via_m: Sequence[tuple[float, float]], discs: Array, half_m: tuple[float, float], smooth_m: float = 0.5) -> Array:
    """Waypoints (n, 2) of a smooth way through `via_m`, clear of `discs` (k, 3: x, y, radius) and inside +-`half_m`, in m.

    Corners, also at places on the way, are spread over some `smooth_m`, less where there is no room. Raises NoRoute with the
    reason.
    """
    ends = np.array(via_m, dtype=np.float64)
    for place in ends:
        _must_be_free(place, discs, half_m)
    lines: dict[float, Array] = {}
    for share in SMOOTHER:
        for spare_m in SPARE_M:
            if spare_m not in lines:
                lines[spare_m] = _line(ends, discs, spare_m, half_m)
            points = _smoothed(lines[spare_m], share * smooth_m)
            if _clear(points, discs, half_m):
                return points
    raise NoRoute("there is a way, but it bends too sharply for a smooth path; move the waypoints or leave wider gaps")


def _line(ends: Array, discs: Array, spare_m: float, half_m: tuple[float, float]) -> Array:
    """Corners (n, 2) of the shortest way, `spare_m` further from the discs where there is room."""
    wide = [_but_free(discs, spare_m, a, b) for a, b in pairwise(ends)]
    try:
        segments = [shortest(a, b, around, half_m) for (a, b), around in zip(pairwise(ends), wide, strict=True)]
    except NoRoute:
        segments = [shortest(a, b, discs, half_m) for a, b in pairwise(ends)]
    return np.concatenate([segments[0], *[segment[1:] for segment in segments[1:]]])


def shortest(start: Array, goal: Array, discs: Array, half_m: tuple[float, float]) -> Array:
    """Corners (n, 2) of the shortest way from `start` to `goal` along polygons around `discs`. Raises NoRoute."""
    corners = _corners(discs, half_m)
    points = np.vstack([start, goal, corners])
    ahead = np.hypot(*(points - goal).T)
    cost, before = np.full(len(points), np.inf), np.full(len(points), -1)
    cost[0], done = 0.0, np.zeros(len(points), dtype=bool)
    queue = [(float(ahead[0]), 0)]
    while queue:
        _, here = heapq.heappop(queue)
        if done[here]:
            continue
        done[here] = True
        if here == 1:
            way = [1]
            while way[-1]:
                way.append(int(before[way[-1]]))
            return np.asarray(points[way[::-1]])
        through = cost[here] + np.hypot(*(points - points[here]).T)
        worth = np.flatnonzero(~done & (through < cost))
        seen = worth[_visible(points[here], points[worth], discs)]
        cost[seen], before[seen] = through[seen], here
        for there in seen.tolist():
            heapq.heappush(queue, (float(cost[there] + ahead[there]), there))
    gap = "the gaps between islands and walls are narrower than the formation; another shape or orientation may fit"
    raise NoRoute(f"no way from ({start[0]:.2f}, {start[1]:.2f}) to ({goal[0]:.2f}, {goal[1]:.2f}) m: {gap}")


def _corners(discs: Array, half_m: tuple[float, float]) -> Array:
    """Corners (n, 2) of polygons around the discs, those that are free."""
    if len(discs) == 0:
        return np.zeros((0, 2))
    angle = 2.0 * np.pi / CORNERS * np.arange(CORNERS)
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=1) / math.cos(np.pi / CORNERS)
    corners = (discs[:, None, :2] + discs[:, None, 2:] * rim).reshape(-1, 2)
    apart = np.hypot(*(corners[:, None] - discs[:, :2]).transpose(2, 0, 1))
    free = np.all(apart >= discs[:, 2] * TOUCHING, axis=1) & np.all(np.abs(corners) <= half_m, axis=1)
    return np.asarray(corners[free])


def _visible(here: Array, there: Array, discs: Array) -> Array:
    """Which of the straight lines from `here` (2,) to `there` (n, 2) run through no disc, (n,) bool."""
    if len(discs) == 0:
        return np.ones(len(there), dtype=bool)
    way, out = there - here, discs[:, :2] - here
    along = np.clip(way @ out.T / np.maximum(np.sum(way**2, axis=1), 1e-18)[:, None], 0.0, 1.0)
    nearest = out - along[:, :, None] * way[:, None]
    return np.asarray(np.all(np.hypot(nearest[..., 0], nearest[..., 1]) >= discs[:, 2] * TOUCHING, axis=1))


def _must_be_free(place: Array, discs: Array, half_m: tuple[float, float]) -> None:
    x, y = place
    if abs(x) > half_m[0] or abs(y) > half_m[1]:
        raise NoRoute(
            f"({x:.2f}, {y:.2f}) m: there the formation would touch a wall (allowed: +-{half_m[0]:.2f}, +-{half_m[1]:.2f})"
        )
    if len(discs):
        short = discs[:, 2] - np.hypot(*(discs[:, :2] - place).T)
        if short.max() > 0.0:
            raise NoRoute(f"({x:.2f}, {y:.2f}) m: there the formation is {short.max():.2f} m too near an island")


def _but_free(discs: Array, spare_m: float, *ends: Array) -> Array:
    """Discs wider by `spare_m`, but no wider than leaves the ends free."""
    if len(discs) == 0:
        return discs
    room = np.min([np.hypot(*(discs[:, :2] - end).T) for end in ends], axis=0)
    return np.column_stack([discs[:, :2], np.minimum(discs[:, 2] + spare_m, np.maximum(discs[:, 2], room))])


def _smoothed(line: Array, smooth_m: float) -> Array:
    """Points about SPACING_M apart on a polygonal line (n, 2) whose corners are spread over some `smooth_m` (the standard
    deviation of a Gaussian), its ends kept."""
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    keep = np.concatenate([[True], np.diff(arc) > 1e-9])
    arc, line = arc[keep], line[keep]
    if len(arc) < 2:
        raise NoRoute(f"it leads nowhere: all its places are ({line[0, 0]:.2f}, {line[0, 1]:.2f}) m")
    places = np.linspace(0.0, arc[-1], max(2, math.ceil(arc[-1] / SPACING_M) + 1))
    points = np.column_stack([np.interp(places, arc, line[:, 0]), np.interp(places, arc, line[:, 1])])
    n = len(points) - 1
    mirrored = np.vstack([2.0 * points[0] - points[n:0:-1], points, 2.0 * points[n] - points[n - 1 :: -1]])
    spread = min(smooth_m / places[1], n / REACH)  # no wider than the mirrored ends are long, or the ends would move
    return np.asarray(gaussian_filter1d(mirrored, spread, axis=0, mode="nearest", truncate=REACH - 0.5)[n : 2 * n + 1])


def _clear(points: Array, discs: Array, half_m: tuple[float, float]) -> bool:
    """Whether there is a spline through these points, and it stays clear."""
    if np.any(np.hypot(*np.diff(points, axis=0).T) < 1e-9):  # there and back again: smoothed, the turn is two points in one
        return False
    knots, curve = curve_through(points)
    fine = curve(np.linspace(0.0, knots[-1], math.ceil(knots[-1] / CHECK_M) + 1))
    inside = bool(np.all(np.abs(fine) <= np.array(half_m) + 1e-9))
    if len(discs) == 0 or not inside:
        return inside
    return bool(np.all(np.hypot(*(fine[:, None] - discs[:, :2]).transpose(2, 0, 1)) >= discs[:, 2] * TOUCHING))

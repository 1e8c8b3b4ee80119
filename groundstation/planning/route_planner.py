"""Route planner: the shortest way around islands for a whole formation, as waypoints for a spline. Pure.

A formation that keeps its orientation hits a round island where one of its nodes does: seen from the formation's centre that
is a disc around (island - node), as wide as island, hull and clearance. One that turns with the path is a disc of its own. So
the formation becomes a point among discs. The shortest way is found by A* on the visibility graph of polygons around the
discs; edges are computed when the search reaches them. Walls shrink the rectangle that the point may be in.
"""

import heapq
import math
from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter1d

from groundstation.planning.feasibility import OutOfTime, check_time, never
from groundstation.planning.formation import SlotOffset
from groundstation.planning.paths import MOST_POINTS, curve_through
from shoal.config.experiment import Experiment
from shoal.config.scene import Route, Waypoints
from shoal.frames import Array

CORNERS = 24  # of the polygon around a disc: the route around it is 0.6 % longer than along the disc
SMOOTHER = (1.0, 0.7, 0.5, 0.3, 0.15, 0.05)  # shares of `smooth_m`, tried in turn
SPARE_M = (0.02, 0.1, 0.2, 0.4)  # extra distance from islands, tried in turn: smoothing cuts corners
SPACING_M = 0.25  # of waypoints along the route: straight lines then stay straight under the spline
CHECK_M = 0.02  # spacing of the points at which the spline is checked
REACH = 4.5  # standard deviations, and half a sample for rounding, after which a Gaussian is cut off
TOUCHING = 1.0 - 1e-9  # of a radius: rounding
WIDTHS = 6  # tried for a turning formation: from its width on a straight path to a disc that holds all of it


class NoRoute(ValueError):
    """No route exists, or an end of it is not free."""


def candidate_routes(
    experiment: Experiment, route: Route, nodes: Sequence[SlotOffset], out_of_time: OutOfTime = never
) -> Iterator[Waypoints]:
    """Routes to try, narrow ones first, each as waypoints of a spline; the caller takes the first that is clear.

    A formation that keeps its form and orientation has one route. One that turns or changes is taken for wider and wider
    discs, because nodes swing outside the path in bends. Raises NoRoute if there is no (further) route, and PlanError when
    `out_of_time`.
    """
    room_m = experiment.vehicle.radius_m + route.clearance_m
    places = np.concatenate([node.place_m[:, :2] for node in nodes])
    if experiment.formation.mode == "translate" and not experiment.formation.changes:
        yield _waypoints(experiment, route, room_m, np.array([node.place_m[0, :2] for node in nodes]), 0.0, out_of_time)
        return
    whole_m = float(np.hypot(*places.T).max())
    across_m = float(np.abs(places[:, 0]).max()) if experiment.formation.mode == "rotate" else whole_m
    has_route = False
    for wide_m in np.unique(np.linspace(across_m, whole_m, WIDTHS)).tolist():
        try:
            yield _waypoints(experiment, route, room_m, np.zeros((1, 2)), wide_m, out_of_time)
        except NoRoute as error:
            if has_route:
                raise NoRoute(
                    "in the bends of this way nodes would touch an island or a wall; wider gaps are needed"
                ) from None
            raise error
        has_route = True


def _waypoints(
    experiment: Experiment, route: Route, room_m: float, at_m: Array, wide_m: float, out_of_time: OutOfTime
) -> Waypoints:
    """Route for nodes `at_m` (n, 2) around the centre, each a disc wider than hull and clearance by `wide_m`."""
    islands = [(np.array(island.position_m), island.radius_m + room_m + wide_m) for island in experiment.islands]
    discs = np.array([(*(place - at), radius) for place, radius in islands for at in at_m]).reshape(-1, 3)
    length, width, _ = experiment.pool.size_m
    reach = np.abs(at_m).max(axis=0) + room_m + wide_m
    walls = experiment.pool.walls
    half_m = (length / 2.0 - float(reach[0]), width / 2.0 - float(reach[1])) if walls else (math.inf, math.inf)
    points = find_route(route.via_m, discs, half_m, route.smooth_m, out_of_time)
    return Waypoints(
        kind="waypoints",
        points_m=tuple((x, y) for x, y in points.tolist()),
        speed_mps=route.speed_mps,
        depth_m=route.depth_m,
        slow=route.slow,
        stop=route.stop,
    )


def find_route(
    via_m: Sequence[tuple[float, float]],
    discs: Array,
    half_m: tuple[float, float],
    smooth_m: float = 0.5,
    out_of_time: OutOfTime = never,
) -> Array:
    """Waypoints (n, 2) of a smooth route through `via_m`, clear of `discs` (k, 3: x, y, radius) and inside +-`half_m`, in m.

    Corners, also those at `via_m`, are spread over about `smooth_m`, less where there is no room. Raises NoRoute with the
    reason, and PlanError when `out_of_time`.
    """
    ends = np.array(via_m, dtype=np.float64)
    for place in ends:
        _must_be_free(place, discs, half_m)
    lines: dict[float, Array] = {}
    for share in SMOOTHER:
        for spare_m in SPARE_M:
            if spare_m not in lines:
                lines[spare_m] = _line(ends, discs, spare_m, half_m, out_of_time)
            check_time(out_of_time)
            points = _smoothed(lines[spare_m], share * smooth_m)
            if _clear(points, discs, half_m):
                return points
    raise NoRoute("there is a way, but it bends too sharply for a smooth path; move the waypoints or leave wider gaps")


def _line(ends: Array, discs: Array, spare_m: float, half_m: tuple[float, float], out_of_time: OutOfTime) -> Array:
    """Corners (n, 2) of the shortest route, `spare_m` further from the discs where there is room."""
    wide = [_but_free(discs, spare_m, a, b) for a, b in pairwise(ends)]
    try:
        segments = [shortest(a, b, d, half_m, out_of_time) for (a, b), d in zip(pairwise(ends), wide, strict=True)]
    except NoRoute:
        segments = [shortest(a, b, discs, half_m, out_of_time) for a, b in pairwise(ends)]
    return np.concatenate([segments[0], *[segment[1:] for segment in segments[1:]]])


def shortest(start: Array, goal: Array, discs: Array, half_m: tuple[float, float], out_of_time: OutOfTime = never) -> Array:
    """Corners (n, 2) of the shortest route from `start` to `goal` along polygons around `discs`. Raises NoRoute, and PlanError
    when `out_of_time`."""
    corners = _corners(discs, half_m)
    points = np.vstack([start, goal, corners])
    ahead = np.hypot(*(points - goal).T)
    cost, before = np.full(len(points), np.inf), np.full(len(points), -1)
    cost[0], is_done = 0.0, np.zeros(len(points), dtype=bool)
    queue = [(float(ahead[0]), 0)]
    while queue:
        _, here = heapq.heappop(queue)
        if is_done[here]:
            continue
        is_done[here] = True
        check_time(out_of_time)
        if here == 1:
            order = [1]
            while order[-1]:
                order.append(int(before[order[-1]]))
            return np.asarray(points[order[::-1]])
        through = cost[here] + np.hypot(*(points - points[here]).T)
        worth = np.flatnonzero(~is_done & (through < cost))
        visible_corners = worth[_visible(points[here], points[worth], discs)]
        cost[visible_corners], before[visible_corners] = through[visible_corners], here
        for there in visible_corners.tolist():
            heapq.heappush(queue, (float(cost[there] + ahead[there]), there))
    gap = "the gaps between islands and walls are narrower than the formation; another shape or orientation may fit"
    raise NoRoute(f"no way from ({start[0]:.2f}, {start[1]:.2f}) to ({goal[0]:.2f}, {goal[1]:.2f}) m: {gap}")


def _corners(discs: Array, half_m: tuple[float, float]) -> Array:
    """Free corners (n, 2) of polygons around the discs."""
    if len(discs) == 0:
        return np.zeros((0, 2))
    angle = 2.0 * np.pi / CORNERS * np.arange(CORNERS)
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=1) / math.cos(np.pi / CORNERS)
    corners = (discs[:, None, :2] + discs[:, None, 2:] * rim).reshape(-1, 2)
    apart = np.hypot(*(corners[:, None] - discs[:, :2]).transpose(2, 0, 1))
    free = np.all(apart >= discs[:, 2] * TOUCHING, axis=1) & np.all(np.abs(corners) <= half_m, axis=1)
    return np.asarray(corners[free])


def _visible(here: Array, there: Array, discs: Array) -> Array:
    """Mask (n,) of the straight lines from `here` (2,) to `there` (n, 2) that cross no disc."""
    if len(discs) == 0:
        return np.ones(len(there), dtype=bool)
    lines, out = there - here, discs[:, :2] - here
    along = np.clip(lines @ out.T / np.maximum(np.sum(lines**2, axis=1), 1e-18)[:, None], 0.0, 1.0)
    nearest = out - along[:, :, None] * lines[:, None]
    return np.asarray(np.all(np.hypot(nearest[..., 0], nearest[..., 1]) >= discs[:, 2] * TOUCHING, axis=1))


def _must_be_free(place: Array, discs: Array, half_m: tuple[float, float]) -> None:
    """Raise NoRoute if a place (2,) is beyond the walls or inside a disc."""
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
    """Discs wider by `spare_m`, or by less where the ends would not stay free."""
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
    if arc[-1] > SPACING_M * MOST_POINTS:
        raise NoRoute(f"it is {arc[-1]:.0f} m long (allowed: {SPACING_M * MOST_POINTS:.0f} m)")
    places = np.linspace(0.0, arc[-1], max(2, math.ceil(arc[-1] / SPACING_M) + 1))
    points = np.column_stack([np.interp(places, arc, line[:, 0]), np.interp(places, arc, line[:, 1])])
    n = len(points) - 1
    mirrored = np.vstack([2.0 * points[0] - points[n:0:-1], points, 2.0 * points[n] - points[n - 1 :: -1]])
    spread = min(smooth_m / places[1], n / REACH)  # no wider than the mirrored ends are long, or the ends would move
    return np.asarray(gaussian_filter1d(mirrored, spread, axis=0, mode="nearest", truncate=REACH - 0.5)[n : 2 * n + 1])


def _clear(points: Array, discs: Array, half_m: tuple[float, float]) -> bool:
    """True if a spline through these points exists and stays clear."""
    if np.any(np.hypot(*np.diff(points, axis=0).T) < 1e-9):  # there and back again: smoothed, the turn is two points in one
        return False
    knots, curve = curve_through(points)
    fine = curve(np.linspace(0.0, knots[-1], math.ceil(knots[-1] / CHECK_M) + 1))
    inside = bool(np.all(np.abs(fine) <= np.array(half_m) + 1e-9))
    if len(discs) == 0 or not inside:
        return inside
    return bool(np.all(np.hypot(*(fine[:, None] - discs[:, :2]).transpose(2, 0, 1)) >= discs[:, 2] * TOUCHING))

"""Half-spaces across the plan that keep it clear of robots, obstacles and walls.

    normal . (x, y) >= offset - give slack        at a node

The normal is the line from a body's place to the plan's, both at that node's instant. Each body has a distance to keep.
A robot that is nearer already only has to get away: its row asks for the distance there is now, plus ESCAPE_MPS times time.
(One slack for all rows would let such a robot stay inside: the slack is paid once.)
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from robot_agent.control.nonlinear.prediction import NODES, Grid, X, Y
from robot_agent.guidance.obstacles import Obstacle
from shoal.frames import Array
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Cube, Floats, Ints, Table

ESCAPE_MPS = 0.1  # of a robot that is too near: a fifth of the shipped vehicle's speed
NEAR_M = 0.4  # farther from its border, a half-space is left out: a plan changes by less in one iteration
WALL_GIVES = 0.1  # of what a body's rows give: 2R hold room enough that hulls do not touch, a wall holds none
TOUCHING_M = 1e-6  # nearer, the direction away means nothing: any is taken
MOST_ROWS = 8 * NODES  # of eight bodies all the way; beyond, the ones given last are left out


class MovingBodies(NamedTuple):
    """Robots at the nodes' instants."""

    place: Cube  # (bodies, nodes, 2) m
    keep_m: Table  # (bodies, nodes) from their places; 0: free
    apart_m: Floats  # (bodies,) distance now


class Outlines(NamedTuple):
    """Obstacles and islands: points along an edge, or one, that move at a steady velocity."""

    point: Table  # (points, 2) places now, m
    first: Ints  # (outlines + 1,) rows of `point`
    velocity: Table  # (outlines, 2) m/s
    keep_m: Floats  # (outlines,)
    apart_m: Floats  # (outlines,) distance now


class Surrounds(NamedTuple):
    """All that a plan has to keep clear of."""

    bodies: MovingBodies
    outlines: Outlines
    room_m: Floats  # (2,) half the length and half the width that a robot's centre may use; infinite without walls


class HalfPlanes(NamedTuple):
    """Rows, the first `used[0]` of them in use."""

    node: Ints
    normal: Table  # (rows, 2)
    offset_m: Floats
    give: Floats
    used: Ints  # (1,)


def make_half_planes() -> HalfPlanes:
    """Memory for the most rows there can be."""
    return HalfPlanes(
        np.zeros(MOST_ROWS, np.int64),
        np.zeros((MOST_ROWS, 2)),
        np.zeros(MOST_ROWS),
        np.zeros(MOST_ROWS),
        np.zeros(1, np.int64),
    )


@kernel(part=True)
def add_row(rows: HalfPlanes, node: int, x: float, y: float, offset_m: float, give: float) -> None:
    """Write one more row, while there is room."""
    i = rows.used[0]
    if i < len(rows.node):
        rows.node[i], rows.normal[i, 0], rows.normal[i, 1], rows.offset_m[i], rows.give[i] = node, x, y, offset_m, give
        rows.used[0] = i + 1


@kernel(part=True)
def keep_off(rows: HalfPlanes, node: int, here: Floats, x: float, y: float, keep_m: float) -> None:
    """The row that keeps a plan's place `here` (2,) away from the point x, y, if it is near."""
    dx, dy = here[X] - x, here[Y] - y
    apart_m = math.sqrt(dx * dx + dy * dy)
    if apart_m < keep_m + NEAR_M:
        dx, dy = (dx / apart_m, dy / apart_m) if apart_m > TOUCHING_M else (1.0, 0.0)
        add_row(rows, node, dx, dy, dx * x + dy * y + keep_m, 1.0)


@kernel(part=True)
def nearest_point(outlines: Outlines, i: int, x: float, y: float) -> tuple[int, bool]:
    """Row of the point of outline `i` that is nearest to x, y (both at one instant), and True if the outline surrounds it."""
    least, nearest, angle = math.inf, outlines.first[i], 0.0
    last = outlines.first[i + 1] - 1
    px, py = outlines.point[last, 0] - x, outlines.point[last, 1] - y
    for j in range(outlines.first[i], last + 1):
        qx, qy = outlines.point[j, 0] - x, outlines.point[j, 1] - y
        if qx * qx + qy * qy < least:
            least, nearest = qx * qx + qy * qy, j
        angle += math.atan2(px * qy - py * qx, px * qx + py * qy)
        px, py = qx, qy
    return nearest, abs(angle) > math.pi


@kernel(part=True)
def keep_off_outline(rows: HalfPlanes, node: int, here: Floats, at_s: float, outlines: Outlines, i: int) -> None:
    """The row that keeps `here` away from an outline; from within, towards its nearest point."""
    moved_x, moved_y = at_s * outlines.velocity[i, 0], at_s * outlines.velocity[i, 1]
    nearest, inside = nearest_point(outlines, i, here[X] - moved_x, here[Y] - moved_y)
    x, y = outlines.point[nearest, 0] + moved_x, outlines.point[nearest, 1] + moved_y
    keep_m = min(outlines.keep_m[i], outlines.apart_m[i] + ESCAPE_MPS * at_s)
    if not inside:
        keep_off(rows, node, here, x, y, keep_m)
        return
    dx, dy = x - here[X], y - here[Y]
    apart_m = max(math.sqrt(dx * dx + dy * dy), TOUCHING_M)
    add_row(rows, node, dx / apart_m, dy / apart_m, (dx * x + dy * y) / apart_m + keep_m, 1.0)


@kernel(part=True)
def find_rows(surrounds: Surrounds, grid: Grid, state: Table, rows: HalfPlanes) -> None:
    """All rows near a plan's states (nodes, 9)."""
    bodies, outlines, rows.used[0] = surrounds.bodies, surrounds.outlines, 0
    for k in range(len(state)):
        at_s, here = grid.time_s[k + 1], state[k]
        for i in range(2):
            for sign in (1.0, -1.0):
                if sign * here[i] > surrounds.room_m[i] - NEAR_M:
                    add_row(rows, k, -sign * (1 - i), -sign * i, -surrounds.room_m[i], WALL_GIVES)
        for i in range(len(bodies.keep_m)):
            if bodies.keep_m[i, k] > 0.0:
                keep_m = min(bodies.keep_m[i, k], bodies.apart_m[i] + ESCAPE_MPS * at_s)
                keep_off(rows, k, here, bodies.place[i, k, 0], bodies.place[i, k, 1], keep_m)
        for i in range(len(outlines.keep_m)):
            keep_off_outline(rows, k, here, at_s, outlines, i)


def bodies_of(places: Array, keep_m: Array, until: Array, depth_m: Array, place: complex) -> MovingBodies:
    """Robots to keep clear of at their `places` (robots, nodes, 4), each at its distance `keep_m` (robots,) for its first
    `until` (robots,) nodes. One that is as far below or above our planned `depth_m` (nodes,) is out of the way."""
    in_way = (np.abs(places[:, :, 2] - depth_m) < keep_m[:, None]) & (np.arange(NODES) < until[:, None])
    first = places[:, 0]
    apart_m = np.hypot(first[:, 0] - place.real, first[:, 1] - place.imag)
    return MovingBodies(np.ascontiguousarray(places[:, :, :2]), np.where(in_way, keep_m[:, None], 0.0), apart_m)


NO_BODIES = MovingBodies(np.zeros((0, NODES, 2)), np.zeros((0, NODES)), np.zeros(0))


def outlines_of(obstacles: Sequence[Obstacle], at_ns: int, place: complex) -> Outlines:
    """Obstacles and islands as they are at the instant of action, for a robot at `place`."""
    points = [obstacle.edge_points + obstacle.displacement(at_ns) for obstacle in obstacles]
    first = np.cumsum([0, *(len(edge) for edge in points)])
    together = np.concatenate(points) if points else np.zeros(0, np.complex128)
    velocity = np.array([(obstacle.velocity.real, obstacle.velocity.imag) for obstacle in obstacles]).reshape(-1, 2)
    apart_m = np.array([float(np.abs(edge - place).min()) for edge in points])
    return Outlines(
        np.ascontiguousarray(np.column_stack([together.real, together.imag])), first.astype(np.int64), velocity,
        np.array([obstacle.clearance_m for obstacle in obstacles]), apart_m,
    )  # fmt: skip

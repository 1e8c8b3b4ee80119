"""Obstacles for the controller: islands of the experiment, and obstacles that the camera sees.

An outline becomes points along its edge, an island is one point. So every obstacle is avoided as points at a distance, like
robots. Depth does not count: the camera cannot measure it, and islands reach from the floor to the surface.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shoal.config.controller import Safety
from shoal.config.scene import Island
from shoal.frames import Array
from shoal.messages.messages import Obstacles
from shoal.messages.obstacle_memory import ages_s, drift_m, growth_m, is_old, swept

SPACING_M = 0.15  # of pieces along an edge: 0.3 m away, the way between two of them is 1 cm too near
ABSURD_M = 1e3  # what lies farther away is no obstacle
FASTEST_MPS = 2.0  # nothing in a pool is faster for long: an arm may be, and an outline that grows looks as if it were
MOST_PIECES = 200  # of one obstacle: an outline of 30 m


@dataclass(frozen=True, eq=False)
class Obstacle:
    """One obstacle. Complex numbers are x + iy in the pool frame."""

    id: int  # the localizer's number of it, or its place among the islands
    edge_points: NDArray[np.complex128]  # (k,) places at `instant_ns`, m
    clearance_m: float  # distance of a robot's centre from each point, m
    velocity: complex  # m/s
    instant_ns: int  # on our clock
    centre: complex  # of the pieces,
    reach_m: float  # and how far from there they go

    def displacement(self, now_ns: int) -> complex:
        """Predicted motion since it was seen, m."""
        return self.velocity * ((now_ns - self.instant_ns) * 1e-9)

    def age_s(self, now_ns: int) -> float:
        """Time since it was seen."""
        return (now_ns - self.instant_ns) * 1e-9

    def overlaps(self, place: complex, radius_m: float, now_ns: int) -> bool:
        """True if a hull of that radius at `place` touches or is inside the obstacle."""
        apart = place - self.displacement(now_ns) - self.edge_points[None]
        return float(np.abs(apart).min()) < radius_m or bool(is_inside(apart)[0])


class OwnHullFilter:
    """Filter that removes the robot's own hull from the obstacles.

    Two bodies cannot be in one place: an obstacle that the camera finds at the hull's place is the hull. One that was seen
    clear of the hull before is another body, and stays one when it drifts against the hull.
    """

    def __init__(self, hull_m: float) -> None:
        self._hull_m = hull_m
        self._others: frozenset[int] = frozenset()  # ids of obstacles that have been clear of the hull

    def exclude(self, obstacles: Sequence[Obstacle], place: complex, now_ns: int) -> tuple[Obstacle, ...]:
        """Return the obstacles without the robot's own hull at `place`, x + iy in the pool frame, and remember their ids: an
        obstacle returned once is another body from then on."""
        others = tuple(o for o in obstacles if o.id in self._others or not self._is_hull(o, place, now_ns))
        self._others = frozenset(obstacle.id for obstacle in others)
        return others

    def _is_hull(self, obstacle: Obstacle, place: complex, now_ns: int) -> bool:
        """True if an obstacle overlaps the hull at `place`. One not seen lately is compared where it was seen, without its
        predicted motion."""
        at_ns = obstacle.instant_ns if is_old(obstacle.age_s(now_ns)) else now_ns
        return obstacle.overlaps(place, self._hull_m, at_ns)


def island_obstacles(islands: Iterable[Island], hull_m: float) -> tuple[Obstacle, ...]:
    """Islands of the experiment as obstacles. All processes know them and routes are planned around them: like walls, they
    only stop a hull."""
    obstacles = []
    for i, island in enumerate(islands):
        middle = complex(*island.position_m)
        obstacles.append(Obstacle(i, np.array([middle]), island.radius_m + hull_m, 0j, 0, middle, 0.0))
    return tuple(obstacles)


def obstacles_from_message(message: Obstacles, instant_ns: int, keep_m: float) -> tuple[Obstacle, ...]:
    """Obstacles of a localizer's message of an instant on our clock, each at the time when it was seen. One at an impossible
    place is left out; one with an impossible speed gets FASTEST_MPS."""
    obstacles = []
    seen_s = ages_s(message, 0.0)
    for number, outline, velocity, unseen_s in zip(message.ids, message.outline, message.velocity, seen_s, strict=False):
        if not np.abs(outline).max() < ABSURD_M:  # false for NaN too
            continue
        corners, velocity_mps = outline[:, 0] + 1j * outline[:, 1], _limited(complex(velocity[0], velocity[1]))
        pieces = _edge_points(corners)
        middle = complex(pieces.mean())
        seen_ns = instant_ns - round(unseen_s * 1e9)
        reach_m = float(np.abs(pieces - middle).max())
        obstacles.append(Obstacle(number, pieces, keep_m, velocity_mps, seen_ns, middle, reach_m))
    return tuple(obstacles)


def _limited(velocity: complex) -> complex:
    """Velocity in m/s, limited to FASTEST_MPS; zero if it is not finite."""
    if not math.isfinite(abs(velocity)):
        return 0j
    return velocity * min(1.0, FASTEST_MPS / max(abs(velocity), FASTEST_MPS))


def grown_with_age(obstacle: Obstacle, safety: Safety, now_ns: int) -> Obstacle:
    """The area in which an obstacle that was last seen a while ago may be by now, as an obstacle that rests."""
    age_s = obstacle.age_s(now_ns)
    drift = drift_m(safety, np.array([obstacle.velocity.real, obstacle.velocity.imag]), age_s)
    corners = swept(np.column_stack([obstacle.edge_points.real, obstacle.edge_points.imag]), drift)
    pieces = _edge_points(corners[:, 0] + 1j * corners[:, 1])
    middle = complex(pieces.mean())
    keep_m = obstacle.clearance_m + growth_m(safety, age_s)
    return Obstacle(obstacle.id, pieces, keep_m, 0j, now_ns, middle, float(np.abs(pieces - middle).max()))


def is_inside(apart: NDArray[np.complex128]) -> NDArray[np.bool_]:
    """True for a place that the edge points enclose; `apart` (places, points) is the place minus each point."""
    return np.asarray(np.abs(np.angle(np.roll(apart, -1, axis=1) * apart.conj()).sum(axis=1)) > math.pi)


def _edge_points(corners: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Corners of an outline, and points on its edges no more than SPACING_M apart, in order around."""
    edges: list[Array] = []
    for begin, end in zip(corners, np.roll(corners, -1), strict=True):
        count = max(1, min(math.ceil(abs(end - begin) / SPACING_M), MOST_PIECES // len(corners)))
        edges.append(begin + (end - begin) * np.arange(count) / count)
    return np.concatenate(edges)

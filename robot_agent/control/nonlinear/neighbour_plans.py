"""Neighbours' plans at the nodes: bodies to keep clear of, and the formation's pull on the reference."""

import math
from collections.abc import Sequence

import numpy as np

from robot_agent.control.nonlinear.obstacle_rows import MovingBodies, Outlines
from robot_agent.control.nonlinear.prediction import NODES
from robot_agent.guidance.formation import Neighbour
from robot_agent.guidance.obstacles import Obstacle
from shoal.frames import Array
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Floats, Table

NS = 1e9


@kernel
def sample_plan(
    plan: Table, meant: Table, period_s: float, at_s: Floats, most_m: float, place: Table, deviation: Table
) -> None:
    """Write the places x, y, z of a plan (rows, 4) at instants after its first row into `place` (instants, 3), and how far
    they are from where they are `meant` to be, `most_m` at most. Beyond its ends a plan stands."""
    last = len(plan) - 1
    for k in range(len(at_s)):
        row = min(max(at_s[k] / period_s, 0.0), float(last))
        low = min(int(row), max(last - 1, 0))
        high, share = min(low + 1, last), row - low
        for c in range(3):
            place[k, c] = plan[low, c] + share * (plan[high, c] - plan[low, c])
            deviation[k, c] = place[k, c] - meant[low, c] - share * (meant[high, c] - meant[low, c])
        off_m = math.sqrt(deviation[k, 0] ** 2 + deviation[k, 1] ** 2 + deviation[k, 2] ** 2)
        if off_m > most_m:
            for c in range(3):
                deviation[k, c] *= most_m / off_m


class PlanSampler:
    """Sampler of neighbours' plans at our own nodes."""

    def __init__(self, nodes_s: Array, weight: tuple[float, float, float, float], has_leader: bool, most_m: float) -> None:
        """`nodes_s` (NODES,) are the nodes' instants from now. A neighbour pulls as if it were `most_m` off its path at most:
        what a plan says beyond that is no motion of a formation."""
        self._nodes_s, self._has_leader, self._most_m = nodes_s, has_leader, most_m
        self.set_weight(weight)

    def set_weight(self, weight: tuple[float, float, float, float]) -> None:
        """Use another weight of the formation's errors, against 1 of the robot's own."""
        self._weight = np.array(weight[:3])

    def sample(self, neighbours: Sequence[Neighbour], now_ns: int) -> tuple[Array, Array | None]:
        """Places x, y, z (neighbours, nodes, 3), and the formation's pull on the reference (nodes, 3); None without one:

        pull = sum Q_j deviation_j / (1 + sum Q_j), (35); a robot with a leader follows its deviation whole."""
        places, deviation = np.empty((len(neighbours), NODES, 3)), np.empty((NODES, 3))
        total, members = np.zeros((NODES, 3)), 0
        for i, other in enumerate(neighbours):
            at_s = self._nodes_s + (now_ns - other.stamp_ns) / NS
            poses, references = np.array(other.plan.eta), np.array(other.plan.eta_reference)
            sample_plan(poses, references, other.plan.period_s, at_s, self._most_m, places[i], deviation)
            if other.fresh and other.formation:
                total += deviation
                members += 1
        if not members:
            return places, None
        return places, total if self._has_leader else total * (self._weight / (1.0 + members * self._weight))


def bodies_of(places: Array, keep_m: Array, until: Array, depth_m: Array, place: complex) -> MovingBodies:
    """Robots to keep clear of at their `places` (robots, nodes, 3), each at its distance `keep_m` (robots,) for its first
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

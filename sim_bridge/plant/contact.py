"""Contact of hulls, which are spheres, with walls, floor, islands and other hulls. Contact has no friction."""

import math
from typing import NamedTuple

import numpy as np

from shoal.config.experiment import Experiment
from shoal.frames import Array
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Table
from sim_bridge.plant.robot_state import place_of, pool_velocity
from sim_bridge.plant.vectors import NO_VECTOR, Vector, add, dot, scale, subtract

# Contact is a spring on which one robot's mass swings at this rate: 0.5 m/s penetrates 8 mm, which steps of 5 ms resolve.
CONTACT_RADPS = 30.0
# Hunt and Crossley (1975): damping that grows with the penetration, so that the force starts from zero and never pulls. At
# this value 0.6 of the speed is left after a bump at 0.1 m/s, 0.2 at 0.5 m/s.
CONTACT_DAMPING_S_PER_M = 10.0
COINCIDENT_M = 1e-9  # m, least distance of two centres, against division by zero


class BasinContact(NamedTuple):
    inside_m: Vector  # limits of centres, on both sides in x and y; in z a floor only, the surface is the hull's (restoring)
    islands_m: Table  # x, y and radius of each
    radius_m: float  # of the hulls
    stiffness_npm: float


@kernel(inline=True, part=True)
def normal_force(stiffness_npm: float, penetration_m: float, closing_mps: float) -> float:
    """Force of a contact: k d (1 + c d'), never negative, for a penetration d that grows by d'."""
    return stiffness_npm * max(penetration_m, 0.0) * max(1.0 + CONTACT_DAMPING_S_PER_M * closing_mps, 0.0)


@kernel(inline=True, part=True)
def wall_force(basin: BasinContact, inside_m: float, at_m: float, speed_mps: float) -> float:
    """Force along an axis of a hull between two walls."""
    side = -1.0 if at_m < 0.0 else 1.0
    return -side * normal_force(basin.stiffness_npm, side * at_m - inside_m, side * speed_mps)


@kernel(inline=True, part=True)
def repulsion(basin: BasinContact, offset_m: Vector, reach_m: float, velocity_mps: Vector) -> Vector:
    """Force on a hull at an offset from something round that touches it within a reach; both relative to it."""
    distance = max(math.sqrt(dot(offset_m, offset_m)), COINCIDENT_M)
    away = scale(1.0 / distance, offset_m)
    return scale(normal_force(basin.stiffness_npm, reach_m - distance, -dot(velocity_mps, away)), away)


@kernel(part=True)
def basin_force(basin: BasinContact, place_m: Vector, velocity_mps: Vector) -> Vector:
    """Force of walls, floor and islands on a hull, in the pool frame."""
    force = Vector(
        wall_force(basin, basin.inside_m.x, place_m.x, velocity_mps.x),
        wall_force(basin, basin.inside_m.y, place_m.y, velocity_mps.y),
        -normal_force(basin.stiffness_npm, place_m.z - basin.inside_m.z, velocity_mps.z),
    )
    for k in range(len(basin.islands_m)):
        offset = Vector(place_m.x - basin.islands_m[k, 0], place_m.y - basin.islands_m[k, 1], 0.0)
        reach_m = basin.islands_m[k, 2] + basin.radius_m
        force = add(force, repulsion(basin, offset, reach_m, velocity_mps))
    return force


@kernel(part=True)
def hulls_force(basin: BasinContact, states: Table, i: int) -> Vector:
    """Force of all other hulls on hull i, in the pool frame."""
    force, place, reach_m = NO_VECTOR, place_of(states, i), 2.0 * basin.radius_m
    for j in range(len(states)):
        offset = subtract(place, place_of(states, j))
        if j != i and dot(offset, offset) < reach_m * reach_m:
            relative = subtract(pool_velocity(states, i), pool_velocity(states, j))
            force = add(force, repulsion(basin, offset, reach_m, relative))
    return force


class ContactModel:
    """Walls, floor, islands and other robots."""

    def __init__(self, experiment: Experiment) -> None:
        length, width, depth = experiment.pool.size_m
        reach = np.array([length / 2, width / 2, depth]) if experiment.pool.walls else np.full(3, np.inf)
        radius_m = self._radius_m = experiment.vehicle.radius_m
        self._inside_m = reach - radius_m
        self._islands_m = np.array([[*island.position_m, island.radius_m] for island in experiment.islands]).reshape(-1, 3)
        stiffness_npm = float(experiment.vehicle.mass.surge_kg) * CONTACT_RADPS**2
        self.constants = BasinContact(Vector(*self._inside_m.tolist()), self._islands_m, radius_m, stiffness_npm)

    def touching(self, position_m: Array) -> list[int]:
        """Indices of the hulls at (n, 3) that touch a wall, the floor, an island or another hull."""
        x, y, z = position_m.T
        outside = (self._inside_m < np.array([np.abs(x), np.abs(y), z]).T).any(axis=1)
        to_island = np.linalg.norm(position_m[:, None, :2] - self._islands_m[:, :2], axis=2)
        on_island = (to_island < self._islands_m[:, 2] + self._radius_m).any(axis=1)
        apart = np.linalg.norm(position_m[:, None] - position_m, axis=2)
        np.fill_diagonal(apart, np.inf)
        collided = (apart < 2.0 * self._radius_m).any(axis=1)
        return np.flatnonzero(outside | on_island | collided).tolist()

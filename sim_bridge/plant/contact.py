"""What a hull, a sphere, can bump into: walls, floor, islands, other hulls. Contact has no friction.

Places, velocities and forces are arrays (n, 3) in the pool frame.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from wire.config.experiment import Experiment
from wire.frames import Array

Indices = NDArray[np.intp]

# Contact is a spring that one robot's mass swings on at this rate: 0.5 m/s dents 8 mm, which steps of 5 ms resolve.
CONTACT_RADPS = 30.0
# Hunt and Crossley (1975): damping that grows with the dent, so that the force starts from zero and never pulls. At this
# value 0.6 of the speed is left after a bump at 0.1 m/s, 0.2 at 0.5 m/s.
CONTACT_DAMPING_S_PER_M = 10.0
NEAR_M = 0.1  # contact is looked at from this far; no robot gets further in one step
MANY = 40  # robots from which on a tree finds pairs faster than a table of all


class Basin:
    """Walls, floor, islands and other robots."""

    def __init__(self, experiment: Experiment) -> None:
        length, width, depth = experiment.pool.size_m
        self._radius_m = experiment.vehicle.radius_m
        has_walls = experiment.pool.walls
        reach = np.array([length / 2, width / 2, depth]) if has_walls else np.full(3, np.inf)
        self._inside_m = reach - self._radius_m  # for centres; z has a floor only, the surface is water's business
        self._clear_to_m = self._inside_m - NEAR_M
        self._clear_from_m = np.array([*-self._clear_to_m[:2], -np.inf])
        self._islands_m = np.array([[*island.position_m, island.radius_m] for island in experiment.islands]).reshape(-1, 3)
        self._stiffness_npm = float(experiment.vehicle.mass.surge_kg) * CONTACT_RADPS**2

    def is_near(self, position_m: Array) -> bool:
        """Whether any hull at (n, 3) is about to touch something."""
        if ((position_m > self._clear_to_m) | (position_m < self._clear_from_m)).any():
            return True
        if len(self._islands_m) and (self._island_dents(position_m)[0] > -NEAR_M).any():
            return True
        within_m = 2.0 * self._radius_m + NEAR_M
        if len(position_m) >= MANY:
            return len(self._pairs(position_m, within_m)[0]) > 0
        near = np.count_nonzero(_squared_distances(position_m) < within_m**2)
        return bool(near > len(position_m))  # each is near itself

    def touches(self, position_m: Array) -> list[int]:
        """Indices of the hulls that touch a wall, the floor, an island or another hull."""
        solid = (self._wall_dents(position_m)[0] > 0).any(axis=1) | (self._island_dents(position_m)[0] > 0).any(axis=1)
        first, second = self._pairs(position_m, 2.0 * self._radius_m)
        return sorted({*np.flatnonzero(solid).tolist(), *first.tolist(), *second.tolist()})

    def push(self, position_m: Array, velocity_mps: Array) -> Array:
        """Contact forces on hulls at (n, 3) that move at (n, 3)."""
        dent, outward = self._wall_dents(position_m)
        force = -outward * self._normal_force(dent, outward * velocity_mps)
        if len(self._islands_m):
            dent, away = self._island_dents(position_m)
            closing = -np.sum(velocity_mps[:, None, :2] * away, axis=2)
            force[:, :2] += np.sum(self._normal_force(dent, closing)[..., None] * away, axis=1)
        first, second = self._pairs(position_m, 2.0 * self._radius_m)
        if len(first):
            apart = position_m[first] - position_m[second]
            distance = np.maximum(np.sqrt(np.sum(apart**2, axis=1)), 1e-9)[:, None]
            away = apart / distance
            closing = -np.sum((velocity_mps[first] - velocity_mps[second]) * away, axis=1)
            normal = self._normal_force(2.0 * self._radius_m - distance[:, 0], closing)[:, None] * away
            np.add.at(force, first, normal)
            np.add.at(force, second, -normal)
        return np.asarray(force)

    def _wall_dents(self, position_m: Array) -> tuple[Array, Array]:
        """How deep each hull is in a wall per axis (n, 3), negative when clear, and which way that wall faces (+-1)."""
        outward = np.where(position_m < 0.0, -1.0, 1.0)
        outward[:, 2] = 1.0
        return outward * position_m - self._inside_m, outward

    def _island_dents(self, position_m: Array) -> tuple[Array, Array]:
        """How deep hulls are in islands (n, islands), negative when clear, and unit vectors (n, islands, 2) out of them."""
        apart = position_m[:, None, :2] - self._islands_m[:, :2]
        distance = np.sqrt(np.sum(apart**2, axis=2))
        return self._islands_m[:, 2] + self._radius_m - distance, apart / np.maximum(distance, 1e-9)[..., None]

    def _pairs(self, position_m: Array, within_m: float) -> tuple[Indices, Indices]:
        """Indices (pairs,) of the hulls whose centres are nearer than this, the lower first, in order."""
        if len(position_m) >= MANY:
            pairs = cKDTree(position_m).query_pairs(within_m, output_type="ndarray")
            pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
            return pairs[:, 0], pairs[:, 1]
        first, second = np.nonzero(_squared_distances(position_m) < within_m**2)
        upper = first < second
        return first[upper], second[upper]

    def _normal_force(self, dent_m: Array, dent_rate_mps: Array) -> Array:
        damping = np.maximum(1.0 + CONTACT_DAMPING_S_PER_M * dent_rate_mps, 0.0)
        return self._stiffness_npm * np.maximum(dent_m, 0.0) * damping


def _squared_distances(position_m: Array) -> Array:
    """Between all hulls at (n, 3): (n, n)."""
    apart = position_m[:, None] - position_m
    return np.asarray(np.add.reduce(apart * apart, axis=2))

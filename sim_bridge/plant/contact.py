"""Contact of hulls, which are spheres, with walls, floor, islands and other hulls. Contact has no friction.

Places, velocities and forces are arrays (n, 3) in the pool frame.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from wire.config.experiment import Experiment
from wire.frames import Array

Indices = NDArray[np.intp]

# Contact is a spring on which one robot's mass swings at this rate: 0.5 m/s penetrates 8 mm, which steps of 5 ms resolve.
CONTACT_RADPS = 30.0
# Hunt and Crossley (1975): damping that grows with the penetration, so that the force starts from zero and never pulls. At
# this value 0.6 of the speed is left after a bump at 0.1 m/s, 0.2 at 0.5 m/s.
CONTACT_DAMPING_S_PER_M = 10.0
NEAR_M = 0.1  # m, distance from which contact is computed; no robot moves farther in one step
MANY = 40  # robots; from this number a tree finds pairs faster than a table of all


class ContactModel:
    """Walls, floor, islands and other robots."""

    def __init__(self, experiment: Experiment) -> None:
        length, width, depth = experiment.pool.size_m
        self._radius_m = experiment.vehicle.radius_m
        has_walls = experiment.pool.walls
        reach = np.array([length / 2, width / 2, depth]) if has_walls else np.full(3, np.inf)
        self._inside_m = reach - self._radius_m  # limits of centres; in z a floor only, hydrodynamics.py has the surface
        self._clear_to_m = self._inside_m - NEAR_M
        self._clear_from_m = np.array([*-self._clear_to_m[:2], -np.inf])
        self._islands_m = np.array([[*island.position_m, island.radius_m] for island in experiment.islands]).reshape(-1, 3)
        self._stiffness_npm = float(experiment.vehicle.mass.surge_kg) * CONTACT_RADPS**2

    def is_near(self, position_m: Array) -> bool:
        """True if any hull at (n, 3) is about to touch something."""
        if ((position_m > self._clear_to_m) | (position_m < self._clear_from_m)).any():
            return True
        if len(self._islands_m) and (self._island_penetrations(position_m)[0] > -NEAR_M).any():
            return True
        within_m = 2.0 * self._radius_m + NEAR_M
        if len(position_m) >= MANY:
            return len(self._pairs(position_m, within_m)[0]) > 0
        near = np.count_nonzero(_squared_distances(position_m) < within_m**2)
        return bool(near > len(position_m))  # each is near itself

    def touching(self, position_m: Array) -> list[int]:
        """Indices of the hulls that touch a wall, the floor, an island or another hull."""
        solid = (self._wall_penetrations(position_m)[0] > 0).any(axis=1) | (self._island_penetrations(position_m)[0] > 0).any(
            axis=1
        )
        first, second = self._pairs(position_m, 2.0 * self._radius_m)
        return sorted({*np.flatnonzero(solid).tolist(), *first.tolist(), *second.tolist()})

    def contact_force(self, position_m: Array, velocity_mps: Array) -> Array:
        """Contact forces (n, 3) on hulls at (n, 3) that move at (n, 3)."""
        penetration, outward = self._wall_penetrations(position_m)
        force = -outward * self._normal_force(penetration, outward * velocity_mps)
        if len(self._islands_m):
            penetration, away = self._island_penetrations(position_m)
            closing = -np.sum(velocity_mps[:, None, :2] * away, axis=2)
            force[:, :2] += np.sum(self._normal_force(penetration, closing)[..., None] * away, axis=1)
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

    def _wall_penetrations(self, position_m: Array) -> tuple[Array, Array]:
        """Penetration of each hull into a wall per axis (n, 3), negative when clear, and the side of that wall (+-1)."""
        outward = np.where(position_m < 0.0, -1.0, 1.0)
        outward[:, 2] = 1.0
        return outward * position_m - self._inside_m, outward

    def _island_penetrations(self, position_m: Array) -> tuple[Array, Array]:
        """Penetration of hulls into islands (n, islands), negative when clear, and unit vectors (n, islands, 2) out of
        them."""
        apart = position_m[:, None, :2] - self._islands_m[:, :2]
        distance = np.sqrt(np.sum(apart**2, axis=2))
        return self._islands_m[:, 2] + self._radius_m - distance, apart / np.maximum(distance, 1e-9)[..., None]

    def _pairs(self, position_m: Array, within_m: float) -> tuple[Indices, Indices]:
        """Indices (pairs,) of the hulls whose centres are nearer than `within_m`, the lower first, in order."""
        if len(position_m) >= MANY:
            pairs = cKDTree(position_m).query_pairs(within_m, output_type="ndarray")
            pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
            return pairs[:, 0], pairs[:, 1]
        first, second = np.nonzero(_squared_distances(position_m) < within_m**2)
        upper = first < second
        return first[upper], second[upper]

    def _normal_force(self, penetration_m: Array, penetration_rate_mps: Array) -> Array:
        damping = np.maximum(1.0 + CONTACT_DAMPING_S_PER_M * penetration_rate_mps, 0.0)
        return self._stiffness_npm * np.maximum(penetration_m, 0.0) * damping


def _squared_distances(position_m: Array) -> Array:
    """Squared distances (n, n) between all hulls at (n, 3)."""
    apart = position_m[:, None] - position_m
    return np.asarray(np.add.reduce(apart * apart, axis=2))

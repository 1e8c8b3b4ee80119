"""Contact of hulls, which are spheres, with walls, floor, islands and other hulls. Contact has no friction."""

import numpy as np

from shoal.config.experiment import Experiment
from shoal.frames import Array

# Contact is a spring on which one robot's mass swings at this rate: 0.5 m/s penetrates 8 mm, which steps of 5 ms resolve.
CONTACT_RADPS = 30.0


class ContactModel:
    """Walls, floor, islands and other robots."""

    def __init__(self, experiment: Experiment) -> None:
        length, width, depth = experiment.pool.size_m
        reach = np.array([length / 2, width / 2, depth]) if experiment.pool.walls else np.full(3, np.inf)
        self._radius_m = experiment.vehicle.radius_m
        self._inside_m = reach - self._radius_m  # limits of centres; in z a floor only, kernels.lift has the surface
        self._islands_m = np.array([[*island.position_m, island.radius_m] for island in experiment.islands]).reshape(-1, 3)
        stiffness_npm = float(experiment.vehicle.mass.surge_kg) * CONTACT_RADPS**2
        self.constants = (self._inside_m, self._islands_m, self._radius_m, stiffness_npm)

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

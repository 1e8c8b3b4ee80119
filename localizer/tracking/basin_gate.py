"""The part of the picture and of the pool in which a robot can be: a pose outside it is none. Pure.

A marker on the deck, one that a person carries, or a reflection in the wall reads like a robot's. The gate lets through what
lies within the pool's outline and `localizer.basin_margin_m` around it, and in none of the masks (`camera.masks_px`).
"""

import numpy as np

from localizer.camera_model import RefractiveCamera
from localizer.detection.image_regions import in_polygons
from shoal.config.experiment import Experiment
from shoal.frames import Array


class BasinGate:
    def __init__(self, experiment: Experiment) -> None:
        self._half_m = np.array(experiment.pool.size_m[:2]) / 2.0 + experiment.localizer.basin_margin_m
        self._masks_px = experiment.camera.masks_px

    def inside(self, position_m: Array) -> bool:
        """True if a robot can be at x, y (2,) of the pool."""
        return bool(np.all(np.abs(position_m) <= self._half_m))

    def admits(self, view: RefractiveCamera, position_m: Array, depth_m: float) -> bool:
        """True if what was seen at x, y (2,), at a depth, can be a robot."""
        if not self.inside(position_m):
            return False
        return not self._masks_px or not in_polygons(view.pool_to_pixel(np.append(position_m, depth_m)), self._masks_px)

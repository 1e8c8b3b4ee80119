"""Marker plates in the picture: on robots' backs, and as landmarks on the rim or the floor."""

from dataclasses import dataclass

import cv2
import numpy as np

from sim_bridge.camera.rays import Lines
from sim_bridge.camera.scenery import through_water
from sim_bridge.camera.textures import Float, plate, plate_texels_per_m
from wire.frames import Array

LENS_SOFTNESS_PX = 0.5


@dataclass(frozen=True)
class Sight:
    """What a window's pixels look along, ripples included, and the light (relative) on what is drawn there."""

    lines: Lines
    light: Float


class Plate:
    """One marker on its white plate. `layer` is pure: it only reads what was drawn at the start."""

    def __init__(self, marker_id: int, side_m: float, px_per_m: float) -> None:
        self._texels_per_m = plate_texels_per_m(side_m)
        self._texture = plate(marker_id, LENS_SOFTNESS_PX * self._texels_per_m / px_per_m)
        self.half_m = self._texture.shape[0] / 2.0 / self._texels_per_m  # transparent margin included

    def corners(self, place_m: Array) -> Array:
        """A square (4, 3) in the pool frame that holds the plate at `place_m` (3,), however it is turned."""
        reach = np.sqrt(2.0) * self.half_m
        return np.asarray(place_m + reach * np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]]))

    def layer(self, sight: Sight, place_m: Array, attitude: Array) -> tuple[Float, Float]:
        """Raw mosaic of the plate at `place_m` (3,) weighted with its coverage, and the coverage (0 to 1). The columns of
        `attitude` (3, 3) are the plate's axes in the pool: up in its picture, right in it, and away from who looks at it."""
        lines, (x0, y0, z0) = sight.lines, (np.float32(value) for value in place_m)
        slope_x, slope_y = (lines.water_x, lines.water_y) if z0 > 0 else (lines.air_x, lines.air_y)
        along, across, normal = attitude.T.astype(np.float32)
        x, y = lines.surface_x - x0, lines.surface_y - y0  # and (slope, 1) deeper per metre, to the plate's plane
        if normal[0] or normal[1]:
            deep = (z0 * normal[2] - x * normal[0] - y * normal[1]) / (normal[2] + slope_x * normal[0] + slope_y * normal[1])
        else:
            deep = z0
        x, y, below = x + deep * slope_x, y + deep * slope_y, deep - z0
        scale, middle = np.float32(self._texels_per_m), np.float32(self._texture.shape[0] / 2.0 - 0.5)
        column = scale * (across[0] * x + across[1] * y + across[2] * below) + middle
        row = middle - scale * (along[0] * x + along[1] * y + along[2] * below)
        found = cv2.remap(self._texture, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        cover = np.asarray(found[..., 1] * np.float32(1.0 / 255.0), dtype=np.float32)
        colour = through_water(np.asarray(found[..., 0] * sight.light, dtype=np.float32), 2.0 * max(float(z0), 0.0))
        return np.asarray(colour * cover, dtype=np.float32), cover

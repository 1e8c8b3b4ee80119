"""Marker plates in the picture: on robots' backs, and as landmarks on the rim or the floor."""

from dataclasses import dataclass

import cv2
import numpy as np

from sim_bridge.scenery import through_water
from sim_bridge.textures import Float, plate, plate_texels_per_m
from sim_bridge.view import Lines
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

    def layer(self, sight: Sight, place_m: Array, yaw_rad: float) -> tuple[Float, Float]:
        """Raw mosaic of the plate at `place_m` (3,) weighted with its coverage, and the coverage (0 to 1)."""
        lines, depth = sight.lines, float(place_m[2])
        slope_x, slope_y = (lines.water_x, lines.water_y) if depth > 0 else (lines.air_x, lines.air_y)
        x = lines.surface_x + np.float32(depth) * slope_x - np.float32(place_m[0])
        y = lines.surface_y + np.float32(depth) * slope_y - np.float32(place_m[1])
        scale, middle = self._texels_per_m, np.float32(self._texture.shape[0] / 2.0 - 0.5)
        cos, sin = np.float32(scale * np.cos(yaw_rad)), np.float32(scale * np.sin(yaw_rad))
        column, row = cos * y - sin * x + middle, middle - (cos * x + sin * y)
        found = cv2.remap(self._texture, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        cover = np.asarray(found[..., 1] * np.float32(1.0 / 255.0), dtype=np.float32)
        colour = through_water(np.asarray(found[..., 0] * sight.light, dtype=np.float32), 2.0 * max(depth, 0.0))
        return np.asarray(colour * cover, dtype=np.float32), cover

"""Test pictures with known truth: textured robots with markers under still water, drawn point by point.

Each pixel is traced into the pool with the same geometry that the tests of camera_model.py check against Fermat's principle,
so a fault of the tracking shows here and a fault of the mapping there.
"""

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray

from localizer.camera_model import RefractiveCamera
from shoal.config.experiment import Experiment
from shoal.frames import Array, pool_to_body

Pixels = NDArray[np.uint8]
_OVERSAMPLE = 3  # samples of a pixel each way
_TEXTURE_PX = 256
BAYER = np.array([[2, 1], [1, 0]])  # of BGR, at pixels of even and odd rows and columns: RGGB


class Scene:
    """Draws an experiment's robots where it is told to."""

    def __init__(self, experiment: Experiment, seed: int = 1, noise: float = 2.0) -> None:
        self._view = RefractiveCamera(experiment.camera)
        self._size_px = experiment.camera.size_px
        self._radius_m = experiment.vehicle.radius_m
        self._marker = experiment.vehicle.marker
        self._marker_ids = {robot.id: robot.marker for robot in experiment.robots}
        self._random = np.random.default_rng(seed)
        width, height = self._size_px
        self._noise = noise * self._random.normal(size=(height, width)).astype(np.float32)  # shifted from frame to frame
        blotches = self._random.normal(size=(height // 16, width // 16, 3)).astype(np.float32)
        water = np.array([150.0, 120.0, 60.0]) + 12.0 * cv2.resize(blotches, self._size_px, interpolation=cv2.INTER_CUBIC)
        self._water = bayer(water.astype(np.float32))
        body = self._random.normal(size=(9, 9, 3)).astype(np.float32)  # one look for all: robots of a fleet are alike
        smooth = cv2.resize(body, (_TEXTURE_PX, _TEXTURE_PX), interpolation=cv2.INTER_CUBIC)
        self._skin = np.clip(np.array([60.0, 160.0, 200.0]) + 40.0 * smooth, 0, 255)

    def frame(
        self, poses: Mapping[int, Array], hidden: frozenset[int] = frozenset(), swapped: Mapping[int, int] | None = None
    ) -> Pixels:
        """The Bayer picture (height, width) with robots (by id) at eta = [x, y, z, yaw], markers of `hidden` ones painted
        over, markers of `swapped` ones carrying another robot's."""
        picture = self._water.copy()
        for robot, eta in poses.items():
            marker = None if robot in hidden else self._marker_ids[(swapped or {}).get(robot, robot)]
            self._draw(picture, np.asarray(eta, dtype=np.float64), marker)
        picture += np.roll(self._noise, self._random.integers(1, min(self._size_px), size=2), axis=(0, 1))
        return np.asarray(np.clip(np.rint(picture), 0, 255), dtype=np.uint8)

    def _draw(self, picture: NDArray[np.float32], eta: Array, marker: int | None) -> None:
        plate_m = eta[2] - self._marker.height_m
        centre = self._view.pool_to_pixel(np.array([eta[0], eta[1], plate_m]))
        reach = round(self._radius_m * 420)
        left, top = (max(int(c) - reach, 0) // 2 * 2 for c in centre)
        right, bottom = (min(int(c) + reach, s) // 2 * 2 for c, s in zip(centre, self._size_px, strict=True))
        if right <= left or bottom <= top:
            return
        n = _OVERSAMPLE
        u = left - 0.5 + (np.arange((right - left) * n) + 0.5) / n  # pixel k spans k - 0.5 to k + 0.5
        v = top - 0.5 + (np.arange((bottom - top) * n) + 0.5) / n
        body = pool_to_body(self._plate_points(u, v, plate_m) - eta[:2], eta[3])
        ahead, starboard = np.ascontiguousarray(body[..., 0]), np.ascontiguousarray(body[..., 1])
        covered = ahead**2 + starboard**2 < self._radius_m**2
        colour = self._robot_colour(ahead, starboard, marker) * covered
        # of each pixel: samples that the robot covers, and their mean colour
        count, total = (sum(values[i::n, j::n] for i in range(n) for j in range(n)) for values in (covered * 1.0, colour))
        under = picture[top:bottom, left:right]
        under += (count / n**2 * (total / np.maximum(count, 1.0) - under)).astype(np.float32)

    def _plate_points(self, u: Array, v: Array, plate_m: float) -> Array:
        """Pool points (len(v), len(u), 2) under a grid of pixels: cubics through a coarse grid, true to 1e-6 m."""
        coarse = [np.linspace(axis[0], axis[-1], 7) for axis in (u, v)]
        places = self._view.pixel_to_pool(np.stack(np.meshgrid(*coarse), axis=-1).reshape(-1, 2), plate_m)
        unit = np.linspace(-1.0, 1.0, 7)
        across, down = np.meshgrid(unit, unit)
        base = polynomial.polyvander2d(across.ravel(), down.ravel(), [3, 3])
        terms = np.linalg.lstsq(base, places)[0].reshape(4, 4, 2)
        fine = (np.linspace(-1.0, 1.0, len(v)), np.linspace(-1.0, 1.0, len(u)))
        return np.moveaxis(polynomial.polygrid2d(*fine, terms.swapaxes(0, 1)), 0, -1)

    def _robot_colour(self, ahead_m: Array, starboard_m: Array, marker: int | None) -> Array:
        """The colour of points on the plate that the sensor measures at their pixels: one of blue, green and red."""
        column, row = (
            ((place_m / self._radius_m + 1.0) / 2.0 * _TEXTURE_PX).astype(int).clip(0, _TEXTURE_PX - 1)
            for place_m in (ahead_m, starboard_m)
        )
        samples = np.kron(BAYER, np.ones((_OVERSAMPLE, _OVERSAMPLE), int))
        channel = np.tile(samples, [size // len(samples) for size in ahead_m.shape])
        colour: Array = self._skin.ravel().take((row * _TEXTURE_PX + column) * 3 + channel)
        if marker is not None:
            dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
            cells = np.asarray(cv2.aruco.generateImageMarker(dictionary, marker, 6))
            white = np.maximum(np.abs(ahead_m), np.abs(starboard_m)) < 0.65 * self._marker.side_m
            row = np.floor((0.5 - ahead_m[white] / self._marker.side_m) * 6).astype(int)  # upper edge ahead
            column = np.floor((0.5 + starboard_m[white] / self._marker.side_m) * 6).astype(int)
            inside = (row >= 0) & (row < 6) & (column >= 0) & (column < 6)
            colour[white] = np.where(inside, 20.0 + 0.8 * cells[row.clip(0, 5), column.clip(0, 5)], 224.0)
        return colour


def bayer(bgr: NDArray[Any]) -> NDArray[Any]:
    """The RGGB mosaic (height, width) of a BGR picture: red first, by definition of the name."""
    mosaic = np.empty(bgr.shape[:2], bgr.dtype)
    mosaic[0::2, 0::2] = bgr[0::2, 0::2, 2]
    mosaic[0::2, 1::2] = bgr[0::2, 1::2, 1]
    mosaic[1::2, 0::2] = bgr[1::2, 0::2, 1]
    mosaic[1::2, 1::2] = bgr[1::2, 1::2, 0]
    return mosaic

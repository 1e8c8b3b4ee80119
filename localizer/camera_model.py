"""The mapping between pixels and the pool: a pinhole camera with lens distortion, in air, above a flat water surface at z =
0.

Pixel to pool: undistorted ray, surface, Snell's law, plane of known depth. Pool to pixel: the point on the surface is the
root of Snell's law along the line from the camera's foot to the point. Points are undistorted, pictures never: a remap of
1280 x 960 costs more than all tracking together, and blurs. Pixel (0, 0) is the CENTRE of the first pixel, as in OpenCV.

A depth below zero is a point above the water (the plate of a surfaced robot). Its ray is straight.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from localizer import kernels
from shoal.config.loader import Section
from shoal.config.perception import Camera
from shoal.frames import Array

LARGEST_FOLD_PX = 0.1  # px; a lens with pixels that are farther off gives wrong places there
# Undistortion is a fixed-point iteration. OpenCV's default of 5 rounds stops 0.3 px short in the corners of a wide lens.
_UNDISTORT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)


class Intrinsics(Section):
    """The part of shoal.config.perception.Camera that belongs to lens and sensor and does not depend on the camera's pose."""

    size_px: tuple[int, int]
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    @classmethod
    def of(cls, camera: Camera) -> "Intrinsics":
        return cls(**{key: getattr(camera, key) for key in cls.model_fields})

    @property
    def matrix(self) -> Array:
        """Camera matrix (3, 3)."""
        (fx, fy), (cx, cy) = self.focal_px, self.centre_px
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def rays(self, pixels: Array) -> Array:
        """Directions (n, 3) in the camera's frame, third component 1, of pixels (n, 2), by undistortion."""
        normal = cv2.undistortPoints(pixels[:, None], self.matrix, np.array(self.distortion), criteria=_UNDISTORT)
        return np.concatenate([normal[:, 0, :], np.ones((len(normal), 1))], axis=1)


def fold_px(lens: Intrinsics) -> float:
    """Largest error of undistorting and distorting the picture's pixels, px; above zero where the polynomial folds over, or
    its iteration does not end: with k3 perhaps only on the way to an edge that is right."""
    width, height = lens.size_px
    x, y = np.linspace(0.0, width - 1.0, 65), np.linspace(0.0, height - 1.0, 49)
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    rays = lens.rays(pixels)
    back, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), lens.matrix, np.array(lens.distortion))
    return float(np.abs(np.asarray(back)[:, 0] - pixels).max())


@dataclass(frozen=True)
class LocalLinearization:
    """First-order mapping around one pool point: exact there, 0.03 px off at 5 cm distance in the corners of the pool
    scene."""

    position_m: Array  # (2,)
    pixel: Array  # (2,)
    jacobian: Array  # (2, 3): d(x, y) / d(u, v, depth)
    pool_to_px: Array  # (2, 2): d(u, v) / d(x, y)
    px_per_m: float  # scale of the picture here, the larger of the two directions

    def nearby_px(self, position_m: Array) -> Array:
        """Pixel (2,) of a pool position (2,) nearby, at the same depth."""
        return np.asarray(self.pixel + self.pool_to_px @ (position_m - self.position_m))

    @property
    def down_px(self) -> Array:
        """d(u, v) / d depth of a point that sinks straight down, (2,) px/m: towards the camera's foot."""
        return np.asarray(-self.pool_to_px @ self.jacobian[:, 2])


class RefractiveCamera:
    """The mapping of one camera, vectorised over points; in pixels, metres and the pool frame."""

    def __init__(self, camera: Camera) -> None:
        self._pool_to_camera = np.asarray(cv2.Rodrigues(np.array(camera.rotation_rad))[0], dtype=np.float64)
        self.numbers = np.array([  # as in kernels.py
            *camera.focal_px, *camera.centre_px, *camera.distortion, *camera.position_m, *self._pool_to_camera.ravel(),
            camera.water_index,
        ])  # fmt: skip

    @property
    def down(self) -> Array:
        """The pool's z axis in the camera's frame, (3,)."""
        return np.asarray(self._pool_to_camera[:, 2])

    def apparent_m(self, point: Array) -> float:
        """Distance of the camera from a pool point (3,) in water of the same index, in which objects look as large as they
        do: the way through air counts as `water_index` times its length."""
        camera, index = self.numbers[9:12], float(self.numbers[21])
        slant = float(np.linalg.norm(point - camera)) / max(float(point[2] - camera[2]), 1e-9)
        return slant * (max(float(point[2]), 0.0) - index * float(min(camera[2], 0.0)))

    def pixel_to_pool(self, points_px: ArrayLike, depth_m: ArrayLike) -> Array:
        """Map pixels (..., 2) to pool x, y (..., 2) on the planes at `depth_m` (scalar or (...))."""
        pixels = np.asarray(points_px, dtype=np.float64)
        places = np.empty(pixels.shape)
        kernels.pool_points(self.numbers, _rows(pixels), _spread(depth_m, pixels.shape[:-1]), places.reshape(-1, 2))
        return places

    def pool_to_pixel(self, points_pool: ArrayLike) -> Array:
        """Map pool points (..., 3) to pixels (..., 2); NaN for points that do not lie before the lens."""
        points = np.asarray(points_pool, dtype=np.float64)
        pixels = np.empty((*points.shape[:-1], 2))
        kernels.pixels_of(self.numbers, _rows(points), pixels.reshape(-1, 2))
        return pixels

    def jacobian(self, points_px: ArrayLike, depth_m: ArrayLike) -> Array:
        """d(x, y) / d(u, v, depth) at pixels (n, 2) and depths (n,): shape (n, 2, 3), in m/px, m/px, m/m."""
        pixels = np.asarray(points_px, dtype=np.float64)
        slopes = np.empty((len(pixels), 2, 3))
        kernels.jacobians(self.numbers, _rows(pixels), _spread(depth_m, pixels.shape[:-1]), slopes)
        return slopes

    def linearize(self, positions_m: Sequence[Array], depths_m: Sequence[float]) -> list[LocalLinearization]:
        """Linearise around pool positions (2,), each at its depth, in one batch."""
        if not positions_m:
            return []
        positions, depths = np.array(positions_m), np.array(depths_m)
        pixels = self.pool_to_pixel(np.column_stack([positions, depths]))
        jacobians = self.jacobian(pixels, depths)
        inverses = np.linalg.inv(jacobians[:, :, :2])
        scales = np.sqrt(np.sum(inverses**2, axis=1).max(axis=1)).tolist()
        return [LocalLinearization(*parts) for parts in zip(positions, pixels, jacobians, inverses, scales, strict=True)]


def _rows(points: Array) -> Array:
    """A copy of points (..., k) as rows (n, k): kernels take no views and nothing that is only to be read."""
    return np.array(points.reshape(-1, points.shape[-1]), order="C")


def _spread(depth_m: ArrayLike, shape: tuple[int, ...]) -> Array:
    """One depth per point, (n,), from a scalar or an array that broadcasts to `shape`."""
    return np.array(np.broadcast_to(np.asarray(depth_m, dtype=np.float64), shape)).reshape(-1)

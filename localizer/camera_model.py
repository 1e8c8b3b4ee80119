"""The mapping between pixels and the pool: a pinhole camera with lens distortion, in air, above a flat water surface at z =
0.

Pixel to pool: undistorted ray, surface, Snell's law, plane of known depth. Pool to pixel: the point on the surface is the
root of Snell's law along the line from the camera's foot to the point. Points are undistorted, pictures never: a remap of
1280 x 960 costs more than all tracking together, and blurs. Pixel (0, 0) is the CENTRE of the first pixel, as in OpenCV.

A depth below zero is a point above the water (the plate of a surfaced robot). Its ray is straight.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import ArrayLike

from wire.config.perception import Camera
from wire.frames import Array
from wire.toml_loader import Section

# Undistortion is a fixed-point iteration. OpenCV's default of 5 rounds stops 0.3 px short in the corners of a wide lens.
_UNDISTORT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)
_NEWTON_STEPS = 6  # from a paraxial start; with six, round trips agree to 1e-11 px over the whole picture
_DIFFERENCE_PX = 0.5  # px, step of central differences; their error is below 1e-8 (relative) for any usable lens
_STEPS_PX = _DIFFERENCE_PX * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0], [0.0, 0.0], [0.0, 0.0]])
_STEPS_M = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


class Intrinsics(Section):
    """The part of wire.config.perception.Camera that belongs to lens and sensor and does not depend on the camera's pose."""

    size_px: tuple[int, int]
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    @classmethod
    def of(cls, camera: Camera) -> "Intrinsics":
        """The intrinsics of a camera."""
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


@dataclass(frozen=True)
class LocalLinearization:
    """First-order mapping around one pool point: exact there, 0.03 px off at 5 cm distance in the corners of the pool
    scene."""

    position_m: Array  # (2,)
    pixel: Array  # (2,)
    jacobian: Array  # (2, 3): d(x, y) / d(u, v, depth)
    pool_to_px: Array  # (2, 2): d(u, v) / d(x, y)

    def nearby_px(self, position_m: Array) -> Array:
        """Pixel (2,) of a pool position (2,) nearby, at the same depth."""
        return np.asarray(self.pixel + self.pool_to_px @ (position_m - self.position_m))

    @property
    def down_px(self) -> Array:
        """d(u, v) / d depth of a point that sinks straight down, (2,) px/m: towards the camera's foot."""
        return np.asarray(-self.pool_to_px @ self.jacobian[:, 2])

    @cached_property
    def px_per_m(self) -> float:
        """Scale of the picture here, px/m, the larger of the two directions."""
        return float(np.linalg.norm(self.pool_to_px, axis=0).max())


class RefractiveCamera:
    """The mapping of one camera, vectorised over points; in pixels, metres and the pool frame."""

    def __init__(self, camera: Camera) -> None:
        self._intrinsics = Intrinsics.of(camera)
        self._matrix, self._distortion = self._intrinsics.matrix, np.array(camera.distortion)
        self._rotation_vector = np.array(camera.rotation_rad)
        self._pool_to_camera = np.asarray(cv2.Rodrigues(self._rotation_vector)[0], dtype=np.float64)
        self._position_m = np.array(camera.position_m)
        self._translation = -self._pool_to_camera @ self._position_m
        self._water_index = camera.water_index

    @property
    def down(self) -> Array:
        """The pool's z axis in the camera's frame, (3,)."""
        return np.asarray(self._pool_to_camera[:, 2])

    def pixel_to_pool(self, points_px: ArrayLike, depth_m: ArrayLike) -> Array:
        """Map pixels (..., 2) to pool x, y (..., 2) on the planes at `depth_m` (scalar or (...))."""
        pixels = np.asarray(points_px, dtype=np.float64)
        shape = pixels.shape
        depth = np.broadcast_to(np.asarray(depth_m, dtype=np.float64), shape[:-1]).reshape(-1, 1)
        ray = self._intrinsics.rays(pixels.reshape(-1, 2)) @ self._pool_to_camera  # rows: R^T times each ray
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        surface = self._position_m[:2] - self._position_m[2] * ray[:, :2] / ray[:, 2:]
        air_slope = ray[:, :2] / ray[:, 2:]
        sine = ray[:, :2] / self._water_index  # Snell: horizontal part of the unit ray shrinks by n
        water_slope = sine / np.sqrt(1.0 - np.sum(sine**2, axis=1, keepdims=True))
        return np.asarray(surface + depth * np.where(depth > 0, water_slope, air_slope)).reshape(shape)

    def pool_to_pixel(self, points_pool: ArrayLike) -> Array:
        """Map pool points (..., 3) to pixels (..., 2)."""
        points = np.asarray(points_pool, dtype=np.float64)
        seen = self._seen_at(points.reshape(-1, 3))
        pixels, _ = cv2.projectPoints(seen, self._rotation_vector, self._translation, self._matrix, self._distortion)
        return np.asarray(pixels, dtype=np.float64).reshape((*points.shape[:-1], 2))

    def jacobian(self, points_px: ArrayLike, depth_m: ArrayLike) -> Array:
        """d(x, y) / d(u, v, depth) at pixels (n, 2) and depths (n,): shape (n, 2, 3), in m/px, m/px, m/m."""
        pixels = np.asarray(points_px, dtype=np.float64)
        depth = np.broadcast_to(np.asarray(depth_m, dtype=np.float64), pixels.shape[:-1])
        away = np.where(depth > 0, 1.0, -1.0)  # x, y are linear in depth on either side of the surface: any step is exact
        around = self.pixel_to_pool(pixels[:, None] + _STEPS_PX, depth[:, None] + away[:, None] * _STEPS_M)  # (n, 6, 2)
        by_u = (around[:, 0] - around[:, 1]) / (2 * _DIFFERENCE_PX)
        by_v = (around[:, 2] - around[:, 3]) / (2 * _DIFFERENCE_PX)
        by_depth = (around[:, 5] - around[:, 4]) * away[:, None]
        return np.stack([by_u, by_v, by_depth], axis=-1)

    def linearize(self, positions_m: Sequence[Array], depths_m: Sequence[float]) -> list[LocalLinearization]:
        """Linearise around pool positions (2,), each at its depth, in one batch."""
        if not positions_m:
            return []
        positions, depths = np.array(positions_m), np.array(depths_m)
        pixels = self.pool_to_pixel(np.column_stack([positions, depths]))
        jacobians = self.jacobian(pixels, depths)
        inverses = np.linalg.inv(jacobians[:, :, :2])
        return [LocalLinearization(*parts) for parts in zip(positions, pixels, jacobians, inverses, strict=True)]

    def _seen_at(self, points: Array) -> Array:
        """Points (n, 3) at which the light from points (n, 3) leaves the water; a point in air is returned unchanged.

        Newton on g(r) = r + depth tan(water angle at r) - reach, with r the horizontal distance from the camera's foot to
        the point on the surface. The tangent, by Snell r / sqrt(n^2 (r^2 + h^2) - r^2), stays well-behaved down to depth
        0, where sines of the water angle would divide zero by zero.
        """
        offset = points[:, :2] - self._position_m[:2]
        reach = np.linalg.norm(offset, axis=1)
        depth = np.maximum(points[:, 2], 0.0)
        height, n = -self._position_m[2], self._water_index
        r = reach * height / (height + depth / n)
        for _ in range(_NEWTON_STEPS):
            root = np.sqrt(n**2 * (r**2 + height**2) - r**2)
            r = r - (r + depth * r / root - reach) / (1.0 + depth * (n * height) ** 2 / root**3)
        fraction = np.divide(r, reach, out=np.ones_like(r), where=reach > 0)
        at_surface = np.column_stack([self._position_m[:2] + fraction[:, None] * offset, np.zeros(len(points))])
        return np.where(points[:, 2:] > 0, at_surface, points)

"""Exact optics of the simulated camera: OpenCV's pinhole with distortion, in air above flat water (Snell's law at z = 0).

`project` maps the pool to pixels, `rays` maps pixels to lines of sight. Neither approximates. They are written without the
localizer's mapping, which tests judge by them.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from shoal.config.perception import Camera
from shoal.frames import Array
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Floats, Table

Float = NDArray[np.float32]  # a plane of the picture, of its blocks, or of a map
Bytes = NDArray[np.uint8]  # a picture: raw mosaic (height, width) or BGR (height, width, 3)

TOLERANCE_M = 1e-12  # m, step at which Newton's iteration for the refraction point ends, after 3 to 6 steps
MAX_STEPS = 30
UNDISTORT = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 40, 1e-10)
GRAZING = 1e-3  # least sine of a ray's angle below the horizon; flatter rays, metres outside any pool, are given this one


@dataclass(frozen=True)
class Rays:
    """Lines of sight, all arrays (..., 2): their crossing of the surface, and sideways metres per metre of depth, in air
    and in water. In water a ray is at `surface + z * water` at depth z."""

    surface_m: Array
    air: Array
    water: Array


def _camera_matrix(camera: Camera) -> Array:
    (fx, fy), (cx, cy) = camera.focal_px, camera.centre_px
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


@kernel(part=True)
def crossing_m(reach_m: float, depth_m: float, height_m: float, index: float) -> float:
    """Distance from the camera's foot at which light from a point to a camera crosses the surface.

    The point is `depth_m` below it and `reach_m` from the foot, the camera `height_m` above it. With r the crossing's
    distance, a ray leaves the surface at tan = r / sqrt(a r^2 + b) (Snell), so g(r) = r + z tan(r) - reach = 0. g rises and
    is concave: Newton converges from any start.
    """
    a, b = index * index - 1.0, index * index * height_m * height_m
    r = reach_m * height_m / (height_m + depth_m / index)
    for _ in range(MAX_STEPS):
        root = math.sqrt(a * r * r + b)
        step = (r + depth_m * r / root - reach_m) / (1.0 + depth_m * b / (root * root * root))
        r -= step
        if abs(step) < TOLERANCE_M:
            break
    return r


@kernel(part=True)
def refract(points: Table, lens: Floats, index: float, crossings: Table) -> None:
    """Points (m, 3) at which the light from points (m, 3) to the lens crosses z = 0; points above the water stay."""
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if z > 0.0:
            dx, dy = x - lens[0], y - lens[1]
            reach_m = math.sqrt(dx * dx + dy * dy)
            share = crossing_m(reach_m, z, -lens[2], index) / reach_m if reach_m > 0.0 else 1.0
            x, y, z = lens[0] + share * dx, lens[1] + share * dy, 0.0
        crossings[i, 0], crossings[i, 1], crossings[i, 2] = x, y, z


@kernel(part=True)
def project_air(points: Table, lens: Floats, turn: Table, pinhole: Floats, pixels: Table) -> None:
    """Pixels (m, 2) of points (m, 3) in air; NaN behind the lens. `turn` is the rotation from pool to camera, `pinhole` focal
    lengths, centre and OpenCV's distortion k1, k2, p1, p2, k3."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = (
        pinhole[0], pinhole[1], pinhole[2], pinhole[3], pinhole[4], pinhole[5], pinhole[6], pinhole[7], pinhole[8]
    )  # fmt: skip
    for i in range(len(points)):
        dx, dy, dz = points[i, 0] - lens[0], points[i, 1] - lens[1], points[i, 2] - lens[2]
        ahead = turn[2, 0] * dx + turn[2, 1] * dy + turn[2, 2] * dz
        if ahead > 0.0:
            x = (turn[0, 0] * dx + turn[0, 1] * dy + turn[0, 2] * dz) / ahead
            y = (turn[1, 0] * dx + turn[1, 1] * dy + turn[1, 2] * dz) / ahead
            r2 = x * x + y * y
            radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
            pixels[i, 0] = cx + fx * (x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x))
            pixels[i, 1] = cy + fy * (y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y)
        else:
            pixels[i, 0] = pixels[i, 1] = math.nan


@kernel
def see(
    points: Table, lens: Floats, index: float, turn: Table, pinhole: Floats, crossings: Table, pixels: Table, path_m: Floats
) -> None:
    """Crossings (m, 3) as `refract`, pixels (m, 2) as `project_air`, and the optical path (m,) from the lens to each point."""
    refract(points, lens, index, crossings)
    project_air(crossings, lens, turn, pinhole, pixels)
    for i in range(len(points)):
        in_air, in_water = 0.0, 0.0
        for axis in range(3):
            in_air += (crossings[i, axis] - lens[axis]) ** 2
            in_water += (points[i, axis] - crossings[i, axis]) ** 2
        path_m[i] = math.sqrt(in_air) + index * math.sqrt(in_water)


@dataclass(frozen=True)
class SeenPoints:
    """Points of the pool as a camera sees them."""

    crossings: Array  # (m, 3), where their light crosses z = 0; points above the water unchanged
    pixels: Array  # (m, 2); NaN for points behind the lens
    path_m: Array  # (m,) optical length from the lens. It grows along every line of sight, and so orders bodies by distance


class Optics:
    """A camera in its pose: its numbers as the kernels take them."""

    def __init__(self, camera: Camera) -> None:
        self._lens, self._index = np.array(camera.position_m), camera.water_index
        self._turn = np.asarray(cv2.Rodrigues(np.array(camera.rotation_rad))[0], dtype=np.float64)
        self._pinhole = np.array([*camera.focal_px, *camera.centre_px, *camera.distortion])

    def see(self, points_pool: Array) -> SeenPoints:
        """Points (m, 3) of the pool frame, as the camera sees them."""
        points = np.ascontiguousarray(points_pool, dtype=np.float64).reshape(-1, 3)
        view = SeenPoints(np.empty_like(points), np.empty((len(points), 2)), np.empty(len(points)))
        see(points, self._lens, self._index, self._turn, self._pinhole, view.crossings, view.pixels, view.path_m)
        return view


def project(camera: Camera, points_pool: Array) -> Array:
    """Pixels (m, 2) at which the camera sees points (m, 3) of the pool frame; NaN for points behind the lens."""
    return Optics(camera).see(points_pool).pixels


def camera_slopes(camera: Camera, pixels: Array) -> Array:
    """Directions [right, down, 1], (..., 3), of pixels (..., 2) in the camera's own frame."""
    flat = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
    ideal = np.asarray(
        cv2.undistortImagePoints(flat, _camera_matrix(camera), np.array(camera.distortion), arg1=UNDISTORT)
    ).reshape(-1, 2)
    slopes = np.column_stack([(ideal - camera.centre_px) / camera.focal_px, np.ones(len(ideal))])
    return slopes.reshape((*np.asarray(pixels).shape[:-1], 3))


def rays(camera: Camera, pixels: Array) -> Rays:
    """The lines of sight of pixels (..., 2). The inverse of `project`."""
    slopes = camera_slopes(camera, pixels).reshape(-1, 3)
    direction: Array = slopes @ np.asarray(cv2.Rodrigues(np.array(camera.rotation_rad))[0])  # row times R = R^T times column
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    air = direction[:, :2] / np.maximum(direction[:, 2:], GRAZING)
    lens = np.array(camera.position_m)
    sine = air / np.sqrt(1.0 + np.sum(air**2, axis=1, keepdims=True))
    water = sine / np.sqrt(camera.water_index**2 - np.sum(sine**2, axis=1, keepdims=True))
    shape = np.asarray(pixels).shape
    return Rays((lens[:2] - lens[2] * air).reshape(shape), air.reshape(shape), water.reshape(shape))

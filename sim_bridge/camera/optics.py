"""Exact optics of the simulated camera: OpenCV's pinhole with distortion, in air above flat water (Snell's law at z = 0).

`project` maps the pool to pixels, `rays` maps pixels to lines of sight. Neither approximates. They are written without the
localizer's mapping, which tests judge by them.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from wire.config.perception import Camera
from wire.frames import Array

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


def refraction_points(camera: Camera, points_pool: Array) -> Array:
    """Points (m, 3) at which the light from points (m, 3) to the camera crosses z = 0. Points above the water are returned
    unchanged."""
    points = np.asarray(points_pool, dtype=np.float64).reshape(-1, 3)
    lens = np.array(camera.position_m)
    offset = points[:, :2] - lens[:2]
    reach = np.hypot(offset[:, 0], offset[:, 1])
    # With r the crossing's distance from the camera's foot, a ray leaves the surface at tan = r / sqrt(a r^2 + b)
    # (Snell), so g(r) = r + z tan(r) - reach = 0. g rises and is concave: Newton converges from any start.
    height2 = lens[2] ** 2
    a, b = camera.water_index**2 - 1.0, camera.water_index**2 * height2
    depth = np.maximum(points[:, 2], 0.0)
    r = reach * lens[2] / (lens[2] - depth / camera.water_index)
    for _ in range(MAX_STEPS):
        root = np.sqrt(a * r**2 + b)
        step = (r + depth * r / root - reach) / (1.0 + depth * b / root**3)
        r = r - step
        if np.all(np.abs(step) < TOLERANCE_M):
            break
    share = np.divide(r, reach, out=np.ones_like(r), where=reach > 0)
    crossing = np.column_stack([lens[:2] + share[:, None] * offset, np.zeros(len(points))])
    return np.where(points[:, 2:] > 0, crossing, points)


def project(camera: Camera, points_pool: Array) -> Array:
    """Pixels (m, 2) at which the camera sees points (m, 3) of the pool frame; NaN for points behind the lens."""
    seen = refraction_points(camera, points_pool)
    rotation = np.array(camera.rotation_rad)
    matrix: Array = np.asarray(cv2.Rodrigues(rotation)[0])
    translation = -matrix @ np.array(camera.position_m)
    pixels, _ = cv2.projectPoints(seen[:, None, :], rotation, translation, _camera_matrix(camera), np.array(camera.distortion))
    ahead = seen @ matrix[2] + translation[2]
    return np.where(ahead[:, None] > 0, np.asarray(pixels, dtype=np.float64).reshape(-1, 2), np.nan)


def optical_path_m(camera: Camera, points_pool: Array) -> Array:
    """Optical length (m,) from the lens to each point. It grows along every line of sight, and so orders bodies by
    distance."""
    points = np.asarray(points_pool, dtype=np.float64).reshape(-1, 3)
    crossing = refraction_points(camera, points)
    in_air = np.linalg.norm(crossing - np.array(camera.position_m), axis=1)
    return np.asarray(in_air + camera.water_index * np.linalg.norm(points - crossing, axis=1))


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

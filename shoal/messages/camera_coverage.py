"""Coverage of cameras: the part of the pool that their pictures show. Pure.

The same optics as the localizer's (pinhole with OpenCV's distortion, in air above flat water, Snell's law), forwards only and
without OpenCV, which neither station nor robots install.
"""

from collections.abc import Sequence

import numpy as np

from shoal.config.perception import Camera
from shoal.frames import Array

_NEWTON_STEPS = 8
_TURN = 2.0 * np.pi / 8 * np.arange(8)
_RING = np.column_stack([np.cos(_TURN), np.sin(_TURN), np.zeros(8)])
_FARTHEST_M = 1e3  # beside the picture: what is behind the lens, or so far that a number says nothing


def outside_m(cameras: Sequence[Camera], places_m: Array, reach_m: float) -> Array:
    """Distance (n,) by which level discs of radius `reach_m` around places (n, 3) reach out of the picture that shows them
    best, in m of the pool at their depth. 0 or less: the disc is wholly inside a picture."""
    return np.asarray(np.min([_outside_one_m(camera, places_m, reach_m) for camera in cameras], axis=0))


def _outside_one_m(camera: Camera, places_m: Array, reach_m: float) -> Array:
    """Distance (n,) in m of places (n, 3), with a reach around each, beyond the picture of one camera; below 0 inside."""
    places = np.column_stack([places_m[:, :2], np.maximum(places_m[:, 2], 0.0)])
    points = np.concatenate([places[:, None], places[:, None] + reach_m * _RING], axis=1)  # (n, 9, 3)
    pixels = _without_fold(camera, points.reshape(-1, 3)).reshape(-1, 9, 2)
    beyond_px = np.maximum(-0.5 - pixels, pixels - (np.array(camera.size_px) - 0.5)).max(axis=2)
    px_per_m = np.linalg.norm(pixels[:, 1:] - pixels[:, :1], axis=2).mean(axis=1) / reach_m
    with np.errstate(invalid="ignore"):
        distance_m = beyond_px.max(axis=1) / px_per_m
    return np.where(np.isfinite(distance_m), np.minimum(distance_m, _FARTHEST_M), _FARTHEST_M)


def _without_fold(camera: Camera, points: Array) -> Array:
    """Project as `project` does, but far outside without the lens's distortion: beyond the angle at which the distortion's
    polynomial turns back, it would bring places into the picture that no lens shows there."""
    k1, k2, _, _, k3 = camera.distortion
    roots = np.roots([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])
    turns = [float(root.real) for root in roots if abs(root.imag) < 1e-12 and root.real > 0.0]
    pixels = project(camera, points)
    if not turns:
        return pixels
    straight = project(camera.model_copy(update={"distortion": (0.0, 0.0, 0.0, 0.0, 0.0)}), points)
    r2 = np.sum(((straight - np.array(camera.centre_px)) / np.array(camera.focal_px)) ** 2, axis=1)
    return np.where((r2 < min(turns))[:, None], pixels, straight)


def project(camera: Camera, points: Array) -> Array:
    """Pixels (n, 2) that show pool points (n, 3) at depths >= 0; NaN for what lies behind the lens."""
    crossings = _at_surface(camera, points)
    at = (crossings - np.array(camera.position_m)) @ _rotation(np.array(camera.rotation_rad)).T
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = np.where(at[:, 2:] > 1e-6, at[:, :2] / at[:, 2:], np.nan).T
    k1, k2, p1, p2, k3 = camera.distortion
    r2 = x**2 + y**2
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    x_bent = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x**2)
    y_bent = y * radial + p1 * (r2 + 2.0 * y**2) + 2.0 * p2 * x * y
    return np.column_stack([x_bent, y_bent]) * camera.focal_px + camera.centre_px


def _at_surface(camera: Camera, points: Array) -> Array:
    """Points at which the light from points (n, 3) crosses z = 0.

    With r the crossing's distance from the camera's foot, a ray leaves the surface at tan = r / sqrt(n^2 (r^2 + h^2) - r^2)
    (Snell). Newton's method solves r + depth tan = reach."""
    lens, n = np.array(camera.position_m), camera.water_index
    offset, depth, height = points[:, :2] - lens[:2], points[:, 2], -lens[2]
    reach = np.hypot(offset[:, 0], offset[:, 1])
    r = reach * height / (height + depth / n)
    for _ in range(_NEWTON_STEPS):
        root = np.sqrt(n**2 * (r**2 + height**2) - r**2)
        r = r - (r + depth * r / root - reach) / (1.0 + depth * (n * height) ** 2 / root**3)
    share = np.divide(r, reach, out=np.ones_like(r), where=reach > 0)
    return np.column_stack([lens[:2] + share[:, None] * offset, np.zeros(len(points))])


def _rotation(vector: Array) -> Array:
    """Rotation matrix (3, 3) of a Rodrigues vector."""
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)

"""Where the camera's picture belongs under the map: a mesh of pool points and the places in the picture that show them. Pure.

The same optics as the localizer's (pinhole with OpenCV's distortion, in air above flat water, Snell's law), forwards only and
without OpenCV, which the station does not install.
"""

import numpy as np

from wire.experiment import Experiment
from wire.frames import Array
from wire.sight import Camera

CELLS = 16  # along the longer side: straight edges between nodes are then within 1 mm of the lens's curves
MARGIN_M = 0.2  # beyond the walls
_NEWTON_STEPS = 8


def mesh(experiment: Experiment) -> tuple[Array, Array]:
    """Grid points (rows + 1, columns + 1, 2) on the plane of the path's depth, pool frame, and the places (same shape) in the
    picture that show them, from 0 to 1 across its width and height."""
    length, width, _ = experiment.pool.size_m
    cell_m = max(length, width) / CELLS
    x = np.linspace(-length / 2 - MARGIN_M, length / 2 + MARGIN_M, max(2, round(length / cell_m)) + 1)
    y = np.linspace(-width / 2 - MARGIN_M, width / 2 + MARGIN_M, max(2, round(width / cell_m)) + 1)
    points = np.stack(np.meshgrid(x, y), axis=-1)
    flat = points.reshape(-1, 2)
    pixels = project(experiment.camera, np.column_stack([flat, np.full(len(flat), experiment.path.depth_m)]))
    return points, ((pixels + 0.5) / np.array(experiment.camera.size_px)).reshape(points.shape)


def project(camera: Camera, points: Array) -> Array:
    """Pixels (n, 2) that show pool points (n, 3) at depths >= 0; NaN for what lies behind the lens."""
    seen = _at_surface(camera, points)
    at = (seen - np.array(camera.position_m)) @ _rotation(np.array(camera.rotation_rad)).T
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = np.where(at[:, 2:] > 1e-6, at[:, :2] / at[:, 2:], np.nan).T
    k1, k2, p1, p2, k3 = camera.distortion
    r2 = x**2 + y**2
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    x_bent = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x**2)
    y_bent = y * radial + p1 * (r2 + 2.0 * y**2) + 2.0 * p2 * x * y
    return np.column_stack([x_bent, y_bent]) * camera.focal_px + camera.centre_px


def _at_surface(camera: Camera, points: Array) -> Array:
    """Where the light from points (n, 3) crosses z = 0. With r the crossing's distance from the camera's foot, a ray leaves
    the surface at tan = r / sqrt(n^2 (r^2 + h^2) - r^2) (Snell); Newton finds r + depth tan = reach."""
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

"""The geometry of a frame in NumPy and OpenCV, without kernels: the reference for localizer/kernels.py."""

import cv2
import numpy as np

from shoal.config.perception import Camera
from shoal.frames import Array, wrap

_UNDISTORT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)
_NEWTON_STEPS = 6
_HALF_PX = 0.5
_STEPS_PX = _HALF_PX * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0], [0.0, 0.0], [0.0, 0.0]])
_STEPS_M = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


def _matrix(camera: Camera) -> Array:
    return np.array([[camera.focal_px[0], 0, camera.centre_px[0]], [0, camera.focal_px[1], camera.centre_px[1]], [0, 0, 1]])


def pool_points(camera: Camera, pixels: Array, depths: Array) -> Array:
    """Pool x, y (n, 2) of pixels (n, 2) at depths (n,)."""
    rotation = np.asarray(cv2.Rodrigues(np.array(camera.rotation_rad))[0], dtype=np.float64)
    normal = cv2.undistortPoints(pixels[:, None], _matrix(camera), np.array(camera.distortion), criteria=_UNDISTORT)
    ray = np.concatenate([normal[:, 0, :], np.ones((len(normal), 1))], axis=1) @ rotation
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    position, depth = np.array(camera.position_m), depths[:, None]
    air_slope = ray[:, :2] / ray[:, 2:]
    surface = position[:2] - position[2] * air_slope
    sine = ray[:, :2] / camera.water_index
    water_slope = sine / np.sqrt(1.0 - np.sum(sine**2, axis=1, keepdims=True))
    return np.asarray(surface + depth * np.where(depth > 0, water_slope, air_slope))


def pixels_of(camera: Camera, points: Array) -> Array:
    """Pixels (n, 2) of pool points (n, 3)."""
    position, n = np.array(camera.position_m), camera.water_index
    offset = points[:, :2] - position[:2]
    reach = np.linalg.norm(offset, axis=1)
    depth = np.maximum(points[:, 2], 0.0)
    height = -position[2]
    r = reach * height / (height + depth / n)
    for _ in range(_NEWTON_STEPS):
        root = np.sqrt(n**2 * (r**2 + height**2) - r**2)
        r = r - (r + depth * r / root - reach) / (1.0 + depth * (n * height) ** 2 / root**3)
    fraction = np.divide(r, reach, out=np.ones_like(r), where=reach > 0)
    at_surface = np.column_stack([position[:2] + fraction[:, None] * offset, np.zeros(len(points))])
    points_seen = np.where(points[:, 2:] > 0, at_surface, points)
    turn = np.array(camera.rotation_rad)
    shift = -np.asarray(cv2.Rodrigues(turn)[0]) @ position
    pixels = cv2.projectPoints(points_seen, turn, shift, _matrix(camera), np.array(camera.distortion))[0]
    return np.asarray(pixels, dtype=np.float64)[:, 0]


def jacobians(camera: Camera, pixels: Array, depths: Array) -> Array:
    """d(x, y) / d(u, v, depth), (n, 2, 3)."""
    away = np.where(depths > 0, 1.0, -1.0)
    around_px, around_m = pixels[:, None] + _STEPS_PX, depths[:, None] + away[:, None] * _STEPS_M
    around = pool_points(camera, around_px.reshape(-1, 2), around_m.ravel()).reshape(-1, 6, 2)
    by_u, by_v = (around[:, 0] - around[:, 1]) / (2 * _HALF_PX), (around[:, 2] - around[:, 3]) / (2 * _HALF_PX)
    return np.stack([by_u, by_v, (around[:, 5] - around[:, 4]) * away[:, None]], axis=-1)


def leaning(roll_rad: float, pitch_rad: float) -> Array:
    """Rotation matrix (3, 3) Ry(pitch) Rx(roll)."""
    turns = [np.array([roll_rad, 0.0, 0.0]), np.array([0.0, pitch_rad, 0.0])]
    about_x, about_y = (np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64) for turn in turns)
    return np.asarray(about_y @ about_x)


def marker_pose(camera: Camera, corners_px: Array, depth_m: float, tilt: Array, side_m: float) -> tuple[Array, Array]:
    """[x, y, yaw], and misfit and residual (2,), of corners (4, 2)."""
    half = side_m / 2.0
    body = np.array([[half, -half, 0.0], [half, half, 0.0], [-half, half, 0.0], [-half, -half, 0.0]])
    turned = body @ leaning(float(tilt[0]), float(tilt[1])).T
    flat = turned[:, :2]
    corners = pool_points(camera, corners_px, depth_m + turned[:, 2])
    centre = corners.mean(axis=0)
    offsets = corners - centre
    yaw = np.arctan2(np.sum(flat[:, 0] * offsets[:, 1] - flat[:, 1] * offsets[:, 0]), np.sum(flat * offsets))
    c, s = np.cos(yaw), np.sin(yaw)
    level = flat @ np.array([[c, s], [-s, c]])
    sized = level * np.sum(level * offsets) / np.sum(level**2)
    misfit = np.max(np.abs(offsets - level)) / side_m
    return np.append(centre, yaw), np.array([misfit, np.sqrt(np.sum((offsets - sized) ** 2) / 4.0)])


def kalman_predict(mean: Array, covariance: Array, step: float, acceleration: float, yaw: float) -> tuple[Array, Array]:
    """State after a step of constant velocity."""
    transition = np.eye(6)
    transition[[0, 1, 2], [3, 4, 5]] = step
    sigma = np.diag([acceleration, acceleration, yaw])
    gain = np.vstack([sigma * step**2 / 2.0, sigma * step])
    ahead = transition @ mean
    ahead[2] = wrap(float(ahead[2]))
    return ahead, transition @ covariance @ transition.T + gain @ gain.T


def kalman_update(mean: Array, covariance: Array, pose: Array, noise: Array) -> tuple[float, Array, Array]:
    """Squared Mahalanobis distance, and the state after the measurement, in Joseph's form."""
    difference = pose - mean[:3]
    difference[2] = wrap(float(difference[2]))
    spread = covariance[:3, :3] + noise
    gain = np.linalg.solve(spread, covariance[:3, :]).T
    after = mean + gain @ difference
    after[2] = wrap(float(after[2]))
    keep = np.eye(6)
    keep[:, :3] -= gain
    squared = float(difference @ np.linalg.solve(spread, difference))
    return squared, after, keep @ covariance @ keep.T + gain @ noise @ gain.T


def sample_colours(picture: Array, points: Array, to_px: Array, left: float, top: float) -> Array:
    """Bilinear samples (3, n) of a picture (height, width, 3) whose edge goes on for ever."""
    x, y = to_px @ points + np.array([[left], [top]])
    height, width = picture.shape[:2]
    x0, y0 = np.floor(x), np.floor(y)
    total = np.zeros((points.shape[1], 3))
    for right in (0, 1):
        for below in (0, 1):
            columns = np.clip(x0 + right, 0, width - 1).astype(int)
            rows = np.clip(y0 + below, 0, height - 1).astype(int)
            share = (x - x0 if right else 1 - x + x0) * (y - y0 if below else 1 - y + y0)
            total += share[:, None] * picture[rows, columns]
    return total.T

"""Compiled geometry of a frame: pixels and pool, marker corners to pose, covariance, gate and Kalman update, patch sampling.

`camera` (22,) of every kernel: fx, fy, cx, cy [px]; k1, k2, p1, p2, k3 of OpenCV's lens model; position (3,) in the pool [m];
the rotation from pool to camera, row by row (9,); the refractive index of water. Pool frame: z down, surface at z = 0. Poses
are [x, y, yaw] in m and rad.
"""

import math

import numpy as np

from shoal.kernels.decorator import kernel
from shoal.kernels.types import Cube, Floats, Image, SingleTable, Table

_UNDISTORT_ROUNDS = 50  # most rounds of the fixed-point iteration; a wide lens takes 25
_UNDISTORT_STEP = 1e-13  # tangent of the angle off the axis, step at which it ends: 1e-10 px
_NEWTON_STEPS = 6  # from a paraxial start; with six, round trips agree to 1e-11 px over the whole picture
_DIFFERENCE_PX = 0.5  # px, step of central differences; their error is below 1e-8 (relative) for any usable lens
_TURN = 2.0 * math.pi


@kernel(part=True)
def wrapped(angle: float) -> float:
    """An angle [rad] in [-pi, pi)."""
    rest: float = np.fmod(angle, _TURN)
    if rest >= math.pi:
        return rest - _TURN
    if rest < -math.pi:
        return rest + _TURN
    return rest


@kernel(part=True)
def pool_point(camera: Floats, u: float, v: float, depth: float) -> tuple[float, float]:
    """Pool x, y [m] of pixel u, v at a depth [m]: undistorted ray, surface, Snell's law; above the water straight."""
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    k1, k2, p1, p2, k3 = camera[4], camera[5], camera[6], camera[7], camera[8]
    distorted_x = (u - cx) / fx
    distorted_y = (v - cy) / fy
    x = distorted_x
    y = distorted_y
    for _ in range(_UNDISTORT_ROUNDS):
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        next_x = (distorted_x - 2.0 * p1 * x * y - p2 * (r2 + 2.0 * x * x)) / radial
        next_y = (distorted_y - p1 * (r2 + 2.0 * y * y) - 2.0 * p2 * x * y) / radial
        step = abs(next_x - x) + abs(next_y - y)
        x = next_x
        y = next_y
        if step < _UNDISTORT_STEP:
            break
    ray_x = camera[12] * x + camera[15] * y + camera[18]
    ray_y = camera[13] * x + camera[16] * y + camera[19]
    ray_z = camera[14] * x + camera[17] * y + camera[20]
    height = -camera[11]
    surface_x = camera[9] + height * ray_x / ray_z
    surface_y = camera[10] + height * ray_y / ray_z
    if depth > 0.0:
        per_n = 1.0 / (camera[21] * math.sqrt(ray_x * ray_x + ray_y * ray_y + ray_z * ray_z))
        sine_x = ray_x * per_n  # Snell: the horizontal part of the unit ray shrinks by n
        sine_y = ray_y * per_n
        cosine = math.sqrt(1.0 - sine_x * sine_x - sine_y * sine_y)
        return surface_x + depth * sine_x / cosine, surface_y + depth * sine_y / cosine
    return surface_x + depth * ray_x / ray_z, surface_y + depth * ray_y / ray_z


@kernel(part=True)
def pixel_of(camera: Floats, x: float, y: float, z: float) -> tuple[float, float]:
    """Pixel u, v of a pool point [m]; NaN of one that does not lie before the lens, whose pixel would be a mirrored one.

    Under water, Newton on g(r) = r + depth tan(water angle at r) - reach, with r the horizontal distance from the camera's
    foot to the point on the surface. The tangent, by Snell r / sqrt(n^2 (r^2 + h^2) - r^2), stays well-behaved down to depth
    0, where sines of the water angle would divide zero by zero.
    """
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    k1, k2, p1, p2, k3 = camera[4], camera[5], camera[6], camera[7], camera[8]
    camera_x, camera_y, camera_z = camera[9], camera[10], camera[11]
    seen_x = x - camera_x
    seen_y = y - camera_y
    seen_z = z - camera_z
    if z > 0.0:
        height = -camera_z
        n = camera[21]
        reach = math.sqrt(seen_x * seen_x + seen_y * seen_y)
        r = reach * height / (height + z / n)
        for _ in range(_NEWTON_STEPS):
            root = math.sqrt(n * n * (r * r + height * height) - r * r)
            r = r - (r + z * r / root - reach) / (1.0 + z * (n * height) ** 2 / root**3)
        fraction = r / reach if reach > 0.0 else 1.0
        seen_x *= fraction
        seen_y *= fraction
        seen_z = height
    across = camera[12] * seen_x + camera[13] * seen_y + camera[14] * seen_z
    down = camera[15] * seen_x + camera[16] * seen_y + camera[17] * seen_z
    along = camera[18] * seen_x + camera[19] * seen_y + camera[20] * seen_z
    if not along > 0.0:
        return math.nan, math.nan
    a = across / along
    b = down / along
    r2 = a * a + b * b
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    distorted_a = a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a)
    distorted_b = b * radial + p1 * (r2 + 2.0 * b * b) + 2.0 * p2 * a * b
    return fx * distorted_a + cx, fy * distorted_b + cy


@kernel
def pool_points(camera: Floats, pixels: Table, depths: Floats, places: Table) -> None:
    """Pool `places` (n, 2) [m] of `pixels` (n, 2) at `depths` (n,) [m]."""
    for i in range(len(pixels)):
        places[i, 0], places[i, 1] = pool_point(camera, pixels[i, 0], pixels[i, 1], depths[i])


@kernel
def pixels_of(camera: Floats, points: Table, pixels: Table) -> None:
    """`pixels` (n, 2) of pool `points` (n, 3) [m]."""
    for i in range(len(points)):
        pixels[i, 0], pixels[i, 1] = pixel_of(camera, points[i, 0], points[i, 1], points[i, 2])


@kernel
def jacobians(camera: Floats, pixels: Table, depths: Floats, slopes: Cube) -> None:
    """`slopes` (n, 2, 3) = d(x, y) / d(u, v, depth) [m/px, m/px, m/m] at `pixels` (n, 2) and `depths` (n,) [m].

    x and y are linear in depth on either side of the surface, so that any step away from it is exact.
    """
    h = _DIFFERENCE_PX
    for i in range(len(pixels)):
        u = pixels[i, 0]
        v = pixels[i, 1]
        z = depths[i]
        away = 1.0 if z > 0.0 else -1.0
        x, y = pool_point(camera, u, v, z)
        right_x, right_y = pool_point(camera, u + h, v, z)
        left_x, left_y = pool_point(camera, u - h, v, z)
        below_x, below_y = pool_point(camera, u, v + h, z)
        above_x, above_y = pool_point(camera, u, v - h, z)
        deep_x, deep_y = pool_point(camera, u, v, z + away)
        slopes[i, 0, 0] = (right_x - left_x) / (2.0 * h)
        slopes[i, 1, 0] = (right_y - left_y) / (2.0 * h)
        slopes[i, 0, 1] = (below_x - above_x) / (2.0 * h)
        slopes[i, 1, 1] = (below_y - above_y) / (2.0 * h)
        slopes[i, 0, 2] = (deep_x - x) * away
        slopes[i, 1, 2] = (deep_y - y) * away


@kernel
def marker_poses(
    camera: Floats, corners: Cube, depths: Floats, tilts: Table, side: float, poses: Table, misfits: Table
) -> None:
    """Squares of `side` [m] fitted by least squares to `corners` (n, 4, 2) [px] of plates at `depths` (n,) [m], in the pool.

    Corners are in ArUco's order, the first ahead to port. `tilts` (n, 2) are roll and pitch of the plates: a corner (a, b)
    ahead and to starboard is at (a cos p + b sin r sin p, b cos r) on level axes, and deeper by b sin r cos p - a sin p.
    `poses` (n, 3) of the plates' middles; `misfits` (n, 2): largest error of a coordinate of a corner over the side, and the
    root of the mean squared error of the corners' coordinates [m] that is left when the size is free.
    """
    half = side / 2.0
    points_m = np.empty((4, 2))
    flat = np.empty((4, 2))
    for i in range(len(corners)):
        sr = math.sin(tilts[i, 0])
        cr = math.cos(tilts[i, 0])
        sp = math.sin(tilts[i, 1])
        cp = math.cos(tilts[i, 1])
        x = 0.0
        y = 0.0
        for k in range(4):
            a = half if k < 2 else -half
            b = half if k == 1 or k == 2 else -half
            flat[k, 0] = a * cp + b * sr * sp
            flat[k, 1] = b * cr
            deeper = b * sr * cp - a * sp
            points_m[k, 0], points_m[k, 1] = pool_point(camera, corners[i, k, 0], corners[i, k, 1], depths[i] + deeper)
            x += points_m[k, 0] / 4.0
            y += points_m[k, 1] / 4.0
        along = 0.0
        across = 0.0
        size = 0.0
        squares = 0.0
        for k in range(4):
            dx = points_m[k, 0] - x
            dy = points_m[k, 1] - y
            along += flat[k, 0] * dx + flat[k, 1] * dy
            across += flat[k, 0] * dy - flat[k, 1] * dx
            size += flat[k, 0] * flat[k, 0] + flat[k, 1] * flat[k, 1]
            squares += dx * dx + dy * dy
        yaw = math.atan2(across, along)
        c = math.cos(yaw)
        s = math.sin(yaw)
        misfit = 0.0
        for k in range(4):
            misfit = max(misfit, abs(points_m[k, 0] - x - c * flat[k, 0] + s * flat[k, 1]))
            misfit = max(misfit, abs(points_m[k, 1] - y - s * flat[k, 0] - c * flat[k, 1]))
        poses[i, 0] = x
        poses[i, 1] = y
        poses[i, 2] = yaw
        misfits[i, 0] = misfit / side
        misfits[i, 1] = math.sqrt(max(squares - (along * along + across * across) / size, 0.0) / 4.0)


@kernel
def measurement_covariance(
    slopes: Table, mapping: Table, sigma_px: float, sigma_depth: float, extra_m2: float, yaw_rad2: float, covariance: Table
) -> None:
    """`covariance` (3, 3) = mapping + [J diag(sigma_px, sigma_px, sigma_depth)^2 J^T + extra_m2 I, 0; 0, yaw_rad2].

    J is `slopes` (2, 3) as in `jacobians`; `mapping` (3, 3) is the part of the camera's pose.
    """
    for i in range(3):
        for j in range(3):
            covariance[i, j] = mapping[i, j]
    for i in range(2):
        for j in range(2):
            by_pixel = slopes[i, 0] * slopes[j, 0] + slopes[i, 1] * slopes[j, 1]
            covariance[i, j] += by_pixel * sigma_px**2 + slopes[i, 2] * slopes[j, 2] * sigma_depth**2
        covariance[i, i] += extra_m2
    covariance[2, 2] += yaw_rad2


@kernel
def kalman_predict(
    mean: Floats,
    covariance: Table,
    step: float,
    acceleration: float,
    yaw_acceleration: float,
    next_mean: Floats,
    next_covariance: Table,
) -> None:
    """One step [s] of constant velocity: x' = F x, P' = F P F^T + G diag(sigma^2) G^T, F = [I, step I; 0, I],
    G = [step^2 / 2 I; step I], with standard deviations of acceleration [m/s^2, rad/s^2]. `mean` (6,), `covariance` (6, 6)."""
    for i in range(3):
        next_mean[i] = mean[i] + step * mean[i + 3]
        next_mean[i + 3] = mean[i + 3]
        for j in range(3):
            pv = covariance[i, j + 3]
            vp = covariance[i + 3, j]
            vv = covariance[i + 3, j + 3]
            next_covariance[i, j] = covariance[i, j] + step * (pv + vp) + step * step * vv
            next_covariance[i, j + 3] = pv + step * vv
            next_covariance[i + 3, j] = vp + step * vv
            next_covariance[i + 3, j + 3] = vv
        sigma = yaw_acceleration if i == 2 else acceleration
        moved = sigma * step * step / 2.0
        sped = sigma * step
        next_covariance[i, i] += moved * moved
        next_covariance[i, i + 3] += moved * sped
        next_covariance[i + 3, i] += moved * sped
        next_covariance[i + 3, i + 3] += sped * sped
    next_mean[2] = wrapped(next_mean[2])


@kernel
def kalman_update(
    mean: Floats, covariance: Table, pose: Floats, noise: Table, next_mean: Floats, next_covariance: Table
) -> float:
    """Squared Mahalanobis distance d^T S^-1 d of a measured `pose` (3,) of covariance `noise` R (3, 3); the state after it.

    d = pose - H x, H = [I, 0]; S = H P H^T + R = L D L^T, L with a unit diagonal; Y = P H^T L^-T; w = L^-1 d:
    x' = x + Y D^-1 w; P' = P - Y D^-1 Y^T, symmetric to the last bit. Squared distance: w^T D^-1 w.
    """
    d0 = covariance[0, 0] + noise[0, 0]
    l10 = (covariance[1, 0] + noise[1, 0]) / d0
    l20 = (covariance[2, 0] + noise[2, 0]) / d0
    d1 = covariance[1, 1] + noise[1, 1] - l10 * l10 * d0
    l21 = (covariance[2, 1] + noise[2, 1] - l20 * l10 * d0) / d1
    d2 = covariance[2, 2] + noise[2, 2] - l20 * l20 * d0 - l21 * l21 * d1
    w0 = pose[0] - mean[0]
    w1 = pose[1] - mean[1] - l10 * w0
    w2 = wrapped(pose[2] - mean[2]) - l20 * w0 - l21 * w1
    y = np.empty((6, 3))
    for i in range(6):
        y[i, 0] = covariance[i, 0]
        y[i, 1] = covariance[i, 1] - l10 * y[i, 0]
        y[i, 2] = covariance[i, 2] - l20 * y[i, 0] - l21 * y[i, 1]
        next_mean[i] = mean[i] + y[i, 0] * w0 / d0 + y[i, 1] * w1 / d1 + y[i, 2] * w2 / d2
        for j in range(i + 1):
            removed = y[i, 0] * y[j, 0] / d0 + y[i, 1] * y[j, 1] / d1 + y[i, 2] * y[j, 2] / d2
            next_covariance[i, j] = covariance[i, j] - removed
            next_covariance[j, i] = next_covariance[i, j]
    next_mean[2] = wrapped(next_mean[2])
    squared: float = w0 * w0 / d0 + w1 * w1 / d1 + w2 * w2 / d2
    return squared


@kernel
def sample_colours(picture: Image, points: Table, to_px: Table, left: float, top: float, samples: SingleTable) -> None:
    """`samples` (3, n) of a `picture` (height, width, 3), bilinear, at to_px (2, 3) [px/m] times body `points` (3, n) [m] plus
    (left, top) [px]. Beyond its border the picture goes on with the pixels of its edge."""
    height, width = picture.shape[0], picture.shape[1]
    for i in range(points.shape[1]):
        x = left + to_px[0, 0] * points[0, i] + to_px[0, 1] * points[1, i] + to_px[0, 2] * points[2, i]
        y = top + to_px[1, 0] * points[0, i] + to_px[1, 1] * points[1, i] + to_px[1, 2] * points[2, i]
        x = min(x, width - 1.0) if x > 0.0 else 0.0  # 0 for NaN too
        y = min(y, height - 1.0) if y > 0.0 else 0.0
        column = min(int(x), width - 2)
        row = min(int(y), height - 2)
        along = x - column
        down = y - row
        for k in range(3):
            upper = picture[row, column, k] * (1.0 - along) + picture[row, column + 1, k] * along
            lower = picture[row + 1, column, k] * (1.0 - along) + picture[row + 1, column + 1, k] * along
            samples[k, i] = upper * (1.0 - down) + lower * down

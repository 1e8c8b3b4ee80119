"""Frames and angles.

Pool frame: origin on the water surface at the red mark, x along the pool, y across it, z down (depth, positive under
water). Right-handed, so a heading is positive from x to y: clockwise for someone looking down at the water.
Body frame: x ahead, y to starboard, z down; it shares z with the pool frame (roll and pitch are the plant's business).

`eta = [x_m, y_m, z_m, yaw_rad]` is a pose in the pool frame, `nu = [surge, sway, heave, yaw rate]` a velocity in the body
frame. Functions take and return float64 arrays and work on any leading shape.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

TURN = 2.0 * math.pi
# How far a pose may be from where the velocities before and after it lead, per second of sampling period: m/s and rad/s. At
# 0.05 s that is 1 mm and 0.025 rad; the shipped experiments' smooth paths need 0.3 um and 0.2 mrad.
DRIFT = np.array([0.02, 0.02, 0.02, 0.5])


def wrap_angle(angle_rad: ArrayLike) -> Array:
    """Angle(s) in rad, wrapped to [-pi, pi). What lies there already comes back unchanged, to the last bit."""
    rest = np.fmod(np.asarray(angle_rad, dtype=np.float64), TURN)  # exact; the turn added below is exact too
    return np.asarray(np.where(rest >= np.pi, rest - TURN, np.where(rest < -np.pi, rest + TURN, rest)))


def wrap(angle_rad: float) -> float:
    """One angle in rad, wrapped to [-pi, pi), bit for bit as `wrap_angle` does it; NaN for what is not finite."""
    if not math.isfinite(angle_rad):
        return math.nan
    rest = math.fmod(angle_rad, TURN)
    return rest - TURN if rest >= math.pi else rest + TURN if rest < -math.pi else rest


def pose_error(eta: ArrayLike, eta_reference: ArrayLike) -> Array:
    """`eta - eta_reference` for poses of shape (..., 4), yaw wrapped (ambiguity A7)."""
    error = np.array(np.asarray(eta, dtype=np.float64) - np.asarray(eta_reference, dtype=np.float64))
    error[..., 3] = wrap_angle(error[..., 3])
    return error


def body_to_pool(vector_body: ArrayLike, yaw_rad: ArrayLike) -> Array:
    """Turn horizontal vectors (..., 2) from the body frame into the pool frame."""
    v = np.asarray(vector_body, dtype=np.float64)
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]], axis=-1)


def pool_to_body(vector_pool: ArrayLike, yaw_rad: ArrayLike) -> Array:
    """Turn horizontal vectors (..., 2) from the pool frame into the body frame."""
    return body_to_pool(vector_pool, -np.asarray(yaw_rad, dtype=np.float64))


def follows_velocity(eta: Array, velocity: Array, period_s: float) -> NDArray[np.bool_]:
    """True (n - 1, 4) where a motion's pose (n, 4) leads to the next as its velocities say, by the trapezoidal rule. Where a
    velocity leaps, the pose may lie anywhere between the results of the two velocities."""
    off = np.abs(np.diff(eta, axis=0) - 0.5 * period_s * (velocity[1:] + velocity[:-1]))
    return np.asarray(off <= period_s * (0.5 * np.abs(np.diff(velocity, axis=0)) + DRIFT))

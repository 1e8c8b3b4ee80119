"""Inputs of a feedback law: errors along the three axes that the robot can push, and the model's terms for them.

The robot has no side force. The reference heading turns lateral errors into heading, for every law alike. Left to the law is
the error along the robot's own x axis, in depth and in heading. With the reference p moving at p', body axes i (ahead), j
(aside):

    e = i . (p - position)    e' = V - u + r s    V = i . p'    s = j . (p - position)    s' = W - v - r e    W = j . p'

Velocities are through the water, the reference's too: in an even current nothing else changes.

r s only moves the error from one axis to the other: it drops out of (e^2 + s^2)' = 2 e (V - u) + 2 s (W - v). Laws that push
against it (with e' in the place of V - u) made robots 0.1 m off the path of `pool` shake themselves away from it.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from robot_agent.vehicle.dynamics import Model, State
from shoal.frames import wrap

PerAxis = tuple[float, float, float]  # surge, heave, yaw


class TrackingErrors(NamedTuple):
    """Errors, reference minus robot, and model terms. Units m, s, N; rad and N m for yaw."""

    error: PerAxis
    speed_error: PerAxis  # V - u, and the same in depth and heading, where it is the error's derivative
    swing_mps: float  # r s
    velocity: PerAxis  # u, w, r
    acceleration: PerAxis  # of the velocity at which the speed error is zero: V', and the same in depth and heading
    load: PerAxis  # wrench at which the velocity stays as it is: drag, Coriolis force, disturbance
    thrust: PerAxis  # that acts now


def tracking_errors(
    model: Model,
    state: State,
    disturbance: Sequence[float],
    goal: Sequence[float],
    speed: Sequence[float],
    change: Sequence[float],
) -> TrackingErrors:
    """Compute the errors. `goal`, `speed` and `change` (4,) are the reference's pose, velocity and acceleration; Gamma (4,) is
    the estimator's."""
    x, y, z, yaw, u, v, w, r, surge_n, heave_n, yaw_nm, *_ = state
    goal_x, goal_y, goal_z, goal_yaw = goal
    x_mps, y_mps, z_mps, yaw_radps = speed
    x_mps2, y_mps2, z_mps2, yaw_radps2 = change
    c, s = math.cos(yaw), math.sin(yaw)
    away_x, away_y = goal_x - x, goal_y - y
    along_mps, across_mps = c * x_mps + s * y_mps, c * y_mps - s * x_mps  # the reference's velocity on the robot's axes
    return TrackingErrors(
        error=(c * away_x + s * away_y, goal_z - z, wrap(goal_yaw - yaw)),
        speed_error=(along_mps - u, z_mps - w, yaw_radps - r),
        swing_mps=r * (c * away_y - s * away_x),
        velocity=(u, w, r),
        acceleration=(c * x_mps2 + s * y_mps2 + r * across_mps, z_mps2, yaw_radps2),
        load=_load(model, (u, v, w, r), disturbance),
        thrust=(surge_n, heave_n, yaw_nm),
    )


def _load(model: Model, nu: Sequence[float], disturbance: Sequence[float]) -> PerAxis:
    """Solve the model's equations (dynamics.py) for the wrench at constant velocity."""
    u, v, w, r = nu
    mass_u, _, mass_w, mass_r = model.mass
    linear_u, _, linear_w, linear_r = model.linear
    quadratic_u, _, quadratic_w, quadratic_r = model.quadratic
    return (
        (linear_u + quadratic_u * math.hypot(u, v)) * u - mass_u * (model.coriolis * v * r + disturbance[0]),
        (linear_w + quadratic_w * abs(w)) * w - mass_w * disturbance[2],
        (linear_r + quadratic_r * abs(r)) * r - mass_r * disturbance[3],
    )


class Axes:
    """Mass and limits of the three axes."""

    def __init__(self, model: Model, limit: PerAxis) -> None:
        self.mass: PerAxis = (model.mass[0], model.mass[2], model.mass[3])
        self.limit = limit

    def wrench(self, now: TrackingErrors, feedback: Sequence[float]) -> PerAxis:
        """Inverse dynamics: the wrench at which the speed errors fall by `feedback` (3,), m/s^2 and rad/s^2."""
        surge, heave, yaw = (
            mass * (acceleration + more) + load
            for mass, acceleration, more, load in zip(self.mass, now.acceleration, feedback, now.load, strict=True)
        )
        return surge, heave, yaw

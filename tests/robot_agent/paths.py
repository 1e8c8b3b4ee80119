"""Paths for the tests of guidance and control."""

import numpy as np

from shoal.messages.messages import Trajectory

PERIOD_S, ROWS = 0.05, 52


def circle(radius_m: float, lap_s: float, period_s: float = PERIOD_S, laps: float = 2.5) -> Trajectory:
    rate = 2 * np.pi / lap_s
    t = np.arange(0.0, laps * lap_s, period_s)
    c, s, zero = np.cos(rate * t), np.sin(rate * t), np.zeros_like(t)
    eta = np.stack([radius_m * c, radius_m * s, zero + 0.3, rate * t + np.pi / 2], axis=1)
    velocity = np.stack([-radius_m * rate * s, radius_m * rate * c, zero, zero + rate], axis=1)
    acceleration = np.stack([-radius_m * rate**2 * c, -radius_m * rate**2 * s, zero, zero], axis=1)
    return Trajectory("circle", period_s, eta, velocity, acceleration)

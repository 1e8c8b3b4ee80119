"""Adaptive neural network: radial basis functions learn in flight the wrench that the motion needs (Lewis, Yesildirek and Liu
1996; Ge, Hang, Lee and Zhang 2001). It uses no model and no disturbance estimate, per axis:

    s = e' + lambda e          wrench = gain s + W' phi(velocity, a)          a = reference acceleration + lambda e'
    W' = learning (phi s - forget |s| W)          V = (m s^2 + |W - W*|^2 / learning) / 2

The network starts from zero. On an axis at a limit it does not learn from the part beyond the limit.
"""

import numpy as np

from robot_agent.control.baselines.tracking_errors import Axes, PerAxis, TrackingErrors
from shoal.config.baseline_controllers import AdaptiveNnConfig
from shoal.frames import Array

SPEEDS, ACCELERATIONS = np.linspace(-1.0, 1.0, 7), np.linspace(-1.0, 1.0, 3)  # centres, as shares of the largest
FORGET = 0.02  # e-modification: keeps weights from drifting off while s is small but never zero


class AdaptiveNn:
    """The law; its weights (3, 21), in N and N m, are its memory."""

    def __init__(self, axes: Axes, config: AdaptiveNnConfig, fastest: PerAxis) -> None:
        self._slope, self._gain, self._learning = (np.array(v) for v in (config.slope_per_s, config.gain, config.learning))
        self._fastest, self._quickest = np.array(fastest), np.array(axes.limit) / np.array(axes.mass)
        self._weights = np.zeros((3, len(SPEEDS) * len(ACCELERATIONS)))

    def wrench(self, now: TrackingErrors) -> PerAxis:
        """See `FeedbackLaw`."""
        surface, basis = self._look(now)
        surge, heave, yaw = (self._gain * surface + (self._weights * basis).sum(axis=1)).tolist()
        return surge, heave, yaw

    def learn(self, now: TrackingErrors, short: PerAxis, period_s: float) -> None:
        """See `FeedbackLaw`."""
        surface, basis = self._look(now)
        learning = np.where(np.array(short) * surface <= 0.0, period_s * self._learning, 0.0)[:, None]
        # Implicit in what is forgotten, so that no gain is too large for the step
        size = np.abs(surface)[:, None]
        self._weights = (self._weights + learning * surface[:, None] * basis) / (1.0 + FORGET * learning * size)

    def reset(self) -> None:
        """See `FeedbackLaw`."""
        self._weights = np.zeros_like(self._weights)

    def _look(self, now: TrackingErrors) -> tuple[Array, Array]:
        """Return s (3,) and the basis functions (3, 21), which add up to one."""
        rate = np.array(now.speed_error)
        surface = rate + self._slope * now.error
        motion = np.array(now.velocity) / self._fastest
        push = (np.array(now.acceleration) + self._slope * rate) / self._quickest
        basis = np.multiply(_bells(motion, SPEEDS)[:, :, None], _bells(push, ACCELERATIONS)[:, None, :])
        return surface, basis.reshape(3, -1)


def _bells(values: Array, centres: Array) -> Array:
    """Normalised Gaussians (n, centres) of values (n,), as wide as the distance between centres."""
    away = (np.clip(values, -1.0, 1.0)[:, None] - centres) / (centres[1] - centres[0])
    bells = np.exp(-0.5 * away * away)
    return np.asarray(bells / bells.sum(axis=1, keepdims=True))

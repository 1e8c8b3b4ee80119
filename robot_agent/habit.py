"""How a number has gone with others so far, and how far it may go from that. Pure.

Recursive least squares for y = theta . x + noise, with a prior: theta is about zero, each part within its spread. What is
known of theta fades back to that in FADES_S. The noise is learned, too: in rough water little is known of theta for longer.
Samples count when they are a second old, as in unusual.py.
"""

import math
from collections import deque
from collections.abc import Sequence

import numpy as np

from robot_agent.unusual import YOUNG_NS
from wire.frames import Array

FADES_S = 300.0
NOISE_S = 10.0  # how fast the noise is learned


class Habit:
    """One number y that goes with others, x."""

    def __init__(self, spread: Sequence[float], noise: float, least_noise: float, smooth_s: float) -> None:
        """`spread` (k,): standard deviations of theta before anything is known; `noise`: of y, at first and at least. Samples
        within `smooth_s` of each other say the same."""
        self._prior = np.diag(np.square(spread))
        self._theta, self._covariance = np.zeros(len(spread)), self._prior
        self._variance, self._least_variance, self._smooth_s = noise**2, least_noise**2, smooth_s
        self._young: deque[tuple[int, float, Array, float]] = deque()  # instant, seconds, x, y

    def expect(self, x: Array) -> tuple[float, float]:
        """What y goes with x (k,), and the standard deviation of that for want of knowledge, without the noise."""
        return float(self._theta @ x), math.sqrt(x @ self._covariance @ x)

    def note(self, x: Array, y: float, elapsed_s: float, at_ns: int) -> None:
        """y came with x (k,) at an instant, `elapsed_s` after the last."""
        self._young.append((at_ns, elapsed_s, x, y))
        while self._young[0][0] <= at_ns - YOUNG_NS:
            _, seconds, x, y = self._young.popleft()
            self._learn(x, y, seconds)

    def _learn(self, x: Array, y: float, seconds: float) -> None:
        missed = y - float(self._theta @ x)  # at first for want of knowledge, but taken for noise: rather too slow than sure
        self._variance += -math.expm1(-seconds / NOISE_S) * (max(missed**2, self._least_variance) - self._variance)
        known = self._covariance + -math.expm1(-seconds / FADES_S) * (self._prior - self._covariance)
        toward = known @ x
        gain = toward / (float(x @ toward) + self._variance * self._smooth_s / seconds)
        self._theta = self._theta + gain * missed
        self._covariance = known - np.outer(gain, toward)

"""Fuzzy control without a model: rules on error and velocity error (Mac Vicar-Whelan's table), and an integral of their output
(fuzzy PID, Woo, Chung and Lin 2000), per axis.

Five triangular sets per input, products for "and", singletons weighted by the truth of their rules for the output.
"""

from bisect import bisect_right

from robot_agent.control.baselines.tracking_errors import Axes, PerAxis, TrackingErrors
from shoal.config.baseline_controllers import FuzzyConfig

PEAKS = (-1.0, -0.4, 0.0, 0.4, 1.0)  # negative big, negative small, zero, positive small, positive big: inputs and outputs
# If the error is ROW and the velocity error is COLUMN, both from negative big to positive big, push by the singleton PEAKS[.].
RULES = ((0, 0, 0, 1, 2), (0, 0, 1, 2, 3), (0, 1, 2, 3, 4), (1, 2, 3, 4, 4), (2, 3, 4, 4, 4))


class Fuzzy:
    """The law; its integrals, as shares of the limits, are its memory."""

    def __init__(self, axes: Axes, config: FuzzyConfig) -> None:
        self._limit = axes.limit
        self._scales = tuple(zip(config.error, config.velocity, strict=True))
        self._proportional, self._rate = config.proportional, config.integral
        self._integral = [0.0, 0.0, 0.0]

    def wrench(self, now: TrackingErrors) -> PerAxis:
        """See `FeedbackLaw`."""
        surge, heave, yaw = (
            limit * (gain * output + integral)
            for limit, gain, output, integral in zip(
                self._limit, self._proportional, self._rule_outputs(now), self._integral, strict=True
            )
        )
        return surge, heave, yaw

    def learn(self, now: TrackingErrors, short: PerAxis, period_s: float) -> None:
        """See `FeedbackLaw`. Integrates the rules' output of each axis (shares of the limits, within +-1), but not while the
        axis is saturated in the output's direction: conditional integration, as in pid.py."""
        for axis, output in enumerate(self._rule_outputs(now)):
            if short[axis] * output <= 0.0:
                integral = self._integral[axis] + period_s * self._rate[axis] * output
                self._integral[axis] = min(max(integral, -1.0), 1.0)

    def reset(self) -> None:
        """See `FeedbackLaw`."""
        self._integral = [0.0, 0.0, 0.0]

    def _rule_outputs(self, now: TrackingErrors) -> list[float]:
        """Output of the rules for each axis, -1 to 1."""
        return [
            rule_output(e / big, rate / fast)
            for (big, fast), e, rate in zip(self._scales, now.error, now.speed_error, strict=True)
        ]


def rule_output(error: float, rate: float) -> float:
    """Output of all rules, -1 to 1, for an error and a velocity error in units of "big"."""
    row, high = _sets(error)
    column, fast = _sets(rate)
    near = (1.0 - fast) * PEAKS[RULES[row][column]] + fast * PEAKS[RULES[row][column + 1]]
    far = (1.0 - fast) * PEAKS[RULES[row + 1][column]] + fast * PEAKS[RULES[row + 1][column + 1]]
    return (1.0 - high) * near + high * far


def _sets(value: float) -> tuple[int, float]:
    """Fuzzify a value within -1 to 1: the index of the lower of the two sets that it belongs to, and its membership in the
    upper one. The two memberships add up to 1."""
    value = min(max(value, -1.0), 1.0)
    low = min(bisect_right(PEAKS, value), len(PEAKS) - 1) - 1
    return low, (value - PEAKS[low]) / (PEAKS[low + 1] - PEAKS[low])

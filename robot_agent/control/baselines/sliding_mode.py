"""Sliding mode with equivalent control and a boundary layer (Slotine and Li, Applied Nonlinear Control, 1991, chapter 7):

    s = e' + lambda e        wrench such that s' = -reach sat(s / layer)        sat(x) = x within -1..1, else its sign

A disturbance below `reach` cannot keep s out of the layer; a thin layer holds it closer, and chatters.
"""

from robot_agent.control.baselines.tracking_errors import Axes, PerAxis, TrackingErrors
from shoal.config.baseline_controllers import SlidingModeConfig


class SlidingMode:
    """The law, without memory: the disturbance is the estimator's, and the switching term takes its error."""

    def __init__(self, axes: Axes, config: SlidingModeConfig) -> None:
        self._axes = axes
        self._gains = tuple(zip(config.slope_per_s, config.reach, config.layer, strict=True))

    def wrench(self, now: TrackingErrors) -> PerAxis:
        """See `FeedbackLaw`."""
        feedback = [
            slope * rate + reach * min(max((rate + slope * e) / layer, -1.0), 1.0)
            for (slope, reach, layer), e, rate in zip(self._gains, now.error, now.speed_error, strict=True)
        ]
        return self._axes.wrench(now, feedback)

    def learn(self, now: TrackingErrors, short: PerAxis, period_s: float) -> None:
        """See `FeedbackLaw`."""

    def reset(self) -> None:
        """See `FeedbackLaw`."""

"""Backstepping, the article's comparison (Krstic, Kanellakopoulos, Kokotovic 1995, chapter 2), per axis:

    z1 = e        alpha = V + k1 z1, the velocity that makes it decay        z2 = alpha - velocity
    wrench such that velocity' = alpha' + c z1 + k2 z2              L = (c z1^2 + z2^2) / 2 falls: L' = -c k1 z1^2 - k2 z2^2

In surge L has c s^2 / 2 more, and L' has c s (W - v), which guidance makes negative: its heading is where W - v opposes s.
"""

from robot_agent.control.baselines.tracking_errors import Axes, PerAxis, TrackingErrors
from shoal.config.baseline_controllers import BacksteppingConfig


class Backstepping:
    """The law, without memory: the disturbance is the estimator's."""

    def __init__(self, axes: Axes, config: BacksteppingConfig) -> None:
        self._axes = axes
        self._gains = tuple(zip(config.error_per_s, config.velocity_per_s, config.coupling_per_s2, strict=True))

    def wrench(self, now: TrackingErrors) -> PerAxis:
        """See `FeedbackLaw`."""
        swing = (now.swing_mps, 0.0, 0.0)
        feedback = [
            k1 * (rate + swung) + c * e + k2 * (rate + k1 * e)
            for (k1, k2, c), e, rate, swung in zip(self._gains, now.error, now.speed_error, swing, strict=True)
        ]
        return self._axes.wrench(now, feedback)

    def learn(self, now: TrackingErrors, short: PerAxis, period_s: float) -> None:
        """See `FeedbackLaw`."""

    def reset(self) -> None:
        """See `FeedbackLaw`."""

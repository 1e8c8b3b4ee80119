"""Three independent PID loops without a model: wrench = p e + i (integral of e) + d e'.

The integral stands still on an axis that is at a limit and would go further beyond it (conditional integration; Astrom and
Hagglund, PID Controllers, 1995, section 3.5). Otherwise it winds up for the ten seconds of a start at full thrust.
"""

from robot_agent.control.baselines.tracking_errors import Axes, PerAxis, TrackingErrors
from shoal.config.baseline_controllers import PidConfig


class Pid:
    """The law; its integrals, in N and N m, are its memory. They hold no more than the limit."""

    def __init__(self, axes: Axes, config: PidConfig) -> None:
        self._gains = tuple(zip(config.p, config.i, config.d, axes.limit, strict=True))
        self._integral = [0.0, 0.0, 0.0]

    def wrench(self, now: TrackingErrors) -> PerAxis:
        """See `FeedbackLaw`."""
        surge, heave, yaw = (
            p * e + held + d * rate
            for (p, _, d, _), e, rate, held in zip(self._gains, now.error, now.speed_error, self._integral, strict=True)
        )
        return surge, heave, yaw

    def learn(self, now: TrackingErrors, short: PerAxis, period_s: float) -> None:
        """See `FeedbackLaw`."""
        for axis, (_, i, _, limit) in enumerate(self._gains):
            if short[axis] * now.error[axis] <= 0.0:
                held = self._integral[axis] + period_s * i * now.error[axis]
                self._integral[axis] = min(max(held, -limit), limit)

    def reset(self) -> None:
        """See `FeedbackLaw`."""
        self._integral = [0.0, 0.0, 0.0]

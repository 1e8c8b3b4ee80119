"""Linear-quadratic regulator, discrete in time (Anderson and Moore, Optimal Control, 1990), per axis.

Inverse dynamics compensates the load and the reference's acceleration. What remains is a double integrator behind the
thrusters' lag T, x = [e, e', f], with f the thrust beyond that, and c the command beyond that:

    e'' = -f / m        T f' = c - f        c = -K x minimises   sum q_e e^2 + q_v e'^2 + (c / limit)^2
"""

import numpy as np
from scipy.linalg import expm, solve_discrete_are

from robot_agent.control.baselines.tracking_errors import Axes, PerAxis, TrackingErrors
from shoal.config.baseline_controllers import LqrConfig
from shoal.frames import Array

NOTHING: PerAxis = (0.0, 0.0, 0.0)


class Lqr:
    """The law, without memory: gains are computed once, the disturbance is the estimator's."""

    def __init__(self, axes: Axes, config: LqrConfig, lag_s: float, period_s: float) -> None:
        self._axes = axes
        self._lag = lag_s > 0.0
        self._gains = [
            gain(mass, lag_s, period_s, np.array([error, velocity]), 1.0 / limit**2).tolist()
            for mass, error, velocity, limit in zip(axes.mass, config.error, config.velocity, axes.limit, strict=True)
        ]

    def wrench(self, now: TrackingErrors) -> PerAxis:
        """See `FeedbackLaw`."""
        model_wrench = self._axes.wrench(now, NOTHING)
        wrench = []
        for axis, (by_error, by_rate, *by_thrust) in enumerate(self._gains):
            base = model_wrench[axis]
            command = base - by_error * now.error[axis] - by_rate * now.speed_error[axis]
            if self._lag:
                command -= by_thrust[0] * (now.thrust[axis] - base)
            wrench.append(command)
        surge, heave, yaw = wrench
        return surge, heave, yaw

    def learn(self, now: TrackingErrors, short: PerAxis, period_s: float) -> None:
        """See `FeedbackLaw`."""

    def reset(self) -> None:
        """See `FeedbackLaw`."""


def plant(mass: float, lag_s: float, period_s: float) -> tuple[Array, Array]:
    """A (n, n) and B (n, 1) of one axis for a command held over each period; n = 3, or 2 without lag."""
    flow = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, -1.0 / mass, 0.0], [0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    if lag_s > 0.0:
        flow[2, 2:] = -1.0 / lag_s, 1.0 / lag_s
        step = expm(flow * period_s)
        return step[:3, :3], step[:3, 3:]
    step = expm(flow[:3, :3] * period_s)
    return step[:2, :2], step[:2, 2:]


def gain(mass: float, lag_s: float, period_s: float, weights: Array, effort: float) -> Array:
    """K (n,) for weights (2,) of e and e', and `effort` of c."""
    a, b = plant(mass, lag_s, period_s)
    q = np.zeros_like(a)
    q[[0, 1], [0, 1]] = weights
    value = solve_discrete_are(a, b, q, np.array([[effort]]))
    return np.asarray(np.linalg.solve(effort + b.T @ value @ b, b.T @ value @ a), dtype=np.float64).ravel()

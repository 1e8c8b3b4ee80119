"""Settings of the control laws that the ESO-MPC is compared with. Lists are [surge, heave, yaw]: m, m and rad; N, N and N m.

All gains are the outcome of one search with the same budget for each law, for the shipped vehicle (docs/baselines.md);
`sim-bridge tune` repeats it for another.
"""

from typing import Literal

from wire.toml_file import Section
from wire.vehicle import NotNegative, Positive

Gains = tuple[NotNegative, NotNegative, NotNegative]
Scales = tuple[Positive, Positive, Positive]

LawName = Literal["eso-mpc", "backstepping", "pid", "lqr", "sliding-mode", "fuzzy", "adaptive-nn"]


class FeedbackLaw(Section):
    """What they have in common."""

    guidance_per_s2: NotNegative = 0.1  # in the place of guidance.position_gain_per_s2, which is set for the ESO-MPC


class Backstepping(FeedbackLaw):
    """How fast errors are to decay, then errors of the velocity that makes them decay, and what the one weighs in the
    Lyapunov function when the other weighs one."""

    error_per_s: Gains = (0.4, 0.4, 1.0)
    velocity_per_s: Gains = (1.0, 1.0, 2.0)
    coupling_per_s2: Gains = (0.2, 0.2, 1.0)


class Pid(FeedbackLaw):
    """One independent loop per axis."""

    p: Gains = (12.0, 12.0, 0.4)  # N/m, N/m, N m/rad
    i: Gains = (1.5, 1.5, 0.05)  # the same, per second
    d: Gains = (20.0, 20.0, 0.25)  # N s/m, N s/m, N m s/rad


class Lqr(FeedbackLaw):
    """Weights of squared errors and of squared velocity errors; that of the wrench is 1 / limit^2 (Bryson's rule)."""

    error: Gains = (4.0, 4.0, 4.0)
    velocity: Gains = (1.0, 1.0, 1.0)


class SlidingMode(FeedbackLaw):
    """s = velocity error + slope error. The switching term is `reach` m/s^2 strong, and linear for |s| < `layer` m/s."""

    slope_per_s: Gains = (0.8, 0.8, 1.5)
    reach: Gains = (0.3, 0.2, 2.0)
    layer: Scales = (0.15, 0.1, 0.5)


class Fuzzy(FeedbackLaw):
    """Errors and velocity errors that count as "big", and what the rules' verdict (-1 to 1) does, as a share of the limit: at
    once, and per second."""

    error: Scales = (0.5, 0.3, 0.8)
    velocity: Scales = (0.3, 0.2, 0.8)
    proportional: Gains = (1.5, 1.5, 1.5)
    integral: Gains = (0.3, 0.3, 0.3)


class AdaptiveNn(FeedbackLaw):
    """s = velocity error + slope error; wrench = gain s + network. The network learns `learning` N per m/s of s and second."""

    slope_per_s: Gains = (0.6, 0.6, 1.0)
    gain: Gains = (20.0, 20.0, 0.4)
    learning: Gains = (20.0, 20.0, 0.4)

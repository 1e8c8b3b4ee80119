"""Settings of the control laws that the MPC is compared with. Lists are [surge, heave, yaw]: m, m and rad; N, N and N m.

All gains are the outcome of one search with the same budget for each law, for the shipped vehicle (docs/baselines.md);
`sim-bridge tune` repeats it for another.
"""

import re
from typing import Annotated, Literal, get_args

from pydantic import AfterValidator, WithJsonSchema

from shoal.config.loader import Section
from shoal.config.vehicle import NotNegative, Positive

Gains = tuple[NotNegative, NotNegative, NotNegative]
Scales = tuple[Positive, Positive, Positive]

LawName = Literal["nmpc", "eso-mpc-article", "backstepping", "pid", "lqr", "sliding-mode", "fuzzy", "adaptive-nn"]
OWN_LAW = r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*"


def _known(name: str) -> str:
    """Check the name of a control law: a shipped one, or MODULE:NAME."""
    names = get_args(LawName)
    if name not in names and not re.fullmatch(OWN_LAW, name):
        raise ValueError(
            f"must be one of {', '.join(map(repr, names))}, or a law of your own: MODULE:NAME (docs/baselines.md)"
        )
    return name


Law = Annotated[
    str,
    AfterValidator(_known),
    WithJsonSchema({"anyOf": [{"enum": list(get_args(LawName))}, {"type": "string", "pattern": f"^{OWN_LAW}$"}]}),
]


class FeedbackLawConfig(Section):
    """Settings that all feedback laws have."""

    guidance_per_s2: NotNegative = 0.1
    """Correction by the reference heading, per position error."""


class BacksteppingConfig(FeedbackLawConfig):
    """Backstepping of position and velocity errors."""

    guidance_per_s2: NotNegative = 0.155
    error_per_s: Gains = (0.0576, 0.889, 3.87)
    """Decay rate of the errors."""
    velocity_per_s: Gains = (2.28, 0.394, 1.71)
    """Decay rate of the velocity errors."""
    coupling_per_s2: Gains = (0.645, 0.0355, 4.71)
    """Weight of the errors in the Lyapunov function; the velocity errors have 1."""


class PidConfig(FeedbackLawConfig):
    """One independent loop per axis."""

    guidance_per_s2: NotNegative = 0.256
    p: Gains = (15.9, 11.1, 0.787)
    """Proportional gain, N/m, N/m and N m/rad."""
    i: Gains = (4.41, 1.36, 0.0633)
    """Integral gain, the same per second."""
    d: Gains = (14.0, 3.58, 0.0978)
    """Derivative gain, N s/m, N s/m and N m s/rad."""


class LqrConfig(FeedbackLawConfig):
    """Weights of squared errors and of squared velocity errors; that of the wrench is 1 / limit^2 (Bryson's rule)."""

    guidance_per_s2: NotNegative = 0.132
    error: Gains = (5.38, 13.3, 8.87)
    """Weight of squared errors."""
    velocity: Gains = (27.8, 7.11, 0.277)
    """Weight of squared velocity errors."""


class SlidingModeConfig(FeedbackLawConfig):
    """s = velocity error + slope error. The switching term is `reach` m/s^2 strong, and linear for |s| < `layer` m/s."""

    guidance_per_s2: NotNegative = 0.0978
    slope_per_s: Gains = (0.67, 0.946, 1.49)
    """Slope of the sliding surface."""
    reach: Gains = (0.16, 0.0673, 0.872)
    """Strength of the switching term, m/s^2 and rad/s^2."""
    layer: Scales = (0.149, 0.0316, 0.071)
    """Boundary layer, m/s and rad/s."""


class FuzzyConfig(FeedbackLawConfig):
    """Rules on five sets of errors and velocity errors."""

    guidance_per_s2: NotNegative = 0.0935
    error: Scales = (0.981, 0.622, 0.324)
    """Error that is big, m and rad."""
    velocity: Scales = (0.308, 0.495, 0.616)
    """Velocity error that is big, m/s and rad/s."""
    proportional: Gains = (0.635, 3.69, 0.341)
    """Effect of the rules' output (-1 to 1) at once, as a share of the limit."""
    integral: Gains = (0.894, 1.66, 0.667)
    """The same per second."""


class AdaptiveNnConfig(FeedbackLawConfig):
    """s = velocity error + slope error; wrench = gain s + network."""

    slope_per_s: Gains = (0.685, 0.953, 5.91)
    """Slope in s."""
    gain: Gains = (27.7, 40.0, 0.128)
    """Gain of s, N per m/s and N m per rad/s."""
    learning: Gains = (15.5, 43.4, 1.89)
    """Rate of learning, N per m/s of s and second."""

"""Settings of the control laws that the ESO-MPC is compared with. Lists are [surge, heave, yaw]: m, m and rad; N, N and N m.

All gains are the outcome of one search with the same budget for each law, for the shipped vehicle (docs/baselines.md);
`sim-bridge tune` repeats it for another.
"""

import re
from typing import Annotated, Literal, get_args

from pydantic import AfterValidator, WithJsonSchema

from wire.config.vehicle import NotNegative, Positive
from wire.toml_loader import Section

Gains = tuple[NotNegative, NotNegative, NotNegative]
Scales = tuple[Positive, Positive, Positive]

LawName = Literal["eso-mpc", "backstepping", "pid", "lqr", "sliding-mode", "fuzzy", "adaptive-nn"]
OWN_LAW = r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*"


def _known(name: str) -> str:
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
    """Reference correction of this law, in the place of controller.guidance.position_gain_per_s2, which is set for the ESO-
    MPC."""


class BacksteppingConfig(FeedbackLawConfig):
    """Decay rates of the errors and of the velocity errors, and the weight of the first in the Lyapunov function, in which the
    second has weight one."""

    guidance_per_s2: NotNegative = 0.0975
    error_per_s: Gains = (0.102, 0.797, 2.41)
    """Decay rate of the errors."""
    velocity_per_s: Gains = (0.801, 2.62, 0.448)
    """Decay rate of the velocity errors."""
    coupling_per_s2: Gains = (0.292, 0.169, 0.476)
    """Weight of the errors in the Lyapunov function, in which the velocity errors have weight 1."""


class PidConfig(FeedbackLawConfig):
    """One independent loop per axis."""

    guidance_per_s2: NotNegative = 0.22
    p: Gains = (7.63, 11.8, 0.781)
    """Proportional gain, N/m, N/m and N m/rad."""
    i: Gains = (1.92, 1.75, 0.0227)
    """Integral gain, the same per second."""
    d: Gains = (7.57, 7.22, 0.162)
    """Derivative gain, N s/m, N s/m and N m s/rad."""


class LqrConfig(FeedbackLawConfig):
    """Weights of squared errors and of squared velocity errors; that of the wrench is 1 / limit^2 (Bryson's rule)."""

    guidance_per_s2: NotNegative = 0.102
    error: Gains = (3.88, 4.59, 4.02)
    """Weight of squared errors."""
    velocity: Gains = (1.0, 0.892, 1.08)
    """Weight of squared velocity errors."""


class SlidingModeConfig(FeedbackLawConfig):
    """s = velocity error + slope error. The switching term is `reach` m/s^2 strong, and linear for |s| < `layer` m/s."""

    guidance_per_s2: NotNegative = 0.0831
    slope_per_s: Gains = (0.351, 1.35, 1.97)
    """Slope of the sliding surface."""
    reach: Gains = (0.377, 0.281, 1.0)
    """Strength of the switching term, m/s^2 and rad/s^2."""
    layer: Scales = (0.106, 0.0748, 0.0709)
    """Boundary layer, m/s and rad/s: within it the switching term is linear, so that it does not chatter."""


class FuzzyConfig(FeedbackLawConfig):
    """Errors and velocity errors that count as "big", and what the rules' verdict (-1 to 1) does, as a share of the limit: at
    once, and per second."""

    guidance_per_s2: NotNegative = 0.154
    error: Scales = (0.62, 0.271, 0.552)
    """Error that counts as big, m and rad."""
    velocity: Scales = (0.149, 0.407, 0.957)
    """Velocity error that counts as big, m/s and rad/s."""
    proportional: Gains = (1.13, 2.08, 1.1)
    """Effect of the rules' output (-1 to 1) at once, as a share of the limit."""
    integral: Gains = (0.477, 0.342, 0.315)
    """Effect of the rules' output per second, as a share of the limit."""


class AdaptiveNnConfig(FeedbackLawConfig):
    """s = velocity error + slope error; wrench = gain s + network. The network learns `learning` N per m/s of s and second."""

    guidance_per_s2: NotNegative = 0.142
    slope_per_s: Gains = (0.38, 0.749, 1.81)
    """Slope of s = velocity error + slope error."""
    gain: Gains = (51.6, 48.1, 0.422)
    """Gain of s, N per m/s and N m per rad/s."""
    learning: Gains = (7.63, 5.54, 1.73)
    """Rate at which the network learns, N per m/s of s and second."""

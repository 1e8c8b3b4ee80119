"""Control laws with which the nonlinear MPC is compared: from estimate and reference to a wrench and a plan."""

import importlib
from collections.abc import Callable
from typing import Any, Protocol, cast

from robot_agent.control.baselines.adaptive_nn import AdaptiveNn
from robot_agent.control.baselines.backstepping import Backstepping
from robot_agent.control.baselines.feedback import Feedback, FeedbackLaw
from robot_agent.control.baselines.fuzzy import Fuzzy
from robot_agent.control.baselines.lqr import Lqr
from robot_agent.control.baselines.pid import Pid
from robot_agent.control.baselines.sliding_mode import SlidingMode
from robot_agent.control.baselines.tracking_errors import Axes
from robot_agent.control.mpc import Mpc, MpcPlan
from robot_agent.guidance.formation import HalfSpaces
from robot_agent.vehicle.dynamics import Model, State
from shoal.config.baseline_controllers import FeedbackLawConfig
from shoal.config.controller import ControllerConfig
from shoal.config.vehicle import Vehicle
from shoal.errors import ConfigError
from shoal.frames import Array


class Law(Protocol):
    """One robot's law with its memory and workspaces."""

    def reset(self) -> None:
        """Forget the last plan."""

    def plan(
        self,
        state: State | Array,
        disturbance: Array,
        wrench: Array,
        reference: Array,
        weight: Array,
        keep_clear: HalfSpaces,
        current: complex = 0j,
        delivered: Array | None = None,
    ) -> MpcPlan:
        """Compute one step. `state` is that at which a command given now begins to act, its velocities through water that
        streams at `current` (x + iy, m/s). Gamma (4,); `wrench` (3,) asked for last, `delivered` (3,) its part that the
        thrusters gave (None: all); `reference` (horizon + 1, 4) from that instant on, its yaw near the state's; `weight` W
        (4,)."""


def heading_gain(config: ControllerConfig) -> float:
    """Gain of the reference heading for a law, 1/s^2: it depends on the heading loop."""
    section = getattr(config, config.law.replace("-", "_"), None)
    return section.guidance_per_s2 if isinstance(section, FeedbackLawConfig) else FeedbackLawConfig().guidance_per_s2


def make_law(vehicle: Vehicle, model: Model, config: ControllerConfig, period_s: float, rows: int) -> Law:
    """Build the law named in the settings. `rows` is the largest number of half-spaces."""
    if config.law == "eso-mpc-article":
        return Mpc(vehicle, model, config.mpc, period_s, rows)
    if ":" in config.law:
        law = _own(config.law)(vehicle, model, config, period_s)
        return law if hasattr(law, "plan") else Feedback(law, vehicle, model, period_s, config.mpc.horizon)
    return Feedback(_feedback(vehicle, model, config, period_s), vehicle, model, period_s, config.mpc.horizon)


def _own(name: str) -> Callable[[Vehicle, Model, ControllerConfig, float], Any]:
    """The maker of a law of one's own, a `Law` or a `FeedbackLaw`. Raises ConfigError if it cannot be imported."""
    module, _, maker = name.partition(":")
    try:
        found = getattr(importlib.import_module(module), maker)
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"controller.law = {name!r}: {error} (install its package where the agent runs)") from None
    if not callable(found):
        raise ConfigError(f"controller.law = {name!r}: must name a class or a function")
    return cast("Callable[[Vehicle, Model, ControllerConfig, float], Any]", found)


def _feedback(vehicle: Vehicle, model: Model, config: ControllerConfig, period_s: float) -> FeedbackLaw:
    """The feedback law that `controller.law` names."""
    limits = vehicle.limits
    surge_n, heave_n, yaw_nm = limits.wrench[:3]  # these laws know no other axis
    axes = Axes(model, (surge_n, heave_n, yaw_nm))
    match config.law:
        case "backstepping":
            return Backstepping(axes, config.backstepping)
        case "pid":
            return Pid(axes, config.pid)
        case "lqr":
            return Lqr(axes, config.lqr, model.lag_s, period_s)
        case "sliding-mode":
            return SlidingMode(axes, config.sliding_mode)
        case "fuzzy":
            return Fuzzy(axes, config.fuzzy)
        case "adaptive-nn":
            return AdaptiveNn(axes, config.adaptive_nn, (limits.speed_mps, limits.heave_mps, limits.yaw_rate_radps))
        case _:
            raise ValueError(f"{config.law} is no feedback law")

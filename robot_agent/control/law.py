"""Control laws with which the nonlinear MPC is compared: from estimate and reference to a wrench and a plan."""

import importlib
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, cast

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
        """Compute one step.

        `state`: when a command given now begins to act, with velocities through the water
        `disturbance`: Gamma (4,)
        `wrench`, `delivered`: (3,) the wrench asked for last, and what the thrusters gave of it (None: all)
        `reference`: (horizon + 1, 4) from the state's instant on, its yaw near the state's
        `weight`: W (4,)
        `current`: velocity of the water, x + iy in m/s
        """


def heading_gain(config: ControllerConfig) -> float:
    """Gain of the reference heading for a law, 1/s^2: it depends on the heading loop."""
    section = getattr(config, config.law.replace("-", "_"), None)
    return section.guidance_per_s2 if isinstance(section, FeedbackLawConfig) else FeedbackLawConfig().guidance_per_s2


class LawParts(NamedTuple):
    """All that a feedback law may be built from."""

    axes: Axes
    vehicle: Vehicle
    model: Model
    config: ControllerConfig
    period_s: float


def _adaptive_nn(parts: LawParts) -> AdaptiveNn:
    limits = parts.vehicle.limits
    return AdaptiveNn(parts.axes, parts.config.adaptive_nn, (limits.speed_mps, limits.heave_mps, limits.yaw_rate_radps))


LAWS: dict[str, Callable[[LawParts], FeedbackLaw]] = {  # by `controller.law`
    "backstepping": lambda parts: Backstepping(parts.axes, parts.config.backstepping),
    "pid": lambda parts: Pid(parts.axes, parts.config.pid),
    "lqr": lambda parts: Lqr(parts.axes, parts.config.lqr, parts.model.lag_s, parts.period_s),
    "sliding-mode": lambda parts: SlidingMode(parts.axes, parts.config.sliding_mode),
    "fuzzy": lambda parts: Fuzzy(parts.axes, parts.config.fuzzy),
    "adaptive-nn": _adaptive_nn,
}


def make_law(vehicle: Vehicle, model: Model, config: ControllerConfig, period_s: float, rows: int) -> Law:
    """Build the law named in the settings: the article's, one of LAWS, or MODULE:NAME. `rows` is the largest number of
    half-spaces."""
    if config.law == "eso-mpc-article":
        return Mpc(vehicle, model, config.mpc, period_s, rows)
    if ":" in config.law:
        law = _import_maker(config.law)(vehicle, model, config, period_s)
        return law if hasattr(law, "plan") else Feedback(law, vehicle, model, period_s, config.mpc.horizon)
    surge_n, heave_n, yaw_nm = vehicle.limits.wrench[:3]  # these laws know no other axis
    parts = LawParts(Axes(model, (surge_n, heave_n, yaw_nm)), vehicle, model, config, period_s)
    return Feedback(LAWS[config.law](parts), vehicle, model, period_s, config.mpc.horizon)


def _import_maker(name: str) -> Callable[[Vehicle, Model, ControllerConfig, float], Any]:
    """Import the class or function MODULE:NAME that makes a user's `Law` or `FeedbackLaw`. Raises ConfigError if there is
    none."""
    module, _, attribute = name.partition(":")
    try:
        maker = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"controller.law = {name!r}: {error} (install its package where the agent runs)") from None
    if not callable(maker):
        raise ConfigError(f"controller.law = {name!r}: must name a class or a function")
    return cast("Callable[[Vehicle, Model, ControllerConfig, float], Any]", maker)

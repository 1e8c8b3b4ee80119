"""The controller that a configuration names: the nonlinear MPC, or a law with which it is compared."""

from robot_agent.control.controller import Controller
from robot_agent.control.nonlinear.nonlinear_controller import NonlinearController
from robot_agent.guidance.obstacles import Obstacle
from wire.config.controller import ControllerConfig, Safety
from wire.config.vehicle import Vehicle

AnyController = Controller | NonlinearController


def make_controller(
    vehicle: Vehicle,
    config: ControllerConfig,
    safety: Safety,
    urgent: bool = False,
    has_leader: bool = False,
    room_m: tuple[float, float] | None = None,
    islands: tuple[Obstacle, ...] = (),
) -> AnyController:
    """See `Controller` for the arguments."""
    kind = NonlinearController if config.law == "nmpc" else Controller
    return kind(vehicle, config, safety, urgent, has_leader, room_m, islands)

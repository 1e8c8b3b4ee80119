"""The controller that a configuration names: the nonlinear MPC, or a law with which it is compared."""

from robot_agent.control.controller import Controller
from robot_agent.control.nonlinear.nonlinear_controller import NonlinearController
from shoal.config.controller import ControllerConfig

AnyController = Controller | NonlinearController


def controller_class(config: ControllerConfig) -> type[Controller] | type[NonlinearController]:
    """The class of the controller for `config.law`. Both are made and stepped alike."""
    return NonlinearController if config.law == "nmpc" else Controller

"""The controller that a configuration names: the nonlinear MPC, or a law with which it is compared."""

from robot_agent.control.controller import Controller, Setting
from robot_agent.control.law_controller import LawController
from robot_agent.control.nonlinear.nonlinear_controller import NonlinearController


def make_controller(setting: Setting) -> Controller:
    """The controller for the law of `setting.config`."""
    return NonlinearController(setting) if setting.config.law == "nmpc" else LawController(setting)

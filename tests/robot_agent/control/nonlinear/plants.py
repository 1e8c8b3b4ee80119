"""Models and problems for the tests of the nonlinear MPC."""

import math

import numpy as np

from robot_agent.control.nonlinear.obstacle_rows import NO_BODIES, Surrounds, outlines_of
from robot_agent.control.nonlinear.prediction import Dynamics, Grid, Hull, Start, Surroundings, make_grid
from robot_agent.control.nonlinear.program import Course, InputLimits, PlanProblem, Weights

HULL = Hull(12.0, 14.0, 0.12, 3.0, 4.0, 0.08, 20.0, 25.0, 0.10, 1.0, 0.1, 0.2)
WATER = Surroundings(0.05, -0.10, 0.01, 0.02, 0.03)
DYNAMICS = Dynamics(HULL, WATER)
STILL = Dynamics(HULL, Surroundings(0.0, 0.0, 0.0, 0.0, 0.0))
NOTHING = Surrounds(NO_BODIES, outlines_of((), 0, 0j), np.array([math.inf, math.inf]))
ALL_AXES = [(0, 2), (0, 1, 2), (0,)]
LIMIT, RATE = np.array([6.0, 6.0, 0.5]), np.array([6.0, 6.0, 2.0])  # X, Y, N


def grid_of(axes: tuple[int, ...]) -> Grid:
    return make_grid(7.0, axes)


def problem_of(
    grid: Grid,
    start: Start,
    surrounds: Surrounds = NOTHING,
    speed_mps: float = 0.1,
    aside_m: float = 0.3,
    is_steered: bool = False,
) -> PlanProblem:
    """A straight course, beside and ahead of the robot's place; a robot that cannot leave its line stays on it."""
    axes, nodes = grid.axes, len(grid.share_s)
    place, velocity = np.zeros((nodes, 2)), np.zeros((nodes, 2))
    place[:, 0], velocity[:, 0] = 0.2 + speed_mps * grid.time_s[1:], speed_mps
    place[:, 1] = aside_m if len(axes) > 1 else 0.0
    heading = np.linspace(0.2, 0.6, nodes) if is_steered else np.zeros(nodes)
    course = Course(place, velocity, heading, np.full(nodes, 1e-4))
    rate = np.array([1e-4, 1e-4, 6e-4])
    weights = Weights(rate[axes], 1e-4, 1.0, 0.5, 3.0, 1e4, is_steered)
    return PlanProblem(start, course, weights, InputLimits(LIMIT[axes], RATE[axes]), surrounds)

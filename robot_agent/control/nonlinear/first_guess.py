"""First guesses for the optimisation: a simple pilot flies to the course, ahead or astern, and comes to rest where it is.

The optimisation improves the flight it is given. Turning round, or coming back astern, is another flight that no small step
leads to; the pilot is such a step. It asks for a velocity through the water that leads back to the course, turns bow or stern
into it, and pushes as fast as it wants to go. Where thrusters push sideways too, it pushes along both axes, and its heading is
the course's.
"""

import math
from typing import NamedTuple

import numpy as np

from robot_agent.control.nonlinear.prediction import (
    MOMENT,
    STATES,
    SURGE,
    YAW,
    Dynamics,
    Grid,
    PlannedFlight,
    R,
    Start,
    U,
    V,
    X,
    Y,
    lag_shares,
    motion,
    step_from,
)
from robot_agent.control.nonlinear.program import Course, InputLimits
from shoal.frames import TURN
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Floats

STILL = 0.02  # of the fastest speed: slower, the direction of the water means nothing
TURN_SHARE, TURN_DAMPING = 0.5, 1.4  # of the heading's bandwidth w: r' = w (0.5 w yaw - 1.4 r), no overshoot


class PilotStyle(NamedTuple):
    """Manner in which the pilot flies."""

    ahead: float  # 1: bow first, -1: stern first
    aside_m: float  # of the course to port, in the middle of the horizon: around what is in the way
    return_per_s: float  # velocity towards the course per distance from it; 0: no way back, only rest
    quickness: float  # rad/s, of the place,
    turning: float  # and of the heading
    fastest_mps: float


@kernel(part=True)
def wanted_force(
    dynamics: Dynamics, pilot: PilotStyle, state: Floats, x_mps: float, y_mps: float, yaw_rad: float
) -> tuple[float, float, float]:
    """Forces that bring the robot to a velocity through the water, and its bow or stern into it; or, if `yaw_rad` is a number,
    to that heading, which needs side thrust."""
    hull, water, yaw = dynamics.hull, dynamics.water, state[YAW]
    speed = math.sqrt(x_mps * x_mps + y_mps * y_mps)
    if speed > pilot.fastest_mps:
        x_mps, y_mps = x_mps * pilot.fastest_mps / speed, y_mps * pilot.fastest_mps / speed
    away, has_sway = 0.0, not math.isnan(yaw_rad)
    if has_sway:
        away = yaw_rad - yaw
    elif speed > STILL * pilot.fastest_mps:
        away = math.atan2(pilot.ahead * y_mps, pilot.ahead * x_mps) - yaw
        away -= TURN * math.floor(away / TURN + 0.5)
    cos, sin = math.cos(yaw), math.sin(yaw)
    along, aside = cos * x_mps + sin * y_mps, cos * y_mps - sin * x_mps
    if not has_sway and away != 0.0 and along * pilot.ahead < 0.0:
        along = 0.0  # first turn
    surge = (hull.linear_u + hull.quadratic_u * abs(along)) * along + hull.mass_u * (
        pilot.quickness * (along - state[U]) - water.own_u
    )
    sway = (hull.linear_v + hull.quadratic_v * abs(aside)) * aside + hull.mass_v * (
        pilot.quickness * (aside - state[V]) - water.own_v
    )
    turn = pilot.turning * (TURN_SHARE * pilot.turning * away - TURN_DAMPING * state[R]) - water.own_r
    return surge, sway, hull.inertia * turn


@kernel
def guess(
    dynamics: Dynamics, grid: Grid, start: Start, course: Course, limits: InputLimits, pilot: PilotStyle, flight: PlannedFlight
) -> None:
    """Fly, and write commands at the nodes within all limits, and the states there."""
    axes, state, middle = len(grid.axes), start.state.copy(), np.zeros(STATES)
    command, demand, has_sway = start.command.copy(), np.zeros(3), False
    for i in range(axes):
        has_sway |= grid.axes[i] == 1
    for k in range(len(flight.state)):
        span_s = grid.time_s[k + 1] - grid.time_s[k]
        steps = math.ceil(2.0 * span_s / dynamics.hull.step_s - 1e-9)
        step_s = span_s / steps
        shares = lag_shares(dynamics.hull.lag_s, step_s)
        x_mps, y_mps = course.velocity[k, 0], course.velocity[k, 1]
        yaw_rad = math.nan
        if has_sway:
            yaw_rad = course.yaw[k] if course.yaw_weight[k] > 0.0 else start.state[YAW]
        speed, bump = math.sqrt(x_mps * x_mps + y_mps * y_mps), 0.0
        if speed > STILL * pilot.fastest_mps:
            middle_s = 0.5 * grid.time_s[len(grid.time_s) - 1]
            bump = pilot.aside_m / speed * math.exp(-((2.0 * (grid.time_s[k + 1] / middle_s - 1.0)) ** 2))
        goal_x, goal_y = course.place[k, 0] - bump * y_mps, course.place[k, 1] + bump * x_mps
        for j in range(steps):
            left_s = (steps - j) * step_s
            back_x = pilot.return_per_s * (goal_x - x_mps * left_s - state[X])
            back_y = pilot.return_per_s * (goal_y - y_mps * left_s - state[Y])
            wanted = wanted_force(
                dynamics, pilot, state, x_mps + back_x - dynamics.water.current_x_mps,
                y_mps + back_y - dynamics.water.current_y_mps, yaw_rad,
            )  # fmt: skip
            for i in range(axes):
                most, want = limits.rate[i] * step_s, wanted[grid.axes[i]]
                change = min(max(min(max(want, -limits.size[i]), limits.size[i]) - command[i], -most), most)
                command[i] += change
                demand[grid.axes[i]] = command[i]
            first = motion(dynamics, (state[YAW], state[U], state[V], state[R]), state[SURGE:])
            step_from(state, first, 0.5 * step_s, middle)
            for i in range(3):
                middle[SURGE + i] = demand[i] + shares.half_acting * (state[SURGE + i] - demand[i])
            rates = motion(dynamics, (middle[YAW], middle[U], middle[V], middle[R]), middle[SURGE:])
            step_from(state, rates, step_s, state)
            for i in range(SURGE, MOMENT + 1):
                state[i] = demand[i - SURGE] + shares.acting * (state[i] - demand[i - SURGE])
        flight.command[k] = command
        flight.state[k] = state

"""The course that a plan flies at its nodes: the reference with the heading that goes with it, and the place to rest.

A robot that moves through the water has its bow, or its stern, in the direction of that motion. The slower it is through the
water, the less its heading matters: weight a^2 v^2 / (v^2 + v_0^2). What heading corrects an error is the optimisation's
business, not the course's.
"""

import math
from typing import NamedTuple

import numpy as np

from robot_agent.control.nonlinear.prediction import NODES, Surroundings
from robot_agent.control.nonlinear.program import Course
from robot_agent.control.nonlinear.tuning import SLOW_MPS
from robot_agent.guidance.reference import Reference
from shoal.frames import TURN, Array
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Table

KEEP_TURN = 0.55  # of a turn: a robot that faces backwards does not change its mind about the way round at every step


class HeadingRule(NamedTuple):
    """Rule by which a course gets its heading."""

    near_rad: float  # whole turns are those nearest to this
    weight_m2: float  # a^2, m^2/rad^2
    is_steered: bool  # the reference has the heading, always at the whole weight
    either_end: bool  # bow or stern first, whichever is nearer


def make_course() -> Course:
    return Course(np.zeros((NODES, 2)), np.zeros((NODES, 2)), np.zeros(NODES), np.zeros(NODES))


@kernel(part=True)
def nearest_turn(angle: float, near: float, period: float) -> float:
    """The angle, with as many periods more or less as bring it nearest to another."""
    return angle - period * math.floor((angle - near) / period + 0.5)


@kernel
def set_course(eta: Table, velocity: Table, water: Surroundings, rule: HeadingRule, course: Course) -> None:
    """Write the course of the last nodes of a reference: poses `eta` and velocities (rows, 4)."""
    near, before = rule.near_rad, len(eta) - len(course.yaw)
    for k in range(len(course.yaw)):
        row = before + k
        course.place[k, 0], course.place[k, 1] = eta[row, 0], eta[row, 1]
        course.velocity[k, 0], course.velocity[k, 1] = velocity[row, 0], velocity[row, 1]
        if rule.is_steered:
            near = nearest_turn(eta[row, 3], near, TURN)
            course.yaw[k], course.yaw_weight[k] = near, rule.weight_m2
            continue
        x_mps, y_mps = velocity[row, 0] - water.current_x_mps, velocity[row, 1] - water.current_y_mps
        square = x_mps * x_mps + y_mps * y_mps
        matters = square / (square + SLOW_MPS**2)
        yaw = nearest_turn(math.atan2(y_mps, x_mps), near, 0.5 * TURN if rule.either_end else TURN)
        course.yaw[k], course.yaw_weight[k] = yaw, matters * rule.weight_m2
        near += matters * (yaw - near)  # a direction that means nothing takes no part in counting the turns


@kernel
def set_depth_course(eta: Table, velocity: Table, course: Course) -> None:
    """Write the course of depth, as motion along x."""
    before = len(eta) - len(course.yaw)
    for k in range(len(course.yaw)):
        course.place[k, 0], course.velocity[k, 0] = eta[before + k, 2], velocity[before + k, 2]


class Turns:
    """The whole turns that a course had in the last step: it keeps them until another is clearly nearer."""

    def __init__(self) -> None:
        self._last: float | None = None

    def reset(self) -> None:
        """Count anew."""
        self._last = None

    def near_rad(self, yaw_rad: float) -> float:
        """The heading near which a course begins, for a robot at `yaw_rad`."""
        last = self._last
        return yaw_rad if last is None or abs(last - yaw_rad) > KEEP_TURN * TURN else last

    def note(self, course: Course, near_rad: float) -> None:
        """Take note of a course; a heading that hardly matters is none."""
        matters = course.yaw_weight[0] > 0.5 * course.yaw_weight.max() > 0.0
        self._last = float(course.yaw[0]) if matters else near_rad


def pulled(reference: Reference, pull: Array) -> Reference:
    """The reference moved by the formation's `pull` (rows, 3)."""
    eta = reference.eta.copy()
    eta[:, :3] += pull
    return reference._replace(eta=eta)

"""The virtual structure (equations 14-16): from the motion of the formation's centre to the motion of each node.

`translate` keeps every offset constant in the pool frame; `rotate` turns the structure with the path (ambiguity A10), and
each node's speed and heading then follow from rigid-body motion, not from the centre's.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from groundstation.spline import PathState
from wire.frames import Array

STANDSTILL_MPS = 1e-6  # below this a node's own direction of motion means nothing


@dataclass(frozen=True, eq=False)
class NodeMotion:
    """A node's motion at n instants, each (n, 4): [x, y, z, yaw] and its first and second time derivative, pool frame."""

    eta: Array
    velocity: Array
    acceleration: Array


def structure_rotation(yaw_rad: Array, climb_rad: Array) -> Array:
    """Rot = Rz(psi) Rx(theta) of (16), shape (n, 3, 3): structure frame to pool frame. y_S is the path's tangent, so
    psi = phi - pi/2; theta is the angle of the tangent towards +z."""
    psi = yaw_rad - np.pi / 2.0
    cp, sp, ct, st = np.cos(psi), np.sin(psi), np.cos(climb_rad), np.sin(climb_rad)
    zero = np.zeros_like(psi)
    rows = [[cp, -ct * sp, st * sp], [sp, ct * cp, -st * cp], [zero, st, ct]]
    return np.moveaxis(np.array(rows), -1, 0)


def node_motion(centre: PathState, node_m: Array, mode: Literal["translate", "rotate"], period_s: float) -> NodeMotion:
    """Motion of one node (14). `node_m` (3,) is L p_i^S, scaled already; the centre is sampled every `period_s`."""
    if mode == "translate":
        return NodeMotion(
            np.column_stack([centre.position_m + node_m, centre.yaw_rad]),
            np.column_stack([centre.velocity_mps, centre.yaw_rate_radps]),
            np.column_stack([centre.acceleration_mps2, centre.yaw_acceleration_radps2]),
        )
    arm = structure_rotation(centre.yaw_rad, centre.climb_rad) @ node_m
    across = np.column_stack([-arm[:, 1], arm[:, 0], np.zeros(len(arm))])  # k x arm: the structure turns about z only
    inward = np.column_stack([-arm[:, 0], -arm[:, 1], np.zeros(len(arm))])
    rate, angular = centre.yaw_rate_radps[:, None], centre.yaw_acceleration_radps2[:, None]
    velocity = centre.velocity_mps + rate * across
    acceleration = centre.acceleration_mps2 + angular * across + rate**2 * inward
    yaw, yaw_rate = _own_heading(velocity, acceleration, centre)
    return NodeMotion(
        np.column_stack([centre.position_m + arm, yaw]),
        np.column_stack([velocity, yaw_rate]),
        # the exact value needs the path's fourth derivative, which a cubic spline does not have at its knots
        np.column_stack([acceleration, np.gradient(yaw_rate, period_s)]),
    )


def _own_heading(velocity: Array, acceleration: Array, centre: PathState) -> tuple[Array, Array]:
    """Unwrapped direction of a node's own horizontal motion (n,), and its rate (13). A robot cannot push sideways, so it
    must head where its node goes. Where the node stands still (it may be the pivot), the centre's heading serves."""
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    moving = speed > STANDSTILL_MPS
    square = np.where(moving, speed, 1.0) ** 2
    yaw = np.where(moving, np.arctan2(velocity[:, 1], velocity[:, 0]), centre.yaw_rad)
    turning = (velocity[:, 0] * acceleration[:, 1] - velocity[:, 1] * acceleration[:, 0]) / square
    return np.unwrap(yaw), np.where(moving, turning, centre.yaw_rate_radps)

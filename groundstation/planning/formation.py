"""The virtual structure (equations 14-16): from the motion of the formation's centre to the motion of each node.

`translate` keeps every offset constant in the pool frame; `rotate` turns the structure with the path (ambiguity A10), and
each node's speed and heading then follow from rigid-body motion, not from the centre's. A formation may take another form on
its way: nodes then move smoothly within the structure.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import linear_sum_assignment

from groundstation.planning.paths import PathState
from shoal.config.formation_shapes import shape_nodes
from shoal.config.scene import Change
from shoal.frames import Array

STANDSTILL_MPS = 1e-6  # below this a node's direction of motion is undefined


@dataclass(frozen=True, eq=False)
class NodeMotion:
    """A node's motion at n instants, each (n, 4): [x, y, z, yaw] and its first and second time derivative, pool frame."""

    eta: Array
    velocity: Array
    acceleration: Array


@dataclass(frozen=True, eq=False)
class SlotOffset:
    """Offset of a node from the formation's centre at n instants, each (n, 3): place, and its two time derivatives."""

    place_m: Array
    rate_mps: Array
    bend_mps2: Array


def quintic_blend(tau: Array, over_s: float) -> tuple[Array, Array, Array]:
    """Weight that goes from 0 to 1 over `over_s`, and its two time derivatives, at `tau` (0 to 1) of that time. Both
    derivatives vanish at the ends: no jump in velocity or acceleration."""
    s = tau**3 * (10.0 - 15.0 * tau + 6.0 * tau**2)
    s1 = 30.0 * tau**2 * (1.0 - tau) ** 2 / over_s
    return s, s1, 60.0 * tau * (1.0 - tau) * (1.0 - 2.0 * tau) / over_s**2


def slot_offsets(nodes_m: Array, changes: Sequence[Change], time_s: Array, robots: Sequence[int] = ()) -> list[SlotOffset]:
    """Offsets of nodes (robots, 3) through all changes of form, one after the other. `robots`: their ids, for changes that
    name them.

    A scale and a turn move the structure as a whole. A new shape gives every robot a node of it so that the sum of squared
    ways is least: on straight ways, taken together, no two robots then meet (Turpin, Michael, Kumar 2014). With an order
    robots may meet on their ways: the planner refuses that.
    """
    shape = (len(nodes_m), len(time_s), 3)
    place, rate, bend = np.broadcast_to(nodes_m[:, None], shape).copy(), np.zeros(shape), np.zeros(shape)
    for change in changes:
        tau = np.clip((time_s - change.at_s) / change.over_s, 0.0, 1.0)
        s, s1, s2 = quintic_blend(tau, change.over_s)
        if change.shape is not None or change.order:
            shift_m = (_new_places(nodes_m, change, robots) - nodes_m)[:, None]
            place, rate, bend = place + s[:, None] * shift_m, rate + s1[:, None] * shift_m, bend + s2[:, None] * shift_m
            nodes_m = nodes_m + shift_m[:, 0]
            continue
        grow, turn = change.scale - 1.0, 1j * change.turn_rad
        spun = np.exp(turn * s)
        size = 1.0 + grow * s
        first, second = (grow + turn * size) * spun, (2.0 * grow + turn * size) * turn * spun  # derivatives over s
        flat = nodes_m[:, None, 0] + 1j * nodes_m[:, None, 1]
        deep = nodes_m[:, None, 2] * grow
        parts = (size * spun - 1.0, s), (first * s1, s1), (second * s1**2 + first * s2, s2)
        for whole, (moved, sunk) in zip((place, rate, bend), parts, strict=True):
            whole[..., 0] += (flat * moved).real
            whole[..., 1] += (flat * moved).imag
            whole[..., 2] += deep * sunk
        nodes_m = change.scale * nodes_m @ _turn(change.turn_rad).T
    return [SlotOffset(*offset) for offset in zip(place, rate, bend, strict=True)]


def _new_places(nodes_m: Array, change: Change, robots: Sequence[int]) -> Array:
    """Nodes (robots, 3) after a change to another shape or order."""
    turn = _turn(change.turn_rad).T
    if change.shape is None:
        form_m = change.scale * nodes_m @ turn
    else:
        form_m = change.scale * shape_nodes(change.shape, len(nodes_m), change.spacing_m) @ turn + nodes_m.mean(axis=0)
    if not change.order:
        return _assigned(nodes_m, form_m)
    return form_m[[change.order.index(robot) for robot in robots]]


def _turn(angle_rad: float) -> Array:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _assigned(nodes_m: Array, form_m: Array) -> Array:
    """The new form's nodes (robots, 3), in the robots' order."""
    costs = np.sum((nodes_m[:, None] - form_m) ** 2, axis=2)
    return np.asarray(form_m[linear_sum_assignment(costs)[1]])


def structure_rotation(yaw_rad: Array, climb_rad: Array) -> Array:
    """Rot = Rz(psi) Rx(theta) of (16), shape (n, 3, 3): structure frame to pool frame. y_S is the path's tangent, so
    psi = phi - pi/2; theta is the angle of the tangent towards +z."""
    psi = yaw_rad - np.pi / 2.0
    cp, sp, ct, st = np.cos(psi), np.sin(psi), np.cos(climb_rad), np.sin(climb_rad)
    zero = np.zeros_like(psi)
    rows = [[cp, -ct * sp, st * sp], [sp, ct * cp, -st * cp], [zero, st, ct]]
    return np.moveaxis(np.array(rows), -1, 0)


def node_motion(centre: PathState, offset: SlotOffset, mode: Literal["translate", "rotate"], period_s: float) -> NodeMotion:
    """Motion of one node (14); the centre is sampled every `period_s`."""
    place, rate, bend = offset.place_m, offset.rate_mps, offset.bend_mps2
    if mode == "translate":
        velocity, acceleration = centre.velocity_mps + rate, centre.acceleration_mps2 + bend
        if not rate.any():
            return NodeMotion(
                np.column_stack([centre.position_m + place, centre.yaw_rad]),
                np.column_stack([velocity, centre.yaw_rate_radps]),
                np.column_stack([acceleration, centre.yaw_acceleration_radps2]),
            )
        return _with_own_heading(centre.position_m + place, velocity, acceleration, centre, period_s)
    rotation = structure_rotation(centre.yaw_rad, centre.climb_rad)
    arm, drift, swing = (np.einsum("nij,nj->ni", rotation, within) for within in (place, rate, bend))
    across = np.column_stack([-arm[:, 1], arm[:, 0], np.zeros(len(arm))])  # k x arm: the structure turns about z only
    inward = np.column_stack([-arm[:, 0], -arm[:, 1], np.zeros(len(arm))])
    sideways = np.column_stack([-drift[:, 1], drift[:, 0], np.zeros(len(arm))])
    turning, angular = centre.yaw_rate_radps[:, None], centre.yaw_acceleration_radps2[:, None]
    velocity = centre.velocity_mps + turning * across + drift
    acceleration = centre.acceleration_mps2 + angular * across + turning**2 * inward + 2.0 * turning * sideways + swing
    return _with_own_heading(centre.position_m + arm, velocity, acceleration, centre, period_s)


def _with_own_heading(position: Array, velocity: Array, acceleration: Array, centre: PathState, period_s: float) -> NodeMotion:
    """Motion of a robot (n, 4) whose heading follows its own velocity, not the centre's."""
    yaw, yaw_rate = own_heading(velocity, acceleration, centre.yaw_rad, centre.yaw_rate_radps)
    return NodeMotion(
        np.column_stack([position, yaw]),
        np.column_stack([velocity, yaw_rate]),
        # the exact value needs the path's fourth derivative, which a cubic spline does not have at its knots
        np.column_stack([acceleration, np.gradient(yaw_rate, period_s)]),
    )


def own_heading(velocity: Array, acceleration: Array, else_rad: Array, else_radps: Array) -> tuple[Array, Array]:
    """Unwrapped direction (n,) of a node's own horizontal motion, and its rate (13). A robot cannot push sideways, so it must
    head along its motion. Where the node stands still (it may be the pivot), `else_rad` and `else_radps` are used."""
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    moving = speed > STANDSTILL_MPS
    square = np.where(moving, speed, 1.0) ** 2
    yaw = np.where(moving, np.arctan2(velocity[:, 1], velocity[:, 0]), else_rad)
    turning = (velocity[:, 0] * acceleration[:, 1] - velocity[:, 1] * acceleration[:, 0]) / square
    return np.unwrap(yaw), np.where(moving, turning, else_radps)

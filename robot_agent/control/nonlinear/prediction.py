"""Motion over the horizon, and its derivatives by the commands: the model of dynamics.py on a grid of nodes.

    x' = R(yaw) (u, v) + current            yaw' = r
    u' = (X - d_u(u, v) u) / m_u + (m_v / m_u) v r + b_u
    v' = (Y - d_v(u, v) v) / m_v - (m_u / m_v) u r + b_v
    r' = (N - d_r(r) r + (m_u - m_v) u v) / I + b_r           lag F' = F_commanded - F, for X, Y and N

u, v, r are velocities through the water. b is the acceleration by forces that turn along with the robot. What keeps
its direction in the pool is the current.

Actuated axes are a property of the vehicle: `Grid.axes` lists those of X (0), Y (1), N (2) that have thrusters; the others
stay zero. Commands are given at the nodes, linear in between, from the command that acts now on. Depth is the same motion
along one axis: x is the depth, u the heave velocity, yaw and v are zero.

The midpoint rule with exact thruster lag, in steps of at most `Hull.step_s`. Derivatives are those of the very same rule, so
they agree with finite differences to rounding.
"""

import math
from typing import NamedTuple

import numpy as np

from shoal.kernels.decorator import kernel
from shoal.kernels.types import Cube, Floats, Ints, Table

NODES = 20  # of the horizon: the last two are 0.8 s apart for 7 s, 1.8 s for 12 s
FIRST_S = 0.1  # to the first node: of the order of the thrusters' lag and dead time, whatever the control period
X, Y, YAW, U, V, R, SURGE, SWAY, MOMENT = range(9)  # of a state
STATES, DERIVED = 9, 6  # numbers of a state, and those whose derivatives are kept
NO_LAG_S = 1e-4  # a shorter lag is none: 1/500 of the shortest control period


class Hull(NamedTuple):
    """Mass and drag through the water of the axes u, v and r, and the numbers of the integration."""

    mass_u: float
    mass_v: float
    inertia: float
    linear_u: float
    linear_v: float
    linear_r: float
    quadratic_u: float
    quadratic_v: float
    quadratic_r: float
    sway: float  # 0: v stays zero
    lag_s: float  # of the thrusters
    step_s: float  # longest step of the integration


class Surroundings(NamedTuple):
    """Accelerations that the hull's own model does not know, and the current."""

    current_x_mps: float
    current_y_mps: float
    own_u: float  # by forces that turn along with the robot, m/s^2 and rad/s^2
    own_v: float
    own_r: float


class Dynamics(NamedTuple):
    """The whole model."""

    hull: Hull
    water: Surroundings


class Grid(NamedTuple):
    """Nodes of the horizon, the instant of action first, and the actuated axes."""

    time_s: Floats  # (nodes + 1,) from 0 on
    share_s: Floats  # (nodes,) trapezoidal weights of nodes 1..
    axes: Ints  # (axes,) of X 0, Y 1, N 2


class Start(NamedTuple):
    """State (9,) at the instant of action, and the command (axes,) that acts from there on."""

    state: Floats
    command: Floats


class PlannedFlight(NamedTuple):
    """Commands at nodes 1.. and the motion that they give. Commands are in rows of nodes, so that the derivatives by all
    commands up to a node are one piece of memory."""

    command: Table  # (nodes, axes)
    state: Table  # (nodes, 9)
    slope: Cube  # (nodes, 6, nodes axes) of x, y, yaw, u, v, r by the commands
    tangent: Table  # (12, nodes axes) workspace


class Rates(NamedTuple):
    """Time derivatives of x, y, yaw, u, v, r."""

    x: float
    y: float
    yaw: float
    u: float
    v: float
    r: float


class Jacobian(NamedTuple):
    """Derivatives of u', v', r' by u, v, r."""

    u_u: float
    u_v: float
    u_r: float
    v_u: float
    v_v: float
    v_r: float
    r_u: float
    r_v: float
    r_r: float


class LagShares(NamedTuple):
    """Acting thrust half a step and a whole step later: shares of the acting one, of the command at the step's beginning and
    of that at its end."""

    half_acting: float
    half_begin: float
    half_end: float
    acting: float
    begin: float
    end: float


def make_grid(horizon_s: float, axes: tuple[int, ...]) -> Grid:
    """Nodes whose spacing grows geometrically from FIRST_S on, up to the horizon."""
    low, high = 1.0, 2.0
    for _ in range(60):
        factor = 0.5 * (low + high)
        low, high = (factor, high) if FIRST_S * (factor ** np.arange(NODES)).sum() < horizon_s else (low, factor)
    spans_s = FIRST_S * low ** np.arange(NODES)
    share_s = 0.5 * (spans_s + np.append(spans_s[1:], 0.0))
    return Grid(np.concatenate([[0.0], np.cumsum(spans_s)]), share_s, np.array(axes, np.int64))


def make_flight(axes: int) -> PlannedFlight:
    """Memory of a flight with `axes` actuated axes: all zeros, a robot at rest at the origin without thrust."""
    count = NODES * axes
    return PlannedFlight(
        np.zeros((NODES, axes)), np.zeros((NODES, STATES)), np.zeros((NODES, DERIVED, count)), np.zeros((12, count))
    )


@kernel(part=True)
def motion(dynamics: Dynamics, pose: tuple[float, float, float, float], force: Floats) -> Rates:
    """Rates of a state: `pose` has yaw, u, v, r; `force` (3,) acts."""
    hull, water = dynamics.hull, dynamics.water
    yaw, u, v, r = pose
    cos, sin, speed, ratio = math.cos(yaw), math.sin(yaw), math.sqrt(u * u + v * v), hull.mass_v / hull.mass_u
    return Rates(
        cos * u - sin * v + water.current_x_mps,
        sin * u + cos * v + water.current_y_mps,
        r,
        (force[0] - (hull.linear_u + hull.quadratic_u * speed) * u) / hull.mass_u + ratio * v * r + water.own_u,
        hull.sway * ((force[1] - (hull.linear_v + hull.quadratic_v * speed) * v) / hull.mass_v - u * r / ratio + water.own_v),
        (force[2] - (hull.linear_r + hull.quadratic_r * abs(r)) * r + (hull.mass_u - hull.mass_v) * u * v) / hull.inertia
        + water.own_r,
    )


@kernel(part=True)
def jacobian(hull: Hull, u: float, v: float, r: float) -> Jacobian:
    """Derivatives of the accelerations u', v', r' of `motion` by u, v, r; that of speed by u is u / speed."""
    speed, ratio = math.sqrt(u * u + v * v), hull.mass_v / hull.mass_u
    per_speed = 1.0 / speed if speed > 1e-9 else 0.0
    return Jacobian(
        -(hull.linear_u + hull.quadratic_u * (speed + u * u * per_speed)) / hull.mass_u,
        ratio * r - hull.quadratic_u * u * v * per_speed / hull.mass_u,
        ratio * v,
        -hull.sway * (hull.quadratic_v * u * v * per_speed / hull.mass_v + r / ratio),
        -hull.sway * (hull.linear_v + hull.quadratic_v * (speed + v * v * per_speed)) / hull.mass_v,
        -hull.sway * u / ratio,
        (hull.mass_u - hull.mass_v) * v / hull.inertia,
        (hull.mass_u - hull.mass_v) * u / hull.inertia,
        -(hull.linear_r + 2.0 * hull.quadratic_r * abs(r)) / hull.inertia,
    )


@kernel(part=True)
def lag_shares(lag_s: float, step_s: float) -> LagShares:
    """The exact response of a first-order lag to a command that changes linearly during a step."""
    if lag_s < NO_LAG_S:
        return LagShares(0.0, 0.5, 0.5, 0.0, 0.0, 1.0)
    half, whole = math.exp(-0.5 * step_s / lag_s), math.exp(-step_s / lag_s)
    mean_half, mean = lag_s / step_s * (1.0 - half), lag_s / step_s * (1.0 - whole)
    return LagShares(half, 0.5 + mean_half - half, 0.5 - mean_half, whole, mean - whole, 1.0 - mean)


@kernel(part=True)
def step_from(state: Floats, rates: Rates, step_s: float, there: Floats) -> None:
    """Place and velocities of a state (9,) after a step at some rates, into `there` (9,), which may be the same."""
    there[X] = state[X] + step_s * rates.x
    there[Y] = state[Y] + step_s * rates.y
    there[YAW] = state[YAW] + step_s * rates.yaw
    there[U] = state[U] + step_s * rates.u
    there[V] = state[V] + step_s * rates.v
    there[R] = state[R] + step_s * rates.r


@kernel(part=True)
def spread_tangents(
    dynamics: Dynamics, state: Floats, middle: Floats, shares: LagShares, step_s: float, reached: int, tangent: Table
) -> None:
    """Carry the first `reached` columns d of the derivatives `tangent` (12, columns) on by a step of the midpoint rule: rows 0
    to 8 are those of the state, the last three those of the thrust halfway. `middle` (9,) is the state halfway.

        d_half = d + step / 2 A(state) d        d <- d + step A(middle) d_half        A: derivative of `motion`
    """
    hull, half = dynamics.hull, 0.5 * step_s
    now = jacobian(hull, state[U], state[V], state[R])
    mid = jacobian(hull, middle[U], middle[V], middle[R])
    cos, sin = math.cos(middle[YAW]), math.sin(middle[YAW])
    x_yaw, y_yaw = -sin * middle[U] - cos * middle[V], cos * middle[U] - sin * middle[V]
    per_u, per_v, per_r = 1.0 / hull.mass_u, hull.sway / hull.mass_v, 1.0 / hull.inertia
    for c in range(reached):
        yaw, u, v, r = tangent[YAW, c], tangent[U, c], tangent[V, c], tangent[R, c]
        yaw_half = yaw + half * r
        u_half = u + half * (now.u_u * u + now.u_v * v + now.u_r * r + per_u * tangent[SURGE, c])
        v_half = v + half * (now.v_u * u + now.v_v * v + now.v_r * r + per_v * tangent[SWAY, c])
        r_half = r + half * (now.r_u * u + now.r_v * v + now.r_r * r + per_r * tangent[MOMENT, c])
        tangent[X, c] += step_s * (x_yaw * yaw_half + cos * u_half - sin * v_half)
        tangent[Y, c] += step_s * (y_yaw * yaw_half + sin * u_half + cos * v_half)
        tangent[YAW, c] = yaw + step_s * r_half
        tangent[U, c] = u + step_s * (mid.u_u * u_half + mid.u_v * v_half + mid.u_r * r_half + per_u * tangent[9, c])
        tangent[V, c] = v + step_s * (mid.v_u * u_half + mid.v_v * v_half + mid.v_r * r_half + per_v * tangent[10, c])
        tangent[R, c] = r + step_s * (mid.r_u * u_half + mid.r_v * v_half + mid.r_r * r_half + per_r * tangent[11, c])
        for i in range(SURGE, STATES):
            tangent[i, c] *= shares.acting


@kernel(part=True)
def predict(dynamics: Dynamics, grid: Grid, start: Start, flight: PlannedFlight, derive: bool) -> None:
    """States at the nodes of a flight by its commands, and with `derive` their slopes."""
    axes = len(grid.axes)
    state, middle = start.state.copy(), np.zeros(STATES)
    begin, end, force = np.zeros(3), np.zeros(3), np.zeros(3)
    flight.tangent[:] = 0.0
    for k in range(len(flight.state)):
        span_s = grid.time_s[k + 1] - grid.time_s[k]
        steps = math.ceil(span_s / dynamics.hull.step_s - 1e-9)
        step_s = span_s / steps
        shares = lag_shares(dynamics.hull.lag_s, step_s)
        tangent = flight.tangent
        for j in range(steps):
            w0, w1 = j / steps, (j + 1) / steps
            for i in range(axes):
                before, after = start.command[i] if k == 0 else flight.command[k - 1, i], flight.command[k, i]
                axis = grid.axes[i]
                begin[axis], end[axis] = before + w0 * (after - before), before + w1 * (after - before)
            now = (state[YAW], state[U], state[V], state[R])
            first = motion(dynamics, now, state[SURGE:])
            step_from(state, first, 0.5 * step_s, middle)
            for i in range(3):
                force[i] = shares.half_acting * state[SURGE + i] + shares.half_begin * begin[i] + shares.half_end * end[i]
            rates = motion(dynamics, (middle[YAW], middle[U], middle[V], middle[R]), force)
            if derive:
                reached = axes * (k + 1)  # later commands have not acted
                for c in range(reached):
                    for i in range(3):
                        tangent[STATES + i, c] = shares.half_acting * tangent[SURGE + i, c]
                for i in range(axes):
                    axis, here = grid.axes[i], axes * k + i
                    if k > 0:
                        tangent[STATES + axis, here - axes] += shares.half_begin * (1.0 - w0) + shares.half_end * (1.0 - w1)
                    tangent[STATES + axis, here] += shares.half_begin * w0 + shares.half_end * w1
                spread_tangents(dynamics, state, middle, shares, step_s, reached, tangent)
                for i in range(axes):
                    axis, here = grid.axes[i], axes * k + i
                    if k > 0:
                        tangent[SURGE + axis, here - axes] += shares.begin * (1.0 - w0) + shares.end * (1.0 - w1)
                    tangent[SURGE + axis, here] += shares.begin * w0 + shares.end * w1
            step_from(state, rates, step_s, state)
            for i in range(3):
                state[SURGE + i] = shares.acting * state[SURGE + i] + shares.begin * begin[i] + shares.end * end[i]
        flight.state[k] = state
        if derive:
            flight.slope[k] = tangent[:DERIVED]


@kernel(part=True)
def move_on(grid: Grid, by_s: float, flight: PlannedFlight) -> None:
    """The same plan `by_s` later, in place: each node takes the command that the plan had for its new instant."""
    nodes, j = len(flight.command), 0
    for k in range(nodes):
        at_s = grid.time_s[k + 1] + by_s
        while j < nodes - 1 and grid.time_s[j + 1] < at_s:
            j += 1
        if j > k:  # rows from k on only, which still have the old commands; the last node stays as it is
            share = min((at_s - grid.time_s[j]) / (grid.time_s[j + 1] - grid.time_s[j]), 1.0)
            for i in range(flight.command.shape[1]):
                before = flight.command[j - 1, i]
                flight.command[k, i] = before + share * (flight.command[j, i] - before)


@kernel
def fly(dynamics: Dynamics, grid: Grid, start: Start, flight: PlannedFlight) -> None:
    """States and slopes of a flight by its commands."""
    predict(dynamics, grid, start, flight, True)

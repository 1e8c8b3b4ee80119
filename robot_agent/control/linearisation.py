"""The article's linear model over the horizon (33): poses at all nodes as an affine function of the wrenches to come.

The model of dynamics.py without sway, lag and current, linearised around the present state. Every quantity is

    free response + sum over blocks j of (response to a unit of block j) x (wrench of block j)

so it is an array (nodes, columns) with a column per block, and the free response last. x and y have 2 blocks + 1 columns:
surge blocks, yaw blocks, free. Those of one axis, z and yaw, u, w and r, have blocks + 1. Velocities are in the body frame.
"""

import math
from typing import NamedTuple

import numpy as np

from robot_agent.vehicle.dynamics import Model
from shoal.frames import Array
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Cube, Floats, Table

SURGE, HEAVE, YAW = 0, 2, 3  # axes in nu and Gamma, and in eta but for surge


class LinearModel(NamedTuple):
    coefficients: Table  # (3, 4) m, linear and quadratic drag of the four axes
    period_s: float  # between two nodes
    input: Table  # (horizon, blocks): 1 in the block that acts in a step, else 0


class ControlTask(NamedTuple):
    """Numbers that change from step to step."""

    state: Floats  # (12,) of dynamics.py
    demand: Floats  # (3,) wrench asked for last: surge, heave, yaw,
    delivered: Floats  # (3,) and what the thrusters gave of it: what it lacks it goes on to lack
    gamma: Floats  # (4,)
    reference: Table  # (nodes, 4)
    weight: Floats  # (4,) W


class Responses(NamedTuple):
    place: Cube  # (2, nodes, 2 blocks + 1) x and y
    axial: Cube  # (2, nodes, blocks + 1) z and yaw
    rate: Cube  # (3, nodes, blocks + 1) u, w and r


class Cost(NamedTuple):
    """The cost (35), halved: 1/2 b'Pb + q'b over all blocks b: surge, yaw, heave; and a slack, the last number of b."""

    smooth: Table  # P of the changes between blocks, and of the slack
    r: Floats  # (3,) price of a change of surge, heave, yaw
    p: Table
    q: Floats


def make_responses(nodes: int, blocks: int) -> Responses:
    """Memory for a horizon."""
    return Responses(np.zeros((2, nodes, 2 * blocks + 1)), np.zeros((2, nodes, blocks + 1)), np.zeros((3, nodes, blocks + 1)))


@kernel(part=True)
def respond(model: LinearModel, task: ControlTask, axis: int, number: int, rate: Table) -> None:
    """Write the velocity w of an axis at each node into `rate`: its response to each block; in the last column, the free one.
    `number` is the axis' place in the wrench Z.

        w' = (Z - d(w) w) / m + Gamma    d(w) w linearised around w0: (linear + 2 quadratic |w0|) w - quadratic |w0| w0
        w[k + 1] = exp(-slope dt) w[k] + (1 - exp(-slope dt)) / slope (the rest of w')
    """
    m, linear, quadratic = model.coefficients[0, axis], model.coefficients[1, axis], model.coefficients[2, axis]
    w0, dt = task.state[4 + axis], model.period_s
    horizon, free = model.input.shape
    slope = (linear + 2.0 * quadratic * abs(w0)) / m
    decay = math.exp(-slope * dt)
    phi_dt = (1.0 - decay) / slope
    lacking = task.delivered[number] - task.demand[number]  # of the wrench
    rate[0, free] = w0
    for k in range(horizon):
        for j in range(free):
            rate[k + 1, j] = decay * rate[k, j] + phi_dt * model.input[k, j] / m
        free_acceleration = task.gamma[axis] + (lacking + quadratic * abs(w0) * w0) / m
        rate[k + 1, free] = decay * rate[k, free] + phi_dt * free_acceleration


@kernel(part=True)
def integrate(dt: float, start: float, rate: Table, place: Table) -> None:
    """Place of an axis, by the trapezoidal rule."""
    nodes, columns = rate.shape
    place[0, columns - 1] = start
    for k in range(nodes - 1):
        for j in range(columns):
            place[k + 1, j] = place[k, j] + 0.5 * dt * (rate[k, j] + rate[k + 1, j])


@kernel(part=True)
def move(dt: float, state: Floats, responses: Responses) -> None:
    """(x, y)' = (cos yaw, sin yaw) u, by the trapezoidal rule. Linearised in yaw:

    cos(yaw) u = cos(yaw0) u - sin(yaw0) u0 (yaw - yaw0), sin alike; -yaw0 belongs to the free response alone.
    """
    x, y, yaw, u = responses.place[0], responses.place[1], responses.axial[1], responses.rate[0]
    x0, y0, yaw0, u0 = state[0], state[1], state[3], state[4]
    nodes, columns = x.shape
    n, free = yaw.shape[1] - 1, columns - 1  # columns: n blocks of surge, n of yaw, the free response
    half, cos, sin = 0.5 * dt, math.cos(yaw0), math.sin(yaw0)
    turn_x, turn_y = -sin * u0, cos * u0
    x[0, free], y[0, free] = x0, y0
    for k in range(nodes):
        for j in range(columns):
            is_surge, is_free = j < n, j == free
            step_x, step_y = 0.0, 0.0
            if is_surge or is_free:
                speed = u[k, j if is_surge else n]
                step_x, step_y = half * (cos * speed), half * (sin * speed)
            if not is_surge:
                step_x += half * turn_x * yaw[k, j - n]
                step_y += half * turn_y * yaw[k, j - n]
            if is_free:
                step_x -= half * turn_x * yaw0
                step_y -= half * turn_y * yaw0
            # half of this node's velocity belongs to the interval before it, half to the one after
            if k > 0:
                x[k, j] += step_x
                y[k, j] += step_y
            if k < nodes - 1:
                x[k + 1, j] = x[k, j] + step_x
                y[k + 1, j] = y[k, j] + step_y


@kernel(part=True)
def condense(responses: Responses, task: ControlTask, cost: Cost) -> None:
    """Add the errors to the cost: P = smooth + S'WS, q += S'W (free - reference), nodes 1 on.

    Unknowns are the blocks of surge, yaw and heave, n each: x and y depend on the first two, yaw and z on one. Only the lower
    triangle of P is summed; then it is copied to the upper one.
    """
    x, y, z, yaw = responses.place[0], responses.place[1], responses.axial[0], responses.axial[1]
    reference, weight, p, q = task.reference, task.weight, cost.p, cost.q
    p[:] = cost.smooth
    nodes, free = x.shape[0], x.shape[1] - 1  # column of the free response
    n = free // 2
    for k in range(1, nodes):
        error_x, error_y = x[k, free] - reference[k, 0], y[k, free] - reference[k, 1]
        error_z, error_yaw = z[k, n] - reference[k, 2], yaw[k, n] - reference[k, 3]
        for i in range(free):  # surge and yaw, by x and y
            w_x, w_y = weight[0] * x[k, i], weight[1] * y[k, i]
            q[i] += w_x * error_x + w_y * error_y
            for j in range(i + 1):
                p[i, j] += w_x * x[k, j] + w_y * y[k, j]
        for i in range(n):  # heave by z, yaw by yaw
            w_z, w_yaw = weight[2] * z[k, i], weight[3] * yaw[k, i]
            q[n + i] += w_yaw * error_yaw
            q[free + i] += w_z * error_z
            for j in range(i + 1):
                p[n + i, n + j] += w_yaw * yaw[k, j]
                p[free + i, free + j] += w_z * z[k, j]
    for i in range(3 * n):
        for j in range(i):
            p[j, i] = p[i, j]


@kernel
def linearise_and_condense(model: LinearModel, task: ControlTask, responses: Responses, cost: Cost) -> None:
    """Write the responses and the cost. The first change of surge, heave and yaw counts from the wrench asked for."""
    dt, n = model.period_s, model.input.shape[1]
    rate, axial = responses.rate, responses.axial
    respond(model, task, SURGE, 0, rate[0])
    respond(model, task, HEAVE, 1, rate[1])
    respond(model, task, YAW, 2, rate[2])
    integrate(dt, task.state[HEAVE], rate[1], axial[0])
    integrate(dt, task.state[YAW], rate[2], axial[1])
    move(dt, task.state, responses)
    surge, heave, yaw = 0, 1, 2  # of r and demand; the blocks of q are those of surge, yaw, heave
    cost.q[:] = 0.0
    cost.q[0] = -cost.r[surge] * task.demand[surge]
    cost.q[n] = -cost.r[yaw] * task.demand[yaw]
    cost.q[2 * n] = -cost.r[heave] * task.demand[heave]
    condense(responses, task, cost)


@kernel
def follow_plan(b: Floats, responses: Responses, eta: Table) -> None:
    """Poses `eta` (nodes, 4) under the blocks `b`: surge, yaw, heave."""
    x, y, z, yaw = responses.place[0], responses.place[1], responses.axial[0], responses.axial[1]
    nodes, free = x.shape[0], x.shape[1] - 1
    n = free // 2
    for k in range(nodes):
        at_x, at_y, at_z, at_yaw = x[k, free], y[k, free], z[k, n], yaw[k, n]
        for j in range(free):
            at_x += x[k, j] * b[j]
            at_y += y[k, j] * b[j]
        for j in range(n):
            at_z += z[k, j] * b[free + j]
            at_yaw += yaw[k, j] * b[n + j]
        eta[k, 0], eta[k, 1], eta[k, 2], eta[k, 3] = at_x, at_y, at_z, at_yaw


def block_of(blocks: tuple[int, ...], steps: int) -> Array:
    """Number of the block that acts in each of so many steps; the last one acts to the end."""
    return np.minimum(np.searchsorted(np.cumsum(blocks), np.arange(steps), "right"), len(blocks) - 1)


def make_linear_model(model: Model, period_s: float, horizon: int, blocks: tuple[int, ...]) -> LinearModel:
    """The model on a horizon of `horizon` steps, with inputs held over `blocks`."""
    return LinearModel(model.coefficients, period_s, np.eye(len(blocks))[block_of(blocks, horizon)])

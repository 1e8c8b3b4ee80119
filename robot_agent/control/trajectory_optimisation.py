"""The best flight of a robot without side force to a moving goal: an optimal-control problem, solved by iterated LQ problems.

Place, heading, velocity and thrust over a row of nodes, `h` seconds apart, with the equations of dynamics.py in the plane:

    s = (x, y, yaw, u, v, r, surge N, yaw N m)        inputs: rates of both thrusts (N/s, N m/s), constant between two nodes

Velocities are in the body frame and through the water; nodes advance by the midpoint rule. The lag of the thrusters is not in
here: s begins that much later. Cost: squared errors of place, heading and, at the end, velocity against the goals, squared
inputs, and squared deviations of surge's input from that of a plan. Bounds: both inputs, and both thrusts at the nodes.

The problem has many local minima (turn left or right, fly ahead or astern), so a first guess decides. From there on (iterative
LQR, Li and Todorov 2004; bounds on the inputs as in Tassa, Mansard and Todorov 2014): linearise along the flight, solve the LQ
problem backwards, fly the changed inputs, and keep them only if they cost less.
"""

import math

import numpy as np

from wire.frames import Array
from wire.kernels import kernel

STATES, INPUTS = 8, 2
GOALS = 5  # columns of a goal: x, y, yaw, and the velocity x, y through the water, in the pool frame
WEIGHTS = 11  # per second x, y, yaw, yaw rate, inputs; at the end place, yaw, velocity, yaw rate; surge's input off the plan
SHORTER, SHORTEST = 0.4, 6  # a step that does not pay is shortened by this, so many times
LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e6  # share by which the inputs' weights are larger while linearising
ENOUGH = 1e-4  # of the cost: an iteration that brings less is the last
NEAR_M, RUSH_S = 0.05, 4.0  # of a first guess
STIFF, DAMP = 0.35, 1.2  # 1/s^2 and 1/s, per mass: critically damped, as quick as thrust allows 0.3 m away
TURN_STIFF, TURN_DAMP = 2.1, 2.9  # 1/s^2 and 1/s, per inertia


@kernel("UniTuple(f8,6)(f8[:,::1], f8, c16, f8[::1], f8, f8, f8, f8, f8, f8)", part=True)
def motion(
    model: Array,
    sway: float,
    water: complex,
    gamma: Array,
    yaw: float,
    u: float,
    v: float,
    r: float,
    surge: float,
    turn: float,
) -> tuple[float, float, float, float, float, float]:
    """Rates of x, y, yaw, u, v, r under the thrusts `surge` (N) and `turn` (N m), in water that streams at `water`."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    speed, c = math.sqrt(u * u + v * v), model[0, 1] / model[0, 0]
    return (
        cos * u - sin * v + water.real,
        sin * u + cos * v + water.imag,
        r,
        (surge - (model[1, 0] + model[2, 0] * speed) * u) / model[0, 0] + c * v * r + gamma[0],
        sway * (gamma[1] - (model[1, 1] + model[2, 1] * speed) * v / model[0, 1] - u * r / c),
        (turn - (model[1, 3] + model[2, 3] * abs(r)) * r) / model[0, 3] + gamma[3],
    )


@kernel("UniTuple(f8,6)(f8[:,::1], f8, c16, f8[::1], f8, f8[::1], f8, f8)", part=True)
def midpoint(
    model: Array, sway: float, water: complex, gamma: Array, h: float, s: Array, surge_rate: float, turn_rate: float
) -> tuple[float, float, float, float, float, float]:
    """yaw, u, v, r and both thrusts half a step after the state `s` (8,)."""
    half = 0.5 * h
    _, _, yaw, u, v, r = motion(model, sway, water, gamma, s[2], s[3], s[4], s[5], s[6], s[7])
    return (
        s[2] + half * yaw, s[3] + half * u, s[4] + half * v, s[5] + half * r, s[6] + half * surge_rate,
        s[7] + half * turn_rate,
    )  # fmt: skip


@kernel("void(f8[:,::1], f8, c16, f8[::1], f8, f8[::1], f8, f8, f8[::1])", part=True)
def advance_node(
    model: Array,
    sway: float,
    water: complex,
    gamma: Array,
    h: float,
    s: Array,
    surge_rate: float,
    turn_rate: float,
    out: Array,
) -> None:
    """State `out` (8,) at the next node."""
    yaw, u, v, r, surge, turn = midpoint(model, sway, water, gamma, h, s, surge_rate, turn_rate)
    x_rate, y_rate, yaw_rate, u_rate, v_rate, r_rate = motion(model, sway, water, gamma, yaw, u, v, r, surge, turn)
    out[0], out[1], out[2] = s[0] + h * x_rate, s[1] + h * y_rate, s[2] + h * yaw_rate
    out[3], out[4], out[5] = s[3] + h * u_rate, s[4] + h * v_rate, s[5] + h * r_rate
    out[6], out[7] = s[6] + h * surge_rate, s[7] + h * turn_rate


@kernel("void(f8[:,::1], f8, f8, f8, f8, f8, f8[:,::1])", part=True)
def slopes(model: Array, sway: float, yaw: float, u: float, v: float, r: float, j: Array) -> None:
    """Derivatives `j` (6, 6) of `motion` by yaw, u, v, r and both thrusts."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    speed, c = math.sqrt(u * u + v * v), model[0, 1] / model[0, 0]
    bend = 1.0 / speed if speed > 0.0 else 0.0
    j[:] = 0.0
    j[0, 0], j[0, 1], j[0, 2] = -sin * u - cos * v, cos, -sin
    j[1, 0], j[1, 1], j[1, 2] = cos * u - sin * v, sin, cos
    j[2, 3] = 1.0
    j[3, 1] = -(model[1, 0] + model[2, 0] * (speed + u * u * bend)) / model[0, 0]
    j[3, 2] = c * r - model[2, 0] * u * v * bend / model[0, 0]
    j[3, 3], j[3, 4] = c * v, 1.0 / model[0, 0]
    j[4, 1] = -sway * (model[2, 1] * u * v * bend / model[0, 1] + r / c)
    j[4, 2] = -sway * (model[1, 1] + model[2, 1] * (speed + v * v * bend)) / model[0, 1]
    j[4, 3] = -sway * u / c
    j[5, 3], j[5, 5] = -(model[1, 3] + 2.0 * model[2, 3] * abs(r)) / model[0, 3], 1.0 / model[0, 3]


@kernel("f8(f8[::1], f8[::1], f8[::1], f8, b1)", part=True)
def node_cost(s: Array, goal: Array, weight: Array, h: float, at_end: bool) -> float:
    """Cost of the state `s` (8,) at a node."""
    x, y, yaw = s[0] - goal[0], s[1] - goal[1], s[2] - goal[2]
    cost = h * (weight[0] * x * x + weight[1] * y * y + weight[2] * yaw * yaw + weight[3] * s[5] * s[5])
    if at_end:
        cos, sin = math.cos(s[2]), math.sin(s[2])
        slip_x, slip_y = cos * s[3] - sin * s[4] - goal[3], sin * s[3] + cos * s[4] - goal[4]
        cost += weight[6] * (x * x + y * y) + weight[7] * yaw * yaw + weight[9] * s[5] * s[5]
        cost += weight[8] * (slip_x * slip_x + slip_y * slip_y)
    return float(cost)


@kernel("void(f8[::1], f8[::1], f8[::1], f8, b1, f8[::1], f8[:,::1])", part=True)
def add_node(s: Array, goal: Array, weight: Array, h: float, at_end: bool, slope: Array, bend: Array) -> None:
    """Add half the derivatives of `node_cost` to `slope` (8,), and of its second ones what is never negative to `bend`."""
    end = 1.0 if at_end else 0.0
    x, y = h * weight[0] + end * weight[6], h * weight[1] + end * weight[6]
    yaw, r = h * weight[2] + end * weight[7], h * weight[3] + end * weight[9]
    slope[0] += x * (s[0] - goal[0])
    slope[1] += y * (s[1] - goal[1])
    slope[2] += yaw * (s[2] - goal[2])
    slope[5] += r * s[5]
    bend[0, 0] += x
    bend[1, 1] += y
    bend[2, 2] += yaw
    bend[5, 5] += r
    if at_end:
        cos, sin = math.cos(s[2]), math.sin(s[2])
        going_x, going_y = cos * s[3] - sin * s[4], sin * s[3] + cos * s[4]
        by = ((-going_y, going_x), (cos, sin), (-sin, cos))  # slopes of the velocity in the pool frame by yaw, u, v
        slip_x, slip_y = going_x - goal[3], going_y - goal[4]
        for i in range(3):
            slope[2 + i] += weight[8] * (by[i][0] * slip_x + by[i][1] * slip_y)
            for j in range(3):
                bend[2 + i, 2 + j] += weight[8] * (by[i][0] * by[j][0] + by[i][1] * by[j][1])


@kernel("UniTuple(f8,2)(f8, f8, f8, f8)", part=True)
def bounds(thrust: float, limit: float, most: float, h: float) -> tuple[float, float]:
    """Least and largest rate of a `thrust` that keeps to its `limit`; both at most `most`."""
    return max(-most, (-limit - thrust) / h), min(most, (limit - thrust) / h)


@kernel(
    "f8(f8[:,::1], f8, c16, f8[::1], f8, f8[:,::1], f8[::1], f8[::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,:,::1],"
    " f8[:,::1], f8, f8[:,::1], f8[:,::1])",
    part=True,
)
def fly(
    model: Array,
    sway: float,
    water: complex,
    gamma: Array,
    h: float,
    goals: Array,
    planned: Array,
    weight: Array,
    limit: Array,
    states: Array,
    inputs: Array,
    gains: Array,
    change: Array,
    share: float,
    new_states: Array,
    new_inputs: Array,
) -> float:
    """Fly a `share` of the `change` (nodes - 1, 2) of the inputs, with feedback by the `gains` (nodes - 1, 2, 8) to the flight
    `states` (nodes, 8), `inputs` (nodes - 1, 2), from its first state. `limit` (2, 2): of thrusts and of their rates. Returns
    the cost of what was flown."""
    last = len(inputs)
    cost = 0.0
    for i in range(8):
        new_states[0, i] = states[0, i]
    for k in range(last):
        for c in range(2):
            rate = inputs[k, c] + share * change[k, c]
            for i in range(8):
                rate += gains[k, c, i] * (new_states[k, i] - states[k, i])
            low, high = bounds(new_states[k, 6 + c], limit[0, c], limit[1, c], h)
            new_inputs[k, c] = min(max(rate, low), high)
            cost += h * weight[4 + c] * new_inputs[k, c] ** 2
        cost += h * weight[10] * (new_inputs[k, 0] - planned[k]) ** 2
        advance_node(
            model, sway, water, gamma, h, new_states[k], new_inputs[k, 0], new_inputs[k, 1], new_states[k + 1]
        )  # fmt: skip
        cost += node_cost(new_states[k + 1], goals[k + 1], weight, h, k + 1 == last)
    return cost


@kernel("UniTuple(f8,2)(f8, f8, f8, f8, f8, f8, f8, f8, f8)", part=True)
def least_in_box(
    q00: float, q01: float, q11: float, g0: float, g1: float, low0: float, high0: float, low1: float, high1: float
) -> tuple[float, float]:
    """The d that makes d'Qd / 2 + g'd least within a box: inside, or else on one of the four edges."""
    det = q00 * q11 - q01 * q01
    d0, d1 = (q01 * g1 - q11 * g0) / det, (q01 * g0 - q00 * g1) / det
    if low0 <= d0 <= high0 and low1 <= d1 <= high1:
        return d0, d1
    least = math.inf
    for edge in range(4):
        if edge < 2:
            e0 = low0 if edge == 0 else high0
            e1 = min(max(-(g1 + q01 * e0) / q11, low1), high1)
        else:
            e1 = low1 if edge == 2 else high1
            e0 = min(max(-(g0 + q01 * e1) / q00, low0), high0)
        value = 0.5 * (q00 * e0 * e0 + 2.0 * q01 * e0 * e1 + q11 * e1 * e1) + g0 * e0 + g1 * e1
        if value < least:
            least, d0, d1 = value, e0, e1
    return d0, d1


@kernel(
    "void(f8[:,::1], f8, c16, f8[::1], f8, f8[:,::1], f8[::1], f8[::1], f8[:,::1], f8[:,::1], f8[:,::1], f8,"
    " f8[:,:,::1], f8[:,:,::1], f8[:,::1])",
    part=True,
)
def improve(
    model: Array,
    sway: float,
    water: complex,
    gamma: Array,
    h: float,
    goals: Array,
    planned: Array,
    weight: Array,
    limit: Array,
    states: Array,
    inputs: Array,
    damping: float,
    work: Array,
    gains: Array,
    change: Array,
) -> None:
    """Solve the LQ problem along a flight, from its end on: `change` (nodes - 1, 2) of its inputs within the bounds, and
    `gains` (nodes - 1, 2, 8) by which they follow a state that is off. An input at a bound follows nothing. `work` (3, 8, 8)
    is overwritten."""
    at, between = np.empty((6, 6)), np.empty((6, 6))
    a, va, bend = work[0], work[1], work[2]
    slope, before = np.zeros(8), np.zeros(8)
    cross = np.zeros((2, 8))
    by_surge, by_turn = 0.5 * h * h / model[0, 0], 0.5 * h * h / model[0, 3]  # of u and r in a step, by the rates
    a[:] = 0.0
    bend[:] = 0.0
    last = len(inputs)
    for k in range(last - 1, -1, -1):
        add_node(states[k + 1], goals[k + 1], weight, h, k + 1 == last, slope, bend)
        s = states[k]
        yaw, u, v, r, _, _ = midpoint(model, sway, water, gamma, h, s, inputs[k, 0], inputs[k, 1])
        slopes(model, sway, s[2], s[3], s[4], s[5], at)
        slopes(model, sway, yaw, u, v, r, between)
        for i in range(6):  # the step's derivative less the identity, a: its columns are yaw, u, v, r and both thrusts
            for j in range(6):
                total = between[i, j]
                for m in range(4):
                    total += 0.5 * h * between[i, m] * at[2 + m, j]
                a[i, 2 + j] = h * total
        for i in range(8):  # bend (1 + a)
            for j in range(8):
                total = bend[i, j]
                if j >= 2:
                    for m in range(6):
                        total += bend[i, m] * a[m, j]
                va[i, j] = total
        w0, w1 = h * (weight[4] + weight[10]), h * weight[5]
        g0 = w0 * inputs[k, 0] - h * weight[10] * planned[k] + by_surge * slope[3] + h * slope[6]
        g1 = w1 * inputs[k, 1] + by_turn * slope[5] + h * slope[7]
        q00 = w0 * (1.0 + damping) + by_surge * (by_surge * bend[3, 3] + 2.0 * h * bend[3, 6]) + h * h * bend[6, 6]
        q11 = w1 * (1.0 + damping) + by_turn * (by_turn * bend[5, 5] + 2.0 * h * bend[5, 7]) + h * h * bend[7, 7]
        q01 = by_surge * (by_turn * bend[3, 5] + h * bend[3, 7]) + h * (by_turn * bend[5, 6] + h * bend[6, 7])
        for j in range(8):
            cross[0, j] = by_surge * va[3, j] + h * va[6, j]
            cross[1, j] = by_turn * va[5, j] + h * va[7, j]
            total = slope[j]
            if j >= 2:
                for m in range(6):
                    total += a[m, j] * slope[m]
            before[j] = total
        for i in range(8):  # (1 + a)' bend (1 + a)
            for j in range(i + 1):
                total = va[i, j]
                if i >= 2:
                    for m in range(6):
                        total += a[m, i] * va[m, j]
                bend[i, j] = bend[j, i] = total
        low0, high0 = bounds(s[6], limit[0, 0], limit[1, 0], h)
        low1, high1 = bounds(s[7], limit[0, 1], limit[1, 1], h)
        low0, high0, low1, high1 = low0 - inputs[k, 0], high0 - inputs[k, 0], low1 - inputs[k, 1], high1 - inputs[k, 1]
        d0, d1 = least_in_box(q00, q01, q11, g0, g1, low0, high0, low1, high1)
        free0, free1 = low0 < d0 < high0, low1 < d1 < high1
        det = q00 * q11 - q01 * q01
        for j in range(8):
            if free0 and free1:
                gains[k, 0, j] = (q01 * cross[1, j] - q11 * cross[0, j]) / det
                gains[k, 1, j] = (q01 * cross[0, j] - q00 * cross[1, j]) / det
            else:
                gains[k, 0, j] = -cross[0, j] / q00 if free0 else 0.0
                gains[k, 1, j] = -cross[1, j] / q11 if free1 else 0.0
        change[k, 0], change[k, 1] = d0, d1
        left0, left1 = g0 + q00 * d0 + q01 * d1, g1 + q01 * d0 + q11 * d1
        for i in range(8):
            k0, k1 = gains[k, 0, i], gains[k, 1, i]
            slope[i] = before[i] + k0 * left0 + k1 * left1 + cross[0, i] * d0 + cross[1, i] * d1
            by0, by1 = k0 * q00 + k1 * q01 + cross[0, i], k0 * q01 + k1 * q11 + cross[1, i]
            for j in range(i + 1):
                bend[i, j] += by0 * gains[k, 0, j] + by1 * gains[k, 1, j] + k0 * cross[0, j] + k1 * cross[1, j]
                bend[j, i] = bend[i, j]


@kernel(
    "f8(f8[:,::1], f8, c16, f8[::1], f8, f8[:,::1], f8[::1], f8[::1], f8[:,::1], i8, f8[:,::1], f8[:,::1], f8[::1],"
    " f8[:,:,::1], f8[:,:,::1], f8[:,::1], f8[:,::1], f8[:,::1])"
)
def optimise(
    model: Array,
    sway: float,
    water: complex,
    gamma: Array,
    h: float,
    goals: Array,
    planned: Array,
    weight: Array,
    limit: Array,
    iterations: int,
    states: Array,
    inputs: Array,
    damping: Array,
    work: Array,
    gains: Array,
    change: Array,
    new_states: Array,
    new_inputs: Array,
) -> float:
    """Make a flight better by at most so many iterations: `states` (nodes, 8), from the first one, which stays, and `inputs`
    (nodes - 1, 2) are written. Returns the cost.

    `model` (3, 4) and Gamma (4,) as in dynamics.py; `goals` (nodes, 5), their headings without jumps; `planned` (nodes - 1,),
    surge's input of a plan; `weight` (11,); `limit` (2, 2): of thrusts and of their rates; `damping` (1,) is kept from call to
    call. The others are overwritten.
    """
    gains[:] = 0.0
    change[:] = 0.0
    cost = fly(
        model, sway, water, gamma, h, goals, planned, weight, limit, states, inputs, gains, change, 0.0, new_states, new_inputs
    )
    states[:] = new_states
    inputs[:] = new_inputs
    for _ in range(iterations):
        improve(model, sway, water, gamma, h, goals, planned, weight, limit, states, inputs, damping[0], work, gains, change)
        share, better = 1.0, False
        for _ in range(SHORTEST):
            found = fly(
                model, sway, water, gamma, h, goals, planned, weight, limit, states, inputs, gains, change, share, new_states,
                new_inputs,
            )  # fmt: skip
            better = found < cost
            if better:
                break
            share *= SHORTER
        if not better:
            damping[0] *= 10.0
            if damping[0] > MOST_DAMPING:
                break
            continue
        gained = cost - found
        cost = found
        states[:] = new_states
        inputs[:] = new_inputs
        damping[0] = max(0.3 * damping[0], LEAST_DAMPING)
        if gained < ENOUGH * cost:
            break
    return cost


@kernel("void(f8[:,::1], f8, c16, f8[::1], f8, f8[:,::1], f8[:,::1], f8, f8[:,::1], f8[:,::1])")
def guess(
    model: Array,
    sway: float,
    water: complex,
    gamma: Array,
    h: float,
    goals: Array,
    limit: Array,
    ahead: float,
    states: Array,
    inputs: Array,
) -> None:
    """A flight to begin with, written into `states` (nodes, 8), from the first one on, and `inputs` (nodes - 1, 2): a robot
    that points at its goal, or with `ahead` -1 away from it, while that is NEAR_M away and RUSH_S last, then along the goal's
    heading, and pushes as much of the force of a spring and a damper as lies along its own heading."""
    for k in range(len(inputs)):
        s, goal = states[k], goals[k]
        cos, sin = math.cos(s[2]), math.sin(s[2])
        off_x, off_y = goal[0] - s[0], goal[1] - s[1]
        slip_x, slip_y = goal[3] - (cos * s[3] - sin * s[4]), goal[4] - (sin * s[3] + cos * s[4])
        wanted = goal[2]
        if off_x * off_x + off_y * off_y > NEAR_M**2 and k * h < RUSH_S:
            wanted = math.atan2(ahead * off_y, ahead * off_x)
        turn = wanted - s[2]
        turn -= 2.0 * math.pi * np.rint(turn / (2.0 * math.pi))
        force_x, force_y = STIFF * off_x + DAMP * slip_x, STIFF * off_y + DAMP * slip_y
        surge = model[0, 0] * (cos * force_x + sin * force_y)
        moment = model[0, 3] * (TURN_STIFF * turn - TURN_DAMP * s[5])
        for c in range(2):
            thrust = min(max(surge if c == 0 else moment, -limit[0, c]), limit[0, c])
            inputs[k, c] = min(max((thrust - s[6 + c]) / h, -limit[1, c]), limit[1, c])
        advance_node(model, sway, water, gamma, h, s, inputs[k, 0], inputs[k, 1], states[k + 1])

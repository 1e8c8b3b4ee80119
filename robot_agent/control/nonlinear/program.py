"""The optimisation: the cost of a flight, its quadratic program, and one iteration of it. Pure.

    J = integral |p - p_ref|^2 + a^2 w (yaw - yaw_ref)^2 + s^2 r^2 + sum rho_i (dF_i/dt)^2 dt          m^2 s
        + T |p - p_ref + t (p' - p_ref')|^2 + a^2 w b (yaw - yaw_ref)^2 at the end, + sigma (deepest entry into a half-space)^2

While a person steers, |e|^2 is the square of the part along yaw_ref alone: nobody asks for a line.

Gauss-Newton about the flight there is: the Hessian is that of the squares of the linearised terms. The program is condensed:
its unknowns are changes of the commands at the nodes, and one slack. `active_set.solve_from` solves it, from the rows that
were active last. Along its step the flight is tried on the nonlinear cost, and the step shortened while that is no better.
"""

import math
from typing import NamedTuple

import numpy as np

from robot_agent.control.active_set import NO_BOUND, ActiveSet, ConvexProgram, solve_from
from robot_agent.control.nonlinear.obstacle_rows import MOST_ROWS, HalfPlanes, Surrounds, find_rows, make_half_planes
from robot_agent.control.nonlinear.prediction import (
    NODES,
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
    make_flight,
    move_on,
    predict,
)
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Cube, Floats, Ints, Table

SHORTER = 0.4  # factor of a step that made the flight worse
LEAST_STEP = 0.1  # below, the flight stays as it is: at most four are tried
LEVEL = 1e-9  # of the cost: at its minimum, rounding makes a step look worse
DAMPING = 1e-9  # of the Hessian's diagonal: directions that cost nothing stay defined


class Course(NamedTuple):
    """Reference at nodes 1.."""

    place: Table  # (nodes, 2) m
    velocity: Table  # (nodes, 2) over ground, m/s
    yaw: Floats  # (nodes,) with whole turns, rad
    yaw_weight: Floats  # (nodes,) a^2 w, m^2/rad^2


class Weights(NamedTuple):
    """Weights of the cost. That of the place is 1."""

    rate: Floats  # (axes,) rho, m^2 s^2/N^2 and m^2 s^2/(N m)^2
    turning_m2: float  # s^2, m^2 s^2/rad^2
    end_s: float  # T
    lead_s: float  # t
    facing_s: float  # b
    entry: float  # sigma, s
    is_steered: bool  # errors of the place count along the heading alone


class InputLimits(NamedTuple):
    size: Floats  # (axes,) N or N m
    rate: Floats  # (axes,) per second


class PlanProblem(NamedTuple):
    """Everything that one step's program is made of, beside the model."""

    start: Start
    course: Course
    weights: Weights
    limits: InputLimits
    surrounds: Surrounds


class QuadraticProgram(NamedTuple):
    hessian: Table
    gradient: Floats
    matrix: Table  # rows: sizes of commands, their changes, half-spaces
    lower: Floats
    upper: Floats
    held: Ints
    work: Cube
    multiplier: Floats
    change: Floats
    dual: Floats
    row: Floats
    old: Table  # (nodes, axes)


class Memory(NamedTuple):
    """A flight with its program and half-spaces: what goes on from step to step."""

    flight: PlannedFlight
    program: QuadraticProgram
    rows: HalfPlanes


class Iteration(NamedTuple):
    before: float  # cost, m^2 s
    after: float
    share: float  # of the program's step
    rounds: int  # of the solver; 0: no solution, the flight is the one before
    entry_m: float  # deepest entry into a half-space, in units of its give
    binds: bool  # a half-space shapes the flight


def make_memory(axes: int) -> Memory:
    """Memory for a vehicle with so many axes. The program's variables are changes of the commands and, last, the slack."""
    commands = NODES * axes
    variables, rows = commands + 1, 2 * commands + MOST_ROWS
    matrix = np.zeros((rows, variables))
    matrix[:commands, :commands] = np.eye(commands)
    matrix[commands : 2 * commands, :commands] = np.eye(commands) - np.eye(commands, k=-axes)
    program = QuadraticProgram(
        hessian=np.zeros((variables, variables)),
        gradient=np.zeros(variables),
        matrix=matrix,
        lower=np.zeros(rows),
        upper=np.zeros(rows),
        held=np.zeros(rows, np.int64),
        work=np.zeros((4, variables, variables)),
        multiplier=np.zeros(variables),
        change=np.zeros(variables),
        dual=np.zeros(rows),
        row=np.zeros(commands),
        old=np.zeros((NODES, axes)),
    )
    return Memory(make_flight(axes), program, make_half_planes())


@kernel(part=True)
def end_error(dynamics: Dynamics, problem: PlanProblem, state: Floats) -> tuple[float, float, float]:
    """The last node's error of place and velocity, p - p_ref + t (p' - p_ref'), m, and that of its heading."""
    course, lead_s, last = problem.course, problem.weights.lead_s, len(problem.course.yaw) - 1
    cos, sin = math.cos(state[YAW]), math.sin(state[YAW])
    x_mps = cos * state[U] - sin * state[V] + dynamics.water.current_x_mps
    y_mps = sin * state[U] + cos * state[V] + dynamics.water.current_y_mps
    return (
        state[X] - course.place[last, 0] + lead_s * (x_mps - course.velocity[last, 0]),
        state[Y] - course.place[last, 1] + lead_s * (y_mps - course.velocity[last, 1]),
        state[YAW] - course.yaw[last],
    )


@kernel(part=True)
def counted(weights: Weights, yaw: float, ex: float, ey: float) -> tuple[float, float]:
    """The part of an error of the place that counts, as two numbers whose squares are summed."""
    return (math.cos(yaw) * ex + math.sin(yaw) * ey, 0.0) if weights.is_steered else (ex, ey)


@kernel(part=True)
def deepest_entry(rows: HalfPlanes, state: Table) -> float:
    """Deepest entry of a flight's states (nodes, 9) into a half-space, in units of its give; 0 if there is none."""
    deepest = 0.0
    for i in range(rows.used[0]):
        here = state[rows.node[i]]
        inside = rows.offset_m[i] - rows.normal[i, 0] * here[X] - rows.normal[i, 1] * here[Y]
        deepest = max(deepest, inside / rows.give[i])
    return deepest


@kernel(part=True)
def cost_of(dynamics: Dynamics, grid: Grid, problem: PlanProblem, memory: Memory) -> float:
    """J of a flight."""
    course, weights, flight = problem.course, problem.weights, memory.flight
    last = len(flight.state) - 1
    total: float = 0.0
    for k in range(last + 1):
        s = flight.state[k]
        ex, ey = counted(weights, course.yaw[k], s[X] - course.place[k, 0], s[Y] - course.place[k, 1])
        turned = s[YAW] - course.yaw[k]
        total += grid.share_s[k] * (
            ex * ex + ey * ey + course.yaw_weight[k] * turned * turned + weights.turning_m2 * s[R] * s[R]
        )
        span_s = grid.time_s[k + 1] - grid.time_s[k]
        for i in range(len(grid.axes)):
            before = problem.start.command[i] if k == 0 else flight.command[k - 1, i]
            total += weights.rate[i] * (flight.command[k, i] - before) ** 2 / span_s
    ex, ey, turned = end_error(dynamics, problem, flight.state[last])
    ex, ey = counted(weights, course.yaw[last], ex, ey)
    total += weights.end_s * (ex * ex + ey * ey) + weights.facing_s * course.yaw_weight[last] * turned * turned
    total += weights.entry * deepest_entry(memory.rows, flight.state) ** 2
    return total


@kernel(part=True)
def add_square(weight: float, error: float, row: Floats, reached: int, program: QuadraticProgram) -> None:
    """Add the square of one linearised term: weight (error + row . change)^2 / 2, `row` (reached,)."""
    for j in range(reached):
        one = weight * row[j]
        program.gradient[j] += one * error
        for i in range(j + 1):
            program.hessian[j, i] += one * row[i]


@kernel(part=True)
def add_place(
    weights: Weights, weight: float, yaw: float, error: tuple[float, float], row_x: Floats, row_y: Floats, reached: int,
    program: QuadraticProgram,
) -> None:  # fmt: skip
    """Add the squares of an error of the place with its derivatives `row_x`, `row_y` (reached,): of all of it, or of what
    counts. `row_x` is overwritten then."""
    if weights.is_steered:
        cos, sin = math.cos(yaw), math.sin(yaw)
        for j in range(reached):
            row_x[j] = cos * row_x[j] + sin * row_y[j]
        add_square(weight, cos * error[0] + sin * error[1], row_x, reached, program)
        return
    add_square(weight, error[0], row_x, reached, program)
    add_square(weight, error[1], row_y, reached, program)


@kernel(part=True)
def add_end(dynamics: Dynamics, problem: PlanProblem, flight: PlannedFlight, program: QuadraticProgram) -> None:
    """Add the squares of the last node's error of place and velocity, and of its heading."""
    last, lead_s = len(flight.state) - 1, problem.weights.lead_s
    state, slope = flight.state[last], flight.slope[last]
    cos, sin, row, aside_row = math.cos(state[YAW]), math.sin(state[YAW]), program.row, program.change
    ahead, aside = cos * state[U] - sin * state[V], sin * state[U] + cos * state[V]
    ex, ey, turned = end_error(dynamics, problem, state)
    for j in range(len(row)):
        row[j] = slope[X, j] + lead_s * (cos * slope[U, j] - sin * slope[V, j] - aside * slope[YAW, j])
        aside_row[j] = slope[Y, j] + lead_s * (sin * slope[U, j] + cos * slope[V, j] + ahead * slope[YAW, j])
    weights, yaw = problem.weights, problem.course.yaw[last]
    add_place(weights, weights.end_s, yaw, (ex, ey), row, aside_row, len(row), program)
    facing = problem.weights.facing_s * problem.course.yaw_weight[last]
    if facing > 0.0:
        add_square(facing, turned, slope[YAW], len(row), program)


@kernel(part=True)
def condense(dynamics: Dynamics, grid: Grid, problem: PlanProblem, flight: PlannedFlight, program: QuadraticProgram) -> None:
    """Hessian and gradient by changes of the commands, and by the slack."""
    course, weights, axes = problem.course, problem.weights, len(grid.axes)
    size, hessian, gradient = len(program.row), program.hessian, program.gradient
    hessian[:] = 0.0
    gradient[:] = 0.0
    for k in range(len(flight.state)):
        s, slope, share_s, reached = flight.state[k], flight.slope[k], grid.share_s[k], axes * (k + 1)
        error = (s[X] - course.place[k, 0], s[Y] - course.place[k, 1])
        for j in range(reached):
            program.row[j], program.change[j] = slope[X, j], slope[Y, j]
        add_place(weights, share_s, course.yaw[k], error, program.row, program.change, reached, program)
        if course.yaw_weight[k] > 0.0:
            add_square(share_s * course.yaw_weight[k], s[YAW] - course.yaw[k], slope[YAW], reached, program)
        if weights.turning_m2 > 0.0:
            add_square(share_s * weights.turning_m2, s[R], slope[R], reached, program)
        span_s = grid.time_s[k + 1] - grid.time_s[k]
        for i in range(axes):
            weight, j = weights.rate[i] / span_s, axes * k + i
            change = flight.command[k, i] - (problem.start.command[i] if k == 0 else flight.command[k - 1, i])
            hessian[j, j] += weight
            gradient[j] += weight * change
            if k > 0:
                hessian[j - axes, j - axes] += weight
                hessian[j, j - axes] -= weight
                gradient[j - axes] -= weight * change
    add_end(dynamics, problem, flight, program)
    for j in range(size):
        hessian[j, j] *= 1.0 + DAMPING
        for i in range(j):
            hessian[i, j] = hessian[j, i]
    hessian[size, size] = weights.entry


@kernel(part=True)
def set_bounds(grid: Grid, problem: PlanProblem, memory: Memory) -> None:
    """Bounds of all rows, and the half-spaces' rows. No change at all is always within the bounds of the commands: what is
    beyond them already may not go farther."""
    flight, program, rows, axes = memory.flight, memory.program, memory.rows, len(grid.axes)
    size, lower, upper = len(program.row), program.lower, program.upper
    for k in range(len(flight.state)):
        for i in range(axes):
            j, most = axes * k + i, problem.limits.rate[i] * (grid.time_s[k + 1] - grid.time_s[k])
            now, limit = flight.command[k, i], problem.limits.size[i]
            change = now - (problem.start.command[i] if k == 0 else flight.command[k - 1, i])
            lower[j], upper[j] = min(-limit - now, 0.0), max(limit - now, 0.0)
            lower[size + j], upper[size + j] = min(-most - change, 0.0), max(most - change, 0.0)
    for i in range(rows.used[0]):
        k, row = rows.node[i], 2 * size + i
        state, slope, x, y = flight.state[k], flight.slope[k], rows.normal[i, 0], rows.normal[i, 1]
        for j in range(size):
            program.matrix[row, j] = x * slope[X, j] + y * slope[Y, j]
        program.matrix[row, size] = rows.give[i]
        lower[row], upper[row] = rows.offset_m[i] - x * state[X] - y * state[Y], NO_BOUND
    program.held[2 * size + rows.used[0] :] = 0


@kernel
def take_change(dynamics: Dynamics, grid: Grid, problem: PlanProblem, memory: Memory, before: float, rounds: int) -> Iteration:
    """Line search: add the program's change to the commands, or the first share of it, from all down by SHORTER, that does not
    raise the cost above `before`; no change if there is none. `memory.flight` holds the result."""
    flight, program, axes = memory.flight, memory.program, len(grid.axes)
    program.old[:] = flight.command
    share, after = 1.0, before
    while share > LEAST_STEP:
        for k in range(len(flight.state)):
            for i in range(axes):
                flight.command[k, i] = program.old[k, i] + share * program.change[axes * k + i]
        predict(dynamics, grid, problem.start, flight, False)
        after = cost_of(dynamics, grid, problem, memory)
        if after <= before * (1.0 + LEVEL):  # false for NaN
            break
        share *= SHORTER
    if not after <= before * (1.0 + LEVEL):
        flight.command[:] = program.old
        predict(dynamics, grid, problem.start, flight, False)
        share, after = 0.0, before
    entry_m, binds = deepest_entry(memory.rows, flight.state), False
    for i in range(2 * len(program.row), 2 * len(program.row) + memory.rows.used[0]):
        binds |= program.held[i] != 0
    return Iteration(before, after, share, rounds, entry_m, binds)


@kernel
def open_program(memory: Memory) -> tuple[ConvexProgram, ActiveSet]:
    """The program of the last iteration with the rows in use, and where its solution belongs."""
    program = memory.program
    count = 2 * len(program.row) + memory.rows.used[0]
    return (
        ConvexProgram(program.hessian, program.gradient, program.matrix[:count], program.lower[:count], program.upper[:count]),
        ActiveSet(program.change, program.dual[:count], program.held[:count], program.work, program.multiplier),
    )


@kernel
def step_plan(dynamics: Dynamics, grid: Grid, problem: PlanProblem, memory: Memory, by_s: float) -> Iteration:
    """The plan of `by_s` ago moved on to now, and one iteration on it, in place."""
    flight, program = memory.flight, memory.program
    move_on(grid, by_s, flight)
    predict(dynamics, grid, problem.start, flight, True)
    find_rows(problem.surrounds, grid, flight.state, memory.rows)
    before = cost_of(dynamics, grid, problem, memory)
    condense(dynamics, grid, problem, flight, program)
    set_bounds(grid, problem, memory)
    convex, working = open_program(memory)
    rounds = solve_from(convex, working)
    if rounds == 0:
        program.held[:] = 0
        return Iteration(before, before, 0.0, 0, deepest_entry(memory.rows, flight.state), memory.rows.used[0] > 0)
    return take_change(dynamics, grid, problem, memory, before, rounds)


@kernel
def appraise(dynamics: Dynamics, grid: Grid, problem: PlanProblem, memory: Memory) -> float:
    """Cost of a flight as it is; its states are written."""
    predict(dynamics, grid, problem.start, memory.flight, False)
    find_rows(problem.surrounds, grid, memory.flight.state, memory.rows)
    return cost_of(dynamics, grid, problem, memory)

"""The quadratic program against residuals, finite differences and OSQP; limits, half-spaces, and numbers that are none."""

import math

import numpy as np
import osqp
import pytest
from scipy import sparse

from robot_agent.control.nonlinear.obstacle_rows import NO_BODIES, MovingBodies, Surrounds, outlines_of
from robot_agent.control.nonlinear.prediction import Grid, PlannedFlight, Start, fly, make_flight
from robot_agent.control.nonlinear.program import Memory, PlanProblem, appraise, make_memory, step_plan
from robot_agent.guidance.obstacles import Obstacle
from shoal.frames import Array
from tests.robot_agent.control.nonlinear.plants import ALL_AXES, DYNAMICS, LIMIT, NOTHING, RATE, STILL, grid_of, problem_of


def counted(problem: PlanProblem, error: Array, yaw: Array) -> Array:
    """Errors of the place (rows, 2): all of them, or the part along the heading of the course."""
    if not problem.weights.is_steered:
        return error
    along = np.sum(error * np.column_stack([np.cos(yaw), np.sin(yaw)]), axis=1)
    return np.column_stack([along, np.zeros_like(along)])


def residuals(grid: Grid, problem: PlanProblem, flight: PlannedFlight) -> Array:
    """All terms of the cost, so that J is the sum of their squares: the formula of program.py, in NumPy."""
    s, course, w = flight.state, problem.course, problem.weights
    share, span = np.sqrt(grid.share_s), np.diff(grid.time_s)
    place = share[:, None] * counted(problem, s[:, :2] - course.place, course.yaw)
    yaw = share * np.sqrt(course.yaw_weight) * (s[:, 2] - course.yaw)
    turning = share * math.sqrt(w.turning_m2) * s[:, 5]
    change = np.diff(np.vstack([problem.start.command, flight.command]), axis=0)
    rate = np.sqrt(w.rate) * change / np.sqrt(span)[:, None]
    x, y, heading, u, v = s[-1, :5]
    over_ground = np.array([
        math.cos(heading) * u - math.sin(heading) * v + DYNAMICS.water.current_x_mps,
        math.sin(heading) * u + math.cos(heading) * v + DYNAMICS.water.current_y_mps,
    ])  # fmt: skip
    missed = [x, y] - course.place[-1] + w.lead_s * (over_ground - course.velocity[-1])
    end = math.sqrt(w.end_s) * counted(problem, missed[None], course.yaw[-1:])[0]
    facing = math.sqrt(w.facing_s * course.yaw_weight[-1]) * (heading - course.yaw[-1])
    return np.concatenate([place.ravel(), yaw, turning, rate.ravel(), end, [facing]])


def jacobian(grid: Grid, problem: PlanProblem, commands: Array) -> tuple[Array, Array]:
    """Residuals of commands, and their derivatives by finite differences."""
    flight = make_flight(commands.shape[1])

    def at(table: Array) -> Array:
        flight.command[:] = table
        fly(DYNAMICS, grid, problem.start, flight)
        return residuals(grid, problem, flight)

    columns = []
    for j in range(commands.size):
        change = np.zeros(commands.shape)
        change.flat[j] = 1e-6
        columns.append((at(commands + change) - at(commands - change)) / 2e-6)
    return at(commands), np.column_stack(columns)


@pytest.mark.parametrize("is_steered", [False, True])
@pytest.mark.parametrize("axes", ALL_AXES)
def test_iteration_is_the_gauss_newton_step_within_the_limits(axes: tuple[int, ...], is_steered: bool) -> None:
    """The change of the commands is what OSQP finds for J'J, made from finite differences of the cost's own terms."""
    grid, count = grid_of(axes), len(axes)
    random = np.random.default_rng(5)
    start = Start(np.array([0.0, 0.0, 0.1, 0.05, 0.0, 0.1, 0.2, 0.0, 0.0]), np.zeros(count))
    problem, memory = problem_of(grid, start, is_steered=is_steered), make_memory(count)
    before = 0.02 * random.normal(size=(20, count)) * LIMIT[list(axes)]
    memory.flight.command[:] = before
    r, slope = jacobian(grid, problem, before)
    assert appraise(DYNAMICS, grid, problem, memory) == pytest.approx(r @ r, rel=1e-9)
    iteration = step_plan(DYNAMICS, grid, problem, memory, 0.0)
    assert iteration.before == pytest.approx(r @ r, rel=1e-9)

    size = 20 * count
    difference = np.eye(size) - np.eye(size, k=-count)
    limit, rate = np.tile(LIMIT[list(axes)], 20), np.repeat(np.diff(grid.time_s), count) * np.tile(RATE[list(axes)], 20)
    offset = difference @ before.ravel() - np.concatenate([start.command, np.zeros(size - count)])
    solver = osqp.OSQP()
    solver.setup(
        sparse.csc_matrix(slope.T @ slope), slope.T @ r, sparse.csc_matrix(np.vstack([np.eye(size), difference])),
        np.concatenate([-limit - before.ravel(), -rate - offset]), np.concatenate([limit - before.ravel(), rate - offset]),
        verbose=False, eps_abs=1e-9, eps_rel=1e-9, max_iter=200_000, polishing=True,
    )  # fmt: skip
    wanted = solver.solve().x.reshape(before.shape)
    got = memory.program.change[:size].reshape(before.shape)
    model = [0.5 * x.ravel() @ (slope.T @ slope) @ x.ravel() + slope.T @ r @ x.ravel() for x in (got, wanted)]
    assert model[0] == pytest.approx(model[1], rel=1e-4)
    assert np.abs(got - wanted).max() < 0.02 * np.abs(wanted).max()
    assert np.allclose(memory.flight.command, before + iteration.share * got)


@pytest.mark.parametrize("seed", range(6))
def test_cost_falls_until_it_stands_and_limits_hold(seed: int) -> None:
    random, grid = np.random.default_rng(seed), grid_of((0, 2))
    state = np.array([0.5, 0.5, 2.0, 0.2, 0.1, 0.5, 0.0, 0.0, 0.0]) * random.normal(size=9)
    problem, memory = problem_of(grid, Start(state, np.zeros(2))), make_memory(2)
    last = math.inf
    for _ in range(30):
        iteration = step_plan(DYNAMICS, grid, problem, memory, 0.0)
        assert iteration.rounds > 0 and iteration.after <= iteration.before * (1.0 + 1e-8) <= last * (1.0 + 2e-8)
        last = iteration.after
        change = np.diff(np.vstack([np.zeros(2), memory.flight.command]), axis=0) / np.diff(grid.time_s)[:, None]
        assert np.all(np.abs(memory.flight.command) <= LIMIT[[0, 2]] + 1e-6)
        assert np.all(np.abs(change) <= RATE[[0, 2]] + 1e-6)
    assert iteration.before - iteration.after < 1e-3 * iteration.after


def flown(surrounds: Surrounds, aside_m: float = 0.3, speed_mps: float = 0.1) -> Memory:
    """A plan after many iterations."""
    grid = grid_of((0, 2))
    problem = problem_of(grid, Start(np.zeros(9), np.zeros(2)), surrounds, speed_mps, aside_m)
    memory = make_memory(2)
    for _ in range(60):
        step_plan(STILL, grid, problem, memory, 0.0)
    return memory


def test_plan_keeps_its_distance_from_a_robot_and_from_an_obstacle_and_stays_in_the_room() -> None:
    """The course leads to within 0.1 m of a robot and of an island, and out of the room."""
    free = flown(NOTHING).flight.state
    body = MovingBodies(np.tile([0.75, 0.38], (1, 20, 1)), np.full((1, 20), 0.3), np.array([1.0]))
    plan = flown(NOTHING._replace(bodies=body)).flight.state
    nearest = [np.hypot(s[:, 0] - 0.75, s[:, 1] - 0.38).min() for s in (free, plan)]
    assert nearest[0] < 0.2 and nearest[1] > 0.295

    island = Obstacle(0, np.array([0.75 + 0.38j]), 0.3, 0j, 0, 0.75 + 0.38j, 0.0)
    plan = flown(NOTHING._replace(outlines=outlines_of((island,), 0, 0j))).flight.state
    assert np.hypot(plan[:, 0] - 0.75, plan[:, 1] - 0.38).min() > 0.295

    plan = flown(NOTHING._replace(room_m=np.array([0.5, math.inf]))).flight.state
    assert free[:, 0].max() > 0.8 and plan[:, 0].max() < 0.51


def test_a_robot_that_is_too_near_gets_away() -> None:
    """It lies 0.1 m from a body with 0.6 m to keep, and wants to stay there: the rows take it out, at ESCAPE_MPS or more."""
    body = MovingBodies(np.tile([0.1, 0.0], (1, 20, 1)), np.full((1, 20), 0.6), np.array([0.1]))
    plan = flown(NOTHING._replace(bodies=body), aside_m=0.0, speed_mps=0.0).flight.state
    assert np.hypot(plan[-1, 0] - 0.1, plan[-1, 1]) > 0.5


def test_an_outline_is_left_by_the_shortest_way() -> None:
    square = np.array([0.2 - 0.2j, 0.2 + 0.2j, -0.8 + 0.2j, -0.8 - 0.2j])
    outline = Obstacle(0, square, 0.1, 0j, 0, -0.3 + 0j, 0.6)
    memory = flown(NOTHING._replace(outlines=outlines_of((outline,), 0, 0j)), aside_m=0.0, speed_mps=0.0)
    assert memory.flight.state[-1, 0] > 0.2


@pytest.mark.parametrize("entry", ["state", "command", "course"])
def test_numbers_that_are_none_give_no_plan(entry: str) -> None:
    grid, start = grid_of((0, 2)), Start(np.zeros(9), np.zeros(2))
    problem, memory = problem_of(grid, start, Surrounds(NO_BODIES, NOTHING.outlines, NOTHING.room_m)), make_memory(2)
    {"state": start.state, "command": start.command, "course": problem.course.yaw}[entry][1] = math.nan
    assert step_plan(DYNAMICS, grid, problem, memory, 0.05).rounds == 0

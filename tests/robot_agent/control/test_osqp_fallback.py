"""OSQP finds the optimum that the active set finds, and refuses what cannot be solved."""

import math

import numpy as np
import pytest

from robot_agent.control import osqp_fallback
from robot_agent.control.active_set import NO_BOUND, ConvexProgram, make_active_set, solve_from
from robot_agent.control.osqp_fallback import CLOSE, solve_by_osqp
from shoal.frames import Array

N, M = 12, 40


def problem(seed: int) -> ConvexProgram:
    """A strictly convex problem with 0 feasible, some rows one-sided and many bounds active."""
    random = np.random.default_rng(seed)
    root, a = random.normal(size=(N, N)), random.normal(size=(M, N))
    lower, upper = -random.uniform(0.05, 1.0, M), random.uniform(0.05, 1.0, M)
    lower[::3] = -NO_BOUND
    return ConvexProgram(root @ root.T + 0.1 * np.eye(N), random.normal(size=N) * 20.0, a, lower, upper)


def cost(program: ConvexProgram, x: Array) -> float:
    return float(0.5 * x @ program.p @ x + program.q @ x)


@pytest.mark.parametrize("seed", range(20))
def test_the_optimum_is_that_of_the_active_set(seed: int) -> None:
    program, exact, working = problem(seed), make_active_set(N, M), make_active_set(N, M)
    assert solve_from(program, exact) and solve_by_osqp(program, working)
    reached = program.a @ working.x
    assert max((reached - program.upper).max(), (program.lower - reached).max()) <= CLOSE
    assert cost(program, working.x) == pytest.approx(cost(program, exact.x), rel=1e-3)
    assert solve_from(program, working) == 1  # the rows that it says are active are


@pytest.mark.parametrize("which", range(5))
@pytest.mark.parametrize("poison", [math.nan, "crossed"])
def test_bad_numbers_and_crossed_bounds_are_refused(which: int, poison: float | str) -> None:
    program, working = problem(1), make_active_set(N, M)
    if poison == "crossed":
        program.lower[0], program.upper[0] = 1.0, -1.0
    else:
        program[which].reshape(-1)[0] = poison
    assert solve_by_osqp(program, working) == 0


def test_a_point_outside_the_rows_is_no_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    """After its last iteration OSQP has a point, wherever it is."""
    monkeypatch.setitem(osqp_fallback.SETTINGS, "max_iter", 2)
    program, working = problem(1), make_active_set(N, M)
    assert solve_by_osqp(program, working) == 0
    assert not working.x.any() and not working.held.any()

"""The quadratic programs' solver: right against an independent one, from any guess, and what it refuses."""

import numpy as np
import pytest
from scipy.optimize import LinearConstraint, minimize

from robot_agent.control.active_set import (
    NO_BOUND,
    ROUNDS,
    ActiveSet,
    ConvexProgram,
    factorise,
    make_active_set,
    solve_from,
)
from shoal.frames import Array

N, M = 6, 9


def problem(random: np.random.Generator) -> ConvexProgram:
    """A strictly convex problem with 0 feasible, some rows one-sided and some bounds active."""
    root = random.normal(size=(N, N))
    a = random.normal(size=(M, N))
    lower, upper = -random.uniform(0.05, 1.0, M), random.uniform(0.05, 1.0, M)
    lower[::3] = -NO_BOUND
    return ConvexProgram(root @ root.T + 0.1 * np.eye(N), random.normal(size=N) * 3.0, a, lower, upper)


def exact(program: ConvexProgram) -> Array:
    """By sequential quadratic programming from scipy, which shares nothing with ours."""
    p, q, a, lower, upper = program

    def cost(x: Array) -> float:
        return float(0.5 * x @ p @ x + q @ x)

    def slope(x: Array) -> Array:
        return np.asarray(p @ x + q)

    rows = LinearConstraint(a, np.maximum(lower, -1e6), upper)
    found = minimize(
        cost, np.zeros(len(q)), jac=slope, constraints=[rows], method="SLSQP", options={"ftol": 1e-9, "maxiter": 500}
    )
    assert found.success, found.message
    return np.asarray(found.x)


def test_random_problems_in_a_row_are_solved() -> None:
    random, found = np.random.default_rng(1), make_active_set(N, M)
    for _ in range(60):
        program = problem(random)
        assert solve_from(program, found) and optimal(program, found)
        cost, least = (float(0.5 * x @ program.p @ x + program.q @ x) for x in (found.x, exact(program)))
        assert cost == pytest.approx(least, abs=1e-4 * (1 + abs(least)))


@pytest.mark.parametrize("which", range(5))
@pytest.mark.parametrize("poison", [np.nan, np.inf])
def test_one_bad_number_is_refused_and_leaves_no_trace(which: int, poison: float) -> None:
    found, good = make_active_set(N, M), problem(np.random.default_rng(4))
    solve_from(good, found)
    before = found.x.copy()
    bad = [array.copy() for array in good]
    bad[which].flat[0] = poison if which < 3 else np.nan
    assert not solve_from(ConvexProgram(*bad), found)
    found.held[:] = 0
    assert solve_from(good, found) and found.x == pytest.approx(before, abs=1e-9)


def test_bounds_that_cross_and_rows_that_leave_no_place_are_refused() -> None:
    found, program = make_active_set(N, M), problem(np.random.default_rng(5))
    lower, upper = program.lower.copy(), program.upper.copy()
    lower[2], upper[2] = 0.5, 0.4
    assert not solve_from(program._replace(lower=lower, upper=upper), found)
    same, low, high = program.a.copy(), program.lower.copy(), program.upper.copy()
    same[1] = same[0]
    low[0], high[0], low[1], high[1] = 1.0, 2.0, -2.0, -1.0
    assert not solve_from(program._replace(a=same, lower=low, upper=high), found)


def test_the_same_sequence_is_solved_bit_for_bit() -> None:
    runs = []
    for _ in range(2):
        random, found = np.random.default_rng(9), make_active_set(N, M)
        runs.append([(solve_from(problem(random), found), *found.x.tolist()) for _ in range(40)])
    assert runs[0] == runs[1]


def test_the_program_is_left_alone() -> None:
    random, found = np.random.default_rng(7), make_active_set(N, M)
    for _ in range(3):
        program = problem(random)
        copies = [array.copy() for array in program]
        solve_from(program, found)
        assert all(np.array_equal(now, then) for now, then in zip(program, copies, strict=True))


@pytest.mark.parametrize("seed", range(6))
def test_a_problem_that_drifts_is_solved_from_its_last_active_set(seed: int) -> None:
    """As in flight: with rows active, some of them changing. Few steps need rows one by one."""
    random, found = np.random.default_rng(seed), make_active_set(N, M)
    program = problem(random)
    quick, active = 0, 0
    for _ in range(60):
        program.q[:] += 0.05 * random.normal(size=N)
        rounds = solve_from(program, found)
        assert rounds and optimal(program, found)
        quick, active = quick + (rounds <= ROUNDS), active + int(np.count_nonzero(found.multiplier))
    assert quick > 30 and active > 30


def test_a_guess_that_cannot_be_is_given_up() -> None:
    """More rows than unknowns, the same row twice, a bound that is gone: the right solution all the same."""
    program, found = problem(np.random.default_rng(13)), make_active_set(N, M)
    found.held[:] = 1
    assert solve_from(program, found) > ROUNDS
    assert found.x == pytest.approx(exact(program), abs=1e-4)
    twice = program._replace(a=program.a.copy())
    twice.a[1], found.held[:] = twice.a[0], 0
    found.held[:2] = 1
    assert solve_from(twice, found) > ROUNDS
    assert found.x == pytest.approx(exact(twice), abs=1e-4)
    found.held[:] = 0
    found.held[[0, 3]] = -1, 1
    assert solve_from(program._replace(lower=np.full(M, -np.inf), upper=np.full(M, NO_BOUND)), found)
    assert found.x == pytest.approx(-np.linalg.solve(program.p, program.q)) and not found.held.any()


def optimal(program: ConvexProgram, found: ActiveSet) -> bool:
    """True if a solution with its multipliers meets the conditions of Karush, Kuhn and Tucker."""
    (p, q, a, lower, upper), x, y = program, found.x, found.multiplier
    reached = a @ x
    slope = np.abs(p @ x + q + a.T @ y).max()
    beyond = max(float((reached - upper).max()), float((lower - reached).max()))
    off = np.where(y > 0.0, upper - reached, np.where(y < 0.0, reached - lower, 0.0))
    return bool(slope < 1e-7 and beyond < 1e-8 and np.abs(off).max() < 1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_rows_that_depend_on_one_another_are_taken_up_one_by_one(seed: int) -> None:
    """Bounds on every unknown and on every difference of two, as in flight: most of them active at once, from guesses that
    have nothing to do with it. Where the rows leave no place that is told."""
    random = np.random.default_rng(seed)
    found = make_active_set(N, 2 * N)
    a = np.vstack([np.eye(N), np.eye(N) - np.eye(N, k=-1)])
    one_by_one, active, none = 0, 0, 0
    for _ in range(300):
        p, q, *_ = problem(random)
        upper = random.choice([0.1, 0.2, 0.3], 2 * N)
        lower = -upper
        if random.random() < 0.2:  # the first may be nowhere: its own bounds lie beyond those of its change
            lower[0], upper[0] = 0.35, 0.4
        found.held[:] = random.integers(-1, 2, 2 * N)
        taken = solve_from(ConvexProgram(p, 20.0 * q, a, lower, upper), found)
        if lower[0] > 0.0:
            none += 1
            assert not taken
            continue
        assert taken and optimal(ConvexProgram(p, 20.0 * q, a, lower, upper), found)
        one_by_one, active = one_by_one + (taken > ROUNDS), active + int(np.count_nonzero(found.multiplier))
    assert one_by_one > 100 and active > 600 and none > 30


def test_only_a_positive_definite_matrix_of_numbers_is_factorised() -> None:
    """With blocks of zeros too."""
    random = np.random.default_rng(12)
    for _ in range(50):
        p, factor = np.zeros((N, N)), np.full((N, N), np.nan)
        for part in (slice(0, 4), slice(4, N)):
            root = random.normal(size=(N, N))[part, part]
            p[part, part] = root @ root.T + 1e-3 * np.eye(len(root))
        assert factorise(p, N, factor) and np.tril(factor) @ np.tril(factor).T == pytest.approx(p, abs=1e-12)
        negative = p - 1.1 * np.linalg.eigvalsh(p)[0] * np.eye(N)
        for spoiled in (negative, 0.0 * p, np.full((N, N), np.nan), p + np.diag([np.inf] * N)):
            assert not factorise(spoiled, N, factor)

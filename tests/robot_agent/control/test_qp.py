"""Both backends against an exact solver, and every trap that OSQP sets."""

import sys
import tomllib
from importlib import metadata
from pathlib import Path
from typing import Literal

import numpy as np
import osqp
import pytest
from packaging.requirements import Requirement
from scipy.optimize import LinearConstraint, minimize

from robot_agent.control.active_set import NO_BOUND, ROUNDS, factorise, solve_from
from robot_agent.control.qp import DaqpSolver, OsqpSolver, Solver, make_solver
from shoal.errors import ConfigError
from shoal.frames import Array

N, M = 6, 9
Backend = Literal["osqp", "daqp"]
BACKENDS: tuple[Backend, ...] = ("osqp", "daqp")
Problem = tuple[Array, Array, Array, Array, Array]


def problem(random: np.random.Generator) -> Problem:
    """A strictly convex problem with 0 feasible, some rows one-sided and some bounds active."""
    root = random.normal(size=(N, N))
    a = random.normal(size=(M, N))
    lower, upper = -random.uniform(0.05, 1.0, M), random.uniform(0.05, 1.0, M)
    lower[::3] = -NO_BOUND
    return root @ root.T + 0.1 * np.eye(N), random.normal(size=N) * 3.0, a, lower, upper


def solver(name: Backend, n: int = N, m: int = M) -> Solver:
    return make_solver(name, np.ones((n, n), bool), np.ones((m, n), bool), np.ones(n), np.ones(m))


def exact(p: Array, q: Array, a: Array, lower: Array, upper: Array) -> Array:
    """By sequential quadratic programming from scipy, which shares nothing with either backend."""

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


def test_no_solution_violates_a_row_by_more_than_a_hundredth_of_its_bounds() -> None:
    """An axis that costs nothing lets x grow to 1e9, and the backend's tolerance with it."""
    random, refused = np.random.default_rng(3), 0
    for _ in range(400):
        p, q = np.diag(random.choice([0.0, 1e-9, 1e-6, 1.0, 100.0], N)), random.normal(size=N) * random.choice([1.0, 1e2, 1e4])
        a = random.normal(size=(M, N)) * (random.random((M, N)) < 0.5)
        lower, upper = -random.uniform(0.05, 1.0, M), random.uniform(0.05, 1.0, M)
        lower[random.random(M) < 0.5] = -NO_BOUND
        backend = OsqpSolver(np.ones((N, N), bool), np.ones((M, N), bool), np.ones(N), np.ones(M))
        found = backend.solve(p, q, a, lower, upper)
        refused += not found.solved
        if found.solved:
            assert max((a @ found.x - upper).max(), (lower - a @ found.x).max()) < 0.011
    assert 0 < refused < 200


@pytest.mark.parametrize("name", BACKENDS)
def test_random_problems_in_a_row_are_solved(name: Backend) -> None:
    random, backend = np.random.default_rng(1), solver(name)
    for _ in range(60):
        p, q, a, lower, upper = problem(random)
        solution = backend.solve(p, q, a, lower, upper)
        assert solution.solved
        best = exact(p, q, a, lower, upper)
        cost, least = (float(0.5 * x @ p @ x + q @ x) for x in (solution.x, best))
        assert cost == pytest.approx(least, abs=0.02 * (1 + abs(least)))
        assert np.all(a @ solution.x <= upper + 0.02) and np.all(a @ solution.x >= lower - 0.02)


@pytest.mark.parametrize("name", BACKENDS)
def test_scales_do_not_change_the_answer(name: Backend) -> None:
    random = np.random.default_rng(2)
    p, q, a, lower, upper = problem(random)
    scale, rows = random.uniform(0.2, 5.0, N), random.uniform(0.2, 5.0, M)
    scaled = make_solver(name, np.ones((N, N), bool), np.ones((M, N), bool), scale, rows)
    assert scaled.solve(p, q, a, lower, upper).x == pytest.approx(exact(p, q, a, lower, upper), abs=0.02)


@pytest.mark.parametrize("name", BACKENDS)
def test_infeasible_is_not_solved_and_leaves_no_trace(name: Backend) -> None:
    """OSQP hands back a finite x of about 2e9 here: only the status tells."""
    random, backend = np.random.default_rng(3), solver(name)
    p, q, a, lower, upper = problem(random)
    before = backend.solve(p, q, a, lower, upper).x
    same = a.copy()
    same[1] = same[0]
    low, high = lower.copy(), upper.copy()
    low[0], high[0], low[1], high[1] = 1.0, 2.0, -2.0, -1.0
    refused = backend.solve(p, q, same, low, high)
    assert not refused.solved and not refused.x.any()
    after = backend.solve(p, q, a, lower, upper)
    assert after.solved and after.x == pytest.approx(before, abs=0.02)


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("which", range(5))
@pytest.mark.parametrize("poison", [np.nan, np.inf])
def test_one_bad_number_is_refused_and_leaves_no_trace(name: Backend, which: int, poison: float) -> None:
    random, backend = np.random.default_rng(4), solver(name)
    good = problem(random)
    before = backend.solve(*good).x
    bad = [array.copy() for array in good]
    bad[which].flat[0] = poison if which != 4 else np.nan
    if which == 3:
        bad[3].flat[0] = np.nan if np.isnan(poison) else np.inf
    assert not backend.solve(*bad).solved
    after = backend.solve(*good)
    assert after.solved and after.x == pytest.approx(before, abs=0.02)


@pytest.mark.parametrize("name", BACKENDS)
def test_crossed_bounds_are_refused_not_ignored(name: Backend) -> None:
    """OSQP prints and keeps the old bounds."""
    random, backend = np.random.default_rng(5), solver(name)
    p, q, a, lower, upper = problem(random)
    backend.solve(p, q, a, lower, upper)
    lower[2], upper[2] = 0.5, 0.4
    assert not backend.solve(p, q, a, lower, upper).solved


@pytest.mark.parametrize("name", BACKENDS)
def test_a_strided_q_is_read_rightly(name: Backend) -> None:
    """OSQP would read the memory between the elements."""
    random, backend = np.random.default_rng(6), solver(name)
    p, q, a, lower, upper = problem(random)
    table = np.full((N, 3), 77.0)
    table[:, 1] = q
    assert backend.solve(p, table[:, 1], a, lower, upper).x == pytest.approx(backend.solve(p, q, a, lower, upper).x, abs=0.01)


@pytest.mark.parametrize("name", BACKENDS)
def test_arguments_are_left_alone(name: Backend) -> None:
    """OSQP's `update(Px=)` writes into the array it is given."""
    random, backend = np.random.default_rng(7), solver(name)
    for _ in range(3):
        arguments = problem(random)
        copies = [array.copy() for array in arguments]
        backend.solve(*arguments)
        assert all(np.array_equal(now, then) for now, then in zip(arguments, copies, strict=True))


@pytest.mark.parametrize("name", BACKENDS)
def test_answers_are_the_callers_to_keep(name: Backend) -> None:
    random, backend = np.random.default_rng(8), solver(name)
    first = backend.solve(*problem(random)).x
    kept = first.copy()
    backend.solve(*problem(random))
    assert np.array_equal(first, kept)


def test_osqp_solves_the_same_sequence_bit_for_bit() -> None:
    """Lockstep: nothing in the solver may depend on time."""
    runs = []
    for _ in range(2):
        random, backend = np.random.default_rng(9), solver("osqp")
        runs.append([backend.solve(*problem(random)) for _ in range(40)])
    for a, b in zip(*runs, strict=True):
        assert np.array_equal(a.x, b.x) and a.iterations == b.iterations


def test_masked_entries_follow_the_data() -> None:
    """Structure frozen with zeros inside the masks: values that come up later must arrive at their places."""
    mask = np.zeros((4, 4), bool)
    mask[:2, :2] = mask[2:, 2:] = True
    rows = np.array([[1, 1, 0, 0], [0, 0, 1, 1]], bool)
    backend = OsqpSolver(mask, rows, np.ones(4), np.ones(2))
    random = np.random.default_rng(10)
    for _ in range(10):
        p = np.zeros((4, 4))
        for half in (slice(0, 2), slice(2, 4)):
            root = random.normal(size=(2, 2))
            p[half, half] = root @ root.T + 0.2 * np.eye(2)
        a = np.where(rows, random.normal(size=(2, 4)), 0.0)
        q = random.normal(size=4)
        lower, upper = np.full(2, -0.3), np.full(2, 0.3)
        exactly = DaqpSolver(mask, rows, np.ones(4), np.ones(2)).solve(p, q, a, lower, upper).x
        assert backend.solve(p, q, a, lower, upper).x == pytest.approx(exactly, abs=0.01)


@pytest.mark.parametrize("name", BACKENDS)
def test_problems_without_an_active_row_are_solved_exactly_and_the_backend_learns_of_their_matrix(name: Backend) -> None:
    random, backend = np.random.default_rng(11), solver(name)
    a, free = problem(random)[2], 0
    for k in range(40):
        p, q, fresh, lower, upper = problem(random)
        a = fresh if k % 3 == 0 else a
        if k % 2:
            lower, upper = np.full(M, -100.0), np.full(M, 100.0)
        solution = backend.solve(p, q, a if k % 3 == 0 else None, lower, upper)
        inside = -np.linalg.solve(p, q)
        assert solution.solved
        if np.all(a @ inside <= upper) and np.all(a @ inside >= lower):
            free += solution.iterations == 0
            assert solution.x == pytest.approx(inside, abs=0.02 if solution.iterations else 1e-9)
        else:
            assert solution.x == pytest.approx(exact(p, q, a, lower, upper), abs=0.02)
    assert free > 15


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("seed", range(6))
def test_a_problem_that_drifts_is_solved_from_its_last_active_set(name: Backend, seed: int) -> None:
    """As in flight: with rows active, some of them changing. The conditions of Karush, Kuhn and Tucker hold."""
    random, backend = np.random.default_rng(seed), solver(name)
    p, q, a, lower, upper = problem(random)
    by_itself, active = 0, 0
    for _ in range(60):
        q += 0.05 * random.normal(size=N)
        solution = backend.solve(p, q, a, lower, upper)
        assert solution.solved
        if solution.iterations:
            continue
        assert solution.multipliers is not None
        x, y, reached = solution.x, solution.multipliers, a @ solution.x
        by_itself, active = by_itself + 1, active + int(np.count_nonzero(y))
        assert p @ x + q + a.T @ y == pytest.approx(0.0, abs=1e-8)
        assert np.all(reached <= upper + 1e-9) and np.all(reached >= lower - 1e-9)
        assert reached[y > 0] == pytest.approx(upper[y > 0]) and reached[y < 0] == pytest.approx(lower[y < 0])
    assert by_itself > 30 and active > 30


def test_a_guess_that_cannot_be_is_given_up() -> None:
    """More rows than unknowns, the same row twice, a bound that is gone: the right solution all the same."""
    random = np.random.default_rng(13)
    p, q, a, lower, upper = problem(random)
    x, y, work, mu = np.empty(N), np.empty(M), np.empty((4, N, N)), np.empty(N)
    assert solve_from(p, q, a, lower, upper, np.ones(M, np.int64), work, mu, x, y) > ROUNDS
    assert x == pytest.approx(exact(p, q, a, lower, upper), abs=1e-4)
    twice, held = a.copy(), np.zeros(M, np.int64)
    twice[1], held[:2] = twice[0], 1
    assert solve_from(p, q, twice, lower, upper, held, work, mu, x, y) > ROUNDS
    assert x == pytest.approx(exact(p, q, twice, lower, upper), abs=1e-4)
    held = np.zeros(M, np.int64)
    held[[0, 3]] = -1, 1
    assert solve_from(p, q, a, np.full(M, -np.inf), np.full(M, NO_BOUND), held, work, mu, x, y)
    assert x == pytest.approx(-np.linalg.solve(p, q)) and not held.any()


def optimal(p: Array, q: Array, a: Array, lower: Array, upper: Array, x: Array, y: Array) -> bool:
    """True if x with multipliers y meets the conditions of Karush, Kuhn and Tucker."""
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
    x, y, work, mu = np.empty(N), np.empty(2 * N), np.empty((4, N, N)), np.empty(N)
    a = np.vstack([np.eye(N), np.eye(N) - np.eye(N, k=-1)])
    one_by_one, active, none = 0, 0, 0
    for _ in range(300):
        p, q, *_ = problem(random)
        upper = random.choice([0.1, 0.2, 0.3], 2 * N)
        lower = -upper
        if random.random() < 0.2:  # the first may be nowhere: its own bounds lie beyond those of its change
            lower[0], upper[0] = 0.35, 0.4
        held = random.integers(-1, 2, 2 * N)
        taken = solve_from(p, 20.0 * q, a, lower, upper, held, work, mu, x, y)
        if lower[0] > 0.0:
            none += 1
            assert not taken
            continue
        assert taken and optimal(p, 20.0 * q, a, lower, upper, x, y)
        one_by_one, active = one_by_one + (taken > ROUNDS), active + int(np.count_nonzero(y))
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


def test_a_robot_without_daqp_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is not part of the base install."""
    monkeypatch.setitem(sys.modules, "daqp", None)
    with pytest.raises(ConfigError, match="not installed"):
        solver("daqp")
    assert solver("osqp").solve(*problem(np.random.default_rng(0))).solved


def test_the_osqp_that_is_pinned_has_the_solver_object_that_is_used() -> None:
    """Its public wrapper takes another 50 us a step; what lies below it may change with any version."""
    wanted = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text())["project"]["dependencies"]
    pins = [Requirement(line) for line in wanted if line.startswith("osqp")]
    assert [str(pin.specifier) for pin in pins] == [f"=={metadata.version('osqp')}"]
    ext = osqp.OSQP(algebra="builtin").ext
    needed = {"update_data_vec", "update_data_mat", "solve", "warm_start", "solution", "info"}
    assert needed <= set(dir(ext.OSQPSolver)) and {"OSQPSettings", "CSC", "osqp_set_default_settings"} <= set(dir(ext))

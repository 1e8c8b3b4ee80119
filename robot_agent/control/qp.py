"""Quadratic programs of one fixed size, solved repeatedly: min 1/2 x'Px + q'x with lower <= Ax <= upper.

Most problems of a flight have the active set of the one before, and need no backend: see `ActiveSetFirst`.

Both backends take dense arrays and own all bookkeeping. They are built once; a solve changes numbers, never structure, and
starts from the last solution. Inputs are checked first, because OSQP does not (all reproduced with 1.1): it prints bounds that
cross and vectors of a wrong size, drops them, and keeps the old ones. It misreads a strided vector. One NaN spoils every later
solve. `update(Px=)` overwrites the caller's array. An infeasible problem returns a finite x of 2e9.
"""

import importlib
import math
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
import osqp
from numpy.typing import NDArray
from scipy import sparse

from robot_agent.control.active_set import NO_BOUND, solve_from
from shoal.errors import ConfigError
from shoal.frames import Array
from shoal.kernels.decorator import kernel

Mask = NDArray[np.bool_]
Entries = NDArray[np.int64]  # (k, 2) row and column of entries of a matrix

MAX_ITERATIONS = 2000  # 16-40 are usual, a cold start takes 240, a robot inside another's space up to 700; 2 ms at the worst
SETTINGS = {
    "verbose": 0,
    "scaling": 0,
    "rho": 0.1,
    "adaptive_rho": 1,  # by iterations; the timed variant would make a run depend on the machine
    "adaptive_rho_interval": 25,
    "eps_abs": 1e-4,
    "eps_rel": 1e-4,
    "check_termination": 5,
    "max_iter": MAX_ITERATIONS,
    "polishing": 0,
    "warm_starting": 1,
    "time_limit": 1e10,
}
SOLVED = (int(osqp.SolverStatus.OSQP_SOLVED), int(osqp.SolverStatus.OSQP_SOLVED_INACCURATE))
OUT_OF_ITERATIONS = int(osqp.SolverStatus.OSQP_MAX_ITER_REACHED)
CLOSE = 0.01  # of what was asked for: a hundred times the tolerance
AT_BOUND = 1e-3  # N, N m or m: so near its bound a row of a backend's solution is guessed to be active
NO_MATRIX, NO_ENTRIES = np.zeros((0, 0)), np.zeros((0, 2), np.int64)


@kernel(
    "b1(f8[:,::1], f8[::1], f8[:,::1], f8[::1], f8[::1], f8[::1], f8[::1], i8[:,::1], i8[:,::1],"
    " f8[::1], f8[::1], f8[::1], f8[::1], f8[::1])"
)
def scale_problem(
    p: Array,
    q: Array,
    a: Array,
    lower: Array,
    upper: Array,
    scale: Array,
    row_scale: Array,
    p_entries: Entries,
    a_entries: Entries,
    p_values: Array,
    q_values: Array,
    a_values: Array,
    low: Array,
    high: Array,
) -> bool:
    """The problem in scaled unknowns x / scale and rows row_scale Ax, into the last five arrays; False if any of its numbers
    is not finite.

    Of P and A only the entries (k, 2), row and column, are read and written. Bounds beyond NO_BOUND become NO_BOUND.
    """
    finite = True
    for k in range(len(p_entries)):
        i, j = p_entries[k]
        p_values[k] = p[i, j] * scale[i] * scale[j]
        finite &= math.isfinite(p_values[k])
    for k in range(len(a_entries)):
        i, j = a_entries[k]
        a_values[k] = a[i, j] * row_scale[i] * scale[j]
        finite &= math.isfinite(a_values[k])
    for i in range(len(q)):
        q_values[i] = q[i] * scale[i]
        finite &= math.isfinite(q_values[i])
    for i in range(len(lower)):
        low[i], high[i] = lower[i] * row_scale[i], upper[i] * row_scale[i]
        low[i] = -NO_BOUND if low[i] < -NO_BOUND else low[i]
        high[i] = NO_BOUND if high[i] > NO_BOUND else high[i]
        finite &= math.isfinite(low[i]) and math.isfinite(high[i])
    return finite


@kernel("b1(f8[::1], f8[::1], f8[::1], f8[::1])")
def unscale(x: Array, y: Array, scale: Array, row_scale: Array) -> bool:
    """Bring a solution x (n,) and its multipliers y (m,) back to the problem's own units, in place; False if x is not
    finite."""
    finite = True
    for i in range(len(x)):
        x[i] *= scale[i]
        finite &= math.isfinite(x[i])
    for i in range(len(y)):
        y[i] *= row_scale[i]
    return finite


class Solution(NamedTuple):
    """`x` is meaningful only if `solved`."""

    x: Array
    solved: bool
    iterations: int  # of the backend; 0: it was not asked
    multipliers: Array | None = None  # (m,) of the rows, positive at the upper bound; None from a solver without


class Solver(Protocol):
    """A backend."""

    def solve(self, p: Array, q: Array, a: Array | None, lower: Array, upper: Array) -> Solution:
        """Solve for p (n, n) symmetric, q (n,), a (m, n), bounds (m,); 1e30 and beyond is no bound. `a` None: as it was."""

    def warm_start(self, x: Array, multipliers: Array) -> None:
        """Start the next solve at x (n,) instead of at the last solution, and at multipliers of the first rows; the others
        are zero."""


class OsqpSolver:
    """OSQP with a sparsity pattern frozen at the start: entries outside the masks must stay zero.

    `scale` (n,) and `row_scale` (m,) bring unknowns and rows near one. OSQP's own scaling is off: it would cost more than the
    solve and change from step to step.
    """

    def __init__(self, p_mask: Mask, a_mask: Mask, scale: Array, row_scale: Array) -> None:
        rows, n = a_mask.shape
        upper = np.triu(p_mask) | np.eye(n, dtype=bool)
        self._scale, self._row_scale = scale.copy(), row_scale.copy()
        self._p_entries, self._a_entries = _by_columns(upper), _by_columns(a_mask)
        self._p, self._a = np.zeros(len(self._p_entries)), np.zeros(len(self._a_entries))
        self._q, self._low, self._high = np.zeros(n), np.zeros(rows), np.zeros(rows)
        self._solver = _built(upper, a_mask)
        self._info, self._solution = self._solver.info, self._solver.solution  # of the last solve; their arrays are copies

    def solve(self, p: Array, q: Array, a: Array | None, lower: Array, upper: Array) -> Solution:
        """See `Solver`."""
        solver, same_a = self._solver, a is None
        finite = scale_problem(
            p, np.ascontiguousarray(q), NO_MATRIX if a is None else a, lower, upper, self._scale, self._row_scale,
            self._p_entries, NO_ENTRIES if same_a else self._a_entries, self._p, self._q, self._a, self._low, self._high,
        )  # fmt: skip
        if (
            not finite
            or solver.update_data_vec(self._q, self._low, self._high)  # refuses bounds that cross
            or solver.update_data_mat(self._p, None, None if same_a else self._a, None)
        ):
            return Solution(np.zeros(len(q)), False, 0)
        solver.solve()
        x, y, info = self._solution.x, self._solution.y, self._info
        finite = unscale(x, y, self._scale, self._row_scale)
        if not (finite and self._close(info)):
            if info.status_val != OUT_OF_ITERATIONS or not finite:  # else the next solve goes on from here
                solver.warm_start(np.zeros(len(q)), np.zeros(len(lower)))
            return Solution(np.zeros(len(q)), False, info.iter)
        return Solution(x, True, info.iter, y)

    def warm_start(self, x: Array, multipliers: Array) -> None:
        """See `Solver`."""
        y, known = np.zeros(len(self._low)), len(multipliers)
        y[:known] = multipliers / self._row_scale[:known]
        self._solver.warm_start(x / self._scale, y)

    def _close(self, info: Any) -> bool:
        """True if solved, or out of iterations so near the solution that the plan is better than the last one. Residuals are
        scaled and relative to the largest number: an error of 2 mm of slack is accepted where 0.2 m are needed.

        The backend's own tolerance is relative to A x. Where an axis costs nothing, x grows to 1e9 and A x with it: then rows
        that are violated by 1e5 are "solved". So no row may be violated by more than CLOSE of the largest bound."""
        status = info.status_val
        bounds = np.abs(np.concatenate([self._low, self._high]))
        largest_bound = max(1.0, float(bounds[bounds < NO_BOUND].max(initial=0.0)))
        if info.prim_res > CLOSE * largest_bound:
            return False
        if status in SOLVED:
            return True
        size = max(1.0, float(np.abs(self._solution.x).max()))
        largest = max(size, float(np.abs(self._q).max()))
        return bool(status == OUT_OF_ITERATIONS and info.prim_res < CLOSE * size and info.dual_res < CLOSE * largest)


class DaqpSolver:
    """DAQP: dual active set, exact, with a bounded worst case. For small problems. It has no memory: `warm_start` does
    nothing.

    The first `bounds` rows of A must be those of the identity: they cost almost nothing.
    """

    def __init__(self, p_mask: Mask, a_mask: Mask, scale: Array, row_scale: Array, bounds: int = 0) -> None:
        rows, n = a_mask.shape
        self._scale, self._row_scale = scale.copy(), np.concatenate([1.0 / scale[:bounds], row_scale[bounds:]])
        self._p_entries, self._a_entries = (np.array(list(np.ndindex(shape)), np.int64) for shape in ((n, n), (rows, n)))
        self._a_entries = self._a_entries[bounds * n :]
        self._p, self._a = np.zeros((n, n)), np.zeros((rows - bounds, n))
        self._q, self._low, self._high = np.zeros(n), np.zeros(rows), np.zeros(rows)
        self._sense = np.zeros(rows, dtype=np.int32)
        try:
            self._daqp = importlib.import_module("daqp")
        except ModuleNotFoundError:
            raise ConfigError('controller.mpc.solver = "daqp": not installed here (pip install daqp, or use "osqp")') from None

    def solve(self, p: Array, q: Array, a: Array | None, lower: Array, upper: Array) -> Solution:
        """See `Solver`."""
        finite = scale_problem(
            p, np.ascontiguousarray(q), NO_MATRIX if a is None else a, lower, upper, self._scale, self._row_scale,
            self._p_entries, NO_ENTRIES if a is None else self._a_entries, self._p.reshape(-1), self._q,
            self._a.reshape(-1), self._low, self._high,
        )  # fmt: skip
        if not finite:
            return Solution(np.zeros(len(q)), False, 0)
        x, _, status, info = self._daqp.solve(self._p, self._q, self._a, self._high, self._low, self._sense)
        if status <= 0 or not _finite(x):
            return Solution(np.zeros(len(q)), False, info["iterations"])
        return Solution(x * self._scale, True, info["iterations"])

    def warm_start(self, x: Array, multipliers: Array) -> None:
        """See `Solver`."""


class ActiveSetFirst:
    """A solution from the last active set (active_set.py), else a `backend`'s, which starts from the last solution."""

    def __init__(self, backend: Solver, rows: int, n: int) -> None:
        self._backend, self._a, self._told_a = backend, np.zeros((rows, n)), False  # the backend has this A
        self._held, self._work, self._mu = np.zeros(rows, np.int64), np.empty((4, n, n)), np.empty(n)
        self._last: tuple[Array, Array] | None = None  # solution and multipliers that the backend has not seen

    def solve(self, p: Array, q: Array, a: Array | None, lower: Array, upper: Array) -> Solution:
        """See `Solver`."""
        if a is not None:
            self._a[:], self._told_a = a, False
        x, y = np.empty(len(q)), np.empty(len(lower))
        if solve_from(p, np.ascontiguousarray(q), self._a, lower, upper, self._held, self._work, self._mu, x, y):
            self._last = x, y
            return Solution(x, True, 0, y)
        if self._last is not None:
            self._backend.warm_start(*self._last)
            self._last = None
        solution = self._backend.solve(p, q, None if self._told_a else self._a, lower, upper)
        self._told_a = True
        self._held[:] = 0
        if solution.solved:
            reached = self._a @ solution.x
            self._held += 1 * (upper - reached < AT_BOUND) - 1 * (reached - lower < AT_BOUND)
        return solution

    def warm_start(self, x: Array, multipliers: Array) -> None:
        """See `Solver`."""
        self._last = x, multipliers
        self._held[:] = 0
        self._held[: len(multipliers)] = np.sign(multipliers)


def _finite(numbers: Array) -> bool:
    """True if every number is finite; false too if their sum overflows."""
    return math.isfinite(np.add.reduce(numbers))


def _built(p_mask: Mask, a_mask: Mask) -> Any:
    """Build OSQP's own solver object. Its Python wrapper takes another 50 us a step to look up constants and copy fields."""
    ext = osqp.OSQP(algebra="builtin").ext
    settings = ext.OSQPSettings()
    ext.osqp_set_default_settings(settings)
    for name, value in SETTINGS.items():
        setattr(settings, name, value)
    rows, n = a_mask.shape
    free = np.full(rows, NO_BOUND)
    p, a = (ext.CSC(sparse.csc_matrix(mask.astype(np.float64))) for mask in (p_mask, a_mask))
    return ext.OSQPSolver(p, np.zeros(n), a, -free, free, rows, n, settings)


def make_solver(
    name: Literal["osqp", "daqp"], p_mask: Mask, a_mask: Mask, scale: Array, row_scale: Array, bounds: int = 0
) -> Solver:
    """Build a solver with the backend of that name for problems with entries in these masks only, (n, n) and (m, n). The first
    `bounds` rows of A are those of the identity."""
    backend: Solver = (
        OsqpSolver(p_mask, a_mask, scale, row_scale)
        if name == "osqp"
        else DaqpSolver(p_mask, a_mask, scale, row_scale, bounds)
    )
    return ActiveSetFirst(backend, *a_mask.shape)


def _by_columns(mask: Mask) -> Entries:
    """The mask's entries in compressed-sparse-column order."""
    columns, rows = np.nonzero(mask.T)
    return np.column_stack([rows, columns])

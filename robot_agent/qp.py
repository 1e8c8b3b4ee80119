"""Quadratic programs of one fixed size, solved over and over: min 1/2 x'Px + q'x with lower <= Ax <= upper.

Both backends take dense arrays and own all bookkeeping. They are built once; a solve changes numbers, never structure, and
starts from the last solution. Whatever comes in is checked first, because OSQP does not (all reproduced with 1.1): bounds
that cross and vectors of a wrong size are printed and dropped, the old ones stay; a strided vector is misread; one NaN
spoils every later solve; `update(Px=)` overwrites the caller's array; an infeasible problem returns a finite x of 2e9.
"""

import importlib
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
import osqp
from numpy.typing import NDArray
from scipy import sparse

from wire.frames import Array
from wire.toml_file import ConfigError

Mask = NDArray[np.bool_]

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
CLOSE = 0.01  # of what was asked for: a hundred times the tolerance
NO_BOUND = 1e30  # what both solvers take for infinity


@dataclass(frozen=True, eq=False)
class Solution:
    """`x` is meaningful only if `solved`."""

    x: Array
    solved: bool
    iterations: int


class Solver(Protocol):
    """A backend."""

    def solve(self, p: Array, q: Array, a: Array, lower: Array, upper: Array) -> Solution:
        """Solve for p (n, n) symmetric, q (n,), a (m, n), bounds (m,); 1e30 and beyond is no bound."""


def usable(p: Array, q: Array, a: Array, lower: Array, upper: Array) -> bool:
    """True if every number is one and no bounds cross."""
    total = float(p.sum()) + float(q.sum()) + float(a.sum()) + float(lower.sum()) + float(upper.sum())
    return bool(np.isfinite(total) and (lower <= upper).all())


class OsqpSolver:
    """OSQP with a sparsity pattern frozen at the start: entries outside the masks must stay zero.

    `scale` (n,) and `row_scale` (m,) bring unknowns and rows near one; the solver does no scaling of its own, which would
    cost more than the solve and change from step to step.
    """

    def __init__(self, p_mask: Mask, a_mask: Mask, scale: Array, row_scale: Array) -> None:
        self._shape = a_mask.shape
        n = self._shape[1]
        upper = np.triu(p_mask) | np.eye(n, dtype=bool)
        self._p_entries = _by_columns(upper)
        self._a_entries = _by_columns(a_mask)
        self._scale, self._row_scale = scale.copy(), row_scale.copy()
        self._p_scale = (scale[:, None] * scale)[self._p_entries]
        self._a_scale = (row_scale[:, None] * scale)[self._a_entries]
        self._solver = _built(upper, a_mask)
        self._p_values, self._a_values = np.empty(len(self._p_scale)), np.empty(len(self._a_scale))

    def solve(self, p: Array, q: Array, a: Array, lower: Array, upper: Array) -> Solution:
        """See `Solver`."""
        if not usable(p, q, a, lower, upper):
            return Solution(np.zeros(len(q)), False, 0)
        np.multiply(p[self._p_entries], self._p_scale, out=self._p_values)
        np.multiply(a[self._a_entries], self._a_scale, out=self._a_values)
        low = np.maximum(lower * self._row_scale, -NO_BOUND)
        high = np.minimum(upper * self._row_scale, NO_BOUND)
        refused = self._solver.update_data_mat(P_x=self._p_values, P_i=None, A_x=self._a_values, A_i=None)
        refused |= self._solver.update_data_vec(q=q * self._scale, l=low, u=high)
        if refused:
            return Solution(np.zeros(len(q)), False, 0)
        self._solver.solve()
        x, info = np.array(self._solver.solution.x), self._solver.info
        if not (self._close(info, q) and np.isfinite(x).all()):
            self._solver.warm_start(np.zeros(len(q)), np.zeros(len(lower)))
            return Solution(np.zeros(len(q)), False, int(info.iter))
        return Solution(x * self._scale, True, int(info.iter))

    def _close(self, info: Any, q: Array) -> bool:
        """Solved; or out of iterations so close to it that the plan is better than the last one (residuals are scaled)."""
        status = info.status_val
        if status in (osqp.SolverStatus.OSQP_SOLVED, osqp.SolverStatus.OSQP_SOLVED_INACCURATE):
            return True
        enough = CLOSE * max(1.0, float(np.abs(q * self._scale).max()))
        return bool(status == osqp.SolverStatus.OSQP_MAX_ITER_REACHED and info.prim_res < CLOSE and info.dual_res < enough)


class DaqpSolver:
    """DAQP: dual active set, exact, with a short tail. For small problems."""

    def __init__(self, p_mask: Mask, a_mask: Mask, scale: Array, row_scale: Array) -> None:
        self._scale, self._row_scale = scale.copy(), row_scale.copy()
        self._sense = np.zeros(a_mask.shape[0], dtype=np.int32)
        try:
            self._daqp = importlib.import_module("daqp")
        except ModuleNotFoundError:
            raise ConfigError('controller.mpc.solver = "daqp": not installed here (pip install daqp, or use "osqp")') from None

    def solve(self, p: Array, q: Array, a: Array, lower: Array, upper: Array) -> Solution:
        """See `Solver`."""
        if not usable(p, q, a, lower, upper):
            return Solution(np.zeros(len(q)), False, 0)
        scale, rows = self._scale, self._row_scale
        x, _, status, info = self._daqp.solve(
            np.ascontiguousarray(p * (scale[:, None] * scale)),
            q * scale,
            np.ascontiguousarray(a * (rows[:, None] * scale)),
            np.minimum(upper * rows, NO_BOUND),
            np.maximum(lower * rows, -NO_BOUND),
            self._sense,
        )
        x = np.asarray(x) * scale
        solved = bool(status > 0 and np.isfinite(x).all())
        return Solution(x if solved else np.zeros(len(q)), solved, int(info["iterations"]))


def _built(p_mask: Mask, a_mask: Mask) -> Any:
    """OSQP's own solver object. Its Python wrapper takes another 50 us a step to look up constants and copy fields."""
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
    name: Literal["osqp", "daqp"],
    p_mask: Mask,
    a_mask: Mask,
    scale: Array,
    row_scale: Array,
) -> Solver:
    """The backend of that name for problems with entries in these masks only, (n, n) and (m, n)."""
    backend = OsqpSolver if name == "osqp" else DaqpSolver
    return backend(p_mask, a_mask, scale, row_scale)


def _by_columns(mask: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices (rows, columns) of the entries in compressed-sparse-column order."""
    columns, rows = np.nonzero(mask.T)
    return rows, columns

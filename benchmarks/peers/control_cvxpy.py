"""cvxpy with OSQP: the problem stated once with parameters (DPP), then solved over and over with a warm start."""

import importlib
from typing import Any

import numpy as np

from benchmarks.robot_agent.control_peer import Solution, in_place_of_ours, print_rows
from shoal.frames import Array

cp: Any = importlib.import_module("cvxpy")


class Cvxpy:
    """The Hessian enters as its root, as DPP wants it."""

    def __init__(self, n: int, rows: int) -> None:
        self._x = cp.Variable(n)
        self._root, self._q = cp.Parameter((n, n)), cp.Parameter(n)
        self._a, self._low, self._high = cp.Parameter((rows, n)), cp.Parameter(rows), cp.Parameter(rows)
        cost = 0.5 * cp.sum_squares(self._root @ self._x) + self._q @ self._x
        self._problem = cp.Problem(cp.Minimize(cost), [self._a @ self._x >= self._low, self._a @ self._x <= self._high])

    def solve(self, p: Array, q: Array, a: Array | None, lower: Array, upper: Array) -> Solution:
        """See `Solver`."""
        self._root.value = np.linalg.cholesky(p + 1e-9 * np.eye(len(p))).T
        self._q.value, self._low.value, self._high.value = q, lower, upper
        if a is not None:
            self._a.value = a
        self._problem.solve(solver=cp.OSQP, warm_start=True, eps_abs=1e-4, eps_rel=1e-4, max_iter=10000)
        solved = self._problem.status in ("optimal", "optimal_inaccurate")
        return Solution(np.array(self._x.value) if solved else np.zeros(len(q)), solved)


print_rows("cvxpy, OSQP", in_place_of_ours(Cvxpy))

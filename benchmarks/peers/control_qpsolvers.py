"""qpsolvers with OSQP: one call per problem, started from the last solution."""

import importlib
from typing import Any

import numpy as np
from scipy import sparse

from benchmarks.robot_agent.control_peer import Solution, in_place_of_ours, print_rows
from shoal.frames import Array

qpsolvers: Any = importlib.import_module("qpsolvers")


class QpSolvers:
    """Bounds are bounds; changes between blocks are rows, both ways."""

    def __init__(self, n: int, rows: int) -> None:
        self._n, self._last = n, np.zeros(n)
        self._g = sparse.csc_matrix((2 * (rows - n), n))

    def solve(self, p: Array, q: Array, a: Array | None, lower: Array, upper: Array) -> Solution:
        """See `Solver`."""
        n = self._n
        if a is not None:
            self._g = sparse.csc_matrix(np.vstack([a[n:], -a[n:]]))
        h = np.concatenate([upper[n:], -lower[n:]])
        x = qpsolvers.solve_qp(
            sparse.csc_matrix(p), q, self._g, h, lb=lower[:n], ub=upper[:n], solver="osqp", initvals=self._last, eps_abs=1e-4
        )
        if x is None:
            return Solution(np.zeros(n), False)
        self._last = x
        return Solution(x, True)


print_rows("qpsolvers, OSQP", in_place_of_ours(QpSolvers))

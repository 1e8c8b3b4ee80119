"""CasADi with qpOASES: dense active set, hot-started."""

import importlib
from typing import Any

import numpy as np

from benchmarks.robot_agent.control_peer import Solution, in_place_of_ours, print_rows
from shoal.frames import Array

ca: Any = importlib.import_module("casadi")


class QpOases:
    """CasADi's `conic` with its settings for model predictive control."""

    def __init__(self, n: int, rows: int) -> None:
        dense = {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(rows - n, n)}
        self._solver = ca.conic("qp", "qpoases", dense, {"printLevel": "none", "error_on_fail": False})
        self._n, self._a, self._last = n, np.zeros((rows - n, n)), np.zeros(n)

    def solve(self, p: Array, q: Array, a: Array | None, lower: Array, upper: Array) -> Solution:
        """See `Solver`."""
        n = self._n
        if a is not None:
            self._a = a[n:]
        out = self._solver(h=p, g=q, a=self._a, lba=lower[n:], uba=upper[n:], lbx=lower[:n], ubx=upper[:n], x0=self._last)
        solved = bool(self._solver.stats()["success"])
        self._last = np.array(out["x"]).ravel() if solved else np.zeros(n)
        return Solution(self._last.copy(), solved)


print_rows("CasADi, qpOASES", in_place_of_ours(QpOases))

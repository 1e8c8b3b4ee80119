"""SHELL: runs one of the programs with a flaw built in that no wire can bring about.

    python -m tests.faults.patched FILE MODULE ARGUMENTS...

The wall clock is off by as many seconds as FILE says. From a signal on, the solver of the quadratic program never returns
(SIGUSR1), takes 30 ms longer (SIGUSR2), or finds no solution (SIGALRM). All else is the program as it is.
"""

import runpy
import signal
import sys
import time
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from robot_agent.qp import OsqpSolver, Solution
from sim_bridge import stepped_clock

SLOW_S, FOR_EVER_S = 0.03, 1e6


class Flaws:
    """What is wrong with this process now."""

    def __init__(self) -> None:
        self.delay_s = 0.0
        self.unsolved = False

    def on_signal(self, number: int, frame: FrameType | None) -> None:
        """Another flaw."""
        self.unsolved |= number == signal.SIGALRM
        self.delay_s = {signal.SIGUSR1: FOR_EVER_S, signal.SIGUSR2: SLOW_S}.get(signal.Signals(number), self.delay_s)

    def install(self) -> None:
        """Build the flaws in."""
        real_solve = OsqpSolver.solve

        def solve(solver: OsqpSolver, p: Any, q: Any, *rest: Any) -> Solution:
            time.sleep(self.delay_s)  # a solver that waits is as late as one that computes
            return Solution(np.zeros(len(q)), False, 0) if self.unsolved else real_solve(solver, p, q, *rest)

        OsqpSolver.solve = solve  # type: ignore[assignment, method-assign]
        for number in (signal.SIGUSR1, signal.SIGUSR2, signal.SIGALRM):
            signal.signal(number, self.on_signal)


if __name__ == "__main__":
    file, module, *arguments = sys.argv[1:]
    stepped_clock.install(Path(file))
    Flaws().install()
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)

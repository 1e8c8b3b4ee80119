"""SHELL: runs one of the programs with a flaw built in that no wire can bring about.

    python -m tests.faults.patched SECONDS MODULE ARGUMENTS...

The wall clock is off by SECONDS, and steps by an hour at SIGHUP. From a signal on, the control step never ends (SIGUSR1),
takes 30 ms longer (SIGUSR2), or its quadratic program has no solution (SIGALRM). All else is the program as it is.
"""

import runpy
import signal
import sys
import time
from types import FrameType
from typing import Any

import numpy as np

from robot_agent.controller import Controller
from robot_agent.qp import OsqpSolver, Solution

HOUR_NS = 3_600_000_000_000
SLOW_S, FOR_EVER_S = 0.03, 1e6


class Flaws:
    """What is wrong with this process now."""

    def __init__(self, offset_s: float) -> None:
        self.offset_ns = round(offset_s * 1e9)
        self.delay_s = 0.0
        self.unsolved = False

    def on_signal(self, number: int, frame: FrameType | None) -> None:
        """Another flaw."""
        self.offset_ns += HOUR_NS * (number == signal.SIGHUP)
        self.unsolved |= number == signal.SIGALRM
        self.delay_s = {signal.SIGUSR1: FOR_EVER_S, signal.SIGUSR2: SLOW_S}.get(signal.Signals(number), self.delay_s)


def install(flaws: Flaws) -> None:
    """Build the flaws in."""
    real_ns, real_step, real_solve = time.time_ns, Controller.step, OsqpSolver.solve

    def time_ns() -> int:
        return real_ns() + flaws.offset_ns

    def step(*arguments: Any) -> Any:
        until_ns = time.thread_time_ns() + round(flaws.delay_s * 1e9)
        while time.thread_time_ns() < until_ns:
            pass
        return real_step(*arguments)

    def solve(solver: OsqpSolver, p: Any, q: Any, *rest: Any) -> Solution:
        return Solution(np.zeros(len(q)), False, 0) if flaws.unsolved else real_solve(solver, p, q, *rest)

    changes = ((time, "time_ns", time_ns), (time, "time", lambda: time_ns() * 1e-9))
    for holder, name, change in (*changes, (Controller, "step", step), (OsqpSolver, "solve", solve)):
        setattr(holder, name, change)
    for number in (signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2, signal.SIGALRM):
        signal.signal(number, flaws.on_signal)


if __name__ == "__main__":
    offset, module, *arguments = sys.argv[1:]
    install(Flaws(float(offset)))
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)

"""The frame of the peers of `control_step`: fly the given case with their solver in place of ours, print the rows."""

import json
import sys
from collections.abc import Callable
from dataclasses import asdict
from typing import Any, NamedTuple, Protocol

import numpy as np

from benchmarks.robot_agent.control_loop import Case, fly
from robot_agent.control.controller import Controller
from robot_agent.control.law_controller import LawController
from robot_agent.guidance.formation import HalfSpaces
from shoal.config.experiment import Experiment
from shoal.frames import Array


class Solution(NamedTuple):
    """`x` is meaningful only if `solved`."""

    x: Array
    solved: bool


class Solver(Protocol):
    """A peer's solver."""

    def solve(self, p: Array, q: Array, a: Array | None, lower: Array, upper: Array) -> Solution:
        """Solve min 1/2 x'Px + q'x with lower <= Ax <= upper, the first rows of A those of the identity. `a` None: as it
        was."""


MakeSolver = Callable[[int, int], Solver]  # unknowns, rows


def case_from_stdin() -> tuple[Case, int]:
    """The case, and how many steps."""
    task = json.load(sys.stdin)
    case = task["case"]
    return Case(case["setting"], case["neighbours"], case["beside"], tuple(case["more"])), task["steps"]


def print_rows(name: str, tamper: Callable[[Controller, Experiment], None]) -> None:
    """Fly, and print the rows as JSON."""
    case, steps = case_from_stdin()
    flown = fly(case, steps, tamper)
    name = f"{name} ({flown.unsolved} of {steps} unsolved)" if flown.unsolved else name
    print("\n" + json.dumps([asdict(row) for row in flown.rows("control_step", str(case), name)]))


def in_place_of_ours(make: MakeSolver) -> Callable[[Controller, Experiment], None]:
    """A tamper that solves the controller's quadratic programs with `make`'s solver."""

    def tamper(controller: Controller, experiment: Experiment) -> None:
        size = 3 * len(experiment.controller.mpc.blocks)
        assert isinstance(controller, LawController)
        mpc: Any = controller._law
        program, working, solver = mpc._program, mpc._working, make(size, 2 * size)  # without half-spaces and their slack
        first_rows: list[Array | None] = [np.ascontiguousarray(program.a[: 2 * size, :size])]

        def solve(keep_clear: HalfSpaces) -> int:
            p, q = np.ascontiguousarray(program.p[:size, :size]), program.q[:size].copy()
            a, first_rows[0] = first_rows[0], None
            solution = solver.solve(p, q, a, program.lower[: 2 * size].copy(), program.upper[: 2 * size].copy())
            working.x[:size], working.x[size] = solution.x, 0.0
            return int(solution.solved)

        mpc._solve = solve

    return tamper

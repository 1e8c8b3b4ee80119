"""The frame of the peers of `control_step`: fly the given case with their solver in place of ours, print the rows."""

import json
import sys
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from benchmarks.robot_agent.control_loop import Case, fly
from robot_agent.control.any_controller import AnyController
from robot_agent.control.controller import Controller
from robot_agent.control.qp import Solver
from shoal.config.experiment import Experiment

MakeSolver = Callable[[int, int], Solver]  # unknowns, rows


def case_from_stdin() -> tuple[Case, int]:
    """The case, and how many steps."""
    task = json.load(sys.stdin)
    case = task["case"]
    return Case(case["setting"], case["neighbours"], case["beside"], tuple(case["more"])), task["steps"]


def print_rows(name: str, tamper: Callable[[AnyController, Experiment], None]) -> None:
    """Fly, and print the rows as JSON."""
    case, steps = case_from_stdin()
    flown = fly(case, steps, tamper)
    name = f"{name} ({flown.unsolved} of {steps} unsolved)" if flown.unsolved else name
    print("\n" + json.dumps([asdict(row) for row in flown.rows("control_step", str(case), name)]))


def in_place_of_ours(make: MakeSolver) -> Callable[[AnyController, Experiment], None]:
    """A tamper that solves the controller's quadratic programs with `make`'s solver."""

    def tamper(controller: AnyController, experiment: Experiment) -> None:
        size = 3 * len(experiment.controller.mpc.blocks)
        assert isinstance(controller, Controller)
        mpc: Any = controller._law
        mpc._plain_solver = make(size, 2 * size)  # it has A from the first solve on
        mpc._plain_solver.solve(mpc._p, mpc._q[:size], mpc._a, mpc._lower[: 2 * size], mpc._upper[: 2 * size])

    return tamper

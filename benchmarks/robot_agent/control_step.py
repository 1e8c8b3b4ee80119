"""One complete control step, closed loop: the nonlinear MPC, and the article's linear one with our solvers and with peers'.

Peers solve the very same quadratic programs (do-mpc: the same task as a nonlinear program, beside which stands ours), each in
an environment of its own. Ours of the article's setting are mostly solved
from the last active set; with `OSQP each step` all go to the backend, as with a peer. `first move`
is how far a solver's first move is from the exact solution of the same problem, by DAQP, in percent of the largest wrench.
"""

from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import numpy as np

from benchmarks.harness import Row, run_peer
from benchmarks.robot_agent.control_loop import Case, Flown, fly
from robot_agent.control.any_controller import AnyController
from robot_agent.control.controller import Controller
from robot_agent.control.qp import Solution, Solver, make_solver
from shoal.config.experiment import Experiment
from shoal.frames import Array

BENCHMARK = "control_step"
STEPS, PEER_STEPS = 3000, 300
CASES = [
    Case(setting, neighbours, beside)
    for setting in ("article's", "default")  # the linear program, and the nonlinear one
    for neighbours, beside in ((0, False), (2, False), (5, False), (2, True))
]
PEER_CASES = [case for case in CASES if case.neighbours == 2 and not case.beside]
OURS = ["numpy", "scipy", "osqp", "numba", "protobuf", "pydantic", "tomli_w", "typer", "rich"]
PEERS = {
    "control_cvxpy": ["cvxpy"],
    "control_qpsolvers": ["qpsolvers[osqp]"],
    "control_qpoases": ["casadi"],
    "control_dompc": ["do-mpc", "casadi"],
}
EXACT = 1e-9


class Witness:
    """A solver that also solves every problem exactly, and notes how far apart the first moves are."""

    def __init__(self, solver: Solver, exact: Solver, blocks: int, limit: Array) -> None:
        self._solver, self._exact = solver, exact
        self._first = np.array([0, blocks, 2 * blocks])  # surge, yaw, heave
        self._limit = limit[[0, 2, 1]]
        self._a: Array | None = None
        self.apart: list[float] = []

    def solve(self, p: Array, q: Array, a: Array | None, lower: Array, upper: Array) -> Solution:
        """Ours, and on the side the exact one."""
        ours = self._solver.solve(p, q, a, lower, upper)
        self._a = a if a is not None else self._a
        exact = self._exact.solve(p, q, a, lower, upper)
        if ours.solved and exact.solved:
            self.apart.append(100.0 * float((np.abs(ours.x - exact.x)[self._first] / self._limit).max()))
        return ours

    def warm_start(self, x: Array, multipliers: Array) -> None:
        """Passed on."""
        self._solver.warm_start(x, multipliers)


def first_moves(case: Case) -> list[float]:
    """Distance from the exact first move, percent of the largest wrench, at every control step of a flight."""
    witnesses: list[Witness] = []

    def watch(controller: AnyController, experiment: Experiment) -> None:
        assert isinstance(controller, Controller)
        mpc: Any = controller._law
        blocks, size = len(experiment.controller.mpc.blocks), 3 * len(experiment.controller.mpc.blocks)
        p_mask, a_mask = np.ones((size, size), dtype=bool), mpc._a != 0.0
        exact = make_solver("daqp", p_mask, a_mask, np.ones(size), np.ones(2 * size), bounds=size)
        mpc._plain_solver = Witness(mpc._plain_solver, exact, blocks, np.array(experiment.vehicle.limits.wrench))
        exact.solve(mpc._p + np.eye(size), mpc._q[:size], mpc._a, mpc._lower[: 2 * size], mpc._upper[: 2 * size])
        witnesses.append(mpc._plain_solver)

    fly(case, STEPS // 3, watch)
    return witnesses[0].apart


def backend_alone(controller: AnyController, experiment: Experiment) -> None:
    """Give every problem to the backend."""
    assert isinstance(controller, Controller)
    mpc: Any = controller._law
    mpc._plain_solver, mpc._half_space_solver = mpc._plain_solver._backend, mpc._half_space_solver._backend
    q, lower, upper = mpc._plain
    mpc._plain_solver.solve(mpc._p, q, mpc._a, lower, upper)  # it has A from now on


def run() -> Iterator[Row]:
    """Ours in every case, peers with two neighbours."""
    for case in CASES:
        if case.setting == "default":
            yield from fly(case, STEPS).rows(BENCHMARK, str(case), "ours")
            continue
        for solver in ("osqp", "daqp"):
            flown: Flown = fly(Case(case.setting, case.neighbours, case.beside, (f'controller.mpc.solver="{solver}"',)), STEPS)
            yield from flown.rows(BENCHMARK, str(case), f"ours, {solver}")
        yield Row.of(BENCHMARK, str(case), "ours, OSQP each step", "us", fly(case, STEPS, backend_alone).step_us)
        if case in PEER_CASES:
            yield Row.of(BENCHMARK, str(case), "ours, osqp", "% of full wrench off the exact first move", first_moves(case))
            for peer, needs in PEERS.items():
                yield from run_peer(peer, [*OURS, *needs], {"case": asdict(case), "steps": PEER_STEPS})

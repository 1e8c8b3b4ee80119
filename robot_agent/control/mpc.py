"""The article's model predictive control (33-40), condensed: a quadratic program over a move-blocked wrench.

Unknowns, channel by channel, planar ones first: surge blocks, yaw blocks, heave blocks, and one slack in metres. Cost (35)
halved: ||eta - reference||^2_W over the nodes, ||change between blocks||^2_R, slack. Rows: bounds (39) on every block, bounds
(40) on every change, half-spaces that keep other robots away (36).

The model is linearised around the present state once a control step (linearisation.py); active_set.py solves, or OSQP where
that fails.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from robot_agent.control.active_set import NO_BOUND, ActiveSet, ConvexProgram, make_active_set, solve_from
from robot_agent.control.linearisation import (
    ControlTask,
    Cost,
    block_of,
    follow_plan,
    linearise_and_condense,
    make_linear_model,
    make_responses,
)
from robot_agent.control.osqp_fallback import solve_by_osqp
from robot_agent.guidance.formation import HalfSpaces
from robot_agent.vehicle.dynamics import STATES, Model, State
from shoal.config.controller import MpcConfig
from shoal.config.vehicle import Vehicle
from shoal.frames import Array
from shoal.messages.messages import Solve

CHANNELS = (0, 2, 1)  # order of the unknowns: surge, yaw, heave
RIDGE = 1e-9  # per N^2: keeps the problem strictly convex when every weight of a channel is zero
BRIDGED_S = 0.15  # that the last good plan may bridge: three poses of a camera at 20 Hz
WEIGHED_S = 0.05  # control period for which `r` weighs changes against the errors at the nodes


def bridged_steps(period_s: float) -> int:
    """Number of consecutive control steps that the last plan may bridge without a solution."""
    return int(BRIDGED_S / period_s + 1e-9)


class MpcPlan(NamedTuple):
    """A wrench for now, and the predicted poses."""

    wrench: Array  # (3,)
    eta: Array  # (horizon + 1, 4) predicted, node 0 is the start
    solve: Solve
    iterations: int
    slack_m: float
    wanted: Array | None = None  # (3,) before it was limited, by a law that knows no limits


class Mpc:
    """Model predictive controller of one robot, with its workspaces and memory."""

    def __init__(self, vehicle: Vehicle, model: Model, config: MpcConfig, period_s: float, rows: int) -> None:
        """Build the quadratic program once, with room for `rows` half-spaces at most."""
        self._period_s, self._n, self._nodes = period_s, len(config.blocks), config.horizon + 1
        self._limit, self._step_limit = np.array(vehicle.limits.wrench[:3]), np.array(vehicle.limits.wrench_step(period_s)[:3])
        self._model = make_linear_model(model, period_s, config.horizon, config.blocks)
        self._responses = make_responses(self._nodes, self._n)
        n, size = self._n, 3 * self._n
        self._blocks = np.zeros(size)  # of the last good plan
        self._shifted, self._most_shifted = 0, bridged_steps(period_s)
        block = block_of(config.blocks, self._most_shifted + 1)
        self._unknowns = block[:, None] + n * np.array([0, 2, 1])  # (steps, 3) where each step's wrench is among the unknowns
        difference = np.eye(n) - np.eye(n, k=-1)
        limits, steps = self._limit.take(CHANNELS).repeat(n), self._step_limit.take(CHANNELS).repeat(n)
        upper = np.concatenate([limits, steps, np.full(rows, NO_BOUND)])
        a = block_diag(np.vstack([np.eye(size), block_diag(difference, difference, difference)]), np.ones((rows, 1)))
        self._program = ConvexProgram(np.zeros((size + 1, size + 1)), np.zeros(size + 1), a, -upper, upper)
        self._working = make_active_set(size + 1, len(a))
        self._plain = self._first_rows(2 * size)  # the problem without half-spaces
        self._first_changes = size + n * np.array([0, 2, 1])  # rows of the changes from the wrench asked for last
        self.tune(config)

    def tune(self, config: MpcConfig) -> None:
        """Use other weights from the next step on; the plan stays."""
        # The cost sums errors over nodes: with more nodes a second they weigh more, and so must changes of the wrench.
        n, per_node = self._n, WEIGHED_S / self._period_s
        difference, r = np.eye(n) - np.eye(n, k=-1), per_node * np.array(config.r)
        smooth = [r[channel] * difference.T @ difference + RIDGE * np.eye(n) for channel in CHANNELS]
        slack = config.slack * max(1.0, *config.q[:2], *config.q_formation[:2])
        self._cost = Cost(block_diag(*smooth, np.array([[slack]])), r, self._program.p, self._program.q)

    def reset(self) -> None:
        """Forget the last plan: until the next solution, for a few steps at most, the thrusters stay off."""
        self._shifted = 0
        self._blocks = np.zeros(3 * self._n)

    def plan(
        self,
        state: State | Array,
        disturbance: Array,
        wrench: Array,
        reference: Array,
        weight: Array,
        keep_clear: HalfSpaces,
        current: complex = 0j,
        delivered: Array | None = None,
    ) -> MpcPlan:
        """Solve once, see `Law.plan`. Limits (40) count from `wrench` (3,), asked for last. The model assumes that what
        `delivered` (3,) lacks of it goes on to lack. The article knows no current."""
        begin = np.zeros(STATES)
        begin[: len(state)] = state
        task = ControlTask(begin, wrench, wrench if delivered is None else delivered, disturbance, reference, weight)
        linearise_and_condense(self._model, task, self._responses, self._cost)
        first, eta = self._first_changes, np.empty((self._nodes, 4))
        self._program.lower[first], self._program.upper[first] = wrench - self._step_limit, wrench + self._step_limit
        iterations = self._solve(keep_clear)
        if not iterations:
            follow_plan(self._blocks, self._responses, eta)
            return self._fall_back(wrench, eta)
        self._blocks, self._shifted = self._working.x[:-1].copy(), 0
        follow_plan(self._blocks, self._responses, eta)
        slack_m = max(0.0, float(self._working.x[-1]))
        return MpcPlan(self._step_of_plan(0, wrench), eta, Solve.SOLVED, iterations, slack_m)

    def _solve(self, keep_clear: HalfSpaces) -> int:
        """Solve with half-spaces (36) in the first of the rows reserved for them. Returns the rounds of the solver, or OSQP's
        iterations; 0: no solution."""
        program, working, limits = self._program, self._working, 6 * self._n
        count = limits + len(keep_clear.node)
        rows = slice(limits, count)
        if count > limits:
            (x, y), free = self._responses.place[:, keep_clear.node], 2 * self._n
            along, across = keep_clear.normal.real[:, None], keep_clear.normal.imag[:, None]
            there = along * x + across * y
            program.a[rows, :free], program.lower[rows] = there[:, :free], keep_clear.offset - there[:, free]
        working.held[count:] = 0
        problem = self._first_rows(count) if count > limits else self._plain
        rounds = solve_from(*problem) or solve_by_osqp(*problem)
        if rounds == 0:
            working.held[:] = 0
        return rounds

    def _first_rows(self, count: int) -> tuple[ConvexProgram, ActiveSet]:
        """The problem with its first rows only, and its active set."""
        program, working = self._program, self._working
        return (
            program._replace(a=program.a[:count], lower=program.lower[:count], upper=program.upper[:count]),
            working._replace(multiplier=working.multiplier[:count], held=working.held[:count]),
        )

    def _step_of_plan(self, step: int, before: Array) -> Array:
        """Return the last good plan's wrench (3,) at a step, within the limits."""
        wanted = np.minimum(
            np.maximum(self._blocks[self._unknowns[step]], before - self._step_limit), before + self._step_limit
        )
        limited: Array = np.minimum(np.maximum(wanted, -self._limit), self._limit)
        return limited

    def _fall_back(self, wrench: Array, eta: Array) -> MpcPlan:
        """Return the last good plan moved on by a step; FAILED and no thrust once BRIDGED_S are used up."""
        if self._shifted >= self._most_shifted:
            self.reset()
            self._shifted = self._most_shifted
            return MpcPlan(np.zeros(3), eta, Solve.FAILED, 0, 0.0)
        self._shifted += 1
        return MpcPlan(self._step_of_plan(self._shifted, wrench), eta, Solve.SHIFTED, 0, 0.0)

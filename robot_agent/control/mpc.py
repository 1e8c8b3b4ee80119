"""Model predictive control (33-40), condensed: a quadratic program over a move-blocked wrench.

Unknowns, channel by channel, planar ones first: surge blocks, yaw blocks, heave blocks, and one slack in metres. Cost (35)
halved: ||eta - reference||^2_W over the nodes, ||change between blocks||^2_R, slack. Rows: bounds (39) on every block, bounds
(40) on every change, half-spaces that keep other robots away (36).

The article's law, for comparison: the model is linearised around the present state, once a control step.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from robot_agent.control.active_set import NO_BOUND
from robot_agent.control.linearisation import Prediction
from robot_agent.control.qp import Solution, Solver, make_solver
from robot_agent.guidance.formation import HalfSpaces
from robot_agent.vehicle.dynamics import Model, State
from shoal.config.controller import MpcConfig
from shoal.config.vehicle import Vehicle
from shoal.frames import Array
from shoal.kernels.decorator import kernel
from shoal.messages.messages import Solve

CHANNELS = (0, 2, 1)  # order of the unknowns: surge, yaw, heave
RIDGE = 1e-9  # per N^2: keeps the problem strictly convex when every weight of a channel is zero
BRIDGED_S = 0.15  # that the last good plan may bridge: three poses of a camera at 20 Hz
WEIGHED_S = 0.05  # control period for which `r` weighs changes against the errors at the nodes


def bridged_steps(period_s: float) -> int:
    """Number of consecutive control steps that the last plan may bridge without a solution."""
    return int(BRIDGED_S / period_s + 1e-9)


@kernel("void(f8[::1], f8[::1], i8[::1], f8[::1], f8[::1])")
def bound_first_changes(asked: Array, most: Array, row: NDArray[np.int64], lower: Array, upper: Array) -> None:
    """Bounds (40) on the changes at `row` (3,) of a problem, by `most` (3,) from the wrench that was `asked` for (3,)."""
    for i in range(3):
        lower[row[i]], upper[row[i]] = asked[i] - most[i], asked[i] + most[i]


@kernel("void(f8[::1], i8[::1], f8[::1], f8[::1], f8[::1], f8[::1])")
def within_limits(b: Array, unknown: NDArray[np.int64], before: Array, change: Array, limit: Array, wrench: Array) -> None:
    """The `wrench` (3,) at `unknown` (3,) of the blocks `b`, clipped exactly: to a `change` from that `before`, then to its
    `limit`. (A solver's tolerance is 1e-4.)"""
    for i in range(3):
        wrench[i] = min(max(b[unknown[i]], before[i] - change[i]), before[i] + change[i])
        wrench[i] = min(max(wrench[i], -limit[i]), limit[i])


class MpcPlan(NamedTuple):
    """A wrench for now, and the predicted poses."""

    wrench: Array  # (3,)
    eta: Array  # (horizon + 1, 4) predicted, node 0 is the start
    solve: Solve
    iterations: int
    slack_m: float
    wanted: Array | None = None  # (3,) before it was limited, by a law that knows no limits


class Mpc:
    """Model predictive controller of one robot, with its workspaces and memory.

    Half-spaces are rare, and their rows would double the time of a solve. So there are two problems: one with the limits only,
    one with `rows` half-spaces and a slack in addition.
    """

    def __init__(self, vehicle: Vehicle, model: Model, config: MpcConfig, period_s: float, rows: int) -> None:
        self._config, self._n = config, len(config.blocks)
        self._limit, self._step_limit = np.array(vehicle.limits.wrench), np.array(vehicle.limits.wrench_step(period_s))
        self._prediction = Prediction(model, period_s, config.horizon, config.blocks)
        n, size = self._n, 3 * self._n
        self._blocks = np.zeros(size)  # of the last good plan
        self._shifted, self._most_shifted = 0, bridged_steps(period_s)
        ends = np.cumsum(config.blocks)
        block = np.minimum(np.searchsorted(ends, np.arange(self._most_shifted + 1), side="right"), n - 1)
        self._unknowns = block[:, None] + n * np.array([0, 2, 1])  # (steps, 3) where each step's wrench is among the unknowns
        difference = np.eye(n) - np.eye(n, k=-1)
        per_node = WEIGHED_S / period_s  # twice as many nodes a second count twice: so must a change between two blocks
        self._r = per_node * np.array(config.r)
        smooth = [self._r[channel] * difference.T @ difference + RIDGE * np.eye(n) for channel in CHANNELS]
        self._smooth = block_diag(*smooth)
        self._p, self._q = np.zeros((size, size)), np.zeros(size + 1)
        self._slack = config.slack * max(1.0, *config.q[:2], *config.q_formation[:2])
        self._p_with_slack = block_diag(self._p, np.array([[self._slack]]))
        self._a = np.vstack([np.eye(size), block_diag(difference, difference, difference)])
        self._a_with_slack = block_diag(self._a, np.ones((rows, 1)))
        limits, steps = self._limit.take(CHANNELS).repeat(n), self._step_limit.take(CHANNELS).repeat(n)
        self._upper = np.concatenate([limits, steps, np.full(rows, NO_BOUND)])
        self._lower = -self._upper
        # The same without half-spaces: views, so that what is written to the one is in the other
        self._plain = self._q[:size], self._lower[: 2 * size], self._upper[: 2 * size]
        self._half_spaces = self._a_with_slack[2 * size :], self._lower[2 * size :]
        self._first_changes = size + n * np.array([0, 2, 1])  # rows of the changes from the wrench asked for last
        self._plain_solver, self._half_space_solver = self._make_solvers(rows)
        self._multipliers = np.zeros(2 * size)  # of the limits, in the last solution
        self._had_half_spaces = False

    def _make_solvers(self, rows: int) -> tuple[Solver, Solver]:
        """Build both solvers, scaled so that the Hessian of a robot at rest has a unit diagonal: 16 iterations, 18-40 with the
        limits as scale."""
        n, size = self._n, 3 * self._n
        p_beside = block_diag(np.ones((2 * n, 2 * n)), np.ones((n, n)), np.ones((1, 1))) > 0.0
        a_beside = self._a_with_slack != 0.0
        a_beside[2 * size :, : 2 * n] = True
        rest, reference, weight = np.zeros(11), np.zeros(self._prediction.eta.shape), np.array(self._config.q)
        self._prediction.restart(rest)
        self._write_cost(rest, np.zeros(3), np.zeros(3), np.zeros(4), 0j, reference, weight + self._config.q_formation)
        scale = 1.0 / np.sqrt(np.diagonal(self._p))
        slack = 1.0 / np.sqrt(self._slack)
        row_scale, scale_beside = np.tile(1.0 / scale, 2), np.append(scale, slack)
        name, row_scale_beside = self._config.solver, np.append(row_scale, np.full(rows, 1.0 / slack))
        alone = make_solver(name, p_beside[:-1, :-1], self._a != 0.0, scale, row_scale, bounds=size)
        q, lower, upper = self._plain
        alone.solve(self._p, q, self._a, lower, upper)  # it has A from now on
        return alone, make_solver(name, p_beside, a_beside, scale_beside, row_scale_beside, bounds=size)

    def reset(self) -> None:
        """Forget the last plan: until the next solution, for a few steps at most, the thrusters stay off."""
        self._shifted = 0
        self._blocks = np.zeros(3 * self._n)

    def take_over_plan(self, other: "Mpc") -> None:
        """Take over the plan of an MPC with other weights, and nothing else of it."""
        self._prediction, self._shifted = other._prediction, other._shifted
        self._blocks, self._multipliers = other._blocks, other._multipliers
        self._plain_solver.warm_start(self._blocks, self._multipliers)

    def predicted_path(self, state: State | Array) -> Array:
        """Return the poses (horizon + 1, 4) around which the coming plan is linearised: those of `state`."""
        self._prediction.restart(state)
        return self._prediction.eta

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
        `delivered` (3,) lacks of it goes on to lack."""
        self.predicted_path(state)
        acts = wrench if delivered is None else delivered
        self._write_cost(np.asarray(state), wrench, acts, disturbance, current, reference, weight)
        bound_first_changes(wrench, self._step_limit, self._first_changes, self._lower, self._upper)
        solution = self._qp_with_half_spaces(keep_clear) if len(keep_clear.node) else self._qp_plain()
        if not solution.solved:
            return self._fall_back(wrench, solution.iterations)
        self._blocks, self._shifted = solution.x[: 3 * self._n], 0
        if solution.multipliers is not None:
            self._multipliers = solution.multipliers[: 6 * self._n]
        eta = self._prediction.follow_plan(self._blocks)
        slack_m = max(0.0, float(solution.x[-1])) if self._had_half_spaces else 0.0
        return MpcPlan(self._step_of_plan(0, wrench), eta, Solve.SOLVED, solution.iterations, slack_m)

    def _write_cost(
        self,
        state: Array,
        asked: Array,
        delivered: Array,
        disturbance: Array,
        current: complex,
        reference: Array,
        weight: Array,
    ) -> None:
        """Write P and q of (35)."""
        self._prediction.linearise_and_condense(
            state, asked, delivered, disturbance, current, reference, weight, self._smooth, self._r, self._p, self._plain[0]
        )

    def _qp_plain(self) -> Solution:
        """Solve without half-spaces."""
        if self._had_half_spaces:
            self._plain_solver.warm_start(self._blocks, self._multipliers)
            self._had_half_spaces = False
        q, lower, upper = self._plain
        return self._plain_solver.solve(self._p, q, None, lower, upper)

    def _qp_with_half_spaces(self, keep_clear: HalfSpaces) -> Solution:
        """Solve with half-spaces (36) in the first of the rows reserved for them."""
        if not self._had_half_spaces:
            self._half_space_solver.warm_start(np.append(self._blocks, 0.0), self._multipliers)
            self._had_half_spaces = True
        self._prediction.half_space_rows(keep_clear, *self._half_spaces)
        self._p_with_slack[:-1, :-1] = self._p
        return self._half_space_solver.solve(self._p_with_slack, self._q, self._a_with_slack, self._lower, self._upper)

    def _step_of_plan(self, step: int, before: Array) -> Array:
        """Return the last good plan's wrench (3,) at a step, within the limits."""
        wrench = np.empty(3)
        within_limits(self._blocks, self._unknowns[step], before, self._step_limit, self._limit, wrench)
        return wrench

    def _fall_back(self, wrench: Array, iterations: int) -> MpcPlan:
        """Return the last good plan moved on by a step; FAILED and no thrust once BRIDGED_S are used up."""
        eta = self._prediction.eta.copy()
        if self._shifted >= self._most_shifted:
            self.reset()
            self._shifted = self._most_shifted
            return MpcPlan(np.zeros(3), eta, Solve.FAILED, iterations, 0.0)
        self._shifted += 1
        return MpcPlan(self._step_of_plan(self._shifted, wrench), eta, Solve.SHIFTED, iterations, 0.0)

"""Model predictive control (33-40), condensed: a quadratic program over move-blocked changes of the wrench.

Unknowns, channel by channel, planar ones first: surge blocks, yaw blocks, heave blocks as differences to the wrench that acts
now, and one slack in metres. Cost (35) halved: ||eta - reference||^2_W over the nodes, ||change between blocks||^2_R, slack.
Rows: bounds (39) on every block, bounds (40) on every change, half-spaces that keep other robots away (36).

Each plan is the trajectory the next step linearises along (`linearise = "trajectory"`), so that one solve per control step
suffices; `"point"` is the article's single working point.
"""

from dataclasses import dataclass

import numpy as np

from robot_agent.formation import HalfSpaces
from robot_agent.model import Model, State
from robot_agent.prediction import Prediction
from robot_agent.qp import NO_BOUND, Solver, make_solver
from wire.experiment import Mpc as MpcConfig
from wire.frames import Array
from wire.messages import Solve
from wire.vehicle import Vehicle

CHANNELS = (0, 2, 1)  # order of the unknowns: surge, yaw, heave
RIDGE = 1e-9  # per N^2: keeps the problem strictly convex when every weight of a channel is zero
MAX_SHIFTED = 3  # control steps that the last good plan may bridge


@dataclass(frozen=True, eq=False)
class MpcPlan:
    """What to do now, and what is expected of it."""

    wrench: Array  # (3,)
    eta: Array  # (horizon + 1, 4) predicted, node 0 is the start
    solve: Solve
    iterations: int
    slack_m: float


class Mpc:
    """Workspaces and memory of one robot's controller."""

    def __init__(self, vehicle: Vehicle, model: Model, config: MpcConfig, period_s: float, rows: int) -> None:
        self._config, self._n, self._h = config, len(config.blocks), config.horizon
        self._limit, self._step_limit = np.array(vehicle.limits.wrench), np.array(vehicle.limits.wrench_step)
        self._prediction = Prediction(model, period_s, config.horizon, config.blocks)
        self._solution, self._base = np.zeros(3 * self._n + 1), np.zeros(3)  # the last good plan, and what it changes
        self._shifted = MAX_SHIFTED
        self._fresh = True
        n = self._n
        ends = np.cumsum(config.blocks)
        first = np.minimum(np.searchsorted(ends, np.arange(MAX_SHIFTED + 1), side="right"), n - 1)
        self._unknowns = first[:, None] + n * np.array([0, 2, 1])  # (steps, 3) where each step's wrench is among the unknowns
        size, fixed = 3 * n + 1, 6 * n
        self._p, self._q = np.zeros((size, size)), np.zeros(size)
        self._a = np.zeros((fixed + rows, size))
        self._lower, self._upper = np.full(fixed + rows, -NO_BOUND), np.full(fixed + rows, NO_BOUND)
        difference = np.eye(n) - np.eye(n, k=-1)
        self._rates = np.zeros((3 * n, 3 * n))
        for i, channel in enumerate(CHANNELS):
            block = slice(i * n, (i + 1) * n)
            self._rates[block, block] = config.r[channel] * difference.T @ difference + RIDGE * np.eye(n)
            self._a[block, block] = np.eye(n)
            self._a[3 * n + i * n : 3 * n + (i + 1) * n, block] = difference
            self._upper[3 * n + i * n : 3 * n + (i + 1) * n] = self._step_limit[channel]
            self._lower[3 * n + i * n : 3 * n + (i + 1) * n] = -self._step_limit[channel]
        self._p[-1, -1] = config.slack
        self._a[fixed:, -1] = 1.0
        self._solver = self._make_solver(rows)

    def _make_solver(self, rows: int) -> Solver:
        """Scaled so that the Hessian of a robot at rest has a unit diagonal: 16 iterations, 18-40 with the limits as scale."""
        n, size = self._n, 3 * self._n + 1
        p_mask = np.zeros((size, size), dtype=bool)
        p_mask[: 2 * n, : 2 * n] = True
        p_mask[2 * n : 3 * n, 2 * n : 3 * n] = True
        p_mask[-1, -1] = True
        a_mask = self._a != 0.0
        a_mask[6 * n :, : 2 * n] = True
        rest = (0.0,) * 11
        self._prediction.restart(rest)
        self._prediction.linearise(rest, np.zeros(3), np.zeros(4))
        self._objective(np.zeros((self._h + 1, 4)), np.array(self._config.q) + self._config.q_formation)
        scale = 1.0 / np.sqrt(np.diagonal(self._p))
        row_scale = np.concatenate([np.tile(1.0 / scale[:-1], 2), np.full(rows, 1.0 / scale[-1])])
        return make_solver(self._config.solver, p_mask, a_mask, scale, row_scale)

    def reset(self) -> None:
        """Forget the last plan."""
        self._fresh, self._shifted = True, MAX_SHIFTED

    def expected(self, state: State) -> Array:
        """Poses (horizon + 1, 4) that the coming plan is linearised along: the last plan moved on by one step, or `state`."""
        if self._fresh or self._config.linearise == "point":
            self._prediction.restart(state)
            self._fresh = False
        return self._prediction.nominal[:4].T

    def plan(
        self, state: State, disturbance: Array, wrench: Array, reference: Array, weight: Array, keep_clear: HalfSpaces
    ) -> MpcPlan:
        """One solve. `reference` (horizon + 1, 4), its yaw near the state's; `weight` W (4,); `wrench` (3,) asked for last."""
        self.expected(state)
        self._prediction.linearise(state, wrench, disturbance)
        self._objective(reference, weight)
        self._constraints(wrench, keep_clear)
        solution = self._solver.solve(self._p, self._q, self._a, self._lower, self._upper)
        n = self._n
        if not solution.solved:
            return self._fall_back(wrench, solution.iterations)
        x = solution.x
        self._prediction.follow(x[: 2 * n], x[2 * n : 3 * n])
        self._solution, self._base, self._shifted = x, wrench, 0
        eta = self._prediction.nominal[:4].T.copy()
        self._prediction.shift()
        return MpcPlan(self._step_of_plan(0, wrench), eta, Solve.SOLVED, solution.iterations, max(0.0, float(x[-1])))

    def _objective(self, reference: Array, weight: Array) -> None:
        """P and q as Gram matrices: unit responses, and the free response's error as one more row."""
        n, prediction, p = self._n, self._prediction, self._p
        root = np.sqrt(weight)
        position = prediction.position.view(np.float64) * np.tile(root[:2], self._h)
        position[-1] -= (reference[1:, :2] * root[:2]).ravel()
        yaw = prediction.yaw * root[3]
        yaw[-1] -= reference[1:, 3] * root[3]
        heave = prediction.heave * root[2]
        heave[-1] -= reference[1:, 2] * root[2]
        planar, depth = position @ position.T, heave @ heave.T
        planar[n:, n:] += yaw @ yaw.T
        p[: 3 * n, : 3 * n] = self._rates
        p[: 2 * n, : 2 * n] += planar[:-1, :-1]
        p[2 * n : 3 * n, 2 * n : 3 * n] += depth[:-1, :-1]
        self._q[: 2 * n], self._q[2 * n : 3 * n] = planar[:-1, -1], depth[:-1, -1]

    def _constraints(self, wrench: Array, keep_clear: HalfSpaces) -> None:
        n = self._n
        for i, channel in enumerate(CHANNELS):
            rows = slice(i * n, (i + 1) * n)
            self._upper[rows] = self._limit[channel] - wrench[channel]
            self._lower[rows] = -self._limit[channel] - wrench[channel]
        self._a[6 * n :, : 2 * n] = 0.0
        self._lower[6 * n :] = -NO_BOUND
        count = len(keep_clear.node)
        if count == 0:
            return
        responses = self._prediction.position[:, keep_clear.node - 1]
        along = responses.real * keep_clear.normal[:, 0] + responses.imag * keep_clear.normal[:, 1]
        self._a[6 * n : 6 * n + count, : 2 * n] = along[:-1].T
        self._lower[6 * n : 6 * n + count] = keep_clear.offset - along[-1]

    def _step_of_plan(self, step: int, before: Array) -> Array:
        """The last good plan's wrench (3,), exactly within the limits (the solver is right to 1e-4)."""
        asked = self._base + self._solution[self._unknowns[step]]
        stepped = np.minimum(np.maximum(asked, before - self._step_limit), before + self._step_limit)
        return np.asarray(np.minimum(np.maximum(stepped, -self._limit), self._limit))

    def _fall_back(self, wrench: Array, iterations: int) -> MpcPlan:
        """The last good plan, moved on by a step; nothing once it is used up."""
        eta = self._prediction.nominal[:4].T.copy()
        if self._shifted >= MAX_SHIFTED:
            self.reset()
            return MpcPlan(np.zeros(3), eta, Solve.FAILED, iterations, 0.0)
        self._shifted += 1
        self._prediction.shift()
        return MpcPlan(self._step_of_plan(self._shifted, wrench), eta, Solve.SHIFTED, iterations, 0.0)

"""One control step of the laws with which the nonlinear MPC is compared, from sensor values to pulse widths. Pure: time is an
argument, nothing blocks.

    controller = Controller(vehicle, config, safety)
    output = controller.step(measurement, goal, neighbours, now_ns)     # once per config.period_s

Data flow of `Controller.step`:

    measurement -> Estimator (eso.py)                state at the exposure, predicted to now and to when a command acts
    goal        -> ReferenceSampler (reference.py)   reference over the horizon
                -> GiveWay (velocity_obstacles.py)   the same reference, or one around robots and obstacles in the way
    neighbours  -> Formation (formation.py)          weighted reference (35), half-spaces (36)
                -> HeadingReference (heading.py)     heading in which surge thrust corrects lateral errors
                -> Law (law.py)                      wrench: the article's MPC (35 to 40), or another law
                -> Allocator (allocation.py)         pulse widths of 4 thrusters and 4 ankles

The estimator is told that `output.pulse_us` went out at `now_ns`. `goal = None` means neutral: the controller goes on
estimating, puts out neutral pulses and forgets its plan. All instants are on one clock, the robot's monotonic one (in lockstep
the simulator's).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from robot_agent.control.heading import HeadingReference
from robot_agent.control.law import Law, heading_gain, make_law
from robot_agent.control.mpc import Mpc, MpcPlan
from robot_agent.control.nonlinear.course import KEEP_TURN
from robot_agent.control.nonlinear.tuning import agility
from robot_agent.guidance.formation import NOWHERE, Formation, Neighbour, NeighbourPredictions, Priority
from robot_agent.guidance.obstacles import Obstacle
from robot_agent.guidance.reference import Drive, Follow, Goal, Hold, Reference, ReferenceSampler, interpolate, is_other_goal
from robot_agent.guidance.velocity_obstacles import GiveWay
from robot_agent.vehicle.dynamics import Model
from robot_agent.vehicle.estimate import Observation, StateMeasurement
from robot_agent.vehicle.fixed_thrusters import make_allocator
from robot_agent.vehicle.kalman import make_estimator
from shoal.config.controller import ControllerConfig, Safety
from shoal.config.vehicle import Vehicle
from shoal.frames import TURN, Array
from shoal.messages.messages import Control, Estimate, Solve, is_finite

NS = 1_000_000_000


class ControlOutput(NamedTuple):
    """Results of one control step. Its arrays belong to the caller: they are never written again."""

    pulse_us: tuple[int, ...]  # 4 thrusters, 4 ankles; neutral unless the step was solved
    observation: Observation | None  # None until the first pose, and after coasting too long
    control: Control | None  # None while the thrusters are at neutral because there is no goal
    plan_eta: Array  # (horizon + 1, 4) predicted poses at now + s * period_s; node 0 is the estimate
    plan_reference: Array  # (horizon + 1, 4) the path that is meant to be flown, at the same instants, with the heading asked
    tracking_error_m: float = 0.0  # distance from the goal's position
    is_free: bool = False  # the robot follows its path: neither giving way nor half-spaces change its plan
    path_is_blocked: bool = False  # it avoids what it would meet on its path too
    flow_moment_nm: float = 0.0  # yaw moment of the water past the hull, (m_u - m_v) u v
    avoids: bool = False  # something is in its way; False on the way back to its path

    @property
    def estimate(self) -> Estimate | None:
        """The part of the observation that leaves the robot."""
        return None if self.observation is None else self.observation.estimate

    @property
    def solve(self) -> Solve:
        """Result of the optimisation."""
        return Solve.NONE if self.control is None else self.control.solve

    @property
    def is_finite(self) -> bool:
        """True if all numbers that go to the wire are finite."""
        numbers = self.tracking_error_m + self.flow_moment_nm + float(self.plan_eta.sum() + self.plan_reference.sum())
        return math.isfinite(numbers) and all(map(is_finite, (self.estimate, self.control)))


class Controller:
    """One robot's controller with its memory and workspaces."""

    foresees = False  # its plan is not the very motion that the robot flies

    def __init__(
        self,
        vehicle: Vehicle,
        config: ControllerConfig,
        safety: Safety,
        urgent: bool = False,
        has_leader: bool = False,
        room_m: tuple[float, float] | None = None,
        islands: tuple[Obstacle, ...] = (),
    ) -> None:
        """`has_leader`: the one neighbour in the formation is the robot's leader. `room_m`: length and width of the pool; None
        without walls."""
        period_s, dead_s = config.period_s, vehicle.thruster.dead_time_s
        self._config, self._urgent, self._weight = config, urgent, np.array(config.mpc.q)
        self._is_article = config.law == "eso-mpc-article"
        self._model = model = Model(vehicle, config.estimator.sway, not self._is_article)
        self._estimator = make_estimator(vehicle, model, config.estimator)
        steps_s = period_s * np.arange(config.mpc.horizon + 1, dtype=np.float64)
        nodes_s = dead_s + steps_s
        self.sampler = ReferenceSampler(nodes_s)
        self._has_leader = has_leader
        self.formation = Formation(safety, nodes_s, self._formation_weight(config), has_leader)
        times_s = np.concatenate([[0.0], nodes_s])
        self._give_way = GiveWay(vehicle, times_s, period_s, agility(vehicle), room_m, islands, urgent)
        self._law: Law = make_law(vehicle, model, config, period_s, self.formation.rows)
        self._heading = HeadingReference(model, period_s, heading_gain(config))
        self.allocator = make_allocator(vehicle)
        # Plans begin at the instant of action and are told from now on: rows of the one for the other
        self._told_rows = np.interp(steps_s, times_s, np.arange(len(times_s), dtype=np.float64))
        self._wrench = np.zeros(3)  # asked for in the last step,
        self._delivered = np.zeros(3)  # and what its pulses gave
        self._priority = Priority(urgent, 0.0)
        self.goal: Goal | None = None  # of the last step
        self._turns: int | None = None  # of the heading against the path's; None: not known yet

    def _formation_weight(self, config: ControllerConfig) -> tuple[float, float, float, float]:
        return (1.0, 1.0, 1.0, 1.0) if self._has_leader else config.mpc.q_formation

    @property
    def told_period_s(self) -> float:
        """Time between two poses of the plan that neighbours get."""
        return self._config.period_s

    def adopt_gains(self, config: ControllerConfig) -> None:
        """Use other gains (shoal/messages/live_gains.py) from the next step on. Estimate, heading and plan are kept."""
        self._config, self._weight = config, np.array(config.mpc.q)
        self._estimator.tune(config.estimator)
        self._heading.tune(heading_gain(config))
        self.formation.set_weight(self._formation_weight(config))
        if isinstance(self._law, Mpc):
            self._law.tune(config.mpc)

    def step(
        self,
        measurement: StateMeasurement,
        goal: Goal | None,
        neighbours: Sequence[Neighbour],
        now_ns: int,
        obstacles: Sequence[Obstacle] = (),
    ) -> ControlOutput:
        """Run one control step at `now_ns`; its pulses are assumed to go out at once. See the module's docstring."""
        estimate = self._estimator.update(measurement, now_ns)
        if estimate is None or goal is None:
            return self._neutral(estimate, now_ns)
        self._take_up(goal)
        reference = self.sampler.sample(goal)
        predictions = self.formation.predict_neighbours(neighbours, now_ns)
        lead = reference
        if isinstance(goal, Follow):
            keep_m = self.formation.clearances_m(predictions, now_ns)
            lead = self._give_way.way_around(reference, estimate.eta, predictions, keep_m, obstacles, now_ns)
        weight, command = self._command(goal, lead, lead is not reference, predictions, estimate)
        keep_clear = NOWHERE
        if isinstance(self._law, Mpc):
            keep_clear = self.formation.half_spaces(predictions, estimate.action[:4], self._priority, now_ns)
        plan = self._law.plan(
            estimate.action, estimate.disturbance, self._wrench, command[1:], weight, keep_clear, estimate.current,
            self._delivered,
        )  # fmt: skip
        is_free = lead is reference and not keep_clear.binds(plan.eta)
        return self._put_out(plan, estimate, reference, lead, command, is_free, now_ns)

    def note_command(self, wrench: Array, delivered: Array, now_ns: int) -> None:
        """Take note of the wrench asked for and delivered, (3,) each, that really went out at `now_ns` instead of the last
        step's."""
        self._estimator.note_wrench(delivered, now_ns)
        self._wrench, self._delivered = wrench, delivered

    def _take_up(self, goal: Goal) -> None:
        """Clear the heading memory at a goal of another kind."""
        before, self.goal = self.goal, goal
        if is_other_goal(before, goal):
            self._heading.reset()
            self._give_way.reset()
            self._turns = None

    def _command(
        self, goal: Goal, lead: Reference, is_led: bool, predictions: NeighbourPredictions, estimate: Observation
    ) -> tuple[Array, Array]:
        """Return the weight W (4,) and the reference with formation terms (35) and heading, (horizon + 2, 4): now and all
        nodes."""
        command, weight, is_resting = lead.eta.copy(), self._weight, isinstance(goal, Hold)
        if isinstance(goal, Drive):  # a person steers
            return weight, self._unwound(command, estimate)
        pull = None if is_resting else self.formation.pull(predictions, weight)
        if pull is not None:
            moved, weight = pull
            command += np.concatenate([moved[:1], moved])
        if is_resting or is_led or not self._is_article:
            command[:, 3] += self._heading.turn(lead, estimate, is_resting)
        else:
            self._heading.reset()
        return weight, self._unwound(command, estimate)

    def _unwound(self, command: Array, estimate: Observation) -> Array:
        """The command (rows, 4) with as many whole turns as the estimate has."""
        away = (estimate.eta.item(3) - command.item(3)) / TURN
        if self._turns is None or abs(away - self._turns) > KEEP_TURN:
            self._turns = round(away)
        if self._turns:
            command[:, 3] += TURN * self._turns
        return command

    def _put_out(
        self,
        plan: MpcPlan,
        estimate: Observation,
        reference: Reference,
        lead: Reference,
        command: Array,
        is_free: bool,
        now_ns: int,
    ) -> ControlOutput:
        """Convert a plan to pulses and output."""
        failed = plan.solve is Solve.FAILED
        pulses, delivered = self.allocator.neutral() if failed else self.allocator.allocate(plan.wrench)
        wrench_step, self._wrench, self._delivered = plan.wrench - self._wrench, plan.wrench, delivered
        self._estimator.note_wrench(delivered, now_ns)
        goal, rows, path = reference.eta[0].copy(), np.empty(command.shape), lead.eta.copy()
        rows[0], rows[1:], path[:, 3] = estimate.eta, plan.eta, command[:, 3]
        told_eta = interpolate(rows, self._told_rows)
        # Without the formation's pull: neighbours who shared a deviation would else see less of it, the less the more they are
        told_reference = interpolate(path, self._told_rows)
        error_m = math.dist(goal[:3].tolist(), estimate.eta[:3].tolist())
        self._priority = Priority(self._urgent, error_m)
        return ControlOutput(
            pulse_us=pulses,
            observation=estimate,
            control=Control(
                eta_reference=goal,
                eta_command=command[0].copy(),
                wrench=plan.wrench,
                wrench_step=wrench_step,
                wrench_wanted=plan.wrench if plan.wanted is None else plan.wanted,
                wrench_delivered=delivered,
                solve=plan.solve,
                iterations=plan.iterations,
                slack_m=plan.slack_m,
            ),
            plan_eta=told_eta,
            plan_reference=told_reference,
            tracking_error_m=error_m,
            is_free=is_free,
            path_is_blocked=self._give_way.path_is_blocked,
            avoids=not is_free,
        )

    def _neutral(self, estimate: Observation | None, now_ns: int) -> ControlOutput:
        """Output with thrusters off. The plan is forgotten; neighbours are told that the robot stays in place."""
        self._law.reset()
        self._heading.reset()
        self._give_way.reset()
        self.goal = None
        self._wrench, self._delivered = np.zeros(3), np.zeros(3)
        self._estimator.note_wrench(np.zeros(3), now_ns)
        self._priority = Priority(self._urgent, 0.0)
        eta = np.zeros(4) if estimate is None else estimate.eta
        stay = np.tile(eta, (self._config.mpc.horizon + 1, 1))
        return ControlOutput(self.allocator.neutral_us, estimate, None, stay, stay)

"""One control step of the laws with which the nonlinear MPC is compared, from sensor values to pulse widths. Pure.

Data flow of `LawController.step`; its interface is that of `Controller` (controller.py):

    measurement -> Estimator (eso.py)                state at the exposure, predicted to now and to when a command acts
    goal        -> ReferenceSampler (reference.py)   reference over the horizon
                -> GiveWay (velocity_obstacles.py)   the same reference, or one around robots and obstacles in the way
    neighbours  -> Formation (formation.py)          weighted reference (35), half-spaces (36)
                -> HeadingReference (heading.py)     heading in which surge thrust corrects lateral errors
                -> Law (law.py)                      wrench: the article's MPC (35 to 40), or another law
                -> Allocator (allocation.py)         pulse widths of 4 thrusters and 4 ankles
"""

import math
from collections.abc import Sequence

import numpy as np

from robot_agent.control.controller import Controller, ControlOutput, Setting
from robot_agent.control.heading import HeadingReference
from robot_agent.control.law import Law, heading_gain, make_law
from robot_agent.control.mpc import Mpc, MpcPlan
from robot_agent.control.nonlinear.course import KEEP_TURN
from robot_agent.guidance.formation import NOWHERE, Formation, NeighbourPredictions, Priority
from robot_agent.guidance.obstacles import Obstacle
from robot_agent.guidance.reference import Drive, Goal, Hold, Reference, interpolate, is_other_goal
from robot_agent.vehicle.estimate import Observation, StateMeasurement
from shoal.config.controller import ControllerConfig
from shoal.frames import TURN, Array
from shoal.messages.messages import Control, Solve


class LawController(Controller):
    """One robot's controller with a law that follows its reference: the article's MPC, or a feedback law."""

    foresees = False

    def __init__(self, setting: Setting) -> None:
        vehicle, config = setting.vehicle, setting.config
        steps_s = config.period_s * np.arange(config.mpc.horizon + 1, dtype=np.float64)
        nodes_s = vehicle.thruster.dead_time_s + steps_s
        super().__init__(setting, nodes_s, steps_s)
        self._weight, self._is_article = np.array(config.mpc.q), config.law == "eso-mpc-article"
        self.formation = Formation(setting.safety, nodes_s, self._formation_weight(config), setting.has_leader)
        self._law: Law = make_law(vehicle, self._model, config, config.period_s, self.formation.rows)
        self._heading = HeadingReference(self._model, config.period_s, heading_gain(config))
        self._wrench = self._delivered = self._still = np.zeros(3)  # these laws know no sway
        self._turns: int | None = None  # of the heading against the path's; None: not known yet

    def _formation_weight(self, config: ControllerConfig) -> tuple[float, float, float, float]:
        return (1.0, 1.0, 1.0, 1.0) if self._has_leader else config.mpc.q_formation

    @property
    def plan_period_s(self) -> float:
        return self._config.period_s

    def adopt_gains(self, config: ControllerConfig) -> None:
        self._config, self._weight = config, np.array(config.mpc.q)
        self._estimator.tune(config.estimator)
        self._heading.tune(heading_gain(config))
        self.formation.set_weight(self._formation_weight(config))
        if isinstance(self._law, Mpc):
            self._law.tune(config.mpc)

    def _steer(
        self,
        goal: Goal,
        measurement: StateMeasurement,
        estimate: Observation,
        predictions: NeighbourPredictions,
        obstacles: Sequence[Obstacle],
        now_ns: int,
    ) -> ControlOutput:
        self._reset_on_new_goal(goal)
        reference = self.sampler.sample(goal)
        clear_reference = self._clear_reference(goal, reference, estimate, predictions, obstacles, now_ns)
        weight, command = self._command(goal, clear_reference, clear_reference is not reference, predictions, estimate)
        keep_clear = NOWHERE
        if isinstance(self._law, Mpc):
            keep_clear = self.formation.half_spaces(predictions, estimate.action[:4], self._priority, now_ns)
        plan = self._law.plan(
            estimate.action, estimate.disturbance, self._wrench, command[1:], weight, keep_clear, estimate.current,
            self._delivered,
        )  # fmt: skip
        is_free = clear_reference is reference and not keep_clear.binds(plan.eta)
        return self._output(plan, estimate, reference, clear_reference, command, is_free, now_ns)

    def _reset_on_new_goal(self, goal: Goal) -> None:
        """Clear heading and avoidance memory at a goal of another kind."""
        before, self.goal = self.goal, goal
        if is_other_goal(before, goal):
            self._heading.reset()
            self._give_way.reset()
            self._turns = None

    def _command(
        self,
        goal: Goal,
        clear_reference: Reference,
        is_avoiding: bool,
        predictions: NeighbourPredictions,
        estimate: Observation,
    ) -> tuple[Array, Array]:
        """Weight W (4,) and commanded poses (horizon + 2, 4), now and at all nodes: the reference with the formation's terms
        (35) and the heading in which surge corrects lateral errors."""
        command, weight, is_resting = clear_reference.eta.copy(), self._weight, isinstance(goal, Hold)
        if isinstance(goal, Drive):  # a person steers
            return weight, self._unwound(command, estimate)
        pull = None if is_resting else self.formation.pull(predictions, weight)
        if pull is not None:
            moved, weight = pull
            command += np.concatenate([moved[:1], moved])
        if is_resting or is_avoiding or not self._is_article:
            command[:, 3] += self._heading.turn(clear_reference, estimate, is_resting)
        else:
            self._heading.reset()
        return weight, self._unwound(command, estimate)

    def _unwound(self, command: Array, estimate: Observation) -> Array:
        """The command (rows, 4) with as many whole turns of yaw as the estimate has."""
        apart_turns = (estimate.eta.item(3) - command.item(3)) / TURN
        if self._turns is None or abs(apart_turns - self._turns) > KEEP_TURN:
            self._turns = round(apart_turns)
        if self._turns:
            command[:, 3] += TURN * self._turns
        return command

    def _output(
        self,
        plan: MpcPlan,
        estimate: Observation,
        reference: Reference,
        clear_reference: Reference,
        command: Array,
        is_free: bool,
        now_ns: int,
    ) -> ControlOutput:
        """Convert a plan's wrench to pulses, remember it, and collect the step's output."""
        failed = plan.solve is Solve.FAILED
        pulses, delivered = self.allocator.neutral() if failed else self.allocator.allocate(plan.wrench)
        wrench_step = plan.wrench - self._wrench
        self.note_command(plan.wrench, delivered, now_ns)
        goal, rows, path = reference.eta[0].copy(), np.empty(command.shape), clear_reference.eta.copy()
        rows[0], rows[1:], path[:, 3] = estimate.eta, plan.eta, command[:, 3]
        plan_eta = interpolate(rows, self._reported_rows)
        # Without the formation's pull: neighbours who shared a deviation would else see less of it, the less the more they are
        plan_reference = interpolate(path, self._reported_rows)
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
            plan_eta=plan_eta,
            plan_reference=plan_reference,
            tracking_error_m=error_m,
            is_free=is_free,
            path_is_blocked=self._give_way.path_is_blocked,
            avoids=not is_free,
        )

    def _forget_plan(self) -> None:
        self._law.reset()
        self._heading.reset()

    def _drift_poses(self, estimate: Observation) -> Array:
        return np.tile(estimate.eta, (len(self._reported_rows), 1))

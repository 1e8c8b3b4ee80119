"""One robot's controller: what every law needs around its plans. Pure: time is an argument, nothing blocks.

    controller = NonlinearController(Setting(vehicle, config, safety))
    output = controller.step(measurement, goal, neighbours, now_ns)     # once per config.period_s

The estimator learns that `output.pulse_us` went out at `now_ns`. `goal = None` means neutral: the controller goes on
estimating, puts out neutral pulses and forgets its plan. All instants are on one clock, the robot's monotonic one (in lockstep
the simulator's).
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from robot_agent.control.nonlinear.tuning import agility
from robot_agent.guidance.formation import Formation, Neighbour, NeighbourPredictions, Priority
from robot_agent.guidance.obstacles import Obstacle
from robot_agent.guidance.reference import Follow, Goal, Reference, ReferenceSampler
from robot_agent.guidance.velocity_obstacles import GiveWay
from robot_agent.vehicle.dynamics import NO_FLOW, FlowMoment, Model
from robot_agent.vehicle.estimate import Observation, StateMeasurement
from robot_agent.vehicle.fixed_thrusters import make_allocator
from robot_agent.vehicle.kalman import make_estimator
from shoal.config.controller import ControllerConfig, Safety
from shoal.config.vehicle import Vehicle
from shoal.frames import Array
from shoal.messages.messages import Control, Estimate, Solve, is_finite


class Setting(NamedTuple):
    """Constants of one robot's controller: its vehicle, gains and limits, its part in the formation, and the pool."""

    vehicle: Vehicle
    config: ControllerConfig
    safety: Safety
    urgent: bool = False  # others give way to it
    has_leader: bool = False  # the one neighbour in the formation is the robot's leader
    room_m: tuple[float, float] | None = None  # length and width of the pool; None without walls
    islands: tuple[Obstacle, ...] = ()


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
    flow_moment: FlowMoment = NO_FLOW
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
        numbers = self.tracking_error_m + sum(self.flow_moment) + float(self.plan_eta.sum() + self.plan_reference.sum())
        return math.isfinite(numbers) and all(map(is_finite, (self.estimate, self.control)))


class Controller(ABC):
    """One robot's controller with its memory and workspaces."""

    foresees: bool  # its plan is the very motion that the robot flies
    formation: Formation

    def __init__(self, setting: Setting, nodes_s: Array, reported_s: Array) -> None:
        """Make a controller whose plan has nodes `nodes_s` after now, the first when a command acts. Neighbours get its poses
        `reported_s` after now."""
        vehicle, config, urgent = setting.vehicle, setting.config, setting.urgent
        self._vehicle, self._config, self._urgent, self._period_s = vehicle, config, urgent, config.period_s
        self._has_leader = setting.has_leader
        self._model = Model(vehicle, config.estimator.sway, config.law != "eso-mpc-article")  # the article's has no lag
        self._estimator = make_estimator(vehicle, self._model, config.estimator)
        self.sampler = ReferenceSampler(nodes_s)
        times_s = np.concatenate([[0.0], nodes_s])
        self._give_way = GiveWay(vehicle, times_s, config.period_s, agility(vehicle), setting.room_m, setting.islands, urgent)
        self.allocator = make_allocator(vehicle)
        self._reported_rows = np.interp(reported_s, times_s, np.arange(len(times_s), dtype=np.float64))
        self._still = np.zeros(len(vehicle.limits.wrench))
        self._wrench, self._delivered = self._still, self._still  # asked for in the last step, and what its pulses gave
        self._priority = Priority(urgent, 0.0)
        self.goal: Goal | None = None  # of the last step

    @property
    @abstractmethod
    def plan_period_s(self) -> float:
        """Time between two poses of the plan that neighbours get."""

    @abstractmethod
    def adopt_gains(self, config: ControllerConfig) -> None:
        """Use other gains (shoal/messages/live_gains.py) from the next step on. Estimate and plan are kept."""

    def step(
        self,
        measurement: StateMeasurement,
        goal: Goal | None,
        neighbours: Sequence[Neighbour],
        now_ns: int,
        obstacles: Sequence[Obstacle] = (),
    ) -> ControlOutput:
        """Run one control step at `now_ns`; its pulses are assumed to go out at once."""
        estimate = self._estimator.update(measurement, now_ns)
        if estimate is None or goal is None:
            return self._neutral(estimate, now_ns)
        predictions = self.formation.predict_neighbours(neighbours, now_ns)
        return self._steer(goal, measurement, estimate, predictions, obstacles, now_ns)

    def note_command(self, wrench: Array, delivered: Array, now_ns: int) -> None:
        """Correct the last step's wrenches: the one asked for and the `delivered` one whose pulses really went out at
        `now_ns`."""
        self._wrench, self._delivered = wrench, delivered
        self._estimator.note_wrench(delivered, now_ns)

    @abstractmethod
    def _steer(
        self,
        goal: Goal,
        measurement: StateMeasurement,
        estimate: Observation,
        predictions: NeighbourPredictions,
        obstacles: Sequence[Obstacle],
        now_ns: int,
    ) -> ControlOutput:
        """Plan towards the goal, and convert the plan's first wrench to pulses."""

    def _clear_reference(
        self,
        goal: Goal,
        reference: Reference,
        estimate: Observation,
        predictions: NeighbourPredictions,
        obstacles: Sequence[Obstacle],
        now_ns: int,
    ) -> Reference:
        """A reference clear of robots and obstacles, for a robot that follows its path; `reference` itself if nothing is in
        the way, or for another goal."""
        if not isinstance(goal, Follow):
            return reference
        keep_m = self.formation.clearances_m(predictions, now_ns)
        return self._give_way.way_around(reference, estimate.eta, predictions, keep_m, obstacles, now_ns)

    def _neutral(self, estimate: Observation | None, now_ns: int) -> ControlOutput:
        """The output at neutral. The plan is forgotten; neighbours get the poses of a robot that drifts."""
        self._give_way.reset()
        self.goal = None
        self._forget_plan()
        self.note_command(self._still, self._still, now_ns)
        self._priority = Priority(self._urgent, 0.0)
        poses = np.zeros((len(self._reported_rows), 4)) if estimate is None else self._drift_poses(estimate)
        return ControlOutput(self.allocator.neutral_us, estimate, None, poses, poses)

    @abstractmethod
    def _forget_plan(self) -> None:
        """Forget the plan, as the thrusters are at neutral."""

    @abstractmethod
    def _drift_poses(self, estimate: Observation) -> Array:
        """Poses (rows, 4) of a robot without thrust, at the instants that neighbours get."""

"""READ FIRST (control): one control step of the nonlinear MPC, from sensor values to pulse widths. Pure.

Data flow of `NonlinearController.step`; its interface is that of `Controller` (controller.py):

    measurement -> KalmanEstimator (kalman.py)        state at the instant at which a command acts, current, own force
    goal        -> ReferenceSampler (reference.py)    reference at the nodes; on HOLD the place where the robot can stop
                -> GiveWay (velocity_obstacles.py)    the same reference, or one around robots and obstacles in the way
    neighbours  -> Formation (formation.py)           formation's pull (35), bodies to keep clear of (36)
                -> set_course (course.py)             places, velocities, headings at the nodes
    estimate    -> derive (tuning.py)                 weights
                -> Planner (planner.py)               one iteration on the plan: surge, sway, yaw; and on that of depth
                -> Allocator (allocation.py)          pulse widths
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from robot_agent.control.controller import Controller, ControlOutput, Setting
from robot_agent.control.mpc import bridged_steps
from robot_agent.control.nonlinear import tuning as tunings
from robot_agent.control.nonlinear.course import HeadingRule, Turns, make_course, pulled, set_course, set_depth_course
from robot_agent.control.nonlinear.obstacle_rows import (
    NO_BODIES,
    MovingBodies,
    Outlines,
    Surrounds,
    bodies_of,
    outlines_of,
)
from robot_agent.control.nonlinear.planner import Planner, make_depth_start, make_start, resting_place
from robot_agent.control.nonlinear.prediction import Dynamics, Start, Surroundings, fly, make_flight, make_grid
from robot_agent.control.nonlinear.program import Iteration, PlanProblem, Weights, make_memory, step_plan
from robot_agent.control.nonlinear.upright_thrust import UprightThrust
from robot_agent.guidance.formation import Formation, Neighbour, NeighbourPredictions, Priority
from robot_agent.guidance.obstacles import Obstacle, is_inside
from robot_agent.guidance.reference import Drive, Follow, Goal, Hold, Reference, interpolate, is_other_goal
from robot_agent.vehicle.dynamics import flow_moment, loop_delay_s
from robot_agent.vehicle.estimate import Observation, StateMeasurement
from shoal.config.controller import ControllerConfig
from shoal.frames import Array
from shoal.messages.messages import Control, Solve

REPORT_S = 0.2  # between two poses of the plan that neighbours get, whatever the control period
GAINS_S = 1.0  # time constant of the weights,
NOISE_S = 4.0  # and of the noise that they heed: what is not known yet at a start is no noise, and ends within a second
GOES_FIRST_S = 2.5  # a robot that goes first still keeps clear of the others for so long: they may be unable to give way
WALL_M = 0.02  # between a hull and a wall, in the plan
REST_M = 0.05  # and at a place to rest, beyond the distance to keep: a place that is moved once stays
RESTS_M = 0.01  # between the last two nodes, 0.8 to 1.8 s: a plan that ends so slowly ends at rest
TOLERANCE_M = 0.02  # mean error of a plan with which no other is looked for
CALM = 8.0  # standard deviations: nearer to its place, a resting robot looks for no other plan
STEEPEST_RAD = 0.5  # a hull that rights itself is not pitched farther by its thrusters: a board that says so is wrong
DRIVES_ON_S = 2.0  # a person goes on steering: a plan that stops with the order's age swings and follows late


class NonlinearController(Controller):
    """One robot's controller with the nonlinear MPC."""

    foresees = True

    def __init__(self, setting: Setting) -> None:
        vehicle, config, safety = setting.vehicle, setting.config, setting.safety
        self._dead_s, horizon_s = vehicle.thruster.dead_time_s, tunings.horizon_s(vehicle)
        self._axes = tunings.planar_axes(vehicle)
        self._grid, self._depth_grid = make_grid(horizon_s, self._axes), make_grid(horizon_s, (0,))
        nodes_s = self._dead_s + self._grid.time_s  # the instant of action, then the nodes
        rows = int((horizon_s + self._dead_s) / REPORT_S) + 1
        super().__init__(setting, nodes_s, REPORT_S * np.arange(rows, dtype=np.float64))
        self._safety, self._islands = safety, setting.islands
        self._delay_s = loop_delay_s(vehicle, config.period_s, self._model.lag_s)
        self._step_s = tunings.step_s(vehicle)
        # A leader's error is taken whole, others' in part: those may have been put into the water far from their paths.
        most_m = safety.join_within_m + (0.0 if setting.has_leader else vehicle.limits.speed_mps * horizon_s)
        self.formation = Formation(safety, nodes_s[1:], config.mpc.q_formation, setting.has_leader, most_m)
        self._fastest_mps = tunings.fastest_mps(vehicle)
        self._planner = Planner(self._grid, config.period_s, 2.0 * safety.radius_m, self._fastest_mps)
        self._depth, self._drift_flight = make_memory(1), make_flight(len(self._axes))
        self._course, self._depth_course, self._turns = make_course(), make_course(), Turns()
        self._depth_limits = tunings.depth_limits(vehicle)
        hull_m = vehicle.radius_m + WALL_M
        self._room_m = np.array([math.inf, math.inf]) if setting.room_m is None else 0.5 * np.array(setting.room_m) - hull_m
        self._open_water = Surrounds(NO_BODIES, outlines_of((), 0, 0j), np.array([math.inf, math.inf]))
        self._heave = np.eye(len(self._still))[1]  # 1 N
        self._tuning: tunings.Bandwidths | None = None
        self._place: Array | None = None  # to rest at
        self._shifted = 0  # steps since the last solution
        self._off_m, self._noise_mps = 0.0, 0.0
        self._upright = UprightThrust(vehicle)
        self._lift_n = 0.0  # thrust's part upwards of a hull that it pitches: 1 N at full thrust

    @property
    def plan_period_s(self) -> float:
        return REPORT_S

    def adopt_gains(self, config: ControllerConfig) -> None:
        self._config = config
        self._estimator.tune(config.estimator)
        self.formation.set_weight(config.mpc.q_formation)

    def note_command(self, wrench: Array, delivered: Array, now_ns: int) -> None:
        """As for every law. What lifts a pitched hull takes part of its heave: observer and plan know the rest."""
        self._wrench, self._delivered = wrench, delivered
        self._estimator.note_wrench(delivered - self._lift_n * self._heave, now_ns)

    # --- one step

    def _steer(
        self,
        goal: Goal,
        measurement: StateMeasurement,
        estimate: Observation,
        predictions: NeighbourPredictions,
        obstacles: Sequence[Obstacle],
        now_ns: int,
    ) -> ControlOutput:
        if self._model.sway:  # the article's model knows no tilt
            self._lift_n = self._lift(measurement, estimate)
            self._upright.step(measurement, self._period_s)
        dynamics, start = self._dynamics(estimate), make_start(estimate.action, self._wrench, self._axes)
        self._reset_on_new_goal(goal, estimate)
        self._retune(estimate)
        pull = self.formation.pull(predictions, np.ones(4))
        surrounds = self._surrounds(predictions, obstacles, estimate, now_ns)
        if isinstance(goal, Hold):
            place = self._stop(goal, dynamics, start, surrounds) if self._place is None else self._place
            self._place = clear_place(place, surrounds, REST_M)
        if isinstance(goal, Drive):
            goal = replace(goal, lasts_s=max(goal.lasts_s, DRIVES_ON_S))
        reference = self.sampler.sample(goal if self._place is None else Hold(self._place))
        clear_reference = self._clear_reference(goal, reference, estimate, predictions, obstacles, now_ns)
        pulled_reference = clear_reference
        if pull is not None and isinstance(goal, Follow):
            moved, _ = pull
            pulled_reference = pulled(clear_reference, np.concatenate([np.repeat(moved[:1], 2, axis=0), moved])[:, :3])
        iteration = self._improve(goal, pulled_reference, dynamics, start, surrounds)
        dive = self._dive(estimate, pulled_reference)
        self._off_m = math.hypot(*(reference.eta[0, :2] - estimate.eta[:2]).tolist())
        return self._output(estimate, reference, clear_reference, iteration, dive, now_ns)

    def _lift(self, measurement: StateMeasurement, estimate: Observation) -> float:
        """Force upwards of the thrust of a tilted hull, N: ahead on a bow that points up, sideways on a side that does."""
        tilts_rad = (measurement.pitch_rad, measurement.roll_rad)
        pitch, roll = (min(max(rad, -STEEPEST_RAD), STEEPEST_RAD) if math.isfinite(rad) else 0.0 for rad in tilts_rad)
        return float(estimate.action.item(8) * math.sin(pitch) - estimate.action.item(11) * math.sin(roll))

    def _reset_on_new_goal(self, goal: Goal, estimate: Observation) -> None:
        """Forget the place to rest at a goal of another kind, and the plan at the first goal or when the estimate has
        leapt."""
        before, self.goal = self.goal, goal
        if is_other_goal(before, goal):
            self._place = None
            self._give_way.reset()
        if before is None or estimate.leap:
            self._planner.forget()
            self._turns.reset()

    def _dynamics(self, estimate: Observation) -> Dynamics:
        """The model with what the observer knows by now."""
        current, own = estimate.current, estimate.own_force.tolist()
        hull = tunings.planar_hull(self._model.coefficients, self._model.sway, self._model.lag_s, self._step_s)
        return Dynamics(hull, Surroundings(current.real, current.imag, *own))

    def _retune(self, estimate: Observation) -> None:
        """Filter the bandwidths towards those that the estimate's noise and the robot's error allow."""
        assert estimate.deviations is not None  # the configuration allows no observer without
        depth_radps = self._config.estimator.bandwidth_radps
        observer_radps = estimate.bandwidth_radps or tunings.MODEL_SHARE * depth_radps
        self._noise_mps += -math.expm1(-self._period_s / NOISE_S) * (estimate.deviations.ground_mps - self._noise_mps)
        deviations = estimate.deviations._replace(ground_mps=self._noise_mps)
        wanted = tunings.derive(self._vehicle, self._delay_s, deviations, (observer_radps, depth_radps), self._off_m)
        if self._tuning is None:
            self._tuning = wanted
        share = -math.expm1(-self._period_s / GAINS_S)
        self._tuning = tunings.Bandwidths(*(a + share * (b - a) for a, b in zip(self._tuning, wanted, strict=True)))
        self._calm_m = CALM * deviations.place_m

    def _surrounds(
        self, predictions: NeighbourPredictions, obstacles: Sequence[Obstacle], estimate: Observation, now_ns: int
    ) -> Surrounds:
        """Neighbours, obstacles and walls that the plan keeps clear of."""
        here, bodies = complex(*estimate.action[:2].tolist()), NO_BODIES
        if predictions.neighbours:
            keep, until = zip(*(self._distance(other, now_ns) for other in predictions.neighbours), strict=True)
            bodies = bodies_of(predictions.pose, np.array(keep), np.array(until), self._depth.flight.state[:, 0], here)
        near = (*self._islands, *obstacles)
        outlines = outlines_of(near, now_ns + round(self._dead_s * 1e9), here) if near else self._open_water.outlines
        return Surrounds(bodies, outlines, self._room_m)

    def _distance(self, other: Neighbour, now_ns: int) -> tuple[float, int]:
        """Distance to keep from a neighbour, and for how many nodes."""
        keep_m, nodes = self.formation.clearance_m(other, now_ns) + self._safety.margin_m, len(self._grid.share_s)
        if self.formation.required_clearance_m(other, self._priority, now_ns) is None:
            nodes = int(np.searchsorted(self._grid.time_s[1:], GOES_FIRST_S))
        return keep_m, nodes

    def _stop(self, goal: Hold, dynamics: Dynamics, start: Start, surrounds: Surrounds) -> Array:
        """The pose (4,) where the robot can come to rest."""
        assert self._tuning is not None
        problem = PlanProblem(start, self._course, self._weights(tunings.Manner(0.0, 0.0)), self._upright.limits, surrounds)
        place, _ = resting_place(dynamics, self._grid, problem, self._tuning, self._fastest_mps, self._drift_flight)
        return np.array([place.real, place.imag, *goal.eta[2:]])

    def _weights(self, manner: tunings.Manner) -> Weights:
        assert self._tuning is not None
        return tunings.planar_weights(self._vehicle, self._tuning, self._config.nmpc.arm_m, manner, self._config.mpc.slack)

    def _improve(
        self, goal: Goal, pulled_reference: Reference, dynamics: Dynamics, start: Start, surrounds: Surrounds
    ) -> Iteration:
        """One step of the planner towards a goal: headings of the reference, weights for the goal, one program solved."""
        assert self._tuning is not None
        gains = self._config.nmpc
        is_resting, is_steered, has_sway = isinstance(goal, Hold), isinstance(goal, Drive), tunings.SWAY in self._axes
        keeps_heading = is_steered or has_sway  # the reference's: no bow has to point where it goes

        near_rad = self._turns.near_rad(start.state.item(2))
        heading_m = gains.arm_m if keeps_heading else gains.heading_m
        rule = HeadingRule(near_rad, heading_m**2, keeps_heading, is_resting)
        set_course(pulled_reference.eta, pulled_reference.velocity, dynamics.water, rule, self._course)
        self._turns.note(self._course, near_rad)

        turning_m = gains.hold_turning_m if is_resting else gains.turning_m
        facing_s = 0.0 if is_resting or keeps_heading else tunings.FACING_S
        asks_no_line = is_steered and not has_sway
        weights = self._weights(tunings.Manner(turning_m, facing_s, asks_no_line))
        problem = PlanProblem(start, self._course, weights, self._upright.limits, surrounds)
        is_calm = is_resting and self._off_m < self._calm_m
        return self._planner.step(dynamics, problem, self._tuning, math.inf if is_calm else TOLERANCE_M)

    def _dive(self, estimate: Observation, pulled_reference: Reference) -> Iteration:
        """Improve the plan of depth by one step. `rounds` is 0 in the result where it failed."""
        assert self._tuning is not None
        hull = tunings.depth_hull(self._model.nominal, self._model.lag_s, tunings.STEP_S)
        water = Surroundings(0.0, 0.0, estimate.disturbance.item(2), 0.0, 0.0)
        set_depth_course(pulled_reference.eta, pulled_reference.velocity, self._depth_course)
        start = make_depth_start(estimate.action, self._wrench.item(1) - self._lift_n)
        weights = tunings.depth_weights(self._vehicle, self._tuning)
        problem = PlanProblem(start, self._depth_course, weights, self._depth_limits, self._open_water)
        iteration = step_plan(Dynamics(hull, water), self._depth_grid, problem, self._depth, self._period_s)
        if not (iteration.rounds and math.isfinite(iteration.after)):
            self._depth.flight.command[:] = 0.0
            return iteration._replace(rounds=0)
        return iteration

    # --- results

    def _output(
        self,
        estimate: Observation,
        reference: Reference,
        clear_reference: Reference,
        iteration: Iteration,
        dive: Iteration,
        now_ns: int,
    ) -> ControlOutput:
        """Convert the plans' wrench to pulses, remember it, and collect the step's output."""
        solved = iteration.rounds > 0 and dive.rounds > 0
        self._shifted = 0 if solved else self._shifted + 1
        failed = self._shifted > bridged_steps(self._period_s)
        wrench = self._still if failed else self._first_wrench(iteration.rounds > 0, dive.rounds > 0)
        pulses, delivered = self.allocator.neutral() if failed else self.allocator.allocate(wrench)
        wrench_step = wrench - self._wrench
        self.note_command(wrench, delivered, now_ns)
        plan_eta, plan_reference = self._reported_plan(estimate, clear_reference)
        error_m = float(np.linalg.norm(reference.eta[0, :3] - estimate.eta[:3]))
        self._priority = Priority(self._urgent, error_m)
        command = clear_reference.eta[0].copy()
        command[3] = self._course.yaw[0]
        deviations = estimate.deviations
        assert deviations is not None  # the configuration allows no observer without
        return ControlOutput(
            pulse_us=pulses,
            observation=estimate,
            control=Control(
                eta_reference=reference.eta[0].copy(),
                eta_command=command,
                wrench=wrench,
                wrench_step=wrench_step,
                wrench_wanted=wrench,
                wrench_delivered=delivered,
                solve=Solve.FAILED if failed else Solve.SOLVED if solved else Solve.SHIFTED,
                iterations=iteration.rounds,
                slack_m=iteration.entry_m,
            ),
            plan_eta=plan_eta,
            plan_reference=plan_reference,
            tracking_error_m=error_m,
            is_free=clear_reference is reference and not iteration.binds,
            path_is_blocked=self._give_way.path_is_blocked,
            flow_moment=flow_moment(self._model.coefficients, estimate.through_water, deviations.velocity_mps),
            avoids=self._give_way.avoids or iteration.binds,
        )

    def _first_wrench(self, has_plan: bool, has_depth_plan: bool) -> Array:
        """The wrench for the coming period: as far on the way to the first node's as the period goes. An axis without a
        plan keeps its wrench. A hull that leans too far gets less of the thrust that tilts it on."""
        share, limits = min(self._period_s / float(self._grid.time_s[1]), 1.0), self._vehicle.limits
        wanted = self._wrench.copy()
        if has_plan:
            for axis, force in zip(self._axes, self._planner.flight.command[0], strict=True):
                wanted[tunings.WRENCH_AXIS[axis]] = force
        if has_depth_plan:
            wanted[1] = self._depth.flight.command[0, 0] + self._lift_n
        wanted = self._wrench + share * (wanted - self._wrench)
        wanted = np.clip(wanted, self._upright.least, self._upright.most)
        most = np.array(limits.wrench_step(self._period_s))
        change = np.clip(wanted - self._wrench, -most, most)
        return np.clip(self._wrench + change, -np.array(limits.wrench), limits.wrench)

    def _reported_plan(self, estimate: Observation, clear_reference: Reference) -> tuple[Array, Array]:
        """The plan that is flown, from now on, and where it is meant to be; the reference has the plan's heading."""
        poses = self._reported_poses(estimate, self._planner.flight.state, self._depth.flight.state[:, 0])
        reference = interpolate(clear_reference.eta, self._reported_rows)
        reference[:, 3] = poses[:, 3]
        return poses, reference

    def _reported_poses(self, estimate: Observation, state: Array, depth_m: Array | float) -> Array:
        """The plan's poses for neighbours: now, at the instant of action, and of a flight (nodes, 9) with its depths."""
        rows = np.empty((len(state) + 2, 4))
        rows[0], rows[1] = estimate.eta, estimate.action[:4]
        rows[2:, :2], rows[2:, 3], rows[2:, 2] = state[:, :2], state[:, 2], depth_m
        return interpolate(rows, self._reported_rows)

    def _forget_plan(self) -> None:
        self._planner.forget()
        self._turns.reset()
        self._depth.flight.command[:] = 0.0
        self._place, self._off_m, self._shifted, self._lift_n = None, 0.0, 0, 0.0

    def _drift_poses(self, estimate: Observation) -> Array:
        dynamics, start = self._dynamics(estimate), make_start(estimate.action, self._still, self._axes)
        fly(dynamics, self._grid, start, self._drift_flight)
        return self._reported_poses(estimate, self._drift_flight.state, estimate.eta.item(2))


def clear_place(pose: Array, surrounds: Surrounds, margin_m: float) -> Array:
    """The pose (4,) to rest at, moved inside the room, and away from all that rests too near, by a margin more than needed.
    What moves on is no reason to leave a place: the plan makes way for it and comes back."""
    place = complex(*pose[:2].tolist())
    most_x, most_y = np.maximum(surrounds.room_m - margin_m, 0.0).tolist()
    for _ in range(4):  # two bodies that push against one another are left to the optimisation
        for there, keep_m, surrounded in _nearest_points(place, surrounds.bodies, surrounds.outlines):
            away = there - place if surrounded else place - there
            if surrounded or abs(away) < keep_m:
                place = there + (away / abs(away) if away else 1.0) * (keep_m + margin_m)
        place = complex(min(max(place.real, -most_x), most_x), min(max(place.imag, -most_y), most_y))
    return np.array([place.real, place.imag, *pose[2:]])


def _nearest_points(place: complex, bodies: MovingBodies, outlines: Outlines) -> list[tuple[complex, float, bool]]:
    """The point of each body that rests at the end of its plan, and of each outline at rest, that is nearest to a place, with
    its distance, and True if the outline surrounds the place."""
    end, before = bodies.place[:, -1], bodies.place[:, -2]
    rests = np.hypot(*(end - before).T) < RESTS_M
    ends = [(complex(*end[i]), float(bodies.keep_m[i].max()), False) for i in np.flatnonzero(rests)]
    for i in np.flatnonzero(np.hypot(*outlines.velocity.T) < tunings.SLOW_MPS):
        points = outlines.point[outlines.first[i] : outlines.first[i + 1]]
        points = points[:, 0] + 1j * points[:, 1]
        apart = place - points
        surrounds = bool(is_inside(apart[None].astype(np.complex128))[0])
        ends.append((complex(points[np.abs(apart).argmin()]), float(outlines.keep_m[i]), surrounds))
    return ends

"""READ FIRST. One robot: commands and inputs in, pulses, plan and state out. Pure: time and messages are arguments.

Data flow of `Agent.step`:

    pose, board, station -> health -> mode (modes.py) -> goal -> controller (controller.py) -> pulses, or neutral
                                                                                           -> plan, state

The same code runs in a pool and in the simulator; sockets and clock are in robot_agent/node.py.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from robot_agent.control.any_controller import make_controller
from robot_agent.control.controller import ControlOutput, Setting
from robot_agent.control.live_tuning import LiveTuning, Prepared
from robot_agent.guidance import driving
from robot_agent.guidance.driving import Driver
from robot_agent.guidance.formation import Neighbour, plan_at_rest, rest_of_plan
from robot_agent.guidance.obstacles import Obstacle, OwnHullFilter, grown_with_age, island_obstacles, obstacles_from_message
from robot_agent.guidance.reference import Goal, Hold
from robot_agent.guidance.trajectory_clock import TrajectoryClock
from robot_agent.inputs import Inputs, StampedPlan, StampedPose, StationView
from robot_agent.safety.health import HealthMonitor
from robot_agent.safety.modes import DRIVE_LASTS_S, ORDERS, POWERED, Health, react, refusal
from robot_agent.safety.thruster_selftest import ThrusterSelftest
from robot_agent.vehicle.estimate import PoseMeasurement, StateMeasurement
from shoal.bus.command_deduplication import ALWAYS_TAKEN
from shoal.config.experiment import Experiment
from shoal.messages.camera_coverage import outside_m
from shoal.messages.codec import Header
from shoal.messages.messages import (
    BoardReading,
    Command,
    CommandKind,
    Control,
    DriveVelocity,
    Estimate,
    Mode,
    Plan,
    Pose,
    Reply,
    RobotState,
    Solve,
    StepTiming,
    Track,
    Trajectory,
)
from shoal.messages.obstacle_memory import blindness, is_old

UNSEEN = frozenset({"pose late", "no pose"})  # reasons of modes.py
SUSPECT = frozenset({"thruster board disobeys", "thrusters do not do as told"})  # after these no earlier test counts
LEFT = ": it has left the camera's picture"
FROM_THE_FUTURE_S = 0.5  # a command may look younger than the heartbeat it is judged by, by no more than this
LONGEST_LIFE_S = 5.0  # upper limit of a command's time to live: an older command moves no robot
BEYOND_WALLS_M = 0.5  # a calibration is no better than that; what is seen farther out is no robot of this pool


@dataclass(frozen=True, eq=False)
class Outputs:
    """Outputs of one control step."""

    pulse_us: tuple[int, ...]
    arm: bool | None  # tell the board to arm or disarm; None: it is as it should be
    plan: Plan | None  # None until the robot knows where it is
    state: RobotState


class Agent:
    """State of one robot between control steps: mode, trajectory, controller."""

    def __init__(self, experiment: Experiment, robot: int) -> None:
        self.mode = Mode.DISARMED
        self._experiment, self._me = experiment, experiment.robot(robot)
        leader = experiment.leader_of(robot)
        self.controller = make_controller(
            Setting(
                experiment.vehicle,
                experiment.controller,
                experiment.safety,
                self._me.urgent,
                has_leader=leader is not None,
                room_m=experiment.pool.size_m[:2] if experiment.pool.walls else None,
                islands=island_obstacles(experiment.islands, experiment.vehicle.radius_m),
            )
        )
        self._ranges_us = experiment.vehicle.ranges_us
        self._driver = Driver(experiment)
        self._driven: tuple[DriveVelocity, int] | None = None  # the last DRIVE's velocity, and its instant on our clock
        self._tuning = LiveTuning(self.controller, experiment.controller)
        coupled = experiment.formation.kind == "virtual-structure"
        self._in_formation_with = self._me.neighbours if coupled else () if leader is None else (leader,)
        self._fault = ""
        self._clock = TrajectoryClock(experiment, robot)
        self._selftest: ThrusterSelftest | None = None
        self._health = HealthMonitor(experiment, self.controller.plan_period_s if self.controller.foresees else 0.0)
        self._own_hull = OwnHullFilter(experiment.vehicle.radius_m)
        self._hold: Hold | None = None
        self._sightings: dict[int, StampedPlan] = {}  # of silent robots: the rest of their plans, from where they were seen
        self._last: ControlOutput | None = None
        self.inputs = Inputs()  # of the last step, a pose outside the pool left out

    # --- orders

    def prepare(self, command: Command) -> Prepared:
        """Do the slow part of a command (solvers for TUNE, the check of a LOAD's trajectory) beforehand. It may run beside a
        step; `handle_command` may not."""
        return self._clock.flaw(command) or self._tuning.prepare(command)

    def handle_command(
        self, header: Header, command: Command, station: StationView, now_ns: int, prepared: Prepared | None = None
    ) -> Reply:
        """Carry out a command, or refuse it with the reason. `prepared` is the result of `prepare` for it, None if that was
        not called."""
        reason = unacceptable(self._me.id, self._experiment.hash, header, command, station)
        if reason:
            return Reply(self._me.id, False, f"{command.order.name} {reason}", self.mode)
        # Both counted on the station's clock: robots that got an order at different instants still follow it together.
        ours_ahead_ns = now_ns - station.clock_ns
        begin_ns, given_ns = command.start_ns + ours_ahead_ns, header.stamp_ns + ours_ahead_ns
        reason = refusal(command.order, self.mode)
        if not reason:
            prepared = self.prepare(command) if prepared is None else prepared
            reason = self._objection(command, prepared, station, begin_ns, given_ns, now_ns)
        if not reason and prepared is not None:
            self._apply(command, prepared, station, begin_ns, given_ns)
        return Reply(self._me.id, not reason, reason, self.mode)

    def _objection(
        self, command: Command, prepared: Prepared, station: StationView, begin_ns: int, given_ns: int, now_ns: int
    ) -> str:
        """Return the reason to refuse a command whose mode and origin are right; empty if there is none."""
        eta = self._estimate.eta if self._estimate is not None else None
        flaw = prepared if isinstance(prepared, str) else ""
        reason = self._clock.objection(command, self.mode is Mode.TRACKING, station, begin_ns, now_ns, eta, flaw)
        if reason:
            return reason
        if command.order is CommandKind.ARM:
            return self._health.arming_refusal(self.inputs, station, now_ns)
        if command.order is CommandKind.DRIVE:
            return self._undrivable(command.drive, given_ns, now_ns)
        return self._tuning.objection(command, prepared)

    def _undrivable(self, velocity: DriveVelocity | None, given_ns: int, now_ns: int) -> str:
        """Return the reason to refuse a DRIVE given at `given_ns`; empty if there is none. What would end it at the next step
        is one."""
        if self._driven is not None and given_ns < self._driven[1]:
            return f"is {(self._driven[1] - given_ns) * 1e-9:.3f} s older than the one that is followed"
        health = self._health.health(self.inputs, False, now_ns, (now_ns - given_ns) * 1e-9)
        return driving.objection(velocity) or react(Mode.DRIVEN, health, self._experiment.safety)[1]

    def _apply(self, command: Command, prepared: Prepared, station: StationView, begin_ns: int, given_ns: int) -> None:
        """Carry out an accepted command, given at `given_ns`. START and RESUME take effect at `begin_ns`. Both are on our
        clock."""
        self._tuning.apply(command, prepared, given_ns)
        self._clock.apply(command, self.mode is Mode.TRACKING, station, begin_ns)
        if command.order is CommandKind.TEST:
            neutral_us = self._last.pulse_us if self._last is not None else ()
            self._selftest = ThrusterSelftest(self._experiment.vehicle, neutral_us)
        if command.order is CommandKind.STOP:
            self._fault = "emergency stop"
        if command.drive is not None and command.order is CommandKind.DRIVE:
            self._driven = command.drive, given_ns
        target = ORDERS[command.order].to
        if target is not None:
            self._enter(target, self._fault if target is Mode.STOPPED else "")

    def _enter(self, mode: Mode, fault: str) -> None:
        """Enter a mode, and drop what belongs to the others."""
        if mode is not Mode.HOLDING:
            self._hold = None
        if mode is not Mode.DRIVEN:
            self._driven = None
            self._driver.reset()
        if mode not in POWERED:
            self._tuning.leave_run()
        if mode is not Mode.TRACKING:
            self._clock.drop_next()
        self.mode, self._fault = mode, fault

    # --- the control step

    def step(self, inputs: Inputs, now_ns: int) -> Outputs:
        """Run one control step at `now_ns`. In this order these decide the thrust, each later one only to take it away:

        safety/health.py       ages of the inputs, and what checks found in the last step
        safety/modes.py        whether the robot may push
        guidance/              the goal: path or HOLD or DRIVE (`_goal`), with neighbours and obstacles
        control/               the goal led around others, and the wrench: the only place where one is computed
        vehicle/allocation.py  wrench to pulses
        `_sound`               pulses that are not finite or out of range become neutral
        safety/path_watch.py   whether the robot does what its plan predicted: acts in the next step
        safety/output_check.py what the board puts out against what was sent: acts in the next step
        """
        if inputs.pose is not None and not self._inside(inputs.pose.pose):
            inputs = replace(inputs, pose=None)
        if self._me.depth_offset_m:
            depth_m = inputs.board.depth_m - self._me.depth_offset_m
            inputs = replace(inputs, board=replace(inputs.board, depth_m=depth_m))
        self.inputs = inputs
        self._health.note_inputs(inputs, self.mode, now_ns, self._selftest is not None and self._selftest.result == "running")
        solver_failed = self._last is not None and self._last.solve is Solve.FAILED
        drive_age_s = (now_ns - self._driven[1]) * 1e-9 if self._driven is not None else 0.0
        health = self._health.health(inputs, solver_failed, now_ns, drive_age_s)
        mode, reason = react(self.mode, health, self._experiment.safety)
        in_doubt = reason.partition(":")[0] in SUSPECT or inputs.board.objection  # the latter: it may be another board
        if in_doubt and self._selftest is not None and self._selftest.result == "passed":
            self._selftest = None
        if mode is not self.mode:
            self._enter(mode, reason + (LEFT if reason in UNSEEN and self._left_the_picture() else ""))
        neighbours = self._neighbours(inputs, now_ns)
        obstacles = self.obstacles(inputs, now_ns)
        goal = self._goal(neighbours, obstacles, now_ns)  # time goes on along the path while the board arms
        if not inputs.board.armed:
            goal = None  # a board arms on neutral pulses, and puts out no others
        self._tuning.step(now_ns, self._clock.formation_s)
        output = self._sound(self.controller.step(_measurement(inputs), goal, neighbours, now_ns, obstacles))
        self._last = output
        pulses = self._pulses(output, inputs.board, now_ns)
        self._health.note_pulses(pulses, now_ns)
        self._health.note_output(output, self.mode, now_ns)
        fresh_robots = tuple(n.robot for n in neighbours if n.fresh)
        adrift = goal is None or output.solve is Solve.FAILED
        plan = self._plan(output, fresh_robots, adrift) if output.estimate is not None else None
        return Outputs(
            pulses,
            self._health.arming_command(inputs.board.armed, self.mode, now_ns),
            plan,
            self._state(output, pulses, health, inputs, fresh_robots, self._blind(inputs, now_ns)),
        )

    def _sound(self, output: ControlOutput) -> ControlOutput:
        """Return a control step's output, or neutral pulses and FAILED in its place if a number is not finite or a pulse is
        outside the vehicle's range: the last guard before the wire. Its goal is then that of the step before."""
        ranges = zip(output.pulse_us, self._ranges_us, strict=True)
        if all(low <= pulse <= high for pulse, (low, high) in ranges) and output.is_finite:
            return output
        nowhere, still = np.zeros_like(output.plan_eta), np.zeros(len(self._experiment.vehicle.limits.wrench))
        before = self._last.control if self._last is not None else None
        control = replace(
            before or Control(), solve=Solve.FAILED, iterations=0, slack_m=0.0,
            wrench=still, wrench_step=still, wrench_wanted=still, wrench_delivered=still,
        )  # fmt: skip
        return ControlOutput(self.neutral_us, None, control, nowhere, nowhere)

    @property
    def _estimate(self) -> Estimate | None:
        """The last step's estimate."""
        return self._last.estimate if self._last is not None else None

    def _pulses(self, output: ControlOutput, board: BoardReading, now_ns: int) -> tuple[int, ...]:
        """Return the controller's pulses, or those of a thruster self-test while it runs."""
        if self._selftest is None or self._selftest.result != "running":
            return output.pulse_us
        if self.mode is not Mode.ARMED:
            self._selftest = None
            return output.pulse_us
        return self._selftest.step(board.armed, board.echo_us, now_ns)

    def note_sent(self, state: RobotState, now_ns: int) -> None:
        """Take note of the pulses and wrench that really went out at `now_ns` instead of those of the last step (a rerun moves
        no robot)."""
        control, still = state.control, np.zeros(len(self._experiment.vehicle.limits.wrench))
        wrench, delivered = (still, still) if control is None else (control.wrench, control.wrench_delivered)
        self.controller.note_command(wrench, delivered, now_ns)
        self._health.note_pulses(state.pulse_us, now_ns)

    @property
    def neutral_us(self) -> tuple[int, ...]:
        """Pulses with which no thruster turns: 4 thrusters, 4 ankles."""
        return self._health.neutral_us

    @property
    def trajectory(self) -> Trajectory | None:
        """The loaded trajectory, None if there is none."""
        return self._clock.trajectory

    @property
    def react_by_ns(self) -> int | None:
        """Instant at which the pose becomes too old for the present mode; the next step must not come later."""
        return self._health.react_by_ns(self.mode)

    def _inside(self, pose: Pose) -> bool:
        """True if a pose lies in the pool, with the calibration's tolerance BEYOND_WALLS_M."""
        length_m, width_m, _ = self._experiment.pool.size_m
        return abs(pose.x_m) <= 0.5 * length_m + BEYOND_WALLS_M and abs(pose.y_m) <= 0.5 * width_m + BEYOND_WALLS_M

    def _left_the_picture(self) -> bool:
        """True if the robot's estimate is not wholly in a picture of the cameras that locate it. A moving camera's place is
        not known here: False then."""
        experiment, estimate = self._experiment, self._estimate
        if estimate is None or not experiment.localizer.uses_camera or experiment.landmarks:
            return False
        return float(outside_m(experiment.all_cameras, estimate.eta[None, :3], experiment.vehicle.radius_m)[0]) > 0.0

    def _goal(self, neighbours: Sequence[Neighbour], obstacles: Sequence[Obstacle], now_ns: int) -> Goal | None:
        """Return the controller's goal in the present mode; None is neutral."""
        if self.mode is Mode.TRACKING:
            return self._clock.goal(self.inputs.station, now_ns)
        if self.mode is Mode.HOLDING:
            observation = self._last.observation if self._last is not None else None
            # After a leap the place to hold was never the robot's
            if observation is not None and (self._hold is None or observation.leap):
                self._hold = Hold(observation.eta)
            return self._hold
        if self._driven is not None and self._estimate is not None:
            (velocity, given_ns), estimate = self._driven, self._estimate
            lasts_s = DRIVE_LASTS_S - (now_ns - given_ns) * 1e-9
            around = driving.bodies(neighbours, obstacles, self.controller.formation, now_ns)
            return self._driver.goal(velocity, lasts_s, estimate.eta, around, estimate.nu.item(2))
        return None

    def _neighbours(self, inputs: Inputs, now_ns: int) -> tuple[Neighbour, ...]:
        """Return the last plans of the other robots in the water, with their freshness and their part in the formation. The
        plan of a robot that is silent and was seen since begins where it was seen; one whose plan never came rests there."""
        limit_ns, formation, neighbours = self._experiment.safety.plan_max_age_s * 1e9, self._in_formation_with, []
        sightings = inputs.station.sightings
        for robot in sorted({*inputs.plans, *sightings, *self._sightings} - {self._me.id, *inputs.station.out}):
            message = inputs.plans.get(robot)
            fresh = message is not None and now_ns - message.instant_ns <= limit_ns
            if not fresh and (place := sightings.get(robot)) is not None:
                seen_ns, rest = now_ns - round(inputs.station.age_s * 1e9), plan_at_rest(place, inputs.board.depth_m)
                if message is not None:
                    rest = rest_of_plan(message.plan, (seen_ns - message.instant_ns) * 1e-9, place)
                self._sightings[robot] = StampedPlan(rest, seen_ns)
            plan = self._sightings.get(robot)
            if message is not None and (fresh or plan is None or plan.instant_ns < message.instant_ns):
                plan = message
            assert plan is not None  # one of the two brought it here
            hears_us = self._me.id in plan.plan.heard
            neighbours.append(Neighbour(robot, plan.instant_ns, plan.plan, fresh, robot in formation, hears_us))
        return tuple(neighbours)

    def obstacles(self, inputs: Inputs, now_ns: int) -> Sequence[Obstacle]:
        """Return the obstacles without the robot's own hull. Those not seen lately grow with their age."""
        watched, safety = inputs.obstacles, self._experiment.safety
        if watched is None:
            return ()
        outlines = obstacles_from_message(watched.obstacles, watched.instant_ns, safety.radius_m)
        if self._estimate is not None:
            x, y, _, _ = self._estimate.eta.tolist()
            outlines = self._own_hull.exclude(outlines, complex(x, y), now_ns)
        return tuple(
            grown_with_age(obstacle, safety, now_ns) if is_old(obstacle.age_s(now_ns)) else obstacle for obstacle in outlines
        )

    def _blind(self, inputs: Inputs, now_ns: int) -> str:
        """Return the reason why obstacles are not known though the experiment watches for them; empty if they are known."""
        if not self._experiment.watches_obstacles:
            return ""
        watched = inputs.obstacles
        if watched is None:
            return blindness(None, 0.0)
        return blindness(watched.obstacles, (now_ns - watched.instant_ns) * 1e-9)

    def _plan(self, output: ControlOutput, fresh_robots: tuple[int, ...], adrift: bool) -> Plan:
        """The plan for the neighbours, from what the controller has computed."""
        return Plan(
            self.controller.plan_period_s,
            output.plan_eta,
            output.plan_reference,
            output.tracking_error_m,
            self._me.urgent,
            fresh_robots,
            adrift,
        )

    def _state(
        self,
        output: ControlOutput,
        pulse_us: tuple[int, ...],
        health: Health,
        inputs: Inputs,
        fresh_robots: tuple[int, ...],
        blind: str,
    ) -> RobotState:
        """The robot's state for station and log."""
        board, pose = inputs.board, inputs.pose
        return RobotState(
            mode=self.mode,
            fault=self._fault,
            guidance=self._health.guidance,
            experiment_hash=self._experiment.hash,
            tuning_id=self._tuning.id,
            trajectory_s=self._clock.reached_s,
            trajectory_id=self._clock.id,
            pulse_us=pulse_us,
            track=pose.pose.track if pose is not None else Track.LOST,
            heard=fresh_robots,
            blind=blind,
            thruster_test=self._selftest.result if self._selftest is not None else "",
            estimate=output.estimate,
            control=output.control,
            board=board if board.board_ms >= 0 else None,
            timing=StepTiming(pose_age_ms=_known_ms(health.pose_age_s), board_age_ms=_known_ms(health.board_age_s)),
        )


def _measurement(inputs: Inputs) -> StateMeasurement:
    """Convert inputs to the observer's measurement; what is not known is None."""
    board = inputs.board
    has_board = board.board_ms >= 0
    roll, pitch, roll_rate, pitch_rate = board.tilt.tolist() if has_board and board.tilt.size else (0.0, 0.0, 0.0, 0.0)
    return StateMeasurement(
        pose=_pose_measurement(inputs.pose),
        depth_m=board.depth_m if has_board else None,
        yaw_rate_radps=board.yaw_rate_radps if has_board else None,
        board_ns=board.arrival_ns if has_board else None,
        pitch_rad=pitch,
        roll_rad=roll,
        pitch_rate_radps=pitch_rate,
        roll_rate_radps=roll_rate,
    )


def _pose_measurement(stamped: StampedPose | None) -> PoseMeasurement | None:
    """Convert a pose to the observer's; None if the localizer only guesses."""
    if stamped is None or not stamped.is_seen:
        return None
    pose = stamped.pose
    return PoseMeasurement(
        stamped.instant_ns, pose.x_m, pose.y_m, pose.yaw_rad, stamped.variance_m2, pose.covariance.item(2, 2)
    )


def unacceptable(robot: int, experiment_hash: str, header: Header, command: Command, station: StationView) -> str:
    """Return the reason to reject a command before its content is looked at; empty if it is accepted. A command is valid from
    the station that is heard now, while it is young, and for the experiment of this robot. The bus removes duplicates and
    commands for an earlier process (shoal/bus/command_deduplication.py). STOP and DISARM are always accepted: whoever may
    command at all (docs/security.md) may take the power away at any time."""
    if command.robot != robot:
        return f"is for robot {command.robot}, this is robot {robot}"
    if command.order in ALWAYS_TAKEN:
        return ""
    if header.session != station.session:
        return "does not come from the station that is heard now"
    age_s = (station.clock_ns - header.stamp_ns) * 1e-9
    lives_s = min(command.time_to_live_s, LONGEST_LIFE_S)
    if not -FROM_THE_FUTURE_S <= age_s <= lives_s:
        return f"is {age_s:.3f} s old, lives {lives_s:g} s"
    if command.experiment_hash != experiment_hash:
        return f"is for experiment {command.experiment_hash[:8]}, this robot holds {experiment_hash[:8]}"
    return ""


def _known_ms(age_s: float) -> float | None:
    """An age in milliseconds; None where it is infinite, of what never came."""
    return age_s * 1e3 if math.isfinite(age_s) else None

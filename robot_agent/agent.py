"""READ FIRST. One robot: orders and inputs in, pulses, plan and state out. Pure: time and messages are arguments.

The data's way through `Agent.step`:

    pose, board, station -> health -> mode (mode.py) -> goal -> controller (controller.py) -> pulses, or neutral
                                                                                           -> plan, state

Nothing here knows whether it runs in a pool or in a simulator; robot_agent/shell.py has the sockets and the clock.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from robot_agent.controller import Controller, ControlOutput, Goal, Hold, Measurement, Neighbour, Sighting
from robot_agent.course import Course
from robot_agent.gains import Gains
from robot_agent.inputs import Inputs
from robot_agent.mode import ORDERS, POWERED, Health, react, refusal
from robot_agent.obstacles import Thing, islands, spread, things_seen
from robot_agent.orders import StationView, unacceptable
from robot_agent.pulse_test import ThrusterTest
from robot_agent.vitals import ARM_AGAIN_S, Vitals
from wire.codec import Header
from wire.experiment import Experiment
from wire.mavlink import Telemetry
from wire.messages import Command, Mode, Order, Plan, Pose, Reply, RobotState, Solve, Track, Trajectory
from wire.picture import outside_m
from wire.unseen import blindness, is_old

UNSEEN = frozenset({"pose late", "no pose"})  # reasons of mode.py
LEFT = ": it has left the camera's picture"
BEYOND_WALLS_M = 0.5  # a calibration is no better than that; what is seen farther out is no robot of this pool


@dataclass(frozen=True, eq=False)
class Outputs:
    """What leaves the robot after one control step."""

    pulse_us: tuple[int, ...]
    arm: bool | None  # tell the board to arm or disarm; None: it is as it should be
    plan: Plan | None  # None until the robot knows where it is
    state: RobotState


class Agent:
    """The robot's mind between control steps: mode, trajectory, controller."""

    def __init__(self, experiment: Experiment, robot: int) -> None:
        self.mode = Mode.DISARMED
        self._experiment, self._me = experiment, experiment.robot(robot)
        leader = experiment.leader_of(robot)
        self._controller = Controller(
            experiment.vehicle,
            experiment.controller,
            experiment.safety,
            self._me.urgent,
            follows=leader is not None,
            room_m=experiment.pool.size_m[:2],
            islands=islands(experiment.islands, experiment.vehicle.radius_m),
        )
        self._gains = Gains(self._controller, experiment.controller)
        coupled = experiment.formation.kind == "virtual-structure"
        self._in_formation_with = self._me.neighbours if coupled else () if leader is None else (leader,)
        self._fault = ""
        self._course = Course(experiment.pool.size_m)
        self._test: ThrusterTest | None = None
        self._vitals = Vitals(experiment)
        self._hold: Hold | None = None
        self._last: ControlOutput | None = None
        self._inputs = Inputs()

    # --- orders

    def order(self, header: Header, command: Command, station: StationView, now_ns: int) -> Reply:
        """Deal with an order. Refused ones say why."""
        reason = unacceptable(self._me.id, self._experiment.hash, header, command, station)
        if reason:
            return Reply(self._me.id, False, f"{command.order.name} {reason}", self.mode)
        reason = refusal(command.order, self.mode) or self._objection(command, station, now_ns)
        if not reason:
            # Counted from when the order was given: robots that got it at different instants still start together.
            self._follow(command, station, now_ns - (station.clock_ns - header.stamp_ns))
        return Reply(self._me.id, not reason, reason, self.mode)

    def _objection(self, command: Command, station: StationView, now_ns: int) -> str:
        reason = self._course.objection(command, self.mode is Mode.TRACKING)
        if reason:
            return reason
        if command.order is Order.ARM:
            return self._vitals.unfit(self._inputs, station, now_ns)
        if command.order in (Order.START, Order.RESUME) and not self._located:
            return "the robot does not know where it is"
        return self._gains.objection(command)

    def _follow(self, command: Command, station: StationView, given_ns: int) -> None:
        """Carry out an order that is accepted, given at that instant on our clock."""
        self._gains.follow(command, given_ns)
        self._course.follow(command, self.mode is Mode.TRACKING, station, given_ns)
        if command.order is Order.TEST:
            neutral_us = self._last.pulse_us if self._last is not None else ()
            self._test = ThrusterTest(self._experiment.vehicle, neutral_us)
        if command.order is Order.STOP:
            self._fault = "emergency stop"
        target = ORDERS[command.order].to
        if target is not None:
            self._enter(target, self._fault if target is Mode.STOPPED else "")

    def _enter(self, mode: Mode, fault: str) -> None:
        if mode is not Mode.HOLDING:
            self._hold = None
        if mode not in POWERED:
            self._gains.leave_run()
        if mode is not Mode.TRACKING:
            self._course.drop_next()
        self.mode, self._fault = mode, fault

    # --- the control step

    def step(self, inputs: Inputs, now_ns: int) -> Outputs:
        """One control step."""
        if inputs.pose is not None and not self._inside(inputs.pose.pose):
            inputs = replace(inputs, pose=None)
        self._inputs = inputs
        self._vitals.note(inputs, self.mode)
        solver_failed = self._last is not None and self._last.solve is Solve.FAILED
        health = self._vitals.health(inputs, solver_failed, now_ns)
        mode, reason = react(self.mode, health, self._experiment.safety, self._experiment.vehicle.battery)
        if mode is not self.mode:
            self._enter(mode, reason + (LEFT if reason in UNSEEN and self._left_the_picture() else ""))
        neighbours = self._neighbours(inputs, now_ns)
        arming = health.board_disarmed_s >= ARM_AGAIN_S  # asked again: it arms on neutral pulses only
        things, goal = self._things(inputs, now_ns), None if arming else self._goal(now_ns)
        self._gains.step(now_ns, self._course.reached_s)
        output = self._controller.step(_measurement(inputs), goal, neighbours, now_ns, things)
        self._last = output
        pulses = self._pulses(output, inputs.telemetry, now_ns)
        self._vitals.told(pulses, now_ns)
        self._vitals.flew(output, now_ns)
        heard = tuple(n.robot for n in neighbours if n.fresh)
        plan = self._plan(output, len(heard)) if output.estimated else None
        return Outputs(
            pulses,
            self._vitals.arming(inputs.telemetry.armed, self.mode, now_ns),
            plan,
            self._state(output, pulses, health, inputs, heard, self._blind(inputs, now_ns)),
        )

    def _pulses(self, output: ControlOutput, telemetry: Telemetry, now_ns: int) -> tuple[int, ...]:
        """The controller's; those of a thruster test while it lasts."""
        if self._test is None or self._test.result != "running":
            return output.pulse_us
        if self.mode is not Mode.ARMED:
            self._test = None
            return output.pulse_us
        return self._test.step(telemetry.armed, telemetry.echo_us, now_ns)

    def acted(self, state: RobotState, now_ns: int) -> None:
        """What really went out at `now_ns`, if it was not what the last step said: a rerun moves nothing."""
        self._controller.acted(state.wrench, state.wrench_delivered, now_ns)
        self._vitals.told(state.pulse_us, now_ns)

    @property
    def trajectory(self) -> Trajectory | None:
        """What is loaded."""
        return self._course.trajectory

    @property
    def react_by_ns(self) -> int | None:
        """When the pose will be too old to go on as now: the next step must not come later."""
        return self._vitals.react_by_ns(self.mode)

    def _inside(self, pose: Pose) -> bool:
        """Whether a pose can be one of this pool."""
        length_m, width_m, _ = self._experiment.pool.size_m
        return abs(pose.x_m) <= 0.5 * length_m + BEYOND_WALLS_M and abs(pose.y_m) <= 0.5 * width_m + BEYOND_WALLS_M

    def _left_the_picture(self) -> bool:
        """Whether the robot, as far as it knows, is no longer wholly in the picture of the camera that locates it. Of a camera
        that moves nobody here knows where it is."""
        experiment, last = self._experiment, self._last
        if last is None or not last.estimated or not experiment.localizer.uses_camera or experiment.landmarks:
            return False
        return float(outside_m(experiment.camera, last.eta[None, :3], experiment.vehicle.radius_m)[0]) > 0.0

    @property
    def _located(self) -> bool:
        return self._last is not None and self._last.estimated

    def _goal(self, now_ns: int) -> Goal | None:
        """What the mode asks the controller for; None is neutral."""
        if self.mode is Mode.TRACKING:
            return self._course.goal(self._inputs.station, now_ns)
        if self.mode is Mode.HOLDING:
            if self._hold is None and self._last is not None and self._last.estimated:
                self._hold = Hold(self._last.eta)
            return self._hold
        return None

    def _neighbours(self, inputs: Inputs, now_ns: int) -> tuple[Neighbour, ...]:
        limit_ns, formation = self._experiment.safety.plan_max_age_s * 1e9, self._in_formation_with
        return tuple(
            Neighbour(robot, heard.instant_ns, heard.plan, now_ns - heard.instant_ns <= limit_ns, robot in formation)
            for robot, heard in sorted(inputs.plans.items())
        )

    def _things(self, inputs: Inputs, now_ns: int) -> Sequence[Thing]:
        """Obstacles. Those that nobody has told of for a while are kept, where they may be by now."""
        watched, safety = inputs.watched, self._experiment.safety
        if watched is None:
            return ()
        found = []
        for thing in things_seen(watched.obstacles, watched.instant_ns, safety.radius_m):
            old = is_old((now_ns - thing.instant_ns) * 1e-9)
            if not self._is_me(thing, thing.instant_ns if old else now_ns):
                found.append(spread(thing, safety, now_ns) if old else thing)
        return tuple(found)

    def _is_me(self, thing: Thing, at_ns: int) -> bool:
        """Whether a thing, where it was at that instant, is what the camera saw of this robot."""
        if self._last is None or not self._last.estimated:
            return False
        x, y, _, _ = self._last.eta.tolist()
        return thing.overlaps(complex(x, y), self._experiment.vehicle.radius_m, at_ns)

    def _blind(self, inputs: Inputs, now_ns: int) -> str:
        """Why the robot does not know of obstacles though somebody should watch for them; empty if it does."""
        if not self._experiment.watches_obstacles:
            return ""
        watched = inputs.watched
        if watched is None:
            return blindness(None, 0.0)
        return blindness(watched.obstacles, (now_ns - watched.instant_ns) * 1e-9)

    def _plan(self, output: ControlOutput, heard: int) -> Plan:
        return Plan(
            self._experiment.controller.period_s,
            output.plan_eta,
            output.plan_reference,
            output.tracking_error_m,
            self._me.urgent,
            heard,
        )

    def _state(
        self,
        output: ControlOutput,
        pulse_us: tuple[int, ...],
        health: Health,
        inputs: Inputs,
        heard: tuple[int, ...],
        blind: str,
    ) -> RobotState:
        telemetry, seen = inputs.telemetry, inputs.pose
        unheard = 1e6  # finite stand-in for "never", in milliseconds: every number on the wire is finite
        return RobotState(
            mode=self.mode,
            fault=self._fault,
            experiment_hash=self._experiment.hash,
            tuning_id=self._gains.id,
            trajectory_s=self._course.reached_s,
            trajectory_id=self._course.id,
            eta=output.eta,
            nu=output.nu,
            disturbance=output.disturbance,
            eta_reference=output.eta_reference,
            eta_command=output.eta_command,
            wrench=output.wrench,
            wrench_step=output.wrench_step,
            wrench_wanted=output.wrench_wanted,
            wrench_delivered=output.wrench_delivered,
            pulse_us=pulse_us,
            echo_us=telemetry.echo_us,
            track=seen.pose.track if seen is not None else Track.LOST,
            pose_age_ms=min(health.pose_age_s * 1e3, unheard),
            depth_m=telemetry.depth_m,
            battery_v=telemetry.battery_v,
            board_armed=telemetry.armed,
            board_age_ms=min(health.board_age_s * 1e3, unheard),
            board_loss=telemetry.loss,
            solve=output.solve,
            iterations=output.iterations,
            slack_m=output.slack_m,
            thruster_test=self._test.result if self._test is not None else "",
            heard=heard,
            planned=output.estimated,
            blind=blind,
        )


def _measurement(inputs: Inputs) -> Measurement:
    seen, telemetry = inputs.pose, inputs.telemetry
    known = telemetry.board_ms >= 0
    return Measurement(
        pose=Sighting(seen.instant_ns, seen.pose.x_m, seen.pose.y_m, seen.pose.yaw_rad)
        if seen is not None and seen.pose.track >= Track.KCF
        else None,
        depth_m=telemetry.depth_m if known else None,
        yaw_rate_radps=telemetry.yaw_rate_radps if known else None,
        board_ns=telemetry.arrival_ns if known else None,
    )

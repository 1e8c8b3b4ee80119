"""A station's decisions and a fleet of robots in simulated time: no camera, no threads, no network.

A robot is the real table of modes (robot_agent/safety/modes.py) and the real clock of its trajectory, around a point that
moves to its reference at a limited speed. Its radio may be late or out, its program dead or restarted, its board silent.
"""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from groundstation.mission.command_dispatcher import CommandResult
from groundstation.mission.gain_update import GainUpdater
from groundstation.mission.mission import Mission
from groundstation.mission.obstacle_monitor import ObstacleSet
from groundstation.mission.plan_manager import PlanRequest
from groundstation.mission.state_machine import MissionState
from groundstation.mission.station_core import StationCore
from groundstation.planning import planner
from groundstation.planning.feasibility import PlanError
from groundstation.planning.segment import PlanSegment, first_segment
from groundstation.telemetry import RobotView
from robot_agent.agent import unacceptable
from robot_agent.guidance.reference import pose_at
from robot_agent.guidance.trajectory_clock import TrajectoryClock
from robot_agent.inputs import StationView
from robot_agent.safety.modes import LIVE, ORDERS, POWERED, Health, react, refusal
from shoal.config.experiment import NO_CAMERA, Experiment, load_experiment
from shoal.frames import Array
from shoal.messages.codec import Header
from shoal.messages.live_gains import tuning
from shoal.messages.messages import (
    Command,
    CommandKind,
    Control,
    DriveVelocity,
    Mode,
    Pose,
    Reply,
    RobotState,
    StationHeartbeat,
    Track,
)
from tests.groundstation.mission.reported_state import reported_state

STEP_S = 0.05
STEP_NS = 50_000_000
ORDER_TIMEOUT_NS = 500_000_000  # as the station's ORDER_TIMEOUT_S
MAX_UNANSWERED = 2  # as the station's
PLANNING_NS = 300_000_000  # from a plan's request to its outcome, usually
SPEED_MPS = 0.35  # of a robot on its way to its reference
TEST_NS = 2_000_000_000  # duration of a thruster test
SESSION = 7  # of the station
POSE = Pose(0.0, 0.0, 0.0, np.eye(3), Track.MARKER, True)

TWO = "[{id=1,node_m=[0.5,0.0,0.0],neighbours=[2]},{id=2,node_m=[-0.5,0.0,0.0],neighbours=[1]}]"
THREE = (
    "[{id=1,node_m=[0.0,0.0,0.0],neighbours=[2]},{id=2,node_m=[0.9,0.0,0.0],neighbours=[1,3]},"
    "{id=3,node_m=[-0.9,0.0,0.0],neighbours=[2]}]"
)
CIRCLE = '{kind="circle",lap_s=20,diameter_m=0.8,depth_m=0.5}'
PLACES = '{kind="waypoints",points_m=[[-1.2,-0.6],[1.2,-0.6],[1.2,0.6],[-1.2,0.6]],speed_mps=0.1,depth_m=0.5}'


def an_experiment(lost: str, robots: str, path: str, duration_s: int = 50) -> Experiment:
    """Robots in a pool with room to be led away."""
    return load_experiment(
        "pool",
        [
            f"duration_s={duration_s}", f"path={path}", "pool.size_m=[7.0,5.0,1.0]",
            f"robots={robots}", f'mission.lost="{lost}"', "mission.wait_from_m=0.1",
            "article=[]", NO_CAMERA,
        ],
    )  # fmt: skip


@dataclass
class Radio:
    """Link between the station and one robot."""

    delay_ns: int = 20_000_000
    deaf_until_ns: int = 0  # nothing reaches the robot before
    mute_until_ns: int = 0  # nothing that the robot sends arrives before


@dataclass
class _Adoption:
    id: str
    at_ns: int
    trajectory_s: float


class SimulatedRobot:
    """One robot. `truth` is what a person at the pool would see."""

    def __init__(self, experiment: Experiment, robot: int, eta: Array) -> None:
        self.id, self.eta, self.radio = robot, np.array(eta), Radio()
        self.alive, self.board_works, self.unseen_until_ns, self.speed_mps = True, True, 0, SPEED_MPS
        self.blind_until_ns = 0  # it cannot tell before whether obstacles are there
        self.foreign_until_ns = 0  # two programs publish its poses before
        self.passed_ns = 0  # when it last passed a thruster test
        self._experiment, self._start_tuning = experiment, tuning(experiment.controller).id
        self.restart(0)

    def restart(self, now_ns: int) -> None:
        """Begin with a new process: disarmed, without trajectory, with the file's gains."""
        self.alive, self.mode, self.fault, self.test = True, Mode.DISARMED, "", ""
        self.clock = TrajectoryClock(self._experiment, self.id)
        self.tuning_id, self._ready = self._start_tuning, ""
        self._adoption: _Adoption | None = None
        self._hold: Array | None = None
        self._beat: tuple[int, StationHeartbeat] | None = None
        self._drive: tuple[DriveVelocity, int] | None = None
        self._test_until_ns, self._speed_mps, self._reference = 0, 0.0, self.eta.copy()

    def view_of_station(self, now_ns: int) -> StationView:
        if self._beat is None:
            return StationView()
        stamp_ns, beat = self._beat
        return StationView(SESSION, now_ns, (now_ns - stamp_ns) * 1e-9, beat.lag_s, beat.slowing)

    def hear(self, stamp_ns: int, beat: StationHeartbeat) -> None:
        """Take a heartbeat."""
        self._beat = stamp_ns, beat

    def obey(self, stamp_ns: int, command: Command, now_ns: int) -> Reply:
        """Carry out a command, or refuse it, as robot_agent/agent.py does."""
        station = self.view_of_station(now_ns)
        reason = unacceptable(self.id, self._experiment.hash, Header(SESSION, 0, stamp_ns), command, station)
        begin_ns = command.start_ns
        reason = reason or refusal(command.order, self.mode)
        reason = reason or self.clock.objection(command, self.mode is Mode.TRACKING, station, begin_ns, now_ns, self.eta)
        if not reason and command.order is CommandKind.ARM and not self.board_works:
            reason = "the thruster board was last heard 5.00 s ago"
        if not reason and command.order is CommandKind.ADOPT and command.tuning_id not in (self.tuning_id, self._ready):
            reason = f"tuning {command.tuning_id} is not ready"
        if not reason:
            self._apply(command, station, begin_ns, stamp_ns, now_ns)
        return Reply(self.id, not reason, reason, self.mode)

    def _apply(self, command: Command, station: StationView, begin_ns: int, stamp_ns: int, now_ns: int) -> None:
        self.clock.apply(command, self.mode is Mode.TRACKING, station, begin_ns)
        if command.order is CommandKind.TEST:
            self.test, self._test_until_ns = "running", now_ns + TEST_NS
        if command.order is CommandKind.TUNE and command.tuning is not None:
            self._ready = command.tuning.id
        if command.order is CommandKind.ADOPT:
            at_ns = stamp_ns + round(command.start_in_s * 1e9)
            same = command.tuning_id == self.tuning_id
            self._adoption = None if same else _Adoption(command.tuning_id, at_ns, command.trajectory_s)
        if command.order is CommandKind.DRIVE and command.drive is not None:
            self._drive = command.drive, stamp_ns
        target = ORDERS[command.order].to
        if target is not None:
            self._enter(target, "emergency stop" if target is Mode.STOPPED else "")

    def _enter(self, mode: Mode, fault: str) -> None:
        if mode is not Mode.HOLDING:
            self._hold = None
        if mode is not Mode.DRIVEN:
            self._drive = None
        if mode not in POWERED and self._adoption is not None and self._adoption.trajectory_s > 0.0:
            self._adoption = None
        if mode is not Mode.TRACKING:
            self.clock.drop_next()
        self.mode, self.fault = mode, fault

    def step(self, now_ns: int) -> RobotState:
        """One control step: react, follow the goal, and report."""
        station = self.view_of_station(now_ns)
        health = Health(
            pose_age_s=self._experiment.safety.pose_hold_s + 0.05 if now_ns < self.unseen_until_ns else 0.02,
            identity_age_s=0.02,
            station_age_s=station.age_s,
            board_age_s=0.02 if self.board_works else 5.0,
            board_disarmed_s=0.0,
            battery_empty=False,
            emergency_stop=self._beat is not None and self._beat[1].emergency_stop and station.age_s < 1.0,
            solver_failed=False,
            drive_age_s=(now_ns - self._drive[1]) * 1e-9 if self._drive is not None else 0.0,
        )
        mode, reason = react(self.mode, health, self._experiment.safety)
        if mode is not self.mode:
            self._enter(mode, reason)
        self._reference = self._goal(station, now_ns)
        self._move()
        if self.test == "running" and now_ns >= self._test_until_ns:
            self.test = "passed" if self.mode is Mode.ARMED else ""
            self.passed_ns = now_ns if self.test else self.passed_ns
        adoption = self._adoption
        if adoption is not None and now_ns >= adoption.at_ns and self.clock.reached_s >= adoption.trajectory_s:
            self.tuning_id, self._ready, self._adoption = adoption.id, "", None
        return self._state(now_ns)

    def _goal(self, station: StationView, now_ns: int) -> Array:
        """Reference pose (4,) in the present mode."""
        if self.mode is Mode.TRACKING:
            follow = self.clock.goal(station, now_ns)
            return self.eta if follow is None else pose_at(follow.trajectory, follow.time_s)
        if self.mode is Mode.HOLDING:
            self._hold = self.eta.copy() if self._hold is None else self._hold
            return self._hold
        if self.mode is Mode.DRIVEN and self._drive is not None:
            surge_m = self._drive[0].surge_mps * STEP_S
            ahead: Array = self.eta + np.array([surge_m * np.cos(self.eta[3]), surge_m * np.sin(self.eta[3]), 0.0, 0.0])
            return ahead
        return self.eta

    def _move(self) -> None:
        before = self.eta
        away = self._reference[:3] - before[:3]
        far_m = float(np.sqrt(away @ away))
        share = min(1.0, self.speed_mps * STEP_S / far_m) if far_m > 0.0 else 0.0
        self.eta = np.array([*(before[:3] + share * away), self._reference[3]])
        self._speed_mps = share * far_m / STEP_S

    def _state(self, now_ns: int) -> RobotState:
        return reported_state(
            self._experiment,
            self.mode,
            self.eta,
            self._speed_mps,
            board_age_ms=20.0 if self.board_works else 5000.0,
            fault=self.fault,
            tuning_id=self.tuning_id,
            trajectory_s=self.clock.reached_s,
            trajectory_id=self.clock.id,
            thruster_test=self.test,
            control=Control(eta_reference=self._reference),
            blind="no sightings" if now_ns < self.blind_until_ns else "",
        )


@dataclass
class _OnTheWay:
    """A command on its way to a robot, or its reply on the way back."""

    command: Command
    sent_ns: int
    arrives_ns: int
    reply: Reply | None = None
    replied_ns: int = 0


@dataclass(frozen=True)
class Driving:
    """A person who drives a robot; without `lets_go` the velocities just end, as those of a page that is gone."""

    velocity: DriveVelocity
    until_ns: int
    lets_go: bool


@dataclass
class SimulatedFleet:
    """Station and robots, stepped together."""

    experiment: Experiment
    automatic: bool = False
    give_up_s: float | None = None
    obstacles: ObstacleSet = field(default_factory=ObstacleSet)  # as the localizer sees them
    now_ns: int = 1_000_000_000
    planning_ns: int = PLANNING_NS
    on_cycle: Callable[[], None] = lambda: None
    on_beat: Callable[[StationHeartbeat], None] = lambda beat: None
    on_state: Callable[[int, RobotState, bool], None] = lambda robot, state, arrives: None
    driving: dict[int, Driving] = field(default_factory=dict)  # by robot: what a person gives it now

    def __post_init__(self) -> None:
        experiment, segment = self.experiment, first_segment(self.experiment)
        self.starts = planner.start_poses(experiment, dict(segment.trajectories))
        self.robots = {r: SimulatedRobot(experiment, r, self.starts[r]) for r in experiment.robot_ids}
        tuner = GainUpdater(experiment)
        self.core = StationCore(
            experiment,
            Mission(experiment, segment, self.starts, self.automatic, self.give_up_s),
            tuner,
        )
        self.mission, self.single = self.core.mission, self.core.single
        self._states: dict[int, deque[tuple[int, int, RobotState]]] = {r: deque() for r in self.robots}
        self._newest: dict[int, tuple[int, RobotState]] = {}
        self._beats: deque[tuple[int, StationHeartbeat]] = deque(maxlen=40)
        self._beat_given: dict[int, int] = dict.fromkeys(self.robots, 0)
        self._on_the_way: list[_OnTheWay] = []
        self._planning: dict[str, tuple[PlanRequest, int]] = {}
        self.fleet: Mapping[int, RobotView] = self._views()

    def run(self, seconds: float) -> None:
        """Step for so long."""
        for _ in range(max(round(seconds / STEP_S), 1)):
            self.step()

    def step(self) -> None:
        """One period of everything."""
        self.now_ns += STEP_NS
        now_ns = self.now_ns
        for robot in self.robots.values():
            if robot.alive:
                self._to_robot(robot)
                state = robot.step(now_ns)
                arrives = now_ns >= robot.radio.mute_until_ns
                if arrives:
                    self._states[robot.id].append((now_ns + robot.radio.delay_ns, now_ns, state))
                self.on_state(robot.id, state, arrives)
        self.fleet, answers = self._views(), self._answers()
        for robot_id, drive in list(self.driving.items()):
            if now_ns < drive.until_ns or drive.lets_go:
                velocity = drive.velocity if now_ns < drive.until_ns else DriveVelocity()
                self.core.drive(robot_id, velocity, self.fleet, now_ns)
            if now_ns >= drive.until_ns:
                del self.driving[robot_id]
        self._plan()
        commands = self.core.step(self.fleet, answers, now_ns, self.obstacles)
        self._plan()
        self.core.follow(self.fleet, answers)
        self._send(commands)
        pace = self.mission.governor
        stopped = self.mission.state is MissionState.STOPPED
        out = tuple(sorted(self.mission.roster.out))
        beat = StationHeartbeat(
            self.experiment.hash, stopped, self.mission.state.name, pace.lag_s, 1.0 - pace.rate, tuple(self.robots), "", out
        )
        self._beats.append((now_ns, beat))
        self.on_beat(beat)
        self.on_cycle()

    def seen_at(self, now_ns: int) -> Mapping[int, RobotView]:
        """The fleet as the station sees it between two cycles."""
        cycle_ns, self.now_ns = self.now_ns, now_ns
        try:
            return self._views()
        finally:
            self.now_ns = cycle_ns

    def reach(self, robot: int) -> bool:
        """True if robot and station hear one another."""
        radio = self.robots[robot].radio
        return self.robots[robot].alive and self.now_ns >= max(radio.deaf_until_ns, radio.mute_until_ns)

    # --- the network

    def _to_robot(self, robot: SimulatedRobot) -> None:
        """Deliver heartbeats and commands that arrive now."""
        now_ns, radio = self.now_ns, robot.radio
        if now_ns >= radio.deaf_until_ns:
            for stamp_ns, beat in self._beats:
                if self._beat_given[robot.id] < stamp_ns <= now_ns - radio.delay_ns:
                    robot.hear(stamp_ns, beat)
                    self._beat_given[robot.id] = stamp_ns
        for way in self._on_the_way:
            if way.command.robot == robot.id and way.reply is None and way.arrives_ns <= now_ns:
                if now_ns >= radio.deaf_until_ns:
                    reply = robot.obey(way.sent_ns, way.command, now_ns)
                    lost = now_ns < radio.mute_until_ns
                    way.reply = replace(reply, accepted=False, reason="no answer", silent=True) if lost else reply
                    way.replied_ns = way.sent_ns + ORDER_TIMEOUT_NS if lost else now_ns + radio.delay_ns
                else:
                    way.arrives_ns = way.sent_ns + 10 * ORDER_TIMEOUT_NS  # never

    def _send(self, commands: Sequence[Command]) -> None:
        for command in commands:
            same = [w for w in self._on_the_way if w.command.robot == command.robot and w.command.order is command.order]
            if len(same) < MAX_UNANSWERED:
                radio = self.robots[command.robot].radio
                self._on_the_way.append(_OnTheWay(command, self.now_ns, self.now_ns + radio.delay_ns))

    def _answers(self) -> list[CommandResult]:
        answers, left = [], []
        for way in self._on_the_way:
            if way.reply is not None and way.replied_ns <= self.now_ns:
                answers.append(CommandResult(way.command, way.reply))
            elif self.now_ns - way.sent_ns >= ORDER_TIMEOUT_NS:
                answers.append(CommandResult(way.command, Reply(way.command.robot, False, "no answer", silent=True)))
            else:
                left.append(way)
        self._on_the_way = left
        return answers

    def _views(self) -> dict[int, RobotView]:
        views = {}
        for robot, arriving in self._states.items():
            while arriving and arriving[0][0] <= self.now_ns:
                _, stamp_ns, state = arriving.popleft()
                self._newest[robot] = stamp_ns, state
            if robot in self._newest:
                stamp_ns, state = self._newest[robot]
                foreign = self.now_ns < self.robots[robot].foreign_until_ns
                age_s = (self.now_ns - stamp_ns) * 1e-9
                view = RobotView(state, age_s, POSE, 0.02, 0.02, two_pose_senders=foreign)
                views[robot] = self.core.view(robot, view, self.now_ns)
            else:
                views[robot] = self.core.view(robot, RobotView(), self.now_ns)
        return views

    def _plan(self) -> None:
        """Compute plans; the outcome comes a little later, if it is still waited for. Any error but PlanError is a bug."""
        for owner, wanted in self.core.plan_requests():
            if wanted is None:
                self._planning.pop(owner, None)
                continue
            request, since_ns = self._planning.setdefault(owner, (wanted, self.now_ns))
            if request is not wanted:
                self._planning[owner] = wanted, self.now_ns
            elif self.now_ns - since_ns >= self.planning_ns:
                del self._planning[owner]
                outcome: PlanSegment | PlanError
                try:
                    outcome = wanted.plan()
                except PlanError as error:
                    outcome = error
                self.core.planned(owner, outcome, self.fleet, self.now_ns)


def armed(robot: SimulatedRobot) -> bool:
    """True if a robot may put out thrust."""
    return robot.alive and robot.mode in LIVE

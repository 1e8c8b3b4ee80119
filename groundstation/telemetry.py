"""Telemetry of the robots as the station hears it, and their health: ONE list of checks for preflight, flight and alarms.

Pure, but for the inboxes, which the bus fills.
"""

import math
from collections import deque
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from shoal.bus.bus import Bus, Inbox
from shoal.config.experiment import Experiment
from shoal.frames import Array
from shoal.messages import topics
from shoal.messages.codec import Header
from shoal.messages.messages import Estimate, LocalizerStatus, Mode, Obstacles, Plan, Pose, RobotState, Solve, Track
from shoal.runtime.runtime import Clock, age_s
from shoal.runtime.version import are_known

LOSSY = 0.2  # share of lost messages; above it echoes, battery voltages and poses are too old
LATE_SHARE = 0.5  # of the control period: the budget of a step
DEPTH_SLACK_M = 0.3  # a pressure sensor that reads further than this outside the basin is wrong
OUT_OF_STEP_S = 0.5  # from the fleet's timetable: at 0.25 m/s a robot is then 0.13 m from its place among the others
CLOSE_M = 0.01  # of slack: plans that enter another robot's space by less are not reported
DEPLOY = "give both the same code: groundstation deploy"
LINK_WINDOW = 100  # messages: 5 s at 20 Hz


@dataclass(frozen=True)
class RobotView:
    """Newest messages of one robot with their ages in s; infinity: never heard."""

    state: RobotState | None = None
    state_age_s: float = float("inf")
    pose: Pose | None = None
    pose_age_s: float = float("inf")
    plan_age_s: float = float("inf")
    clock_offset_s: float = 0.0  # of the robot's clock from the station's
    loss: float = 0.0  # share of its last messages that did not arrive
    behind_s: float = 0.0  # lag behind the fleet's timetable (groundstation/mission/timetable.py)
    other_gains: bool = False  # it has other gains than the fleet
    other_code: str = ""  # it runs other code than the station: which, in words
    two_pose_senders: bool = False  # two programs publish its poses by turns
    localizer_hash: str = ""  # of the experiment that its poses rest on; empty: not told
    out: bool = False  # a person took it out of the water

    @property
    def mode(self) -> Mode | None:
        """Mode as last heard; None: never heard."""
        return self.state.mode if self.state is not None else None

    @property
    def heard(self) -> bool:
        """True if its state is fresh."""
        return self.state is not None and self.state_age_s <= topics.STATE.max_age_s

    @property
    def trajectory_s(self) -> float:
        """Progress along its trajectory in s, from its own state."""
        return self.state.trajectory_s if self.state is not None else 0.0

    @property
    def error_m(self) -> float:
        """Distance from its reference in m; 0 while it does not fly."""
        if self.state is None or self.mode is not Mode.TRACKING:
            return 0.0
        return self.state.error_m or 0.0

    @property
    def speed_mps(self) -> float:
        """Speed over the floor."""
        return float(np.linalg.norm(self._estimate.nu[:3])) if self._estimate is not None else 0.0

    @property
    def _estimate(self) -> Estimate | None:
        return self.state.estimate if self.state is not None else None

    @property
    def is_located(self) -> bool:
        """True if anything is known of its place."""
        return self._estimate is not None or self.pose is not None

    @property
    def eta(self) -> Array:
        """Best known pose (4,): the robot's own estimate if it is heard, else the localizer's pose, else its last estimate.
        Zeros for a robot that is not located."""
        if self._estimate is not None and (self.heard or self.pose is None):
            return self._estimate.eta
        if self.pose is not None:
            return np.array([self.pose.x_m, self.pose.y_m, self.pose.depth_m, self.pose.yaw_rad])
        return np.zeros(4)

    @property
    def rest(self) -> Array:
        """Pose (4,) in which it rests: the place that it holds, or its pose if it holds none."""
        if self.state is not None and self.mode is Mode.HOLDING and self.state.control is not None:
            return np.array([*self.state.control.eta_reference[:3], self.eta[3]])
        return self.eta


Fleet = Mapping[int, RobotView]


def other_code(other: str, own: str) -> str:
    """Text about a program that does not surely run the code of the station, `own`; empty if it does. `other` is what its
    messages say, "" of an earlier version."""
    if not are_known(other, own):
        return f"runs {other or 'an earlier version'}, the station {own}: nobody knows whether that is the same"
    return f"runs {other or 'an earlier version'}, the station {own}" if other != own else ""


@dataclass
class LinkMonitor:
    """Link loss and clock offset of one robot, from the headers of its last LINK_WINDOW states."""

    headers: deque[tuple[int, int, float]] = field(default_factory=lambda: deque(maxlen=LINK_WINDOW))

    def add(self, headers: Sequence[Header], newest: Header, instant_ns: int) -> None:
        """Take in headers, oldest first, also known ones: several may arrive between two calls. The state with header `newest`
        was true at `instant_ns` on our clock, as far as we can tell."""
        for header in headers:
            if self.headers and self.headers[-1][0] != header.session:
                self.headers.clear()
            if not self.headers or header.sequence > self.headers[-1][1]:
                ahead_s = (header.stamp_ns - instant_ns) * 1e-9 if header == newest else -math.inf
                self.headers.append((header.session, header.sequence, ahead_s))

    @property
    def loss(self) -> float:
        """Share of the sequence numbers that did not arrive."""
        if len(self.headers) < 2:
            return 0.0
        return max(0.0, 1.0 - (len(self.headers) - 1) / (self.headers[-1][1] - self.headers[0][1]))

    @property
    def clock_offset_s(self) -> float:
        """Offset of the robot's clock in s. Messages are late, never early: the one with the least delay counts."""
        ahead_s = max([ahead_s for _, _, ahead_s in self.headers], default=-math.inf)
        return ahead_s if ahead_s > -math.inf else 0.0


@dataclass(frozen=True, eq=False)
class FleetInboxes:
    """Newest messages of the fleet: one inbox a topic, or one a robot. One set for the process; mission and page read it."""

    states: dict[int, Inbox[RobotState]]
    poses: dict[int, Inbox[Pose]]
    plans: dict[int, Inbox[Plan]]
    localizer: Inbox[LocalizerStatus]
    obstacles: Inbox[Obstacles]

    def view(self, robot: int, link: LinkMonitor, clock: Clock) -> RobotView:
        """View of a robot now; ages by the process's clock. Takes its last states into `link`."""
        state, pose, plan = self.states[robot].newest(), self.poses[robot].newest(), self.plans[robot].newest()
        localizer = self.localizer.newest()
        if state is not None:
            link.add(self.states[robot].headers(), state.header, clock.instant_ns(state))
        return RobotView(
            state.message if state else None,
            age_s(clock, state) if state else float("inf"),
            pose.message if pose else None,
            age_s(clock, pose) if pose else float("inf"),
            age_s(clock, plan) if plan else float("inf"),
            link.clock_offset_s,
            link.loss,
            two_pose_senders=self.poses[robot].has_two_senders(),
            localizer_hash=localizer.message.experiment_hash if localizer is not None else "",
        )


def subscribe_fleet(bus: Bus, robots: tuple[int, ...]) -> FleetInboxes:
    """Open inboxes that fill from now on."""
    return FleetInboxes(
        bus.inboxes(topics.STATE, RobotState, robots),
        bus.inboxes(topics.POSE, Pose, robots),
        bus.inboxes(topics.PLAN, Plan, robots),
        bus.inbox(topics.LOCALIZER, LocalizerStatus),
        bus.inbox(topics.OBSTACLES, Obstacles),
    )


class Problem(NamedTuple):
    """A failed check. `level`: critical, warning, notice (as an alarm)."""

    key: str
    level: str
    text: str
    remedy: str = ""
    blocks_arming: bool = False


@dataclass(frozen=True)
class Finding:
    """A failed check of one robot, with the fields of `Problem`."""

    robot: int
    key: str
    level: str
    text: str
    remedy: str
    blocks_arming: bool

    @property
    def message(self) -> str:
        """Text and remedy."""
        return f"{self.text} ({self.remedy})" if self.remedy else self.text


def findings(experiment: Experiment, robot: int, view: RobotView, start: Array | None = None) -> tuple[Finding, ...]:
    """Failed checks of one robot. `start`: the pose (4,) in which it should begin; None once it has begun."""
    state = view.state
    if view.out:
        return (
            Finding(robot, *Problem("out", "notice", "out of the water", f"groundstation mission back-in --robot {robot}")),
        )
    if state is None or not view.heard:
        has_state = state is not None
        text = f"not heard for {view.state_age_s:.1f} s" if has_state else "not heard"
        level = "critical" if has_state else "warning"
        remedy = f"start its agent (robot-agent run ... --robot {robot})"
        return (Finding(robot, *Problem("silent", level, text, remedy, blocks_arming=True)),)
    problems = [problem for check in CHECKS for problem in check(experiment, view, state)]
    if start is not None:
        problems += _start(experiment, state, start)
    return tuple(Finding(robot, *problem) for problem in problems)


def _experiment(experiment: Experiment, view: RobotView, state: RobotState) -> Iterator[Problem]:
    """Findings about the agent's experiment and code: others than the station's."""
    if state.experiment_hash != experiment.hash:
        text = f"has another experiment ({state.experiment_hash[:8]}, here {experiment.hash[:8]})"
        same = "start its agent with this run's experiment.toml"
        yield Problem("experiment", "critical", text, DEPLOY if view.other_code else same, blocks_arming=True)
    if view.other_code:
        yield Problem("code", "warning", view.other_code, DEPLOY)


def _pose_senders(experiment: Experiment, view: RobotView, state: RobotState) -> Iterator[Problem]:
    """Findings that keep every robot from flying: its poses may be another robot's, or those of a camera that hangs
    elsewhere."""
    if view.localizer_hash not in ("", experiment.hash):
        text = f"its poses are by another experiment ({view.localizer_hash[:8]}, here {experiment.hash[:8]})"
        yield Problem("localizer", "critical", text, "start the localizer with this run's experiment.toml", blocks_arming=True)
    if view.two_pose_senders:
        remedy = "end one: a localizer, or a simulator that was left running"
        yield Problem("poses", "critical", "two programs publish its poses by turns", remedy, blocks_arming=True)


def foreign_poses(experiment: Experiment, fleet: Fleet, robots: Sequence[int]) -> str:
    """The first of these robots whose poses may be another robot's or camera's, with the reason and the remedy; empty if there
    is none."""
    for robot in robots:
        view = fleet[robot]
        problem = None if view.state is None else next(_pose_senders(experiment, view, view.state), None)
        if problem is not None:
            return f"robot {robot}: {problem.text} ({problem.remedy})"
    return ""


def silent_sightings(experiment: Experiment, fleet: Fleet) -> dict[int, tuple[float, float]]:
    """Places x, y of the robots whose plans no longer come, and which the camera sees."""
    pose_limit_s, plan_limit_s = (topic.max_age_in(experiment.safety) for topic in (topics.POSE, topics.PLAN))
    return {
        robot: (view.pose.x_m, view.pose.y_m)
        for robot, view in fleet.items()
        if plan_limit_s < view.plan_age_s < math.inf and view.pose_age_s <= pose_limit_s and not view.two_pose_senders
        and view.pose is not None and view.pose.track >= Track.KCF
    }  # fmt: skip


def blind_robots(experiment: Experiment, fleet: Fleet, robots: Sequence[int]) -> str:
    """Those of these robots that cannot tell whether obstacles are there, with the reason of the first; empty if there are
    none, or if they may fly all the same (mission.blind)."""
    reasons = {r: state.blind for r in robots if (state := fleet[r].state) is not None and state.blind}
    if not reasons or experiment.mission.blind != "hold":
        return ""
    return f"robot{'s' if len(reasons) > 1 else ''} {', '.join(map(str, reasons))} blind: {next(iter(reasons.values()))}"


def _pose(experiment: Experiment, view: RobotView, state: RobotState) -> Iterator[Problem]:
    """Findings about the robot's newest pose: old, lost, or of an unverified marker."""
    pose, limit_s = view.pose, topics.POSE.max_age_in(experiment.safety)
    if pose is None or view.pose_age_s > limit_s:
        age = "none yet" if pose is None else f"{view.pose_age_s:.1f} s old"
        yield Problem(
            "pose",
            "warning",
            f"no fresh pose ({age})",
            "is the localizer running, the robot in the picture?",
            blocks_arming=True,
        )
    elif pose.track < Track.KCF:
        yield Problem(
            "pose",
            "warning",
            f"pose is {pose.track.name}",
            "move it where the camera sees it; look for glare",
            blocks_arming=True,
        )
    elif experiment.localizer.markers and not pose.identity_verified:
        yield Problem(
            "identity",
            "warning",
            f"pose is {pose.track.name}, identity not verified",
            "let the camera see its marker",
            blocks_arming=True,
        )


def _board(experiment: Experiment, view: RobotView, state: RobotState) -> Iterator[Problem]:
    """Findings about the thruster board: silence, lost messages, depth, battery."""
    age_ms, board = state.timing.board_age_ms, state.board
    if board is None or age_ms is None:
        yield Problem("board", "critical", "thruster board not heard", "check its cable and power", blocks_arming=True)
        return
    if age_ms > topics.STATE.max_age_s * 1e3:
        yield Problem(
            "board",
            "critical",
            f"thruster board silent for {age_ms * 1e-3:.1f} s",
            "check its cable and power",
            blocks_arming=True,
        )
        return
    if board.loss > LOSSY:
        text = f"{board.loss:.0%} of the board's messages are lost"
        yield Problem("loss", "warning", text, "check the cable between computer and board", blocks_arming=True)
    depth_m = experiment.pool.size_m[2]
    if experiment.pool.walls and not -DEPTH_SLACK_M <= board.depth_m <= depth_m + DEPTH_SLACK_M:
        text = f"depth {board.depth_m:.2f} m in a basin of {depth_m:g} m"
        yield Problem("depth", "warning", text, "check its pressure sensor, or its zero", blocks_arming=True)
    battery = experiment.vehicle.battery
    if board.battery_v <= 0.0:  # the default: the board tells its voltage a second after its first word
        yield Problem(
            "battery", "warning", "battery not heard yet", "wait a second; if it lasts, check the board", blocks_arming=True
        )
    elif board.battery_v < battery.no_arm_v:
        text = f"battery {board.battery_v:.1f} V, needs {battery.no_arm_v:.1f} V"
        yield Problem("battery", "critical", text, "charge it", blocks_arming=True)
    elif board.battery_v < battery.warn_v:
        yield Problem("battery", "warning", f"battery {board.battery_v:.1f} V", "charge it soon")


def _link(experiment: Experiment, view: RobotView, state: RobotState) -> Iterator[Problem]:
    """Findings about the radio link: lost messages, and a clock that is off."""
    if view.loss > LOSSY:
        yield Problem(
            "link", "warning", f"{view.loss:.0%} of its messages are lost", "check the radio link", blocks_arming=True
        )
    limit_ms, offset_s = experiment.mission.clock_offset_ms, view.clock_offset_s
    if abs(offset_s) > limit_ms * 1e-3:
        how = "ahead of" if offset_s > 0 else "behind"
        text = f"its clock is {abs(offset_s) * 1e3:.0f} ms {how} the station's"
        yield Problem(
            "clock",
            "notice",
            text,
            f"synchronise both (chrony), and start its agent again; allowed: {limit_ms:g} ms",
            blocks_arming=True,
        )


def _mode(experiment: Experiment, view: RobotView, state: RobotState) -> Iterator[Problem]:
    """Findings about the robot's own state: stopped, in trouble, an old plan, thrusters not tested."""
    if state.mode in (Mode.STOPPED, Mode.FAULT):
        remedy = "clear the stop" if state.mode is Mode.STOPPED else "disarm it, and look for the cause"
        yield Problem("mode", "critical", f"{state.mode.name.lower()}: {state.fault}", remedy, blocks_arming=True)
    elif state.fault:
        yield Problem("fault", "warning", state.fault)
    flies = state.mode in (Mode.TRACKING, Mode.HOLDING, Mode.DRIVEN)
    if flies and topics.PLAN.max_age_in(experiment.safety) < view.plan_age_s < float("inf"):
        yield Problem("plan", "warning", f"its plan is {view.plan_age_s:.1f} s old", "others give it room")
    if experiment.mission.thruster_test and not flies and state.thruster_test != "passed":
        text = f"thruster test: {state.thruster_test or 'not done'}"
        yield Problem("thrusters", "notice", text, "groundstation mission test", blocks_arming=True)


def _gains(experiment: Experiment, view: RobotView, state: RobotState) -> Iterator[Problem]:
    """Finding about gains that are not the fleet's."""
    if view.other_gains:
        yield Problem(
            "gains", "warning", "has other gains than the fleet", "wait: the station gives it the fleet's", blocks_arming=True
        )


def _lag(experiment: Experiment, view: RobotView, state: RobotState) -> Iterator[Problem]:
    """Finding about a robot that is not at its place in the formation's time."""
    if abs(view.behind_s) > OUT_OF_STEP_S:
        how = "behind" if view.behind_s > 0.0 else "ahead of"
        text = f"is {abs(view.behind_s):.1f} s {how} the others"
        yield Problem("step", "critical", text, "all hold, and go on together when resumed; is its clock steady?")


def _control(experiment: Experiment, view: RobotView, state: RobotState) -> Iterator[Problem]:
    """Findings about the control step: a failed solver, a slow step, a plan too near another robot."""
    control, step_us = state.control, state.timing.step_us
    if control is not None and control.solve is Solve.FAILED:
        yield Problem("solve", "critical", "the solver failed: neutral")
    elif control is not None and control.solve is Solve.SHIFTED:
        yield Problem("solve", "notice", "an old plan is flown on")
    if step_us * 1e-6 > LATE_SHARE * experiment.controller.period_s:
        yield Problem("late", "notice", f"control step takes {step_us * 1e-3:.0f} ms")
    if control is not None and control.slack_m > CLOSE_M:
        yield Problem("close", "warning", f"its plan enters another robot's space by {control.slack_m * 1e3:.0f} mm")


def _sight(experiment: Experiment, view: RobotView, state: RobotState) -> Iterator[Problem]:
    """Finding about a robot that is not told of obstacles."""
    if state.blind:
        remedy = "is the localizer running? It learns anew by itself, in some seconds, when light and camera stay as they are"
        yield Problem("blind", "warning", f"blind: {state.blind}", remedy, blocks_arming=experiment.mission.blind == "hold")


CHECKS: tuple[Callable[[Experiment, RobotView, RobotState], Iterator[Problem]], ...] = (
    _mode, _experiment, _board, _pose_senders, _pose, _sight, _link, _gains, _lag, _control,
)  # fmt: skip


def _start(experiment: Experiment, state: RobotState, start: Array) -> Iterator[Problem]:
    """Finding about a robot that is away from the pose in which it should begin."""
    if state.estimate is None:
        return
    away_m = float(np.hypot(*(state.estimate.eta[:2] - start[:2])))
    age_ms = state.timing.pose_age_ms
    fresh = age_ms is not None and age_ms <= topics.POSE.max_age_in(experiment.safety) * 1e3
    if fresh and away_m > experiment.mission.start_within_m:
        text = f"is {away_m:.2f} m from its start ({start[0]:.2f}, {start[1]:.2f}) m"
        yield Problem(
            "start", "notice", text, "bring it there, or Return to start (groundstation mission return)", blocks_arming=True
        )


def blocking_findings(
    experiment: Experiment, fleet: Fleet, starts: Mapping[int, Array] | None = None, exclude: Sequence[str] = ()
) -> tuple[Finding, ...]:
    """Findings that keep the robots in `fleet` from being armed, without the keys in `exclude`; empty if they are ready."""
    return tuple(
        finding
        for robot in experiment.robot_ids
        if robot in fleet
        for finding in findings(experiment, robot, fleet[robot], starts[robot] if starts is not None else None)
        if finding.blocks_arming and finding.key not in exclude
    )


def preflight(
    experiment: Experiment, fleet: Fleet, starts: Mapping[int, Array] | None = None, exclude: Sequence[str] = ()
) -> tuple[str, ...]:
    """Messages of `blocking_findings`, each with its robot."""
    return tuple(
        f"robot {finding.robot}: {finding.message}" for finding in blocking_findings(experiment, fleet, starts, exclude)
    )


def first_lost_robot(robots: Sequence[int], fleet: Fleet, still_to_arm: Container[int] = ()) -> tuple[int, str] | None:
    """First of these robots that is lost to a running mission, and the reason; None while none is. Robots in `still_to_arm`
    may be disarmed."""
    for robot in robots:
        mode, state = fleet[robot].mode, fleet[robot].state
        if not fleet[robot].heard or state is None or mode is None:
            return robot, "silent"
        if mode in (Mode.STOPPED, Mode.FAULT) or (mode is Mode.DISARMED and robot not in still_to_arm):
            return robot, f"{mode.name.lower()}{f' ({state.fault})' if state.fault else ''}"
    return None

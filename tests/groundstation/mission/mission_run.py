"""A mission with robots that do as they are told, stepped by hand."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from groundstation.mission.command_dispatcher import CommandResult
from groundstation.mission.mission import Mission
from groundstation.mission.objections import LIVE
from groundstation.mission.state_machine import MissionState
from groundstation.planning.segment import PlanSegment
from groundstation.telemetry import RobotView
from shoal.config.experiment import Experiment, load_experiment
from shoal.messages.messages import (
    Command,
    CommandKind,
    Control,
    Mode,
    Pose,
    Reply,
    Track,
    Trajectory,
)
from tests.groundstation.mission.reported_state import reported_state

STEP_NS = 50_000_000


@dataclass
class ObedientRobot:
    """Obeys at once unless told to refuse; tells its state when asked."""

    experiment: Experiment
    mode: Mode = Mode.DISARMED
    loaded: str = ""
    loaded_next: str = ""  # under way
    refuses: frozenset[CommandKind] = frozenset()
    silent: bool = False
    hears: bool = False  # also when silent: nothing that it says arrives
    unknown: bool = False
    test: str = ""
    tuning_id: str = ""
    eta: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    holds_at: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    surge_mps: float = 0.0
    age_s: float = 0.02
    fault: str = ""
    trajectory_s: float = 0.0
    starts_at_ns: int = 0
    battery_v: float = 12.0
    verified: bool = True
    blind: str = ""
    localizer_hash: str = ""  # of the experiment of the localizer whose poses it gets
    two_pose_senders: bool = False
    got: list[Command] = field(default_factory=list)

    def obey(self, command: Command, now_ns: int) -> Reply:
        self.got.append(command)
        unheard = self.silent or self.unknown
        if (unheard and not self.hears) or command.order in self.refuses:
            return Reply(command.robot, False, "no answer" if unheard else "I refuse", silent=unheard)
        if command.order is CommandKind.HOLD and self.mode not in LIVE:
            return Reply(command.robot, False, "HOLD is not accepted")
        leads = {
            CommandKind.ARM: Mode.ARMED,
            CommandKind.START: Mode.TRACKING,
            CommandKind.HOLD: Mode.HOLDING,
            CommandKind.RESUME: Mode.TRACKING,
            CommandKind.DISARM: Mode.DISARMED,
            CommandKind.STOP: Mode.STOPPED,
            CommandKind.CLEAR_STOP: Mode.DISARMED,
            CommandKind.DRIVE: Mode.DRIVEN,
        }
        if command.order is CommandKind.LOAD:
            assert command.trajectory is not None
            if self.mode is Mode.TRACKING:
                self.loaded_next = command.trajectory.id
            else:
                self.loaded, self.trajectory_s = command.trajectory.id, command.trajectory.begin_s
        if command.order is CommandKind.SWITCH and self.loaded_next == command.trajectory_id:
            self.loaded = command.trajectory_id
        self.mode = leads.get(command.order, self.mode)
        if command.order in (CommandKind.START, CommandKind.RESUME):
            self.trajectory_s = command.trajectory_s + max(now_ns - command.start_ns, 0) * 1e-9
            self.starts_at_ns = command.start_ns
        return Reply(command.robot, not unheard, "no answer" if unheard else "", silent=unheard)

    def view(self) -> RobotView:
        pose = Pose(0, 0, 0, np.eye(3), Track.MARKER, self.verified)
        control = Control(eta_reference=np.array(self.holds_at)) if self.mode is Mode.HOLDING else Control()
        state = reported_state(
            self.experiment,
            self.mode,
            self.eta,
            self.surge_mps,
            self.battery_v,
            fault=self.fault,
            trajectory_id=self.loaded,
            trajectory_s=self.trajectory_s,
            thruster_test=self.test,
            tuning_id=self.tuning_id,
            blind=self.blind,
            control=control if self.mode in LIVE else None,
        )
        if self.unknown:
            return RobotView()
        age_s = 9.0 if self.silent else self.age_s
        return RobotView(
            state, age_s, pose, 0.02, two_pose_senders=self.two_pose_senders, localizer_hash=self.localizer_hash
        )  # fmt: skip


class MissionRun:
    """A mission and its robots, stepped together."""

    def __init__(self, automatic: bool = True, settings: Sequence[str] = (), give_up_s: float | None = None) -> None:
        self.experiment = load_experiment("pool", ["duration_s=2", *settings])
        two = np.zeros((2, 4))
        trajectories = {r: Trajectory(f"t{r}", 0.05, two, two, two) for r in self.experiment.robot_ids}
        starts = dict.fromkeys(self.experiment.robot_ids, np.zeros(4))
        segment = PlanSegment(trajectories, trajectories[1], self.experiment.duration_s)
        self.mission = Mission(self.experiment, segment, starts, automatic, give_up_s)
        self.robots = {r: ObedientRobot(self.experiment) for r in self.experiment.robot_ids}
        self.now_ns = 0
        self.answers: list[CommandResult] = []
        self.states: list[MissionState] = []

    def fleet(self) -> dict[int, RobotView]:
        return {r: robot.view() for r, robot in self.robots.items()}

    def at(self, state: MissionState) -> bool:
        return self.mission.state is state

    def in_mode(self, robot: int, mode: Mode) -> bool:
        return self.robots[robot].mode is mode

    def step(self, seconds: float = 0.05) -> None:
        for _ in range(round(seconds / 0.05)):
            self.now_ns += STEP_NS
            commands = self.mission.step(self.fleet(), self.answers, self.now_ns)
            self.answers = [CommandResult(c, self.robots[c.robot].obey(c, self.now_ns)) for c in commands]
            for robot in self.robots.values():
                if robot.mode is Mode.TRACKING and self.now_ns >= robot.starts_at_ns and not robot.silent:
                    robot.trajectory_s += 0.05
            if not self.states or self.states[-1] is not self.mission.state:
                self.states.append(self.mission.state)

"""Gains changed together, or not at all: the station's side, against robots that obey, refuse, forget or say nothing."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise

import pytest

from groundstation.mission.command_dispatcher import RETRY_S, CommandResult
from groundstation.mission.gain_update import AGAIN_S, PATIENCE_S, GainStage, GainUpdater
from groundstation.mission.lap_statistics import FlownLaps
from groundstation.mission.timetable import START_IN_S
from groundstation.telemetry import RobotView
from shoal.config.experiment import load_experiment
from shoal.messages.messages import Command, CommandKind, Mode, Reply, RobotState

EXPERIMENT = load_experiment("pool", ["path.lap_s=25", "duration_s=100"])
LAPS = FlownLaps(25.0, end_s=100.0)
KEY, VALUE = "controller.nmpc.turning_m", 0.2
STEP_S = 0.05


@dataclass
class GainRobot:
    """Keeps what it is told and flies with it at the instant that it is told, unless it is told to misbehave."""

    tuning_id: str
    mode: Mode = Mode.TRACKING
    in_reach: bool = True
    late_s: float = 0.02  # its states
    trajectory_s: float = 10.0
    refuses: frozenset[CommandKind] = frozenset()
    mute: frozenset[CommandKind] = frozenset()  # the order does not arrive
    forgets: bool = False  # accepts, and does not change over
    ready: str = ""
    adopts_at_s: float = float("inf")
    got: list[tuple[float, Command]] = field(default_factory=list)

    def obey(self, command: Command, now_s: float) -> Reply:
        self.got.append((now_s, command))
        if command.order in self.mute:
            return Reply(command.robot, False, "whatever a bus may say of silence", silent=True)
        if command.order in self.refuses:
            return Reply(command.robot, False, "no answer that I like")  # the words are no verdict
        if command.order is CommandKind.TUNE:
            self.ready = command.tuning_id
        elif not self.forgets:
            self.adopts_at_s = now_s + command.start_in_s
            if command.trajectory_s > self.trajectory_s:
                self.adopts_at_s += command.trajectory_s - self.trajectory_s - command.start_in_s
        return Reply(command.robot, True)

    def move(self, now_s: float) -> None:
        if now_s >= self.adopts_at_s - 1e-9:
            self.tuning_id, self.adopts_at_s = self.ready, float("inf")

    def view(self) -> RobotView:
        state = RobotState(
            mode=self.mode, tuning_id=self.tuning_id, experiment_hash=EXPERIMENT.hash, trajectory_s=self.trajectory_s
        )
        return RobotView(state, self.late_s if self.in_reach else 9.0)


class TunedFleet:
    """Two robots and the tuner, stepped together."""

    def __init__(self) -> None:
        self.tuner = GainUpdater(EXPERIMENT)
        self.first = self.tuner.status().flown.id
        self.robots = {r: GainRobot(self.first) for r in EXPERIMENT.robot_ids}
        self.now_s = 100.0
        self.answers: list[CommandResult] = []

    def views(self) -> dict[int, RobotView]:
        return {r: robot.view() for r, robot in self.robots.items()}

    def step(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.now_s += STEP_S
            commands = self.tuner.step(self.views(), self.answers, round(self.now_s * 1e9))
            self.answers = [CommandResult(c, self.robots[c.robot].obey(c, self.now_s)) for c in commands]
            for robot in self.robots.values():
                robot.move(self.now_s)
                robot.trajectory_s += STEP_S if robot.mode is Mode.TRACKING else 0.0

    def request(self, value: float = VALUE, next_lap: bool = False) -> str:
        views = self.views()
        flying = {r: view.state for r, view in views.items() if view.state is not None and view.mode is Mode.TRACKING}
        return self.tuner.request({KEY: value}, views, round(self.now_s * 1e9), flying, LAPS if next_lap else None)

    def undo(self) -> str:
        return self.tuner.undo(self.views(), round(self.now_s * 1e9))

    @property
    def flown(self) -> set[str]:
        return {robot.tuning_id for robot in self.robots.values()}

    def orders(self, robot: int = 2) -> list[CommandKind]:
        return [command.order for _, command in self.robots[robot].got]


def test_all_check_then_all_change_over_at_one_instant() -> None:
    fleet = TunedFleet()
    assert fleet.request() == ""
    wanted = fleet.tuner.status().wanted
    fleet.step(1.0)
    assert fleet.flown == {wanted}
    status = fleet.tuner.status()
    assert (status.stage, status.flown.id, status.reason, status.undo) == (GainStage.IDLE, wanted, "", True)
    assert fleet.orders() == [CommandKind.TUNE, CommandKind.ADOPT]
    assert [t.id for t in fleet.tuner.take_unlogged()] == [fleet.first, wanted]
    assert fleet.tuner.take_unlogged() == []


def test_an_instant_that_one_robot_hears_of_late_is_the_same_instant() -> None:
    fleet = TunedFleet()
    fleet.robots[2].mute = frozenset({CommandKind.ADOPT})
    fleet.request()
    fleet.step(0.3)
    fleet.robots[2].mute = frozenset()
    fleet.step(0.3)
    times = {r: {t + c.start_in_s for t, c in robot.got if c.order is CommandKind.ADOPT} for r, robot in fleet.robots.items()}
    instants = sorted(times[1] | times[2])
    assert len(times[2]) == 2
    assert instants[-1] - instants[0] < 1e-6


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda r: replace(r, refuses=frozenset({CommandKind.TUNE})), "robot 2 refuses: no answer that I like; nothing"),
        (lambda r: replace(r, mute=frozenset({CommandKind.TUNE})), "robot 2 does not answer; nothing was changed"),
        (lambda r: replace(r, refuses=frozenset({CommandKind.ADOPT})), "robot 2 refuses: no answer that I like; the others"),
        (lambda r: replace(r, mute=frozenset({CommandKind.ADOPT})), "robot 2 does not answer; the others go back"),
        (lambda r: replace(r, forgets=True), "robot 2 did not change over; the others go back"),
    ],
    ids=[
        "refuses the check",
        "never checks",
        "refuses to change over",
        "never hears when",
        "accepts and does not change over",
    ],
)
def test_a_robot_that_does_not_follow_leaves_all_with_the_gains_before(
    spoil: Callable[[GainRobot], GainRobot], reason: str
) -> None:
    fleet = TunedFleet()
    fleet.robots[2] = spoil(fleet.robots[2])
    assert fleet.request() == ""
    fleet.step(5 * PATIENCE_S)
    status = fleet.tuner.status()
    assert status.reason.startswith(reason), status.reason
    assert status.stage is GainStage.IDLE
    assert status.flown.id == fleet.first
    assert fleet.robots[1].tuning_id == fleet.first
    assert not status.undo


def test_the_change_back_that_is_not_followed_either_says_that_gains_may_differ() -> None:
    fleet = TunedFleet()
    fleet.robots[2].forgets = True
    fleet.request()
    fleet.step(1.0)
    fleet.robots[1].mute = frozenset({CommandKind.TUNE, CommandKind.ADOPT})
    fleet.step(3 * (PATIENCE_S + START_IN_S))
    assert fleet.tuner.status().reason == "robot 1 does not answer; the fleet's gains may differ"


def test_an_unanswered_command_is_sent_again_after_its_period() -> None:
    fleet = TunedFleet()
    fleet.robots[2].mute = frozenset({CommandKind.TUNE})
    fleet.request()
    fleet.step(PATIENCE_S)
    times = [t for t, c in fleet.robots[2].got if c.order is CommandKind.TUNE]
    assert min(b - a for a, b in pairwise(times)) >= RETRY_S - 1e-6
    assert len(times) >= 0.8 * PATIENCE_S / RETRY_S
    assert len([c for _, c in fleet.robots[1].got if c.order is CommandKind.TUNE]) == 1  # who has answered is left alone


def test_gains_for_the_next_lap_wait_for_it_and_can_be_cancelled() -> None:
    fleet = TunedFleet()
    assert fleet.request(next_lap=True) == ""
    fleet.step(1.0)
    assert fleet.tuner.status().stage is GainStage.WAITING
    assert {c.trajectory_s for _, c in fleet.robots[1].got if c.order is CommandKind.ADOPT} == {25.0}
    fleet.step(1.0)
    assert fleet.flown == {fleet.first}
    assert fleet.undo() == ""
    fleet.step(1.0)
    assert (fleet.tuner.status().stage, fleet.flown) == (GainStage.IDLE, {fleet.first})


def test_a_robot_that_leaves_the_run_before_the_lap_begins_ends_the_change() -> None:
    fleet = TunedFleet()
    fleet.request(next_lap=True)
    fleet.step(1.0)
    fleet.robots[2].mode = Mode.FAULT
    fleet.step(1.0)
    assert fleet.tuner.status().reason.startswith("robot 2 left the run before the lap began")


@pytest.mark.parametrize(
    ("progress_s", "mode", "reason"),
    [
        (99.0, Mode.TRACKING, "there is no next lap: the run ends with this one"),
        (10.0, Mode.HOLDING, "there is no next lap: not every robot is on its trajectory"),
    ],
)
def test_gains_for_a_next_lap_that_never_comes_are_refused(progress_s: float, mode: Mode, reason: str) -> None:
    fleet = TunedFleet()
    fleet.robots[2] = replace(fleet.robots[2], trajectory_s=progress_s, mode=mode)
    assert fleet.request(next_lap=True) == reason
    assert fleet.tuner.status().stage is GainStage.IDLE


@pytest.mark.parametrize(("before_s", "lap"), [(START_IN_S + 0.1, 1), (START_IN_S - 0.1, 2)])
def test_a_lap_that_begins_before_the_robots_can_change_is_not_the_next_one(before_s: float, lap: int) -> None:
    fleet = TunedFleet()
    begins_s = LAPS.next_s(fleet.robots[1].trajectory_s)
    for number in fleet.robots:
        fleet.robots[number] = replace(fleet.robots[number], trajectory_s=begins_s - before_s)
    assert LAPS.lap_s is not None and fleet.request(next_lap=True) == ""
    fleet.step(0.3)
    at_s = {command.trajectory_s for _, command in fleet.robots[2].got if command.order is CommandKind.ADOPT}
    assert at_s == {begins_s + (lap - 1) * LAPS.lap_s}


def test_a_path_without_laps_has_no_next_one() -> None:
    assert GainUpdater(EXPERIMENT).request({KEY: VALUE}, {}, 0, {}, FlownLaps(None)) == "this path has no laps"


def test_wishes_that_cannot_be() -> None:
    fleet = TunedFleet()
    assert fleet.undo() == "there is nothing to undo"
    assert KEY in fleet.request(-1.0)
    assert fleet.request(EXPERIMENT.controller.nmpc.turning_m) == "this is what is flown already"
    assert fleet.request() == ""
    assert fleet.request(0.3) == fleet.undo() == "another change is under way: robots check the gains"
    fleet.step(1.0)
    fleet.robots[2].in_reach = False
    assert fleet.request(0.3) == "robot 2 is not heard"


def test_undo_goes_back_a_set_at_a_time() -> None:
    fleet, ids = TunedFleet(), []
    for value in (0.2, 0.3):
        fleet.request(value)
        fleet.step(1.0)
        ids.append(fleet.tuner.status().flown.id)
    for expected in (ids[0], fleet.first):
        assert fleet.undo() == ""
        fleet.step(1.0)
        assert fleet.flown == {expected}
    assert fleet.undo() == "there is nothing to undo"


@pytest.mark.parametrize(("mode", "taken"), [(Mode.DISARMED, True), (Mode.HOLDING, True), (Mode.STOPPED, False)])
def test_a_robot_that_comes_back_gets_the_gains_of_the_fleet(mode: Mode, taken: bool) -> None:
    fleet = TunedFleet()
    fleet.request()
    fleet.step(1.0)
    fleet.robots[2].tuning_id, fleet.robots[2].mode = fleet.first, mode
    fleet.step(AGAIN_S + 1.5)
    assert (fleet.flown == {fleet.tuner.status().flown.id}) is taken


def test_a_robot_whose_states_come_late_gets_the_gains_of_the_fleet() -> None:
    """Its request waits for it: the station does not call it heard, and its states come."""
    fleet = TunedFleet()
    fleet.request()
    fleet.step(1.0)
    fleet.robots[2].tuning_id, fleet.robots[2].late_s = fleet.first, 0.35
    assert not fleet.views()[2].heard
    fleet.step(AGAIN_S + 1.5)
    assert fleet.flown == {fleet.tuner.status().flown.id}


def test_a_robot_outside_the_formation_that_does_not_answer_keeps_no_change_waiting() -> None:
    """It is heard, with other gains, and no command reaches it."""
    fleet = TunedFleet()
    fleet.robots[2].tuning_id, fleet.robots[2].mute = "other", frozenset({CommandKind.TUNE})
    fleet.step(3.0)
    assert CommandKind.TUNE in fleet.orders(2)
    formation = {1: fleet.views()[1]}
    assert fleet.tuner.request({KEY: VALUE}, formation, round(fleet.now_s * 1e9), {}) == ""
    wanted = fleet.tuner.status().wanted
    fleet.step(2.0)
    assert fleet.robots[1].tuning_id == wanted == fleet.tuner.status().flown.id


def test_a_late_reply_about_another_gain_set_is_ignored() -> None:
    fleet = TunedFleet()
    fleet.request()
    fleet.step(STEP_S)
    wrong = CommandResult(Command(CommandKind.TUNE, 2, tuning_id="another"), Reply(2, False, "I cannot"))
    fleet.answers.append(wrong)
    fleet.step(1.0)
    assert fleet.flown == {fleet.tuner.status().flown.id} != {fleet.first}


def test_a_change_for_the_next_lap_ends_when_a_robot_falls_silent() -> None:
    fleet = TunedFleet()
    fleet.request(next_lap=True)
    fleet.step(1.0)
    fleet.robots[2].in_reach = False
    fleet.step(PATIENCE_S + 12.0)
    assert fleet.tuner.status().reason.startswith("robot 2 left the run before the lap began")
    assert fleet.tuner.status().stage is GainStage.IDLE
    assert fleet.robots[1].tuning_id == fleet.first


def test_a_change_for_the_next_lap_ends_when_one_robot_never_begins_it() -> None:
    fleet = TunedFleet()
    fleet.request(next_lap=True)
    fleet.step(1.0)
    # its clock stands, the lap of the other begins
    fleet.robots[2].mode, fleet.robots[2].adopts_at_s = Mode.HOLDING, float("inf")
    fleet.step(15.0 + PATIENCE_S + 3.0)
    assert "robot 2 did not change over with the lap" in fleet.tuner.status().reason
    assert fleet.flown == {fleet.first}

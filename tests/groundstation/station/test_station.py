"""The station takes stops and replies at once, drops outdated plans, and ends only when every robot is at rest."""

import errno
import logging
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer

from groundstation.client import gains_command
from groundstation.formation_clock import named_alone
from groundstation.logs.recorder import Recorder
from groundstation.mission.command_dispatcher import RETRY_S
from groundstation.mission.gain_update import GainUpdater
from groundstation.mission.mission import Mission
from groundstation.mission.plan_manager import FlownPath, PlanRequest
from groundstation.mission.roster import LED, TAKEN_OUT, Leader
from groundstation.mission.single_robot import RobotTask
from groundstation.mission.state_machine import MissionState
from groundstation.planning import planner
from groundstation.planning.feasibility import PlanError
from groundstation.planning.segment import PlanSegment, first_segment
from groundstation.station import process
from groundstation.station.station import COMMAND_KINDS, MAX_UNANSWERED, OVERTAKEN, Station, workers
from groundstation.telemetry import DEPLOY, Finding, RobotView, findings, subscribe_fleet
from groundstation.web.alarms import alarms
from groundstation.web.backend import Validity
from shoal.bus.access_control import INSECURE
from shoal.bus.bus import HELD_UP, Bus, Inbox, Received
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import Experiment, dump_experiment, load_experiment, with_flight
from shoal.config.scene import read_form
from shoal.messages import topics
from shoal.messages.codec import Header
from shoal.messages.messages import (
    WHOLE_FLEET,
    BoardReading,
    CameraHealth,
    Command,
    CommandKind,
    DriveVelocity,
    Estimate,
    FaultRequest,
    LocalizerStatus,
    Mode,
    Outcome,
    Plan,
    Pose,
    Progress,
    Reply,
    RobotState,
    StationHeartbeat,
    StepTiming,
    Track,
    Trajectory,
    Tuning,
    required,
)
from shoal.runtime.runtime import Stop, WallClock, run_steps, wait
from shoal.runtime.version import code
from sim_bridge.lockstep.clock import LockstepClock
from tests.groundstation.mission.mission_run import ObedientRobot
from tests.waiting import eventually

FRESH = StepTiming(board_age_ms=20.0)
pytestmark = pytest.mark.real_time

PERIOD_S = 0.125
PATIENCE_S = 20.0
TRIES = 5


def next_beat_ns(bus: Bus, stop: Stop, beats: Inbox[StationHeartbeat]) -> int:
    """Stamp of the next heartbeat."""
    previous = beats.newest_header()
    assert wait(bus, stop, lambda: beats.newest_header() is not previous, PATIENCE_S)
    header = beats.newest_header()
    assert header is not None
    return header.stamp_ns


@contextmanager
def a_station(folder: Path, hub: MemoryHub | None = None) -> Iterator[Station]:
    """Alone on its bus, unless there is a hub with others."""
    experiment = load_experiment("pool")
    segment, bus = first_segment(experiment), Bus(MemoryTransport(hub or MemoryHub()))
    starts = planner.start_poses(experiment, segment.trajectories)
    recorder, tuner = Recorder(folder / "run.mcap", "", {}), GainUpdater(experiment)
    with workers(len(experiment.robot_ids)) as threads:
        yield Station(
            experiment, bus, WallClock(), recorder, Mission(experiment, segment, starts, False), tuner,
            subscribe_fleet(bus, experiment.robot_ids), threads,
        )  # fmt: skip
    recorder.close()


@pytest.mark.parametrize(
    ("kind", "level", "text"),
    [
        ("warning", logging.WARNING, "pictures are not recorded any longer"),
        ("error", logging.ERROR, "log stopped: No space left on device (errno 28)"),
    ],
)
def test_a_recorders_trouble_is_told_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, kind: str, level: int, text: str
) -> None:
    monkeypatch.setattr(Recorder, kind, text)
    with a_station(tmp_path) as station, caplog.at_level(logging.WARNING, "shoal"):
        for _ in range(3):
            station.cycle(station.clock.now_ns())
    lines = [(record.levelno, record.message) for record in caplog.records if record.message.startswith("recorder: ")]
    assert lines == [(level, f"recorder: {text}")]


def test_a_radio_breaks_only_where_the_simulator_owns_time(tmp_path: Path) -> None:
    """By the wall clock the simulator cannot do it, so the request is refused and not told as done."""
    hub = MemoryHub()
    with a_station(tmp_path, hub) as station:
        station.bus.watch_presence()
        Bus(MemoryTransport(hub)).announce("sim-bridge")
        assert eventually(lambda: "sim-bridge" in station.bus.present)
        refusal, number = station.request(CommandKind.FAULT, text="radio 1 dead")
        assert "without --real-time" in refusal and number == 0
        asked_for = Bus(MemoryTransport(hub)).inbox(topics.FAULT, FaultRequest)
        assert station.request(CommandKind.FAULT, text="thruster 1/3 dead for 5")[0] == ""
        received = asked_for.newest()
        assert received is not None and (received.message.what, received.message.for_s) == ("thruster 1/3 dead", 5.0)
        station.clock = LockstepClock()
        assert station.request(CommandKind.FAULT, text="radio 1 dead")[0] == ""


@pytest.mark.parametrize(("why", "level"), [(LED, logging.INFO), (TAKEN_OUT, logging.INFO), ("not heard", logging.WARNING)])
def test_a_formation_without_a_robot_that_a_person_took_is_no_fault_of_the_run(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, why: str, level: int
) -> None:
    """The report counts warnings as faults: a flight in which a person drove a robot would have failed for it."""
    caplog.set_level("INFO", "shoal")
    hub = MemoryHub()
    with a_station(tmp_path, hub) as station:
        fleet = ObedientFleet(hub, station.experiment)
        fleet.modes = {1: Mode.TRACKING, 2: Mode.HOLDING}
        station.mission.state = MissionState.RUNNING
        station.mission.roster.mark_lost(2, why)
        fleet.until(station, lambda: station.mission.state is MissionState.DEGRADED)
        station.cycle(station.clock.now_ns())
        lines = {record.levelno for record in caplog.records if record.message.startswith("mission: running without a robot")}
        assert lines == {level}


def test_the_heartbeat_tells_when_the_flight_began(tmp_path: Path) -> None:
    """Terminals, scripts and the recorded run count their time from it."""
    hub = MemoryHub()
    with a_station(tmp_path, hub) as station:
        beats = Bus(MemoryTransport(hub)).inbox(topics.HEARTBEAT, StationHeartbeat)
        station.mission.began_ns = 1_234_000_000
        station.cycle(station.clock.now_ns())
        received = beats.newest()
        assert received is not None and received.message.began_ns == 1_234_000_000


def test_the_heartbeat_says_of_the_mission_what_others_act_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hub = MemoryHub()
    with a_station(tmp_path, hub) as station:
        others = Bus(MemoryTransport(hub))
        beats = others.inbox(topics.HEARTBEAT, StationHeartbeat)

        def beat() -> StationHeartbeat:
            station.cycle(station.clock.now_ns())
            received = beats.newest()
            assert received is not None
            return received.message

        first = beat()
        assert (first.experiment_hash, first.code, first.emergency_stop) == (station.experiment.hash, station.code, False)
        assert (first.mission, first.lag_s, first.slowing, first.planned, first.out) == ("WAITING", 0.0, 0.0, (), ())
        assert (first.flight_s, first.other_path) == (station.mission.segment.end_s, False)
        others.publish(topics.STATE, RobotState(estimate=Estimate()), station.clock.now_ns(), 2)
        others.publish(topics.STATE, RobotState(), station.clock.now_ns(), 1)
        assert station.request(CommandKind.OUT, only=1)[0] == ""
        station.mission.governor.lag_s, station.mission.governor.rate = 1.5, 0.75
        monkeypatch.setattr(station.mission.governor, "step", lambda *_: None)
        station.mission.plans.segment = replace(station.mission.segment, is_return=True)
        second = beat()
        assert (second.lag_s, second.slowing, second.planned, second.out, second.flight_s) == (1.5, 0.25, (2,), (1,), 0.0)
        assert station.request(CommandKind.STOP)[0] == ""
        third = beat()
        assert third.emergency_stop and third.mission == "STOPPED"


def test_a_terminal_changes_gains_or_goes_back_to_those_of_before(tmp_path: Path) -> None:
    with a_station(tmp_path) as station:
        station.cycle(station.clock.now_ns())
        for changes, says in (
            ([], "there is nothing to undo"),
            (["controller.nmpc.heading_m=0.02"], "robot 1, 2 is not heard"),
        ):
            reply = station.on_operator_command(Header(5, 1, 0), gains_command(changes))
            assert (reply.accepted, reply.reason, reply.outcome) == (False, says, None)


def test_nothing_breaks_where_nobody_simulates(tmp_path: Path) -> None:
    with a_station(tmp_path) as station:
        for text, says in (("thruster 1/3 dead", "nothing here is simulated"), ("rudder 1 lost", "cannot be broken")):
            reason, number = station.request(CommandKind.FAULT, text=text)
            assert says in reason and number == 0
        assert "no robot 7" in station.drive(7, DriveVelocity(surge_mps=0.1))


def test_an_outdated_plan_is_dropped(tmp_path: Path) -> None:
    """A detour was being planned when a person sent everybody home."""
    late = threading.Event()
    with a_station(tmp_path) as station:
        mission, detour = station.mission, station.mission.segment
        home = replace(detour, is_return=True)

        def slow(out_of_time: Callable[[], bool]) -> PlanSegment:
            late.wait(PATIENCE_S)
            return detour

        mission.state, mission.plans.request = MissionState.HALTING, PlanRequest("another path", slow)
        station.plan(0)
        mission.plans.request = PlanRequest("a way for everybody from rest", lambda out_of_time: home)
        late.set()
        deadline = time.monotonic() + PATIENCE_S
        while mission.state is MissionState.HALTING and time.monotonic() < deadline:
            station.plan(0)
            time.sleep(0.001)
        assert mission.state is MissionState.RELOADING
        assert mission.segment is home


def test_a_plan_that_nobody_waits_for_any_more_is_given_up(tmp_path: Path) -> None:
    """The next one waits until it has ended: robots would hold for as long."""
    over: list[bool] = []
    with a_station(tmp_path) as station:
        mission, detour = station.mission, station.mission.segment

        def slow(out_of_time: Callable[[], bool]) -> PlanSegment:
            over.append(eventually(out_of_time, 5.0))
            return detour

        def taken() -> bool:
            station.plan(0)
            return mission.state is MissionState.RELOADING

        mission.state, mission.plans.request = MissionState.HALTING, PlanRequest("another path", slow)
        station.plan(0)
        home = replace(detour, is_return=True)
        mission.plans.request = PlanRequest("a way for everybody from rest", lambda out_of_time: home)
        assert eventually(taken)
        assert over == [True] and mission.segment is home


def test_planning_is_given_up_in_time_and_when_the_station_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In lockstep only when the station ends: there a plan must not depend on the machine."""
    deadlines, over = list[Callable[[], bool]](), list[bool]()

    def plan(out_of_time: Callable[[], bool]) -> PlanSegment:
        deadlines.append(out_of_time)
        over.append(out_of_time())
        return station.mission.segment

    def taken() -> bool:
        station.plan(0)
        return not station.planning

    with a_station(tmp_path) as station:
        station.views = station.fleet()
        for clock, limit_s in ((WallClock(), 3600.0), (WallClock(), 0.0), (LockstepClock(), 0.0)):
            monkeypatch.setattr("groundstation.station.station.PLANNING_S", limit_s)
            station.mission.state, station.mission.plans.request = MissionState.HALTING, PlanRequest("another path", plan)
            with station.lock:
                station.clock = clock
                station.plan(0)
            assert eventually(taken)
        assert over == [False, True, False]
    assert all(out_of_time() for out_of_time in deadlines)


def test_a_planner_that_breaks_leaves_the_fleet_holding_and_the_station_alive(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with a_station(tmp_path) as station:
        mission = station.mission
        station.views = station.fleet()
        mission.state, mission.plans.request = (
            MissionState.HALTING,
            PlanRequest("another path", lambda out_of_time: dict[str, PlanSegment]()["robot 3"]),
        )
        with station.lock:
            station.clock = LockstepClock()
            station.plan(0)
        assert mission.state is MissionState.PAUSED
        assert "KeyError: 'robot 3'" in mission.reason
    assert any(record.exc_info and record.message == "planning failed" for record in caplog.records), "where it broke"


def test_in_lockstep_a_stop_is_taken_while_a_plan_is_computed(tmp_path: Path) -> None:
    """And the plan, which nobody waits for any more, is dropped."""
    begun, late = threading.Event(), threading.Event()
    with a_station(tmp_path) as station:
        station.views, station.clock = station.fleet(), LockstepClock()
        mission, detour = station.mission, station.mission.segment

        def slow(out_of_time: Callable[[], bool]) -> PlanSegment:
            begun.set()
            late.wait(PATIENCE_S)
            return detour

        def cycle() -> None:
            with station.lock:
                station.plan(0)

        mission.state, mission.plans.request = MissionState.HALTING, PlanRequest("another path", slow)
        planning = threading.Thread(target=cycle)
        planning.start()
        assert begun.wait(PATIENCE_S)
        reason, _ = station.request(CommandKind.STOP)
        assert (reason, planning.is_alive()) == ("", True)
        late.set()
        planning.join(PATIENCE_S)
        assert mission.state is MissionState.STOPPED


def test_in_lockstep_a_plan_that_another_request_replaced_meanwhile_is_dropped(tmp_path: Path) -> None:
    with a_station(tmp_path) as station:
        station.clock = LockstepClock()
        mission, detour = station.mission, station.mission.segment
        home = PlanRequest("a way for everybody from rest", lambda out_of_time: replace(detour, is_return=True))

        def slow(out_of_time: Callable[[], bool]) -> PlanSegment:
            with station.lock:  # as a request takes it
                mission.plans.request = home
            return replace(detour, is_return=False)

        mission.state, mission.plans.request = MissionState.HALTING, PlanRequest("another path", slow)
        with station.lock:
            station.plan(0)
            assert (mission.state, mission.plan_request) == (MissionState.HALTING, home)
            station.plan(0)
        assert (mission.state, mission.segment.is_return) == (MissionState.RELOADING, True)


class ObedientFleet:
    """Robots on the station's bus that do as they are told, and tell a state when they are asked to."""

    def __init__(self, hub: MemoryHub, experiment: Experiment) -> None:
        self.bus, self.experiment = Bus(MemoryTransport(hub)), experiment
        self.modes = dict.fromkeys(experiment.robot_ids, Mode.DISARMED)
        self.got: list[tuple[int, CommandKind]] = []
        for robot in experiment.robot_ids:
            self.bus.serve(robot, lambda header, command: self.obey(command))

    def obey(self, command: Command) -> Reply:
        self.got.append((command.robot, command.order))
        self.modes[command.robot] = LEADS.get(command.order, self.modes[command.robot])
        return Reply(command.robot, True, mode=self.modes[command.robot])

    def tell(self) -> None:
        for robot, mode in self.modes.items():
            state = RobotState(
                mode=mode,
                experiment_hash=self.experiment.hash,
                board=BoardReading(battery_v=12.0),
                timing=FRESH,
            )
            self.bus.publish(topics.STATE, state, time.time_ns(), robot)

    def until(self, station: Station, done: Callable[[], bool]) -> None:
        """Cycle after cycle, at the station's own pace."""
        deadline = time.monotonic() + PATIENCE_S
        while not done():
            assert time.monotonic() < deadline, (self.got, station.requests.recent)
            self.tell()
            station.cycle(station.clock.now_ns())
            time.sleep(0.002)

    def until_heard(self, station: Station) -> None:
        """Cycle until the station has heard both robots."""
        self.until(station, lambda: len(station.views) == 2 and all(view.heard for view in station.views.values()))


def tell_until(fleet: ObedientFleet, over: threading.Event) -> None:
    while not over.wait(0.02):
        fleet.tell()


def end_by_interruption(station: Station, stop: Stop, fleet: ObedientFleet) -> None:
    """Tell a station to end as Ctrl-C does, and run it to its end while the fleet goes on telling its state."""
    stop.request(interrupted=True)
    over, sender = threading.Event(), threading.Thread(target=lambda: tell_until(fleet, over))
    sender.start()
    try:
        # the loop alone: `cycles` around it needs a network and a page
        process._wall_loop(station, stop, process.EndOfRun(station, None))  # private: `run` begins with a whole fleet
    finally:
        over.set()
        sender.join()


LEADS = {
    CommandKind.ARM: Mode.ARMED,
    CommandKind.HOLD: Mode.HOLDING,
    CommandKind.STOP: Mode.STOPPED,
    CommandKind.CLEAR_STOP: Mode.DISARMED,
    CommandKind.DISARM: Mode.DISARMED,
}


def asked(station: Station, order: CommandKind) -> int:
    reason, number = station.request(order)
    assert reason == ""
    return number


def outcome(station: Station, number: int) -> Outcome:
    """As a terminal asks for it."""
    reply = station.on_operator_command(Header(9, 1, 0), Command(CommandKind.NONE, WHOLE_FLEET, about=number))
    assert reply.accepted and reply.outcome is not None
    return reply.outcome


def test_a_stop_reaches_the_robots_while_all_other_threads_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A plan that takes long, and robots that do not answer what they were asked before. The first stops are lost on their
    way: to send others, the station has to notice that these are not answered."""
    hub, free, lost = MemoryHub(), threading.Event(), list[int]()
    with a_station(tmp_path, hub) as station:
        fleet, send = ObedientFleet(hub, station.experiment), station.bus.send_command

        def lossy(command: Command, stamp_ns: int, timeout_s: float, to: int | None = None) -> Callable[[], Reply]:
            if command.order is CommandKind.STOP and lost.count(command.robot) < MAX_UNANSWERED:
                lost.append(command.robot)
                return lambda: Reply(command.robot, False, silent=True)
            return send(command, stamp_ns, timeout_s, to)

        monkeypatch.setattr(station.bus, "send_command", lossy)
        safe = (CommandKind.STOP, CommandKind.DISARM, CommandKind.HOLD)
        assert {station.workers.of(order) for order in CommandKind if order not in safe}.isdisjoint(
            map(station.workers.of, safe)
        )
        for threads in (station.workers.orders, station.workers.plans):
            for _ in range(2 * MAX_UNANSWERED * COMMAND_KINDS * len(station.experiment.robot_ids)):
                threads.submit(free.wait, PATIENCE_S)
        try:
            number = asked(station, CommandKind.STOP)
            fleet.until(station, lambda: outcome(station, number).progress is Progress.DONE)
            assert outcome(station, number).confirmed == (1, 2)
            assert not free.is_set()
        finally:
            free.set()


def test_an_order_that_is_not_answered_is_on_its_way_twice_at_most(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However long a robot says nothing: what is asked then, a stop for example, waits for none of them."""
    free, out, timeouts_s = threading.Event(), [], set()

    def silent(command: Command, stamp_ns: int, timeout_s: float, to: int | None = None) -> Callable[[], Reply]:
        out.append(command.order)
        timeouts_s.add(timeout_s)

        def reply() -> Reply:
            free.wait(PATIENCE_S)
            return Reply(command.robot, False, silent=True)

        return reply

    with a_station(tmp_path) as station:
        monkeypatch.setattr(station.bus, "send_command", silent)
        try:
            asked(station, CommandKind.STOP)
            for k in range(100):
                station.cycle(k * 1_000_000_000)  # each would ask anew
            assert len(station.pending) == MAX_UNANSWERED * 2
        finally:
            free.set()
    assert out == [CommandKind.STOP] * MAX_UNANSWERED * 2
    assert timeouts_s == {MAX_UNANSWERED * RETRY_S}, "later, a stop would be repeated less often than every RETRY_S"


class JustAnswered(Future[Reply]):
    """A reply that comes right after one has looked whether it is there."""

    def done(self) -> bool:
        there = super().done()
        if not there:
            self.set_result(Reply(2, True))
        return there


def test_a_reply_that_comes_while_replies_are_collected_is_taken_once(tmp_path: Path) -> None:
    """A lost reply to an ARM would let a robot be armed a second time that was started again meanwhile."""
    with a_station(tmp_path) as station:
        station.pending = [(Command(CommandKind.ARM, 2), JustAnswered())]
        for k in range(3):
            station.cycle((k + 1) * 1_000_000)
        assert station.mission._powered_ns == {2: 2_000_000}  # the mission's own memory: nothing else tells it
        assert station.pending == []


def test_a_request_is_known_by_its_number_and_no_other(tmp_path: Path) -> None:
    with a_station(tmp_path) as station:
        reply = station.on_operator_command(Header(9, 1, 0), Command(CommandKind.STOP, WHOLE_FLEET))
        assert reply.accepted and reply.outcome is not None
        assert outcome(station, reply.outcome.request).order is CommandKind.STOP
        unknown = station.on_operator_command(Header(9, 2, 0), Command(CommandKind.NONE, WHOLE_FLEET, about=77))
        assert (unknown.accepted, unknown.reason) == (False, "request 77 is not known here (any more)")
        refused = station.on_operator_command(Header(9, 3, 0), Command(CommandKind.RESUME, WHOLE_FLEET))
        assert not refused.accepted and refused.outcome is None
        nothing = station.on_operator_command(Header(9, 4, 0), Command(CommandKind.NONE, WHOLE_FLEET))
        assert not nothing.accepted


def test_a_request_that_was_long_in_the_making_is_not_done_after_another(tmp_path: Path) -> None:
    with a_station(tmp_path) as station:
        begun_s = time.monotonic()
        assert station.request(CommandKind.LOAD, valid=Validity(asked_s=begun_s))[0] == ""
        reason, number = station.request(CommandKind.LOAD, valid=Validity(asked_s=begun_s))
        assert "another request was made" in reason and number == 0
        assert "another request" not in station.request(CommandKind.LOAD, valid=Validity(asked_s=time.monotonic()))[0]


class _HandClock:
    """A clock that the test sets; every sender goes by it."""

    waits = False

    def __init__(self) -> None:
        self.at_ns = 1_000_000_000

    def now_ns(self) -> int:
        return self.at_ns

    def instant_ns(self, received: Received[Any]) -> int:
        return received.header.stamp_ns

    def arrival_ns(self, stamp_ns: int) -> int:
        return self.at_ns


@pytest.mark.parametrize("another", ["request", "drive", "gains"])
def test_a_request_is_not_done_by_a_state_of_before_it_whatever_else_is_asked_before_the_next_cycle(
    tmp_path: Path, another: str
) -> None:
    """The robot holds, a person has just driven it, and that is on its way: a HOLD is to follow it."""
    hub, clock = MemoryHub(), _HandClock()
    with a_station(tmp_path, hub) as station:
        station.clock = clock
        Bus(MemoryTransport(hub)).publish(topics.STATE, RobotState(Mode.HOLDING), clock.at_ns, 1)
        station.cycle(clock.at_ns)
        clock.at_ns += 10_000_000
        reason, number = station.request(CommandKind.HOLD, only=1)
        assert reason == ""
        clock.at_ns += 30_000_000
        if another == "request":
            station.request(CommandKind.HOLD, only=2)
        elif another == "drive":
            station.drive(2, DriveVelocity(surge_mps=0.1))
        else:
            station.request_gains({"controller.nmpc.turning_m": 0.02}, next_lap=False)
        assert outcome(station, number).progress is Progress.UNDER_WAY


def test_a_stop_is_a_stop_whatever_else_the_command_carries(tmp_path: Path) -> None:
    with a_station(tmp_path) as station:
        for extra in ({"about": 1}, {"tuning": gains_command([]).tuning}):
            station.mission.state = MissionState.WAITING
            command = Command(CommandKind.STOP, WHOLE_FLEET, **extra)
            assert station.on_operator_command(Header(9, 1, 0), command).accepted
            assert station.mission.state is MissionState.STOPPED


def test_a_draft_is_planned_as_its_request_would_be_and_refused_for_the_same_reason(tmp_path: Path) -> None:
    with a_station(tmp_path) as station:
        station.views = {robot: ObedientRobot(station.experiment).view() for robot in (1, 2)}
        before, text = station.mission.segment, dump_experiment(load_experiment("figure-eight", ["duration_s=40"]))
        drafted = station.draft(CommandKind.PATH, text)
        planned = first_segment(with_flight(station.experiment, text)).trajectories
        for robot, trajectory in drafted.trajectories.items():
            assert np.allclose(trajectory.eta[0, :3], station.views[robot].eta[:3], atol=1e-6)
            assert np.allclose(trajectory.eta[-1, :3], planned[robot].eta[-2, :3], atol=1e-6)  # it begins slowly
        for order, what, reason in (
            (CommandKind.PATH, dump_experiment(load_experiment("straight")), "it is for robots 1; here are 1, 2"),
            (CommandKind.FORMATION, "order 2,2", "each once"),
        ):
            with pytest.raises(PlanError, match=reason):
                station.draft(order, what)
            assert reason in station.request(order, text=what)[0]
        assert station.mission.segment is before and station.mission.plan_request is None


def test_the_heartbeat_says_that_a_person_gave_another_form_or_way(tmp_path: Path) -> None:
    """The article's figures are not for such a flight."""
    hub = MemoryHub()
    with a_station(tmp_path, hub) as station:
        beats, plans = Bus(MemoryTransport(hub)).inbox(topics.HEARTBEAT, StationHeartbeat), station.mission.plans
        reports, first = [], plans.segment
        changes = read_form("line 1.0", 0.0)[:1]
        for k, segment in enumerate((replace(first, forms=changes), replace(first, via=((0.5, 0.5),)), first)):
            plans.segment = segment
            station.cycle((k + 1) * 50_000_000)
            beat = beats.newest()
            reports.append(beat is not None and beat.message.other_path)
        assert reports == [True, True, False]


def test_the_heartbeat_says_that_another_path_than_the_experiments_is_flown(tmp_path: Path) -> None:
    hub = MemoryHub()
    with a_station(tmp_path, hub) as station:
        beats, plans = Bus(MemoryTransport(hub)).inbox(topics.HEARTBEAT, StationHeartbeat), station.mission.plans
        reports = []
        other = FlownPath(with_flight(station.experiment, dump_experiment(load_experiment("figure-eight", ["duration_s=40"]))))
        for k in range(2):
            station.cycle((k + 1) * 50_000_000)
            beat = beats.newest()
            reports.append(beat is not None and beat.message.other_path)
            plans.adopt_at_rest(other.plan(), other)
        assert reports == [False, True]


@pytest.mark.parametrize(
    ("state", "unfit", "ready"),
    [
        (MissionState.WAITING, False, True),
        (MissionState.CANCELLED, False, True),
        (MissionState.CANCELLED, True, False),
        (MissionState.RUNNING, False, False),
    ],
)
def test_the_heartbeat_says_whether_a_flight_may_begin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, state: MissionState, unfit: bool, ready: bool
) -> None:
    findings = (Finding(1, "pose", "critical", "no pose", "", blocks_arming=True),) if unfit else ()
    monkeypatch.setattr("groundstation.station.station.blocking_findings", lambda *_: findings)
    hub = MemoryHub()
    with a_station(tmp_path, hub) as station:
        beats = Bus(MemoryTransport(hub)).inbox(topics.HEARTBEAT, StationHeartbeat)
        station.mission.state = state
        monkeypatch.setattr(station.core, "step", lambda *_: ())
        station.cycle(station.clock.now_ns())
        received = beats.newest()
        assert received is not None and received.message.ready is ready


def test_the_heartbeat_says_where_the_camera_sees_a_silent_robot(tmp_path: Path) -> None:
    hub = MemoryHub()
    with a_station(tmp_path, hub) as station:
        others, clock = Bus(MemoryTransport(hub)), station.clock
        beats, row = others.inbox(topics.HEARTBEAT, StationHeartbeat), np.zeros((1, 4))

        def sightings() -> dict[int, list[float]]:
            station.cycle(clock.now_ns())
            beat = required(beats.newest()).message
            return dict(zip(beat.sightings, beat.sightings_m.tolist(), strict=True))

        def long_ago_ns() -> int:
            return clock.now_ns() - 10**10

        for robot, track in ((1, Track.MARKER), (2, Track.COAST)):  # the second is only predicted
            others.publish(topics.PLAN, Plan(0.2, row, row), long_ago_ns(), robot, age_ns=10**10)
            others.publish(topics.POSE, Pose(0.5 * robot, -0.25, 0.0, np.eye(3), track, True), clock.now_ns(), robot)
        assert sightings() == {1: [0.5, -0.25]}
        others.publish(topics.PLAN, Plan(0.2, row, row), clock.now_ns(), 1)
        assert sightings() == {}


def test_a_terminals_request_for_one_robot_is_for_that_robot_and_a_stop_for_everybody(tmp_path: Path) -> None:
    hub = MemoryHub()
    with a_station(tmp_path, hub) as station:
        fleet = ObedientFleet(hub, station.experiment)
        fleet.modes = {1: Mode.HOLDING, 2: Mode.HOLDING}
        fleet.until_heard(station)
        operator = Bus(MemoryTransport(hub))
        station.bus.serve(WHOLE_FLEET, station.on_operator_command)
        reply = operator.command(Command(CommandKind.DISARM, 2), time.time_ns(), PATIENCE_S, to=WHOLE_FLEET)
        assert reply.accepted and reply.outcome is not None, reply.reason
        number = reply.outcome.request
        fleet.until(station, lambda: outcome(station, number).progress is Progress.DONE)
        assert (outcome(station, number).confirmed, fleet.modes) == ((2,), {1: Mode.HOLDING, 2: Mode.DISARMED})
        refused = operator.command(Command(CommandKind.START, 2), time.time_ns(), PATIENCE_S, to=WHOLE_FLEET)
        assert refused.reason == "start is not for one robot (allowed: arm, hold, disarm, go, out, back-in)"
        stop = operator.command(Command(CommandKind.STOP, 2), time.time_ns(), PATIENCE_S, to=WHOLE_FLEET)
        assert stop.outcome is not None
        fleet.until(station, lambda: set(fleet.modes.values()) == {Mode.STOPPED})


def test_a_path_that_was_read_while_somebody_asked_for_something_else_is_not_flown(tmp_path: Path) -> None:
    with a_station(tmp_path, MemoryHub()) as station:
        path, asked_s = dump_experiment(load_experiment("figure-eight")), time.monotonic()
        station.request(CommandKind.HOLD)  # also one that is refused: its sender may see to the fleet by something else
        assert station.request(CommandKind.PATH, text=path, valid=Validity(asked_s=asked_s))[0] == OVERTAKEN
        assert station.request(CommandKind.PATH, text=path, valid=Validity(asked_s=time.monotonic()))[0] != OVERTAKEN


def test_a_velocity_that_came_to_its_turn_too_late_leads_no_robot(tmp_path: Path) -> None:
    hub = MemoryHub()
    with a_station(tmp_path, hub) as station:
        fleet = ObedientFleet(hub, station.experiment)
        fleet.modes = {1: Mode.HOLDING, 2: Mode.HOLDING}
        fleet.until_heard(station)
        ahead = DriveVelocity(0.1, 0.0, 0.0)
        assert station.drive(2, ahead, Validity(time.monotonic() - 0.1)) == HELD_UP
        assert not station.mission.roster.led_by_people
        assert station.drive(2, ahead, Validity(time.monotonic() + PATIENCE_S)) == ""
        assert station.mission.roster.led_by_people == {2}


def test_a_station_whose_cycle_stands_still_does_not_do_later_what_nobody_waits_for(tmp_path: Path) -> None:
    hub, begun, replies = MemoryHub(), threading.Event(), list[Reply]()
    load, gains = Command(CommandKind.LOAD, WHOLE_FLEET), Command(CommandKind.TUNE, WHOLE_FLEET, tuning=Tuning(""))
    with a_station(tmp_path, hub) as station:

        def serve(header: Header, command: Command) -> Reply:
            begun.set()
            return station.on_operator_command(header, command)

        station.bus.serve(WHOLE_FLEET, serve, expires=True)
        operator = Bus(MemoryTransport(hub))

        def ask(command: Command, timeout_s: float) -> None:
            replies.append(operator.command(command, time.monotonic_ns(), timeout_s, to=WHOLE_FLEET))

        def ask_while_it_stands(command: Command, waits_s: float) -> None:
            begun.clear()
            asking = threading.Thread(target=ask, args=(command, waits_s))
            with station.lock:
                asking.start()
                begun.wait(PATIENCE_S)
                time.sleep(waits_s)
            asking.join()

        ask(gains, PATIENCE_S)
        for command in (load, gains):
            ask_while_it_stands(command, 1.0)
        assert [reply.reason for reply in replies] == ["there is nothing to undo", HELD_UP, HELD_UP]
        assert station.mission.state is MissionState.WAITING
        ask(load, PATIENCE_S)
        ask_while_it_stands(Command(CommandKind.DISARM, WHOLE_FLEET), 0.1)
        assert [reply.accepted for reply in replies[3:]] == [True, True]


@pytest.mark.parametrize("mode", [Mode.DISARMED, Mode.TRACKING, Mode.STOPPED])
def test_a_run_is_ended_once_everybody_is_at_rest(tmp_path: Path, mode: Mode) -> None:
    hub = MemoryHub()
    with a_station(tmp_path, hub) as station:
        fleet = ObedientFleet(hub, station.experiment)
        fleet.modes = dict.fromkeys(fleet.modes, mode)
        station.mission.state = {Mode.TRACKING: MissionState.RUNNING, Mode.STOPPED: MissionState.STOPPED}.get(
            mode, MissionState.WAITING
        )
        fleet.until(station, lambda: all(view.heard for view in station.views.values()))
        number = asked(station, CommandKind.END)
        assert not station.ended
        assert station.request_gains(None, next_lap=False)[0] == "there is nothing to undo"
        station.requests.begin(CommandKind.TUNE, station.mission, station.tuner.status().flown.id)  # gains are no other end
        fleet.until(station, lambda: station.ended)
        assert outcome(station, number).progress is Progress.DONE
        assert (CommandKind.DISARM in [order for _, order in fleet.got]) is (mode is Mode.TRACKING)
        assert not any(m is Mode.TRACKING for m in fleet.modes.values())
        assert station.status().ended


def test_a_station_that_is_told_to_end_in_flight_holds_and_then_disarms(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "shoal")
    hub, stop = MemoryHub(), Stop(install=False)
    with a_station(tmp_path, hub) as station:
        fleet = ObedientFleet(hub, station.experiment)
        fleet.modes = dict.fromkeys(fleet.modes, Mode.TRACKING)
        station.mission.state = MissionState.RUNNING
        fleet.until_heard(station)
        end_by_interruption(station, stop, fleet)
        for robot in fleet.modes:
            orders = [order for of, order in fleet.got if of == robot]
            assert orders.index(CommandKind.HOLD) < orders.index(CommandKind.DISARM)
        assert set(fleet.modes.values()) == {Mode.DISARMED}
        lines = [record.message for record in caplog.records]
        told_to_end = next(k for k, line in enumerate(lines) if line.startswith("told to end while robots have power"))
        assert lines.index(process.INTERRUPTED) < told_to_end  # the report's cause is Ctrl-C, and no request that nobody made
        assert not [line for line in lines if line.endswith("asked for") or "a person asked" in line]


@pytest.mark.parametrize("state", [MissionState.LOADING, MissionState.ARMING])
def test_a_station_that_is_told_to_end_while_robots_are_being_armed_leaves_none_armed(
    tmp_path: Path, state: MissionState
) -> None:
    hub, stop = MemoryHub(), Stop(install=False)
    with a_station(tmp_path, hub) as station:
        fleet = ObedientFleet(hub, station.experiment)
        fleet.until_heard(station)
        station.mission.state = state
        end_by_interruption(station, stop, fleet)
        assert station.mission.state not in (MissionState.LOADING, MissionState.ARMING)
        orders = [order for robot, order in fleet.got if robot == 1 and order in (CommandKind.ARM, CommandKind.DISARM)]
        assert orders[-1] is CommandKind.DISARM and fleet.modes == {1: Mode.DISARMED, 2: Mode.DISARMED}


def test_an_end_disarms_the_one_robot_that_is_armed(tmp_path: Path) -> None:
    hub = MemoryHub()
    with a_station(tmp_path, hub) as station:
        fleet = ObedientFleet(hub, station.experiment)
        fleet.modes = {1: Mode.DISARMED, 2: Mode.HOLDING}
        fleet.until_heard(station)
        asked(station, CommandKind.END)
        fleet.until(station, lambda: station.ended)
        assert fleet.modes == {1: Mode.DISARMED, 2: Mode.DISARMED}


def test_an_end_replaced_by_a_start_ends_no_run(tmp_path: Path) -> None:
    hub = MemoryHub()
    with a_station(tmp_path, hub) as station:
        fleet = ObedientFleet(hub, station.experiment)
        fleet.modes = dict.fromkeys(fleet.modes, Mode.TRACKING)
        station.mission.state = MissionState.RUNNING
        fleet.until(station, lambda: all(view.heard for view in station.views.values()))
        number = asked(station, CommandKind.END)
        stop = asked(station, CommandKind.STOP)
        fleet.until(station, lambda: outcome(station, stop).progress is Progress.DONE)
        assert outcome(station, number).progress is Progress.FAILED
        assert not station.ended


def test_an_automatic_run_that_a_person_took_over_ends_only_when_it_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "IDLE_ALONE_S", 0.2)
    hub = MemoryHub()
    with a_station(tmp_path, hub) as station:
        fleet, end = ObedientFleet(hub, station.experiment), process.EndOfRun(station, None)
        fleet.modes = dict.fromkeys(fleet.modes, Mode.TRACKING)
        fleet.until(station, lambda: [view.mode for view in station.views.values()] == [Mode.TRACKING] * 2)
        station.mission.automatic, station.mission.state = True, MissionState.RUNNING
        stop = asked(station, CommandKind.STOP)
        assert not end.reached()
        time.sleep(0.3)
        assert not end.reached()  # a robot that moves is never left alone
        fleet.until(station, lambda: outcome(station, stop).progress is Progress.DONE)
        fleet.until(station, lambda: all(view.mode is Mode.STOPPED for view in station.views.values()))
        assert not end.reached()
        before_s = station.asked_s
        assert station.request_gains(None, next_lap=False)[0]  # refused, and asked for all the same
        assert station.asked_s > before_s
        fleet.until(station, end.reached)
        assert station.ended

        station.core.ended, station.mission.state = False, MissionState.DONE  # after a return to the start
        assert not process.EndOfRun(station, None).reached()
        station.core.by_hand = False  # as a person's START leaves it
        assert process.EndOfRun(station, None).reached()


def test_a_run_without_a_robot_that_is_out_of_the_water_is_left_alone_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its agent may be switched off for good: nobody can hear it."""
    monkeypatch.setattr(process, "IDLE_ALONE_S", 0.2)
    hub = MemoryHub()
    with a_station(tmp_path, hub) as station:
        fleet, end = ObedientFleet(hub, station.experiment), process.EndOfRun(station, None)
        del fleet.modes[2]
        station.mission.automatic = station.core.by_hand = True
        fleet.until(station, lambda: bool(station.views) and station.views[1].heard)
        assert not end.reached()
        time.sleep(0.3)
        assert not end.reached()  # robot 2 may be anywhere
        assert station.request(CommandKind.OUT, only=2)[0] == ""
        fleet.until(station, end.reached)


def test_status_returns_at_once_while_a_cycle_hangs(tmp_path: Path) -> None:
    with a_station(tmp_path) as station:
        station.cycle(station.clock.now_ns())
        before = station.status()
        with station.lock:  # as a cycle does
            station.beat_s -= 5.0
            hung = station.status()
        assert before.beat_age_s < 5.0 <= hung.beat_age_s
        assert hung.state is before.state
        station.cycle(station.clock.now_ns())
        assert station.status().beat_age_s < 5.0, "the cycle goes on"


def test_the_paths_flown_now_are_told_with_their_end(tmp_path: Path) -> None:
    with a_station(tmp_path) as station:
        segment = station.mission.segment
        station.publish_paths(0)
        assert station.paths == {robot: (trajectory, segment.end_s) for robot, trajectory in segment.trajectories.items()}
        short = replace(segment, end_s=3.0)
        station.mission.plans.adopt(short)
        station.mission.roster.mark_lost(2, "silent")
        station.publish_paths(0)
        assert {robot: end_s for robot, (_, end_s) in (station.paths or {}).items()} == {1: 3.0}


def test_a_trip_of_one_robot_is_published_and_then_its_path_again(tmp_path: Path) -> None:
    hub = MemoryHub()
    inboxes = Bus(MemoryTransport(hub)).inboxes(topics.TRAJECTORY, Trajectory, (1, 2))
    with a_station(tmp_path, hub) as station:
        segment = station.mission.segment
        alone = named_alone(segment.trajectories[2])
        task = RobotTask(CommandKind.GO, 0, transfer=replace(segment, trajectories={2: alone}, end_s=4.0))
        ids = []
        for leader in (Leader.MISSION, Leader.PERSON, Leader.MISSION):
            station.single.tasks[2], station.mission.roster.led_by[2] = task, leader
            station.publish_paths(0)
            newest = [inboxes[robot].newest() for robot in (1, 2)]
            ids.append([received.message.id for received in newest if received is not None])
            assert (station.paths or {})[2] == (
                (alone, 4.0) if leader is Leader.PERSON else (segment.trajectories[2], segment.end_s)
            )
        path = [segment.trajectories[robot].id for robot in (1, 2)]
        assert ids == [path, [path[0], alone.id], path]


def test_a_station_that_ends_waits_for_no_plan() -> None:
    """The reason that a plan is given to end is the only way out of this one, within the test's patience."""
    begun, ended = threading.Event(), []

    def plan(closing: threading.Event) -> None:
        begun.set()
        ended.append(closing.wait(PATIENCE_S))

    with workers(2) as threads:
        threads.plans.submit(plan, threads.closing)
        assert begun.wait(PATIENCE_S)
    assert ended == [True]


def test_a_robot_with_other_gains_than_the_fleets_is_not_armed(tmp_path: Path) -> None:
    with a_station(tmp_path) as station:
        fleets = station.tuner.status().flown.id
        for own, blocks in (("", False), (fleets, False), ("another", True)):
            view = RobotView(state=RobotState(tuning_id=own), state_age_s=0.0)
            alarms_of_robot = findings(station.experiment, 1, station.core.view(1, view, 0))
            assert any(finding.key == "gains" and finding.blocks_arming for finding in alarms_of_robot) is blocks


def test_robots_are_not_armed_by_the_poses_of_another_experiment(tmp_path: Path) -> None:
    """A localizer whose file gives the markers to other robots, or hangs the camera elsewhere, says nothing by itself: its
    poses are fresh, and as certain as any."""
    hub = MemoryHub()
    with a_station(tmp_path, hub) as station:
        fleet = Bus(MemoryTransport(hub))
        for hash_, blocks in (("0" * 64, True), (station.experiment.hash, False), ("", False)):  # the last: an earlier version
            fleet.publish(topics.LOCALIZER, LocalizerStatus(CameraHealth.OK, experiment_hash=hash_), time.time_ns())
            state = RobotState(
                experiment_hash=station.experiment.hash,
                board=BoardReading(battery_v=12.0),
                timing=FRESH,
            )
            fleet.publish(topics.STATE, state, time.time_ns(), 1)
            station.cycle(station.clock.now_ns())
            view = replace(station.status().views[1], state_age_s=0.0)
            alarms_of_robot = [f for f in findings(station.experiment, 1, view) if f.key == "localizer"]
            assert [f.blocks_arming for f in alarms_of_robot] == [True] * blocks
            if blocks:
                text = f"its poses are by another experiment (00000000, here {station.experiment.hash[:8]})"
                assert (alarms_of_robot[0].level, alarms_of_robot[0].text) == ("critical", text)


def test_a_robot_whose_poses_come_from_two_programs_is_not_armed(tmp_path: Path) -> None:
    hub = MemoryHub()
    with a_station(tmp_path, hub) as station:
        programs = Bus(MemoryTransport(hub)), Bus(MemoryTransport(hub))
        state = RobotState(experiment_hash=station.experiment.hash, board=BoardReading(battery_v=12.0), timing=FRESH)
        for number in (0, 1, 0):
            programs[number].publish(topics.POSE, Pose(0.0, 0.0, 0.0, np.eye(3), Track.MARKER, True), time.time_ns(), 1)
            programs[number].publish(topics.STATE, state, time.time_ns(), 1)
        station.cycle(station.clock.now_ns())
        views = {robot: replace(view, state_age_s=0.0) for robot, view in station.status().views.items()}
        own = {robot: [f for f in findings(station.experiment, robot, views[robot]) if f.key == "poses"] for robot in (1, 2)}
        assert [f.blocks_arming for f in own[1]] == [True] and own[2] == []


@pytest.mark.parametrize("insecure", [True, False])
def test_an_open_network_is_named_on_the_page_for_as_long_as_the_run_lasts(tmp_path: Path, insecure: bool) -> None:
    with a_station(tmp_path) as station:
        station.insecure = insecure
        for _ in range(2):
            station.cycle(station.clock.now_ns())
            assert (INSECURE in station.status().lasting.values()) is insecure


def test_programs_of_other_code_than_the_stations_are_named_on_the_page_and_in_the_log(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A robot of the same code, one of another, one of a version that did not say it, and a localizer of another."""
    hub = MemoryHub()
    with a_station(tmp_path, hub) as station, caplog.at_level(logging.WARNING, "shoal"):
        fleet, own, localizer = (
            Bus(MemoryTransport(hub)),
            code().short,
            LocalizerStatus(CameraHealth.OK, code="0.1.0 8289d898"),
        )
        for robot, its, hash_ in ((1, own, station.experiment.hash), (2, "", "0" * 64)):
            state = RobotState(experiment_hash=hash_, code=its, board=BoardReading(battery_v=12.0), timing=FRESH)
            fleet.publish(topics.STATE, state, time.time_ns(), robot)
        fleet.publish(topics.LOCALIZER, localizer, time.time_ns())
        for _ in range(2):
            station.cycle(station.clock.now_ns())
        status = station.status()
        views = {robot: replace(view, state_age_s=0.0) for robot, view in status.views.items()}  # however slow the machine is
        alarm_list = alarms(station.experiment, views, localizer, 0.0, "", status.lasting)
        ours = [alarm.line for alarm in alarm_list if alarm.key.endswith("code")]
        assert ours == [
            f"the localizer runs 0.1.0 8289d898, the station {own}", f"robot 2: runs an earlier version, the station {own}",
        ]  # fmt: skip
        remedies = {f.key: f.remedy for f in findings(station.experiment, 2, views[2])}
        assert remedies["experiment"] == remedies["code"] == DEPLOY
        log_lines = [record.getMessage() for record in caplog.records if "runs" in record.getMessage()]
        assert log_lines == [f"robot 2 runs an earlier version, the station {own} ({DEPLOY})", f"{ours[0]} ({DEPLOY})"]


def test_a_stop_does_not_wait_for_the_next_cycle(tmp_path: Path) -> None:
    experiment = load_experiment("pool", [f"controller.period_s={PERIOD_S}", "camera.rate_hz=8"])
    hub, stop = MemoryHub(), Stop(install=False)
    bus, person = Bus(MemoryTransport(hub)), Bus(MemoryTransport(hub))
    beats = person.inbox(topics.HEARTBEAT, StationHeartbeat)
    station = process.cycles(experiment, bus, tmp_path, process.StationOptions(), stop)
    thread = threading.Thread(target=run_steps, args=(station,))
    thread.start()
    gaps_s = []
    try:
        for _ in range(TRIES):  # a busy machine may take longer than a period now and then, but not every time
            before_ns = next_beat_ns(person, stop, beats)
            assert person.command(Command(CommandKind.STOP, WHOLE_FLEET), time.time_ns(), PATIENCE_S).accepted
            gaps_s.append((next_beat_ns(person, stop, beats) - before_ns) * 1e-9)
            beat = beats.newest()
            assert beat is not None and beat.message.emergency_stop
            assert beat.message.code == code().short  # what `robot-agent check` compares its own with
    finally:
        stop.request()
        thread.join()
    assert min(gaps_s) < 0.5 * PERIOD_S, gaps_s


def test_a_log_whose_end_the_disk_does_not_take_is_told_and_no_success(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def finish(_: Writer) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Writer, "finish", finish)
    experiment, stop = load_experiment("pool"), Stop(install=False)
    stop.request()
    bus = Bus(MemoryTransport(MemoryHub()))
    assert not run_steps(process.cycles(experiment, bus, tmp_path, process.StationOptions(), stop))
    lines = [record.getMessage() for record in caplog.records if record.levelno == logging.ERROR]
    assert lines == ["recorder: log stopped: No space left on device (errno 28)"]

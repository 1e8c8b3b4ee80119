"""A script makes the operator's requests, reads live states, and is told what is missing or late.

The station is played by the test, on a bus in memory.
"""

import threading
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from groundstation.mission.state_machine import FLEET_REQUESTS
from shoal import ConnectedFleet, NotHeard, RequestFailed
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import EXPERIMENTS, load_experiment, with_flight
from shoal.config.scene import Circle
from shoal.errors import ConfigError
from shoal.messages import topics
from shoal.messages.messages import (
    Command,
    CommandKind,
    Estimate,
    Event,
    Mode,
    Outcome,
    Pose,
    Progress,
    Reply,
    RobotState,
    StationHeartbeat,
    required,
)
from tests.waiting import eventually

METHODS = {"return": "return_to_start", "test": "test_thrusters"}  # the others have the requests' names


class PlayedStation:
    """Answers every request with the same reply, and notes it."""

    def __init__(self, hub: MemoryHub) -> None:
        self.bus = Bus(MemoryTransport(hub))
        self.commands: list[Command] = []
        self.reply = Reply(0, True, outcome=Outcome(1, progress=Progress.DONE, confirmed=(1, 2)))
        self.bus.serve(0, lambda header, command: self._answer(command))

    def _answer(self, command: Command) -> Reply:
        self.commands.append(command)
        return self.reply

    def says(self, text: str) -> None:
        self.bus.publish(topics.EVENT, Event(2, "groundstation", text), 0)


@pytest.fixture
def hub() -> MemoryHub:
    return MemoryHub()


@pytest.fixture
def station(hub: MemoryHub) -> PlayedStation:
    return PlayedStation(hub)


@pytest.fixture
def fleet(hub: MemoryHub, station: PlayedStation) -> Iterator[ConnectedFleet]:
    with ConnectedFleet(Bus(MemoryTransport(hub))) as connected:
        yield connected


@pytest.mark.parametrize("name", FLEET_REQUESTS)
def test_each_request_of_a_terminal_is_a_method_and_the_same_command(
    fleet: ConnectedFleet, station: PlayedStation, name: str
) -> None:
    method = METHODS.get(name, name.replace("-", "_"))
    assert getattr(fleet, method)().confirmed == (1, 2)
    assert [(c.order, c.robot) for c in station.commands] == [(CommandKind[name.upper().replace("-", "_")], 0)]


def test_another_path_is_loaded_by_name_or_file_with_settings_and_needs_no_camera(
    fleet: ConnectedFleet, station: PlayedStation, tmp_path: Path
) -> None:
    """The station gets the whole experiment as text; a bad one never leaves."""
    fleet.load("pool", {"path.lap_s": 80.0})
    table = tomllib.loads((EXPERIMENTS / "numeric.toml").read_text(encoding="utf-8"))
    del table["camera"], table["localizer"]["uses_camera"]
    (tmp_path / "lab.toml").write_text(tomli_w.dumps(table), encoding="utf-8")
    fleet.load(str(tmp_path / "lab.toml"))
    assert [c.order for c in station.commands] == [CommandKind.PATH, CommandKind.PATH]
    names, texts = ("pool", "numeric"), [c.text for c in station.commands]
    first, second = (with_flight(load_experiment(name), text) for name, text in zip(names, texts, strict=True))
    assert isinstance(first.path, Circle) and first.path.lap_s == 80.0
    assert second.path == load_experiment("numeric").path
    with pytest.raises(ConfigError, match=r"path\.lap_h: unknown key"):
        fleet.load("pool", {"path.lap_h": 80.0})
    points_m = [[k / 7, k % 2 / 3] for k in range(900)]
    many = {"path": {"kind": "waypoints", "points_m": points_m, "speed_mps": 0.1, "depth_m": 0.5}}
    with pytest.raises(ConfigError, match=r"pool: its path has \d+ characters \(allowed: 8000"):
        fleet.load("pool", many)
    assert len(station.commands) == 2


@pytest.mark.parametrize("name", ["arm", "hold", "disarm"])
def test_a_request_for_one_robot_goes_to_the_station_and_names_it(
    fleet: ConnectedFleet, station: PlayedStation, name: str
) -> None:
    getattr(fleet, name)(robot=2)
    assert [(c.order, c.robot) for c in station.commands] == [(CommandKind[name.upper()], 2)]


def test_a_mission_is_not_done_by_what_was_told_before_it_was_asked_for(fleet: ConnectedFleet, station: PlayedStation) -> None:
    """A script starts a second flight without a wait: the station still tells, and once more, that the first one is done."""

    def tell(*missions: str) -> None:
        for mission in missions:
            station.bus.publish(topics.HEARTBEAT, StationHeartbeat(mission=mission), time.time_ns())

    tell("LOADING", "RUNNING", "DONE")
    assert fleet.wait_mission("DONE", timeout_s=2.0) == "DONE"
    station.reply = Reply(0, True, outcome=Outcome(2, progress=Progress.UNDER_WAY))
    fleet.start(wait_s=0.0)
    tell("DONE")  # it was under way
    with pytest.raises(NotHeard):
        fleet.wait_mission("DONE", timeout_s=0.3)
    with pytest.raises(NotHeard):
        fleet.mission(max_age_s=0.3)
    tell("LOADING")
    assert fleet.mission() == "LOADING"
    tell("RUNNING", "DONE")
    assert fleet.wait_mission("DONE", timeout_s=2.0) == "DONE"


def test_one_robot_is_sent_to_a_place(fleet: ConnectedFleet, station: PlayedStation) -> None:
    fleet.go((1.0, -0.5), robot=2)
    assert [(c.robot, c.via.tolist()) for c in station.commands] == [(2, [[1.0, -0.5]])]


def test_places_and_gains_travel_with_the_request(fleet: ConnectedFleet, station: PlayedStation) -> None:
    fleet.go((1.0, -0.5), (2.0, 0.0))
    fleet.set_gains({"controller.mpc.q_formation": [0.3, 0.3, 0.3, 0.3]})
    go, tune = station.commands
    assert go.via.tolist() == [[1.0, -0.5], [2.0, 0.0]]
    assert tune.tuning is not None and tune.tuning.values.tolist() == [0.3, 0.3, 0.3, 0.3]


def test_a_request_without_numbers_never_reaches_the_station(fleet: ConnectedFleet, station: PlayedStation) -> None:
    for places in ((), ((1.0, float("nan")),)):
        with pytest.raises(ValueError, match="no places"):
            fleet.go(*places)
    with pytest.raises(ConfigError):
        fleet.set_gains({"controller.mpc.q_formation": "much"})
    assert station.commands == []


def test_a_failed_or_refused_request_raises_with_the_reason_of_each_robot(
    fleet: ConnectedFleet, station: PlayedStation
) -> None:
    station.reply = Reply(0, False, "START is not possible when STOPPED")
    with pytest.raises(RequestFailed, match="start: refused: START is not possible"):
        fleet.start()
    missing = Outcome(1, progress=Progress.FAILED, confirmed=(1,), waiting=(2,), why=("not heard",))
    station.reply = Reply(0, True, outcome=missing)
    with pytest.raises(RequestFailed, match="robot 2: not heard") as failed:
        fleet.stop()
    assert failed.value.outcome is not None and failed.value.outcome.confirmed == (1,)


def test_a_request_that_does_not_wait_returns_when_it_is_taken(fleet: ConnectedFleet, station: PlayedStation) -> None:
    station.reply = Reply(0, True, outcome=Outcome(1))
    assert fleet.start(wait_s=0.0).progress is Progress.UNDER_WAY
    with pytest.raises(RequestFailed, match=r"not done within 0\.1 s"):
        fleet.start(wait_s=0.1)


def test_live_states_are_the_newest_and_a_silent_robot_is_told(fleet: ConnectedFleet, station: PlayedStation) -> None:
    for x_m in (1.0, 2.0):
        station.bus.publish(
            topics.STATE, RobotState(Mode.TRACKING, estimate=Estimate(eta=np.array([x_m, 0.0, 0.0, 0.0]))), 0, robot=3
        )
    station.bus.publish(topics.POSE, Pose(0.5, 0.25, 0.0), 0, robot=3)
    assert (required(fleet.state(3).estimate).eta[0], fleet.pose(3).y_m) == (2.0, 0.25)
    with pytest.raises(NotHeard, match="robot 4: no state"):
        fleet.state(4, max_age_s=0.05)
    with pytest.raises(NotHeard, match="robot 50: no such robot"):
        fleet.state(50)
    with pytest.raises(NotHeard, match="robot 3: no state of the last 0 s"):
        fleet.state(3, max_age_s=0.0)
    station.bus.publish(topics.HEARTBEAT, StationHeartbeat(mission="RUNNING"), 0)  # a clock that stands
    assert fleet.mission() == "RUNNING"


def test_the_robots_of_a_new_connection_are_those_that_are_heard_soon(fleet: ConnectedFleet, station: PlayedStation) -> None:
    """Not those that happened to say something before the question. One that fell silent is not heard."""
    over = threading.Event()

    def speak() -> None:
        while not over.wait(0.1):
            station.bus.publish(topics.STATE, RobotState(), time.time_ns(), robot=3)

    robot = threading.Thread(target=speak)
    robot.start()
    try:
        assert fleet.robots == (3,)
    finally:
        over.set()
        robot.join()
    assert eventually(lambda: fleet.robots == (), 60.0)


def test_waiting_ends_with_the_event_the_state_or_the_time(
    fleet: ConnectedFleet, station: PlayedStation, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("groundstation.scripting.fleet.FRESH_S", 60.0)
    station.says("robot 1 is armed")
    station.says("mission: waiting for the fleet: robot 2: not heard")
    station.bus.publish(topics.HEARTBEAT, StationHeartbeat(mission="WAITING"), 10**18)
    assert fleet.wait_event("armed", timeout_s=1.0).source == "groundstation"
    with pytest.raises(NotHeard, match="robot 2: not heard"):
        fleet.wait_ready(timeout_s=0.05)
    for mission in ("CANCELLED", "WAITING"):  # a flight may begin from both
        station.bus.publish(topics.HEARTBEAT, StationHeartbeat(mission=mission), 10**18)
        with pytest.raises(NotHeard):
            fleet.wait_ready(timeout_s=0.05)
        station.bus.publish(topics.HEARTBEAT, StationHeartbeat(mission=mission, ready=True), 10**18)
        fleet.wait_ready(timeout_s=1.0)
    with pytest.raises(NotHeard, match="no event with 'landed'"):
        fleet.wait_event("landed", timeout_s=0.05)
    with pytest.raises(NotHeard, match="it is WAITING"):
        fleet.wait_mission("DONE", timeout_s=0.05)
    station.bus.publish(topics.HEARTBEAT, StationHeartbeat(mission="DONE"), 10**18)
    assert fleet.wait_mission("FAILED", "DONE", timeout_s=1.0) == "DONE"


def test_a_mission_that_was_heard_long_ago_is_not_waited_for_with_success(
    fleet: ConnectedFleet, station: PlayedStation, monkeypatch: pytest.MonkeyPatch
) -> None:
    station.bus.publish(topics.HEARTBEAT, StationHeartbeat(mission="DONE"), 10**18)  # by the wall clock
    monkeypatch.setattr("groundstation.scripting.fleet.FRESH_S", 0.05)
    time.sleep(0.1)
    with pytest.raises(NotHeard):
        fleet.wait_mission("DONE", timeout_s=0.05)


def test_a_fleet_is_ready_by_the_word_of_the_station_that_is_heard_now(
    hub: MemoryHub, fleet: ConnectedFleet, station: PlayedStation, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that was killed has said that the fleet is ready; the next one has not said so yet."""
    monkeypatch.setattr("groundstation.scripting.fleet.FRESH_S", 0.05)
    station.says("mission: fleet ready")
    station.bus.publish(topics.HEARTBEAT, StationHeartbeat(mission="WAITING", ready=True), 10**18)  # by the wall clock
    fleet.wait_ready(timeout_s=0.05)
    time.sleep(0.1)
    with pytest.raises(NotHeard, match="nothing heard"):
        fleet.wait_ready(timeout_s=0.05)
    again = Bus(MemoryTransport(hub))
    again.publish(topics.HEARTBEAT, StationHeartbeat(mission="WAITING"), 10**18)
    with pytest.raises(NotHeard, match="nothing heard"):
        fleet.wait_ready(timeout_s=0.0)
    again.publish(topics.HEARTBEAT, StationHeartbeat(mission="WAITING", ready=True), 10**18)
    fleet.wait_ready(timeout_s=0.0)


def test_a_condition_that_hears_nothing_does_not_hold(fleet: ConnectedFleet, station: PlayedStation) -> None:
    with pytest.raises(NotHeard, match="did not hold"):
        fleet.wait(lambda: fleet.state(1, max_age_s=0.01).mode is Mode.ARMED, timeout_s=0.1)
    station.bus.publish(topics.STATE, RobotState(Mode.ARMED), 0, robot=1)
    fleet.wait(lambda: fleet.state(1, max_age_s=60.0).mode is Mode.ARMED, timeout_s=1.0)


def test_a_corrupt_event_harms_nobody(fleet: ConnectedFleet, station: PlayedStation) -> None:
    station.bus.forward(topics.EVENT, b"\xff\x00broken", 0)
    station.says("still here")
    assert fleet.wait_event("still", timeout_s=1.0).message == "still here"


def test_a_wait_ends_with_the_reason_when_the_fleet_is_gone_for_good(hub: MemoryHub) -> None:
    gone = ConnectedFleet(Bus(MemoryTransport(hub)), lambda: "the simulation has ended: refused")
    with gone, pytest.raises(NotHeard, match="the simulation has ended: refused"):
        gone.wait_ready(60.0)


def test_a_slow_simulation_is_waited_for(fleet: ConnectedFleet, station: PlayedStation) -> None:
    """Simulated time stands here: a wait of a tenth of a second outlasts it, and sees what comes then."""
    station.bus.publish(topics.HEARTBEAT, StationHeartbeat(mission="RUNNING"), 5)
    late = threading.Timer(0.5, lambda: station.bus.publish(topics.HEARTBEAT, StationHeartbeat(mission="DONE"), 6))
    late.start()
    assert fleet.wait_mission("DONE", timeout_s=0.1) == "DONE"
    late.join()

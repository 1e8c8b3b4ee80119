"""Waits and ages in the fleet's own time: a busy machine that simulates slowly makes nobody late."""

import time

import pytest

from groundstation.fleet_time import FleetTime, PaceMeter, pace_in_words
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.messages import topics
from shoal.messages.messages import RobotState, StationHeartbeat

S = 10**9
TODAY_NS = 1_800_000_000 * S  # a stamp of the wall clock
SHORT_S = 0.02


class Fleet:
    """A station and a robot that stamp what they say, and the time as somebody beside them sees it."""

    def __init__(self) -> None:
        hub = MemoryHub()
        self.station, bus = Bus(MemoryTransport(hub)), Bus(MemoryTransport(hub))
        self.states = bus.inbox(topics.STATE, RobotState, 1)
        self.time = FleetTime(bus.inbox(topics.HEARTBEAT, StationHeartbeat))

    def beat(self, stamp_ns: int) -> None:
        self.station.publish(topics.HEARTBEAT, StationHeartbeat(), stamp_ns)

    def age_s(self) -> float:
        received = self.states.newest()
        assert received is not None
        return self.time.age_s(received)


@pytest.fixture
def fleet() -> Fleet:
    return Fleet()


def test_a_wait_is_over_when_both_clocks_say_so(fleet: Fleet) -> None:
    fleet.beat(3 * S)
    over = fleet.time.limit(SHORT_S)
    time.sleep(2 * SHORT_S)
    assert not over()  # simulated time has stood meanwhile
    fleet.beat(4 * S)
    assert over()
    quick = fleet.time.limit(60.0)
    fleet.beat(400 * S)  # much faster than the clock: a person's minute is still a minute
    assert not quick()


def test_a_wait_that_began_before_the_station_was_heard_counts_from_its_first_heartbeat(fleet: Fleet) -> None:
    over = fleet.time.limit(SHORT_S)
    fleet.beat(7 * S)
    assert not over()
    time.sleep(2 * SHORT_S)
    assert not over()
    fleet.beat(8 * S)
    assert over()


def test_where_nobody_simulates_the_wall_clock_counts(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    for stamp_ns in (None, TODAY_NS):
        if stamp_ns is not None:
            fleet.beat(stamp_ns)
        over = fleet.time.limit(SHORT_S)
        time.sleep(2 * SHORT_S)
        assert over()
    fleet.beat(3 * S)
    monkeypatch.setattr("groundstation.fleet_time.STANDING_S", 0.0)  # a simulation that has not been heard for long is gone
    over = fleet.time.limit(SHORT_S)
    time.sleep(2 * SHORT_S)
    assert over()


def test_a_message_is_as_old_as_simulated_time_makes_it(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    fleet.beat(3 * S)
    fleet.station.publish(topics.STATE, RobotState(), 3 * S, 1)
    time.sleep(SHORT_S)
    assert fleet.age_s() == 0.0
    fleet.beat(3 * S + 1)
    assert 0.0 < fleet.age_s() < SHORT_S
    monkeypatch.setattr("groundstation.fleet_time.STANDING_S", 0.0)
    assert fleet.age_s() >= SHORT_S


def test_the_pace_is_that_of_the_last_seconds() -> None:
    meter = PaceMeter()
    assert meter.add(10.0, 100.0) is None
    for k in range(1, 20):
        meter.add(10.0 + k, 100.0 + k)
    assert [meter.add(29.0 + 0.5 * k, 119.0 + k) for k in range(1, 11)][-1] == pytest.approx(0.5)


def test_only_a_pace_below_the_wanted_one_is_the_machines_fault() -> None:
    assert pace_in_words(0.6, 1.0) == "0.6 x real time, the machine is busy"
    assert pace_in_words(0.99, 1.0) == "1.0 x real time"
    assert pace_in_words(0.5, 0.5) == pace_in_words(0.5, None) == "0.5 x real time"


def test_simulated_time_that_begins_anew_keeps_nobody_waiting_and_nothing_young(fleet: Fleet) -> None:
    """A simulation is started again beside a script; one of its robots is not."""
    fleet.station.publish(topics.STATE, RobotState(), 1000 * S, 1)
    fleet.beat(1000 * S)
    over = fleet.time.limit(SHORT_S)
    fleet.beat(1 * S)
    time.sleep(2 * SHORT_S)
    assert not over()
    fleet.beat(2 * S)
    assert over()
    assert fleet.age_s() >= 2 * SHORT_S

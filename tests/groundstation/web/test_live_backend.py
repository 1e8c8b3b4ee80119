"""Ages on the page: a busy machine makes nothing old, what has stopped does not look alive, old lines do not look new."""

import time
from dataclasses import replace
from typing import Any

import pytest

from groundstation.web.live_backend import LiveBackend
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import load_experiment
from shoal.messages import topics
from shoal.messages.messages import Event, LocalizerStatus, Message, RobotState, StepTiming, Truth
from shoal.messages.topics import Topic
from shoal.runtime.runtime import WallClock
from sim_bridge.lockstep.clock import LockstepClock
from tests.groundstation.fake_station import FakeStation

S = 10**9
WAIT_S = 0.2


def test_the_age_of_a_robots_state_is_simulated_until_simulated_time_stands() -> None:
    hub, experiment, clock = MemoryHub(), load_experiment("pool"), LockstepClock()
    bus = Bus(MemoryTransport(hub))
    station = FakeStation(experiment, bus, clock=clock)
    backend = LiveBackend(experiment, {}, bus, station.inboxes, clock, station, "lockstep")
    Bus(MemoryTransport(hub)).publish(topics.STATE, RobotState(timing=StepTiming(step_us=90_000.0)), S, 1)
    clock.tick_ns = S + S // 20
    time.sleep(WAIT_S)

    def age_ms() -> float:
        age_ms: float = backend.snapshot()["robots"][0]["age_ms"]
        return age_ms

    assert age_ms() == 50.0
    assert "1:late" not in [alarm["key"] for alarm in backend.snapshot()["alarms"]]
    station.own_status = replace(station.own_status, beat_age_s=60.0)
    assert age_ms() >= WAIT_S * 1e3
    assert "simulated time stands since 60 s: the machine is busy" in [a["text"] for a in backend.snapshot()["alarms"]]


def test_the_page_counts_from_when_the_flight_began_and_from_nothing_before_that() -> None:
    hub, experiment, clock = MemoryHub(), load_experiment("pool"), WallClock()
    bus = Bus(MemoryTransport(hub))
    station = FakeStation(experiment, bus, clock=clock)
    backend = LiveBackend(experiment, {}, bus, station.inboxes, clock, station, "real-time")
    assert backend.snapshot()["began_s"] is None
    station.own_status = replace(station.own_status, began_ns=5 * S)
    assert backend.snapshot()["began_s"] == 5.0


@pytest.mark.parametrize(
    ("topic", "message", "robot", "ahead_s"),
    [(topics.STATE, RobotState(), 1, 20), (topics.TRUTH, Truth(), None, 20), (topics.LOCALIZER, LocalizerStatus(), None, 0)],
)
def test_a_line_of_an_earlier_run_is_shown_at_its_own_time(
    topic: Topic, message: Message, robot: int | None, ahead_s: int
) -> None:
    """A program outlives a station: the next one gets its lines of an hour ago, by a clock that is 20 s off. A localizer's
    messages may be stamped by its camera's clock, so they date its lines only where that is the station's clock too."""
    hub, experiment, clock = MemoryHub(), load_experiment("pool"), WallClock()
    bus, sender = Bus(MemoryTransport(hub)), Bus(MemoryTransport(hub))
    station = FakeStation(experiment, bus, clock=clock)
    backend = LiveBackend(experiment, {}, bus, station.inboxes, clock, station, "real-time")
    its_now_ns = clock.now_ns() + ahead_s * S
    sender.publish(topics.EVENT, Event(4, "sender", "fault"), its_now_ns - 3600 * S)
    sender.publish(topics.EVENT, Event(2, "sender", "disarmed"), its_now_ns)
    sender.publish(topic, message, its_now_ns, robot)
    deadline, notes = time.monotonic() + 10.0, list[dict[str, Any]]()
    while len(notes) < 2 and time.monotonic() < deadline:
        notes += backend.notes()
        time.sleep(0.02)
    old, new = (clock.now_ns() * 1e-9 - note["time_s"] for note in notes)
    assert abs(old - 3600.0) < 10.0
    assert 0.0 <= new < 10.0


def test_lines_that_several_programs_have_kept_come_in_the_order_of_their_times() -> None:
    hub, experiment, clock = MemoryHub(), load_experiment("pool"), WallClock()
    bus, now_ns = Bus(MemoryTransport(hub)), clock.now_ns()
    station = FakeStation(experiment, bus, clock=clock)
    backend = LiveBackend(experiment, {}, bus, station.inboxes, clock, station, "real-time")
    for robot, ages_s in ((1, (40, 20)), (2, (30, 10))):
        agent = Bus(MemoryTransport(hub))
        for age_s in ages_s:
            agent.publish(topics.EVENT, Event(2, f"agent-{robot}", f"{age_s} s ago"), now_ns - age_s * S)
        agent.publish(topics.STATE, RobotState(), now_ns, robot)
    deadline, notes = time.monotonic() + 10.0, list[dict[str, Any]]()
    while len(notes) < 4 and time.monotonic() < deadline:
        notes += backend.notes()
        time.sleep(0.02)
    assert [note["text"] for note in notes] == ["40 s ago", "30 s ago", "20 s ago", "10 s ago"]

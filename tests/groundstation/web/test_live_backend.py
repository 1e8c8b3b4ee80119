"""Ages on the page: a busy machine makes nothing old, what has stopped does not look alive, old lines do not look new."""

import time
from dataclasses import replace
from typing import Any

from groundstation.web.live_backend import LiveBackend
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import load_experiment
from shoal.messages import topics
from shoal.messages.messages import Event, RobotState, StepTiming
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


def test_a_line_of_an_earlier_run_is_shown_at_its_own_time() -> None:
    """A robot's program outlives a station: the next one gets its lines of an hour ago, by a clock that is 20 s off."""
    hub, experiment, clock = MemoryHub(), load_experiment("pool"), WallClock()
    bus, robot = Bus(MemoryTransport(hub)), Bus(MemoryTransport(hub))
    station = FakeStation(experiment, bus, clock=clock)
    backend = LiveBackend(experiment, {}, bus, station.inboxes, clock, station, "real-time")
    its_now_ns = clock.now_ns() + 20 * S
    robot.publish(topics.EVENT, Event(4, "agent-1", "robot 1: fault: no pose"), its_now_ns - 3600 * S)
    robot.publish(topics.EVENT, Event(2, "agent-1", "robot 1: disarmed"), its_now_ns)
    robot.publish(topics.STATE, RobotState(), its_now_ns, 1)
    deadline, notes = time.monotonic() + 10.0, list[dict[str, Any]]()
    while len(notes) < 2 and time.monotonic() < deadline:
        notes += backend.notes()
        time.sleep(0.02)
    old, new = (clock.now_ns() * 1e-9 - note["time_s"] for note in notes)
    assert abs(old - 3600.0) < 10.0
    assert 0.0 <= new < 10.0

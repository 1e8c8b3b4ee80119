"""Ages on the page of a simulation: a busy machine makes nothing old, and what has stopped does not look alive."""

import time
from dataclasses import replace

from groundstation.web.live_backend import LiveBackend
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import load_experiment
from shoal.messages import topics
from shoal.messages.messages import RobotState, StepTiming
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

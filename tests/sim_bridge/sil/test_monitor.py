"""The lines that the monitor writes into a log while robots fly."""

import numpy as np

from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import load_experiment
from shoal.messages import topics
from shoal.messages.messages import Event, Mode, RobotState, StationHeartbeat
from sim_bridge.sil.monitor import Monitor


def line(name: str, states: dict[int, RobotState], mission: str = "RUNNING", told: str = "") -> str:
    hub = MemoryHub()
    robots, person = Bus(MemoryTransport(hub)), Bus(MemoryTransport(hub))
    monitor = Monitor(load_experiment(name), person)
    robots.publish(topics.HEARTBEAT, StationHeartbeat(mission=mission), 1)
    if told:
        robots.publish(topics.EVENT, Event(2, "groundstation", told), 1)
    for robot, state in states.items():
        robots.publish(topics.STATE, state, 1, robot)
    return monitor.line()


def tracking(off_m: float, fault: str = "") -> RobotState:
    return RobotState(
        mode=Mode.TRACKING, eta=np.array([off_m, 0.0, 0.3, 0.0]), eta_reference=np.array([0.0, 0.0, 0.3, 0.0]), fault=fault
    )


def test_two_robots_are_named() -> None:
    told = line("pool", {1: tracking(0.012), 2: RobotState(mode=Mode.HOLDING, fault="the pose is old")})
    assert told.endswith("1 tracking 12 mm, 2 holding - (the pose is old)")


def test_of_twenty_robots_the_worst_and_those_with_alarms_are_named() -> None:
    states = {robot: tracking(0.001 * robot) for robot in range(1, 19)} | {
        19: RobotState(mode=Mode.DISARMED, fault="no battery")
    }
    told = line("fleet-20", states)  # robot 20 has not been heard
    assert told.endswith("1 disarmed, 18 tracking, worst 18: 18 mm, 19 (no battery)")
    assert len(told) < 120


def test_a_run_that_waits_or_holds_gives_the_reason() -> None:
    told = line("pool", {1: tracking(0.0)}, "WAITING", "mission: waiting for the fleet: robot 1: depth -1.00 m")
    assert told.endswith("waiting     robot 1: depth -1.00 m")
    assert line("pool", {}, "PAUSED", "mission: holding: robot 2: no pose").endswith("robot 2: no pose")
    assert line("pool", {1: tracking(0.0)}, "RUNNING", "mission: waiting for the fleet: depth").endswith("1 tracking 0 mm")

"""The lines that the monitor writes into a log while robots fly."""

from io import StringIO

import numpy as np
from rich.console import Console

from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import load_experiment
from shoal.messages import topics
from shoal.messages.messages import ALONE, BoardReading, Control, Estimate, Event, Mode, RobotState, StationHeartbeat
from sim_bridge.sil.monitor import Monitor


def line(name: str, states: dict[int, RobotState], mission: str = "RUNNING", reason: str = "") -> str:
    hub = MemoryHub()
    robots, person = Bus(MemoryTransport(hub)), Bus(MemoryTransport(hub))
    monitor = Monitor(load_experiment(name), person)
    robots.publish(topics.HEARTBEAT, StationHeartbeat(mission=mission), 1)
    if reason:
        robots.publish(topics.EVENT, Event(2, "groundstation", reason), 1)
    for robot, state in states.items():
        robots.publish(topics.STATE, state, 1, robot)
    return monitor.line()


def test_a_battery_that_no_board_has_reported_is_not_shown_as_empty() -> None:
    hub = MemoryHub()
    robots, monitor = Bus(MemoryTransport(hub)), Monitor(load_experiment("pool"), Bus(MemoryTransport(hub)))
    console = Console(width=200, record=True, file=StringIO())
    for board in (None, BoardReading(), BoardReading(battery_v=12.4, battery_reports=1)):
        robots.publish(topics.STATE, RobotState(board=board), 1, 1)
        console.print(monitor.render())
    text = console.export_text()
    assert "0.0 V" not in text and "12.4 V" in text


def tracking(off_m: float, fault: str = "") -> RobotState:
    return RobotState(
        mode=Mode.TRACKING,
        fault=fault,
        estimate=Estimate(eta=np.array([off_m, 0.0, 0.3, 0.0])),
        control=Control(eta_reference=np.array([0.0, 0.0, 0.3, 0.0])),
    )


def test_two_robots_are_named() -> None:
    text = line("pool", {1: tracking(0.012), 2: RobotState(mode=Mode.HOLDING, fault="the pose is old")})
    assert text.endswith("1 tracking 12 mm, 2 holding - (the pose is old)")


def test_of_twenty_robots_the_worst_and_those_with_alarms_are_named() -> None:
    states = {robot: tracking(0.001 * robot) for robot in range(1, 19)} | {
        19: RobotState(mode=Mode.DISARMED, fault="no battery")
    }
    text = line("fleet-20", states)  # robot 20 has not been heard
    assert text.endswith("1 disarmed, 18 tracking, worst 18: 18 mm, 19 (no battery)")
    assert len(text) < 120


def test_a_run_that_waits_or_holds_gives_the_reason() -> None:
    text = line("pool", {1: tracking(0.0)}, "WAITING", "mission: waiting for the fleet: robot 1: depth -1.00 m")
    assert text.endswith("waiting     robot 1: depth -1.00 m")
    assert line("pool", {}, "PAUSED", "mission: holding: robot 2: no pose").endswith("robot 2: no pose")
    assert line("pool", {1: tracking(0.0)}, "RUNNING", "mission: waiting for the fleet: depth").endswith("1 tracking 0 mm")


def test_the_planned_end_of_a_flight_is_told_by_the_clock_beside_it() -> None:
    """After 40 s of the flight, 10 s of it held, robots are 30 s along: what is left begins now."""
    hub = MemoryHub()
    robots, monitor = Bus(MemoryTransport(hub)), Monitor(load_experiment("pool"), Bus(MemoryTransport(hub)))
    assert " - / 120 s" in monitor.line()
    for robot in (1, 2):
        robots.publish(topics.STATE, RobotState(Mode.TRACKING, trajectory_id="p", trajectory_s=30.0), 1, robot)
    for mission, flight_s, shown in (
        ("RUNNING", 120.0, "40.0 / 130 s"),
        ("RUNNING", 136.0, "40.0 / 146 s"),  # a detour, or another path
        ("FAILED", 120.0, "40.0 / 146 s"),  # nothing comes any nearer
    ):
        robots.publish(topics.HEARTBEAT, StationHeartbeat(mission=mission, flight_s=flight_s, began_ns=10**9), 41 * 10**9)
        assert shown in monitor.line()
    for mission in ("STOPPED", "WAITING", "DONE"):  # nothing flies: the clock stands, and does not run past the planned end
        robots.publish(topics.HEARTBEAT, StationHeartbeat(mission=mission, flight_s=120.0, began_ns=10**9), 401 * 10**9)
        assert "40.0 / 146 s" in monitor.line()


def test_a_robot_that_is_led_alone_puts_off_no_end() -> None:
    """Robot 2 left the formation after 30 s: its clock along the formation's trajectory stands; that of robot 1 goes on."""
    hub = MemoryHub()
    robots, monitor = Bus(MemoryTransport(hub)), Monitor(load_experiment("pool"), Bus(MemoryTransport(hub)))
    for led, time_s in ((Mode.DRIVEN, 50), (Mode.HOLDING, 70)):
        robots.publish(topics.STATE, RobotState(Mode.TRACKING, trajectory_id="p", trajectory_s=float(time_s)), 1, 1)
        robots.publish(topics.STATE, RobotState(led, trajectory_id="p", trajectory_s=30.0), 1, 2)
        beat = StationHeartbeat(mission="DEGRADED", flight_s=120.0, began_ns=10**9)
        robots.publish(topics.HEARTBEAT, beat, (time_s + 1) * 10**9)
        assert f"{time_s:.1f} / 120 s" in monitor.line()


def test_on_the_way_home_no_end_of_the_flight_before_is_shown() -> None:
    """The terminal said "344.1 / 265 s returning", beside a page with 5:44 / 5:45."""
    hub = MemoryHub()
    robots, monitor = Bus(MemoryTransport(hub)), Monitor(load_experiment("pool"), Bus(MemoryTransport(hub)))
    for mission, flight_s, shown in (("RUNNING", 120.0, " 40.0 / 120 s  running"), ("RETURNING", 0.0, " 40.0 s  returning")):
        for robot in (1, 2):
            robots.publish(topics.STATE, RobotState(Mode.TRACKING, trajectory_id="p", trajectory_s=40.0), 1, robot)
        beat = StationHeartbeat(mission=mission, flight_s=flight_s, began_ns=10**9)
        robots.publish(topics.HEARTBEAT, beat, 41 * 10**9)
        assert shown in monitor.line()


def test_time_flown_is_the_formations_and_not_that_of_a_flight_alone() -> None:
    """Faults of processes begin with it. Robot 1 is sent somewhere before the formation starts, and again later."""
    hub = MemoryHub()
    robots, monitor = Bus(MemoryTransport(hub)), Monitor(load_experiment("pool"), Bus(MemoryTransport(hub)))

    def flown_s(*clocks: tuple[str, float]) -> float:
        for robot, (trajectory_id, trajectory_s) in enumerate(clocks, start=1):
            state = RobotState(Mode.TRACKING, trajectory_id=trajectory_id, trajectory_s=trajectory_s)
            robots.publish(topics.STATE, state, 1, robot)
        return monitor.flown_s

    assert flown_s((f"{ALONE}x", 5.0), (f"{ALONE}y", 4.0)) == 0.0
    assert flown_s(("p1", 7.0), ("p2", 6.5)) == 6.5
    assert flown_s((f"{ALONE}x", 1.0), ("p2", 7.5)) == 7.5

"""A robot that a person takes out of the water, and puts back, seen by people, planner and robots."""

import numpy as np
import pytest

from groundstation.mission.mission import ATTENDED
from groundstation.mission.objections import LIVE
from groundstation.mission.state_machine import MissionState
from shoal.config.experiment import load_experiment
from shoal.messages.messages import CommandKind, Mode, Outcome, Progress
from tests.groundstation.mission.judged_run import RunRecord
from tests.groundstation.mission.simulated_fleet import SimulatedFleet, armed

POOL = load_experiment("pool", ("duration_s=12.0", 'mission.lost="go-on"'))


def ask(fleet: SimulatedFleet, order: CommandKind, only: int = 0) -> str:
    """Make a request; returns the reason of a refusal, or of a failure within two cycles."""
    reason, number = fleet.core.request(order, fleet.fleet, fleet.now_ns, only=only)
    if reason or not only:
        return reason
    fleet.run(0.1)
    outcome = fleet.core.requests.outcome(number)
    assert isinstance(outcome, Outcome)
    return "" if outcome.progress is Progress.DONE else outcome.reason


def arm(fleet: SimulatedFleet, robot: int) -> None:
    """Arm one robot."""
    reason, _ = fleet.core.request(CommandKind.ARM, fleet.fleet, fleet.now_ns, only=robot)
    fleet.run(0.5)
    assert fleet.robots[robot].mode is Mode.ARMED, reason


def until(fleet: SimulatedFleet, state: MissionState, seconds: float = 30.0) -> None:
    for _ in range(round(seconds / 0.05)):
        if fleet.mission.state is state:
            return
        fleet.step()
    raise AssertionError(f"{fleet.mission.state}: {fleet.mission.reason}")


def test_fleet_flies_without_a_robot_that_is_out_until_it_is_back_in() -> None:
    fleet = SimulatedFleet(POOL)
    fleet.robots[2].alive = False
    fleet.run(0.5)
    assert "robot 2: not heard" in ask(fleet, CommandKind.START)
    assert "2" in ask(fleet, CommandKind.OUT, 3) and "robot 1 is not out of the water" in ask(fleet, CommandKind.BACK_IN, 1)
    assert ask(fleet, CommandKind.OUT, 2) == ""
    assert ask(fleet, CommandKind.OUT, 2) == "robot 2 is out of the water"
    assert "last one in the water" in ask(fleet, CommandKind.OUT, 1)
    assert "back-in --robot 2" in ask(fleet, CommandKind.ARM, 2)
    for _ in range(2):  # it stays out of later runs too
        assert ask(fleet, CommandKind.START) == ""
        until(fleet, MissionState.DEGRADED)
        assert fleet.mission.reason == "robot 2: out of the water"
        assert fleet.robots[1].mode is Mode.TRACKING and fleet.mission.roster.active == (1,)
        until(fleet, MissionState.DONE)
    assert ask(fleet, CommandKind.STOP) == ""  # confirmed without it, and cleared without it
    until(fleet, MissionState.STOPPED)
    fleet.run(0.5)
    assert ask(fleet, CommandKind.CLEAR_STOP) == ""
    until(fleet, MissionState.WAITING, 3.0)
    fleet.run(3.0)  # no heartbeat of the stop is on its way any more
    fleet.robots[2].restart(fleet.now_ns)
    assert ask(fleet, CommandKind.BACK_IN, 2) == "" and fleet.mission.roster.active == (1, 2)
    fleet.run(0.5)
    assert ask(fleet, CommandKind.START) == ""
    until(fleet, MissionState.RUNNING)
    assert fleet.robots[2].mode is Mode.TRACKING


def test_robot_taken_out_in_flight_is_no_obstacle_any_more_and_may_rejoin() -> None:
    fleet, out_by_beat = SimulatedFleet(POOL), list[tuple[int, ...]]()
    fleet.on_beat = lambda beat: out_by_beat.append(beat.out)
    fleet.run(0.5)
    assert ask(fleet, CommandKind.START) == ""
    until(fleet, MissionState.RUNNING)
    assert ask(fleet, CommandKind.OUT, 2) == "robot 2 is TRACKING: disarm it first"
    fleet.robots[2].alive = False
    until(fleet, MissionState.DEGRADED)
    assert len(fleet.mission.plans.discs_to_avoid(fleet.fleet)) == 1
    assert "TRACKING" in ask(fleet, CommandKind.OUT, 2)  # without a station it has power for some seconds more
    fleet.run(4.0)
    assert ask(fleet, CommandKind.OUT, 2) == ""
    assert len(fleet.mission.plans.discs_to_avoid(fleet.fleet)) == 0
    assert out_by_beat[0] == () and out_by_beat[-1] == (2,)
    assert "back-in --robot 2" in ask(fleet, CommandKind.REJOIN)
    fleet.robots[2].restart(fleet.now_ns)
    assert ask(fleet, CommandKind.BACK_IN, 2) == "" and fleet.mission.roster.active == (1,)
    fleet.run(0.5)
    assert ask(fleet, CommandKind.REJOIN) == ""
    until(fleet, MissionState.RUNNING)
    assert set(fleet.mission.roster.active) == {1, 2} and out_by_beat[-1:] == [()]


@pytest.mark.parametrize("flies", [True, False])
def test_robot_that_was_silent_with_power_is_disarmed_when_it_is_out_of_the_water(flies: bool) -> None:
    fleet = SimulatedFleet(POOL)
    fleet.run(0.5)
    if flies:
        assert ask(fleet, CommandKind.START) == ""
        until(fleet, MissionState.RUNNING)
    else:
        arm(fleet, 2)
    fleet.robots[2].radio.mute_until_ns = fleet.now_ns + 5_000_000_000  # it hears the station, and so keeps its power
    fleet.run(4.0)
    assert fleet.robots[2].mode in LIVE and ask(fleet, CommandKind.OUT, 2) == ""
    fleet.run(0.5)
    assert fleet.robots[2].mode is Mode.DISARMED  # told so though it is not heard
    fleet.run(2.0)
    assert fleet.robots[2].mode is Mode.DISARMED and (not flies or fleet.robots[1].mode is Mode.TRACKING)


def test_stop_waits_for_a_robot_out_of_the_water_that_has_power() -> None:
    fleet = SimulatedFleet(POOL)
    fleet.run(0.5)
    assert ask(fleet, CommandKind.OUT, 2) == ""
    robot = fleet.robots[2]
    robot.mode, robot.radio.delay_ns = Mode.ARMED, 200_000_000
    fleet.run(0.25)
    _, number = fleet.core.request(CommandKind.STOP, fleet.fleet, fleet.now_ns)
    while (outcome := fleet.core.requests.outcome(number)) is None or outcome.progress is Progress.UNDER_WAY:
        fleet.step()
    assert outcome.progress is Progress.DONE and not armed(robot)


def test_robot_is_sent_through_the_place_of_one_that_is_out_of_the_water() -> None:
    fleet = SimulatedFleet(POOL)
    fleet.run(0.5)
    place_m = fleet.robots[2].eta[:2]
    arm(fleet, 1)
    ways = []
    for out in (False, True):
        if out:
            assert ask(fleet, CommandKind.OUT, 2) == ""
        ways.append(fleet.core.request(CommandKind.GO, fleet.fleet, fleet.now_ns, ((place_m[0], place_m[1]),), 1))
    assert "from robot 2" in ways[0][0] and ways[1][0] == ""
    while (outcome := fleet.core.requests.outcome(ways[1][1])) is None or outcome.progress is Progress.UNDER_WAY:
        fleet.step()
    assert outcome.progress is Progress.DONE, outcome.reason
    assert np.hypot(*(fleet.robots[1].eta[:2] - place_m)) < POOL.safety.off_path_m


def test_report_has_no_error_of_a_robot_that_was_out_of_the_water() -> None:
    fleet = SimulatedFleet(POOL)
    record = RunRecord(fleet)
    fleet.run(0.5)
    for ends in (CommandKind.DISARM, CommandKind.NONE):
        assert ask(fleet, CommandKind.START) == ""
        until(fleet, MissionState.RUNNING if ends is CommandKind.DISARM else MissionState.DEGRADED)
        fleet.run(3.0)
        if ends is CommandKind.DISARM:
            assert ask(fleet, ends) == ""
            until(fleet, MissionState.CANCELLED)
            fleet.robots[1].eta = fleet.starts[1]
            fleet.run(0.2)
            assert ask(fleet, CommandKind.OUT, 2) == ""
            fleet.robots[2].eta = fleet.starts[2] + np.array([0.8, 0.0, 0.0, 0.0])
    record.judge()


def test_robot_is_fetched_from_the_water_after_a_stop() -> None:
    fleet = SimulatedFleet(POOL)
    fleet.run(0.5)
    fleet.robots[2].alive = False
    fleet.run(4.0)
    _, number = fleet.core.request(CommandKind.STOP, fleet.fleet, fleet.now_ns)
    fleet.run(1.0)
    stop = fleet.core.requests.outcome(number)
    assert stop is not None and stop.waiting == (2,)
    assert ask(fleet, CommandKind.OUT, 2) == ""
    stop = fleet.core.requests.outcome(number)
    assert stop is not None and stop.progress is Progress.DONE
    assert ask(fleet, CommandKind.CLEAR_STOP) == ""
    until(fleet, MissionState.WAITING, 3.0)
    assert ask(fleet, CommandKind.STOP) == ""
    fleet.run(0.5)
    assert ask(fleet, CommandKind.BACK_IN, 2) == "" and fleet.mission.roster.active == (1, 2)


def test_report_tells_a_flight_home_from_the_flight_before_it_also_of_a_robot_that_was_sent_elsewhere_between() -> None:
    fleet = SimulatedFleet(POOL)
    record = RunRecord(fleet)
    fleet.run(0.5)
    assert ask(fleet, CommandKind.START) == ""
    until(fleet, MissionState.RUNNING)
    fleet.run(3.0)  # shorter than a clock goes back by within a flight
    assert ask(fleet, CommandKind.DISARM) == ""
    until(fleet, MissionState.CANCELLED)
    arm(fleet, 2)
    refused, _ = fleet.core.request(CommandKind.GO, fleet.fleet, fleet.now_ns, ((1.0, 0.8),), 2)
    fleet.run(15.0)
    assert not refused and ask(fleet, CommandKind.DISARM) == ""
    until(fleet, MissionState.CANCELLED)
    assert ask(fleet, CommandKind.OUT, 1) == ""
    assert ask(fleet, CommandKind.RETURN) == ""
    until(fleet, MissionState.DONE, 60.0)
    record.judge()


def test_an_automatic_mission_waits_for_a_person_once_a_robot_is_taken_out() -> None:
    fleet = SimulatedFleet(POOL, automatic=True, give_up_s=20.0)
    fleet.robots[2].alive = False
    fleet.run(1.0)
    assert ask(fleet, CommandKind.OUT, 2) == ""
    fleet.run(30.0)
    assert fleet.mission.state is MissionState.WAITING and fleet.mission.reason == ATTENDED
    fleet.robots[2].restart(fleet.now_ns)
    assert ask(fleet, CommandKind.BACK_IN, 2) == ""
    fleet.run(5.0)
    assert fleet.mission.state is MissionState.WAITING and not any(armed(robot) for robot in fleet.robots.values())
    assert ask(fleet, CommandKind.START) == ""
    until(fleet, MissionState.DONE)

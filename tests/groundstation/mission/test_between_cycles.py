"""Requests that come between two cycles of the station, with the robots' states as the last cycle saw them."""

import pytest

from groundstation.mission.single_robot import SingleRobotControl
from shoal.messages.messages import CommandKind, DriveVelocity, Mode, Outcome, Progress
from tests.groundstation.mission.simulated_fleet import CIRCLE, TWO, SimulatedFleet, an_experiment

MS = 1_000_000


def waiting_fleet() -> SimulatedFleet:
    """Robots at rest, over a radio that takes no time."""
    pool = SimulatedFleet(an_experiment("go-on", TWO, CIRCLE))
    for robot in pool.robots.values():
        robot.radio.delay_ns = 0
    pool.run(1.0)
    return pool


@pytest.mark.parametrize("another", ["request", "drive", "gains"])
def test_a_disarm_behind_an_arm_is_not_done_by_a_state_of_before_whatever_else_is_asked(another: str) -> None:
    pool = waiting_fleet()
    pool.core.request(CommandKind.ARM, pool.fleet, pool.now_ns + MS, only=1)
    pool.step()  # ARM is on its way
    assert pool.fleet[1].mode is Mode.DISARMED
    reason, number = pool.core.request(CommandKind.DISARM, pool.fleet, pool.now_ns + 10 * MS, only=1)
    assert reason == ""
    if another == "request":
        pool.core.request(CommandKind.ARM, pool.fleet, pool.now_ns + 40 * MS, only=2)
    elif another == "drive":
        pool.core.drive(2, DriveVelocity(surge_mps=0.1), pool.fleet, pool.now_ns + 40 * MS)
    else:
        pool.core.request_gains({"controller.nmpc.turning_m": 0.02}, False, pool.fleet, pool.now_ns + 40 * MS)
    assert outcome(pool, number).progress is Progress.UNDER_WAY
    pool.run(1.0)
    assert pool.robots[1].mode is Mode.DISARMED and outcome(pool, number).progress is Progress.DONE


def test_a_hold_behind_a_drive_is_not_done_by_a_state_of_before_the_drive() -> None:
    pool = waiting_fleet()
    for order in (CommandKind.ARM, CommandKind.HOLD):
        assert pool.core.request(order, pool.fleet, pool.now_ns, only=1)[0] == ""
        pool.run(1.0)
    assert pool.core.drive(1, DriveVelocity(surge_mps=0.1), pool.fleet, pool.now_ns + MS) == ""
    pool.step()  # DRIVE is on its way
    assert pool.fleet[1].mode is Mode.HOLDING
    reason, number = pool.core.request(CommandKind.HOLD, pool.fleet, pool.now_ns + 10 * MS, only=1)
    pool.core.request(CommandKind.ARM, pool.fleet, pool.now_ns + 40 * MS, only=2)
    assert reason == "" and outcome(pool, number).progress is Progress.UNDER_WAY
    pool.run(1.0)
    assert pool.robots[1].mode is Mode.HOLDING and outcome(pool, number).progress is Progress.DONE


def test_a_robot_that_says_that_it_is_disarmed_is_sent_a_disarm_all_the_same() -> None:
    """An ARM may have been sent to it just before, and come behind the state that says so."""
    pool = waiting_fleet()
    single: SingleRobotControl = pool.core.single
    assert single.request(CommandKind.DISARM, 1, pool.fleet, pool.now_ns - 30 * MS) == ""
    single.settle(pool.fleet, pool.now_ns)
    assert [command.order for command in single.step(pool.fleet, (), pool.now_ns)] == [CommandKind.DISARM]
    single.settle(pool.fleet, pool.now_ns)
    assert not single.led


def outcome(pool: SimulatedFleet, number: int) -> Outcome:
    """A request's outcome, which is known."""
    latest = pool.core.requests.outcome(number)
    assert latest is not None
    return latest

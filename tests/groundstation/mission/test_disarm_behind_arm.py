"""A DISARM behind an ARM, of which the robots do not know yet."""

from groundstation.mission.single_robot import SingleRobotControl
from groundstation.mission.state_machine import MissionState
from shoal.messages.messages import CommandKind
from tests.groundstation.mission.simulated_fleet import CIRCLE, TWO, SimulatedFleet, an_experiment

MS = 1_000_000


def waiting_fleet() -> SimulatedFleet:
    """Robots at rest, over a radio that takes no time."""
    pool = SimulatedFleet(an_experiment("go-on", TWO, CIRCLE))
    for robot in pool.robots.values():
        robot.radio.delay_ns = 0
    pool.run(1.0)
    return pool


def test_a_robot_that_says_that_it_is_disarmed_is_sent_a_disarm_all_the_same() -> None:
    """An ARM may have been sent to it just before, and come behind the state that says so."""
    pool = waiting_fleet()
    single: SingleRobotControl = pool.core.single
    assert single.request(CommandKind.DISARM, 1, pool.fleet, pool.now_ns - 30 * MS) == ""
    single.settle(pool.fleet, pool.now_ns)
    assert [command.order for command in single.step(pool.fleet, (), pool.now_ns)] == [CommandKind.DISARM]
    single.settle(pool.fleet, pool.now_ns)
    assert not single.led


def test_a_fleet_that_says_that_it_is_disarmed_is_sent_a_disarm_all_the_same() -> None:
    pool = waiting_fleet()
    mission = pool.mission
    assert mission.request(CommandKind.DISARM, pool.fleet, pool.now_ns - 30 * MS) == ""
    sent = [(command.order, command.robot) for command in mission.step(pool.fleet, (), pool.now_ns)]
    assert sent == [(CommandKind.DISARM, 1), (CommandKind.DISARM, 2)]
    assert mission.step(pool.fleet, (), pool.now_ns + 50 * MS) == () and mission.state is MissionState.CANCELLED

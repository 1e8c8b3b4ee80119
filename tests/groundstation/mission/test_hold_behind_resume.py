"""Another plan or place behind a RESUME, of which the robots do not know yet: the radio takes a while."""

from groundstation.mission.state_machine import MissionState
from shoal.messages.messages import CommandKind, Mode
from tests.groundstation.mission.simulated_fleet import CIRCLE, TWO, SimulatedFleet, an_experiment

DELAY_NS = 150_000_000  # each way: a state that a robot sent before the RESUME comes after it
PLANNING_NS = 50_000_000  # a plan is there before a robot's state that says that it has set off


def held_fleet() -> SimulatedFleet:
    """Robots that hold on their way, over a radio that is slow but hears them."""
    pool = SimulatedFleet(an_experiment("go-on", TWO, CIRCLE), planning_ns=PLANNING_NS)
    for robot in pool.robots.values():
        robot.radio.delay_ns = 20_000_000
    pool.run(1.0)
    ask(pool, CommandKind.START)
    pool.run(20.0)
    for robot in pool.robots.values():
        robot.radio.delay_ns = DELAY_NS
    ask(pool, CommandKind.HOLD)
    pool.run(5.0)
    assert {robot.mode for robot in pool.robots.values()} == {Mode.HOLDING}
    return pool


def ask(pool: SimulatedFleet, order: CommandKind, robot: int = 0, place_m: tuple[float, float] | None = None) -> None:
    refused, _ = pool.core.request(order, pool.fleet, pool.now_ns, () if place_m is None else (place_m,), robot)
    assert refused == ""


def resumed_and_held(pool: SimulatedFleet) -> None:
    """One person resumes, another one holds at once."""
    ask(pool, CommandKind.RESUME)
    pool.step()
    ask(pool, CommandKind.HOLD)
    pool.step()


def test_the_fleet_flies_home_and_not_on_where_it_was_told_to_return_just_behind_a_resume() -> None:
    pool = held_fleet()
    resumed_and_held(pool)
    ask(pool, CommandKind.RETURN)
    for _ in range(100):
        pool.step()
        flies_home = pool.mission.state in (MissionState.RELEASING, MissionState.RUNNING, MissionState.RETURNING)
        still = [r.id for r in pool.robots.values() if r.clock.reached_s <= pool.mission.plans.progress_s + 0.1]
        assert flies_home or len(still) == 2, "a robot flies on along the path that it was to leave"
    assert pool.mission.state is MissionState.RETURNING


def test_a_robot_flies_to_its_own_place_and_not_on_where_it_was_sent_there_just_behind_a_resume() -> None:
    pool = held_fleet()
    resumed_and_held(pool)
    path = pool.robots[2].clock.id
    ask(pool, CommandKind.GO, 2, (2.0, 1.0))
    for _ in range(100):
        pool.step()
        robot = pool.robots[2]
        assert robot.clock.id != path or robot.clock.reached_s <= pool.mission.plans.progress_s + 0.1
    assert pool.robots[2].mode is Mode.TRACKING and pool.robots[2].clock.id != path

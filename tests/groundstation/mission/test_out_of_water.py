"""A robot that a person takes out of the water, and puts back, seen by people, planner and robots."""

from groundstation.mission.state_machine import MissionState
from tests.groundstation.mission.simulated_fleet import SimulatedFleet
from wire.config.experiment import load_experiment
from wire.messages.messages import Mode, Order, Outcome, Progress

POOL = load_experiment("pool", ("duration_s=12.0", 'mission.lost="go-on"'))


def ask(fleet: SimulatedFleet, order: Order, only: int = 0) -> str:
    """Make a request; returns the reason of a refusal, or of a failure within two cycles."""
    reason, number = fleet.core.request(order, fleet.fleet, fleet.now_ns, only=only)
    if reason or not only:
        return reason
    fleet.run(0.1)
    outcome = fleet.core.requests.outcome(number)
    assert isinstance(outcome, Outcome)
    return "" if outcome.progress is Progress.DONE else outcome.reason


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
    assert "robot 2: not heard" in ask(fleet, Order.START)
    assert "2" in ask(fleet, Order.OUT, 3) and "robot 1 is not out of the water" in ask(fleet, Order.BACK_IN, 1)
    assert ask(fleet, Order.OUT, 2) == ""
    assert ask(fleet, Order.OUT, 2) == "robot 2 is out of the water"
    assert "last one in the water" in ask(fleet, Order.OUT, 1)
    assert "back-in --robot 2" in ask(fleet, Order.ARM, 2)
    for _ in range(2):  # it stays out of later runs too
        assert ask(fleet, Order.START) == ""
        until(fleet, MissionState.DEGRADED)
        assert fleet.mission.reason == "robot 2: out of the water"
        assert fleet.robots[1].mode is Mode.TRACKING and fleet.mission.roster.active == (1,)
        until(fleet, MissionState.DONE)
    assert ask(fleet, Order.STOP) == ""  # confirmed without it, and cleared without it
    until(fleet, MissionState.STOPPED)
    fleet.run(0.5)
    assert ask(fleet, Order.CLEAR_STOP) == ""
    until(fleet, MissionState.WAITING, 3.0)
    fleet.run(3.0)  # no heartbeat of the stop is on its way any more
    fleet.robots[2].restart(fleet.now_ns)
    assert ask(fleet, Order.BACK_IN, 2) == "" and fleet.mission.roster.active == (1, 2)
    fleet.run(0.5)
    assert ask(fleet, Order.START) == ""
    until(fleet, MissionState.RUNNING)
    assert fleet.robots[2].mode is Mode.TRACKING


def test_robot_taken_out_in_flight_is_no_obstacle_any_more_and_may_rejoin() -> None:
    fleet, told = SimulatedFleet(POOL), list[tuple[int, ...]]()
    fleet.on_beat = lambda beat: told.append(beat.out)
    fleet.run(0.5)
    assert ask(fleet, Order.START) == ""
    until(fleet, MissionState.RUNNING)
    assert ask(fleet, Order.OUT, 2) == "robot 2 is TRACKING: disarm it first"
    fleet.robots[2].alive = False
    until(fleet, MissionState.DEGRADED)
    assert len(fleet.mission.plans.discs_to_avoid(fleet.fleet)) == 1
    assert "TRACKING" in ask(fleet, Order.OUT, 2)  # without a station it has power for some seconds more
    fleet.run(4.0)
    assert ask(fleet, Order.OUT, 2) == ""
    assert len(fleet.mission.plans.discs_to_avoid(fleet.fleet)) == 0
    assert told[0] == () and told[-1] == (2,)
    assert "back-in --robot 2" in ask(fleet, Order.REJOIN)
    fleet.robots[2].restart(fleet.now_ns)
    assert ask(fleet, Order.BACK_IN, 2) == "" and fleet.mission.roster.active == (1,)
    fleet.run(0.5)
    assert ask(fleet, Order.REJOIN) == ""
    until(fleet, MissionState.RUNNING)
    assert set(fleet.mission.roster.active) == {1, 2} and told[-1:] == [()]

"""Progress of operators' requests, as pages and terminals are told."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from groundstation.mission.command_dispatcher import CommandResult
from groundstation.mission.gain_update import GainStage, GainStatus
from groundstation.mission.request_progress import GOALS, KEPT, RequestTracker
from groundstation.mission.single_robot import RobotTask
from groundstation.mission.state_machine import TRANSITIONS, MissionState
from groundstation.planning.feasibility import PlanError
from groundstation.planning.segment import PlanSegment
from shoal.messages.messages import Command, Mode, Order, Outcome, Progress, Reply, Trajectory, Tuning
from tests.groundstation.mission.mission_run import MissionRun

FLOWN, WANTED = Tuning("flown"), Tuning("wanted")


@dataclass
class Asked:
    """A mission by hand, and the account of what is asked for."""

    run: MissionRun = field(default_factory=lambda: MissionRun(automatic=False, settings=["duration_s=60"]))
    requests: RequestTracker = field(default_factory=lambda: RequestTracker((1, 2)))
    tuning: GainStatus = field(default_factory=lambda: GainStatus(FLOWN))

    def ask(self, order: Order, **more: Any) -> int:
        run = self.run
        assert run.mission.request(order, run.fleet(), run.now_ns, **more) == ""
        return self.requests.begin(order, run.mission)

    def step(self, seconds: float = 0.05) -> None:
        for _ in range(round(seconds / 0.05)):
            self.run.step()
            self.look()

    def look(self) -> None:
        self.requests.follow(self.run.mission, self.run.fleet(), self.tuning, self.run.answers)

    def outcome(self, number: int) -> Outcome:
        found = self.requests.outcome(number)
        assert found is not None
        return found

    def progress(self, number: int) -> Progress:
        return self.outcome(number).progress

    def fly(self) -> None:
        number = self.ask(Order.START)
        self.step(1.0)
        assert self.progress(number) is Progress.DONE
        assert self.run.at(MissionState.RUNNING)


def test_every_request_that_the_mission_takes_leads_somewhere() -> None:
    assert {row.cause for row in TRANSITIONS if isinstance(row.cause, Order)} | {Order.END} == set(GOALS)
    for row in TRANSITIONS:
        if isinstance(row.cause, Order):
            assert row.to in GOALS[row.cause].through | GOALS[row.cause].to, row


def test_a_request_is_done_when_every_robot_has_done_it() -> None:
    asked = Asked()
    for order in (Order.LOAD, Order.ARM, Order.START, Order.HOLD, Order.RESUME, Order.DISARM):
        if order is Order.ARM:
            asked = Asked()  # nothing is armed twice
        if order is Order.START:
            asked = Asked()
        number = asked.ask(order)
        assert asked.progress(number) is Progress.UNDER_WAY, order
        asked.step(1.5)
        found = asked.outcome(number)
        assert (found.progress, found.confirmed, found.waiting) == (Progress.DONE, (1, 2), ()), order


def test_a_stop_is_confirmed_robot_by_robot() -> None:
    asked = Asked()
    asked.fly()
    asked.run.robots[2].silent = True
    number = asked.ask(Order.STOP)
    asked.step(1.0)
    found = asked.outcome(number)
    assert (found.progress, found.confirmed, found.waiting) == (Progress.UNDER_WAY, (1,), (2,))
    assert found.why == ("not heard for 9.0 s",)
    asked.run.robots[2].silent = False
    asked.step(0.5)
    assert (asked.progress(number), asked.outcome(number).confirmed) == (Progress.DONE, (1, 2))


def test_a_refusal_is_shown_until_the_robot_has_obeyed() -> None:
    asked = Asked()
    asked.fly()
    asked.run.robots[2].refuses = frozenset({Order.STOP})
    number = asked.ask(Order.STOP)
    asked.step(0.5)
    assert asked.outcome(number).why == ("I refuse",)
    asked.run.robots[2].refuses = frozenset()
    asked.step(0.5)
    assert (asked.progress(number), asked.outcome(number).why) == (Progress.DONE, ())


def test_a_stage_that_a_robot_does_not_follow_fails_with_its_reason() -> None:
    asked = Asked()
    asked.run.robots[2].refuses = frozenset({Order.ARM})
    number = asked.ask(Order.START)
    asked.step(11.0)
    found = asked.outcome(number)
    assert (found.progress, found.waiting, found.why) == (Progress.FAILED, (1, 2), ("is armed", "I refuse"))
    assert "robot 2 does not follow ARM" in found.reason


@pytest.mark.parametrize("found", [True, False])
def test_places_are_gone_to_or_the_planner_says_why_not(found: bool) -> None:
    """An experiment whose path can be changed; the plan itself is made elsewhere."""
    asked = Asked()
    asked.fly()
    mission = asked.run.mission
    number = asked.requests.begin(Order.GO, mission)
    # the public request would make the plan too, which this test makes elsewhere
    mission._go(Order.GO, asked.run.now_ns)
    mission.plans.by_operator = True
    asked.look()
    assert asked.progress(number) is Progress.UNDER_WAY
    if not found:
        mission.planned(PlanError("robot 1: yaw rate 6.741 rad/s exceeds the limit 1.9"), asked.run.fleet(), asked.run.now_ns)
        asked.look()
        assert asked.progress(number) is Progress.FAILED
        assert asked.outcome(number).reason.endswith("no way there: robot 1: yaw rate 6.741 rad/s exceeds the limit 1.9")
        return
    line = np.zeros((2, 4))
    there = {r: replace(t, id=f"{t.id} there", eta=line) for r, t in mission.segment.trajectories.items()}
    mission.plans.adopt(PlanSegment(there, there[1], 60.0))
    mission.state = MissionState.RUNNING
    asked.look()
    assert asked.progress(number) is Progress.DONE


def test_another_request_takes_the_place_of_one_under_way_and_the_same_is_one() -> None:
    asked = Asked()
    first = asked.ask(Order.START)
    asked.step(0.1)
    stop = asked.ask(Order.STOP)
    assert asked.outcome(first).reason == "STOP was asked for instead"
    assert asked.progress(first) is Progress.FAILED
    assert asked.ask(Order.STOP) == stop


def test_a_silent_robot_does_not_confirm_disarm() -> None:
    asked = Asked()
    asked.fly()
    asked.run.mission.roster.mark_lost(2, "silent")
    asked.run.robots[2].silent = True
    number = asked.ask(Order.DISARM)
    asked.step(1.0)
    assert (asked.progress(number), asked.outcome(number).waiting) == (Progress.FAILED, (2,))


def test_gains_are_told_apart_from_the_mission() -> None:
    asked = Asked()
    asked.fly()
    number = asked.requests.begin(Order.TUNE, asked.run.mission, WANTED.id)
    hold = asked.ask(Order.HOLD)
    asked.tuning = GainStatus(FLOWN, WANTED.id, GainStage.ASKING)
    asked.step(0.5)
    assert (asked.progress(number), asked.progress(hold)) == (Progress.UNDER_WAY, Progress.DONE)
    asked.tuning = GainStatus(FLOWN, reason="robot 2 refuses: too much")
    asked.look()
    assert (asked.progress(number), asked.outcome(number).reason) == (Progress.FAILED, "robot 2 refuses: too much")
    again = asked.requests.begin(Order.TUNE, asked.run.mission, WANTED.id)
    asked.tuning = GainStatus(WANTED)
    asked.run.robots[1].tuning_id = WANTED.id
    asked.look()
    assert (asked.progress(again), asked.outcome(again).waiting) == (Progress.UNDER_WAY, (2,))  # it came back meanwhile
    asked.run.robots[2].tuning_id = WANTED.id
    asked.look()
    assert asked.progress(again) is Progress.DONE


def test_a_run_ends_when_all_heard_robots_rest() -> None:
    asked = Asked()
    asked.fly()
    asked.run.robots[2].silent = True
    asked.run.robots[1].refuses = frozenset({Order.DISARM})
    assert asked.run.mission.request(Order.DISARM, asked.run.fleet(), asked.run.now_ns) == ""
    number = asked.requests.begin(Order.END, asked.run.mission)
    asked.step(1.0)
    assert asked.requests.ending and asked.progress(number) is Progress.UNDER_WAY
    asked.run.robots[1].refuses = frozenset()
    asked.step(25.0)  # both patiences: the silent one is given up
    assert asked.run.in_mode(1, Mode.DISARMED)
    found = asked.outcome(number)
    assert (found.progress, found.confirmed, found.waiting) == (Progress.DONE, (1,), (2,))
    assert not asked.requests.ending


def test_a_failed_thruster_test_names_the_thruster() -> None:
    asked = Asked()
    number = asked.ask(Order.TEST)
    asked.run.mission.state = MissionState.WAITING  # as if it were over
    fleet = asked.run.fleet()
    for robot, result in ((1, "passed"), (2, "thruster 3: no current")):
        state = fleet[robot].state
        assert state is not None
        fleet[robot] = replace(fleet[robot], state=replace(state, thruster_test=result))
    asked.requests.follow(asked.run.mission, fleet, asked.tuning, ())
    found = asked.outcome(number)
    assert (found.progress, found.confirmed) == (Progress.FAILED, (1,))
    assert found.why == ("is disarmed, thruster test thruster 3: no current",)


def test_the_last_outcomes_are_kept_and_no_more() -> None:
    asked = Asked()
    for _ in range(KEPT):
        asked.ask(Order.STOP)
        asked.ask(Order.CLEAR_STOP)
    robots = len(asked.run.robots)
    assert [o.request for o in asked.requests.recent] == list(range(KEPT - robots, 2 * KEPT + 1))  # the last is not over
    assert asked.requests.outcome(1) is None


def test_requests_that_are_under_way_are_known_however_many_there_are() -> None:
    """Each robot of a large fleet is sent somewhere by a terminal of its own; all are told the end when a STOP ends all at
    once."""
    asked = Asked(requests=RequestTracker(tuple(range(1, 50))))
    asked.ask(Order.START)
    tasks = [RobotTask(Order.GO, 0) for _ in range(49)]
    numbers = [asked.requests.begin_task(1, task, asked.run.mission) for task in tasks]
    asked.look()
    assert all(asked.progress(number) is Progress.UNDER_WAY for number in numbers)
    for task in tasks:
        task.progress = Progress.FAILED
    asked.look()
    assert all(asked.progress(number) is Progress.FAILED for number in numbers)


def test_an_answer_about_gains_is_no_refusal_of_the_mission() -> None:
    asked = Asked()
    number = asked.ask(Order.ARM)
    answers = [CommandResult(Command(order, 2), Reply(2, False, order.name)) for order in (Order.LOAD, Order.TUNE)]
    asked.requests.follow(asked.run.mission, asked.run.fleet(), asked.tuning, answers)
    assert asked.outcome(number).why == ("is disarmed", "LOAD")


@pytest.mark.parametrize("fit", [True, False])
def test_a_return_without_one_robot_fails_and_names_it(fit: bool) -> None:
    asked = Asked()
    asked.run.step(0.2)
    asked.run.robots[2].verified = fit
    number = asked.ask(Order.RETURN)
    asked.step(0.5)
    line = np.zeros((20, 4))
    home = {
        r: Trajectory(f"{t.id} home", 0.05, line, line, line, 0.05) for r, t in asked.run.mission.segment.trajectories.items()
    }
    asked.run.mission.planned(PlanSegment(home, home[1], 1.0, is_return=True), asked.run.fleet(), asked.run.now_ns)
    asked.step(4.0)
    assert asked.run.at(MissionState.DONE)
    found = asked.outcome(number)
    if fit:
        assert (found.progress, found.confirmed, found.waiting) == (Progress.DONE, (1, 2), ())
        return
    assert (found.progress, found.confirmed, found.waiting) == (Progress.FAILED, (1,), (2,))
    assert found.reason.startswith("robot 2 is left out: pose is MARKER, identity not verified")


def test_a_disarm_that_a_robot_cannot_confirm_any_more_fails_with_its_reason() -> None:
    asked = Asked()
    number = asked.ask(Order.DISARM)
    asked.run.step(1.0)
    assert asked.run.at(MissionState.CANCELLED)
    asked.run.robots[2].silent = True
    asked.look()
    assert (asked.progress(number), asked.outcome(number).reason) == (Progress.FAILED, "robot 2: not heard for 9.0 s")


def test_a_robot_that_is_not_disarmed_is_named_once() -> None:
    asked = Asked()
    asked.run.robots[2].refuses = frozenset({Order.DISARM})
    asked.fly()
    asked.ask(Order.DISARM)
    asked.step(25.0)
    assert asked.run.at(MissionState.FAILED)
    assert asked.run.mission.reason.count("robot 2 does not follow DISARM") == 1

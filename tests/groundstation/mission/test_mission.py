"""The mission against a fleet of simple obedient (or not) robots, with time as an argument."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from groundstation.mission.mission import ATTENDED, PATIENCE_S, STAGES, TEST_PATIENCE_S, Mission
from groundstation.mission.obstacle_monitor import ObstacleSet
from groundstation.mission.roster import Leader
from groundstation.mission.state_machine import IN_FLIGHT, TERMINAL, MissionState
from groundstation.planning.feasibility import PlanError
from groundstation.planning.segment import PlanSegment
from groundstation.telemetry import first_lost_robot, preflight
from shoal.config.experiment import load_experiment
from shoal.messages import topics
from shoal.messages.messages import CommandKind, Mode, Trajectory
from tests.groundstation.mission.mission_run import STEP_NS, MissionRun
from tests.groundstation.mission.simulated_fleet import SimulatedFleet


def test_an_automatic_mission_goes_from_waiting_to_done() -> None:
    run = MissionRun()
    run.step(6.0)
    flown = [
        MissionState.LOADING,
        MissionState.ARMING,
        MissionState.STARTING,
        MissionState.RUNNING,
        MissionState.ENDING,
        MissionState.DONE,
    ]
    assert run.states == flown
    for robot in run.robots.values():
        assert [c.order for c in robot.got] == [CommandKind.LOAD, CommandKind.ARM, CommandKind.START, CommandKind.DISARM]
        assert all(c.experiment_hash == run.experiment.hash for c in robot.got)
    assert run.mission.state is MissionState.DONE


def test_robots_start_at_one_instant_though_one_needs_a_second_order() -> None:
    run = MissionRun()
    run.robots[2].refuses = frozenset({CommandKind.START})
    while not run.robots[1].got or run.robots[1].got[-1].order is not CommandKind.START:
        run.step()
    run.step(0.1)
    run.robots[2].refuses = frozenset()
    run.step(0.6)
    assert run.in_mode(2, Mode.TRACKING)
    assert abs(run.robots[1].starts_at_ns - run.robots[2].starts_at_ns) <= STEP_NS


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"silent": True}, "not heard"),
        ({"battery_v": 10.0}, "battery 10.0 V, needs 10.5 V"),
        ({"verified": False}, "identity not verified"),
        ({"mode": Mode.FAULT, "fault": "no pose"}, "fault: no pose"),
    ],
)
def test_a_failed_preflight_names_robot_and_reason_and_arms_no_robot(change: dict[str, object], says: str) -> None:
    run = MissionRun()
    for name, value in change.items():
        setattr(run.robots[2], name, value)
    run.step(3.0)
    assert run.at(MissionState.WAITING)
    assert "robot 2" in run.mission.reason
    assert says in run.mission.reason
    assert run.robots[1].got == []


def test_a_refusal_is_told_before_the_request_with_the_same_reason() -> None:
    run = MissionRun(settings=["duration_s=60"])
    while run.mission.state is not MissionState.RUNNING:
        run.step()
    refusals = run.mission.refusals(run.fleet())
    assert set(refusals) == {CommandKind.GO, CommandKind.REJOIN}, "on a circle, with all robots in their places"
    for order, reason in refusals.items():
        assert run.mission.request(order, run.fleet(), run.now_ns, via=[(0.1, 0.1)]) == reason
    run.mission.request(CommandKind.HOLD, run.fleet(), run.now_ns)
    assert CommandKind.RESUME in run.mission.refusals(run.fleet()), "nobody holds yet"
    run.step(0.2)
    assert set(run.mission.refusals(run.fleet())) == {CommandKind.REJOIN}


def test_another_experiment_on_a_robot_is_refused() -> None:
    run = MissionRun()
    run.robots[1].experiment = load_experiment("pool", ["duration_s=3"])
    assert "another experiment" in preflight(run.experiment, run.fleet())[0]


def test_an_order_never_obeyed_fails_the_mission_and_disarms_all() -> None:
    run = MissionRun()
    run.robots[1].refuses = frozenset({CommandKind.ARM})
    run.step(PATIENCE_S + 2.0)
    assert run.at(MissionState.FAILED)
    assert run.states[-2:] == [MissionState.ABORTING, MissionState.FAILED]
    assert run.in_mode(2, Mode.DISARMED)
    assert run.mission.state is MissionState.FAILED


@pytest.mark.parametrize("change", [{"silent": True}, {"mode": Mode.FAULT, "fault": "no pose"}])
def test_a_robot_lost_in_flight_ends_the_mission_and_the_others_are_disarmed(change: dict[str, object]) -> None:
    run = MissionRun()
    while run.mission.state is not MissionState.RUNNING:
        run.step()
    for name, value in change.items():
        setattr(run.robots[2], name, value)
    assert (first_lost_robot((1, 2), run.fleet()) or (0, ""))[0] == 2
    run.step(PATIENCE_S + 1.0)
    assert run.at(MissionState.FAILED)
    assert run.in_mode(1, Mode.DISARMED)


def test_a_robot_that_holds_makes_all_hold_and_all_go_on_from_one_place() -> None:
    run = MissionRun()
    while run.robots[1].trajectory_s < 0.5:
        run.step()
    run.robots[2].mode, run.robots[2].fault = Mode.HOLDING, "pose late"
    run.step(0.2)
    assert run.at(MissionState.PAUSED)
    assert {r.mode for r in run.robots.values()} == {Mode.HOLDING}
    run.step(1.5)
    resumes = [robot.got[-1] for robot in run.robots.values()]
    assert [c.order for c in resumes] == [CommandKind.RESUME, CommandKind.RESUME]
    assert resumes[0].trajectory_s == resumes[1].trajectory_s >= 0.5
    run.step(4.0)
    assert run.at(MissionState.DONE)


def test_a_state_that_was_sent_before_the_flight_began_makes_nobody_hold() -> None:
    """A state may be as old as `topics.STATE.max_age_s`: for so long a hold that a robot reports may be an earlier one. After
    that it counts."""
    run = MissionRun()
    while run.mission.state is not MissionState.RUNNING:
        run.step()
    began_ns, robot = run.now_ns, run.robots[2]
    robot.mode = Mode.HOLDING
    while run.at(MissionState.RUNNING):
        run.step()
    assert 0 <= (run.now_ns - began_ns) * 1e-9 - topics.STATE.max_age_s <= 2 * STEP_NS * 1e-9
    assert run.at(MissionState.PAUSED) and run.mission.reason.startswith("robot 2 holds")


def test_a_hold_by_an_operator_lasts_until_an_operator_resumes() -> None:
    run = MissionRun()
    while run.mission.state is not MissionState.RUNNING:
        run.step()
    assert run.mission.request(CommandKind.HOLD, run.fleet(), run.now_ns) == ""
    run.step(5.0)
    assert run.at(MissionState.PAUSED)
    assert run.mission.request(CommandKind.RESUME, run.fleet(), run.now_ns) == ""
    run.step(4.0)
    assert run.at(MissionState.DONE)


@pytest.mark.parametrize(("settings", "turns"), [([], True), (["vehicle=vectored"], False)])
def test_a_formation_goes_on_when_its_robots_have_had_the_time_to_turn_to_their_paths(
    settings: list[str], turns: bool
) -> None:
    """Headings are free in HOLD. A robot with side thrust sets out at any heading."""
    waits_s = []
    for heading_rad in (0.0, 1.0, -3.0, 6.28):
        run = MissionRun(settings=["duration_s=60", *settings])
        for robot in run.robots.values():
            robot.battery_v = run.experiment.vehicle.battery.full_v
        while run.mission.state is not MissionState.RUNNING:
            run.step()
        assert run.mission.request(CommandKind.HOLD, run.fleet(), run.now_ns) == ""
        run.step(1.0)
        run.robots[2].eta = (0.0, 0.0, 0.0, heading_rad)
        assert run.mission.request(CommandKind.RESUME, run.fleet(), run.now_ns) == ""
        run.step(0.5)
        resumes = [robot.got[-1] for robot in run.robots.values()]
        assert {command.order for command in resumes} == {CommandKind.RESUME} and len({c.start_ns for c in resumes}) == 1
        waits_s.append((resumes[0].start_ns - run.now_ns) * 1e-9)
    least_s, some_s, most_s, whole_turn_s = waits_s
    assert whole_turn_s == pytest.approx(least_s, abs=0.1)
    limits, inertia = run.experiment.vehicle.limits, run.experiment.vehicle.mass.yaw_kg_m2
    by_moment_s, by_rate_s = 2.0 * math.sqrt(3.0 * inertia / limits.wrench[2]), 3.0 / limits.yaw_rate_radps
    if turns:
        assert least_s < some_s < most_s and max(by_moment_s, by_rate_s) < most_s - least_s < 1.01 * (by_moment_s + by_rate_s)
    else:
        assert some_s == most_s == least_s


def paused_beyond(settings: Sequence[str] = (), beyond_m: float = 0.06) -> MissionRun:
    """A mission whose robots, on a straight path at 0.1 m/s, came to rest beyond the point at which they were told to hold."""
    run = MissionRun(automatic=False, settings=["duration_s=60", *settings])
    time_s = 0.05 * np.arange(1200, dtype=np.float64)
    eta, velocity = np.zeros((2, 1200, 4))
    eta[:, 0], velocity[:, 0] = 0.1 * time_s, 0.1
    trajectories = {r: Trajectory(f"t{r}", 0.05, eta, velocity, np.zeros_like(eta)) for r in run.experiment.robot_ids}
    segment = PlanSegment(trajectories, trajectories[1], run.experiment.duration_s)
    run.mission = Mission(run.experiment, segment, dict.fromkeys(run.experiment.robot_ids, np.zeros(4)), False, None)
    assert run.mission.request(CommandKind.START, run.fleet(), run.now_ns) == ""
    run.step(2.0)
    for robot in run.robots.values():
        robot.trajectory_s = (run.now_ns - robot.starts_at_ns) * 1e-9
    run.step()
    assert run.mission.request(CommandKind.HOLD, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    for robot in run.robots.values():
        robot.eta = robot.holds_at = (0.1 * robot.trajectory_s + beyond_m, 0.02, 0.0, 2.0)
    return run


def test_a_formation_goes_on_from_where_it_came_to_rest() -> None:
    """A robot that stops comes to rest beyond the point of its path at which it was told to."""
    run = paused_beyond()
    stopped_s = run.robots[1].trajectory_s
    run.robots[2].eta = run.robots[2].holds_at = (0.1 * stopped_s + 0.03, 0.02, 0.0, 2.0)
    assert run.mission.request(CommandKind.RESUME, run.fleet(), run.now_ns) == ""
    run.step(0.2)
    goes_on = {robot.got[-1].trajectory_s - stopped_s for robot in run.robots.values()}
    assert len(goes_on) == 1 and goes_on.pop() == pytest.approx(0.45, abs=0.06)  # between 0.6 and 0.3 s


def test_a_formation_loses_no_pace_while_its_robots_turn_to_their_paths() -> None:
    run = paused_beyond(["mission.wait_from_m=0.01", "mission.wait_at_m=0.02"])
    assert run.mission.request(CommandKind.RESUME, run.fleet(), run.now_ns) == ""
    run.step(0.2)
    began_ns = run.robots[1].starts_at_ns
    while run.now_ns < began_ns - STEP_NS:
        run.step()
        assert run.mission.governor.lag_s == 0.0 and run.mission.governor.rate == 1.0
    run.step(2.0)
    assert run.mission.governor.lag_s > 0.0


def test_time_zero_of_a_flight_stays_when_it_is_held_resumed_and_brought_home_and_is_new_with_a_new_start() -> None:
    run = MissionRun(automatic=False, settings=["duration_s=60"])
    assert run.mission.request(CommandKind.START, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    began_ns = run.mission.began_ns
    assert run.at(MissionState.RUNNING) and 0 < began_ns <= run.now_ns
    for order in (CommandKind.HOLD, CommandKind.RESUME):
        assert run.mission.request(order, run.fleet(), run.now_ns) == ""
        run.step(1.0)
        assert run.mission.began_ns == began_ns, order
    assert run.at(MissionState.RUNNING)
    for order in (CommandKind.DISARM, CommandKind.RETURN):
        assert run.mission.request(order, run.fleet(), run.now_ns) == ""
        run.step(1.0)
    run.mission.planned(replace(next_leg(run, 0.05), is_return=True), run.fleet(), run.now_ns)
    run.step(1.0)
    assert run.mission.state is MissionState.RETURNING and run.mission.began_ns == began_ns, "the report counts from it too"
    for order in (CommandKind.DISARM, CommandKind.START):
        assert run.mission.request(order, run.fleet(), run.now_ns) == ""
        run.step(1.0)
    assert run.mission.began_ns > began_ns + 2 * 10**9


def test_a_fleet_that_is_ready_waits_for_a_person_without_a_reason() -> None:
    """A reason to wait is something that a person has to mend first."""
    run = MissionRun(automatic=False)
    run.robots[2].unknown = True
    run.step()
    assert run.at(MissionState.WAITING) and "robot 2" in run.mission.reason
    run.robots[2].unknown = False
    for is_out in (True, False):  # a person's hand in it is no reason either: here it is always a person who starts
        run.mission.note_water(2, is_out)
    run.step()
    assert run.at(MissionState.WAITING) and run.mission.reason == ""


def test_a_start_that_is_held_begins_at_the_beginning_after_an_earlier_flight_of_the_same_path() -> None:
    """Robots still have the trajectory, and their clocks stand where the earlier flight ended."""
    run = running(automatic=False)
    while run.robots[1].trajectory_s < 1.0:
        run.step()
    assert run.mission.request(CommandKind.DISARM, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.mission.request(CommandKind.START, run.fleet(), run.now_ns) == ""
    while not run.at(MissionState.STARTING):
        run.step()
    assert run.mission.request(CommandKind.HOLD, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.at(MissionState.PAUSED) and run.mission.plans.progress_s == 0.0
    assert run.mission.request(CommandKind.RESUME, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    assert [robot.got[-1].trajectory_s for robot in run.robots.values()] == [0.0, 0.0]


def test_a_mission_that_never_gets_ready_fails_with_its_reason_where_nobody_attends() -> None:
    run = MissionRun(give_up_s=5.0)
    run.robots[2].battery_v = 10.0
    run.step(4.9)
    assert run.at(MissionState.WAITING)
    run.step(2.0)
    assert run.at(MissionState.FAILED)
    assert "no progress for 5 s, and nobody attends: waiting for the fleet: robot 2: battery 10.0 V" in run.mission.reason


def test_a_mission_that_holds_for_ever_fails_with_its_reason_where_nobody_attends() -> None:
    run = MissionRun(give_up_s=5.0)
    while run.mission.state is not MissionState.RUNNING:
        run.step()
    run.robots[2].mode, run.robots[2].fault = Mode.HOLDING, "no way round"
    run.robots[1].refuses = run.robots[2].refuses = frozenset({CommandKind.RESUME})
    run.step(4.0)
    assert run.mission.state not in TERMINAL
    run.step(8.0)
    assert run.at(MissionState.FAILED)
    assert run.in_mode(1, Mode.DISARMED) and run.in_mode(2, Mode.DISARMED)
    assert run.mission.reason.startswith("no progress for 5 s, and nobody attends: ")


def test_a_mission_that_a_person_attends_or_that_goes_on_is_not_given_up() -> None:
    attended = MissionRun(give_up_s=1.0)
    while attended.mission.state is not MissionState.RUNNING:
        attended.step()
    assert attended.mission.request(CommandKind.HOLD, attended.fleet(), attended.now_ns) == ""
    attended.step(5.0)
    assert attended.at(MissionState.PAUSED)
    goes_on = MissionRun(give_up_s=1.0)
    goes_on.step(6.0)
    assert goes_on.at(MissionState.DONE)


def test_stop_is_latched_on_every_robot_until_cleared() -> None:
    run = MissionRun(automatic=False)
    assert run.mission.request(CommandKind.START, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.at(MissionState.RUNNING)
    run.robots[2].refuses = frozenset({CommandKind.STOP})
    assert run.mission.request(CommandKind.STOP, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.in_mode(1, Mode.STOPPED)
    run.robots[2].refuses = frozenset()
    run.step(0.5)  # asked again and again
    assert run.in_mode(2, Mode.STOPPED)
    assert "only when" in run.mission.request(CommandKind.START, run.fleet(), run.now_ns)
    assert run.mission.request(CommandKind.CLEAR_STOP, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.at(MissionState.WAITING)
    assert {r.mode for r in run.robots.values()} == {Mode.DISARMED}


def test_an_automatic_mission_waits_for_a_request_after_a_cleared_stop() -> None:
    """All are still near their starts, fit and disarmed: just what an automatic mission waits for to begin."""
    run = MissionRun()
    while run.mission.state is not MissionState.RUNNING:
        run.step()
    assert run.mission.request(CommandKind.STOP, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.mission.request(CommandKind.CLEAR_STOP, run.fleet(), run.now_ns) == ""
    run.step(5.0)
    assert run.at(MissionState.WAITING)
    assert {r.mode for r in run.robots.values()} == {Mode.DISARMED}
    assert run.mission.request(CommandKind.START, run.fleet(), run.now_ns) == ""
    run.step(6.0)
    assert run.at(MissionState.DONE)


THREE = "robots=[{id=1,node_m=[0,0.4,0]},{id=2,node_m=[0,-0.4,0]},{id=3,node_m=[0.8,0,0]}]"


def three_running(policy: str) -> MissionRun:
    run = MissionRun(settings=[THREE, f'mission.lost="{policy}"'])
    while run.mission.state is not MissionState.RUNNING:
        run.step()
    run.step(0.5)
    return run


def test_with_policy_hold_a_robot_that_first_holds_and_then_fails_keeps_the_others_holding() -> None:
    """No pose for 0.2 s, then for half a second: the usual way to be lost."""
    run = three_running("hold")
    run.robots[2].mode, run.robots[2].fault = Mode.HOLDING, "pose late"
    run.step(0.3)
    assert run.at(MissionState.PAUSED)
    run.robots[2].mode, run.robots[2].fault = Mode.FAULT, "no pose"
    run.step(5.0)
    assert run.at(MissionState.PAUSED)
    assert run.mission.reason == "robot 2: fault (no pose)"
    assert {run.robots[r].mode for r in (1, 3)} == {Mode.HOLDING}
    assert run.mission.request(CommandKind.RESUME, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.at(MissionState.DEGRADED)


def test_with_policy_hold_a_robot_lost_while_all_resume_makes_the_others_hold_again() -> None:
    run = three_running("hold")
    run.mission.request(CommandKind.HOLD, run.fleet(), run.now_ns)
    run.step(0.5)
    run.robots[2].refuses = frozenset({CommandKind.RESUME})
    run.mission.request(CommandKind.RESUME, run.fleet(), run.now_ns)
    run.step(0.5)
    assert run.at(MissionState.RESUMING)
    run.robots[2].silent = True
    run.step(3.0)
    assert run.at(MissionState.PAUSED)
    assert {run.robots[r].mode for r in (1, 3)} == {Mode.HOLDING}


@pytest.mark.parametrize("policy", ["hold", "go-on", "close-up"])
def test_a_robot_that_was_silent_and_flies_on_is_held(policy: str) -> None:
    run = three_running(policy)
    run.robots[2].silent = True
    run.step(0.2)
    assert run.mission.roster.lost == {2: "silent"}
    run.robots[2].silent = False
    assert run.in_mode(2, Mode.TRACKING)
    run.step(0.2)
    assert run.in_mode(2, Mode.HOLDING)


def test_a_gap_stays_open_until_an_operator_resumes_the_held_robots() -> None:
    run = three_running("close-up")
    run.mission.request(CommandKind.HOLD, run.fleet(), run.now_ns)
    run.step(0.5)
    run.robots[2].mode, run.robots[2].fault = Mode.FAULT, "no pose"
    run.step(3.0)
    assert run.at(MissionState.PAUSED)
    assert run.mission.reason == "robot 2: fault (no pose)"
    assert run.mission.request(CommandKind.RESUME, run.fleet(), run.now_ns) == ""
    run.step(0.2)
    assert run.at(MissionState.HALTING)
    assert set(run.mission.roster.slots_in_use().values()) == {1, 2}


@pytest.mark.parametrize("then", ["carried off", "out", "another form"])
def test_a_gap_closes_whatever_else_happens_to_the_held_robots(then: str) -> None:
    """Nobody moves while a person holds; the next plan, whatever it is made for, has no gap."""
    run = three_running("close-up")
    run.mission.request(CommandKind.HOLD, run.fleet(), run.now_ns)
    run.step(0.5)
    run.robots[2].mode, run.robots[2].fault = Mode.FAULT, "no pose"
    run.step(0.5)
    assert set(run.mission.roster.slots_in_use().values()) == {1, 3}
    order, text = CommandKind.RESUME, ""
    if then == "carried off":
        run.robots[1].eta = (3.0, 0.0, 0.0, 0.0)
    elif then == "out":
        run.robots[2].mode = Mode.DISARMED
        run.mission.note_water(2, True)
    else:
        order, text = CommandKind.FORMATION, "line 1.0"
    run.step(0.5)
    assert run.mission.request(order, run.fleet(), run.now_ns, text=text) == ""
    run.step(0.2)
    assert run.at(MissionState.HALTING)
    assert set(run.mission.roster.slots_in_use().values()) == {1, 2}


def test_a_gap_is_forgotten_with_the_robot_that_rejoins() -> None:
    """Another one that a person leads later leaves none that the others were to close."""
    run = three_running("close-up")
    run.mission.request(CommandKind.HOLD, run.fleet(), run.now_ns)
    run.step(0.5)
    run.robots[2].mode = Mode.FAULT
    run.step(0.5)
    run.robots[2].mode = Mode.DISARMED
    run.step(0.5)
    assert run.mission.request(CommandKind.REJOIN, run.fleet(), run.now_ns) == ""
    run.step(0.2)
    assert run.mission.roster.active == (1, 2, 3)
    run.robots[2].mode = Mode.HOLDING
    run.mission.request(CommandKind.HOLD, run.fleet(), run.now_ns)
    run.mission.lead(1, CommandKind.DISARM)
    assert 1 in run.mission.roster.lost
    assert run.mission.request(CommandKind.RESUME, run.fleet(), run.now_ns) == ""
    run.step(0.2)
    assert set(run.mission.roster.slots_in_use().values()) == {2, 3}


def test_a_thruster_test_after_a_run_includes_its_lost_robot() -> None:
    run = three_running("go-on")
    run.robots[2].mode, run.robots[2].fault = Mode.FAULT, "thrusters do not do as told"
    run.step(0.5)
    assert run.mission.roster.lost
    run.mission.request(CommandKind.DISARM, run.fleet(), run.now_ns)
    run.step(1.0)
    run.robots[2].fault = ""
    assert run.mission.request(CommandKind.TEST, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.at(MissionState.TESTING)
    assert [robot.got[-1].order for robot in run.robots.values()] == [CommandKind.TEST] * 3


def test_a_way_home_asked_for_while_a_detour_is_planned_is_not_that_detour() -> None:
    run = MissionRun(settings=['path={kind="waypoints",points_m=[[-1,0],[1,0]],speed_mps=0.1}'])
    while run.mission.state is not MissionState.RUNNING:
        run.step()
    assert run.mission.request(CommandKind.GO, run.fleet(), run.now_ns, [(0.5, 0.5)]) == ""
    run.step()
    replan = run.mission.plan_request
    assert replan is not None
    assert run.mission.request(CommandKind.RETURN, run.fleet(), run.now_ns) == ""
    assert run.mission.plan_request is None
    run.step(0.5)
    assert run.at(MissionState.HALTING)
    assert run.mission.plan_request is not None and run.mission.plan_request is not replan
    assert run.mission.plan_request.plan().is_return


def test_a_place_outside_the_pool_is_refused_before_anybody_leaves_the_path() -> None:
    """Robots refuse a trajectory that leaves the pool, walls or not; the formation would hold then."""
    straight = ['path={kind="waypoints",points_m=[[-1,0],[1,0]],speed_mps=0.1}', "pool.walls=false"]
    run = MissionRun(settings=straight)
    while run.mission.state is not MissionState.RUNNING:
        run.step()
    places = [(1.0, 1.0), (0.0, 1.3)]
    assert run.mission.request(CommandKind.GO, run.fleet(), run.now_ns, places) == "(0, 1.3) m is outside the pool"
    assert run.at(MissionState.RUNNING)
    assert run.mission.request(CommandKind.GO, run.fleet(), run.now_ns, places[:1]) == ""


def test_robots_that_an_earlier_station_stopped_are_cleared_by_the_order_that_preflight_asks_for() -> None:
    run = MissionRun(automatic=False)
    run.robots[2].mode, run.robots[2].fault = Mode.STOPPED, "emergency stop"
    run.step(1.0)
    assert "(clear the stop)" in run.mission.reason
    assert run.mission.request(CommandKind.CLEAR_STOP, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.at(MissionState.WAITING)
    assert run.in_mode(2, Mode.DISARMED)


def test_without_being_asked_a_manual_mission_arms_nothing() -> None:
    run = MissionRun(automatic=False)
    run.step(3.0)
    assert all(robot.got == [] for robot in run.robots.values())
    run.robots[1].silent = True
    assert "robot 1: not heard" in run.mission.request(CommandKind.START, run.fleet(), run.now_ns)
    run.robots[1].silent = False
    assert run.mission.request(CommandKind.LOAD, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert [c.order for c in run.robots[1].got] == [CommandKind.LOAD]
    assert run.mission.request(CommandKind.ARM, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.in_mode(1, Mode.ARMED)
    assert run.at(MissionState.ARMING)
    assert run.mission.request(CommandKind.START, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.in_mode(1, Mode.TRACKING)


def test_a_robot_lost_before_the_start_aborts_it_with_its_reason() -> None:
    """Not ten seconds of orders that it cannot follow, and then what it said to the last of them."""
    run = MissionRun()
    run.robots[2].refuses = frozenset({CommandKind.START})
    while not run.at(MissionState.STARTING):
        run.step()
    run.step(0.2)
    run.robots[2].mode, run.robots[2].fault = Mode.FAULT, "no pose"
    run.step(0.1)
    assert run.at(MissionState.ABORTING)
    assert run.mission.reason == "robot 2: fault (no pose)"
    run.step(0.5)
    assert run.at(MissionState.FAILED)
    assert run.in_mode(1, Mode.DISARMED)


@pytest.mark.parametrize("state", [MissionState.ARMING, MissionState.STARTING])
def test_a_robot_that_was_armed_and_restarts_before_the_start_is_not_armed_again(state: MissionState) -> None:
    run = MissionRun(automatic=False)
    run.robots[1].refuses = frozenset({CommandKind.START})
    order = CommandKind.ARM if state is MissionState.ARMING else CommandKind.START
    assert run.mission.request(order, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.at(state)
    run.robots[2].mode, run.robots[2].loaded = Mode.DISARMED, ""
    run.step(0.1)
    assert run.at(MissionState.ABORTING) and run.mission.reason == "robot 2: disarmed"
    run.step(0.5)
    assert run.at(MissionState.FAILED) and {r.mode for r in run.robots.values()} == {Mode.DISARMED}
    assert [c.order for c in run.robots[2].got].count(CommandKind.ARM) == 1


@pytest.mark.parametrize(
    ("order", "before", "lost"),
    [
        (CommandKind.TEST, Mode.ARMED, "abort"),
        (CommandKind.TEST, Mode.DISARMED, "abort"),
        (CommandKind.ARM, Mode.ARMED, "abort"),
        (CommandKind.RETURN, Mode.DISARMED, "hold"),
    ],
)
def test_a_robot_that_is_armed_and_restarts_is_not_armed_again_for_the_same_request(
    order: CommandKind, before: Mode, lost: str
) -> None:
    """Robot 2 is not armed yet when robot 1 restarts, whichever of the two requests it was armed for."""
    run = MissionRun(False, [f'mission.lost="{lost}"'])
    run.step(0.2)
    run.robots[1].mode, run.robots[2].refuses = before, frozenset({CommandKind.ARM})
    run.step(0.2)
    assert run.mission.request(order, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    if order is CommandKind.RETURN:
        run.mission.planned(replace(next_leg(run, 4.0), is_return=True), run.fleet(), run.now_ns)
    run.step(0.5)
    assert run.mission.state in (MissionState.TEST_ARMING, MissionState.ARMING, MissionState.REARMING)
    assert run.robots[1].mode is Mode.ARMED
    run.robots[1].mode, run.robots[1].loaded = Mode.DISARMED, ""
    run.robots[1].got.clear()
    run.step(2.0)
    assert CommandKind.ARM not in [c.order for c in run.robots[1].got]
    assert run.robots[1].mode is Mode.DISARMED


def test_a_robot_that_restarts_before_anybody_hears_that_it_was_armed_is_not_armed_again() -> None:
    run = MissionRun(False)
    run.robots[2].refuses = frozenset({CommandKind.ARM})
    run.step(0.2)
    assert run.mission.request(CommandKind.ARM, run.fleet(), run.now_ns) == ""
    while run.robots[1].mode is not Mode.ARMED:
        run.step()
    run.robots[1].mode, run.robots[1].loaded = Mode.DISARMED, ""
    run.step(1.0)
    assert [c.order for c in run.robots[1].got].count(CommandKind.ARM) == 1


def test_a_robot_that_was_disarmed_just_before_a_request_is_armed_for_it() -> None:
    """That it was armed before is heard after the request."""
    run = MissionRun(False)
    run.step(1.0)
    run.robots[1].mode, run.robots[1].age_s = Mode.ARMED, 0.25
    run.robots[1].refuses = run.robots[2].refuses = frozenset({CommandKind.LOAD})
    assert run.mission.request(CommandKind.ARM, run.fleet(), run.now_ns) == ""
    run.step(0.2)
    run.robots[1].mode, run.robots[1].age_s = Mode.DISARMED, 0.02
    run.robots[1].refuses = run.robots[2].refuses = frozenset()
    run.step(1.0)
    assert run.at(MissionState.ARMING) and {r.mode for r in run.robots.values()} == {Mode.ARMED}


def test_rejoin_is_refused_while_the_others_return() -> None:
    """That way has no places for robots that are out."""
    run = MissionRun()
    roster = run.mission.roster
    roster.mark_lost(2, "silent")

    def why_not(segment: PlanSegment) -> str:
        run.mission.plans.segment = segment
        return run.mission.objection(CommandKind.REJOIN, run.fleet())

    outward, home = run.mission.segment, replace(run.mission.segment, is_return=True)
    assert "way back" in why_not(home)
    assert "way back" not in why_not(outward)
    roster.reinstate((2,))
    assert why_not(home) == "no robot is out"


# --- in step


def running(settings: Sequence[str] = (), automatic: bool = True) -> MissionRun:
    run = MissionRun(automatic, ["duration_s=60", *settings])
    if not automatic:
        assert run.mission.request(CommandKind.START, run.fleet(), run.now_ns) == ""
    while run.mission.state is not MissionState.RUNNING:
        run.step()
    run.step(1.0)
    return run


def test_a_second_start_names_the_same_instant_as_the_first() -> None:
    run = MissionRun()
    run.robots[2].refuses = frozenset({CommandKind.START})
    while not run.at(MissionState.STARTING):
        run.step()
    run.step(1.2)
    run.robots[2].refuses = frozenset()
    run.step(0.5)
    assert run.at(MissionState.RUNNING)
    (first,), several = ([c for c in r.got if c.order is CommandKind.START] for r in run.robots.values())
    assert len(several) > 3 and {(c.start_ns, c.trajectory_s) for c in several} == {(first.start_ns, first.trajectory_s)}
    assert abs(run.robots[1].trajectory_s - run.robots[2].trajectory_s) < 0.06


@pytest.mark.parametrize(
    ("by_s", "says"), [(-0.8, "robot 2 is 0.8 s behind the others"), (0.7, "is 0.7 s ahead of the others")]
)
def test_a_robot_out_of_step_makes_all_hold_and_all_go_on_from_where_the_others_were(by_s: float, says: str) -> None:
    run = running()
    run.robots[2].trajectory_s += by_s
    run.step(0.25)
    assert run.at(MissionState.RUNNING)  # it may be a state that came late
    run.step(0.2)
    assert run.at(MissionState.PAUSED) and says in run.mission.reason
    assert {r.mode for r in run.robots.values()} == {Mode.HOLDING}
    others_s = run.robots[1].trajectory_s
    run.step(2.0)
    assert run.at(MissionState.RUNNING) and run.mission.reason == ""
    resumed = [r.got[-1] for r in run.robots.values()]
    assert [c.order for c in resumed] == [CommandKind.RESUME] * 2
    assert [c.trajectory_s for c in resumed] == pytest.approx([others_s] * 2, abs=0.11)


@pytest.mark.parametrize("by_s", [-0.4, 0.4])
def test_a_robot_a_little_out_of_step_flies_on(by_s: float) -> None:
    run = running()
    run.robots[2].trajectory_s += by_s
    run.step(3.0)
    assert run.at(MissionState.RUNNING)


def test_a_robot_that_is_out_of_step_for_a_moment_now_and_then_flies_on() -> None:
    """States that jump about are no reason to hold; nor is what was seen before a hold one after it."""
    run = running()
    for _ in range(4):
        run.robots[2].trajectory_s -= 0.8
        run.step(0.2)
        run.robots[2].trajectory_s += 0.8
        run.step(0.1)
    assert run.at(MissionState.RUNNING)
    run.robots[2].trajectory_s -= 0.8
    run.step(0.2)
    assert run.mission.request(CommandKind.HOLD, run.fleet(), run.now_ns) == ""
    run.step(0.2)
    assert run.mission.request(CommandKind.RESUME, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    run.robots[2].trajectory_s -= 0.8
    run.step(0.2)
    assert run.at(MissionState.RUNNING)


def test_a_resume_does_not_go_back_to_a_robot_far_behind() -> None:
    run = running(automatic=False)
    run.step(10.0)
    run.robots[2].trajectory_s = 0.0
    run.step(1.0)
    assert run.at(MissionState.PAUSED)
    assert run.mission.request(CommandKind.RESUME, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    assert {r.got[-1].order for r in run.robots.values()} == {CommandKind.RESUME}
    assert {r.got[-1].trajectory_s > 10.0 for r in run.robots.values()} == {True}


def test_a_robot_that_starts_out_of_step_makes_all_hold() -> None:
    run = MissionRun(settings=["duration_s=60"])
    run.robots[1].refuses = frozenset({CommandKind.START})
    while not run.in_mode(2, Mode.TRACKING):
        run.step()
    run.robots[2].starts_at_ns += 2_000_000_000
    run.step(1.5)
    assert MissionState.PAUSED in run.states and MissionState.RUNNING not in run.states


def test_a_robot_on_another_plan_than_the_others_makes_all_hold() -> None:
    run = running()
    run.robots[2].loaded = "of yesterday"
    run.step(0.5)
    assert run.at(MissionState.PAUSED)
    assert run.mission.reason == "robot 2 flies another plan than the others"


def test_all_hold_before_anybody_goes_on() -> None:
    run = running(automatic=False)
    run.robots[2].refuses = frozenset({CommandKind.HOLD})
    assert run.mission.request(CommandKind.HOLD, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    assert run.mission.request(CommandKind.RESUME, run.fleet(), run.now_ns) == "robot 2 does not hold yet (TRACKING)"
    run.robots[2].refuses = frozenset()
    run.step(0.5)
    assert run.mission.request(CommandKind.RESUME, run.fleet(), run.now_ns) == ""


def test_a_stalled_station_moves_no_reference() -> None:
    """The lag that robots extrapolate from the last heartbeat is the one that the next heartbeat tells."""
    run = running(["mission.wait_from_m=0.1", "mission.wait_at_m=0.2"])
    pace = run.mission.governor
    pace.rate, pace.lag_s = 0.1, 1.0
    run.now_ns += 500_000_000
    run.mission.step(run.fleet(), (), run.now_ns)
    assert pace.lag_s == pytest.approx(1.0 + 0.9 * 0.5)
    run.now_ns += 1_000_000  # and one that comes early
    run.mission.step(run.fleet(), (), run.now_ns)
    assert pace.lag_s == pytest.approx(1.45 + 0.9 * 0.001, abs=2e-4)


# --- deadlines


STRAIGHT = 'path={kind="waypoints",points_m=[[-1,0],[1,0]],speed_mps=0.1}'


def next_leg(run: MissionRun, begin_s: float) -> PlanSegment:
    still = np.zeros((200, 4))
    trajectories = {r: Trajectory(f"n{r}", 0.05, still, still, still, begin_s) for r in run.experiment.robot_ids}
    return PlanSegment(trajectories, trajectories[1], 60.0)


def going_elsewhere() -> MissionRun:
    run = running([STRAIGHT, "duration_s=20"], automatic=False)
    assert run.mission.request(CommandKind.GO, run.fleet(), run.now_ns, [(0.5, 0.5)]) == ""
    return run


def test_a_plan_that_does_not_come_in_time_makes_all_hold() -> None:
    run = going_elsewhere()
    run.step(1.5)
    assert run.at(MissionState.SWITCHING)
    run.step(0.5)
    assert run.at(MissionState.PAUSED)
    assert run.mission.reason == "no plan in time"
    assert run.mission.request(CommandKind.RESUME, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.at(MissionState.RUNNING)


def test_a_late_switch_makes_all_hold_and_replan_from_rest() -> None:
    run = going_elsewhere()
    run.robots[2].refuses = frozenset({CommandKind.SWITCH})
    run.mission.planned(next_leg(run, 3.0), run.fleet(), run.now_ns)
    run.step(1.5)
    assert run.robots[1].loaded == "n1" and run.robots[2].loaded == "t2"
    run.step(0.5)
    assert run.at(MissionState.PAUSED)
    assert run.mission.reason == "robot 2 has not gone over in time: robot 2 refuses SWITCH: I refuse"
    assert run.mission.request(CommandKind.RESUME, run.fleet(), run.now_ns) == ""
    assert run.at(MissionState.HALTING)
    run.step(0.2)
    assert run.mission.plan_request is not None
    run.mission.planned(next_leg(run, 4.0), run.fleet(), run.now_ns)
    run.step(2.0)
    assert run.at(MissionState.RUNNING)
    assert {r.loaded for r in run.robots.values()} == {"n1", "n2"}
    assert all(CommandKind.RESUME not in [c.order for c in r.got] for r in run.robots.values())


def test_a_robot_that_does_not_hold_while_all_come_to_rest_ends_the_mission() -> None:
    run = running(automatic=False)
    run.robots[2].refuses = frozenset({CommandKind.HOLD})
    assert run.mission.request(CommandKind.RETURN, run.fleet(), run.now_ns) == ""
    run.step(PATIENCE_S - 0.5)
    assert run.at(MissionState.HALTING)
    run.step(1.0)
    assert MissionState.ABORTING in run.states
    run.step(1.0)
    assert run.at(MissionState.FAILED) and run.mission.reason == "robot 2 does not follow HOLD"
    assert {r.mode for r in run.robots.values()} == {Mode.DISARMED}


def test_a_thruster_test_is_refused_while_a_robot_holds() -> None:
    """It would have been sent ARM, and have refused, for ten seconds; restarted in that time, it would have been armed."""
    run = MissionRun(automatic=False)
    run.robots[2].mode = Mode.HOLDING
    assert run.mission.request(CommandKind.TEST, run.fleet(), run.now_ns) == "robot 2 holds: disarm it first"
    assert run.at(MissionState.WAITING)


def test_a_robot_under_power_is_not_sent_arm() -> None:
    run = MissionRun(automatic=False)
    assert run.mission.request(CommandKind.TEST, run.fleet(), run.now_ns) == ""
    run.robots[2].mode = Mode.HOLDING  # a person was quicker
    run.step(1.0)
    assert run.at(MissionState.TEST_ARMING)
    assert CommandKind.ARM not in [command.order for command in run.robots[2].got]


@pytest.mark.parametrize("ends_it", [CommandKind.RETURN, CommandKind.DISARM])
def test_a_thruster_test_after_a_run_begins_no_other(ends_it: CommandKind) -> None:
    """A person has sent an automatic mission's fleet back, or disarmed it: all are at their starts, fit and disarmed. It waits
    for just that to begin."""
    run = running()
    assert run.mission.request(ends_it, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    if ends_it is CommandKind.RETURN:
        run.mission.planned(replace(next_leg(run, 0.05), is_return=True), run.fleet(), run.now_ns)
        run.step(70.0)
    assert run.mission.state in TERMINAL
    for robot in run.robots.values():
        robot.test = "passed"
    assert run.mission.request(CommandKind.TEST, run.fleet(), run.now_ns) == ""
    run.step(10.0)
    assert run.at(MissionState.WAITING) and run.mission.reason == ATTENDED
    assert {r.mode for r in run.robots.values()} == {Mode.DISARMED}
    assert run.mission.request(CommandKind.START, run.fleet(), run.now_ns) == ""
    run.step(2.0)
    assert run.at(MissionState.RUNNING)


def test_a_gap_is_closed_also_after_a_person_has_led_another_robot() -> None:
    run = three_running("close-up")
    run.mission.lead(3, CommandKind.HOLD)
    run.step(1.0)
    run.robots[2].silent = True
    run.step(0.5)
    assert MissionState.HALTING in run.states and run.mission.roster.active == (1,)


def test_a_thruster_test_that_does_not_end_is_given_up() -> None:
    run = MissionRun(automatic=False)
    run.robots[1].test = "passed"
    assert run.mission.request(CommandKind.TEST, run.fleet(), run.now_ns) == ""
    run.step(TEST_PATIENCE_S)
    assert run.at(MissionState.TESTING)
    run.robots[2].test = "running"
    run.step(2.0)
    assert run.at(MissionState.FAILED) and "the thruster test does not end: {1: 'passed', 2: 'running'}" in run.mission.reason
    assert {r.mode for r in run.robots.values()} == {Mode.DISARMED}


def test_patience_for_a_robot_begins_when_it_stops_confirming() -> None:
    """Trajectories lie loaded for a while; then an agent is restarted, and has none."""
    run = MissionRun(automatic=False)
    assert run.mission.request(CommandKind.LOAD, run.fleet(), run.now_ns) == ""
    run.step(PATIENCE_S + 1.0)
    run.robots[2].loaded, run.robots[2].refuses = "", frozenset({CommandKind.LOAD})
    run.step(PATIENCE_S - 1.0)
    assert run.at(MissionState.LOADING)
    run.robots[2].refuses = frozenset()
    run.step(0.5)
    assert run.at(MissionState.LOADING) and run.robots[2].loaded == "t2"
    run.robots[2].loaded, run.robots[2].refuses = "", frozenset({CommandKind.LOAD})
    run.step(PATIENCE_S + 1.0)
    assert run.states[-2:] == [MissionState.ABORTING, MissionState.FAILED]
    assert "robot 2 does not follow LOAD: robot 2 refuses LOAD: I refuse" in run.mission.reason


# --- lost on the way to a new plan


def on_the_way_to_a_plan(policy: str, state: MissionState) -> MissionRun:
    """Three robots, sent home, in this state."""
    run = running([THREE, f'mission.lost="{policy}"'], automatic=False)
    assert run.mission.request(CommandKind.RETURN, run.fleet(), run.now_ns) == ""
    run.step(0.2)
    if state is not MissionState.HALTING:
        for robot in run.robots.values():
            robot.refuses = frozenset({CommandKind.LOAD} if state is MissionState.RELOADING else {CommandKind.START})
        run.mission.planned(replace(next_leg(run, 4.0), is_return=True), run.fleet(), run.now_ns)
        run.step(0.3)
    if state is MissionState.REARMING:  # those who hold are armed, and it takes no time
        run.mission.state = state
    assert run.at(state)
    return run


SILENT: dict[str, object] = {"silent": True}
FAULTY: dict[str, object] = {"mode": Mode.FAULT, "fault": "no pose"}
RESTARTED: dict[str, object] = {"mode": Mode.DISARMED, "loaded": ""}
LOST_WHERE = [MissionState.HALTING, MissionState.RELOADING, MissionState.REARMING, MissionState.RELEASING]


@pytest.mark.parametrize("state", LOST_WHERE)
@pytest.mark.parametrize("how", [SILENT, FAULTY, RESTARTED])
@pytest.mark.parametrize(
    ("policy", "leads_to"),
    [
        ("abort", MissionState.ABORTING),
        ("hold", MissionState.PAUSED),
        ("go-on", MissionState.HALTING),
        ("close-up", MissionState.HALTING),
    ],
)
def test_a_robot_lost_while_a_plan_is_made_is_the_policys_affair(
    policy: str, leads_to: MissionState, how: dict[str, object], state: MissionState
) -> None:
    run = on_the_way_to_a_plan(policy, state)
    old = run.mission.plan_request
    for name, value in how.items():
        setattr(run.robots[2], name, value)
    run.step()
    assert run.at(leads_to)
    assert "robot 2: " in run.mission.reason
    assert (2 in run.mission.roster.lost) == (policy != "abort")
    if leads_to is MissionState.HALTING:  # a plan that counts on the robot is not flown
        for robot in run.robots.values():
            robot.refuses = frozenset()
        run.step(0.3)
        assert run.mission.plan_request is not None and run.mission.plan_request is not old
        assert set(run.mission.plan_request.plan().trajectories) == {1, 3}
    elif leads_to is MissionState.PAUSED:
        run.step(1.0)
        assert run.at(MissionState.PAUSED) and {run.robots[r].mode for r in (1, 3)} == {Mode.HOLDING}


def test_robots_that_lie_disarmed_are_not_lost_while_a_plan_home_is_made() -> None:
    run = MissionRun(automatic=False)
    run.step(0.2)
    assert run.mission.request(CommandKind.RETURN, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    assert run.at(MissionState.HALTING) and run.mission.roster.lost == {}
    run.mission.planned(replace(next_leg(run, 0.05), is_return=True), run.fleet(), run.now_ns)
    run.step(2.0)
    assert run.at(MissionState.RETURNING)


def test_robots_that_lie_disarmed_and_have_no_way_home_say_so() -> None:
    run = MissionRun(automatic=False)
    run.step(0.2)
    assert run.mission.request(CommandKind.RETURN, run.fleet(), run.now_ns) == ""
    run.step(0.2)
    run.mission.planned(PlanError("an island is in the way"), run.fleet(), run.now_ns)
    run.step(1.0)
    assert run.at(MissionState.FAILED)
    assert run.mission.reason == "no way from here: an island is in the way"


def test_a_robot_that_should_rejoin_stays_out_when_there_is_no_way() -> None:
    run = three_running("go-on")
    run.robots[2].mode = Mode.DISARMED
    run.step(0.2)
    assert run.mission.request(CommandKind.REJOIN, run.fleet(), run.now_ns) == ""
    run.step(0.2)
    run.mission.planned(PlanError("an island is in the way"), run.fleet(), run.now_ns)
    run.step(1.0)
    assert run.at(MissionState.PAUSED) and "no way from here" in run.mission.reason
    assert run.mission.roster.lost == {2: "disarmed"}
    assert {run.robots[r].mode for r in (1, 3)} == {Mode.HOLDING}


@pytest.mark.parametrize("state", LOST_WHERE)
def test_a_person_can_hold_robots_that_wait_for_a_plan(state: MissionState) -> None:
    run = on_the_way_to_a_plan("abort", state)
    assert run.mission.request(CommandKind.HOLD, run.fleet(), run.now_ns) == ""
    run.step(3.0)
    assert run.at(MissionState.PAUSED)
    assert {r.mode for r in run.robots.values()} == {Mode.HOLDING}


def test_robots_that_lie_disarmed_cannot_be_held() -> None:
    run = MissionRun(automatic=False)
    run.step(0.2)
    assert run.mission.request(CommandKind.RETURN, run.fleet(), run.now_ns) == ""
    run.step(0.2)
    assert run.mission.request(CommandKind.HOLD, run.fleet(), run.now_ns) == "no robot is armed"
    assert run.at(MissionState.HALTING)


def test_a_plan_uses_the_fleet_as_known_at_its_request() -> None:
    """It is computed in another thread: robots that are lost meanwhile would be missing from one half of it."""
    run = on_the_way_to_a_plan("go-on", MissionState.HALTING)
    wanted = run.mission.plan_request
    assert wanted is not None
    run.robots[2].silent = True
    run.step(0.2)
    assert run.mission.roster.active == (1, 3)
    assert set(wanted.plan().trajectories) == {1, 2, 3}


@pytest.mark.parametrize("is_return", [True, False])
def test_an_obstacle_on_a_transfer_makes_robots_rest_and_replan(is_return: bool) -> None:
    """With policy go-on a robot that is lost was to be gone when the other comes by. The new plan leads where the transfer
    led, also where the last plan that was asked for was to lead home."""
    run = running([THREE, 'mission.lost="go-on"', "mission.detours=true"], automatic=False)
    assert run.mission.request(CommandKind.RETURN, run.fleet(), run.now_ns) == ""
    run.step(0.2)
    away = next_leg(run, 3.0)
    eta = np.zeros((200, 4))
    eta[:, 0] = np.linspace(-1.0, 1.0, 200)
    ways = {**away.trajectories, 1: replace(away.trajectories[1], eta=eta), 3: replace(away.trajectories[3], eta=eta + 1.0)}
    transfer = replace(away, trajectories=ways, is_return=is_return, transfer_end_s=13.0, end_s=13.0)
    run.mission.planned(transfer, run.fleet(), run.now_ns)
    run.step(2.0)
    assert run.at(MissionState.RETURNING if is_return else MissionState.RUNNING)
    if is_return:
        run.robots[2].mode, run.robots[2].fault = Mode.FAULT, "no pose"
    else:
        run.mission.plans.monitor.update(ObstacleSet((1,), np.array([[0.0, 0.0, 0.2]])), 0)
    run.step(0.1)
    assert run.at(MissionState.HALTING)
    assert "on the path of robot 1" in run.mission.reason
    assert run.mission.plans.targets_return == is_return
    run.step(0.3)
    assert run.mission.plan_request is not None
    if is_return:
        plan = run.mission.plan_request.plan()
        assert plan.is_return and set(plan.trajectories) == {1, 3}


def test_no_robot_flies_home_onto_a_thing_that_lies_on_a_start() -> None:
    """Neither when it lies there before, nor when it comes to lie there under way. When it is gone they go on."""
    fleet = SimulatedFleet(load_experiment("pool", ("duration_s=60.0",)))

    def request(order: CommandKind, state: MissionState, seconds: float = 8.0) -> None:
        assert fleet.core.request(order, fleet.fleet, fleet.now_ns)[0] == ""
        fleet.run(seconds)
        assert fleet.mission.state is state, fleet.mission.reason

    start = fleet.starts[1]
    thing = ObstacleSet((1,), np.array([[start[0] + 0.1, start[1], 0.1]]))
    fleet.run(1.0)
    request(CommandKind.START, MissionState.RUNNING)
    fleet.obstacles = thing
    request(CommandKind.RETURN, MissionState.PAUSED)
    assert "where robot 1 should come to rest" in fleet.mission.reason
    fleet.obstacles = ObstacleSet()
    request(CommandKind.RETURN, MissionState.RETURNING, 4.0)
    fleet.obstacles = thing
    fleet.run(8.0)
    assert fleet.mission.state is MissionState.PAUSED
    fleet.obstacles = ObstacleSet()
    request(CommandKind.RESUME, MissionState.RETURNING)


# --- how a run ends


def test_a_run_disarmed_by_an_operator_does_not_succeed() -> None:
    run = running()
    assert run.mission.request(CommandKind.DISARM, run.fleet(), run.now_ns) == ""
    run.robots[2].refuses = frozenset({CommandKind.DISARM})
    run.step(0.5)
    run.robots[2].refuses = frozenset()
    run.step(0.5)
    assert run.at(MissionState.CANCELLED)
    assert run.mission.reason == "a person asked for disarm while running"
    assert run.mission.request(CommandKind.DISARM, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    assert run.at(MissionState.CANCELLED)
    assert run.mission.request(CommandKind.LOAD, run.fleet(), run.now_ns) == ""
    assert run.mission.request(CommandKind.START, run.fleet(), run.now_ns) == ""
    run.step(65.0)
    assert run.at(MissionState.DONE)
    assert run.mission.request(CommandKind.DISARM, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    assert run.at(MissionState.DONE)  # what was done stays done


def test_the_reason_why_a_run_failed_is_not_lost_for_a_refusal() -> None:
    run = running()
    run.robots[2].mode, run.robots[2].fault, run.robots[2].refuses = Mode.FAULT, "no pose", frozenset({CommandKind.DISARM})
    run.robots[1].refuses = frozenset({CommandKind.DISARM})
    run.step(1.0)
    run.robots[1].refuses = frozenset()
    run.step(1.0)
    assert run.at(MissionState.FAILED)
    assert run.mission.reason == "robot 2: fault (no pose)"


@pytest.mark.parametrize(
    ("order", "ends_in"), [(CommandKind.DISARM, MissionState.ENDING), (CommandKind.CLEAR_STOP, MissionState.CLEARING)]
)
def test_a_robot_never_heard_confirms_nothing(order: CommandKind, ends_in: MissionState) -> None:
    run = MissionRun(automatic=False)
    run.robots[2].unknown = True
    run.step(0.2)
    assert run.mission.request(order, run.fleet(), run.now_ns) == ""
    run.step(PATIENCE_S - 1.0)
    assert run.at(ends_in)
    run.step(2.0)
    assert run.at(MissionState.ABORTING)
    run.step(PATIENCE_S - 2.0)
    assert run.at(MissionState.ABORTING)
    run.step(3.0)
    assert run.at(MissionState.FAILED)
    assert f"robot 2 does not follow {order.name}" in run.mission.reason


def test_a_state_from_before_the_command_confirms_nothing() -> None:
    """Its last word was that it is disarmed; then it was armed, and not heard any more."""
    run = MissionRun(automatic=False)
    run.step(0.2)
    run.robots[2].silent = True
    assert run.mission.request(CommandKind.DISARM, run.fleet(), run.now_ns) == ""
    run.step(5.0)
    assert run.at(MissionState.ENDING)
    run.robots[2].silent = False
    run.step(0.2)
    assert run.at(MissionState.CANCELLED)


def test_a_robot_armed_after_its_last_state_is_still_disarmed() -> None:
    """Its last state is from before; whoever took that for done would leave an armed robot behind."""
    run = MissionRun(automatic=False)
    assert run.mission.request(CommandKind.ARM, run.fleet(), run.now_ns) == ""
    while not run.in_mode(2, Mode.ARMED):
        run.step()
    before = run.fleet()
    assert run.in_mode(2, Mode.ARMED) and run.mission.request(CommandKind.DISARM, before, run.now_ns) == ""
    disarmed = {r: replace(view, state=replace(view.state, mode=Mode.DISARMED)) for r, view in before.items() if view.state}
    orders = run.mission.step(disarmed, (), run.now_ns + 10_000_000)
    assert [(c.order, c.robot) for c in orders] == [(CommandKind.DISARM, 1), (CommandKind.DISARM, 2)]
    assert run.at(MissionState.ENDING)


def test_the_result_of_an_earlier_thruster_test_is_ignored() -> None:
    run = MissionRun(automatic=False)
    for robot in run.robots.values():
        robot.test, robot.age_s = "passed", 0.2
    assert run.mission.request(CommandKind.TEST, run.fleet(), run.now_ns) == ""
    while not run.at(MissionState.TESTING):
        run.step()
    run.step(0.2)
    assert run.at(MissionState.TESTING)
    for robot in run.robots.values():
        robot.test, robot.age_s = "thruster 3 does not turn", 0.02
    while not run.at(MissionState.TEST_ENDING):
        run.step()
    assert run.mission.reason.startswith("robot 1: thruster 3 does not turn")


@pytest.mark.parametrize("order", [CommandKind.START, CommandKind.RESUME])
def test_a_robot_that_does_not_start_with_the_others_is_waited_for_briefly(order: CommandKind) -> None:
    run = running(automatic=False) if order is CommandKind.RESUME else MissionRun(automatic=False, settings=["duration_s=60"])
    if order is CommandKind.RESUME:
        assert run.mission.request(CommandKind.HOLD, run.fleet(), run.now_ns) == ""
        run.step(0.5)
    run.robots[2].refuses = frozenset({order})
    assert run.mission.request(order, run.fleet(), run.now_ns) == ""
    while not run.in_mode(1, Mode.TRACKING):
        run.step()
    run.step(3.0)
    assert run.mission.state in (MissionState.STARTING, MissionState.RESUMING)
    run.step(1.0)
    assert MissionState.ABORTING in run.states and f"robot 2 refuses {order.name}: I refuse" in run.mission.reason
    assert {r.mode for r in run.robots.values()} == {Mode.DISARMED}


def test_a_formation_on_its_way_home_is_not_sent_elsewhere() -> None:
    run = on_the_way_to_a_plan("abort", MissionState.RELEASING)
    for robot in run.robots.values():
        robot.refuses = frozenset()
    while not run.at(MissionState.RUNNING):
        run.step()
    assert "on their way back" in run.mission.request(CommandKind.GO, run.fleet(), run.now_ns, [(0.5, 0.5)])


def test_robots_held_on_a_way_home_that_is_blocked_since_get_another_one() -> None:
    run = running([STRAIGHT, "duration_s=20"], automatic=False)
    assert run.mission.request(CommandKind.RETURN, run.fleet(), run.now_ns) == ""
    run.step(0.2)
    eta = np.zeros((200, 4))
    eta[:, 0] = np.linspace(-1.0, 1.0, 200)
    segment = next_leg(run, 3.0)
    run.mission.planned(
        replace(
            segment, trajectories={r: replace(t, eta=eta) for r, t in segment.trajectories.items()}, is_return=True, end_s=13.0
        ),
        run.fleet(),
        run.now_ns,
    )
    for robot in run.robots.values():
        robot.eta = (-1.0, 0.0, 0.0, 0.0)
    run.step(2.0)
    assert run.at(MissionState.RETURNING)
    assert run.mission.request(CommandKind.HOLD, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    run.mission.plans.monitor.update(ObstacleSet((1,), np.array([[0.5, 0.0, 0.1]])), run.now_ns)
    assert run.mission.request(CommandKind.RESUME, run.fleet(), run.now_ns) == ""
    assert run.at(MissionState.HALTING) and run.mission.plans.targets_return


@pytest.mark.parametrize("away_m", [0.1, 1.1])
def test_a_robot_that_rests_beside_its_path_is_led_back_before_resume(away_m: float) -> None:
    """A person carried it off, or it came to rest beside a bend. Sent on from there, it would be off its plan by as much."""
    run = running(automatic=False)
    assert run.mission.request(CommandKind.HOLD, run.fleet(), run.now_ns) == ""
    run.robots[2].eta = (0.0, away_m, 0.0, 0.0)
    run.step(0.5)
    assert run.mission.request(CommandKind.RESUME, run.fleet(), run.now_ns) == ""
    assert run.at(MissionState.HALTING) and run.mission.reason == f"robot 2 is {away_m:.2f} m from its place"
    assert all(CommandKind.RESUME not in [c.order for c in robot.got] for robot in run.robots.values())


def test_robots_that_still_move_go_on_from_where_they_come_to_rest() -> None:
    """Not from where they are when they are told to: they coast beyond it before their paths begin to move."""
    run = paused_beyond(beyond_m=0.04)
    for robot in run.robots.values():
        robot.holds_at = (0.1 * robot.trajectory_s + 0.06, 0.02, 0.0, 2.0)
    stopped_s = run.robots[1].trajectory_s
    assert run.mission.request(CommandKind.RESUME, run.fleet(), run.now_ns) == ""
    run.step(0.2)
    assert run.robots[1].got[-1].trajectory_s - stopped_s == pytest.approx(0.6, abs=0.06)


# --- after an emergency stop


def test_clear_stop_waits_for_robots_that_the_stop_has_not_reached() -> None:
    run = running(automatic=False)
    run.robots[2].refuses = frozenset({CommandKind.STOP})
    assert run.mission.request(CommandKind.STOP, run.fleet(), run.now_ns) == ""
    run.step(0.1)
    assert run.mission.request(CommandKind.CLEAR_STOP, run.fleet(), run.now_ns) == "robot 2 has not stopped yet (TRACKING)"
    assert run.at(MissionState.STOPPED)
    run.robots[2].refuses = frozenset()
    run.step(0.5)
    assert run.mission.request(CommandKind.CLEAR_STOP, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    assert run.at(MissionState.WAITING) and {r.mode for r in run.robots.values()} == {Mode.DISARMED}


@pytest.mark.parametrize("age_s", [0.02, 0.6])
def test_a_robot_that_is_heard_again_and_flies_while_a_stop_is_cleared_is_disarmed(age_s: float) -> None:
    """Also one whose states come late: they were sent since."""
    run = running(automatic=False)
    run.robots[2].silent = True
    assert run.mission.request(CommandKind.STOP, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    assert run.mission.request(CommandKind.CLEAR_STOP, run.fleet(), run.now_ns) == ""
    run.step(0.2)
    assert run.at(MissionState.CLEARING)
    run.robots[2].silent, run.robots[2].age_s = False, age_s
    run.robots[2].refuses = frozenset({CommandKind.CLEAR_STOP})  # as a robot that is not stopped does
    run.step(0.5 + 2.0 * age_s)
    assert run.at(MissionState.FAILED) and run.mission.reason == "robot 2 has not stopped: it is TRACKING"
    assert {r.mode for r in run.robots.values()} == {Mode.DISARMED}


def test_clear_stop_reaches_robots_that_have_not_reported_the_stop() -> None:
    """They say that they are disarmed, which was so before the STOP that is on its way."""
    run = MissionRun(automatic=False)
    run.step(0.2)
    before = run.fleet()
    assert run.mission.request(CommandKind.STOP, before, run.now_ns) == ""
    assert run.mission.request(CommandKind.CLEAR_STOP, before, run.now_ns) == ""
    orders = run.mission.step(before, (), run.now_ns + 10_000_000)
    assert [(c.order, c.robot) for c in orders] == [(CommandKind.CLEAR_STOP, 1), (CommandKind.CLEAR_STOP, 2)]
    assert run.at(MissionState.CLEARING)


def test_a_thruster_test_after_a_cleared_stop_does_not_begin_an_automatic_mission() -> None:
    run = running()
    assert run.mission.request(CommandKind.STOP, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    assert run.mission.request(CommandKind.CLEAR_STOP, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    assert run.mission.request(CommandKind.TEST, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    for robot in run.robots.values():
        robot.test = "passed"
    run.step(3.0)
    assert run.at(MissionState.WAITING) and run.states[-2] is MissionState.TEST_ENDING
    assert {r.mode for r in run.robots.values()} == {Mode.DISARMED}


# --- home


def test_a_return_arms_no_robot_that_preflight_blocks() -> None:
    run = MissionRun(automatic=False, settings=["mission.thruster_test=true"])
    run.step(0.2)
    untested = "thruster test: not done (groundstation mission test)"
    refused = f"no robot is fit to move; robot 1: {untested}; robot 2: {untested}"
    assert run.mission.request(CommandKind.RETURN, run.fleet(), run.now_ns) == refused
    assert run.at(MissionState.WAITING)
    run.robots[1].test, run.robots[1].eta = "passed", (0.9, 0.9, 0.0, 0.0)  # far from its start: that is why it returns
    assert run.mission.request(CommandKind.RETURN, run.fleet(), run.now_ns) == ""
    assert run.mission.roster.lost == {2: untested}
    run.step(0.5)
    run.mission.planned(replace(next_leg(run, 0.05), is_return=True), run.fleet(), run.now_ns)
    run.step(2.0)
    assert run.at(MissionState.RETURNING)
    assert run.in_mode(1, Mode.TRACKING) and run.in_mode(2, Mode.DISARMED)


# --- links that lose one way


@pytest.mark.parametrize("policy", ["hold", "go-on", "close-up"])
def test_a_lost_robot_is_sent_hold_though_its_states_do_not_arrive(policy: str) -> None:
    run = three_running(policy)
    last_view = run.robots[2].view()
    run.robots[2].silent = run.robots[2].hears = True
    run.robots[2].view = lambda: replace(last_view, state_age_s=9.0)  # type: ignore[method-assign]  # its last word: TRACKING
    run.step(0.5)
    assert run.mission.roster.lost == {2: "silent"}
    assert run.in_mode(2, Mode.HOLDING)


def test_a_lost_robot_that_still_hears_is_disarmed_with_the_others() -> None:
    run = three_running("go-on")
    last_view = run.robots[2].view()
    run.robots[2].silent = run.robots[2].hears = True
    run.robots[2].view = lambda: replace(last_view, state_age_s=9.0)  # type: ignore[method-assign]
    run.step(0.5)
    assert run.mission.request(CommandKind.DISARM, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    assert run.at(MissionState.CANCELLED)  # nobody waits for it
    assert run.in_mode(2, Mode.DISARMED)


def test_a_lost_robot_returns_after_the_run_when_the_others_cannot() -> None:
    run = three_running("go-on")
    run.robots[2].mode, run.robots[2].fault = Mode.FAULT, "no pose"
    run.step(0.5)
    assert run.mission.request(CommandKind.DISARM, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.at(MissionState.CANCELLED) and set(run.mission.roster.lost) == {2}
    run.robots[2].fault = ""
    for robot in (1, 3):
        run.robots[robot].battery_v = 10.0
    assert run.mission.request(CommandKind.RETURN, run.fleet(), run.now_ns) == ""
    assert set(run.mission.roster.lost) == {1, 3}


def test_a_robot_far_from_its_place_slows_the_formation() -> None:
    run = MissionRun(settings=["duration_s=60", "mission.wait_from_m=0.1", "mission.wait_at_m=0.4"])
    while not run.at(MissionState.RUNNING):
        run.step()
    run.robots[2].eta = (0.35, 0.0, 0.0, 0.0)
    run.step(1.5)
    assert run.at(MissionState.SLOWED) and run.mission.reason == "robot 2 is 0.35 m from its place"


def test_a_robot_that_disarms_when_its_way_home_is_blocked_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """It lay disarmed before this return, and might be while that was planned; it has flown since."""
    run = MissionRun(automatic=False)
    run.step(0.2)
    assert run.mission.request(CommandKind.RETURN, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    run.mission.planned(replace(next_leg(run, 0.05), is_return=True), run.fleet(), run.now_ns)
    run.step(2.0)
    assert run.at(MissionState.RETURNING)
    monkeypatch.setattr(run.mission.plans, "first_contact", lambda fleet, now_ns: "on the way of robot 1")
    run.step()
    assert run.at(MissionState.HALTING)
    run.robots[2].mode = Mode.DISARMED
    run.step(0.2)
    assert run.mission.reason == "robot 2: disarmed" and run.in_mode(1, Mode.DISARMED)


def test_rejoin_takes_in_who_is_fit_and_leaves_out_who_is_not() -> None:
    run = three_running("go-on")
    run.robots[3].silent = True
    run.robots[2].mode = Mode.FAULT
    run.step(0.5)
    assert set(run.mission.roster.lost) == {2, 3}
    run.robots[2].mode, run.robots[2].fault = Mode.HOLDING, ""
    run.step(0.5)
    assert run.mission.request(CommandKind.REJOIN, run.fleet(), run.now_ns) == ""
    assert set(run.mission.roster.lost) == {3}


def test_a_stop_that_one_robot_missed_to_clear_is_cleared_later() -> None:
    run = running(automatic=False)
    run.mission.request(CommandKind.STOP, run.fleet(), run.now_ns)
    run.step(1.0)
    run.robots[2].silent = True
    assert run.mission.request(CommandKind.CLEAR_STOP, run.fleet(), run.now_ns) == ""
    run.step(PATIENCE_S * 2.0 + 1.0)
    assert run.at(MissionState.FAILED)
    reason = run.mission.reason
    run.robots[2].silent = False
    assert run.mission.request(CommandKind.DISARM, run.fleet(), run.now_ns) == ""
    run.step(PATIENCE_S * 2.0 + 1.0)
    assert run.at(MissionState.FAILED) and run.mission.reason
    assert "robot 2" in reason
    assert run.mission.request(CommandKind.CLEAR_STOP, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.at(MissionState.WAITING)
    assert {robot.mode for robot in run.robots.values()} == {Mode.DISARMED}


def test_disarm_when_all_is_over_keeps_the_reason() -> None:
    run = running(automatic=False)
    run.mission.request(CommandKind.DISARM, run.fleet(), run.now_ns)
    run.step(1.0)
    assert run.at(MissionState.CANCELLED)
    reason = run.mission.reason
    run.mission.request(CommandKind.DISARM, run.fleet(), run.now_ns)
    run.step(1.0)
    assert (run.mission.state, run.mission.reason) == (MissionState.CANCELLED, reason)
    assert "disarm while running" in reason


@pytest.mark.parametrize(
    ("ends", "verdict"),
    [(CommandKind.DISARM, MissionState.CANCELLED), (CommandKind.STOP, MissionState.STOPPED), (None, MissionState.FAILED)],
)
def test_a_start_after_a_flight_that_passed_has_a_verdict_of_its_own(
    ends: CommandKind | None, verdict: MissionState | None
) -> None:
    run = MissionRun(automatic=False)
    assert run.mission.request(CommandKind.START, run.fleet(), run.now_ns) == ""
    run.step(6.0)
    assert run.at(MissionState.DONE) and run.mission.verdict is MissionState.DONE
    run.robots[2].refuses = frozenset({CommandKind.ARM})
    assert run.mission.request(CommandKind.START, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.at(MissionState.ARMING)
    if ends is not None:
        assert run.mission.request(ends, run.fleet(), run.now_ns) == ""
    run.step(PATIENCE_S + 1.0)
    assert run.mission.verdict is verdict


def test_the_way_home_after_a_stop_is_no_success_of_the_flight_that_was_stopped() -> None:
    fleet = SimulatedFleet(load_experiment("pool"))
    fleet.run(1.0)
    for order in (CommandKind.START, CommandKind.STOP, CommandKind.CLEAR_STOP, CommandKind.RETURN):
        assert fleet.core.request(order, fleet.fleet, fleet.now_ns)[0] == ""
        fleet.run(6.0 if order is CommandKind.START else 1.0)
    while fleet.mission.state not in TERMINAL:
        fleet.step()
    assert (fleet.mission.state, fleet.mission.verdict) == (MissionState.DONE, MissionState.STOPPED)


def test_a_run_that_is_over_can_be_started_again_and_a_test_keeps_its_verdict() -> None:
    run = MissionRun(automatic=False)
    assert run.mission.request(CommandKind.START, run.fleet(), run.now_ns) == ""
    run.step(6.0)
    assert run.at(MissionState.DONE)
    assert run.mission.request(CommandKind.TEST, run.fleet(), run.now_ns) == ""
    for robot in run.robots.values():
        robot.test = "passed"
    run.step(2.0)
    assert run.at(MissionState.WAITING) and run.mission.verdict is MissionState.DONE
    # nobody flies for these alone: a run that is ended now is done
    for order, leads_to in ((CommandKind.LOAD, MissionState.LOADING), (CommandKind.ARM, MissionState.ARMING)):
        assert run.mission.request(order, run.fleet(), run.now_ns) == ""
        run.step(1.0)
        assert run.at(leads_to) and run.mission.verdict is MissionState.DONE
    assert run.mission.request(CommandKind.DISARM, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    run.robots[2].refuses = frozenset({CommandKind.ARM})
    assert run.mission.request(CommandKind.START, run.fleet(), run.now_ns) == ""
    run.step(PATIENCE_S + 1.0)
    assert run.at(MissionState.FAILED)
    run.robots[2].refuses = frozenset()
    assert run.mission.request(CommandKind.START, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.at(MissionState.RUNNING) and run.mission.verdict is None
    run.step(6.0)
    assert run.at(MissionState.DONE) and run.mission.verdict is MissionState.DONE
    assert run.mission.request(CommandKind.START, run.fleet(), run.now_ns) == ""


@pytest.mark.parametrize("after", ["test", "stop", "armed alone"])
def test_a_failure_after_a_run_leaves_its_verdict(after: str) -> None:
    run = MissionRun(automatic=False)
    assert run.mission.request(CommandKind.START, run.fleet(), run.now_ns) == ""
    run.step(6.0)
    assert run.at(MissionState.DONE)
    ends = MissionState.FAILED
    if after == "test":
        assert run.mission.request(CommandKind.TEST, run.fleet(), run.now_ns) == ""
        run.robots[2].silent = True
    else:
        assert run.mission.request(CommandKind.STOP, run.fleet(), run.now_ns) == ""
        run.step(0.5)
        run.robots[2].silent = after == "stop"
        assert run.mission.request(CommandKind.CLEAR_STOP, run.fleet(), run.now_ns) == ""
    if after == "armed alone":
        run.step(1.0)
        run.robots[1].mode, ends = Mode.ARMED, MissionState.CANCELLED
        assert run.mission.request(CommandKind.DISARM, run.fleet(), run.now_ns) == ""
    run.step(30.0)
    assert run.at(ends)
    assert run.mission.verdict is MissionState.DONE


def test_hold_while_planning_leaves_out_a_robot_that_is_disarmed() -> None:
    """It was to be armed for the plan, and cannot hold."""
    run = three_running("go-on")
    run.mission.request(CommandKind.DISARM, run.fleet(), run.now_ns)
    run.step(1.0)
    assert run.mission.request(CommandKind.RETURN, run.fleet(), run.now_ns) == ""
    run.robots[1].mode = run.robots[3].mode = Mode.HOLDING
    assert run.mission.request(CommandKind.HOLD, run.fleet(), run.now_ns) == ""
    assert run.mission.roster.lost == {2: "disarmed"}


@pytest.mark.parametrize("again", [CommandKind.RESUME, CommandKind.RETURN])
def test_a_return_from_rest_that_was_held_leads_home_and_flies_no_path(again: CommandKind) -> None:
    """Robots that people led away hold in the water, and have the plan of an earlier flight."""
    fleet = SimulatedFleet(load_experiment("pool", ("duration_s=12.0",)))
    flown: list[bool] = []
    fleet.on_cycle = lambda: flown.append(fleet.mission.segment.is_return) if fleet.mission.state in IN_FLIGHT else None

    def ask(order: CommandKind, only: int = 0) -> str:
        return fleet.core.request(order, fleet.fleet, fleet.now_ns, only=only)[0]

    fleet.run(0.5)
    assert ask(CommandKind.START) == ""
    fleet.run(3.0)
    assert ask(CommandKind.DISARM) == ""
    fleet.run(1.0)
    for order in (CommandKind.ARM, CommandKind.HOLD):
        assert [ask(order, robot) for robot in fleet.robots] == [""] * len(fleet.robots)
        fleet.run(0.5)
    flown.clear()
    assert ask(CommandKind.RETURN) == "" and ask(CommandKind.HOLD) == ""
    fleet.run(1.0)
    assert fleet.mission.state.name == "PAUSED" and fleet.mission.plans.progress_s == 0.0
    assert ask(again) == ""
    for _ in range(800):
        fleet.step()
    assert fleet.mission.state is MissionState.DONE and flown and all(flown)
    assert all(np.hypot(*(r.eta[:2] - fleet.starts[r.id][:2])) < 0.1 for r in fleet.robots.values())


def test_another_form_is_planned_in_flight_and_flown_once_all_have_it() -> None:
    run = MissionRun(settings=['path={kind="waypoints",points_m=[[-1,0],[1,0]],speed_mps=0.1}'])
    while run.mission.state is not MissionState.RUNNING:
        run.step()
    assert "'trinagle': must read" in run.mission.request(CommandKind.FORMATION, run.fleet(), run.now_ns, text="trinagle 1")
    assert run.mission.request(CommandKind.FORMATION, run.fleet(), run.now_ns, text="line 1.0") == ""
    assert run.at(MissionState.SWITCHING)
    request = run.mission.plan_request
    assert request is not None
    held = PlanSegment(run.mission.segment.trajectories, run.mission.segment.centre, run.mission.segment.end_s)
    run.mission.planned(held, run.fleet(), run.now_ns)
    run.step(0.2)
    assert run.at(MissionState.RUNNING)
    assert run.mission.segment is held


def test_a_form_that_cannot_be_flown_leaves_the_formation_in_its_own() -> None:
    run = MissionRun(settings=['path={kind="waypoints",points_m=[[-1,0],[1,0]],speed_mps=0.1}'])
    while run.mission.state is not MissionState.RUNNING:
        run.step()
    before = run.mission.segment
    assert run.mission.request(CommandKind.FORMATION, run.fleet(), run.now_ns, text="line 1.0") == ""
    run.mission.planned(PlanError("robot 1: too fast"), run.fleet(), run.now_ns)
    assert run.at(MissionState.RUNNING)
    assert run.mission.segment is before
    assert run.mission.reason == "no way there: robot 1: too fast"


def test_from_a_hold_another_form_is_planned_from_rest_and_then_flown() -> None:
    run = MissionRun(settings=['path={kind="waypoints",points_m=[[-1,0],[1,0]],speed_mps=0.1}'])
    while run.mission.state is not MissionState.RUNNING:
        run.step()
    assert run.mission.request(CommandKind.HOLD, run.fleet(), run.now_ns) == ""
    run.step(0.3)
    assert run.mission.request(CommandKind.FORMATION, run.fleet(), run.now_ns, text="line 1.0") == ""
    run.step(0.3)
    assert run.at(MissionState.HALTING)
    assert run.mission.plan_request is not None and run.mission.plan_request.name == "from rest"


@pytest.mark.parametrize(
    ("two", "reason"),
    [
        (False, "robot 2: its poses are by another experiment (another"),
        (True, "robot 2: two programs publish its poses by turns"),
    ],
)
def test_robots_whose_poses_are_not_the_runs_hold_until_they_are(two: bool, reason: str) -> None:
    run = MissionRun(automatic=False, settings=["duration_s=20"])
    assert run.mission.request(CommandKind.START, run.fleet(), run.now_ns) == ""
    run.step(2.0)
    assert run.at(MissionState.RUNNING)
    well, robot = run.robots[2].localizer_hash, run.robots[2]
    robot.localizer_hash, robot.two_pose_senders = well if two else "another one", two
    run.step(0.5)
    assert run.at(MissionState.PAUSED) and run.mission.reason.startswith(reason)
    assert {robot.mode for robot in run.robots.values()} == {Mode.HOLDING}
    for order in (CommandKind.RESUME, CommandKind.RETURN):
        assert run.mission.request(order, run.fleet(), run.now_ns).startswith(reason)
    robot.localizer_hash, robot.two_pose_senders = run.experiment.hash, False
    run.step(0.5)
    assert run.mission.request(CommandKind.RESUME, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.at(MissionState.RUNNING)


def test_an_automatic_mission_goes_on_when_the_localizer_is_the_runs_again() -> None:
    run = MissionRun(settings=["duration_s=20"])
    run.step(3.0)
    for robot in run.robots.values():
        robot.localizer_hash = "another one"
    run.step(3.0)
    assert run.at(MissionState.PAUSED)
    for robot in run.robots.values():
        robot.localizer_hash = run.experiment.hash
    run.step(2.5)
    assert run.at(MissionState.RUNNING)


# --- blind


@pytest.mark.parametrize(
    ("blind", "reason"),
    [
        ({2: "the light changed"}, "robot 2 blind: the light changed"),
        ({1: "the light changed", 2: "nobody tells"}, "robots 1, 2 blind: the light changed"),
    ],
)
def test_robots_hold_while_one_cannot_tell_of_obstacles(blind: dict[int, str], reason: str) -> None:
    run = running(automatic=False)
    for robot, why in blind.items():
        run.robots[robot].blind = why
    run.step(0.2)
    assert run.at(MissionState.PAUSED) and run.mission.reason == reason
    assert {r.mode for r in run.robots.values()} == {Mode.HOLDING}


@pytest.mark.parametrize("trouble", ["blind", "localizer_hash"])
def test_robots_that_may_not_fly_are_sent_off_by_no_loss_and_no_request(trouble: str) -> None:
    """They hold for another reason than the robot that is then lost. The gap closes when a person lets them go on."""
    run = three_running("close-up")
    for robot in run.robots.values():
        setattr(robot, trouble, "the light changed")
    run.step(0.5)
    assert run.at(MissionState.PAUSED)
    run.robots[2].mode, run.robots[2].fault = Mode.FAULT, "no pose"
    run.step(3.0)
    assert run.at(MissionState.PAUSED) and run.mission.roster.active == (1, 3)
    for order, text in ((CommandKind.RESUME, ""), (CommandKind.RETURN, ""), (CommandKind.FORMATION, "line 1.0")):
        assert "robot" in run.mission.request(order, run.fleet(), run.now_ns, text=text)
    for robot in run.robots.values():
        setattr(robot, trouble, "")
    run.step(2.0)  # the mission is automatic: it goes on by itself
    assert run.at(MissionState.HALTING)
    assert set(run.mission.roster.slots_in_use().values()) == {1, 2}


@pytest.mark.parametrize("trouble", ["blind", "localizer_hash"])
def test_robots_that_may_not_fly_any_more_wait_for_it_armed(trouble: str) -> None:
    """All was well at the request, and while they were armed."""
    run = MissionRun(automatic=False)
    assert run.mission.request(CommandKind.START, run.fleet(), run.now_ns) == ""
    while not run.at(MissionState.ARMING):
        run.step()
    setattr(run.robots[2], trouble, "the light changed")
    run.step(3.0)
    assert run.at(MissionState.ARMING) and "robot 2" in run.mission.reason
    assert {r.mode for r in run.robots.values()} == {Mode.ARMED}
    setattr(run.robots[2], trouble, "")
    run.step(1.0)
    assert run.at(MissionState.RUNNING)


@pytest.mark.parametrize(("policy", "lost"), [("warn", False), ("hold", True)])
def test_robots_fly_on_beside_a_blind_one_that_is_lost_or_where_people_allow_it(policy: str, lost: bool) -> None:
    run = running([f'mission.blind="{policy}"', 'mission.lost="go-on"'], automatic=False)
    if lost:
        run.robots[2].mode = Mode.DISARMED
        run.step(0.2)
    run.robots[2].blind = "the light changed"
    run.step(1.0)
    assert run.mission.state is (MissionState.DEGRADED if lost else MissionState.RUNNING)


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ((), "the path is a circle"),
        (('path={kind="waypoints",points_m=[[-1,0],[1,0]],speed_mps=0.1,dive_mps=0.001}',), "the path dives"),
    ],
)
def test_a_path_that_cannot_be_left_is_refused_with_the_one_reason_that_holds(settings: Sequence[str], why: str) -> None:
    run = MissionRun(settings=settings)
    while run.mission.state is not MissionState.RUNNING:
        run.step()
    refused = run.mission.request(CommandKind.GO, run.fleet(), run.now_ns, [(0.5, 0.5)])
    assert refused == f"{why}: it cannot be left for other places under way"


@pytest.mark.parametrize(
    ("mode", "is_disarmed"),
    [
        (Mode.TRACKING, True),
        (Mode.HOLDING, True),
        (Mode.DISARMED, False),
        (Mode.FAULT, False),
    ],
)
def test_a_lost_robot_that_is_silent_is_disarmed_with_the_others_if_it_may_have_power(mode: Mode, is_disarmed: bool) -> None:
    """It may receive though it is not heard; one that had no power when it was last heard is left alone."""
    run = running(["mission.lost=go-on"], automatic=False)
    run.robots[2].mode, run.robots[2].silent = mode, True
    run.step(1.0)
    assert 2 in run.mission.roster.lost
    run.robots[2].got.clear()
    run.robots[1].refuses = frozenset({CommandKind.DISARM})
    assert run.mission.request(CommandKind.DISARM, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    assert run.at(MissionState.ENDING)
    assert {command.order for command in run.robots[2].got} == ({CommandKind.DISARM} if is_disarmed else set())


@pytest.mark.parametrize("flying", [True, False])
@pytest.mark.parametrize(
    ("mode", "out", "led", "orders"),
    [
        (Mode.TRACKING, False, False, {CommandKind.HOLD}),
        (Mode.DRIVEN, False, False, {CommandKind.HOLD}),
        (Mode.HOLDING, False, False, set()),
        (Mode.ARMED, False, False, set()),
        (Mode.FAULT, False, False, set()),
        (Mode.TRACKING, False, True, set()),
        (Mode.TRACKING, True, False, {CommandKind.DISARM}),
        (Mode.ARMED, True, False, {CommandKind.DISARM}),
        (Mode.DISARMED, True, False, set()),
    ],
)
def test_a_robot_with_no_part_holds_if_it_moves_and_is_disarmed_if_it_is_out_of_the_water(
    flying: bool, mode: Mode, out: bool, led: bool, orders: set[CommandKind]
) -> None:
    run = running(["mission.lost=go-on"], automatic=False) if flying else MissionRun(automatic=False)
    roster = run.mission.roster
    if flying:
        roster.mark_lost(2, "silent")
    if out:
        roster.take_out(2)
    if led:
        roster.led_by[2] = Leader.PERSON
    run.robots[2].mode, run.robots[2].refuses = mode, frozenset(CommandKind)
    for robot in run.robots.values():
        robot.got.clear()
    run.step(0.5)
    assert {command.order for command in run.robots[2].got} == orders
    assert run.robots[1].got == [], "it has its part, or rests"


ANY = frozenset(Mode) | {None}
STOPS = frozenset({Mode.DISARMED, Mode.FAULT})


@pytest.mark.parametrize(
    ("state", "order", "modes"),
    [
        (MissionState.LOADING, CommandKind.LOAD, None),
        (MissionState.ARMING, CommandKind.ARM, {Mode.ARMED, Mode.HOLDING}),
        (MissionState.STARTING, CommandKind.START, {Mode.TRACKING}),
        (MissionState.RESUMING, CommandKind.RESUME, {Mode.TRACKING}),
        (MissionState.RELOADING, CommandKind.LOAD, None),
        (MissionState.REARMING, CommandKind.ARM, {Mode.ARMED, Mode.HOLDING}),
        (MissionState.RELEASING, CommandKind.START, {Mode.TRACKING}),
        (MissionState.ENDING, CommandKind.DISARM, {Mode.DISARMED}),
        (MissionState.CLEARING, CommandKind.CLEAR_STOP, STOPS),
        (MissionState.ABORTING, CommandKind.DISARM, STOPS | {Mode.STOPPED}),
        (MissionState.TEST_ARMING, CommandKind.ARM, {Mode.ARMED}),
        (MissionState.TEST_ENDING, CommandKind.DISARM, {Mode.DISARMED}),
    ],
)
def test_a_stage_is_done_by_the_modes_that_confirm_its_command(
    state: MissionState, order: CommandKind, modes: frozenset[Mode] | None
) -> None:
    """Or, with None, by what is loaded, whatever the mode."""
    stage = STAGES[state]
    assert stage.order is order
    for loaded in (True, False):
        done = {mode for mode in ANY if stage.confirmed(mode, loaded)}
        assert done == ((ANY if loaded else set()) if modes is None else modes), loaded


def test_every_stage_has_its_confirmation_here() -> None:
    assert len(STAGES) == 12

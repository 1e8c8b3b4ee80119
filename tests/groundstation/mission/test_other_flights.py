"""Another experiment's path, another form, another order of robots: before a start, from a hold, and refused with a reason."""

from typing import Any

import numpy as np
import pytest

from groundstation.mission.state_machine import MissionState
from groundstation.planning import planner
from groundstation.planning.feasibility import never
from groundstation.planning.segment import PlanSegment, first_segment, sample
from shoal.config.experiment import NO_CAMERA, Experiment, dump_experiment, load_experiment, with_flight
from shoal.config.loader import parse_toml
from shoal.errors import ConfigError
from shoal.frames import Array
from shoal.messages.messages import CommandKind, Mode, Progress
from tests.groundstation.mission.simulated_fleet import CIRCLE as LAPS
from tests.groundstation.mission.simulated_fleet import PLACES, THREE, TWO, SimulatedFleet, an_experiment

CIRCLE = '[path]\nkind = "circle"\ndiameter_m = 1.0\nlap_s = 60.0\ndepth_m = 0.3\n'


def other() -> str:
    return dump_experiment(load_experiment("figure-eight", ["duration_s=40"]))


def ask(fleet: SimulatedFleet, order: CommandKind, text: str = "") -> str:
    return fleet.core.request(order, fleet.fleet, fleet.now_ns, text=text)[0]


def until(fleet: SimulatedFleet, state: MissionState, within_s: float) -> None:
    for _ in range(round(within_s / 0.05)):
        fleet.step()
        if fleet.mission.state is state:
            return
    raise AssertionError(f"{fleet.mission.state} instead of {state}: {fleet.mission.reason}")


def newest(fleet: SimulatedFleet) -> tuple[Progress, str]:
    outcome = fleet.core.requests.recent[-1]
    return outcome.progress, outcome.reason


def furthest_off_m(fleet: SimulatedFleet, flown: Experiment, seconds: float) -> float:
    """Largest distance of a robot from the places that this experiment gives it, without its ways there: its places are those
    of the path at the time that is left to the end."""
    planned, away_m = first_segment(flown), 0.0
    for _ in range(round(seconds / 0.05)):
        fleet.step()
        left_s = fleet.mission.segment.end_s - fleet.mission.plans.progress_s
        for robot, trajectory in planned.trajectories.items():
            place = sample(trajectory, np.array([planned.end_s - left_s])).eta[0]
            away_m = max(away_m, float(np.hypot(*(fleet.robots[robot].eta - place)[:2])))
    return away_m


def shown_plan(fleet: SimulatedFleet, order: CommandKind, text: str) -> PlanSegment:
    """Plan that a person is shown before the click."""
    return fleet.mission.draft(order, text, fleet.fleet, fleet.now_ns)(never)


@pytest.fixture
def fleet() -> SimulatedFleet:
    started = SimulatedFleet(load_experiment("pool"))
    started.run(1.0)
    return started


def test_a_path_that_is_loaded_at_rest_moves_nobody_and_is_what_the_next_start_flies(fleet: SimulatedFleet) -> None:
    before = {r: robot.eta.copy() for r, robot in fleet.robots.items()}
    assert ask(fleet, CommandKind.PATH, other()) == ""
    assert newest(fleet)[0] is Progress.UNDER_WAY
    assert "still being planned" in ask(fleet, CommandKind.START)
    fleet.run(1.0)
    assert newest(fleet) == (Progress.DONE, "") and fleet.mission.state is MissionState.WAITING
    assert all(robot.mode is Mode.DISARMED and np.allclose(robot.eta, before[r]) for r, robot in fleet.robots.items())
    assert fleet.mission.plans.flown.name == "figure-eight"
    assert ask(fleet, CommandKind.START) == ""
    until(fleet, MissionState.RUNNING, 10.0)
    until_there_s = fleet.mission.segment.transfer_end_s - fleet.mission.plans.progress_s + 3.0
    fleet.run(until_there_s)
    assert furthest_off_m(fleet, with_flight(fleet.experiment, other()), 20.0) < 0.05
    until(fleet, MissionState.DONE, 40.0)


def test_the_way_home_is_in_no_lap() -> None:
    fleet = SimulatedFleet(load_experiment("pool", ["path.lap_s=20", "path.diameter_m=0.4", "duration_s=200"]))
    fleet.run(1.0)
    assert ask(fleet, CommandKind.START) == ""
    until(fleet, MissionState.RUNNING, 10.0)
    fleet.run(50.0)
    assert ask(fleet, CommandKind.RETURN) == ""
    until(fleet, MissionState.RETURNING, 20.0)
    flown_s = {lap.number: lap.time_s for lap in fleet.core.laps.laps() if lap.number}
    reason, _ = fleet.core.request_gains({"controller.nmpc.turning_m": 0.2}, True, fleet.fleet, fleet.now_ns)
    assert reason == "this path has no laps"
    until(fleet, MissionState.DONE, 60.0)
    after_s = {lap.number: lap.time_s for lap in fleet.core.laps.laps()}
    assert after_s.pop(0) > 5.0
    assert after_s == flown_s and sorted(after_s) == [1, 2, 3]


def test_from_a_hold_another_path_is_flown_and_its_start_is_the_way_back(fleet: SimulatedFleet) -> None:
    assert ask(fleet, CommandKind.START) == ""
    until(fleet, MissionState.RUNNING, 10.0)
    fleet.run(5.0)
    assert ask(fleet, CommandKind.PATH, other()).startswith("load is not possible when")
    assert ask(fleet, CommandKind.HOLD) == ""
    fleet.run(2.0)
    assert ask(fleet, CommandKind.PATH, other()) == ""
    until(fleet, MissionState.RUNNING, 20.0)
    fleet.step()
    assert newest(fleet)[0] is Progress.DONE
    fleet.run(fleet.mission.segment.transfer_end_s - fleet.mission.plans.progress_s + 3.0)
    flown = with_flight(fleet.experiment, other())
    assert furthest_off_m(fleet, flown, 15.0) < 0.05
    assert ask(fleet, CommandKind.RETURN) == ""
    until(fleet, MissionState.DONE, 90.0)
    for robot, trajectory in first_segment(flown).trajectories.items():
        assert np.allclose(fleet.robots[robot].eta[:3], trajectory.eta[0, :3], atol=0.05)


APART = THREE.replace("0.9", "1.3")
BESIDE = '{kind="waypoints",points_m=[[0.4,-0.6],[1.4,-0.6],[1.4,0.0]],speed_mps=0.1,depth_m=0.4}'


@pytest.mark.parametrize(
    ("when", "lost", "slots"),
    [
        ("planned", 3, {1: 1, 2: 2}),
        ("planned", 1, None),
        ("before the way home", 1, None),
        ("before the way home, taken out", 1, None),
        ("on the way home", 1, None),
        ("on the way home, taken out", 2, None),
        ("planned on the way home", 1, None),
    ],
)
def test_another_path_is_flown_without_the_gap_of_a_lost_robot(when: str, lost: int, slots: dict[int, int] | None) -> None:
    """It is lost before, or while the way to the path is planned: the others close up, and fly what was asked for."""
    fleet = SimulatedFleet(an_experiment("close-up", APART, PLACES))
    wanted = dump_experiment(an_experiment("close-up", APART, BESIDE, 12)).replace('name = "pool"', 'name = "beside"')

    def loses(moment: str, wait_s: float) -> None:
        if when.partition(",")[0] == moment:
            fleet.robots[lost].alive = False
            fleet.run(wait_s)

    fleet.run(1.0)
    assert ask(fleet, CommandKind.START) == ""
    fleet.run(6.0)
    loses("before the way home", 15.0)
    if "home" in when:
        assert ask(fleet, CommandKind.RETURN) == ""
        until(fleet, MissionState.RETURNING, 30.0)
        fleet.run(2.0)
        loses("on the way home", 2.0)
    if fleet.mission.state is not MissionState.PAUSED:
        assert ask(fleet, CommandKind.HOLD) == ""
        fleet.run(3.0)
    if when.endswith("taken out"):
        fleet.mission.note_water(lost, True)
    loses("planned", 0.2)  # not noticed yet
    loses("planned on the way home", 0.2)
    assert ask(fleet, CommandKind.PATH, wanted) == ""
    while newest(fleet)[0] is Progress.UNDER_WAY:
        fleet.step()
    assert newest(fleet)[0] is Progress.DONE, newest(fleet)
    assert fleet.mission.plans.flown.name == "beside"
    assert set(fleet.mission.roster.slots_in_use().values()) == {1, 2}
    assert slots is None or fleet.mission.roster.slots_in_use() == slots


def test_a_request_reads_its_experiment_once(fleet: SimulatedFleet, monkeypatch: pytest.MonkeyPatch) -> None:
    texts = []

    def parse(text: str, source: str) -> dict[str, Any]:
        texts.append(text)
        return parse_toml(text, source)

    monkeypatch.setattr("shoal.config.experiment.parse_toml", parse)
    assert ask(fleet, CommandKind.PATH, other()) == ""
    assert texts == [other()]


@pytest.mark.parametrize("holds", [False, True])
def test_robots_change_places_at_rest_and_from_a_hold(fleet: SimulatedFleet, holds: bool) -> None:
    """Under way they would meet: there the planner refuses it."""
    if holds:
        assert ask(fleet, CommandKind.START) == ""
        until(fleet, MissionState.RUNNING, 10.0)
        fleet.run(3.0)
        assert ask(fleet, CommandKind.FORMATION, "order 2,1") == ""
        fleet.run(1.0)
        assert newest(fleet)[0] is Progress.FAILED and "robots 1 and 2: " in newest(fleet)[1]
        assert ask(fleet, CommandKind.HOLD) == ""
        fleet.run(2.0)
    places = fleet.mission.segment.trajectories
    was = {r: robot.eta[:2].copy() if holds else places[r].eta[0, :2] for r, robot in fleet.robots.items()}
    assert ask(fleet, CommandKind.FORMATION, "order 2,1") == ""
    if not holds:
        fleet.run(1.0)
        assert newest(fleet)[0] is Progress.DONE
        assert ask(fleet, CommandKind.START) == ""
    until(fleet, MissionState.RUNNING, 20.0)
    while fleet.mission.plans.progress_s < fleet.mission.segment.transfer_end_s:
        fleet.step()
    assert all(np.hypot(*(fleet.robots[3 - r].eta[:2] - was[r])) < 0.05 for r in (1, 2))


@pytest.mark.parametrize(
    ("state", "form"),
    [
        (MissionState.WAITING, "turn 30 over 12"),
        (MissionState.PAUSED, "turn 30 over 12"),
        (MissionState.RUNNING, "line 0.9 turn 40"),
    ],
)
def test_a_draft_of_a_form_is_the_form_that_is_then_flown(fleet: SimulatedFleet, state: MissionState, form: str) -> None:
    """A person sees it before asking for it."""
    if state is not MissionState.WAITING:
        assert ask(fleet, CommandKind.START) == ""
        until(fleet, MissionState.RUNNING, 10.0)
    if state is MissionState.PAUSED:
        assert ask(fleet, CommandKind.HOLD) == ""
        fleet.run(2.0)
    assert fleet.mission.state is state
    before = fleet.mission.segment
    drafted = shown_plan(fleet, CommandKind.FORMATION, form)
    assert fleet.mission.segment is before and fleet.mission.plan_request is None
    assert ask(fleet, CommandKind.FORMATION, form) == ""
    while fleet.mission.segment is before:
        fleet.step()
    for robot, trajectory in fleet.mission.segment.trajectories.items():
        assert np.allclose(drafted.trajectories[robot].eta[-1, :3], trajectory.eta[-1, :3], atol=0.01)
        assert not np.allclose(before.trajectories[robot].eta[-1, :3], trajectory.eta[-1, :3], atol=0.1)


@pytest.mark.parametrize("order", [CommandKind.PATH, CommandKind.FORMATION])
@pytest.mark.parametrize("rests", [False, True])
def test_a_draft_after_a_loss_shows_the_robots_and_their_ways_as_they_are_then_flown(order: CommandKind, rests: bool) -> None:
    """From a hold the others close up first; at rest the robot that was lost flies again, and each has its own place."""
    fleet = SimulatedFleet(an_experiment("close-up", APART, PLACES))
    path = dump_experiment(an_experiment("close-up", APART, BESIDE, 12)).replace('name = "pool"', 'name = "beside"')
    text = path if order is CommandKind.PATH else "turn 20 over 12"
    fleet.run(1.0)
    assert ask(fleet, CommandKind.START) == ""
    fleet.run(6.0)
    if not rests:
        assert ask(fleet, CommandKind.HOLD) == ""
        fleet.run(4.0)
    fleet.robots[1].alive = False
    fleet.run(20.0 if rests else 3.0)
    if rests:
        assert fleet.mission.roster.closed
        assert ask(fleet, CommandKind.DISARM) == ""
        fleet.robots[1].alive = True
        until(fleet, MissionState.CANCELLED, 20.0)
        fleet.run(1.0)
    drafted, before = shown_plan(fleet, order, text), fleet.mission.segment
    assert fleet.mission.segment is before and fleet.mission.plan_request is None
    assert ask(fleet, order, text) == ""
    fleet.run(2.0)
    assert fleet.mission.segment is not before, newest(fleet)
    flown = fleet.mission.roster.trajectories(fleet.mission.segment)
    assert drafted.trajectories.keys() == flown.keys() == set(fleet.mission.roster.active)
    for robot, trajectory in flown.items():
        assert np.allclose(trajectory.eta[[0, -1], :3], drafted.trajectories[robot].eta[[0, -1], :3], atol=0.02)


def test_a_path_that_cannot_be_flown_here_leaves_the_one_before(fleet: SimulatedFleet) -> None:
    before = fleet.mission.plans.flown
    for text, reason in (
        (dump_experiment(load_experiment("straight")), "it is for robots 1; here are 1, 2"),
        ("path = 3", "path = 3"),
        ("name = 4\n", "path: missing"),
        ("a = ", "not valid TOML"),
        (
            '[path]\nkind = "circle"\ndiameter_m = 1.0\nlap_s = 60.0\ndepth_m = 0.3\n[formation]\nkind = "leader-follower"',
            "kind",
        ),
    ):
        assert reason in ask(fleet, CommandKind.PATH, text)
    assert ask(fleet, CommandKind.PATH, CIRCLE.replace("1.0", "30.0")) == ""
    fleet.run(1.0)
    assert newest(fleet)[0] is Progress.FAILED and "beyond" in newest(fleet)[1]
    assert fleet.mission.plans.flown is before and ask(fleet, CommandKind.START) == ""


@pytest.mark.parametrize(
    ("form", "reason"),
    [("order 2,2", "each once"), ("order 1", "must name each robot once (1, 2)"), ("line 1 order", "each once")],
)
def test_an_order_that_is_none_is_refused(fleet: SimulatedFleet, form: str, reason: str) -> None:
    assert reason in ask(fleet, CommandKind.FORMATION, form)


def test_a_file_changes_form_into_an_order_of_its_robots() -> None:
    change = "formation.changes=[{at_s=10,over_s=10,shape='line',spacing_m=0.9,order=[2,1]}]"
    ends = {}
    for order in ("[2,1]", "[1,2]"):
        flown = planner.draft(load_experiment("pool", [change.replace("[2,1]", order)]))[0].trajectories
        ends[order] = [flown[r].eta[-1, :2] - (flown[1].eta[-1, :2] + flown[2].eta[-1, :2]) / 2 for r in (1, 2)]
    assert np.allclose(ends["[2,1]"], ends["[1,2]"][::-1])
    with pytest.raises(ConfigError, match=r"order = \[2\]"):
        load_experiment("pool", [change.replace("[2,1]", "[2]")])


def test_a_draft_begins_where_the_robots_are(fleet: SimulatedFleet) -> None:
    """At rest and from a hold, of another form and of another path: with the ways into place, and on to its end."""
    for held in (False, True):
        if held:
            assert ask(fleet, CommandKind.START) == ""
            until(fleet, MissionState.RUNNING, 20.0)
            fleet.run(10.0)
            assert ask(fleet, CommandKind.HOLD) == ""
            until(fleet, MissionState.PAUSED, 10.0)
            fleet.run(3.0)
        for segment in (shown_plan(fleet, CommandKind.FORMATION, "column 0.9"), shown_plan(fleet, CommandKind.PATH, other())):
            assert segment.transfer_end_s > segment.centre.begin_s
            begins = {tuple(np.round(t.eta[0, :2], 2)) for t in segment.trajectories.values()}
            assert begins == {tuple(np.round(view.rest[:2], 2)) for view in fleet.fleet.values()}
    assert fleet.mission.state is MissionState.PAUSED and newest(fleet)[0] is Progress.DONE  # nobody was asked to fly it


def on_laps(progress_s: float) -> SimulatedFleet:
    """Two robots so far along their laps, of 20 s each."""
    fleet = SimulatedFleet(an_experiment("go-on", TWO, LAPS, 100))
    fleet.run(1.0)
    assert ask(fleet, CommandKind.START) == ""
    until(fleet, MissionState.RUNNING, 10.0)
    while fleet.mission.plans.progress_s < progress_s:
        fleet.step()
    return fleet


def test_the_way_into_place_after_a_hold_belongs_to_the_lap_that_is_flown_on() -> None:
    fleet = on_laps(40.5)
    assert ask(fleet, CommandKind.HOLD) == ""
    fleet.run(3.0)
    before = {lap.number: lap.time_s for lap in fleet.core.laps.laps()}
    assert ask(fleet, CommandKind.FORMATION, "column 1.2") == ""
    until(fleet, MissionState.RUNNING, 10.0)
    while fleet.mission.plans.progress_s < fleet.mission.segment.transfer_end_s + 25.0:
        fleet.step()
    after = {lap.number: lap.time_s for lap in fleet.core.laps.laps()}
    assert sorted(after) == [1, 2, 3, 4]
    assert (after[1], after[2]) == (before[1], before[2]), "they were over"
    assert after[4] == pytest.approx(25.0 - 1.5 - 19.4, abs=0.5), "and the next one begins 20 s of the path after the third"


@pytest.mark.parametrize("moves", [False, True])
def test_gains_for_the_next_lap_are_not_taken_on_the_way_into_place(moves: bool) -> None:
    """A plan from a hold moves the lap; a hold that robots go on from does not."""
    fleet = on_laps(45.0)
    before = {robot: body.tuning_id for robot, body in fleet.robots.items()}
    _, number = fleet.core.request_gains({"controller.nmpc.turning_m": 0.02}, True, fleet.fleet, fleet.now_ns)
    fleet.run(2.0)
    assert ask(fleet, CommandKind.HOLD) == ""
    fleet.run(3.0)
    assert (ask(fleet, CommandKind.FORMATION, "column 1.2") if moves else ask(fleet, CommandKind.RESUME)) == ""
    until(fleet, MissionState.RUNNING, 10.0)
    while fleet.mission.plans.progress_s < 59.5:
        fleet.step()
    assert {robot: body.tuning_id for robot, body in fleet.robots.items()} == before
    fleet.run(3.0)
    outcome = fleet.core.requests.outcome(number)
    assert outcome is not None
    if moves:
        assert {robot: body.tuning_id for robot, body in fleet.robots.items()} == before
        assert (outcome.progress, outcome.reason) == (
            Progress.FAILED, "a new plan has moved the lap: nothing was changed",
        )  # fmt: skip
    else:
        assert outcome.progress is Progress.DONE


def test_each_run_has_laps_of_its_own() -> None:
    """A person disarms after a few seconds, loads another path, and starts again."""
    fleet = SimulatedFleet(load_experiment("pool"))
    fleet.run(1.0)
    assert ask(fleet, CommandKind.START) == ""
    fleet.run(5.5)
    first = fleet.core.laps.laps()
    assert ask(fleet, CommandKind.DISARM) == ""
    until(fleet, MissionState.CANCELLED, 5.0)
    assert first and fleet.core.laps.laps()[0].time_s >= first[0].time_s
    assert ask(fleet, CommandKind.PATH, other()) == ""
    fleet.run(1.0)
    assert ask(fleet, CommandKind.START) == ""
    fleet.run(3.0)
    (again,) = fleet.core.laps.laps()
    flown_s = min(robot.clock.reached_s for robot in fleet.robots.values())
    assert again.time_s == pytest.approx(flown_s, abs=0.15)


def test_a_form_can_be_taken_from_a_hold_that_reaches_the_robots_at_the_paths_end() -> None:
    """A robot flies on until a HOLD reaches it, and its clock beyond the end; no plan begins there."""
    fleet = SimulatedFleet(an_experiment("go-on", THREE, PLACES, 20))
    fleet.run(1.0)
    assert ask(fleet, CommandKind.START) == ""
    while fleet.mission.plans.progress_s < fleet.mission.segment.end_s - 0.1:
        fleet.step()
    for robot in fleet.robots.values():
        robot.radio.delay_ns = 200_000_000
    assert ask(fleet, CommandKind.HOLD) == ""
    fleet.run(4.0)
    assert all(robot.clock.reached_s > fleet.mission.segment.end_s for robot in fleet.robots.values())
    assert ask(fleet, CommandKind.FORMATION, "line 0.8") == ""
    until(fleet, MissionState.DONE, 60.0)


def rotating(robots: str, more: tuple[str, ...] = ()) -> Experiment:
    """Laps in a formation that turns with its path."""
    circle = f"path={LAPS}".replace("lap_s=20", "lap_s=40")
    settings = [circle, f"robots={robots}", "pool.size_m=[9.0,9.0,1.0]", "duration_s=60", "article=[]", NO_CAMERA, *more]
    return load_experiment("pool", ['formation.mode="rotate"', *settings])


def offset_m(fleet: SimulatedFleet) -> Array:
    """Place of robot 2 (2,) as seen from robot 1."""
    return np.asarray((fleet.robots[2].eta - fleet.robots[1].eta)[:2])


@pytest.mark.parametrize("after_s", [-6.0, 0.9], ids=["on the way into place", "just after"])
def test_a_form_from_a_hold_replaces_the_one_taken_before_the_start(after_s: float) -> None:
    fleet = SimulatedFleet(an_experiment("go-on", THREE, LAPS, 60))
    fleet.run(1.0)
    assert ask(fleet, CommandKind.FORMATION, "line 1.0") == ""
    fleet.run(1.0)
    assert ask(fleet, CommandKind.START) == ""
    until(fleet, MissionState.RUNNING, 10.0)
    while fleet.mission.plans.progress_s < fleet.mission.segment.transfer_end_s + after_s:
        fleet.step()
    assert ask(fleet, CommandKind.HOLD) == ""
    fleet.run(3.0)
    for form in ("line 1.3", "column 1.2", "order 3,1,2"):  # each from a hold on the way into the one before
        assert ask(fleet, CommandKind.FORMATION, form) == ""
        until(fleet, MissionState.RUNNING, 10.0)
        assert ask(fleet, CommandKind.HOLD) == ""
        fleet.run(2.0)
    assert ask(fleet, CommandKind.RESUME) == ""
    until(fleet, MissionState.RUNNING, 10.0)
    while fleet.mission.plans.progress_s < fleet.mission.segment.transfer_end_s + 5.0:
        fleet.step()
    x_m, y_m = np.array([body.eta[:2] for body in fleet.robots.values()]).T
    assert np.ptp(x_m) < 0.05 and np.diff(np.sort(y_m)) == pytest.approx([1.2, 1.2], abs=0.05), "a column"


def test_a_form_from_a_hold_comes_behind_a_change_of_the_experiment_that_has_begun() -> None:
    change = '[{at_s=6.0,over_s=8.0,shape="line",spacing_m=1.0}]'
    experiment = load_experiment("pool", [
        f"path={LAPS}", "pool.size_m=[7.0,5.0,1.0]", f"robots={TWO}", "duration_s=60", "article=[]", NO_CAMERA,
        f"formation.changes={change}",
    ])  # fmt: skip
    fleet = SimulatedFleet(experiment)
    fleet.run(1.0)
    assert ask(fleet, CommandKind.START) == ""
    until(fleet, MissionState.RUNNING, 10.0)
    while fleet.mission.plans.progress_s < 7.0:
        fleet.step()
    assert ask(fleet, CommandKind.HOLD) == ""
    fleet.run(2.0)
    assert ask(fleet, CommandKind.FORMATION, "column 1.2") == ""
    until(fleet, MissionState.RUNNING, 10.0)
    while fleet.mission.plans.progress_s < fleet.mission.segment.transfer_end_s + 15.0:
        fleet.step()
    assert np.abs(offset_m(fleet)) == pytest.approx([0.0, 1.2], abs=0.05)


@pytest.mark.parametrize("holds", [False, True])
def test_a_formation_that_turns_takes_another_form_at_rest_and_from_a_hold(holds: bool) -> None:
    """Its robots fly in other directions then: they turn at the end of their ways into place."""
    fleet = SimulatedFleet(rotating(THREE))
    fleet.run(1.0)
    if holds:
        assert ask(fleet, CommandKind.START) == ""
        until(fleet, MissionState.RUNNING, 10.0)
        fleet.run(5.0)
        assert ask(fleet, CommandKind.HOLD) == ""
        fleet.run(2.0)
    for form in ("column 1.0", "turn 30", "order 3,1,2"):
        assert ask(fleet, CommandKind.FORMATION, form) == ""
        fleet.run(1.0)
        assert fleet.mission.reason == "" and not fleet.mission.plans.failure
        if holds:
            until(fleet, MissionState.RUNNING, 20.0)
            assert newest(fleet)[0] is Progress.DONE
            assert ask(fleet, CommandKind.HOLD) == ""
            fleet.run(2.0)


def test_a_form_is_taken_once_when_a_robot_is_lost_before_the_others_set_out() -> None:
    fleet = SimulatedFleet(an_experiment("close-up", THREE, PLACES, 60))
    fleet.run(1.0)
    assert ask(fleet, CommandKind.START) == ""
    until(fleet, MissionState.RUNNING, 10.0)
    fleet.run(4.0)
    assert ask(fleet, CommandKind.HOLD) == ""
    fleet.run(3.0)
    assert ask(fleet, CommandKind.FORMATION, "scale 1.3") == ""
    until(fleet, MissionState.RELOADING, 5.0)
    fleet.robots[3].alive = False
    until(fleet, MissionState.DEGRADED, 40.0)
    while fleet.mission.plans.progress_s < fleet.mission.segment.transfer_end_s + 5.0:
        fleet.step()
    assert float(np.hypot(*offset_m(fleet))) == pytest.approx(1.3 * 0.9, abs=0.05)


def test_no_form_is_flown_in_place_of_the_way_home() -> None:
    """A RETURN from rest that was held before it had its plan: RESUME leads home, and nothing else flies the path."""
    fleet = SimulatedFleet(an_experiment("go-on", TWO, PLACES, 20))
    fleet.run(1.0)
    for robot in fleet.robots:
        assert fleet.core.request(CommandKind.ARM, fleet.fleet, fleet.now_ns, only=robot)[0] == ""
    fleet.run(0.5)
    assert ask(fleet, CommandKind.RETURN) == ""
    fleet.run(0.1)
    assert ask(fleet, CommandKind.HOLD) == ""
    fleet.run(3.0)
    assert "on their way back to the start" in ask(fleet, CommandKind.FORMATION, "column 0.8")
    assert ask(fleet, CommandKind.RESUME) == ""
    until(fleet, MissionState.DONE, 60.0)


def test_another_path_in_place_of_the_way_home_is_a_flight_of_its_own() -> None:
    """The session is judged by its end, and not by that of the flight before."""
    fleet = SimulatedFleet(an_experiment("abort", TWO, PLACES, 20))
    fleet.run(1.0)
    assert ask(fleet, CommandKind.START) == ""
    until(fleet, MissionState.DONE, 60.0)
    verdicts = [fleet.mission.verdict]
    assert ask(fleet, CommandKind.RETURN) == ""
    until(fleet, MissionState.RETURNING, 20.0)
    assert ask(fleet, CommandKind.HOLD) == ""
    fleet.run(2.0)
    text = dump_experiment(an_experiment("abort", TWO, PLACES.replace("0.6", "0.4"), 20))
    assert ask(fleet, CommandKind.PATH, text) == ""
    until(fleet, MissionState.RUNNING, 20.0)
    fleet.robots[2].alive = False
    until(fleet, MissionState.FAILED, 30.0)
    assert [*verdicts, fleet.mission.verdict] == [MissionState.DONE, MissionState.FAILED]

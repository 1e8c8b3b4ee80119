"""Plans for robots under way: joined without a jump, clear of what lies there, and refused with a reason."""

import time
from contextlib import suppress
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from groundstation.mission.obstacle_monitor import ObstacleMonitor, ObstacleSet
from groundstation.planning import planner
from groundstation.planning.feasibility import PlanError
from groundstation.planning.replanning import replan
from groundstation.planning.rest_to_rest import assign_slots, plan_regroup, plan_return
from groundstation.planning.segment import NO_OBSTACLES, PlanSegment, concatenate, first_contact, first_segment, sample
from groundstation.planning.shift import reshape
from groundstation.telemetry import RobotView
from robot_agent.guidance.reference import Follow, ReferenceSampler, splice, splice_objection
from robot_agent.guidance.trajectory_check import unflyable
from shoal.config.experiment import NO_CAMERA, Experiment, load_experiment
from shoal.config.scene import read_form
from shoal.frames import Array
from shoal.messages.codec import decode, encode
from shoal.messages.messages import Command, CommandKind, Estimate, RobotState, Trajectory
from tests.groundstation.planning.smoothness import check_smooth

PERIOD_S = 0.05
BLOCKED = load_experiment("blocked-path")
SEEN_S = {"blocked-path": 52.0, "islands": 80.0}  # when the centre would come by what turns up
BALL = np.array([[1.0, 0.1, 0.2]])


def clearance(segment: PlanSegment, thing: Array, from_s: float) -> float:
    """Smallest distance of any robot to an obstacle's edge."""
    nearest: list[float] = []
    for t in segment.trajectories.values():
        first = max(round((from_s - t.begin_s) / PERIOD_S), 0)
        nearest.append(float(np.hypot(*(t.eta[first:, :2] - thing[:2]).T).min()) - float(thing[2]))
    return min(nearest)


@pytest.mark.parametrize("begin_s", [0.0, 5.3, 15.6, 19.35, 40.1])
def test_a_trajectory_has_its_velocity_up_to_its_last_sample_wherever_it_begins(begin_s: float) -> None:
    """The last instant may come out behind the end by rounding: a robot that turns would stop at once there."""
    rows = np.ones((1257, 4))
    flown = Trajectory("a", PERIOD_S, rows, rows, rows, begin_s)
    for from_s in (begin_s, begin_s + 14.05):
        left = len(rows) - round((from_s - begin_s) / PERIOD_S)
        motion = sample(flown, from_s + PERIOD_S * np.arange(left, dtype=np.float64))
        assert np.all(motion.velocity == 1.0) and np.all(motion.acceleration == 1.0)
    assert not sample(flown, np.array([begin_s - 0.01, begin_s + PERIOD_S * len(rows)])).velocity.any()


def test_a_detour_keeps_clear_keeps_its_shape_and_arrives() -> None:
    segment = first_segment(BLOCKED)
    new = replan(BLOCKED, segment, 14.0, BALL)
    assert clearance(segment, BALL[0], 14.0) < 0.3  # it was in the way
    assert clearance(new, BALL[0], 14.0) > BLOCKED.safety.radius_m + 0.2
    for a, b in combinations(new.trajectories.values(), 2):
        apart = a.eta[:, :2] - b.eta[:, :2]
        assert np.abs(apart - apart[0]).max() < 1e-9  # in `translate` the shape does not change at all
    for robot, t in new.trajectories.items():
        assert np.hypot(*(t.eta[-1, :2] - segment.trajectories[robot].eta[-1, :2])) < 0.01
    assert segment.end_s < new.end_s < segment.end_s + 15.0


def test_a_route_that_takes_too_long_to_plan_or_to_fly_is_given_up() -> None:
    """A page may give fifty places, as far apart as the pool is long."""
    experiment = load_experiment("straight")
    segment, (length, width, _) = first_segment(experiment), experiment.pool.size_m
    with pytest.raises(PlanError, match="none was found in time"):
        replan(experiment, segment, 10.0, NO_OBSTACLES, [(2.0, 1.0)], lambda: True)
    begun_s = time.process_time()
    with pytest.raises(PlanError, match="m long: a trajectory message holds"):
        far = [(0.3 * length * (-1) ** k, 0.3 * width * (-1) ** (k // 2)) for k in range(50)]
        replan(experiment, segment, 10.0, NO_OBSTACLES, far)
    assert time.process_time() - begun_s < 2.0


@pytest.mark.parametrize("room_m", [3.0, 1.5])
def test_a_detour_from_straight_sides_comes_back_to_them(room_m: float) -> None:
    """An L with a stop at its corner, and an obstacle on the first side: corner and second side are flown as planned. Robots
    that are still aside at the corner would have to leap as they turn: then the way leads to the path's end."""
    points = f"path.points_m=[[{-room_m},-0.8],[1.5,-0.8],[1.5,0.9]]"
    corner = load_experiment(
        "straight", ["pool.size_m=[9,6,1.5]", points, "path.corner=stop", "path.stop=true", "duration_s=70"]
    )
    segment = first_segment(corner)
    thing = np.array([[1.8 - room_m, -0.75, 0.1]])
    new = replan(corner, segment, 4.0, thing)
    assert clearance(segment, thing[0], 4.0) < 0.3 < clearance(new, thing[0], 4.0)
    assert (new.end_s == segment.end_s) is (room_m == 3.0)
    late = np.arange(55.0, 70.0, 0.5)
    for robot, trajectory in segment.trajectories.items():
        away_m = np.abs(sample(new.trajectories[robot], late).eta - sample(trajectory, late).eta)[:, :3].max()
        assert away_m < 1e-6 or room_m < 3.0
        assert unflyable(new.trajectories[robot], corner.pool, corner.vehicle) == ""


@pytest.mark.parametrize(("begin_s", "place"), [(57.0, (-0.49, -0.12)), (13.1, (-1.09, 0.57)), (49.95, (1.0, 0.26))])
def test_a_path_that_does_not_stop_ends_at_the_place_that_a_person_gave(begin_s: float, place: tuple[float, float]) -> None:
    """It does not fly on beyond it, and perhaps out of the pool."""
    experiment = load_experiment("figure-eight")
    new = replan(experiment, first_segment(experiment), begin_s, NO_OBSTACLES, [place])
    end = sample(new.centre, np.array([new.end_s])).eta[0, :2]
    assert np.hypot(*(end - place)) < 0.01
    assert all(unflyable(t, experiment.pool, experiment.vehicle) == "" for t in new.trajectories.values())


def test_a_form_shortly_before_the_end_is_one_that_robots_can_look_ahead_to() -> None:
    experiment, form = load_experiment("numeric"), "order 3,1,2"
    segment, forms = first_segment(experiment), 0
    for begin_s in np.arange(experiment.duration_s - 10.0, experiment.duration_s - 1.0, 0.5).tolist():
        with suppress(PlanError):
            new = reshape(experiment, segment, begin_s, read_form(form, begin_s))
            assert {unflyable(t, experiment.pool, experiment.vehicle) for t in new.trajectories.values()} == {""}
            forms += 1
    assert forms


def test_after_a_plan_from_rest_the_formation_still_takes_other_forms() -> None:
    """Behind the end of that plan there is no stop that the path does not have: it would be a bend that nobody can turn."""
    experiment = load_experiment("figure-eight", [NO_CAMERA, "path.corner=round"])
    segment = first_segment(experiment)
    rests = {robot: trajectory.eta[1020] for robot, trajectory in segment.trajectories.items()}
    rested = plan_regroup(experiment, segment, 51.0, 51.0, rests, {robot: robot for robot in rests})
    new = reshape(experiment, rested, 102.1, read_form("turn 40", 102.1))
    assert {unflyable(t, experiment.pool, experiment.vehicle) for t in new.trajectories.values()} == {""}


@pytest.mark.parametrize("scene", ["blocked-path", "islands"])
def test_a_switch_of_segments_moves_no_reference(scene: str) -> None:
    """The reference at each step, through the robot's own splice and sampler, across the seam."""
    experiment = load_experiment(scene)
    segment = first_segment(experiment)
    begin_s = 30.0
    middle = segment.centre.eta[round(SEEN_S[scene] / PERIOD_S), :2]
    new = replan(experiment, segment, begin_s, np.array([[*middle, 0.1]]))
    for robot, then in new.trajectories.items():
        old = segment.trajectories[robot]
        assert splice_objection(old, then) == ""
        join = splice(old, then, begin_s - 1.0)
        seam = round((then.begin_s - join.begin_s) / PERIOD_S)
        check_smooth(join, seam - 10, seam + round(10.0 / PERIOD_S))
        before, after = ReferenceSampler(PERIOD_S * np.arange(51.0)), ReferenceSampler(PERIOD_S * np.arange(51.0))
        now = begin_s - 2.6  # all of the horizon lies before the seam: nothing may change
        a, b = before.sample(Follow(old, now)), after.sample(Follow(splice(old, then, now), now))
        np.testing.assert_allclose(a.eta, b.eta, atol=1e-12)
        np.testing.assert_allclose(a.acceleration, b.acceleration, atol=1e-12)
        own = np.unwrap(np.arctan2(then.velocity[:200, 1], then.velocity[:200, 0]))
        assert np.abs(np.sin(own - then.eta[:200, 3])).max() < 1e-6  # it heads where it goes


def test_a_seam_that_jumps_is_refused_by_the_robot() -> None:
    segment = first_segment(BLOCKED)
    old = segment.trajectories[1]
    new = replan(BLOCKED, segment, 14.0, BALL).trajectories[1]
    beside = new.eta + np.array([0.0, 1e-3, 0.0, 0.0])
    aside = Trajectory("x", new.period_s, beside, new.velocity, new.acceleration, new.begin_s)
    assert "its pose jumps by 0.001" in splice_objection(old, aside)
    faster = Trajectory("x", new.period_s, new.eta, new.velocity * 1.1, new.acceleration, new.begin_s)
    assert "its velocity jumps" in splice_objection(old, faster)
    off = Trajectory("x", new.period_s, new.eta, new.velocity, new.acceleration, new.begin_s + 0.02)
    assert "not at the instants" in splice_objection(old, off)
    late = Trajectory("x", new.period_s, new.eta, new.velocity, new.acceleration, 1e4)
    assert "outside" in splice_objection(old, late)


def test_two_replans_in_a_row_and_one_to_a_requested_place() -> None:
    segment = first_segment(BLOCKED)
    first = replan(BLOCKED, segment, 10.0, BALL)
    second = replan(BLOCKED, first, 16.0, np.vstack([BALL, [[2.5, 1.0, 0.2]]]))
    assert all(splice_objection(first.trajectories[r], second.trajectories[r]) == "" for r in (1, 2, 3))
    assert clearance(second, BALL[0], 16.0) > 0.3 and clearance(second, np.array([2.5, 1.0, 0.2]), 16.0) > 0.3
    moved = replan(BLOCKED, segment, 10.0, NO_OBSTACLES, [(1.0, 1.5)])
    assert np.hypot(*(moved.centre.eta[-1, :2] - [1.0, 1.5])) < 0.01
    again = replan(BLOCKED, moved, 13.0, np.array([[-0.7, 0.3, 0.1]]))
    assert np.hypot(*(again.centre.eta[-1, :2] - [1.0, 1.5])) < 0.01  # the person's place still counts


ROOM = ["pool.size_m=[9.0,8.0,1.2]", "localizer.uses_camera=false", "article=[]"]
SQUARE = 'path={kind="waypoints",points_m=[[-2,-2],[2,-2],[2,2],[-2,2]],speed_mps=0.15,depth_m=0.4,slow=true,stop=true}'
AND_BACK = 'path={kind="route",via_m=[[-2.5,0.0],[2.5,0.0],[2.5,2.0],[-2.5,0.0]],speed_mps=0.15,depth_m=0.4}'


def test_a_second_detour_leads_to_no_place_that_was_passed_before_the_first() -> None:
    """The way that the first detour left comes nearest to the first corner at its end."""
    experiment = load_experiment("pool", [*ROOM, SQUARE, "duration_s=110"])
    segment = first_segment(experiment)
    for begin_s, away_s in ((36.0, 40.0), (42.0, 30.0)):
        x, y = sample(segment.centre, np.array([begin_s + away_s])).eta[0, :2]
        segment = replan(experiment, segment, begin_s, np.array([[x, y, 0.1]]))
    assert segment.centre.eta[:, 1].min() > -0.5 and np.hypot(*(segment.centre.eta[:, :2] - 2.0).T).min() < 1.0
    assert np.allclose(segment.centre.eta[-1, :2], [-2.0, 2.0], atol=0.01)


@pytest.mark.parametrize("given", [False, True])
def test_a_detour_after_a_hold_keeps_to_the_instants_at_which_the_form_changes(given: bool) -> None:
    """The experiment's changes count from the path's beginning, a person's from when it was given; a hold moves both."""
    change = "formation.changes=[{at_s=50,over_s=10,scale=2.0}]"
    room = ["pool.size_m=[11.0,9.0,1.2]", *ROOM[1:], SQUARE, "duration_s=150"]
    experiment = load_experiment("pool", room if given else [*room, change])
    segment = first_segment(experiment)
    if given:
        segment = reshape(experiment, segment, 18.0, read_form("scale 2 over 20", 18.0))
    rests = {r: sample(t, np.array([20.0])).eta[0] + [0.3, 0.3, 0.0, 0.0] for r, t in segment.trajectories.items()}
    held = plan_regroup(experiment, segment, 20.0, 20.0, rests, {r: r for r in rests})
    begin_s = held.transfer_end_s + (10.0 if given else 26.0)
    x, y = sample(held.centre, np.array([begin_s + 25.0])).eta[0, :2]
    detour = replan(experiment, held, begin_s, np.array([[x, y, 0.1]]))

    def apart_m(flown: PlanSegment) -> Array:
        one, other = (sample(t, begin_s + np.arange(0.0, 30.0)).eta[:, :2] for t in flown.trajectories.values())
        return np.asarray(np.hypot(*(one - other).T))

    assert np.ptp(apart_m(held)) > 0.2
    np.testing.assert_allclose(apart_m(detour), apart_m(held), atol=0.02)


def test_a_detour_on_a_way_there_and_back_ends_when_it_is_back() -> None:
    """The fleet begins at the last place; it does not stay there afterwards for as long as the whole way took."""
    experiment = load_experiment("pool", [*ROOM, AND_BACK, "duration_s=140"])
    before = first_segment(experiment)
    x, y = sample(before.centre, np.array([54.0])).eta[0, :2]
    after = replan(experiment, before, 14.0, np.array([[x, y, 0.1]]))

    def stays_s(segment: PlanSegment) -> float:
        away = np.hypot(*(segment.centre.eta[:, :2] - segment.centre.eta[-1, :2]).T)
        return segment.end_s - segment.centre.begin_s - PERIOD_S * float(np.flatnonzero(away > 0.01)[-1])

    assert stays_s(after) == pytest.approx(stays_s(before), abs=1.0)


@pytest.mark.long
def test_no_way_round_is_refused_with_the_reason() -> None:
    wall = np.array([[1.0, y, 0.3] for y in np.arange(-4.0, 4.1, 0.5)])
    segment = first_segment(BLOCKED)
    with pytest.raises(PlanError, match="no way from"):
        replan(BLOCKED, segment, 14.0, wall)
    with pytest.raises(PlanError, match="only a level path"):
        replan(load_experiment("pool"), first_segment(load_experiment("pool")), 5.0, BALL, [(0.0, 0.0)])
    with pytest.raises(PlanError, match=r"too near|exceeds"):
        replan(BLOCKED, segment, segment.end_s - 2.0, np.array([[-2.0, 0.0, 0.2]]), [(-3.0, 0.0)])


def test_an_obstacle_on_the_path_is_reported_with_robot_place_and_time() -> None:
    segment = first_segment(BLOCKED)
    contact = first_contact(BLOCKED, segment, 14.0, 60.0, BALL)
    assert contact.startswith("something lies at (1.00, 0.10) m, on the path of robot 3, in 2")
    assert first_contact(BLOCKED, segment, 14.0, 20.0, BALL) == ""  # later
    assert first_contact(BLOCKED, segment, 60.0, 75.0, BALL) == ""  # behind
    assert first_contact(BLOCKED, segment, 0.0, 75.0, np.array([[0.0, 3.0, 0.2]])) == ""  # beside


@pytest.mark.parametrize("progress_s", [20.0, 20.013, 20.031])
def test_robots_load_every_plan_that_is_made_under_way_and_plans_made_of_plans(progress_s: float) -> None:
    """The first path stops at once at its end; a plan from rest takes its samples from between the path's."""

    def check(segment: PlanSegment) -> None:
        for trajectory in segment.trajectories.values():
            assert unflyable(trajectory, BLOCKED.pool, BLOCKED.vehicle) == ""

    segment = first_segment(BLOCKED)
    check(replan(BLOCKED, segment, 10.0, BALL))
    for begin_s in (30.0, 60.0, 90.0):
        now = np.array([max(progress_s, segment.transfer_end_s + 3.017)])
        rests = {r: sample(t, now).eta[0] + np.array([0.1, -0.1 * r, 0.0, 0.0]) for r, t in segment.trajectories.items()}
        check(plan_return(BLOCKED, begin_s, rests, {r: t.eta[0] for r, t in first_segment(BLOCKED).trajectories.items()}))
        segment = plan_regroup(BLOCKED, segment, begin_s, float(now[0]), rests, {r: r for r in rests})
        check(segment)


def test_a_segment_says_when_its_path_would_have_begun() -> None:
    """Held twice: the robots are then where the path's own clock, from there on, says that they are."""
    segment = first = first_segment(BLOCKED)
    for progress_s, begin_s in ((20.0, 25.0), (50.0, 60.0)):
        rests = {r: sample(t, np.array([progress_s])).eta[0] for r, t in segment.trajectories.items()}
        segment = plan_regroup(BLOCKED, segment, begin_s, progress_s, rests, {r: r for r in rests})
    late = np.array([segment.transfer_end_s + 10.0])
    for robot, trajectory in segment.trajectories.items():
        here, there = sample(trajectory, late).eta[0], sample(first.trajectories[robot], late - segment.path_s).eta[0]
        assert np.abs(here - there)[:3].max() < 1e-3


def glides(from_m: tuple[float, float], to_m: tuple[float, float], seconds: float = 20.0) -> Trajectory:
    """Straight from one place to another, at constant speed."""
    share = np.linspace(0.0, 1.0, round(seconds / PERIOD_S) + 1)[:, None]
    eta, velocity = np.zeros((len(share), 4)), np.zeros((len(share), 4))
    eta[:, :2] = np.array(from_m) + share * (np.array(to_m) - np.array(from_m))
    velocity[:, :2] = (np.array(to_m) - np.array(from_m)) / seconds
    return Trajectory("glides", PERIOD_S, eta, velocity, np.zeros_like(eta))


def test_on_ways_of_their_own_robots_may_begin_and_end_beside_a_thing_but_not_come_nearer_to_it() -> None:
    trajectory = glides((0.0, 0.0), (2.0, 0.0))
    is_return = PlanSegment({1: trajectory}, trajectory, 20.0, is_return=True)
    into_place = PlanSegment({1: trajectory}, trajectory, 60.0, transfer_end_s=20.0)
    for segment in (is_return, into_place):
        assert "on the path of robot 1, in 5.6 s" in first_contact(BLOCKED, segment, 0.0, 25.0, np.array([[1.0, 0.0, 0.15]]))
        assert first_contact(BLOCKED, segment, 15.0, 40.0, np.array([[1.0, 0.0, 0.15]])) == ""  # gone by
        for x in (-0.3, 2.3):  # behind its start, and behind its goal
            assert first_contact(BLOCKED, segment, 0.0, 25.0, np.array([[x, 0.0, 0.15]])) == ""
        for x in (0.3, 2.2):  # it would run through one, and into one that came to lie on its goal
            assert first_contact(BLOCKED, segment, 0.0, 25.0, np.array([[x, 0.0, 0.15]])) != ""
        assert first_contact(BLOCKED, segment, 0.0, 25.0, NO_OBSTACLES) == ""


def test_robots_on_their_own_ways_look_out_for_lost_ones_also_where_no_path_is_changed_for_things() -> None:
    trajectory = glides((0.0, 0.0), (2.0, 0.0))
    lost = RobotView(RobotState(estimate=Estimate(eta=np.array([1.0, 0.0, 0.0, 0.0]))), 9.0)
    obstacles = ObstacleSet((1,), np.array([[1.5, 0.0, 0.1]]))
    for settings, sees_things in ((["mission.detours=true"], True), (["mission.detours=false"], False)):
        monitor = ObstacleMonitor(load_experiment("pool", settings))
        monitor.update(obstacles, 0)
        is_return = PlanSegment({1: trajectory}, trajectory, 20.0, is_return=True)
        assert monitor.first_contact(is_return, 0.0, {5: lost}, 1_000_000_000).startswith("robot 5 lies at (1.00, 0.00) m")
        thing = monitor.first_contact(is_return, 0.0, {5: RobotView()}, 1_000_000_000)
        assert thing.startswith("something lies at (1.50, 0.00) m") == sees_things
        in_formation = PlanSegment({1: trajectory}, trajectory, 20.0)
        assert monitor.first_contact(in_formation, 0.0, {5: lost}, 1_000_000_000) == ""  # a circle: they give way


def test_from_rest_into_the_slots_and_on_along_the_leg() -> None:
    segment = first_segment(BLOCKED)
    progress_s, begin_s = 20.0, 21.0
    here = {r: sample(t, np.array([progress_s])).eta[0] for r, t in segment.trajectories.items()}
    rests = {**here, 3: here[3] + [-1.0, -0.6, 0.0, 0.0]}
    new = plan_regroup(BLOCKED, segment, begin_s, progress_s, rests, {1: 1, 2: 2, 3: 3})
    for robot, t in new.trajectories.items():
        assert np.abs(t.eta[0, :3] - rests[robot][:3]).max() < 1e-9
        assert np.abs(t.velocity[0]).max() == 0.0
        check_smooth(t, 0, len(t.eta) - 250)
        np.testing.assert_allclose(t.eta[-1], segment.trajectories[robot].eta[-1], atol=1e-6)
    for a, b in combinations(new.trajectories.values(), 2):
        assert np.linalg.norm(a.eta[:, :3] - b.eta[:, :3], axis=1).min() > 0.59
    assert new.end_s > segment.end_s


def test_a_vehicle_that_turns_slowly_is_given_time_to_turn() -> None:
    """Robots refuse what they cannot fly: then a way home ends in an abort, with everybody disarmed where they are."""
    pool = load_experiment("pool")
    limits = pool.vehicle.limits.model_copy(update={"yaw_rate_radps": 1.2})
    vehicle = pool.vehicle.model_copy(update={"limits": limits})
    experiment, ready = pool.model_copy(update={"vehicle": vehicle}), first_segment(pool)
    starts = {r: t.eta[0] for r, t in ready.trajectories.items()}
    rests = {r: np.array([start[0] + 0.9, start[1], start[2], 0.0]) for r, start in starts.items()}  # they look away
    is_return = plan_return(experiment, 1.0, rests, starts)
    into_place = plan_regroup(experiment, ready, 1.0, 5.0, rests, {r: r for r in rests})
    for segment in (is_return, into_place):
        assert [unflyable(t, experiment.pool, vehicle) for t in segment.trajectories.values()] == ["", ""]
    assert is_return.end_s < 25.0  # and not at a snail's pace


def test_a_gap_closes_without_anybody_crossing() -> None:
    segment = first_segment(BLOCKED)
    eta = {r: sample(segment.trajectories[r], np.array([20.0])).eta[0] for r in (2, 3)}
    slots = assign_slots(segment, 20.0, eta, (1, 2))
    assert set(slots) == {2, 3} and set(slots.values()) == {1, 2}

    def way(robot: int, slot: int) -> float:
        return float(np.sum((eta[robot] - sample(segment.trajectories[slot], np.array([20.0])).eta[0])[:3] ** 2))

    assert way(2, slots[2]) + way(3, slots[3]) <= way(2, slots[3]) + way(3, slots[2])


def test_flown_and_planned_trajectories_join_into_one() -> None:
    segment = first_segment(BLOCKED)
    new = replan(BLOCKED, segment, 14.0, BALL).trajectories[1]
    whole = concatenate(segment.trajectories[1], new)
    seam = round(14.0 / PERIOD_S)
    assert (whole.begin_s, whole.id) == (0.0, new.id)
    np.testing.assert_array_equal(whole.eta[:seam], segment.trajectories[1].eta[:seam])
    np.testing.assert_array_equal(whole.eta[seam:], new.eta)


@pytest.mark.parametrize(("progress_s", "fits"), [(2.0, False), (120.0, True)])
def test_a_plan_from_rest_in_the_longest_run_is_a_message_or_refused(progress_s: float, fits: bool) -> None:
    """Its transfers come on top of what is left of the run."""
    rows = planner.MOST_SAMPLES
    places = {r: trajectory.eta[0] for r, trajectory in first_segment(BLOCKED).trajectories.items()}
    still = {
        r: Trajectory(f"still {r}", PERIOD_S, np.tile(at, (rows, 1)), np.zeros((rows, 4)), np.zeros((rows, 4)))
        for r, at in places.items()
    }
    longest = PlanSegment(still, still[1], (rows - 1) * PERIOD_S - planner.horizon(BLOCKED) * PERIOD_S)
    rests = {r: at + np.array([0.3, 0.0, 0.0, 0.0]) for r, at in places.items()}
    try:
        segment = plan_regroup(BLOCKED, longest, progress_s, progress_s, rests, {r: r for r in rests})
    except PlanError as error:
        assert not fits
        assert "a trajectory message holds 2184 s" in str(error)
        return
    assert fits
    for trajectory in segment.trajectories.values():
        load = Command(CommandKind.LOAD, robot=1, trajectory=trajectory)
        assert decode(Command, encode(load), "station", "command").trajectory is not None


def test_a_joined_trajectory_is_a_message_however_long_the_run_is() -> None:
    period_s, samples = 0.05, planner.MOST_SAMPLES
    line = np.tile(np.arange(samples, dtype=np.float64)[:, None] * period_s, 4)
    longest = Trajectory("longest", period_s, line, line, line)
    later = Trajectory("later", period_s, line + 60.0, line + 60.0, line + 60.0, 60.0)  # after a pause, and to the same end
    joined = longest
    for _ in range(2):
        joined = decode(Trajectory, encode(concatenate(joined, later)), "station", "trajectory")
    assert joined.id == "later" and joined.begin_s == pytest.approx(60.0)
    np.testing.assert_allclose(sample(joined, np.array([60.0, 100.0])).eta[:, 0], [60.0, 100.0], atol=1e-9)
    with_start = concatenate(longest, replace(later, eta=line[:2], velocity=line[:2], acceleration=line[:2]))
    assert with_start.begin_s == 0.0


def world(seed: int) -> tuple[Experiment, np.random.Generator]:
    """Three robots, a few islands on and beside the way, and a thing that turns up later."""
    random = np.random.default_rng([seed, 11])
    count = int(random.integers(0, 5))
    places, radii = random.uniform(-3.5, 3.5, (count, 2)).tolist(), random.uniform(0.2, 0.7, count).tolist()
    islands = [{"position_m": place, "radius_m": radius} for place, radius in zip(places, radii, strict=True)]
    table = BLOCKED.model_dump(mode="json", exclude_none=True)
    start, goal = random.uniform([-6.0, -2.0], [-5.0, 2.0]), random.uniform([5.0, -2.0], [6.0, 2.0])
    table["path"] = {"kind": "route", "via_m": [start.tolist(), goal.tolist()], "speed_mps": 0.15, "depth_m": 0.5}
    table["formation"]["mode"] = str(random.choice(["translate", "rotate"]))
    table |= {"islands": islands, "duration_s": 120.0}
    table["pool"]["size_m"] = [18.0, 12.0, 2.0]
    return Experiment.model_validate(table), random


def replanned(seed: int) -> str:
    """Plan a random world, and again when something turns up; "" if there was a way and it is flyable and clear, by distances
    and differences alone; else why there was none."""
    experiment, random = world(seed)
    try:
        segment = first_segment(experiment)
    except PlanError as error:
        return f"first: {error}"
    begin_s = float(np.round(random.uniform(5.0, 20.0) / PERIOD_S)) * PERIOD_S
    ahead = segment.centre.eta[round((begin_s + random.uniform(14.0, 25.0)) / PERIOD_S), :2]
    thing = np.array([[*(ahead + random.uniform(-0.4, 0.4, 2)), random.uniform(0.1, 0.3)]])
    try:
        new = replan(experiment, segment, begin_s, thing)
    except PlanError as error:
        return f"detour: {error}"
    for a, b in combinations(new.trajectories.values(), 2):
        assert np.linalg.norm(a.eta[:, :3] - b.eta[:, :3], axis=1).min() >= 2.0 * experiment.safety.radius_m - 1e-6, seed
    assert clearance(new, thing[0], begin_s) >= experiment.safety.radius_m - 1e-6, seed
    limits = experiment.vehicle.limits
    for robot, t in new.trajectories.items():
        assert splice_objection(segment.trajectories[robot], t) == "", seed
        flown = slice(0, round((new.end_s - begin_s) / PERIOD_S))
        for island in experiment.islands:
            shore = np.hypot(*(t.eta[flown, :2] - island.position_m).T).min() - island.radius_m
            assert shore >= experiment.vehicle.radius_m - 1e-6, seed
        speed = np.hypot(*np.diff(t.eta[flown, :2], axis=0).T) / PERIOD_S
        assert speed.max() <= limits.speed_mps * 1.001, seed
        assert np.abs(np.diff(t.eta[flown, 3])).max() / PERIOD_S <= limits.yaw_rate_radps * 1.01, seed
    return ""


@pytest.mark.parametrize("seed", range(12))
def test_in_random_worlds_whatever_is_sent_is_clear_and_flyable(seed: int) -> None:
    replanned(seed)


@pytest.mark.slow
def test_a_thousand_random_worlds_have_no_collision() -> None:
    reasons = [replanned(seed) for seed in range(1000)]
    assert sum(not reason for reason in reasons) > 600  # the others have no way, or none that is wide enough in time

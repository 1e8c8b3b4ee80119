"""Ways from rest to rest: clear of everybody all along, and motions that a robot can follow."""

import math
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from groundstation.planning import prioritized_planning as marshalling
from groundstation.planning.feasibility import PlanError
from groundstation.planning.formation import NodeMotion
from groundstation.planning.planner import start_poses
from groundstation.planning.prioritized_planning import plan_transfers
from groundstation.planning.rest_to_rest import keep_away, plan_regroup
from groundstation.planning.route_planner import NoRoute
from groundstation.planning.segment import BESIDE_M, first_segment, sample
from groundstation.planning.transfer import FreeSpace, Transfer, free_space, plan_transfer, s_curve_profile
from shoal.config.controller import WAY_ROOM_M
from shoal.config.experiment import NO_CAMERA, Experiment, load_experiment
from shoal.config.scene import Island
from shoal.frames import Array

PERIOD_S = 0.05
NO_OBSTACLES = np.zeros((0, 3))


def pool(*islands: tuple[float, float, float], size_m: tuple[float, float, float] = (12.0, 10.0, 3.0)) -> Experiment:
    base = load_experiment("open-water")
    return base.model_copy(
        update={
            "islands": tuple(Island(position_m=(x, y), radius_m=r) for x, y, r in islands),
            "pool": base.pool.model_copy(update={"size_m": size_m, "walls": True}),
        }
    )


def pose(x: float, y: float, z: float = 1.0, yaw: float = 0.3) -> Array:
    return np.array([x, y, z, yaw])


def check(experiment: Experiment, motions: dict[int, NodeMotion], starts: dict[int, Array], goals: dict[int, Array]) -> None:
    """Everything that must hold, by distances and finite differences alone."""
    keep = 2.0 * experiment.safety.radius_m
    for a, b in combinations(motions, 2):
        apart = float(np.linalg.norm(motions[a].eta[:, :3] - motions[b].eta[:, :3], axis=1).min())
        rests = [float(np.linalg.norm(places[a][:3] - places[b][:3])) for places in (starts, goals)]
        assert apart >= min(keep, *rests) - 2e-3
    for robot, motion in motions.items():
        p, v, pushed = motion.eta[:, :3], motion.velocity[:, :3], motion.acceleration[:, :3]
        assert np.abs(p[0] - starts[robot][:3]).max() < 1e-9
        assert np.abs(p[-1] - goals[robot][:3]).max() < 2e-3
        assert np.abs(v[[0, -1]]).max() < 1e-9
        assert np.abs(np.diff(p, axis=0) / PERIOD_S - 0.5 * (v[1:] + v[:-1])).max() < 2e-3
        assert np.abs(np.diff(v, axis=0) / PERIOD_S - 0.5 * (pushed[1:] + pushed[:-1])).max() < 2e-2
        assert np.abs(np.diff(pushed, axis=0)).max() < 0.02  # no jump
        for island in experiment.islands:
            shore = np.hypot(*(p[:, :2] - island.position_m).T).min() - island.radius_m
            assert shore >= experiment.vehicle.radius_m - 1e-6


def test_a_glide_is_smooth_and_ends_where_it_should() -> None:
    for length in (0.01, 0.3, 5.0):
        distance_m, rate, bend = s_curve_profile(length, 0.15, PERIOD_S)
        assert distance_m[0] == 0.0 and distance_m[-1] == pytest.approx(length, abs=1e-9)
        assert rate.max() <= 0.15 + 1e-12 and rate.min() >= -1e-12
        np.testing.assert_allclose(np.gradient(distance_m, PERIOD_S)[1:-1], rate[1:-1], atol=2e-4)
        np.testing.assert_allclose(np.gradient(rate, PERIOD_S)[1:-1], bend[1:-1], atol=3e-3)


@pytest.mark.parametrize("seed", range(25))
def test_random_robots_find_home_clear_of_one_another(seed: int) -> None:
    random = np.random.default_rng([seed, 7])
    experiment = pool((0.0, 0.0, 0.6), (2.5, 2.0, 0.4))
    count = int(random.integers(2, 7))

    def places() -> dict[int, Array]:
        chosen: list[Array] = []
        while len(chosen) < count:
            p = random.uniform([-5.3, -4.3, 0.5, -3.0], [5.3, 4.3, 2.0, 3.0])
            clear = all(np.hypot(*(p[:2] - i.position_m)) > i.radius_m + 0.25 for i in experiment.islands)
            if clear and all(np.hypot(*(p[:2] - q[:2])) > 0.65 for q in chosen):
                chosen.append(p)
        return dict(enumerate(chosen, 1))

    starts, goals = places(), places()
    check(experiment, plan_transfers(experiment, starts, goals, NO_OBSTACLES), starts, goals)


def test_two_on_one_anothers_places_change_them() -> None:
    experiment = pool(size_m=(4.0, 3.0, 2.0))
    starts = {1: pose(-0.5, 0.0), 2: pose(0.5, 0.0)}
    goals = {1: starts[2], 2: starts[1]}
    check(experiment, plan_transfers(experiment, starts, goals, NO_OBSTACLES), starts, goals)


def test_three_go_round_in_a_ring() -> None:
    experiment = pool(size_m=(5.0, 4.0, 2.0))
    starts = {1: pose(-0.6, 0.0), 2: pose(0.6, 0.0), 3: pose(0.0, 1.0)}
    goals = {1: starts[2], 2: starts[3], 3: starts[1]}
    check(experiment, plan_transfers(experiment, starts, goals, NO_OBSTACLES), starts, goals)


def test_a_thing_in_the_way_is_gone_round() -> None:
    experiment = pool()
    starts, goals = {1: pose(-3.0, 0.0)}, {1: pose(3.0, 0.0)}
    motions = plan_transfers(experiment, starts, goals, np.array([[0.0, 0.1, 0.5]]))
    check(experiment, motions, starts, goals)
    assert np.hypot(*(motions[1].eta[:, :2] - [0.0, 0.1]).T).min() >= 0.5 - 1e-6


@given(
    rests_m=st.floats(0.3, 0.59),
    at_rad=st.floats(-math.pi, math.pi),
    goal_m=st.floats(0.65, 1.3),
    to_rad=st.floats(-math.pi, math.pi),
)
@example(rests_m=0.3, at_rad=0.975, goal_m=0.963, to_rad=3.092)
@settings(max_examples=40)
def test_a_robot_that_touches_another_one_finds_a_way_around_it(
    rests_m: float, at_rad: float, goal_m: float, to_rad: float
) -> None:
    """After a stop robots drift up to one another; their discs are wider than their hulls."""
    place, goal = rests_m * np.exp(1j * at_rad), goal_m * np.exp(1j * to_rad)
    starts, goals = {1: pose(place.real, place.imag)}, {1: pose(goal.real, goal.imag)}
    motions = plan_transfers(pool(), starts, goals, np.array([[0.0, 0.0, 0.6]]))
    check(pool(), motions, starts, goals)
    assert np.hypot(*motions[1].eta[:, :2].T).min() >= rests_m - BESIDE_M


@pytest.mark.parametrize("turn_rad", [0.6, -1.0, 1.5, 2.4])
@pytest.mark.parametrize("rests_m", [0.9, 1.18, 1.25])
def test_a_robot_that_rests_nearer_to_a_thing_than_it_would_fly_finds_a_way_around(rests_m: float, turn_rad: float) -> None:
    """A lost robot that drifted up to it, for example. It comes no nearer than it rests, but for a bend's last centimetre."""
    experiment, goal = pool(), 1.27 * np.exp(1j * turn_rad)
    starts, goals = {1: pose(rests_m, 0.0)}, {1: pose(goal.real, goal.imag)}
    motions = plan_transfers(experiment, starts, goals, np.array([[0.0, 0.0, 1.25]]))
    check(experiment, motions, starts, goals)
    assert np.hypot(*motions[1].eta[:, :2].T).min() >= rests_m - BESIDE_M


def test_a_robot_that_is_at_its_goal_already_stays() -> None:
    starts = {1: pose(0.0, 0.0), 2: pose(2.0, 0.0)}
    goals = {1: pose(0.0, 0.0), 2: pose(1.0, 0.0)}
    motions = plan_transfers(pool(), starts, goals, NO_OBSTACLES)
    assert np.ptp(motions[1].eta, axis=0).max() == 0.0
    assert len(motions[1].eta) == len(motions[2].eta)


def test_no_way_is_said_and_why() -> None:
    ring = np.array([[2.0 * np.cos(a), 2.0 * np.sin(a), 0.7] for a in np.linspace(0.0, 2.0 * np.pi, 16)])
    with pytest.raises(PlanError, match=r"robot 1: no way from \(0\.00, 0\.00\) to \(4\.00, 0\.00\) m"):
        plan_transfers(pool(), {1: pose(0.0, 0.0)}, {1: pose(4.0, 0.0)}, ring)


@pytest.mark.parametrize("absurd", [(np.nan, 0.0), (1e9, 0.0), (0.0, np.nan), (0.0, np.inf)])
def test_a_robot_that_tells_an_impossible_place_is_not_marshalled(absurd: tuple[float, float]) -> None:
    x, yaw = absurd
    with pytest.raises(PlanError, match="robot 1 says that it"):
        plan_transfers(pool(), {1: pose(x, 0.0, yaw=yaw)}, {1: pose(4.0, 0.0)}, NO_OBSTACLES)


def test_a_transfer_past_a_waiting_robot_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """No route leads around: each transfer is planned here as if no robot stood anywhere."""

    def as_if_alone(of: Experiment, around: FreeSpace, start: Array, goal: Array, *others: Any) -> Transfer:
        return plan_transfer(of, around, start, goal, [])

    monkeypatch.setattr(marshalling, "plan_transfer", as_if_alone)
    monkeypatch.setattr(marshalling, "ORDERS", 2)
    starts = {1: pose(-2.0, 0.0), 2: pose(0.0, 0.1)}
    with pytest.raises(PlanError, match="robot 1 would pass too near a robot that waits"):
        plan_transfers(pool(), starts, {1: pose(2.0, 0.0), 2: starts[2]}, NO_OBSTACLES)


def test_a_way_that_turns_on_the_spot_is_no_way_and_says_so() -> None:
    """From places of the pool run, among three things that the camera sees: no spline takes the corner in front of the goal.
    Anything but a reason would end the station, with its robots in the water."""
    experiment = load_experiment("pool")
    rest = np.array([0.53692761, 0.06801661, 0.25018865, 2.48896894])
    parked = np.array([-0.29450748, 0.15240046, 0.26044311, 2.37850454])
    goal = sample(first_segment(experiment).trajectories[1], np.array([18.7])).eta[0]
    obstacles = np.array(
        [
            [2.0196855927151156, -0.9989661938522431, 0.1788811895480024],
            [1.4630468041366795, 0.4795651934960071, 0.571192825510389],
            [-0.5635884974798929, 1.2058292559251262, 0.24152648781989094],
        ]
    )
    around = free_space(experiment, keep_away(experiment, obstacles), 0.6)
    with pytest.raises(NoRoute, match="turns on the spot"):
        plan_transfer(experiment, around, rest, goal, [parked])


@pytest.mark.parametrize("scene", ["crossing-2", "crossing-4", "overtake", "swap"])
def test_robots_on_paths_through_one_another_are_led_to_places_apart(scene: str) -> None:
    """They were told to hold while they passed, and are to go on: at no time do all of them have to rest at one place."""
    experiment = load_experiment(scene)
    segment, keep_m = first_segment(experiment), 2.0 * experiment.safety.radius_m
    robots, most_m = experiment.robot_ids, keep_m - 0.005
    places = np.array([segment.trajectories[robot].eta[:, :3] for robot in robots])
    apart_m = np.array([np.linalg.norm(a - b, axis=1) for a, b in combinations(places, 2)]).min(axis=0)
    met_s = PERIOD_S * int(np.argmin(apart_m))
    assert apart_m.min() < 0.5 * keep_m
    rests = {robot: segment.trajectories[robot].eta[0] for robot in robots}
    for progress_s in (met_s - 2.0, met_s):
        plan = plan_regroup(experiment, segment, 20.0, progress_s, rests, {robot: robot for robot in robots})
        there = round((plan.transfer_end_s - 20.0) / PERIOD_S)
        ways = [plan.trajectories[robot].eta[: there + 1, :3] for robot in robots]
        assert min(np.linalg.norm(a - b, axis=1).min() for a, b in combinations(ways, 2)) > most_m
        assert plan.end_s - plan.transfer_end_s > 1.0, "the rest of the path is still flown"


@pytest.mark.long
def test_a_dense_fleet_without_transfers_is_refused_in_bounded_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twenty robots of a grid, a third of a circle from where they began: each goal is beside somebody who waits."""
    made = []

    def counted(*given: Any) -> Transfer:
        made.append(given)
        return plan_transfer(*given)

    monkeypatch.setattr("groundstation.planning.prioritized_planning.MOST_TRIES", 60)
    monkeypatch.setattr("groundstation.planning.prioritized_planning.plan_transfer", counted)
    experiment = load_experiment("fleet-20")
    segment = first_segment(experiment)
    rests, goals = {r: t.eta[400] for r, t in segment.trajectories.items()}, start_poses(experiment, segment.trajectories)
    with pytest.raises(PlanError, match="in 60 tries"):
        plan_transfers(experiment, rests, goals, NO_OBSTACLES)
    assert len(made) <= 60 * 2 * len(rests)


def test_planning_ends_when_nobody_waits_any_longer() -> None:
    calls: list[int] = []

    def out_of_time() -> bool:
        calls.append(1)
        return len(calls) > 3

    experiment = load_experiment("fleet-20")
    segment = first_segment(experiment)
    rests, goals = {r: t.eta[400] for r, t in segment.trajectories.items()}, start_poses(experiment, segment.trajectories)
    with pytest.raises(PlanError, match="in time, in 1 tries"):
        plan_transfers(experiment, rests, goals, NO_OBSTACLES, out_of_time)


def test_a_way_that_leads_out_of_the_camera_s_picture_is_refused() -> None:
    """An island fills the picture from edge to edge, and the way round it leaves it. Who rests beside the picture may go."""
    experiment = load_experiment("pool", ["pool.size_m=[8,8,1]", "islands=[{position_m=[0,0],radius_m=1.2}]"])
    starts, goals = {1: pose(-1.6, 0.0, 0.3)}, {1: pose(1.6, 0.0, 0.3)}
    with pytest.raises(PlanError, match=r"robot 1: its way leads 0\.\d+ m beyond the camera's picture, at \("):
        plan_transfers(experiment, starts, goals, NO_OBSTACLES)
    plan_transfers(load_experiment("pool", ["pool.size_m=[8,8,1]", NO_CAMERA]), starts, goals, NO_OBSTACLES)
    open_water = experiment.model_copy(update={"islands": ()})
    plan_transfers(open_water, {1: pose(2.2, 0.0, 0.3)}, {1: pose(0.5, 0.0, 0.3)}, NO_OBSTACLES)


def test_ways_leave_the_room_for_which_robots_give_way_in_flight() -> None:
    """From a line into a triangle two ways came to 0.68 m, and robots gave way on the station's own plan."""
    starts = {1: pose(-0.8, 0.0), 2: pose(0.0, 0.0), 3: pose(0.8, 0.0)}
    goals = {1: pose(-0.4, 0.6), 2: pose(0.0, 0.6 + 0.4 * 3.0**0.5), 3: pose(0.4, 0.6)}
    motions = plan_transfers(pool(), starts, goals, NO_OBSTACLES)
    for a, b in combinations(motions, 2):
        assert np.linalg.norm(motions[a].eta[:, :3] - motions[b].eta[:, :3], axis=1).min() > 0.6 + WAY_ROOM_M


def test_ways_are_nearer_where_there_is_no_more_room() -> None:
    """Past a robot that stays, between it and a wall: there is room for 2R, and for no more."""
    starts = {1: pose(-1.2, 0.25), 2: pose(0.0, -0.28)}
    goals = {1: pose(1.2, 0.25), 2: starts[2]}
    experiment = pool(size_m=(4.0, 1.2, 2.0))
    motions = plan_transfers(experiment, starts, goals, NO_OBSTACLES)
    check(experiment, motions, starts, goals)
    assert np.linalg.norm(motions[1].eta[:, :3] - motions[2].eta[:, :3], axis=1).min() < 0.6 + WAY_ROOM_M

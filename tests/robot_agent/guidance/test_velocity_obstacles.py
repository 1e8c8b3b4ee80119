"""The rule by itself: point masses that do exactly what it says, in random geometries."""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_agent.control.nonlinear.tuning import agility
from robot_agent.guidance.formation import WAY_STEP_S, WAY_STEPS, Formation, Neighbour
from robot_agent.guidance.reference import Reference
from robot_agent.guidance.velocity_obstacles import NOBODY, SURE_S, GiveWay, Traffic, robot_traffic, straight_ways
from shoal.config.experiment import load_experiment
from shoal.messages.messages import Plan

EXPERIMENT = load_experiment("pool")
VEHICLE = EXPERIMENT.vehicle
AGILITY = agility(VEHICLE)
ROOM_M = AGILITY.room_m
PERIOD_S, KEEP_M = 0.1, 0.6 + ROOM_M
TIMES_S = np.concatenate([[0.0], 0.05 + PERIOD_S * np.arange(26)])


def one(place: complex, velocity: complex, keep_m: float, sided: bool) -> Traffic:
    going = np.array([velocity], complex)
    return Traffic(np.array([place], complex), going, np.array([keep_m]), np.array([sided]), straight_ways(going))


class Point:
    """A robot without inertia on a straight line at constant speed, that stops at its end."""

    def __init__(self, start: complex, end: complex, speed_mps: float, room_m: tuple[float, float] | None = None) -> None:
        self.place, self.start, self.end, self.speed_mps = start, start, end, speed_mps
        self.give_way = GiveWay(VEHICLE, TIMES_S, PERIOD_S, AGILITY, room_m)
        self.traffic = NOBODY
        self.velocity = 0j

    def path(self, time_s: float) -> Reference:
        along, length = (self.end - self.start) / abs(self.end - self.start), abs(self.end - self.start)
        way = self.speed_mps * (time_s + TIMES_S)
        place = self.start + along * np.minimum(way, length)
        velocity = self.speed_mps * along * (way < length)
        zero = np.zeros_like(way)
        eta = np.stack([place.real, place.imag, zero, zero + math.atan2(along.imag, along.real)], axis=1)
        return Reference(eta, np.stack([velocity.real, velocity.imag, zero, zero], axis=1), np.zeros_like(eta))

    def step(self, time_s: float, traffic: Traffic) -> bool:
        """One period. Returns whether it leaves its path."""
        path = self.path(time_s)
        led = self.give_way.avoidance_path(path, self.place, traffic)
        self.velocity = complex(led.velocity[1, 0], led.velocity[1, 1]) + 0.5 * (
            complex(led.eta[1, 0], led.eta[1, 1]) - self.place
        )
        second = led.eta[10, :2] - led.eta[0, :2]
        self.traffic = one(self.place, complex(*second) / float(TIMES_S[10]), KEEP_M, True)
        return led is not path

    def move(self) -> None:
        self.place += self.velocity * PERIOD_S


def fly(points: list[Point], seconds: float) -> tuple[float, np.ndarray]:
    """Everyone hears of everyone a step late. Returns how near any two came, and all places (steps, points)."""
    nearest, track = math.inf, []
    for k in range(round(seconds / PERIOD_S)):
        traffic = [point.traffic for point in points]
        for i, point in enumerate(points):
            point.step(k * PERIOD_S, functools.reduce(Traffic.joined, traffic[:i] + traffic[i + 1 :]))
        for point in points:
            point.move()
        places = np.array([point.place for point in points])
        nearest = min(nearest, float((np.abs(places[:, None] - places) + 1e9 * np.eye(len(places))).min()))
        track.append(places)
    return nearest, np.array(track)


@pytest.mark.parametrize("seconds", [0.1, 0.5, 2.5])
def test_robot_in_the_way_is_seen_whatever_the_horizon(seconds: float) -> None:
    times_s = TIMES_S[: np.searchsorted(TIMES_S, seconds)]
    for ahead_m, leaves in ((1.0, True), (-1.0, False)):
        point = Point(0j, 5.0 + 0j, 0.1)
        point.give_way = GiveWay(VEHICLE, times_s, PERIOD_S, AGILITY)
        left = []
        for k in range(6):
            whole = point.path(k * PERIOD_S)
            path = Reference(whole.eta[: len(times_s)], whole.velocity[: len(times_s)], whole.acceleration[: len(times_s)])
            left.append(point.give_way.avoidance_path(path, 0j, one(ahead_m + 0j, -0.1 + 0j, KEEP_M, True)) is not path)
        assert left == [leaves and k >= round(SURE_S / PERIOD_S) - 1 for k in range(6)]


def arrived(points: list[Point]) -> bool:
    return all(abs(point.place - point.end) < 0.02 for point in points)


@pytest.mark.parametrize("seed", range(12))
def test_two_that_meet_pass_and_arrive_wherever_they_come_from(seed: int) -> None:
    """Courses cross at any angle, at about the same time."""
    random = np.random.default_rng(seed)
    angle, speed = random.uniform(math.pi / 3.0, 5.0 * math.pi / 3.0), random.uniform(0.07, 0.14)
    turned, off = complex(math.cos(angle), math.sin(angle)), complex(*random.uniform(-0.3, 0.3, 2))
    points = [Point(-1.8, 1.8, 0.1), Point(-1.8 * turned + off, 1.8 * turned + off, speed)]
    nearest, _ = fly(points, 120.0)
    assert nearest > KEEP_M - 0.06
    assert arrived(points)


@pytest.mark.parametrize("seed", range(8))
def test_head_on_both_leave_one_another_to_port(seed: int) -> None:
    mine, theirs, early = np.random.default_rng(seed).uniform([-0.15, -0.15, 0.0], [0.15, 0.15, 1.5]).tolist()
    points = [Point(-1.8 + 1j * mine, 1.8 + 1j * mine, 0.1), Point(1.8 + early + 1j * theirs, -1.8 + 1j * theirs, 0.1)]
    _, track = fly(points, 30.0)
    beside = int(np.argmin(np.abs(track[:, 0].real - track[:, 1].real)))
    assert track[beside, 0].imag > track[beside, 1].imag + 0.6  # y grows to starboard of who goes along x


@pytest.mark.parametrize("seed", range(2))
def test_four_through_one_point_go_round_one_another(seed: int) -> None:
    random = np.random.default_rng(seed)
    off = random.uniform(-0.1, 0.1, 4) + 1j * random.uniform(-0.1, 0.1, 4)
    points = [Point(1.5 * 1j**k + off[k], -1.5 * 1j**k, 0.1) for k in range(4)]
    nearest, _ = fly(points, 65.0)
    assert nearest > 0.65 and arrived(points)


def test_overtaken_robot_goes_on_and_the_other_passes_around() -> None:
    points = [Point(-1.9 + 0.02j, 1.9 + 0.02j, 0.1), Point(-1.0, 0.6, 0.04)]
    nearest, track = fly(points, 60.0)
    assert nearest > KEEP_M - 0.06 and arrived(points)
    assert np.abs(track[:, 1].imag).max() < 0.05 and np.abs(track[:, 0].imag).max() > 0.6


@pytest.mark.parametrize(("speed_mps", "slower", "aside_m"), [(0.101, 0.44, -0.093), (0.1, 0.5, 0.2), (0.1776, 0.454, 0.03)])
def test_robot_that_overtakes_stays_beside_its_reference(speed_mps: float, slower: float, aside_m: float) -> None:
    """It cannot be back before its reference has passed too. Ahead of that it would circle around the other robot."""
    points = [Point(-3.0 + 1j * aside_m, 5.0 + 1j * aside_m, speed_mps), Point(-1.6, 3.0, speed_mps * slower)]
    _, track = fly(points, 42.0)
    time_s = PERIOD_S * np.arange(1, len(track) + 1)
    assert (track[:, 0].real - points[0].start.real - speed_mps * time_s).max() < 0.05
    off_m = abs(track[:, 0] - points[0].start - speed_mps * time_s)
    away_s = PERIOD_S * np.count_nonzero(off_m > 0.05)
    passing_s = 2.0 * math.sqrt(KEEP_M**2 - aside_m**2) / (speed_mps * (1.0 - slower))
    assert off_m.max() < KEEP_M + abs(aside_m) + 0.1 and away_s < passing_s + 8.0


@settings(max_examples=25, deadline=None)
@given(st.floats(0.0, 6.28), st.floats(0.61, 3.0), st.floats(-0.009, 0.009), st.floats(0.0, 0.3))
def test_robots_in_formation_are_given_back_their_own_path(angle: float, apart: float, drift: float, speed: float) -> None:
    """Side by side at the same velocity, or nearly so, as near as the planner allows."""
    me = Point(0j, 100 + 0j, max(speed, 1e-3))
    where = apart * complex(math.cos(angle), math.sin(angle))
    mate = one(where, complex(speed, 0.0) - drift * where / apart, KEEP_M, True)
    assert not any(me.step(k * PERIOD_S, mate) for k in range(20))


def test_robot_comes_back_to_its_path_without_overshoot() -> None:
    points = [Point(-1.8, 2.5, 0.1), Point(1.8, -1.8, 0.1)]
    _, track = fly(points, 60.0)
    aside = track[:, 0].imag
    assert aside.max() > 0.2 and aside.min() > -0.01
    gone = int(np.argmax(aside))
    assert np.all(np.diff(aside[gone:]) < 1e-3)


def test_robot_whose_path_is_over_does_not_creep_around_one_that_rests() -> None:
    """Something is ahead of it until its path is over. Then a robot rests halfway between it and its end."""
    point, time_s, rests = Point(-1.6, 0.0, 0.1), 0.0, 0j
    while time_s < 20.0 or abs(point.place - point.end) > 0.05:
        if time_s < 20.0:
            ahead = (point.end - point.place) / abs(point.end - point.place)
            point.step(time_s, one(point.place + ahead, 0j, 1.5, False))
            rests = 0.5 * point.place + 0.02j
        else:
            point.step(time_s, one(rests, 0j, KEEP_M, False))
        point.move()
        time_s += PERIOD_S
        assert time_s < 20.0 + 4.0 * abs(rests) / (0.5 * AGILITY.fastest_mps)


@pytest.mark.parametrize(("robot", "other", "by_its_path"), [(0.0j, 0.1j, True), (0.5j, 0.1j, True), (0.5j, 1.0j, False)])
def test_path_that_leads_into_others_is_told_from_a_robot_that_is_off_it(
    robot: complex, other: complex, by_its_path: bool
) -> None:
    """All three give way. In the last case the path is free, 1 m to port of what the robot, 0.5 m off, would come too near."""
    point = Point(-1.8, 1.8, 0.1)
    point.place += robot
    answers = [point.step(k * PERIOD_S, one(other, -0.1 + 0j, KEEP_M, True)) for k in range(5)]
    assert answers[-1] and point.give_way.path_is_blocked is by_its_path
    point.give_way.reset()
    assert not point.give_way.path_is_blocked


def test_robot_is_not_driven_into_a_wall() -> None:
    """The wall is 0.5 m to starboard: the other one has to do it all."""
    room = (10.0, 1.0)
    points = [Point(-1.8 + 0.3j, 1.8 + 0.3j, 0.1, room), Point(1.8 + 0.3j, -1.8 + 0.3j, 0.1, room)]
    nearest, track = fly(points, 60.0)
    assert np.abs(track.imag).max() < 0.5 - VEHICLE.radius_m
    assert nearest > 0.0


@pytest.mark.parametrize("way", [0.2j, -0.2j])
def test_round_an_obstacle_the_shorter_way_counts(way: complex) -> None:
    point = Point(-1.8, 1.8, 0.1)
    ball = one(way, 0j, 0.4, False)
    side = [point.place.imag]
    for k in range(500):
        point.step(k * PERIOD_S, ball)
        point.move()
        side.append(point.place.imag)
        assert abs(point.place - way) > 0.36
    assert abs(point.place - point.end) < 0.02
    assert max(side, key=abs) * way.imag < 0.0


@pytest.mark.parametrize("stops", [True, False])
def test_robot_does_not_flee_from_one_that_comes_towards_it_and_means_to_stop(stops: bool) -> None:
    """Two that fly into places 0.8 m apart, one behind the other on a line."""
    point, leaves = Point(-0.2 + 0j, 0j, 0.1), False
    for k in range(100):
        time_s = k * PERIOD_S
        way = 0.2 * (time_s + WAY_STEP_S * np.arange(WAY_STEPS + 1, dtype=np.float64))
        place = 2.0 - (np.minimum(way, 1.2) if stops else way)
        other = one(complex(place[0]), complex((place[2] - place[0]) / (2.0 * WAY_STEP_S)), KEEP_M, True)
        leaves |= point.step(time_s, other._replace(way=(place[1:] - place[0])[None].astype(np.complex128)))
        point.move()
        if not stops and leaves:
            return
    assert stops and not leaves and abs(point.place) < 0.02


def plan(urgent: bool = False, depth_m: float = 0.3) -> Plan:
    eta = np.zeros((51, 4))
    eta[:, 0], eta[:, 2] = 1.0 - 0.1 * 0.05 * np.arange(51), depth_m
    return Plan(0.05, eta, eta + np.array([0.0, 0.2, 0.0, 0.0]), urgent=urgent)


def met(neighbour: Neighbour, now_ns: int = 0, urgent: bool = False) -> Traffic:
    """Seen by a robot at 0.3 m."""
    formation = Formation(
        EXPERIMENT.safety, 0.05 * np.arange(1, 52, dtype=np.float64), EXPERIMENT.controller.mpc.q_formation, False
    )
    predictions = formation.predict_neighbours([neighbour], now_ns)
    return robot_traffic(predictions, formation.clearances_m(predictions, now_ns), ROOM_M, 0.3, urgent)


def test_a_robot_is_where_its_plan_says_it_is_now_and_goes_where_it_means_to() -> None:
    traffic = met(Neighbour(2, 0, plan(), True), 1_000_000_000)
    assert traffic.place == pytest.approx([0.9]) and traffic.velocity == pytest.approx([-0.1])
    assert traffic.keep_m == pytest.approx([2.0 * EXPERIMENT.safety.radius_m + ROOM_M])


@pytest.mark.parametrize("rests", [True, False])
def test_a_way_that_a_robot_tells_counts_if_it_comes_to_rest_there(rests: bool) -> None:
    intended = plan()
    along_m, reference = 0.1 * 0.05 * np.arange(51, dtype=np.float64), np.zeros((51, 4))
    reference[:, 0], reference[:, 2] = 1.0 - np.minimum(along_m, 0.15), 0.3
    reference[:, 1] = 0.0 if rests else np.maximum(along_m - 0.15, 0.0)
    way = met(Neighbour(2, 0, replace(intended, eta_reference=reference), True)).way[0]
    straight = -0.1 * WAY_STEP_S * np.arange(1, len(way) + 1)
    assert way == pytest.approx(np.maximum(straight, -0.15) if rests else straight)


@pytest.mark.parametrize(("silent_s", "more_m"), [(0.0, 0.0), (3.0, 0.3), (30.0, 0.5), (57.0, 0.3), (60.0, 0.0), (1e5, 0.0)])
def test_space_around_a_silent_robot_grows_and_goes_again_but_the_robot_stays(silent_s: float, more_m: float) -> None:
    traffic = met(Neighbour(2, 0, plan(), False), round(silent_s * 1e9))
    assert traffic.keep_m == pytest.approx([2.0 * EXPERIMENT.safety.radius_m + ROOM_M + more_m])
    if silent_s >= 3.0:  # its plan is used up
        assert traffic.place == pytest.approx([0.75]) and traffic.velocity == pytest.approx([0.0])
    assert not traffic.yields[0]


def test_robot_adrift_gives_way_to_nobody_and_goes_where_it_drifts() -> None:
    """Seen by an urgent robot; and it comes from astern, where a robot with thrust would keep clear."""
    last_plan = plan()
    adrift = replace(last_plan, eta_reference=last_plan.eta, adrift=True)
    neighbour = Neighbour(2, 0, adrift, True, hears_us=True)
    assert met(neighbour, urgent=True).keep_m[0] > 0.0 and not met(neighbour, urgent=True).yields[0]
    left = []
    for yields in (True, False):
        point = Point(-1.8, 1.8, 0.1)
        astern = one(-2.8 + 0.1j, 0.25 + 0j, KEEP_M, yields)
        left.append([point.step(k * PERIOD_S, astern) for k in range(5)][-1])
    assert left == [False, True]


def test_only_who_is_deep_below_is_out_of_the_way() -> None:
    keep_m = 2.0 * EXPERIMENT.safety.radius_m
    assert met(Neighbour(2, 0, plan(depth_m=0.35 + keep_m), True)).keep_m == 0.0
    assert met(Neighbour(2, 0, plan(depth_m=0.25 + keep_m), True)).keep_m > keep_m


@pytest.mark.parametrize(
    ("mine", "theirs", "hears_us", "fresh", "yields"),
    [(True, False, True, True, True), (True, True, True, True, False), (True, False, False, True, False),
     (True, False, True, False, False), (False, False, True, True, False)],
)  # fmt: skip
def test_only_a_robot_that_hears_us_and_is_heard_yields_to_the_urgent(
    mine: bool, theirs: bool, hears_us: bool, fresh: bool, yields: bool
) -> None:
    traffic = met(Neighbour(2, 0, plan(theirs), fresh, hears_us=hears_us), urgent=mine)
    assert (traffic.keep_m[0] == 0.0) == yields

"""Kernels of guidance against NumPy, on scenes drawn at random."""

import numpy as np
import pytest

from robot_agent.guidance.formation import WAY_STEP_S, WAY_STEPS, Formation, Neighbour, Places
from robot_agent.guidance.reference import sample_trajectory
from robot_agent.guidance.velocity_obstacles import (
    ABAFT,
    CATCH_UP,
    HEAD_ON,
    PARTING,
    SLIGHTEST_MPS,
    STANDS_ON,
    WALL_S,
    WELL_CLEAR,
    Agility,
    Basin,
    Motion,
    Traffic,
    closes_in,
    find_meetings,
    look_ahead,
    make_fan,
    nearest_free,
    path_back,
    path_out,
    set_horizons,
)
from shoal.frames import Array
from shoal.messages.messages import Plan
from tests.robot_agent.guidance.expectations import CONFIG, NS, PERIOD_S, SAFETY, STEPS

SEEDS = range(8)
LOOK_AHEAD_S, AGILITY = 8.0, Agility(0.15, 8.0, 0.4, 0.12, 0.5, 0.25)
TIMES_S = np.concatenate([[0.0], 0.05 + PERIOD_S * np.arange(STEPS, dtype=np.float64)])
LOOKS_S = WAY_STEP_S * np.arange(1, 17)


def places(random: np.random.Generator, size: float, *shape: int) -> Places:
    return np.asarray(size * (random.normal(size=shape) + 1j * random.normal(size=shape)))


def columns(rows: Array, place: Array) -> Array:
    """Rows at fractional row numbers, column by column, held beyond the ends."""
    return np.column_stack([np.interp(place, np.arange(len(rows)), column) for column in rows.T])


# --- formation


@pytest.mark.parametrize("seed", SEEDS)
def test_plans_are_sampled_as_by_interpolation_of_each(seed: int) -> None:
    random, now_ns, most_m = np.random.default_rng(seed), 3 * NS, 1.5
    nodes_s = 0.04 + PERIOD_S * np.arange(STEPS, dtype=np.float64)
    others, expected, poses = [], np.zeros((STEPS, 4)), []
    formation = Formation(SAFETY, nodes_s, CONFIG.q_formation, False, most_m)
    for robot in range(2, 8):
        eta, reference = random.normal(size=(2, int(random.integers(1, 60)), 4))
        reference[:, 3] += 2.0 * np.pi * random.integers(-3, 4)
        plan = Plan(float(random.uniform(0.02, 0.2)), eta, reference)
        others.append(Neighbour(robot, int(random.integers(-NS, 4 * NS)), plan, random.random() < 0.7, random.random() < 0.7))
        place = np.asarray((nodes_s + (now_ns - others[-1].stamp_ns) / NS) / plan.period_s, np.float64)
        deviation = eta - reference
        deviation[:, 3] -= 2.0 * np.pi * np.rint(deviation[0, 3] / (2.0 * np.pi))
        off = columns(deviation, place)
        off[:, :3] *= np.minimum(1.0, most_m / np.maximum(np.linalg.norm(off[:, :3], axis=1), 1e-9))[:, None]
        if others[-1].fresh and others[-1].formation:
            expected += off
        poses.append(columns(eta, place))
    predictions = formation.predict_neighbours(others, now_ns)
    assert predictions.deviation == pytest.approx(expected, abs=1e-9)
    assert predictions.pose == pytest.approx(np.array(poses), abs=1e-9)


# --- reference


@pytest.mark.parametrize("seed", SEEDS)
def test_a_trajectory_is_sampled_as_by_interpolation(seed: int) -> None:
    random = np.random.default_rng(seed)
    path, offset_s = random.normal(size=(3, 30, 4)), np.sort(random.uniform(0.0, 3.0, 40))
    begin_s, period_s, time_s, rate, waits_s = random.uniform(0.05, 1.0, 5).tolist()
    result = np.empty((3, 40, 4))
    sample_trajectory(path, begin_s, period_s, time_s, rate, waits_s, offset_s, result)
    place = (time_s + rate * np.maximum(offset_s - waits_s, 0.0) - begin_s) / period_s
    moves = rate * ((place >= 0.0) & (place <= 29.0) & (offset_s >= waits_s))[:, None]
    for rows, samples, pace in zip(result, path, (1.0, moves, moves**2), strict=True):
        assert rows == pytest.approx(pace * columns(samples, place), abs=1e-9)


# --- velocity obstacles


def scene(seed: int) -> tuple[np.random.Generator, complex, complex, Traffic, Array]:
    """A place, a velocity, and seven that may be in its way, each for a time."""
    random = np.random.default_rng(seed)
    place, velocity = places(random, 0.2, 2).tolist()
    keep_m, yields = random.uniform(0.1, 0.9, 7) * (random.random(7) < 0.9), random.random(7) < 0.6
    there, going, way = places(random, 1.0, 7), places(random, 0.1, 7), np.reshape(places(random, 0.3, 7 * WAY_STEPS), (7, -1))
    traffic = Traffic(there, going, keep_m, yields, way)
    return random, place, velocity, traffic, random.uniform(2.0, 8.0, 7) * (random.random(7) < 0.8)


def dot(a: Places | complex, b: Places | complex) -> Array:
    return np.asarray((np.conj(a) * b).real)


def cross(a: Places | complex, b: Places | complex) -> Array:
    return np.asarray((np.conj(a) * b).imag)


@pytest.mark.parametrize("seed", range(40))
def test_closing_in_is_that_of_straight_lines(seed: int) -> None:
    _, place, velocity, traffic, within_s = scene(seed)
    apart, closing = traffic.place - place, velocity - traffic.velocity
    square, towards = np.abs(closing) ** 2, dot(apart, closing)
    nearest_m = np.abs(apart - closing * np.minimum(towards / square, within_s))
    too_near = (within_s > 0.0) & (nearest_m < np.minimum(traffic.keep_m, PARTING * np.abs(apart)))
    expected = bool(((square >= SLIGHTEST_MPS**2) & (towards > 0.0) & too_near).any())
    assert closes_in(place, velocity, traffic, within_s) == expected


@pytest.mark.parametrize("seed", range(40))
def test_of_two_that_cross_one_gives_way_and_the_other_counts_on_it(seed: int) -> None:
    """By angles: a robot on whose starboard bow the other crosses gives way, head on both do, and whoever overtakes."""
    _, place, velocity, traffic, _ = scene(seed)
    within_s, keep_m = np.empty((2, 7))
    agility = AGILITY._replace(look_ahead_s=LOOK_AHEAD_S)
    set_horizons(place, velocity, agility, traffic, within_s, keep_m)
    away = traffic.place - place
    bearing, course = np.angle(away / velocity), np.angle(traffic.velocity / velocity)
    seen_at = np.angle(-away / traffic.velocity)  # by the other
    abaft = np.arccos(ABAFT)
    overtakes_us = (np.abs(bearing) > abaft) & (np.abs(course) < np.pi / 2.0)
    head_on, overtaken = np.abs(course) > np.arccos(HEAD_ON), np.abs(seen_at) > abaft
    from_port = (course > 0.0) & ~head_on & ~overtaken
    expected = np.where(overtakes_us, 0.0, np.where(from_port, STANDS_ON, 1.0))
    expected = LOOK_AHEAD_S * np.where(traffic.yields, expected, 1.0) * (traffic.keep_m > 0.0)
    assert within_s == pytest.approx(expected)
    stands_on = traffic.yields & from_port & ~overtakes_us
    assert keep_m == pytest.approx(traffic.keep_m - STANDS_ON * agility.room_m * stands_on)


def homing(goal: complex, speed: complex, point: complex) -> complex:
    """At most as fast as half the greatest change can still stop."""
    back, braking = AGILITY.return_per_s * (goal - point), np.sqrt(AGILITY.change_mps2 * abs(goal - point))
    limit = min(max(CATCH_UP * abs(speed), AGILITY.catch_up_mps), braking)
    velocity = speed + back * min(1.0, limit / max(abs(back), limit))
    return complex(velocity * min(1.0, AGILITY.fastest_mps / max(abs(velocity), AGILITY.fastest_mps)))


@pytest.mark.parametrize("seed", SEEDS)
def test_the_way_back_is_that_of_a_point_that_homes(seed: int) -> None:
    random, point, velocity, *_ = scene(seed)
    eta, rate = 0.02 * random.normal(size=(2, len(TIMES_S), 4)).cumsum(axis=1)
    way, going, ahead = eta.copy(), rate.copy(), np.empty(16, complex)
    path_back(point, velocity, AGILITY, TIMES_S, way, going)
    look_ahead(eta, rate, TIMES_S, point, AGILITY, ahead)
    at, moving = point, velocity
    for k, step_s in enumerate(np.diff(TIMES_S)):
        assert way[k, 0] + 1j * way[k, 1] == pytest.approx(at, abs=1e-9)
        assert going[k, 0] + 1j * going[k, 1] == pytest.approx(moving, abs=1e-9)
        change = homing(complex(*eta[k, :2]), complex(*rate[k, :2]), at) - moving
        moving += change * min(1.0, AGILITY.change_mps2 * step_s / abs(change))
        at += moving * step_s
    beyond_s, at, before = np.maximum(LOOKS_S - TIMES_S[-1], 0.0), point, complex(*eta[0, :2])
    goals = [np.interp(LOOKS_S, TIMES_S, eta[:, c]) + beyond_s * rate[-1, c] for c in (0, 1)]
    for k, goal in enumerate(goals[0] + 1j * goals[1]):
        at += WAY_STEP_S * homing(before, (goal - before) / WAY_STEP_S, at)
        before = goal
        assert ahead[k] == pytest.approx(at - point, abs=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_way_out_changes_to_its_course_steadily(seed: int) -> None:
    random, point, velocity, *_ = scene(seed)
    course = velocity + places(random, 0.1, 1)[0]
    way, rate = np.zeros((2, len(TIMES_S), 4))
    path_out(point, velocity, course, AGILITY.change_mps2, TIMES_S, way, rate)
    change = course - velocity
    going = velocity + change * np.minimum(1.0, TIMES_S * AGILITY.change_mps2 / abs(change))
    at = point + np.append(0.0, np.cumsum(going[1:] * np.diff(TIMES_S)))
    assert rate[:, :2] @ (1.0, 1j) == pytest.approx(going, abs=1e-9) and way[:, :2] @ (1.0, 1j) == pytest.approx(at, abs=1e-9)


@pytest.mark.parametrize("seed", range(40))
def test_the_velocity_chosen_is_the_cheapest_of_the_fan(seed: int) -> None:
    random, place, velocity, traffic, within_s = scene(seed)
    wanted, (there, going, keep_m, sided, way) = 0.1 + 0.02j, traffic
    pace = 0.08 * np.exp(1j * seed) if seed % 2 else 0.0
    ahead = np.asarray(wanted * LOOKS_S, np.complex128)
    room, islands, islands_keep_m = (1.0, 0.6), places(random, 1.0, 2), np.array([0.3, 0.2])
    meets = np.empty(7, bool)
    any_meets = find_meetings(place, ahead, traffic, within_s, meets)
    away = there - place
    keep = np.minimum(keep_m, PARTING * np.abs(away))
    passes = np.abs(away - ahead[:, None] + way.T) < keep
    passes &= np.arange(1, 17)[:, None] <= np.round(within_s / WAY_STEP_S)
    assert np.array_equal(meets, passes.any(axis=0)) and any_meets == meets.any()

    fan, counts = make_fan(), within_s > 0.0
    chosen = nearest_free(
        Motion(place, wanted, velocity, complex(pace)), traffic, within_s, sided, fan, Basin(*room, islands, islands_keep_m)
    )
    along = pace / max(abs(pace), 1e-12)
    ways, now = wanted * fan.turn, velocity - going
    ways = ways - np.maximum(dot(along, ways) - max(dot(along, wanted), abs(pace)), 0.0) * along
    closing = ways[:, None] - going
    side = np.where(cross(now, away) > WELL_CLEAR * keep * np.abs(now), 1.0, -1.0)
    wrong = sided & (cross(closing, away) * side < 0.0)
    towards = dot(away, closing)
    time_s = np.clip(towards / np.maximum(np.abs(closing) ** 2, 1e-12), 0.0, within_s)
    short = 1.0 - np.abs(away - closing * time_s) / np.maximum(keep, 1e-12)
    bad = np.where(wrong, 1.0, np.where(towards > 0.0, np.maximum(short, 0.0), 0.0))[:, counts].max(axis=1, initial=0.0)
    ahead_of_us = place + ways * WALL_S
    into = (np.abs(ahead_of_us.real) > max(room[0], abs(place.real))) | (
        np.abs(ahead_of_us.imag) > max(room[1], abs(place.imag))
    )
    for island, clear_m in zip(islands, islands_keep_m, strict=True):
        off = island - place
        at_s = np.clip((off * ways.conj()).real / np.maximum(np.abs(ways) ** 2, 1e-12), 0.0, WALL_S)
        into |= np.abs(off - ways * at_s) < min(clear_m, PARTING * abs(off))
    price = 100.0 * np.maximum(bad, into) + fan.price + 0.3 * np.abs(ways - velocity) / abs(wanted)
    assert chosen == pytest.approx(complex(ways[np.argmin(price)]), abs=1e-9)

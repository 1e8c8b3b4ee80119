"""Neighbours: formation pull, who yields, growing bubbles, half-spaces."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_agent.guidance.formation import MEANT_S, NEAREST, NOWHERE, WAY_STEP_S, Formation, HalfSpaces, Neighbour, Priority
from shoal.frames import Array
from shoal.messages.messages import Plan
from tests.robot_agent.guidance.expectations import CONFIG, NS, PERIOD_S, SAFETY, STEPS

EQUAL = Priority(False, 0.0)


def plan(
    start: tuple[float, float],
    velocity: tuple[float, float] = (0.0, 0.0),
    off: tuple[float, ...] = (0, 0, 0, 0),
    **rank: object,
) -> Plan:
    eta = np.zeros((STEPS, 4))
    eta[:, :2] = np.array(start) + PERIOD_S * np.arange(STEPS, dtype=np.float64)[:, None] * np.array(velocity)
    fields = {"tracking_error_m": 0.0, "urgent": False, **rank}
    return Plan(PERIOD_S, eta, eta - np.array(off), **fields)  # type: ignore[arg-type]


def at(x: float, y: float = 0.0, z: float = 0.0) -> Array:
    """Our pose (4,)."""
    return np.array([x, y, z, 0.0])


def neighbour(p: Plan, stamp_ns: int = 0, fresh: bool = True, robot: int = 2, hears_us: bool = True) -> Neighbour:
    return Neighbour(robot, stamp_ns, p, fresh, hears_us=hears_us)


def formation() -> Formation:
    return Formation(SAFETY, PERIOD_S * np.arange(STEPS, dtype=np.float64), CONFIG.q_formation, has_leader=False)


def test_pull_is_the_sum_of_weighted_deviations() -> None:
    """argmin of ||e||_Q^2 + sum ||e - dev_j||_Qij^2 is sum Qij dev_j / (Q + sum Qij): what the reference is moved by."""
    both = [neighbour(plan((1, 0), off=(0.1, 0.2, 0.3, 0.4))), neighbour(plan((2, 0), off=(-0.3, 0, 0, 0)), robot=3)]
    predictions = formation().predict_neighbours(both, 0)
    pull = formation().pull(predictions, np.full(4, 2.0))
    assert pull is not None and predictions.members == 2
    assert pull[0][10] == pytest.approx(0.15 * np.array([-0.2, 0.2, 0.3, 0.4]) / 2.3)
    assert pull[1] == pytest.approx(np.full(4, 2.3))


def test_a_leaders_deviation_is_followed_whole() -> None:
    led = Formation(SAFETY, PERIOD_S * np.arange(STEPS, dtype=np.float64), (1.0, 1.0, 1.0, 1.0), has_leader=True)
    pull = led.pull(led.predict_neighbours([neighbour(plan((1, 0), off=(0.1, 0.2, 0.3, 0.4)))], 0), np.full(4, 2.0))
    assert pull is not None and pull[1] == pytest.approx(np.full(4, 2.0))
    assert pull[0][10] == pytest.approx(np.array([0.1, 0.2, 0.3, 0.4]))


def test_plans_are_read_at_our_instants() -> None:
    predictions = formation().predict_neighbours([neighbour(plan((0, 0), (0.2, 0.1)), stamp_ns=0)], 7 * NS // 40)
    assert predictions.pose[0, 10, :2] == pytest.approx(np.array([0.2, 0.1]) * 0.675)  # node 10 of ours, 13.5 of theirs
    assert predictions.pose[0, -1, :2] == pytest.approx(np.array([0.2, 0.1]) * 2.5)  # the plan's end stands


def test_plans_with_steps_of_another_length_are_read_at_our_instants() -> None:
    slow = plan((0, 0), (0.2, 0.1), off=(0.1, 0, 0, 0))
    slow = dataclasses.replace(slow, period_s=0.08, eta=slow.eta[:40], eta_reference=slow.eta_reference[:40])
    predictions = formation().predict_neighbours([neighbour(slow), neighbour(plan((0, 0)))], NS // 10)
    assert predictions.pose[0, 10, :2] == pytest.approx(np.array([0.2, 0.1]) * 0.05 * 0.6 / 0.08)
    assert predictions.pose[0, -1, :2] == pytest.approx(np.array([0.2, 0.1]) * 0.05 * 2.6 / 0.08)
    assert predictions.deviation[:, 0] == pytest.approx(np.full(STEPS, 0.1))


def test_yaw_deviation_is_wrapped() -> None:
    predictions = formation().predict_neighbours([neighbour(plan((1, 0), off=(0, 0, 0, 6.2)))], 0)
    assert predictions.deviation[0, 3] == pytest.approx(6.2 - 2 * np.pi)


def test_a_silent_neighbour_leaves_the_formation_and_keeps_a_growing_bubble() -> None:
    silent = neighbour(plan((1, 0), off=(0.1, 0, 0, 0)), fresh=False)
    sizes = [formation().required_clearance_m(silent, EQUAL, s * NS) for s in (1, 3, 30, 58, 3600)]
    assert sizes == pytest.approx([0.7, 0.9, 1.1, 0.8, 0.6])  # 2R + 0.1 m/s, at most 0.5 m more, and 2R again after a minute
    predictions = formation().predict_neighbours([silent], NS)
    assert formation().pull(predictions, np.ones(4)) is None and predictions.neighbours == [silent]


@pytest.mark.parametrize(
    ("high", "low"),
    [
        (Priority(True, 1.0), Priority(False, 0.0)),
        (Priority(False, 0.1), Priority(False, 0.2)),
    ],
)
def test_order_of_ranks_decides_who_yields(high: Priority, low: Priority) -> None:
    assert high.goes_before(low) and not low.goes_before(high) and not high.goes_before(high)


@pytest.mark.parametrize("own", [Priority(True, 0.0), Priority(False, 0.0)])
def test_a_robot_that_does_not_hear_us_is_not_taken_to_yield(own: Priority) -> None:
    """It may hear others: a number of neighbours would not tell."""
    deaf = neighbour(plan((1, 0), tracking_error_m=9.0, heard=(3, 4)), hears_us=False)
    assert formation().required_clearance_m(deaf, own, 0) == pytest.approx(0.6)
    assert formation().required_clearance_m(deaf._replace(hears_us=True), own, 0) is None


@settings(max_examples=300)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.5), st.floats(0.0, 0.5))
def test_two_robots_are_never_both_above_one_another(seed: int, age_a_s: float, age_b_s: float) -> None:
    """However late each hears of the other: tracking errors change by 0.5 m/s at most."""
    random = np.random.default_rng(seed)
    step_s = 0.01
    errors = np.abs(np.cumsum(random.choice([-1.0, 1.0], (2, 100)) * 0.5 * step_s, axis=1) + random.uniform(0.0, 0.2, (2, 1)))

    def rank(robot: int, age_s: float) -> Priority:
        return Priority(False, float(errors[robot, 99 - int(age_s / step_s)]))

    a_first = rank(0, 0.0).goes_before(rank(1, age_b_s), age_b_s)
    b_first = rank(1, 0.0).goes_before(rank(0, age_a_s), age_a_s)
    assert not (a_first and b_first)


def test_the_higher_ignores_the_lower_which_yields_and_equals_both_act() -> None:
    here = neighbour(plan((1, 0), tracking_error_m=0.2))
    assert formation().required_clearance_m(here, Priority(False, 0.05), 0) is None
    assert formation().required_clearance_m(here, Priority(False, 0.5), 0) == pytest.approx(0.6)
    assert formation().required_clearance_m(here, Priority(False, 0.2), 0) == pytest.approx(0.6)


def test_silent_robot_has_no_robot_above_it() -> None:
    silent = neighbour(plan((1, 0), tracking_error_m=9.0), fresh=False)
    assert formation().required_clearance_m(silent, Priority(True, 0.0), 0) == pytest.approx(0.6)


def half_spaces(others: list[Neighbour], own: Array, rank: Priority = EQUAL, now_ns: int = 0) -> HalfSpaces:
    f = formation()
    return f.half_spaces(f.predict_neighbours(others, now_ns), own, rank, now_ns)


def test_half_spaces_only_when_it_gets_close() -> None:
    here = [neighbour(plan((0, 0)))]
    assert len(half_spaces(here, at(0.66)).node) == 0  # 2R + margin = 0.65
    assert len(half_spaces(here, at(0.64)).node) == 5


def test_half_spaces_of_a_silent_robot_come_sooner() -> None:
    silent = [neighbour(plan((0, 0)), fresh=False)]
    assert len(half_spaces(silent, at(1.0), now_ns=NS).node) == 0
    assert half_spaces(silent, at(1.0), now_ns=5 * NS).offset == pytest.approx(np.full(5, 1.1))


def test_robot_of_higher_priority_sees_no_half_spaces() -> None:
    here = [neighbour(plan((0, 0), tracking_error_m=0.2)), neighbour(plan((0.5, 1.0), tracking_error_m=0.0), robot=3)]
    rows = half_spaces(here, at(0.5, 0.5), Priority(False, 0.1))
    assert rows.offset == pytest.approx(np.full(5, -1.0 + 0.6)) and np.allclose(rows.normal, -1j)  # of the second one alone


def test_half_spaces_are_tangent_to_the_circle_between_the_two() -> None:
    rows = half_spaces([neighbour(plan((0.1, 0.2), (0.02, 0.0)))], at(0.4, 0.6))
    for node, normal, offset in zip(rows.node, rows.normal, rows.offset, strict=True):
        there = 0.1 + 0.02 * PERIOD_S * node + 0.2j
        line = 0.4 + 0.6j - there
        assert normal == pytest.approx(line / abs(line))
        assert offset == pytest.approx((normal * there.conjugate()).real + 0.6)


def test_a_robot_well_below_is_out_of_the_way() -> None:
    here = [neighbour(plan((0, 0)))]
    assert len(half_spaces(here, at(0.1, 0.0, 0.7)).node) == 0
    assert len(half_spaces(here, at(0.1, 0.0, 0.5)).node) == 5


def test_on_top_of_one_another_there_is_a_way_out() -> None:
    rows = half_spaces([neighbour(plan((0, 0)))], at(0.0))
    assert np.abs(rows.normal) == pytest.approx(np.ones(5))


def test_the_nearest_count_when_there_are_too_many() -> None:
    crowd = [neighbour(plan((0.3 + 0.05 * i, 0.0)), robot=i + 2) for i in range(6)]
    rows = half_spaces(crowd, at(0.0))
    assert len(rows.node) == 5 * NEAREST == formation().rows
    assert rows.offset.min() == pytest.approx(-0.45 + 0.6)  # of the fourth; the fifth and sixth are left out


@pytest.mark.parametrize("poison", [np.nan, np.inf])
def test_a_plan_with_nonsense_is_no_plan(poison: float) -> None:
    bad = plan((0, 0))
    bad.eta[3, 1] = poison
    good = neighbour(plan((1, 0), off=(0.1, 0, 0, 0)), robot=3)
    predictions = formation().predict_neighbours([neighbour(bad), neighbour(Plan(PERIOD_S)), good], 0)
    assert predictions.members == 1 and predictions.neighbours == [good]
    assert predictions.deviation[:, 0] == pytest.approx(np.full(STEPS, 0.1))


@pytest.mark.parametrize("laps", [300, 30_000])
def test_a_robot_that_has_flown_many_laps_is_still_there(laps: int) -> None:
    p = plan((0, 0), off=(0.1, 0.2, 0.3, 0.4))
    turned = np.array([0.0, 0.0, 0.0, 2.0 * np.pi * laps])
    later = dataclasses.replace(p, eta=p.eta + turned, eta_reference=p.eta_reference + turned)
    assert formation().predict_neighbours([neighbour(later)], 0).deviation == pytest.approx(
        formation().predict_neighbours([neighbour(p)], 0).deviation
    )
    assert len(half_spaces([neighbour(later)], at(0.64)).node) == 5


def test_where_each_is_now_and_means_to_go_read_from_each_plan_alone() -> None:
    """Plans of several lengths and ages, at once and by hand."""
    random = np.random.default_rng(5)
    others = []
    for robot, length in enumerate((3, 26, 51), 2):
        eta, reference = random.uniform(-1.0, 1.0, (2, length, 4))
        others.append(Neighbour(robot, int(random.integers(-3 * NS, NS // 2)), Plan(PERIOD_S, eta, reference), True))
    predictions = formation().predict_neighbours(others, NS // 2)
    for i, other in enumerate(others):
        last = len(other.plan.eta) - 1
        now = min(max(round((NS // 2 - other.stamp_ns) / NS / PERIOD_S), 0), last)
        then = min(now + round(MEANT_S / PERIOD_S), last)
        moved = other.plan.eta_reference[then] - other.plan.eta_reference[now]
        x, y, z, _ = other.plan.eta[now]
        assert predictions.place_now[i] == pytest.approx(complex(x, y)) and predictions.depth_now[i] == pytest.approx(z)
        assert predictions.intended_velocity[i] == pytest.approx(complex(moved[0], moved[1]) / (PERIOD_S * max(then - now, 1)))


def test_way_that_a_robot_means_to_go_is_its_planned_reference_and_then_straight_on() -> None:
    eta, time_s = np.zeros((51, 4)), PERIOD_S * np.arange(51, dtype=np.float64)
    eta[:, 0], eta[:, 1] = 0.2 * time_s, 0.03 * time_s**2
    way = formation().predict_neighbours([Neighbour(2, 0, Plan(PERIOD_S, eta + 0.1, eta), True)], NS // 2).intended_way[0]
    end_s = time_s[-1]
    for k, place in enumerate(way):
        at_s = 0.5 + WAY_STEP_S * (k + 1)
        beyond_m = 0.03 * (min(at_s, end_s) ** 2 + (2.0 * end_s - PERIOD_S) * max(at_s - end_s, 0.0))
        assert place == pytest.approx(complex(0.2 * (at_s - 0.5), beyond_m - 0.03 * 0.25), abs=1e-9)
    old = formation().predict_neighbours([Neighbour(2, 0, Plan(PERIOD_S, eta, eta), False)], 4 * NS).intended_way
    assert not old.any()


@pytest.mark.parametrize(("x_m", "leans"), [(0.7, False), (0.53, False), (0.51, True), (0.3, True)])
def test_a_plan_leans_against_a_half_space_that_it_is_close_to_or_in(x_m: float, leans: bool) -> None:
    eta = np.zeros((4, 4))
    eta[2, :2] = x_m, 9.0
    assert HalfSpaces(np.array([2]), np.array([1 + 0j]), np.array([0.5])).binds(eta) is leans
    assert not NOWHERE.binds(eta)

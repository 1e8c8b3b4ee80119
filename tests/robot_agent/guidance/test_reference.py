"""Goals sampled over the horizon, and the reference heading's rules."""

import numpy as np
import pytest

from robot_agent.control.heading import HOLD_RADPS, HeadingReference, headings
from robot_agent.guidance.reference import Follow, Hold, Reference, ReferenceSampler
from shoal.config.controller import GuidanceConfig
from shoal.config.vehicle import load_vehicle
from shoal.frames import Array
from shoal.messages.messages import Trajectory
from tests.robot_agent.paths import PERIOD_S, ROWS, circle

VEHICLE = load_vehicle("spherical")
OFFSETS = 0.05 + PERIOD_S * np.arange(51, dtype=np.float64)
REST = np.zeros(4)


def line(speed_mps: float, yaw_rad: float = 0.0) -> Reference:
    """A path's rows along a heading, at constant speed through the origin."""
    t = np.concatenate([[0.0], OFFSETS])
    direction = np.array([np.cos(yaw_rad), np.sin(yaw_rad)])
    eta, velocity = np.zeros((ROWS, 4)), np.zeros((ROWS, 4))
    eta[:, :2], eta[:, 3] = speed_mps * t[:, None] * direction, yaw_rad
    velocity[:, :2] = speed_mps * direction
    return Reference(eta, velocity, np.zeros((ROWS, 4)))


def guidance(sway: bool = True, **changes: float) -> HeadingReference:
    return HeadingReference(VEHICLE, GuidanceConfig().model_copy(update=changes), PERIOD_S, sway)


# --- sampling


@pytest.mark.parametrize("period_s", [0.05, 0.02, 0.13])
def test_samples_are_the_path_itself(period_s: float) -> None:
    rows = ReferenceSampler(OFFSETS).sample(Follow(circle(0.5, 20.0, period_s), 7.013))
    t = 7.013 + np.concatenate([[0.0], OFFSETS])
    angle = 2 * np.pi / 20.0 * t
    assert rows.eta[:, 0] == pytest.approx(0.5 * np.cos(angle), abs=2e-4)
    assert rows.velocity[:, 1] == pytest.approx(0.5 * np.pi / 10 * np.cos(angle), abs=1e-4)
    assert rows.eta[:, 3] == pytest.approx(angle + np.pi / 2, abs=1e-9)


def test_before_the_start_it_waits_at_the_first_pose() -> None:
    path = circle(0.5, 20.0)
    rows = ReferenceSampler(OFFSETS).sample(Follow(path, -1.0))
    assert np.array_equal(rows.eta[0], path.eta[0]) and not rows.velocity[:19].any()
    assert rows.velocity[-1].any()  # the horizon sees the start coming


def test_after_the_end_it_rests_at_the_last_pose() -> None:
    path = circle(0.5, 20.0)
    end_s = (len(path.eta) - 1) * PERIOD_S
    rows = ReferenceSampler(OFFSETS).sample(Follow(path, end_s - 1.0))
    assert rows.velocity[0].any()
    assert rows.eta[-1] == pytest.approx(path.eta[-1]) and not rows.velocity[-1].any() and not rows.acceleration[-1].any()
    late = ReferenceSampler(OFFSETS).sample(Follow(path, 1e6))
    assert np.ptp(late.eta, axis=0) == pytest.approx(np.zeros(4)) and not late.velocity.any()


def test_a_trajectory_of_one_sample_is_a_point() -> None:
    point = Trajectory("p", 0.05, np.array([[1.0, 2.0, 0.3, 0.4]]), np.zeros((1, 4)), np.zeros((1, 4)))
    assert ReferenceSampler(OFFSETS).sample(Follow(point, 3.0)).eta[-1] == pytest.approx([1.0, 2.0, 0.3, 0.4])


def test_another_trajectory_replaces_the_last_one() -> None:
    sampler = ReferenceSampler(OFFSETS)
    sampler.sample(Follow(circle(0.5, 20.0), 0.0))
    assert sampler.sample(Follow(circle(1.0, 20.0), 0.0)).eta[0, 0] == pytest.approx(1.0)


@pytest.mark.long
def test_time_moves_the_horizon_smoothly() -> None:
    """The same instant seen from two control steps is the same pose, yaw beyond half a turn included."""
    sampler, path = ReferenceSampler(OFFSETS), circle(0.5, 20.0)
    before = sampler.sample(Follow(path, 0.0)).eta[1:].copy()
    for k in range(1, 900):
        now = sampler.sample(Follow(path, k * PERIOD_S)).eta[1:]
        if k * PERIOD_S < 47.0:
            assert now[:-1] == pytest.approx(before[1:], abs=1e-9)
        before = now.copy()


# --- heading


def headings_along(
    g: HeadingReference, path: Reference, eta: Array, nu: Array, gamma: Array = REST, current: complex = 0j
) -> Array:
    command = path.eta.copy()
    g.turn_along(command, path, eta, nu, gamma, current)
    return command[:, 3]


def settled(
    g: HeadingReference, path: Reference, eta: Array, nu: Array, gamma: Array = REST, steps: int = 600, current: complex = 0j
) -> Array:
    out = np.zeros(ROWS)
    for _ in range(steps):
        out = headings_along(g, path, eta, nu, gamma, current)
    return out


@pytest.mark.parametrize("period_s", [0.1, 0.05, 0.02])
@pytest.mark.parametrize(
    ("speed_mps", "off_m", "time_constants"), [(0.4, 1.0, 1 / 1.6), (0.4, 0.002, 1 / 1.6), (0.01, 0.002, 3.0)]
)
def test_feedback_comes_in_time_at_every_rate_and_slight_feedback_on_a_slow_path_later(
    period_s: float, speed_mps: float, off_m: float, time_constants: float
) -> None:
    """Feedback after one of its time constants: 63 % of what it comes to."""
    filter_s = 2.0
    g = HeadingReference(VEHICLE, GuidanceConfig().model_copy(update={"filter_s": filter_s}), period_s, sway=True)
    settled(g, line(speed_mps), REST, np.array([speed_mps, 0, 0, 0]), steps=1)  # the first call of all takes it at once
    eta, nu = np.array([0, -off_m, 0, 0]), np.array([speed_mps, 0, 0, 0])
    steps = round(time_constants * filter_s / period_s)
    after, at_last = (np.tan(settled(g, line(speed_mps), eta, nu, steps=n)[0]) for n in (steps, 20 * steps))
    assert after / at_last == pytest.approx(1.0 - np.exp(-1.0), abs=0.08)


@pytest.mark.parametrize("current", [0.05j, -0.03 + 0.06j, 0.08 - 0.02j])
def test_in_a_current_it_points_where_thrust_alone_keeps_the_robot_on_its_line(current: complex) -> None:
    """Through the water the robot runs straight, without crab: its heading is that of its velocity through the water."""
    headings = settled(guidance(), line(0.2), REST, np.array([0.2, 0, 0, 0]), current=current)
    assert headings == pytest.approx(np.full(ROWS, np.angle(0.2 - current)), abs=1e-3)


def test_in_a_current_it_turns_ahead_of_the_bend() -> None:
    """A circle in a current, node by node against the force balance of the plant's equations."""
    path = ReferenceSampler(OFFSETS).sample(Follow(circle(0.5, 20.0), 3.0))
    current = 0.04 + 0.05j
    headings = settled(guidance(), path, path.eta[0], np.array([np.pi * 0.05, 0, 0, 0]), current=current)
    velocity = path.velocity[:, 0] + 1j * path.velocity[:, 1] - current
    drag = VEHICLE.drag.linear[1] + VEHICLE.drag.quadratic[1] * np.abs(velocity)
    force = VEHICLE.mass.sway_kg * (path.acceleration[:, 0] + 1j * path.acceleration[:, 1]) + drag * velocity
    assert np.exp(1j * headings) == pytest.approx(force / np.abs(force), abs=0.02)


def test_holding_station_in_a_current_it_turns_into_it() -> None:
    g, path = guidance(), ReferenceSampler(OFFSETS).sample(Hold(REST))
    for _ in range(400):
        out = g.heading_on_hold(path, REST, REST, REST, 0.05j)
    assert abs(np.sin(out[0])) == pytest.approx(1.0, abs=0.01)  # ahead or astern


def test_on_a_straight_path_it_is_the_tangent() -> None:
    path = line(0.2, 0.7)
    assert settled(guidance(), path, np.array([0, 0, 0, 0.7]), np.array([0.2, 0, 0, 0])) == pytest.approx(np.full(ROWS, 0.7))


def test_on_a_circle_it_holds_the_crab_angle_of_the_plant() -> None:
    """Steady turn: m u r = d(V) v, so tan b = m r / d(V) with the nose turned inwards. At 0.014 m/s that is 0.25 rad."""
    speed, rate = 0.225 * 0.02 * np.pi, 0.02 * np.pi
    path = ReferenceSampler(OFFSETS).sample(Follow(circle(0.225, 100.0), 10.0))
    crab = np.arctan(12.0 * rate / (3.0 + 20.0 * speed))
    yaw = path.eta[0, 3] + crab
    eta = np.array([*path.eta[0, :3], yaw])
    nu = np.array([speed * np.cos(crab), -speed * np.sin(crab), 0, rate])
    heading = settled(guidance(), path, eta, nu)
    assert heading - path.eta[:, 3] == pytest.approx(np.full(ROWS, crab), abs=1e-3)
    assert 0.2 < crab < 0.25


@pytest.mark.parametrize(("x_m", "y_m"), [(0.09, 0.12), (0.12, -0.09), (-0.12, 0.09), (-0.09, -0.12)])
def test_at_the_start_it_is_at_once_the_line_of_the_needed_force(x_m: float, y_m: float) -> None:
    """Ahead or astern of a robot 0.15 m off. Filtered from nothing on, it was aside of that line by 1.3 rad at first."""
    speed_mps = 0.014
    config = GuidanceConfig()
    heading = headings_along(guidance(), line(speed_mps), np.array([x_m, y_m, 0, 0]), np.array([speed_mps, 0, 0, 0]))[0]
    drag = VEHICLE.drag.linear[1] + VEHICLE.drag.quadratic[1] * speed_mps
    force = drag * speed_mps - config.position_gain_per_s2 * VEHICLE.mass.surge_kg * (x_m + 1j * y_m)
    assert np.sin(heading - np.angle(force)) == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize("offset", [-0.05, 0.05])
def test_off_the_path_it_turns_towards_it(offset: float) -> None:
    heading = settled(guidance(), line(0.014), np.array([0, offset, 0, 0]), np.array([0.014, 0, 0, 0]))
    assert np.all(heading * -offset > 0.01) and np.all(np.abs(heading) <= 1.2 + 1e-9)


def test_a_side_force_is_leant_into() -> None:
    """Thrust's side part balances Gamma: F sin b = m gamma with F cos b = drag."""
    gamma = np.array([0.0, 0.002, 0.0, 0.0])
    heading = settled(guidance(), line(0.05), REST, np.array([0.05, 0, 0, 0]), gamma)
    drag = (3.0 + 20.0 * 0.05) * 0.05
    assert heading[0] == pytest.approx(-np.arctan(12 * 0.002 / drag), abs=1e-3)


def test_a_surge_disturbance_turns_nothing() -> None:
    gamma = np.array([0.02, 0.0, 0.0, 0.0])
    heading = settled(guidance(), line(0.014), REST, np.array([0.014, 0, 0, 0]), gamma)
    assert heading == pytest.approx(np.zeros(ROWS))


def test_ahead_of_the_path_it_backs_up_instead_of_turning_round() -> None:
    eta = np.array([0.3, 0.05, 0, 0.0])
    heading = settled(guidance(), line(0.014), eta, np.array([0.014, 0, 0, 0]))
    assert np.abs(heading).max() <= 1.2 + 1e-9
    assert heading[0] > 0.0  # astern: nose to the side it is on, tail to the path


def test_no_force_keeps_the_tangent() -> None:
    """Standing still on a resting path with a millimetre of noise: no turn worth the name."""
    random, g = np.random.default_rng(1), guidance()
    headings = [
        headings_along(
            g,
            line(0.0, 0.4),
            np.array([*random.normal(0, 0.001, 2), 0, 0.4]),
            np.array([*random.normal(0, 0.002, 2), 0, 0]),
            REST,
        )[0]
        for _ in range(400)
    ]
    assert np.abs(np.array(headings) - 0.4).max() < 0.5 and np.std(headings) < 0.2


def test_heading_never_jumps() -> None:
    """A robot carried around its reference in every direction, thrust reversals included: at most 0.15 rad a step."""
    g, before = guidance(), None
    for k in range(3000):
        angle = 0.004 * k
        eta = np.array([0.2 * np.cos(angle), 0.2 * np.sin(angle), 0, 0.0])
        heading = headings_along(g, line(0.014), eta, np.array([0.014, 0, 0, 0]), REST)
        assert before is None or abs(heading[0] - before) < 0.15
        before = float(heading[0])


def test_without_sway_in_the_model_it_points_where_it_should_go() -> None:
    path = ReferenceSampler(OFFSETS).sample(Follow(circle(0.5, 20.0), 3.0))
    eta = np.array([*path.eta[0, :3], path.eta[0, 3]])
    assert settled(guidance(sway=False), path, eta, np.array([0.157, 0, 0, 0.31])) == pytest.approx(path.eta[:, 3])
    aside = path.eta[0, 3] + np.pi / 2
    beside = eta + np.array([0.05 * np.cos(aside), 0.05 * np.sin(aside), 0, 0])
    assert settled(guidance(sway=False), path, beside, np.array([0.157, 0, 0, 0.31]))[0] < path.eta[0, 3]


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("sway", [True, False])
def test_headings_are_those_of_the_force_in_vectors(seed: int, sway: bool) -> None:
    """The same in NumPy, over all rows at once."""
    random = np.random.default_rng(seed)
    eta, velocity, acceleration = 0.1 * random.normal(size=(3, ROWS, 4))
    current, feedback = 0.03 - 0.05j, complex(*(0.3 * random.normal(size=2)))
    mass, linear, quadratic, worth, limit, keep, jump = 12.0, 3.0, 20.0, 0.02, 1.2, 0.9, 0.1
    turned = eta.copy()
    ahead, rest = headings(
        turned, velocity, acceleration, current, sway, mass, linear, quadratic, feedback, worth, limit, keep, 1.0, jump
    )
    through, back = velocity @ (1.0, 1j, 0.0, 0.0) - (current if sway else 0.0), np.exp(-1j * eta[:, 3])
    needed = mass * (acceleration @ (1.0, 1j, 0.0, 0.0)) + (linear + quadratic * np.abs(through)) * through
    own = back * needed if sway else (back * through).real + 0j
    force = feedback + own

    def angle(direction: float) -> Array:
        tangent = direction * force.imag / np.maximum(direction * force.real, worth)
        return np.asarray(np.clip(np.arctan(tangent), -limit, limit))

    direction = -1.0 if force[0].real < -worth else 1.0
    jump = keep * (jump + float(angle(1.0)[0] - angle(direction)[0]))
    assert ahead == direction and rest == pytest.approx(jump, abs=1e-9)
    assert turned[:, 3] == pytest.approx(angle(direction) + eta[:, 3] + jump, abs=1e-9)
    assert np.array_equal(turned[:, :3], eta[:, :3])


@pytest.mark.parametrize(("speed_mps", "quicker"), [(0.01, 1.0), (0.06, 1.3), (0.4, 1.6)])
def test_a_fast_robot_feeds_back_more_quickly(speed_mps: float, quicker: float) -> None:
    """Force aside for 1 cm and 1 mm/s off the path, from the thrust along the heading."""
    config, drag, mass = GuidanceConfig(), VEHICLE.drag, VEHICLE.mass.surge_kg
    beside, slips = np.array([0.0, -0.01, 0.0, 0.0]), np.array([speed_mps, -0.001, 0.0, 0.0])
    own = (drag.linear[1] + drag.quadratic[1] * speed_mps) * speed_mps
    asked = mass * (0.01 * config.position_gain_per_s2 * quicker**2 + 0.001 * config.velocity_gain_per_s * quicker)
    ahead = max(own, config.turning_force_n)
    assert np.tan(settled(guidance(), line(speed_mps), beside, slips)) * ahead == pytest.approx(asked, rel=0.01)


# --- station keeping


def at_rest(point: Array) -> Reference:
    return Reference(np.tile(point, (ROWS, 1)), np.zeros((ROWS, 4)), np.zeros((ROWS, 4)))


def test_hold_keeps_the_heading_while_near() -> None:
    g = guidance()
    for _ in range(400):
        heading = g.heading_on_hold(at_rest(np.array([0, 0, 0.3, 2.0])), np.array([0.02, 0.02, 0.3, 1.1]), REST, REST)
    assert heading == pytest.approx(np.full(ROWS, 1.1))


@pytest.mark.parametrize(("bearing", "line_rad"), [(0.8, 0.8), (2.5, 2.5 - np.pi), (-2.9, np.pi - 2.9)])
def test_hold_turns_to_the_line_either_way_round(bearing: float, line_rad: float) -> None:
    """Far off, nose at 0: ahead to a point in front, astern to one behind; never more than a quarter turn."""
    g, eta = guidance(), np.array([0, 0, 0.3, 0.0])
    for _ in range(1500):
        heading = g.heading_on_hold(at_rest(np.array([0.3 * np.cos(bearing), 0.3 * np.sin(bearing), 0.3, 0])), eta, REST, REST)
    assert heading[0] == pytest.approx(line_rad, abs=0.02)


def test_hold_turns_into_line_with_a_current_and_slowly() -> None:
    g, before, heading = guidance(), 0.0, np.zeros(1)
    for _ in range(1500):
        heading = g.heading_on_hold(at_rest(np.zeros(4)), np.zeros(4), REST, np.array([0.0, 0.01, 0.0, 0.0]))
        assert abs(heading[0] - before) <= HOLD_RADPS * PERIOD_S + 1e-12
        before = float(heading[0])
    assert abs(heading[0]) == pytest.approx(np.pi / 2, abs=0.02)


def test_hold_samples_the_point() -> None:
    rows = ReferenceSampler(OFFSETS).sample(Hold(np.array([1.0, 2.0, 0.3, 0.4])))
    assert np.array_equal(rows.eta, np.tile([1.0, 2.0, 0.3, 0.4], (ROWS, 1))) and not rows.velocity.any()

"""Paths against brute force: arc length by summing a million chords, derivatives by finite differences, circle closed form."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline

from groundstation.planning.paths import CirclePath, PathState, SplinePath
from groundstation.planning.straight_sides import make_path
from shoal.config.scene import Circle, Waypoints
from shoal.frames import Array

# The article's waypoints with their signs put back (ambiguity A9); the clock starts at the third, the origin.
X = (-4.0, -2.0, 0.0, 2.0, 4.0, 6.0, 10.0, 12.0, 15.0, 18.0)
Y = (1.2, 0.6, 0.0, 1.5, 3.8, 5.0, 3.0, 2.0, 2.0, 1.0)
ARTICLE = Waypoints(kind="waypoints", points_m=tuple(zip(X, Y, strict=True)), speed_mps=0.3, start_index=2, dive_mps=0.05)


def central(values: Array, step_s: float) -> Array:
    """Derivative of samples by central differences, shape (n - 2, ...)."""
    return np.asarray((values[2:] - values[:-2]) / (2.0 * step_s))


def assert_derivatives(state: PathState, step_s: float) -> None:
    """Every derivative a path states is the finite difference of what it differentiates."""
    inner = slice(1, -1)
    np.testing.assert_allclose(central(state.position_m, step_s), state.velocity_mps[inner], atol=2e-6)
    np.testing.assert_allclose(central(state.velocity_mps, step_s), state.acceleration_mps2[inner], atol=5e-5)
    np.testing.assert_allclose(central(state.yaw_rad, step_s), state.yaw_rate_radps[inner], atol=2e-5)


def test_waypoints_are_passed_in_order() -> None:
    path = SplinePath(ARTICLE)
    time_s = np.linspace(0.0, path.end_s, 200_001)
    positions = path.at(time_s).position_m
    passed = [int(np.argmin(np.hypot(positions[:, 0] - x, positions[:, 1] - y))) for x, y in zip(X[2:], Y[2:], strict=True)]
    assert passed == sorted(passed)
    for index, x, y in zip(passed, X[2:], Y[2:], strict=True):
        assert np.hypot(positions[index, 0] - x, positions[index, 1] - y) < 1e-4


def test_clock_starts_at_the_chosen_waypoint() -> None:
    np.testing.assert_allclose(SplinePath(ARTICLE).at(np.array([0.0])).position_m[0], [0.0, 0.0, 0.0], atol=1e-12)


def test_arc_length_is_that_of_a_million_chords() -> None:
    knots = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(X), np.diff(Y)))])
    curve = CubicSpline(knots, np.column_stack([X, Y]), bc_type="natural")
    fine = curve(np.linspace(0.0, knots[-1], 1_000_001))
    brute_m = float(np.sum(np.hypot(*np.diff(fine, axis=0).T)))
    assert SplinePath(ARTICLE).length_m == pytest.approx(brute_m, abs=1e-8)


def test_distance_flown_is_speed_times_time_everywhere() -> None:
    """The very point of A8: over chord length the speed would vary by up to 21 %."""
    path = SplinePath(ARTICLE)
    time_s = np.linspace(0.0, path.end_s, 400_001)
    positions = path.at(time_s).position_m
    flown_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(positions[:, :2], axis=0).T))])
    np.testing.assert_allclose(flown_m, 0.3 * time_s, atol=1e-7)


def test_spline_derivatives_by_finite_differences() -> None:
    step_s = 1e-3
    state = SplinePath(ARTICLE).at(np.arange(0.5, 60.0, step_s))
    assert_derivatives(state, step_s)
    # the third derivative jumps at waypoints, and there the difference quotient sees both sides
    rate = central(state.yaw_rate_radps, step_s) - state.yaw_acceleration_radps2[1:-1]
    assert np.quantile(np.abs(rate), 0.999) < 1e-5


def test_speed_is_constant_and_dive_is_too() -> None:
    state = SplinePath(ARTICLE).at(np.linspace(0.0, 60.0, 997))
    np.testing.assert_allclose(np.hypot(state.velocity_mps[:, 0], state.velocity_mps[:, 1]), 0.3, rtol=1e-12)
    np.testing.assert_allclose(state.position_m[:, 2], 0.05 * np.linspace(0.0, 60.0, 997))
    np.testing.assert_allclose(np.tan(state.climb_rad), 0.05 / 0.3)


def test_beyond_the_end_the_path_goes_straight_on() -> None:
    path = SplinePath(ARTICLE)
    step_s = 0.01
    state = path.at(path.end_s + np.arange(-2.0, 2.0, step_s))
    assert_derivatives(state, step_s / 1.0)
    last = path.at(np.array([path.end_s, path.end_s + 5.0]))
    assert np.hypot(*(last.position_m[1] - last.position_m[0])[:2]) == pytest.approx(1.5)
    assert last.yaw_rate_radps[1] == 0.0
    assert last.yaw_rad[1] == pytest.approx(last.yaw_rad[0])


def test_yaw_is_unwrapped_whatever_instants_are_asked_for() -> None:
    angle = np.linspace(0.0, 6.0 * np.pi, 60)  # three laps
    points = tuple((float(x), float(y)) for x, y in zip(np.cos(angle), np.sin(angle), strict=True))
    path = SplinePath(Waypoints(kind="waypoints", points_m=points, speed_mps=0.1))
    ends = path.at(np.array([0.0, path.end_s]))
    assert ends.yaw_rad[1] - ends.yaw_rad[0] == pytest.approx(6.0 * np.pi, abs=0.25)  # its natural ends are straight


@given(st.lists(st.tuples(st.floats(-5, 5), st.floats(-5, 5)), min_size=2, max_size=8), st.floats(0.0, 1.0))
@settings(max_examples=60, deadline=None)
def test_arc_length_inverts_for_any_waypoints(points: list[tuple[float, float]], fraction: float) -> None:
    gaps = [np.hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(points)]
    try:
        path = SplinePath(Waypoints(kind="waypoints", points_m=tuple(points), speed_mps=0.3))
    except ValueError:
        return  # no path: refused, see below
    wanted_m = fraction * path.length_m
    knots = np.concatenate([[0.0], np.cumsum(gaps)])
    curve = CubicSpline(knots, np.array(points), bc_type="natural")
    fine = curve(np.linspace(0.0, float(path.chord_parameter(np.array([wanted_m]))[0]), 100_001))
    assert float(np.sum(np.hypot(*np.diff(fine, axis=0).T))) == pytest.approx(wanted_m, abs=1e-5)


def test_circle_closed_form() -> None:
    path = make_path(Circle(kind="circle", diameter_m=0.45, lap_s=100.0, depth_m=0.3))
    assert isinstance(path, CirclePath)
    state = path.at(np.array([0.0, 25.0, 50.0, 100.0]))
    np.testing.assert_allclose(
        state.position_m, [[0.225, 0, 0.3], [0, 0.225, 0.3], [-0.225, 0, 0.3], [0.225, 0, 0.3]], atol=1e-15
    )
    np.testing.assert_allclose(state.yaw_rad, np.pi * np.array([0.5, 1.0, 1.5, 2.5]))
    speed = 2.0 * np.pi / 100.0 * 0.225
    np.testing.assert_allclose(np.hypot(*state.velocity_mps[:, :2].T), speed)
    np.testing.assert_allclose(np.hypot(*state.acceleration_mps2[:, :2].T), speed**2 / 0.225)


def test_circle_derivatives_by_finite_differences() -> None:
    path = CirclePath(Circle(kind="circle", diameter_m=1.7, lap_s=20.0, depth_m=0.2))
    state = path.at(np.arange(0.0, 20.0, 1e-3))
    assert_derivatives(state, 1e-3)
    ahead = np.column_stack([np.cos(state.yaw_rad), np.sin(state.yaw_rad)])
    np.testing.assert_allclose(ahead * 2.0 * np.pi / 20.0 * 0.85, state.velocity_mps[:, :2], atol=1e-12)


def test_doubled_waypoint_is_refused() -> None:
    with pytest.raises(ValueError, match="points 1 and 2 are the same place"):
        SplinePath(Waypoints(kind="waypoints", points_m=((0, 0), (1, 0), (1, 0), (2, 0)), speed_mps=0.1))


def test_start_beyond_the_path_is_refused() -> None:
    with pytest.raises(ValueError, match="allowed are 0 to 1"):
        SplinePath(Waypoints(kind="waypoints", points_m=((0, 0), (1, 0), (2, 0)), speed_mps=0.1, start_index=2))


def test_turning_on_the_spot_is_refused_with_the_place() -> None:
    with pytest.raises(ValueError, match=r"turns on the spot at \(0\.00, 0\."):
        SplinePath(Waypoints(kind="waypoints", points_m=((0, -2.5), (0, 0), (0, -1)), speed_mps=0.1))

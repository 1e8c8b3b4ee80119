"""Angles and frames, against the definitions: complex numbers turn vectors, the right-hand rule says which way."""

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from shoal.frames import Array, body_to_pool, pool_to_body, pose_error, wrap, wrap_angle

angles = st.floats(-1e6, 1e6)
yaws = st.floats(-10.0, 10.0)
vectors = arrays(np.float64, st.tuples(st.integers(1, 4), st.just(2)), elements=st.floats(-100, 100))
poses = arrays(np.float64, 4, elements=st.floats(-100, 100))

JUST_BELOW = math.nextafter(-math.pi, -4.0)


@given(angles)
@example(math.pi)
@example(-math.pi)
@example(JUST_BELOW)
@example(-JUST_BELOW)
@example(3 * math.pi)
def test_wrap_keeps_the_direction_and_stays_in_range(angle_rad: float) -> None:
    wrapped = wrap(angle_rad)
    assert -math.pi <= wrapped < math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle_rad), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle_rad), abs=1e-9)


@given(angles)
@example(JUST_BELOW)
def test_wrapping_twice_changes_nothing(angle_rad: float) -> None:
    assert wrap(wrap(angle_rad)) == wrap(angle_rad)


@given(st.floats(-math.pi, math.pi, exclude_max=True))
def test_an_angle_in_range_is_not_touched(angle_rad: float) -> None:
    assert wrap(angle_rad) == angle_rad


@given(arrays(np.float64, st.tuples(st.integers(0, 3), st.integers(0, 3)), elements=angles))
def test_one_angle_and_many_agree_to_the_last_bit(angles_rad: Array) -> None:
    wrapped = wrap_angle(angles_rad)
    assert wrapped.shape == angles_rad.shape
    assert wrapped.ravel().tolist() == [wrap(angle) for angle in angles_rad.ravel().tolist()]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_no_angle_stays_no_angle(value: float) -> None:
    assert math.isnan(wrap(value))
    with np.errstate(invalid="ignore"):
        assert np.isnan(wrap_angle(value))


@given(vectors, yaws)
def test_turning_is_multiplication_by_a_complex_number(vector_body: Array, yaw_rad: float) -> None:
    turned = body_to_pool(vector_body, yaw_rad)
    expected = (vector_body[:, 0] + 1j * vector_body[:, 1]) * complex(math.cos(yaw_rad), math.sin(yaw_rad))
    np.testing.assert_allclose(turned, np.stack([expected.real, expected.imag], axis=-1), atol=1e-12)


@given(vectors, yaws)
def test_there_and_back(vector: Array, yaw_rad: float) -> None:
    np.testing.assert_allclose(pool_to_body(body_to_pool(vector, yaw_rad), yaw_rad), vector, atol=1e-12)
    np.testing.assert_allclose(body_to_pool(pool_to_body(vector, yaw_rad), yaw_rad), vector, atol=1e-12)


def test_each_vector_may_have_its_own_yaw() -> None:
    turned = body_to_pool(np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), np.array([0.0, math.pi / 2, math.pi / 2]))
    np.testing.assert_allclose(turned, [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]], atol=1e-15)


def test_heading_turns_from_x_to_y_about_the_axis_that_points_down() -> None:
    """Right-handed with z down: yaw is a turn about +z. The cross product is the referee."""
    yaw_rad = 0.3
    ahead = np.append(body_to_pool([1.0, 0.0], yaw_rad), 0.0)
    starboard = np.append(body_to_pool([0.0, 1.0], yaw_rad), 0.0)
    np.testing.assert_allclose(np.cross(ahead, starboard), [0.0, 0.0, 1.0], atol=1e-15)
    assert ahead[1] > 0.0


@given(poses, poses, st.integers(-5, 5))
def test_pose_error_is_the_short_way_round(eta: Array, reference: Array, turns: int) -> None:
    before = eta.copy()
    error = pose_error(eta, reference)
    np.testing.assert_array_equal(error[:3], eta[:3] - reference[:3])
    assert -math.pi <= error[3] < math.pi
    wound = pose_error(eta + np.array([0, 0, 0, 2 * math.pi * turns]), reference)
    assert math.cos(wound[3] - error[3]) == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_array_equal(eta, before)


def test_pose_error_across_the_seam() -> None:
    error = pose_error([[0, 0, 0, 3.1], [0, 0, 0, -3.1]], [[0, 0, 0, -3.1], [0, 0, 0, 3.1]])
    np.testing.assert_allclose(error[:, 3], [6.2 - 2 * math.pi, 2 * math.pi - 6.2], atol=1e-12)

"""Goals over the horizon are samples of the trajectory, of its first pose before it and of its last one after it."""

import numpy as np
import pytest

from robot_agent.guidance.reference import Follow, Hold, ReferenceSampler
from shoal.messages.messages import Trajectory
from tests.robot_agent.paths import PERIOD_S, ROWS, circle

OFFSETS = 0.05 + PERIOD_S * np.arange(51, dtype=np.float64)


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


def test_before_it_goes_on_in_the_middle_it_rests_there_and_sees_the_motion_coming() -> None:
    path = circle(0.5, 20.0)
    moving = ReferenceSampler(OFFSETS).sample(Follow(path, 7.0)).eta[0]
    rows = ReferenceSampler(OFFSETS).sample(Follow(path, 7.0, waits_s=1.5))
    rests = np.concatenate([[0.0], OFFSETS]) < 1.5
    assert np.array_equal(rows.eta[rests], np.tile(moving, (rests.sum(), 1)))
    assert not rows.velocity[rests].any() and not rows.acceleration[rests].any() and rows.velocity[~rests, 3].all()
    late = ReferenceSampler(OFFSETS).sample(Follow(path, 8.0)).eta[0].copy()
    assert ReferenceSampler(OFFSETS + 1.45).sample(Follow(path, 7.0, waits_s=1.5)).eta[21] == pytest.approx(late, abs=1e-9)


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


def test_hold_samples_the_point() -> None:
    rows = ReferenceSampler(OFFSETS).sample(Hold(np.array([1.0, 2.0, 0.3, 0.4])))
    assert np.array_equal(rows.eta, np.tile([1.0, 2.0, 0.3, 0.4], (ROWS, 1))) and not rows.velocity.any()

"""The constant-velocity filter against batch least squares and against its own covariance."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from localizer.tracking.kalman import GATE, initial_state, predict, stopped, update
from shoal.frames import wrap

NOISE = np.diag([4e-6, 9e-6, 1e-4])
NOISE[0, 1] = NOISE[1, 0] = 2e-6


def test_equals_weighted_least_squares() -> None:
    """Two measurements and the first speed's prior: the filter's answer is the least-squares one over all unknowns."""
    first, second, step = np.array([0.1, 0.2, 0.3]), np.array([0.13, 0.18, 0.36]), 0.1
    filtered, _ = update(predict(initial_state(first, NOISE), step), second, NOISE)

    start = initial_state(first, NOISE)
    moved = predict(start, step)
    still = np.eye(6)
    still[[0, 1, 2], [3, 4, 5]] = step
    process = moved.covariance - still @ start.covariance @ still.T
    # unknown: state before and acceleration over the step (3); the state after follows
    gain = np.vstack([np.eye(3) * step**2 / 2, np.eye(3) * step])
    acceleration = np.linalg.pinv(gain) @ process @ np.linalg.pinv(gain).T
    rows = np.zeros((12, 9))
    rows[:6, :6] = np.eye(6)
    rows[6:9, 6:] = np.eye(3)
    rows[9:, :6], rows[9:, 6:] = still[:3], gain[:3]
    values = np.concatenate([start.mean, np.zeros(3), second])
    weight = np.linalg.inv(np.block([
        [start.covariance, np.zeros((6, 6))],
        [np.zeros((3, 6)), acceleration, np.zeros((3, 3))],
        [np.zeros((3, 9)), NOISE],
    ]))  # fmt: skip
    normal = rows.T @ weight @ rows
    solution = np.linalg.solve(normal, rows.T @ weight @ values)
    to_after = np.hstack([still, gain])
    assert filtered.mean == pytest.approx(to_after @ solution, rel=1e-6, abs=1e-9)
    assert filtered.covariance == pytest.approx(to_after @ np.linalg.inv(normal) @ to_after.T, rel=1e-5, abs=1e-10)


def test_gate_lets_through_what_the_covariance_promises() -> None:
    random = np.random.default_rng(1)
    motion, _ = update(predict(initial_state(np.zeros(3), NOISE), 0.05), np.array([0.001, 0.0, 0.01]), NOISE)
    ahead = predict(motion, 0.05)
    spread = ahead.covariance[:3, :3] + NOISE
    samples = random.multivariate_normal(ahead.mean[:3], spread, 4000)
    distances = np.array([update(ahead, sample, NOISE)[1] for sample in samples])
    assert distances.mean() == pytest.approx(3.0, rel=0.05)  # chi-square with 3 degrees of freedom
    assert np.quantile(distances, 0.95) == pytest.approx(7.81, rel=0.05)
    assert distances.max() < GATE
    assert chi2.sf(GATE, 3) == pytest.approx(1.5e-5, rel=0.05)  # a wider gate lets misread markers through


@given(yaw=st.floats(-10, 10), turn=st.floats(-0.3, 0.3))
def test_heading_is_filtered_across_the_wrap(yaw: float, turn: float) -> None:
    motion = initial_state(np.array([0.0, 0.0, wrap(yaw)]), NOISE)
    measured = np.array([0.0, 0.0, wrap(yaw + turn)])
    after, squared = update(motion, measured, NOISE)
    assert squared == pytest.approx(turn**2 / (2.0 * NOISE[2, 2]), abs=1e-9)
    assert wrap(after.yaw_rad - yaw) == pytest.approx(turn / 2, abs=1e-9)
    assert -np.pi <= after.yaw_rad < np.pi


def test_follows_a_robot_that_turns_steadily() -> None:
    """0.3 m/s on a circle of 0.15 m: the hardest turn a robot can fly stays well inside the gate, and turns do not lag."""
    motion = initial_state(np.array([0.15, 0.0, np.pi / 2]), NOISE)
    for k in range(1, 60):
        angle = 2.0 * 0.05 * k
        motion = predict(motion, 0.05)
        pose = np.array([0.15 * np.cos(angle), 0.15 * np.sin(angle), wrap(angle + np.pi / 2)])
        ahead = motion.mean
        motion, squared = update(motion, pose, NOISE)
        if k > 20:
            assert np.linalg.norm(pose[:2] - ahead[:2]) < 4e-3
            assert abs(wrap(pose[2] - ahead[2])) < 0.01
            assert squared < GATE / 2


def test_uncertainty_grows_in_the_dark_and_stops_at_rest() -> None:
    motion, _ = update(predict(initial_state(np.zeros(3), NOISE), 0.05), np.zeros(3), NOISE)
    sigmas = []
    for _ in range(10):
        motion = predict(motion, 0.05)
        sigmas.append(motion.position_sigma_m)
    assert all(b > a for a, b in pairwise(sigmas))
    still = stopped(motion)
    assert still.mean[3:] == pytest.approx(0.0) and still.position_m == pytest.approx(motion.position_m)

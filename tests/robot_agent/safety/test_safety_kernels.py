"""Kernels of the checks against NumPy, on numbers drawn at random."""

import numpy as np
import pytest

from robot_agent.safety.likelihood_ratio import Knowledge, Sought, largest_evidence
from robot_agent.safety.output_check import LATELY_NS, LEAP_US, TOLERANCE_US, is_explained
from robot_agent.safety.sent_commands import CommandRows, follow_commands, follow_legs

NS = 1_000_000_000
STEP_NS = NS // 20


@pytest.mark.long
@pytest.mark.parametrize("seed", range(8))
def test_evidence_is_that_of_inverse_matrices(seed: int) -> None:
    random, k, n, least, most = np.random.default_rng(seed), 5, 23, 0.6, 2.0
    x, theta, weights = 0.1 * random.normal(size=(n, k)), 0.1 * random.normal(size=k), random.uniform(10.0, 1e4, n)
    root = 0.1 * random.normal(size=(k, k))
    covariance, y = root @ root.T + 0.01 * np.eye(k), random.normal(size=n) * 0.01
    begins, best = np.array([15, 8, 0]), -np.inf
    for begin in begins:
        rows, residual = x[begin:], (y - x @ theta)[begin:]
        s = np.diag(1.0 / weights[begin:]) + rows @ covariance @ rows.T
        for part in range(3):
            along, size = -rows[:, part] @ np.linalg.solve(s, residual), rows[:, part] @ np.linalg.solve(s, rows[:, part])
            share = np.clip(along / size, least, most)
            best = max(best, float(share * (along - 0.5 * share * size)))
    knowledge, sought = Knowledge(theta, covariance), Sought(3, least, most)
    evidence = largest_evidence(np.column_stack([x, y]), weights, begins, knowledge, sought)
    assert evidence == pytest.approx(best, rel=1e-7)


@pytest.mark.long
@pytest.mark.parametrize("lag_s", [0.0, 0.1])
@pytest.mark.parametrize("seed", range(4))
def test_moments_follow_their_commands_with_the_lag(seed: int, lag_s: float) -> None:
    """Against the exact response, a microsecond at a time."""
    random = np.random.default_rng(seed)
    acts_ns = np.sort(random.integers(-STEP_NS, 3 * STEP_NS, 5)) // 1000 * 1000
    moments, acting, impulse = random.normal(size=(5, 4)), random.normal(size=4), np.empty(4)
    expected, integral = acting.copy(), np.zeros(4)
    t_ns = np.arange(0, 2 * STEP_NS, 1000)
    which = np.searchsorted(acts_ns, t_ns, "right") - 1
    left = np.exp(-1e-6 / lag_s) if lag_s else 0.0
    for i in which:
        wanted = moments[i] if i >= 0 else np.zeros(4)
        after = wanted + (expected - wanted) * left
        integral += 1e-6 * wanted + lag_s * (expected - after)
        expected = after
    follow_commands(acts_ns, moments, 5, lag_s, 0, 2 * STEP_NS, acting, impulse)
    assert acting == pytest.approx(expected, abs=1e-9) and impulse == pytest.approx(integral, abs=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_legs_give_less_the_farther_their_ankles_are_turned_and_these_turn_at_their_rate(seed: int) -> None:
    """Against ankles and thrust in steps of 20 microseconds."""
    random, lag_s, rate_radps, fine_s = np.random.default_rng(seed), 0.1, 5.0, 2e-5
    thrust_ns, ankle_ns = np.sort(random.integers(-STEP_NS, 4 * STEP_NS, (2, 5)))
    level, turned = random.normal(size=(5, 4)), random.uniform(-1.0, 1.0, (5, 4))
    moment, angle, integral = random.normal(size=4), random.uniform(-1.0, 1.0, 4), np.zeros(4)
    work, impulse = np.zeros((4, 4)), np.empty(4)
    work[0], work[1] = moment, angle
    for t_ns in np.arange(0, 4 * STEP_NS, 20_000):
        i, j = np.searchsorted(thrust_ns, t_ns, "right") - 1, np.searchsorted(ankle_ns, t_ns, "right") - 1
        moment = moment + fine_s / lag_s * ((level[i] if i >= 0 else 0.0) - moment)
        angle = angle + np.clip((turned[j] if j >= 0 else 0.0) - angle, -rate_radps * fine_s, rate_radps * fine_s)
        integral += fine_s * moment * np.cos(angle)
    impulse_sum = np.zeros(4)
    for span_ns in ((0, STEP_NS), (STEP_NS, 4 * STEP_NS)):
        follow_legs(
            CommandRows(thrust_ns, level, 5), CommandRows(ankle_ns, turned, 5), lag_s, rate_radps, span_ns, work, impulse
        )
        impulse_sum += impulse
    assert impulse_sum == pytest.approx(integral, abs=1e-3) and work[1] == pytest.approx(angle, abs=1e-3)


@pytest.mark.parametrize("seed", range(60))
def test_an_echo_is_explained_by_the_commands_of_its_time(seed: int) -> None:
    random, count, arrival_ns = np.random.default_rng(seed), 20, 15 * STEP_NS
    sent_ns = STEP_NS * np.arange(count)
    told_us = 1500 + random.integers(-6, 7, (count, 8)).cumsum(axis=0)
    if seed % 3 == 0:
        told_us[12:, 1] += LEAP_US + 50
    echo_us = told_us[int(random.integers(4, 18))] + random.integers(-6, 7, 8)
    lately = told_us[max(np.flatnonzero(sent_ns <= arrival_ns - LATELY_NS)) : 16]
    groups = [lately] if seed % 3 == 0 else [lately[i : i + 2] for i in range(len(lately))]
    expected = any(
        ((group.min(axis=0) - TOLERANCE_US <= echo_us) & (echo_us <= group.max(axis=0) + TOLERANCE_US)).all()
        for group in groups
    )
    assert is_explained(echo_us, sent_ns, told_us, count, arrival_ns, 4) == expected

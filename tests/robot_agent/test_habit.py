"""What is learned, held against the numbers that the samples were made of, and against ordinary least squares."""

import math

import numpy as np

from robot_agent.habit import FADES_S, Habit
from robot_agent.unusual import YOUNG_NS
from wire.frames import Array

NS = 1_000_000_000
STEP_S = 0.05
SPREAD = (0.3, 0.3, 0.004)
NOISE = 0.001


def samples(theta: Array, seconds: float, seed: int) -> tuple[Array, Array]:
    """Causes (k, 3) that swing, and what comes of them with white noise."""
    random = np.random.default_rng(seed)
    t = STEP_S * np.arange(round(seconds / STEP_S))
    x = np.column_stack([0.05 * np.sin(0.9 * t + random.uniform(0.0, 6.0)), 0.02 * np.sin(0.4 * t), np.ones_like(t)])
    return x, x @ theta + NOISE * random.standard_normal(len(t))


def taught(theta: Array, seconds: float, seed: int = 1) -> Habit:
    habit = Habit(SPREAD, NOISE, NOISE / 10.0, STEP_S)
    for k, (x, y) in enumerate(zip(*samples(theta, seconds, seed), strict=True)):
        habit.note(x, y, STEP_S, round(k * STEP_S * NS))
    return habit


def test_it_learns_what_least_squares_over_all_samples_finds() -> None:
    theta = np.array([-0.25, 0.2, 0.003])
    x, y = samples(theta, 60.0, 1)
    fitted, *_ = np.linalg.lstsq(x, y, rcond=None)
    habit = taught(theta, 60.0)
    for cause in np.array([[0.05, 0.0, 1.0], [0.0, 0.02, 1.0], [-0.05, 0.01, 1.0]]):
        usual, doubt = habit.expect(cause)
        assert abs(usual - float(cause @ fitted)) < 0.1 * abs(float(cause @ fitted))
        assert abs(usual - float(cause @ theta)) < 3.0 * doubt < 5.0e-3


def test_it_is_never_surer_than_it_may_be() -> None:
    """Its doubt against its errors, over habits drawn from the prior, at first and later."""
    random, cause = np.random.default_rng(2), np.array([0.05, -0.01, 1.0])
    for seconds in (0.05, 2.0, 4.0, 20.0):
        shares = []
        for seed in range(200):
            theta = random.standard_normal(3) * SPREAD
            usual, doubt = taught(theta, seconds, seed).expect(cause)
            shares.append((usual - float(cause @ theta)) / doubt)
        assert 0.1 < math.sqrt(np.mean(np.square(shares))) < 1.1, seconds


def test_the_newest_second_does_not_count() -> None:
    theta, cause = np.array([0.1, 0.0, 0.0]), np.array([0.05, 0.0, 1.0])
    habit = taught(theta, 30.0)
    before = habit.expect(cause)
    x, _ = samples(theta, 30.0, 1)
    young = round(YOUNG_NS / NS / STEP_S) - 1
    last_ns = round((len(x) - 1) * STEP_S * NS)
    for k in range(1, young):
        habit.note(x[k], 1.0, STEP_S, last_ns + round(k * STEP_S * NS))
    assert abs(habit.expect(cause)[0] - before[0]) < 3.0e-4
    for k in range(young, young + 10):
        habit.note(x[k], 1.0, STEP_S, last_ns + round(k * STEP_S * NS))
    assert abs(habit.expect(cause)[0] - before[0]) > 5.0e-4


def test_what_is_not_seen_any_more_is_doubted_again() -> None:
    habit, cause = taught(np.array([0.1, 0.0, 0.0]), 60.0), np.array([0.05, 0.0, 0.0])
    known = habit.expect(cause)[1]
    for k in range(round(FADES_S / 0.05)):  # nothing moves
        habit.note(np.array([0.0, 0.0, 1.0]), 0.0, STEP_S, round((60.0 + k * STEP_S) * NS))
    doubt = habit.expect(cause)[1]
    assert 4.0 * known < doubt < 0.3 * 0.05
    assert doubt > 0.7 * 0.3 * 0.05


def test_rough_samples_teach_less() -> None:
    theta, cause = np.zeros(3), np.array([0.05, 0.0, 1.0])
    calm = taught(theta, 20.0)
    rough = Habit(SPREAD, NOISE, NOISE / 10.0, STEP_S)
    x, y = samples(theta, 20.0, 1)
    for k in range(len(x)):
        rough.note(x[k], 30.0 * float(y[k]), STEP_S, round(k * STEP_S * NS))
    assert rough.expect(cause)[1] > 3.0 * calm.expect(cause)[1]

"""The grid of control steps: its mean period, where poses come on it, and which steps are late."""

import itertools
from collections.abc import Iterable, Iterator

import numpy as np
import pytest

from robot_agent.host.step_clock import StepClock
from robot_agent.safety.modes import LATE_S

PERIOD_S = 0.05
LONG_S = 60.0


def steps(arrivals_s: Iterable[float], until_s: float = LONG_S) -> Iterator[tuple[float, float]]:
    """Instants of steps, and the age of the pose at each, for a loop that only waits for poses that come at these instants."""
    pace, coming, newest_s, taken_s = StepClock(PERIOD_S, 0.0), iter(arrivals_s), None, None
    next_s = next(coming, float("inf"))
    while True:
        due_s = pace.due_s(newest_s if newest_s != taken_s else None)
        if next_s <= due_s:
            newest_s, next_s = next_s, next(coming, float("inf"))
            continue
        now_s = max(due_s, newest_s or 0.0)  # what came before the step's place opened has been waiting
        if now_s > until_s:
            return
        pace.note_step(now_s, newest_s if newest_s != taken_s else None)
        pace.count_lateness(now_s - due_s)
        taken_s = newest_s
        yield now_s, now_s - (newest_s if newest_s is not None else float("nan"))
    assert pace.missed == 0


@pytest.mark.parametrize("phase_s", [0.0, 0.011, 0.024, 0.037])
@pytest.mark.parametrize("rate_hz", [7.0, 15.0, 19.98, 20.0, 30.0, 40.0, 60.0, 100.0])
def test_poses_at_any_rate_leave_the_mean_period_within_one_percent(rate_hz: float, phase_s: float) -> None:
    instants_s = np.array([now_s for now_s, _ in steps(phase_s + k / rate_hz for k in range(round(LONG_S * rate_hz) + 99))])
    periods_s = np.diff(instants_s)[4:]
    assert periods_s.mean() == pytest.approx(PERIOD_S, rel=0.01)
    assert np.diff(instants_s[::20]).max() == pytest.approx(20 * PERIOD_S, rel=0.06)  # nor does it hurry and rest in turn
    assert periods_s.min() > 0.5 * PERIOD_S and periods_s.max() < 1.6 * PERIOD_S


@pytest.mark.parametrize("rate_hz", [20.0, 40.0, 60.0])
def test_where_rates_match_poses_are_taken_as_they_come(rate_hz: float) -> None:
    step_times = list(steps((0.021 + k / rate_hz for k in range(6000)), 30.0))
    ages_s = np.array([age_s for now_s, age_s in step_times if now_s > 10.0])
    assert ages_s.max() < 0.001
    assert np.diff([now_s for now_s, _ in step_times])[200:] == pytest.approx(PERIOD_S, abs=0.001)


def test_poses_that_take_now_longer_now_shorter_are_still_taken_as_they_come() -> None:
    random = np.random.default_rng(1)
    arrivals_s = (0.03 + k * PERIOD_S + abs(random.normal(0.0, 0.003)) for k in itertools.count())
    ages_s = np.array([age_s for now_s, age_s in steps(arrivals_s, 30.0) if now_s > 10.0])
    assert np.percentile(ages_s, 99) < 0.001


def test_where_poses_have_stopped_the_loop_waits_once_and_then_keeps_its_period() -> None:
    """The robot is to hold then: it may not fly on at half its rate."""
    instants_s = np.array([now_s for now_s, _ in steps((0.021 + k * PERIOD_S for k in range(200)), 20.0)])
    assert np.diff(instants_s[instants_s > 5.0]).max() < 1.6 * PERIOD_S
    assert np.diff(instants_s[instants_s > 10.2]) == pytest.approx(PERIOD_S, abs=1e-6)


def test_without_any_pose_the_loop_goes_on_at_its_period() -> None:
    instants_s = [now_s for now_s, _ in steps(())]
    assert np.diff(instants_s) == pytest.approx(PERIOD_S)


def loop(takes_s: Iterable[float]) -> StepClock:
    """A loop whose steps take so long; there is a new pose whenever it looks."""
    pace, now_s = StepClock(PERIOD_S, 0.0), 0.0
    for took_s in takes_s:
        due_s = pace.due_s(0.0)
        now_s = max(now_s, due_s)
        pace.note_step(now_s, None)
        now_s += took_s
        pace.count_lateness(now_s - due_s)
        if pace.late_steps * PERIOD_S >= LATE_S:
            break
    return pace


@pytest.mark.parametrize(
    ("takes_s", "within"),
    [([0.15], 3), ([0.03], 3), ([0.07], 3), ([0.03, 0.03, 0.005], 7), ([0.2, 0.2, 0.2, 0.005], 5)],
    ids=["thrice the period", "over its budget", "over its period", "late two times of three", "late three times of four"],
)
def test_a_loop_that_cannot_keep_up_is_too_slow_soon(takes_s: list[float], within: int) -> None:
    pace = loop(itertools.islice(itertools.cycle(takes_s), 40))
    assert pace.late_steps * PERIOD_S >= LATE_S
    assert pace.missed <= within


@pytest.mark.parametrize("hiccup_s", [0.03, 0.06, 0.2, 1.0])
def test_a_hiccup_now_and_then_is_not_too_slow(hiccup_s: float) -> None:
    pace = loop([*([0.004] * 9), hiccup_s] * 20)
    assert (pace.missed > 0, pace.late_steps * PERIOD_S < LATE_S) == (True, True)


def test_a_loop_that_was_slow_for_a_minute_is_quick_again_within_a_second() -> None:
    """Before the robot flies nothing stops a slow loop; once it flies, only how it runs now may."""
    pace = StepClock(PERIOD_S, 0.0)
    for _ in range(1200):
        pace.count_lateness(0.1)
    assert pace.late_steps * PERIOD_S >= LATE_S
    for _ in range(20):
        pace.count_lateness(0.004)
    assert (pace.missed, pace.late_steps * PERIOD_S < LATE_S) == (1200, True)


def test_places_that_were_missed_are_left_out_and_the_grid_stays_where_it_was() -> None:
    pace = StepClock(PERIOD_S, 0.0)
    pace.note_step(0.0, None)
    pace.note_step(0.323, None)  # a step that was due at 0.05
    assert pace.due_s(0.0) == pytest.approx(0.35)

"""The virtual structure's pace: exactly on time while nobody lags, smooth when somebody does, and it recovers."""

import numpy as np
import pytest

from groundstation.mission.timetable import ProgressGovernor
from shoal.config.mission import MissionConfig
from shoal.frames import Array

PERIOD_S = 0.05


def driven(pace: ProgressGovernor, errors: Array) -> Array:
    rates = []
    for error in errors.tolist():
        pace.step(error, PERIOD_S)
        rates.append(pace.rate)
    return np.array(rates)


def test_on_time_is_exactly_on_time() -> None:
    pace = ProgressGovernor(MissionConfig(wait_from_m=0.2))
    assert set(driven(pace, np.full(200, 0.19)).tolist()) == {1.0}
    assert pace.lag_s == 0.0
    never = ProgressGovernor(MissionConfig())
    assert set(driven(never, np.full(200, 9.0)).tolist()) == {1.0}


def test_it_slows_smoothly_down_to_the_slowest_and_comes_back_to_exactly_one() -> None:
    pace = ProgressGovernor(MissionConfig(wait_from_m=0.1, wait_at_m=0.4, slowest=0.1))
    slow = driven(pace, np.full(200, 1.0))
    assert slow[-1] == pytest.approx(0.1, abs=1e-3) and slow.min() >= 0.1
    assert np.abs(np.diff(slow)).max() < 0.04  # 0.3 m/s then changes by 12 mm/s in a step at most
    assert np.abs(np.diff(slow, 2)).max() < 0.006
    assert pace.lag_s == pytest.approx(float(np.sum(1.0 - np.concatenate([[1.0], slow[:-1]])) * PERIOD_S))
    assert pace.slowed
    back = driven(pace, np.zeros(400))
    assert back[-1] == 1.0 and back.max() <= 1.0 and not pace.slowed
    lag_s = pace.lag_s
    driven(pace, np.zeros(50))
    assert pace.lag_s == lag_s  # what was lost stays lost: nobody hurries


def test_between_the_two_errors_the_pace_falls_in_proportion() -> None:
    pace = ProgressGovernor(MissionConfig(wait_from_m=0.1, wait_at_m=0.5, slowest=0.2))
    assert driven(pace, np.full(400, 0.3))[-1] == pytest.approx(0.6, abs=1e-3)


def test_a_start_is_on_time_again() -> None:
    pace = ProgressGovernor(MissionConfig(wait_from_m=0.1))
    driven(pace, np.full(50, 1.0))
    pace.reset()
    assert pace.rate == 1.0 and pace.lag_s > 0.0
    pace.start()
    assert pace.lag_s == 0.0


def test_after_a_stall_lag_and_rate_continue_without_a_leap() -> None:
    pace = ProgressGovernor(MissionConfig(wait_from_m=0.1, wait_at_m=0.4, slowest=0.1))
    driven(pace, np.full(200, 1.0))
    lag_s, rate = pace.lag_s, pace.rate
    pace.step(0.0, 0.5)
    assert pace.lag_s - lag_s == pytest.approx((1.0 - rate) * 0.5)  # robots counted on with 1 - rate for that long
    assert pace.rate - rate < 0.04
    lag_s, rate = pace.lag_s, pace.rate
    pace.step(0.0, 0.001)  # a cycle that comes early
    assert pace.lag_s - lag_s == pytest.approx((1.0 - rate) * 0.001)
    assert pace.rate - rate < 0.001


def test_lag_grows_until_waiting_for_robots_ends() -> None:
    pace = ProgressGovernor(MissionConfig(wait_from_m=0.1, wait_at_m=0.4, slowest=0.1))
    driven(pace, np.full(200, 1.0))
    lag_s, rate = pace.lag_s, pace.rate
    pace.step(None, PERIOD_S)
    assert pace.rate == 1.0
    assert pace.lag_s - lag_s == pytest.approx((1.0 - rate) * PERIOD_S)

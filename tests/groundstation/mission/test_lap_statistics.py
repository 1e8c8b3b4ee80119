"""The table of laps, against states whose errors are given."""

import numpy as np
import pytest

from groundstation.mission.lap_statistics import KEPT, FlownLaps, LapStatistics
from shoal.messages.messages import Control, Estimate, Mode, RobotState

LAP_S = 10.0
PATH = FlownLaps(LAP_S)


def note(laps: LapStatistics, trajectory_s: dict[int, float], error_m: float = 0.01, path: FlownLaps = PATH) -> None:
    """A step of robots that are so far along, all as far from their references."""
    away = np.array([error_m, 0.0, 0.0, 0.0])
    laps.update(
        {
            robot: RobotState(
                mode=Mode.TRACKING, tuning_id="a", trajectory_s=s, estimate=Estimate(eta=away), control=Control()
            )
            for robot, s in trajectory_s.items()
        },
        path,
    )


def test_a_hold_and_resume_from_the_slowest_keeps_the_laps() -> None:
    """One robot holds by itself; until the others do they come a little further, and go back by that when all resume."""
    laps = LapStatistics()
    for k in range(1, 301):
        note(laps, {1: 0.05 * k, 2: 0.05 * k}, 0.01 if k <= 200 else 0.02)
    for k in (301, 302, 303):
        note(laps, {1: 15.0, 2: 0.05 * k}, 0.02)
    for k in range(301, 381):
        note(laps, {1: 0.05 * k, 2: 0.05 * k}, 0.02)
    first, second = laps.laps()
    assert (first.number, second.number) == (1, 2)
    assert first.time_s == pytest.approx(LAP_S, abs=0.11)
    assert second.time_s == pytest.approx(9.0, abs=0.11)
    assert [first.rms_m, second.rms_m] == pytest.approx([0.01, 0.02], rel=0.02)


def test_another_run_begins_another_table() -> None:
    laps = LapStatistics()
    for k in range(1, 250):
        note(laps, {1: 0.05 * k})
    note(laps, {1: 0.05})
    (only,) = laps.laps()
    assert only.number == 1 and only.time_s < 0.1


def test_another_run_soon_after_begins_another_table() -> None:
    """The run before was over after 4 s: less than a robot goes back at a hold."""
    laps = LapStatistics()
    for k in range(1, 81):
        note(laps, {1: 0.05 * k}, 0.5)
    again = FlownLaps(LAP_S, flight=1)
    laps.update({}, again)
    assert laps.laps(), "until the next one is flown, its table stays"
    for k in range(1, 41):
        note(laps, {1: 0.05 * k}, 0.01, again)
    (only,) = laps.laps()
    assert only.time_s == pytest.approx(2.0, abs=0.11)
    assert only.rms_m == pytest.approx(0.01)


def test_a_robot_that_joins_late_makes_no_lap_shorter() -> None:
    """Robot 2 is away from 5 s to 15 s, over the end of the first lap; robot 3 joins at 18 s."""
    laps = LapStatistics()
    for k in range(1, 371):
        flying = {1: True, 2: not 100 < k < 300, 3: k >= 360}
        note(laps, {robot: 0.05 * k for robot, flies in flying.items() if flies})
    first, second = laps.laps()
    assert first.time_s == pytest.approx(LAP_S, abs=0.11)
    assert second.time_s == pytest.approx(8.5, abs=0.11)


def test_an_error_that_is_not_known_is_left_out_and_the_time_is_not() -> None:
    laps = LapStatistics()
    for k in range(1, 191):
        if k % 3:
            note(laps, {1: 0.05 * k}, 0.02)
        else:
            laps.update({1: RobotState(mode=Mode.TRACKING, tuning_id="a", trajectory_s=0.05 * k, control=Control())}, PATH)
    (lap,) = laps.laps()
    assert lap.rms_m == pytest.approx(0.02)
    assert lap.time_s == pytest.approx(9.45, abs=0.06)


def test_laps_of_another_path_are_counted_from_its_own_beginning() -> None:
    """A path without laps until 12 s, then one with laps of 4 s that begins at 15 s, after a transfer into place."""
    laps = LapStatistics()
    for k in range(1, 241):
        note(laps, {1: 0.05 * k}, path=FlownLaps(None))
    assert [lap.number for lap in laps.laps()] == [0]
    for k in range(241, 481):
        note(laps, {1: 0.05 * k}, path=FlownLaps(4.0, path_s=15.0, flight=1))
    assert [lap.number for lap in laps.laps()] == [1, 2, 3]
    assert [lap.time_s for lap in laps.laps()][1] == pytest.approx(4.0, abs=0.11)


def test_the_newest_laps_are_kept_and_another_flight_begins_anew() -> None:
    laps = LapStatistics()
    for k in range(1, 14 * 20):
        note(laps, {1: 0.5 * k}, 0.001 * (1 + int(0.05 * k)))
    assert [lap.number for lap in laps.laps()] == list(range(14 - KEPT + 1, 15))
    assert [lap.max_m for lap in laps.laps()] == pytest.approx([0.001 * lap.number for lap in laps.laps()])
    note(laps, {1: 140.5}, 0.02, FlownLaps(LAP_S, flight=1))
    assert [(lap.number, lap.max_m) for lap in laps.laps()] == [(15, 0.02)]
    note(laps, {1: 135.5}, 0.03, FlownLaps(LAP_S, flight=1))
    assert [lap.number for lap in laps.laps()] == [15, 14], "back by no more than a resume is"
    note(laps, {1: 130.4}, 0.04, FlownLaps(LAP_S, flight=1))
    assert [(lap.number, lap.max_m) for lap in laps.laps()] == [(14, 0.04)], "another run"


@pytest.mark.parametrize(
    ("laps", "clock_s", "number", "next_s"),
    [
        (FlownLaps(10.0, 5.0), 0.0, 1, 15.0),
        (FlownLaps(10.0, 5.0), 14.99, 1, 15.0),
        (FlownLaps(10.0, 5.0), 15.0, 2, 25.0),
        (FlownLaps(None, 5.0), 99.0, 0, 5.0),
    ],
)
def test_laps_are_counted_from_the_paths_beginning(laps: FlownLaps, clock_s: float, number: int, next_s: float) -> None:
    assert (laps.number(clock_s), laps.next_s(clock_s)) == (number, next_s)

"""Lag of a robot behind the fleet, from a state that is some time old."""

import numpy as np
import pytest

from groundstation.mission.timetable import ProgressGovernor, Timetable
from groundstation.telemetry import RobotView
from shoal.config.mission import MissionConfig
from shoal.messages.messages import Estimate, Mode, RobotState

NS = 1_000_000_000
TIMETABLE = Timetable(start_ns=10 * NS, from_s=3.0)


def seen(trajectory_s: float, age_s: float = 0.0, mode: Mode = Mode.TRACKING) -> RobotView:
    return RobotView(RobotState(mode=mode, trajectory_s=trajectory_s, estimate=Estimate(eta=np.zeros(4))), age_s)


def test_the_timetable_stands_until_its_instant() -> None:
    assert [TIMETABLE.at_s(t * NS) for t in (0, 10, 12)] == [3.0, 3.0, 5.0]


@pytest.mark.parametrize("age_s", [0.0, 0.1, 0.2])
def test_a_late_state_counts_with_its_age(age_s: float) -> None:
    pace = ProgressGovernor(MissionConfig())
    told_s = 5.0 - age_s
    assert TIMETABLE.behind_s(seen(told_s, age_s), pace, 12 * NS) == pytest.approx(0.0)
    assert TIMETABLE.behind_s(seen(told_s - 0.7, age_s), pace, 12 * NS) == pytest.approx(0.7)
    assert TIMETABLE.behind_s(seen(told_s + 0.7, age_s), pace, 12 * NS) == pytest.approx(-0.7)


def test_a_formation_that_waits_is_not_behind_itself() -> None:
    """At a fifth of its pace, and two seconds late: 0.2 s ago it was 0.16 s less late."""
    pace = ProgressGovernor(MissionConfig())
    pace.lag_s, pace.rate = 2.0, 0.2
    assert TIMETABLE.behind_s(seen(5.0 - 0.2 - 1.84, 0.2), pace, 12 * NS) == pytest.approx(0.0)


def test_only_a_heard_flying_robot_has_a_lag() -> None:
    pace = ProgressGovernor(MissionConfig())
    for robot in (seen(0.0, mode=Mode.HOLDING), seen(0.0, age_s=9.0), RobotView()):
        assert TIMETABLE.behind_s(robot, pace, 12 * NS) == 0.0

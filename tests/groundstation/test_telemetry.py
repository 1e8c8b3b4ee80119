"""A robot's link and clock from message headers, and the findings about them."""

from dataclasses import replace

import numpy as np
import pytest

from groundstation.telemetry import LinkMonitor, RobotView, findings
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import load_experiment
from shoal.messages import topics
from shoal.messages.codec import Header, encode
from shoal.messages.messages import BoardReading, Mode, Plan, Pose, RobotState, StepTiming, Track

MS = 1_000_000


@pytest.mark.parametrize(("lost", "share"), [((), 0.0), ((3, 7), 0.2), ((2, 4, 6, 8), 0.4)])
def test_only_missing_sequence_numbers_count_as_lost(lost: tuple[int, ...], share: float) -> None:
    """Two messages between two looks, then none, again and again: a robot and a station that keep time alike."""
    inbox, ear = Bus(MemoryTransport(MemoryHub())).inbox(topics.PLAN, Plan, 1), LinkMonitor()
    for k in range(200):
        if k % 10 not in lost:
            inbox.store(Header(7, k + 1, k * 50 * MS), encode(Plan(0.05)))
        newest = inbox.newest()
        if k % 2 and newest is not None:
            ear.add(inbox.headers(), newest.header, (k * 50 - 3) * MS)
    assert ear.loss == pytest.approx(share, abs=0.02)
    assert 0.002 < ear.clock_offset_s < 0.004


@pytest.mark.parametrize(("limit", "key", "age_s"), [("pose_hold_s", "pose", 0.4), ("plan_max_age_s", "plan", 0.7)])
def test_message_ages_are_judged_by_the_experiments_limits(limit: str, key: str, age_s: float) -> None:
    """At a lower rate an experiment allows more; the station must not bar what the robots would fly with."""
    view = RobotView(
        RobotState(mode=Mode.HOLDING, board=BoardReading(battery_v=16.0), timing=StepTiming(board_age_ms=20.0)), 0.02,
        Pose(0.0, 0.0, 0.0, np.eye(3), Track.MARKER, True, 1.0, 0.0), age_s, age_s,
    )  # fmt: skip
    for limit_s, is_alarm in ((age_s - 0.1, True), (age_s + 0.1, False)):
        experiment = load_experiment("pool", [f"safety.{limit}={limit_s}", "safety.pose_neutral_s=0.9"])
        assert (key in [finding.key for finding in findings(experiment, 1, view)]) is is_alarm


UNHEARD_BATTERY = RobotState(timing=StepTiming(board_age_ms=20.0), board=BoardReading())


def test_an_unheard_battery_is_not_reported_empty() -> None:
    experiment = load_experiment("pool")
    alarms_by_key = {f.key: f for f in findings(experiment, 1, RobotView(UNHEARD_BATTERY, 0.02))}
    assert (alarms_by_key["battery"].text, alarms_by_key["battery"].blocks_arming) == ("battery not heard yet", True)
    low = {
        f.key: f
        for f in findings(
            experiment, 1, RobotView(RobotState(timing=StepTiming(board_age_ms=20.0), board=BoardReading(battery_v=9.0)), 0.02)
        )
    }
    assert low["battery"].text == "battery 9.0 V, needs 10.5 V"


@pytest.mark.parametrize(
    ("age_ms", "board", "text"),
    [
        (2500.0, BoardReading(5), "thruster board silent for 2.5 s"),
        (None, None, "thruster board not heard"),
        (None, BoardReading(5), "thruster board not heard"),
    ],
)
def test_a_board_never_heard_is_reported_without_an_age(age_ms: float | None, board: BoardReading | None, text: str) -> None:
    view = RobotView(RobotState(timing=StepTiming(board_age_ms=age_ms), board=board), 0.02, None, 0.02)
    assert text in [finding.text for finding in findings(load_experiment("pool"), 1, view)]


def test_a_robot_that_was_never_heard_has_no_mode() -> None:
    assert RobotView().mode is None
    assert RobotView(RobotState()).mode is Mode.DISARMED


@pytest.mark.parametrize(("behind_s", "text"), [(0.8, "is 0.8 s behind the others"), (-0.6, "is 0.6 s ahead of the others")])
def test_a_robot_out_of_step_raises_an_alarm_and_does_not_block_arming(behind_s: float, text: str) -> None:
    experiment = load_experiment("pool")
    view = RobotView(RobotState(mode=Mode.TRACKING), 0.02, None, 0.02, behind_s=behind_s)
    (alarm,) = [f for f in findings(experiment, 1, view) if f.key == "step"]
    assert (alarm.level, alarm.blocks_arming, alarm.text) == ("critical", False, text)
    assert not [f for f in findings(experiment, 1, replace(view, behind_s=0.4)) if f.key == "step"]

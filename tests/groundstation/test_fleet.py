"""What headers tell of a robot's link and clock, and what is found amiss."""

from dataclasses import replace

import pytest

from groundstation.fleet import Ear, RobotView, findings
from wire import topics
from wire.bus import Bus
from wire.codec import Header, encode
from wire.experiment import load_experiment
from wire.messages import Mode, Plan, RobotState
from wire.transport import MemoryHub, MemoryTransport

MS = 1_000_000


@pytest.mark.parametrize(("lost", "share"), [((), 0.0), ((3, 7), 0.2), ((2, 4, 6, 8), 0.4)])
def test_only_what_did_not_come_is_lost_however_late_somebody_looks(lost: tuple[int, ...], share: float) -> None:
    """Two messages between two looks, then none, again and again: a robot and a station that keep time alike."""
    inbox, ear = Bus(MemoryTransport(MemoryHub())).inbox(topics.PLAN, Plan, 1), Ear()
    for k in range(200):
        if k % 10 not in lost:
            inbox.store(Header(7, k + 1, k * 50 * MS), encode(Plan(0.05)))
        newest = inbox.newest()
        if k % 2 and newest is not None:
            ear.hear(inbox.headers(), newest.header, (k * 50 - 3) * MS)
    assert ear.loss == pytest.approx(share, abs=0.02)
    assert 0.002 < ear.clock_offset_s < 0.004


@pytest.mark.parametrize(("age_ms", "text"), [(2500.0, "thruster board silent for 2.5 s"), (1e6, "thruster board not heard")])
def test_a_board_that_was_never_heard_has_not_been_silent_for_so_long(age_ms: float, text: str) -> None:
    seen = RobotView(RobotState(board_age_ms=age_ms), 0.02, None, 0.02)
    assert text in [finding.text for finding in findings(load_experiment("pool"), 1, seen)]


def test_a_robot_that_was_never_heard_has_no_mode() -> None:
    assert RobotView().mode is None
    assert RobotView(RobotState()).mode is Mode.DISARMED


@pytest.mark.parametrize(("behind_s", "text"), [(0.8, "is 0.8 s behind the others"), (-0.6, "is 0.6 s ahead of the others")])
def test_a_robot_out_of_step_is_an_alarm_but_does_not_keep_it_from_going_on(behind_s: float, text: str) -> None:
    experiment = load_experiment("pool")
    seen = RobotView(RobotState(mode=Mode.TRACKING), 0.02, None, 0.02, behind_s=behind_s)
    (found,) = [f for f in findings(experiment, 1, seen) if f.key == "step"]
    assert (found.level, found.bars, found.text) == ("critical", False, text)
    assert not [f for f in findings(experiment, 1, replace(seen, behind_s=0.4)) if f.key == "step"]

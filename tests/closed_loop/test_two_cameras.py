"""Lockstep flights under two cameras: robots cross from one picture into the other, and one camera goes or is bumped.

The first seven seconds of one flight also stand for the scene's begin as its users fly it (test_scenes.py)."""

from pathlib import Path

import pytest

from groundstation.report.report import write_report
from localizer.evaluation.runner import evaluate_log
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import dump_experiment, load_experiment
from shoal.messages import topics
from shoal.messages.codec import decode
from shoal.messages.messages import Event, LocalizerStatus, Mode, Obstacles, Pose, RobotState, Track
from sim_bridge.in_process.executor import Executor

pytestmark = pytest.mark.long

BUMPED_S = 3.8  # s along the trajectories
GONE_S = 7.0  # s along the trajectories: the east sees both robots, robot 2 in the middle, where the west saw it too


def test_robots_fly_on_under_one_camera_when_the_other_is_bumped(tmp_path: Path) -> None:
    """East is bumped while the west sees both robots, until the end."""
    fault = "camera east bump 20"
    settings = ["duration_s=5", "recording.video=none", "localizer.preview_rate_hz=0"]
    experiment, hub = load_experiment("two-cameras", settings, [f"t={BUMPED_S:g} {fault}"]), MemoryHub()
    bus = Bus(MemoryTransport(hub))
    statuses, poses, states, events, obstacles = (
        bus.collect(topic) for topic in (topics.LOCALIZER, topics.POSE, topics.STATE, topics.EVENT, topics.OBSTACLES)
    )
    (tmp_path / "experiment.toml").write_text(dump_experiment(experiment), encoding="utf-8")
    assert Executor(experiment, tmp_path, hub).fly()

    stamps_ns = {decode(Event, data, "test", key).message: header.stamp_ns for _, key, header, data in events()}
    begin_ns = stamps_ns[f"fault: {fault}"]
    by_stamp = {header.stamp_ns: decode(LocalizerStatus, data, "test", key) for _, key, header, data in statuses()}
    out_ns = min(stamp_ns for stamp_ns, status in by_stamp.items() if status.out)
    assert begin_ns < out_ns <= begin_ns + 250_000_000  # most of the five marks are read in three pictures
    assert all(status.out == ("east",) and status.robots == (1, 2) for at, status in by_stamp.items() if at >= out_ns)
    assert "camera east is out: the camera was moved: check marks are" in by_stamp[out_ns].message
    assert all(decode(Obstacles, data, "test", key).ids == () for _, key, _, data in obstacles())
    over_ns = max(by_stamp)
    flown = [decode(RobotState, data, "test", key).mode for _, key, h, data in states() if begin_ns <= h.stamp_ns < over_ns]
    assert flown.count(Mode.TRACKING) >= 2 * 20 and set(flown) <= {Mode.TRACKING, Mode.DISARMED}
    assert len([0 for _, _, header, _ in poses() if header.stamp_ns > begin_ns]) > 2 * 20
    rows = {row.subject: row for row in evaluate_log(tmp_path / "run.mcap")[0]}
    assert rows["all but lost"].max_mm < 6.0 and rows["camera east"].max_mm > 50.0


def test_robots_cross_over_and_fly_on_when_the_camera_that_they_left_is_gone(tmp_path: Path) -> None:
    experiment, hub = load_experiment("two-cameras", ["duration_s=9"], [f"t={GONE_S:g} camera west gone"]), MemoryHub()
    bus = Bus(MemoryTransport(hub))
    statuses, poses = bus.collect(topics.LOCALIZER), bus.collect(topics.POSE)
    (tmp_path / "experiment.toml").write_text(dump_experiment(experiment), encoding="utf-8")
    assert Executor(experiment, tmp_path, hub).fly()

    by_stamp = {header.stamp_ns: decode(LocalizerStatus, data, "test", key) for _, key, header, data in statuses()}
    out_ns = min(stamp_ns for stamp_ns, status in by_stamp.items() if status.out and status.robots)
    assert by_stamp[out_ns].out == ("west",) and "camera west is out: its last picture is" in by_stamp[out_ns].message
    assert all(status.robots == (1, 2) for stamp_ns, status in by_stamp.items() if stamp_ns >= out_ns)
    published = [decode(Pose, data, "test", key) for _, key, _, data in poses()]
    assert all(pose.track is Track.MARKER for pose in published)

    rows = {row.subject: row for row in evaluate_log(tmp_path / "run.mcap")[0]}
    assert rows["all but lost"].rms_mm < 2.0 and rows["all but lost"].nees < 3.5
    assert rows["seen by 1"].poses > 100 and rows["seen by 2"].poses > 100
    assert rows["step, hand-over"].poses >= 3 and rows["step, hand-over"].max_mm < 3.0
    assert rows["step, hand-over"].nees < rows["step, hand-over"].nees_high

    result = write_report(tmp_path)
    assert [(fault.time_s, fault.source, fault.text) for fault in result.faults if fault.time_s < GONE_S] == []
    assert [check.name for check in result.checks if check.failed] == ["faults"]  # that the camera is gone
    out = result.cameras_out
    assert out["east"] == 0.0 and out["west"] == pytest.approx((9.0 - GONE_S - 0.25) / 9.0, abs=0.03)
    assert "Cameras, share of the flight without their poses: west" in (tmp_path / "report.html").read_text(encoding="utf-8")

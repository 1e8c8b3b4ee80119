"""Poses of a log against the truth in it, where every sender stamps by a clock of its own."""

from pathlib import Path

import numpy as np
import pytest

from groundstation.logs.recorder import Recorder
from localizer.evaluation.runner import evaluate_log
from shoal.messages import topics
from shoal.messages.codec import Header, encode
from shoal.messages.messages import LocalizerStatus, Pose, Track, Truth
from shoal.messages.topics import Topic

MS = 1_000_000
LATE_MS = 40  # from the exposure to the publication
SPEED_MPS = 0.2


@pytest.mark.parametrize(("localizer_s", "simulator_s"), [(0.0, 0.0), (-20.0, 0.0), (7.0, -3.0)])
def test_a_log_is_evaluated_by_one_clock_whatever_its_senders_clocks_show(
    tmp_path: Path, localizer_s: float, simulator_s: float
) -> None:
    """A robot that moves is where its pose says, at the same instant."""
    recorder = Recorder(tmp_path / "run.mcap", "name = 'pool'\n", {"mode": "real-time"})
    begin_ns = 1_700_000_000_000 * MS

    def put(topic: Topic, key: str, message: object, at_ms: int, clock_s: float, session: int, age_ms: int = 0) -> None:
        stamp_ns = begin_ns + at_ms * MS + round(clock_s * 1e9)
        header = Header(session, at_ms + 1, stamp_ns)
        arrived_ns = begin_ns + (at_ms + age_ms) * MS
        recorder.put(topic, f"shoal/{key}", header, encode(message), arrived_ns)  # type: ignore[arg-type]

    for at_ms in range(0, 12_000, 50):
        x_m = SPEED_MPS * at_ms * 1e-3
        truth = Truth((1,), np.array([[x_m, 0.0, 0.3, 0.0]]), np.zeros((1, 4)), np.zeros((1, 3)), np.zeros((1, 4)))
        put(topics.TRUTH, "sim/truth", truth, at_ms, simulator_s, 5)
        pose = Pose(x_m, 0.0, 0.0, 1e-6 * np.eye(3), Track.MARKER, True)
        put(topics.POSE, "robot/1/pose", pose, at_ms, localizer_s, 9, LATE_MS)
        put(topics.LOCALIZER, "localizer/status", LocalizerStatus(frame_age_ms=LATE_MS), at_ms, localizer_s, 9, LATE_MS)
    recorder.close()
    assert recorder.error == ""
    rows = {row.subject: row for row in evaluate_log(tmp_path / "run.mcap")[0]}
    assert rows["robot 1"].poses > 200 and rows["robot 1"].max_mm < 5.0


@pytest.mark.parametrize(("clocks_s", "phase_ms"), [((0.0, 0.0), 0), ((7.0, -3.0), 0), ((0.0, 0.0), 20)])
def test_which_cameras_saw_a_robot_does_not_depend_on_their_clocks(
    tmp_path: Path, clocks_s: tuple[float, float], phase_ms: int
) -> None:
    """The second one, which sees it from half of the flight on, exposes `phase_ms` earlier; fused poses have the first one's
    stamps, as what fuses carries them over."""
    recorder = Recorder(tmp_path / "run.mcap", "name = 'pool'\n", {"mode": "real-time"})
    begin_ns, jitter_ms = 1_700_000_000_000 * MS, np.random.default_rng(1).uniform(0.0, 2.0, (240, 3))

    def put(topic: Topic, robot: int | None, message: object, at_ms: int, session: int, clock_s: float, age_ms: float) -> None:
        header = Header(session, at_ms + 100, begin_ns + at_ms * MS + round(clock_s * 1e9))
        arrived_ns = begin_ns + round((at_ms + age_ms) * MS)
        recorder.put(topic, f"shoal/{topic.key(robot)}", header, encode(message), arrived_ns)  # type: ignore[arg-type]

    for step in range(240):
        at_ms = 50 * step
        truth = Truth((1,), np.array([[0.0, 0.0, 0.3, 0.0]]), np.zeros((1, 4)), np.zeros((1, 3)), np.zeros((1, 4)))
        put(topics.TRUTH, None, truth, at_ms, 5, 0.0, 0.1)
        pose = Pose(0.0, 0.0, 0.0, 1e-6 * np.eye(3), Track.MARKER, True)
        for number, (name, clock_s) in enumerate(zip(("east", "west", ""), (*clocks_s, clocks_s[0]), strict=True)):
            exposed_ms, late_ms = at_ms - phase_ms * (name == "west"), LATE_MS + jitter_ms[step, number]
            if name != "west" or step >= 120:
                put(topics.POSE.of_camera(name), 1, pose, exposed_ms, 7 + number, clock_s, late_ms)
            status = LocalizerStatus(frame_age_ms=LATE_MS)
            put(topics.LOCALIZER.of_camera(name), None, status, exposed_ms, 7 + number, clock_s, late_ms)
    recorder.close()
    rows = {row.subject: row.poses for row in evaluate_log(tmp_path / "run.mcap")[0]}
    assert "seen by 0" not in rows and rows["step, hand-over"] == 1
    assert abs(rows["seen by 1"] - 120) <= 2 and abs(rows["seen by 2"] - 120) <= 2

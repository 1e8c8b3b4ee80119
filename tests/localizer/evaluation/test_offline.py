"""`localizer track` and `localizer rerun`: a video, and a recording of what the localizer went by, become poses again."""

import csv
import itertools
import json
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from typer.testing import CliRunner

from localizer.__main__ import cli
from localizer.detection.image_regions import BAYER_TO_BGR
from localizer.evaluation.offline import PoseTable, frames_of_video
from localizer.node import FrameOutlets, LocalizerNode
from localizer.sources.base import CapturedFrame
from localizer.sources.recording import FRAMES, FrameRecorder, RecordedFrame, recorded_frames
from localizer.sources.video import VideoReader
from localizer.tracking.fleet_localizer import FleetLocalizer, LocalizationResult
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import load_experiment
from shoal.errors import ConfigError
from shoal.frames import Array
from shoal.messages import topics
from shoal.messages.messages import BoardReading, RobotState, StepTiming
from shoal.runtime.output_files import disk_free
from shoal.runtime.runtime import Stop
from sim_bridge.lockstep.clock import LockstepClock
from tests.localizer.scene import Scene
from tests.localizer.stand_ins import MS

JUST_NOW = StepTiming(board_age_ms=0.0)
pytestmark = pytest.mark.long

EXPERIMENT = load_experiment("pool")
FILMED, RECORDED = 10, 24
ROLL_RAD, DEPTH_M = 0.06, 0.32
STANDING = np.array([-0.4, 0.1, 0.3, 1.0])


def _place(frame: int) -> Array:
    return np.array([0.4 + 0.01 * frame, 0.1, 0.3, 0.7])


def _run(*arguments: str, exit_code: int = 0) -> str:
    done = CliRunner().invoke(cli, arguments)
    assert done.exit_code == exit_code, (done.output, done.exception)
    return done.stdout


def _rows(table: Path) -> list[dict[str, str]]:
    with table.open() as file:
        return list(csv.DictReader(file))


# --- a video


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("track") / "pool.avi"
    scene = Scene(EXPERIMENT)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"HFYU"), 20.0, EXPERIMENT.camera.size_px)
    for k in range(FILMED):
        writer.write(cv2.cvtColor(scene.frame({1: _place(k), 2: STANDING}), BAYER_TO_BGR))
    writer.release()
    return path


def _track(video: Path, out: Path, *options: str) -> list[dict[str, str]]:
    output = _run("track", str(video), "--experiment", "pool", "--out", str(out), *options)
    assert output.endswith(f"Wrote {out}: {2 * (FILMED - 1)} poses from {FILMED} pictures.\n")
    assert not list(out.parent.glob("*.part"))
    return _rows(out) if out.suffix == ".csv" else []


def test_the_table_has_a_row_for_each_robot_and_frame(video: Path, tmp_path: Path) -> None:
    rows = _track(video, tmp_path / "poses.csv")
    assert [(int(row["frame"]), int(row["robot"])) for row in rows] == [(k, i) for k in range(1, FILMED) for i in (1, 2)]
    for row in rows[::2]:
        assert float(row["x_m"]) == pytest.approx(_place(int(row["frame"]))[0], abs=2e-3)
        assert row["track"] == "marker" and row["identity_verified"] == "1" and float(row["sigma_x_m"]) < 0.01
        assert int(row["stamp_ns"]) == int(row["frame"]) * 50 * MS


def test_parquet_has_the_same_cells(video: Path, tmp_path: Path) -> None:
    rows = _track(video, tmp_path / "poses.csv")
    _track(video, tmp_path / "poses.parquet")
    table = pq.read_table(tmp_path / "poses.parquet")
    assert table.column_names == list(rows[0])
    for row, cells in zip(rows, table.to_pylist(), strict=True):
        assert cells["track"] == row["track"] and cells["identity_verified"] is bool(int(row["identity_verified"]))
        numbers = [name for name in row if name not in ("track", "identity_verified")]
        assert [cells[name] for name in numbers] == [float(row[name]) for name in numbers]


def test_reports_of_boards_correct_the_poses(video: Path, tmp_path: Path) -> None:
    """A roll moves the centre below the plate to port of where a level robot's is; another depth moves it towards the lens."""
    reports = tmp_path / "boards.csv"
    lines = [f"{k},1,{DEPTH_M},{ROLL_RAD},0.0\n{k},2,,,\n" for k in range(FILMED)]
    reports.write_text("frame,robot,depth_m,roll_rad,pitch_rad\n" + "".join(lines))
    level = _track(video, tmp_path / "level.csv")
    leaning = _track(video, tmp_path / "leaning.csv", "--reports", str(reports))
    for before, after in zip(level[::2], leaning[::2], strict=True):
        assert float(after["depth_m"]) == DEPTH_M and float(before["depth_m"]) != DEPTH_M
        moved = np.array([float(after[name]) - float(before[name]) for name in ("x_m", "y_m")])
        yaw, aside_m = float(after["yaw_rad"]), EXPERIMENT.vehicle.marker.height_m * np.sin(ROLL_RAD)
        np.testing.assert_allclose(moved, -aside_m * np.array([-np.sin(yaw), np.cos(yaw)]), atol=4e-3)
        assert float(after["sigma_x_m"]) < float(before["sigma_x_m"])
    assert leaning[1::2] == level[1::2], "robot 2 told nothing"
    bad = tmp_path / "bad.csv"
    bad.write_text("frame,robot,depth_m\n0,1,deep\n")
    command = ["track", str(video), "--experiment", "pool", "--out", str(tmp_path / "none.csv"), "--reports", str(bad)]
    assert "bad.csv: line 2, column depth_m: 'deep' is no number" in str(CliRunner().invoke(cli, command).exception)
    assert not list(tmp_path.glob("none*"))


def test_a_run_that_was_cut_goes_on_to_the_same_table(video: Path, tmp_path: Path) -> None:
    whole, cut = tmp_path / "whole.csv", tmp_path / "cut.csv"
    _track(video, whole)
    text = whole.read_text()
    part = _begun(video, cut)
    part.write_text(text[: int(0.55 * len(text))])  # in the middle of a row
    _track(video, cut, "--resume")
    assert cut.read_text() == text


@pytest.mark.parametrize("fails_again", [False, True])
def test_a_run_that_goes_on_tells_of_pictures_that_failed_before(
    fails_again: bool, video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They make no rows, so that the table alone looks as if nothing had failed: the first part's count, each once."""
    out = tmp_path / "poses.csv"
    _begun(video, out, fails_at=2)
    if fails_again:  # on the way up to the last frame that is whole

        def failing(self: FleetLocalizer, *arguments: Any) -> LocalizationResult:
            raise cv2.error("assertion failed")

        locate, calls = FleetLocalizer.locate, iter(range(1000))
        monkeypatch.setattr(
            FleetLocalizer, "locate", lambda self, *rest: (failing if next(calls) == 2 else locate)(self, *rest)
        )
    done = CliRunner().invoke(cli, ["track", str(video), "--experiment", "pool", "--out", str(out), "--resume"])
    assert done.exit_code == 1, done.output
    assert "1 pictures could not be localized in, the first: error: assertion failed" in done.stderr
    assert {int(row["frame"]) for row in _rows(out)} == {1, *range(3, FILMED)}
    assert [path.name for path in tmp_path.iterdir()] == ["poses.csv"]


def _begun(video: Path, out: Path, fails_at: int = -1) -> Path:
    """The part of a table that a run of the same command gathers, made by one that is stopped. `fails_at`: the picture that
    nothing can be done with."""
    script = f"""
import os
import cv2
from localizer.evaluation import offline
row = offline._row  # private: the run ends in the middle of its work, as if it were killed
offline._row = lambda frame, *rest: os._exit(9) if frame > 3 else row(frame, *rest)
locate, calls = offline.FleetLocalizer.locate, iter(range(1000))
def locate_or_fail(self, *rest):
    if next(calls) == {fails_at}:
        raise cv2.error("assertion failed")
    return locate(self, *rest)
offline.FleetLocalizer.locate = locate_or_fail
from localizer.__main__ import cli
cli(["track", {str(video)!r}, "--experiment", "pool", "--out", {str(out)!r}])
"""
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, check=False).returncode == 9
    (part,) = out.parent.glob(f"{out.name}.*.part")
    return part


def test_a_part_of_other_settings_is_not_gone_on_with(video: Path, tmp_path: Path) -> None:
    """One table must not hold the poses of two calibrations."""
    out = tmp_path / "cut.csv"
    part = _begun(video, out)
    text = part.read_text()
    command = ["track", str(video), "--experiment", "pool", "--out", str(out), "--resume"]
    done = CliRunner().invoke(cli, [*command, "--set", "camera.focal_px=[1200.0, 1200.0]"])
    assert f"{part}: its poses are of another recording, or of other settings" in str(done.exception)
    assert part.read_text() == text and not out.exists()


def test_two_programs_never_write_the_same_table(video: Path, tmp_path: Path) -> None:
    """Two people go on with the same part: each would add its rows behind the other's."""
    whole, out = tmp_path / "whole.csv", tmp_path / "poses.csv"
    _track(video, whole)
    film = VideoReader(video)
    with closing(film):
        first, second = PoseTable(out, "12345678"), PoseTable(out, "12345678")
        writing = first.write(frames_of_video(film, video, EXPERIMENT, None), EXPERIMENT)
        assert [next(writing) for _ in range(4)] == [1, 2, 3, 4]
        with pytest.raises(ConfigError, match="another program still writes it"):
            next(second.write(frames_of_video(film, video, EXPERIMENT, None), EXPERIMENT))
        assert list(writing)[-1] == FILMED
    assert out.read_text() == whole.read_text()
    with pytest.raises(ConfigError, match="is there already"):  # asked before the first had ended
        next(second.write(iter(()), EXPERIMENT))


def test_a_part_that_a_disk_has_spoilt_goes_on_before_that(video: Path, tmp_path: Path) -> None:
    """As when the power fails: zeros, any bytes, or numbers that are none."""
    whole = tmp_path / "whole.csv"
    _track(video, whole)
    lines = whole.read_bytes().splitlines(keepends=True)
    for k, spoilt in enumerate(
        (bytes(200), b"\xff\xfe" * 50 + b"\n", b"x" + b",1" * 12 + b"\n", lines[5][:-4] + b"\xc3\xa9\n")
    ):
        out = tmp_path / f"{k}.csv"
        _begun(video, out).write_bytes(b"".join([*lines[:5], spoilt, *lines[6:9]]))
        _track(video, out, "--resume")
        assert out.read_bytes() == whole.read_bytes()


def test_a_table_that_came_meanwhile_is_not_written_over(video: Path, tmp_path: Path) -> None:
    out = tmp_path / "poses.csv"
    with closing(VideoReader(video)) as film:
        table = PoseTable(out, "12345678")
        writing = table.write(frames_of_video(film, video, EXPERIMENT, None), EXPERIMENT)
        next(writing)
        out.write_text("somebody else's\n")
        with pytest.raises(ConfigError, match=r"poses.csv: came meanwhile \(move it, then --resume"):
            list(writing)
    (part,) = tmp_path.glob("*.part")
    assert out.read_text() == "somebody else's\n" and len(part.read_text().splitlines()) > FILMED


def test_a_table_is_not_overwritten(video: Path, tmp_path: Path) -> None:
    out = tmp_path / "poses.csv"
    command, part = ["track", str(video), "--experiment", "pool", "--out", str(out)], _begun(video, out)
    part.write_text("kept\n")
    assert "is there already (write to another file, or --resume)" in str(CliRunner().invoke(cli, command).exception)
    assert "its columns are not" in str(CliRunner().invoke(cli, [*command, "--resume"]).exception)
    out.write_text("whole\n")
    assert "is there already (write to another file)" in str(CliRunner().invoke(cli, [*command, "--resume"]).exception)
    assert (part.read_text(), out.read_text()) == ("kept\n", "whole\n")


def test_a_video_of_another_size_or_without_robots_makes_no_table(video: Path, tmp_path: Path) -> None:
    writer = cv2.VideoWriter(str(tmp_path / "empty.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, EXPERIMENT.camera.size_px)
    for _ in range(3):
        writer.write(np.full((960, 1280, 3), 90, np.uint8))
    writer.release()
    out = str(tmp_path / "poses.csv")
    command = ["track", str(tmp_path / "empty.avi"), "--experiment", "pool", "--out", out]
    assert "no robot was found in any picture" in str(CliRunner().invoke(cli, command).exception)
    other = ["--set", "camera.size_px=[960,1280]", "--set", "camera.centre_px=[479.5,639.5]"]
    turned = CliRunner().invoke(cli, [*command, *other])
    assert "empty.avi: 1280x960, but camera.size_px of experiment 'pool' is 960x1280" in str(turned.exception)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty.avi"]


def test_a_video_that_was_cut_makes_a_table_and_exit_code_1(tmp_path: Path) -> None:
    """Three of ten pictures are gone from the middle: later ones keep their numbers, and the last line tells."""
    scene, whole = Scene(EXPERIMENT), tmp_path / "pool.avi"
    writer = cv2.VideoWriter(str(whole), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, EXPERIMENT.camera.size_px)
    for k in range(FILMED):
        writer.write(cv2.cvtColor(scene.frame({1: _place(k), 2: STANDING}), BAYER_TO_BGR))
    writer.release()
    data = bytearray(whole.read_bytes())
    middle = len(data) // 2
    data[middle : middle + len(data) // 4] = bytes(len(data) // 4)
    whole.write_bytes(data)
    out = tmp_path / "poses.csv"
    done = CliRunner().invoke(cli, ["track", str(whole), "--experiment", "pool", "--out", str(out)])
    assert done.exit_code == 1 and "3 of 10 pictures cannot be read: 5 to 7" in done.stderr
    rows = _rows(out)
    assert {int(row["frame"]) for row in rows} >= {1, 2, 3, 8, 9} and len(rows) < 2 * (FILMED - 1)
    for row in rows[::2]:
        assert float(row["x_m"]) == pytest.approx(_place(int(row["frame"]))[0], abs=4e-3)


def test_pictures_whose_processing_fails_are_skipped_and_counted(
    video: Path, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in flight: the pictures after them have their poses; where nothing came out there is no table, and exit code 1."""
    locate, count, failing = FleetLocalizer.locate, [0], [range(4, 6)]

    def failing_at_times(self: FleetLocalizer, *arguments: Any) -> LocalizationResult:
        count[0] += 1
        if count[0] - 1 in failing[0]:
            raise cv2.error("assertion failed")
        return locate(self, *arguments)

    monkeypatch.setattr(FleetLocalizer, "locate", failing_at_times)
    out = tmp_path / "poses.csv"
    done = CliRunner().invoke(cli, ["track", str(video), "--experiment", "pool", "--out", str(out)])
    assert done.exit_code == 1
    assert "2 pictures could not be localized in, the first: error: assertion failed" in done.stderr
    assert {int(row["frame"]) for row in _rows(out)} == {1, 2, 3, 6, 7, 8, 9}
    count[0] = 0
    done = CliRunner().invoke(cli, ["rerun", str(recording), "--json"])
    assert done.exit_code == 1 and "2 pictures could not be localized in" in done.stderr
    assert [(row["first_frame"], row["poses"]) for row in json.loads(done.stdout)] == [(4, RECORDED - 1)] * 2
    failing[0] = range(1000)
    for command in (
        ["track", str(video), "--experiment", "pool", "--out", str(tmp_path / "none.csv")],
        ["rerun", str(recording)],
    ):
        done = CliRunner().invoke(cli, command)
        assert done.exit_code == 1 and "assertion failed" in str(done.exception)
    assert not list(tmp_path.glob("none*"))


# --- a recording


class _LeaningRobots:
    """A camera over two robots whose boards report depth and tilt; robot 1's marker is hidden for a while, and once no
    frame comes."""

    trouble, silent_after_s = "", 0.25

    def __init__(self, bus: Bus, clock: LockstepClock) -> None:
        self._bus, self._clock, self._scene = bus, clock, Scene(EXPERIMENT)

    def frames(self, stop: Stop) -> Iterator[CapturedFrame | None]:
        for k in range(RECORDED):
            self._clock.tick_ns = at_ns = (20 + k) * 50 * MS
            for robot in (1, 2):
                tilt = np.array([ROLL_RAD + 0.001 * k, 0.01 * robot, 0.02, 0.0])
                self._bus.publish(
                    topics.STATE,
                    RobotState(board=BoardReading(depth_m=0.3 + 1e-4 * k, tilt=tilt), timing=JUST_NOW),
                    at_ns,
                    robot,
                )
            hidden = frozenset({1} if 8 <= k < 14 else ())
            yield CapturedFrame(self._scene.frame({1: _place(k), 2: STANDING}, hidden), at_ns - 7, at_ns, at_ns)
            if k == 10:
                yield None

    def close(self) -> None:
        """Do nothing: nothing is open."""


def _localize(folder: Path, **recording: Any) -> list[tuple[int, bytes]]:
    """Run the localizer once, recording; returns stamps and bytes of all poses on the bus."""
    network = MemoryHub()
    bus, ours = Bus(MemoryTransport(network)), Bus(MemoryTransport(network))
    published = ours.collect(topics.POSE)
    with closing(FrameRecorder(folder, EXPERIMENT, waits=True, **recording)) as recorder:
        clock = LockstepClock()
        camera = _LeaningRobots(ours, clock)
        LocalizerNode(EXPERIMENT, bus, Stop(install=False), clock, camera, FrameOutlets(recorder=recorder)).run()
    return [(header.stamp_ns, payload) for _, _, header, payload in published()]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("record") / "frames-1"
    published = _localize(folder)
    kept = [(frame.stamp_ns, pose) for frame in recorded_frames(folder) for pose in frame.poses.values()]
    assert kept == published and len(published) == 2 * (RECORDED - 1), "one claim, then poses"
    with (folder / FRAMES).open("rb") as file:  # viewers read it by its index
        indexed = [channel.topic for _, channel, _ in make_reader(file).iter_messages(log_time_order=False)]
    assert indexed.count("camera/frame") == RECORDED and indexed.count("robot/2/pose") == RECORDED - 1
    return folder


def test_a_recording_localized_again_gives_the_same_poses_to_the_bit(recording: Path) -> None:
    same = json.loads(_run("rerun", str(recording), "--json"))
    assert [(row["poses"], row["differing"]) for row in same] == [(RECORDED - 1, 0)] * 2
    other = json.loads(_run("rerun", str(recording), "--json", "--set", "localizer.depth_sigma_m=0.02"))
    assert [row["differing"] for row in other] == [RECORDED - 1] * 2 and other[1]["first_frame"] == 1


def test_another_folder_is_refused_with_what_a_recording_is(tmp_path: Path) -> None:
    for name in ("run.mcap", "experiment.toml"):
        (tmp_path / name).touch()
    for folder in (tmp_path, tmp_path / "run.mcap", tmp_path / "nothing"):
        refused = str(CliRunner().invoke(cli, ["rerun", str(folder)]).exception)
        assert "missing there (allowed: a folder of `localizer run --record`)" in refused
        assert (f"sim-bridge rerun {tmp_path}" in refused) is (folder == tmp_path)


def test_a_changed_recording_differs(recording: Path, tmp_path: Path) -> None:
    changed = tmp_path / "changed"
    with closing(FrameRecorder(changed, EXPERIMENT)) as recorder:
        for frame in recorded_frames(recording):
            frame.depths_m[2] += 1e-12
            recorder.put(frame)
    rows = json.loads(_run("rerun", str(changed), "--json", exit_code=1))
    assert rows[0]["differing"] == 0 and rows[1]["differing"] > 0 and rows[1]["largest_mm"] < 1e-6


def test_a_recording_becomes_a_table_with_what_boards_measured(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "poses.csv"
    _run("track", str(recording), "--out", str(out))
    rows, stamps_ns = _rows(out), [frame.stamp_ns for frame in recorded_frames(recording)]
    assert len(rows) == 2 * (RECORDED - 1)
    for row in rows:
        k = int(row["frame"])
        assert float(row["depth_m"]) == pytest.approx(0.3 + 1e-4 * k) and int(row["stamp_ns"]) == stamps_ns[k]


def test_a_recording_that_was_cut_counts_as_far_as_it_goes(recording: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut"
    cut.mkdir()
    (cut / "experiment.toml").write_bytes((recording / "experiment.toml").read_bytes())
    whole = (recording / FRAMES).read_bytes()
    (cut / FRAMES).write_bytes(whole[: int(0.6 * len(whole))])
    done = CliRunner().invoke(cli, ["rerun", str(cut), "--json"])
    assert done.exit_code == 1 and f"{cut / FRAMES}: was cut, and ends after " in done.stderr
    assert all(10 <= row["poses"] < RECORDED - 1 and row["differing"] == 0 for row in json.loads(done.stdout))
    done = CliRunner().invoke(cli, ["track", str(cut), "--out", str(tmp_path / "poses.csv")])
    assert done.exit_code == 1 and f"{cut / FRAMES}: was cut, and ends after " in done.stderr
    assert 20 <= len(_rows(tmp_path / "poses.csv")) < 2 * (RECORDED - 1)
    (cut / FRAMES).write_bytes(whole[:100])
    assert "no recording of frames" in str(CliRunner().invoke(cli, ["rerun", str(cut)]).exception)


def test_a_disk_that_vanishes_or_blocks_ends_the_recording_and_not_the_poses(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A USB disk is pulled out after five frames; another one stops answering then, and `close` gives it up."""

    def free_bytes(folder: Path) -> int:
        if not next(frames, False):
            shutil.rmtree(folder, ignore_errors=True)
        return disk_free(folder)

    frames = iter([True] * 5)
    published = _localize(tmp_path / "pulled", free_bytes=free_bytes)
    assert len(published) == 2 * (RECORDED - 1) and f"{tmp_path / 'pulled'}: No such file or directory" in caplog.text
    answers, calls = threading.Event(), itertools.count()

    def blocking(folder: Path) -> int:
        if next(calls) >= 5:
            answers.wait(60.0)
        return 10**12

    recorder = FrameRecorder(tmp_path / "stuck", EXPERIMENT, free_bytes=blocking, patience_s=0.1)
    frame = RecordedFrame(np.zeros(EXPERIMENT.camera.size_px[::-1], np.uint8), 0, 0)
    for _ in range(200):  # with a disk that is waited for, this never ends
        recorder.put(frame)
    recorder.close()
    answers.set()
    assert "stuck ends: the disk is too slow, or does not answer" in caplog.text
    assert "the disk does not answer; its last frames and its end are missing" in caplog.text


def test_a_recording_of_a_disk_that_was_too_slow_says_that_frames_are_missing(tmp_path: Path) -> None:
    """All that was waiting then is written, in order, and read again."""
    answers = threading.Event()

    def slow(folder: Path) -> int:
        answers.wait()
        return 10**12

    recorder = FrameRecorder(tmp_path / "slow", EXPERIMENT, free_bytes=slow, patience_s=60.0)
    pixels = np.zeros(EXPERIMENT.camera.size_px[::-1], np.uint8)
    for k in range(200):
        recorder.put(RecordedFrame(pixels, k, k))
    answers.set()
    recorder.close()
    assert "the disk is too slow" in recorder.failure
    damage = list[str]()
    stamps_ns = [frame.stamp_ns for frame in recorded_frames(tmp_path / "slow", damage)]
    assert stamps_ns == list(range(len(stamps_ns))) and 0 < len(stamps_ns) < 200
    assert f"was cut, and ends after {len(stamps_ns)} frames" in damage[0]


def test_frames_that_could_not_be_read_again_are_not_recorded(tmp_path: Path) -> None:
    large = load_experiment("pool", ["camera.size_px=[8192,8192]", "camera.centre_px=[4095.5,4095.5]"])
    with pytest.raises(ConfigError, match=r"frames of camera\.size_px 8192x8192 are larger than what can be read again"):
        FrameRecorder(tmp_path / "large", large)
    assert not list(tmp_path.iterdir())


def test_a_recording_without_frames_is_not_kept_and_not_the_same(tmp_path: Path) -> None:
    """A station that was not there must not cost the name of the folder. A killed process leaves one without frames."""
    for _ in range(2):
        FrameRecorder(tmp_path / "empty", EXPERIMENT).close()
        assert not list(tmp_path.iterdir())
    killed = FrameRecorder(tmp_path / "killed", EXPERIMENT)
    (tmp_path / "killed").rename(tmp_path / "empty")
    killed.close()
    assert "holds no frame" in str(CliRunner().invoke(cli, ["rerun", str(tmp_path / "empty")]).exception)


def test_a_full_disk_ends_the_recording_and_not_the_poses(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    room = iter([10**12] * 5)
    published = _localize(tmp_path / "full", free_bytes=lambda _: next(room, 0))
    assert len(published) == 2 * (RECORDED - 1)
    assert len(list(recorded_frames(tmp_path / "full"))) == 5
    assert "ends after 5 frames: less than recording.stop_video_below_gb" in caplog.text
    with pytest.raises(ConfigError, match="is there already"):
        FrameRecorder(tmp_path / "full", EXPERIMENT)

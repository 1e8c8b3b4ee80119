"""Errors that were put in on purpose must come out of the tables: pictures, logs, videos of the pool."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from groundstation.logs.recorder import Recorder
from localizer.__main__ import cli
from localizer.detection.image_regions import BAYER_TO_BGR
from localizer.evaluation.metrics import GroundTruthTrajectory, PoseRow, PublishedPose, pose_rows
from shoal.config.experiment import load_experiment
from shoal.frames import Array, wrap
from shoal.messages import topics
from shoal.messages.codec import Header, encode
from shoal.messages.messages import Pose, Track, Truth
from tests.localizer.scene import Scene

MS = 1_000_000
SIGMA = np.array([0.002, 0.004, 0.01])  # m, m, rad


def pose(x_m: float, y_m: float, yaw_rad: float, track: Track = Track.MARKER, verified: bool = True) -> Pose:
    return Pose(x_m, y_m, yaw_rad, np.diag(SIGMA**2), track, verified)


def rows_by_subject(rows: list[PoseRow]) -> dict[str, PoseRow]:
    return {row.subject: row for row in rows}


def still(*place: float) -> GroundTruthTrajectory:
    return GroundTruthTrajectory(np.array([0, 400 * MS]), np.array([place, place]))


def line(start: Array, end: Array, seconds: float = 0.4) -> GroundTruthTrajectory:
    return GroundTruthTrajectory(np.array([0, round(seconds * 1e9)]), np.array([start, end]))


# --- arithmetic


def test_known_errors_give_known_figures() -> None:
    """(3, 4) mm and 0.01 rad off, then nothing: RMS 5 / sqrt 2; e' P^-1 e = (3/2)^2 + (4/4)^2 + 1 = 4.25, then 0."""
    trajectory = line(np.array([0.0, 0.0, 0.0]), np.array([0.4, 0.2, 0.2]))
    poses = [
        PublishedPose(1, 100 * MS, pose(0.103, 0.054, 0.06)),
        PublishedPose(1, 300 * MS, pose(0.3, 0.15, 0.15)),
    ]
    row = rows_by_subject(pose_rows(poses, {1: trajectory}))["all but lost"]
    assert (row.poses, row.swapped, row.unflagged) == (2, 0, 0)
    assert row.rms_mm == pytest.approx(5.0 / np.sqrt(2.0)) and row.max_mm == pytest.approx(5.0)
    assert row.rms_deg == pytest.approx(np.degrees(0.01) / np.sqrt(2.0))
    assert row.nees == pytest.approx(4.25 / 2.0)


@pytest.mark.long
def test_the_band_of_the_nees_holds_for_errors_of_the_stated_size_and_not_for_others() -> None:
    """By simulation: 100 sets of 40 errors drawn from the covariance; about 95 % of their means lie in the band."""
    random = np.random.default_rng(3)
    trajectory = {1: still(0.0, 0.0, 0.0)}

    def inside(scale: float) -> float:
        hits = 0
        for _ in range(100):
            errors = scale * random.normal(0.0, SIGMA, (40, 3))
            row = pose_rows([PublishedPose(1, 0, pose(*e)) for e in errors], trajectory)[-1]
            hits += row.nees_low <= row.nees <= row.nees_high
        return hits / 100

    assert 0.88 <= inside(1.0) <= 0.99
    assert inside(1.5) < 0.05
    assert inside(0.5) < 0.05


def test_headings_are_compared_across_the_seam() -> None:
    trajectory = line(np.array([0.0, 0.0, np.pi - 0.1]), np.array([0.0, 0.0, -np.pi + 0.1]))  # 0.2 rad on, not 6.1 back
    poses = [PublishedPose(1, 200 * MS, pose(0.0, 0.0, wrap(np.pi + 0.01))), PublishedPose(1, 0, pose(0.0, 0.0, np.pi - 0.09))]
    row = pose_rows(poses, {1: trajectory})[-1]
    assert row.max_deg == pytest.approx(np.degrees(0.01)) == row.rms_deg


def test_a_swap_is_counted_and_doubly_if_it_was_not_flagged() -> None:
    trajectories = {1: still(0.0, 0.0, 0.0), 2: still(1.0, 0.0, 0.0)}
    poses = [
        PublishedPose(1, 0, pose(0.0, 0.0, 0.0)), PublishedPose(2, 0, pose(1.0, 0.0, 0.0)),
        PublishedPose(1, MS, pose(0.9, 0.0, 0.0)), PublishedPose(2, MS, pose(0.1, 0.0, 0.0, Track.KCF, verified=False)),
        PublishedPose(2, 2 * MS, pose(0.0, 0.0, 0.0, Track.LOST)),
    ]  # fmt: skip
    rows = rows_by_subject(pose_rows(poses, trajectories))
    assert {subject: (row.poses, row.swapped, row.unflagged) for subject, row in rows.items()} == {
        "robot 1": (2, 1, 1), "robot 2": (2, 1, 0), "marker": (3, 1, 1), "kcf": (1, 1, 0), "lost": (1, 1, 1),
        "all but lost": (4, 2, 1),
    }  # fmt: skip


def test_where_the_truth_has_a_gap_or_ends_nothing_is_made_up() -> None:
    trajectory = GroundTruthTrajectory(np.array([0, 100 * MS, 2000 * MS]), np.zeros((3, 3)))
    instants = (-1, 0, 50, 100, 101, 1999, 2000, 2001)
    row = pose_rows([PublishedPose(1, at * MS, pose(0.0, 0.0, 0.0)) for at in instants], {1: trajectory})[-1]
    assert row.poses == 4
    assert pose_rows([PublishedPose(3, 0, pose(0.0, 0.0, 0.0))], {1: trajectory}) == []


def test_where_the_truth_is_not_a_number_it_is_not_known() -> None:
    """Motion capture lost the robot from 100 to 200 ms: these poses do not count, and none in between is made up."""
    trajectory = GroundTruthTrajectory(np.array([0, 50, 100, 150, 200]) * MS, np.zeros((5, 3)))
    trajectory.pose[2:4] = np.nan
    poses = [PublishedPose(1, at * MS, pose(0.004, 0.0, 0.0)) for at in (0, 50, 75, 100, 125, 150, 175, 200)]
    row = pose_rows(poses, {1: trajectory})[-1]
    assert row.poses == 3 and row.rms_mm == pytest.approx(4.0)


def test_a_matrix_that_is_no_covariance_leaves_the_nees_out() -> None:
    bad = replace(pose(0.003, 0.0, 0.0), covariance=np.diag([1e-6, -1e-6, 1e-6]))
    row = pose_rows([PublishedPose(1, 0, bad)], {1: still(0.0, 0.0, 0.0)})[-1]
    assert np.isnan(row.nees) and row.rms_mm == pytest.approx(3.0)


# --- a run's log


def record(path: Path, steps: int = 100) -> None:
    """Two robots on lines; robot 2 is always found 6 mm too far in x, robot 1 never."""
    recorder = Recorder(path, "", {})
    for k in range(steps):
        stamp_ns = k * 50 * MS
        eta = np.array([[0.01 * k, 0.0, 0.3, 0.0], [0.0, 1.0, 0.3, 0.02 * k]])
        truth = Truth((1, 2), eta, np.zeros((2, 4)), np.zeros((2, 3)), np.zeros((2, 4)))
        recorder.put(topics.TRUTH, "pool7/sim/truth", Header(5, k + 1, stamp_ns), encode(truth, stamp_ns), stamp_ns)
        for robot, error_m in ((1, 0.0), (2, 0.006)):
            published = pose(eta[robot - 1, 0] + error_m, eta[robot - 1, 1], eta[robot - 1, 3])
            key = f"pool7/{topics.POSE.key(robot)}"
            recorder.put(topics.POSE, key, Header(6, k + 1, stamp_ns), encode(published, stamp_ns), stamp_ns)
    recorder.close()


def test_a_log_is_judged_by_the_truth_in_it(tmp_path: Path) -> None:
    record(tmp_path / "run.mcap")
    out = tmp_path / "rows.json"
    done = CliRunner().invoke(cli, ["evaluate", str(tmp_path / "run.mcap"), "--json", str(out)])
    assert done.exit_code == 0, done.output
    assert done.output.splitlines()[0].split()[:3] == ["subject", "poses", "rms_mm"]
    rows = {row["subject"]: row for row in json.loads(out.read_text())}
    assert set(rows) == {"robot 1", "robot 2", "marker", "all but lost"}
    assert rows["robot 1"]["rms_mm"] == pytest.approx(0.0, abs=1e-9)
    assert rows["robot 2"]["rms_mm"] == pytest.approx(6.0)
    assert rows["robot 2"]["nees"] == pytest.approx(9.0)
    assert rows["all but lost"]["rms_mm"] == pytest.approx(6.0 / np.sqrt(2.0))


def test_a_log_that_was_cut_counts_as_far_as_it_goes(tmp_path: Path) -> None:
    whole, cut = tmp_path / "whole.mcap", tmp_path / "run.mcap"
    record(whole, steps=2000)
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    done = CliRunner().invoke(cli, ["evaluate", str(cut)])
    assert done.exit_code == 1, (done.output, done.exception)
    assert "robot 2" in done.stdout and f"{cut}: was cut, and what lies behind is not evaluated" in done.stderr


# --- a video of the pool


def pool_video(tmp_path: Path) -> tuple[Path, Path]:
    """12 frames of two robots under water, and the truth about them, robot 2's 8 mm too far in y."""
    experiment = load_experiment("pool")
    scene = Scene(experiment)
    writer = cv2.VideoWriter(str(tmp_path / "pool.avi"), cv2.VideoWriter.fourcc(*"HFYU"), 20.0, experiment.camera.size_px)
    lines = ["robot,frame,yaw_rad,x_m,y_m,depth_m"]
    for k in range(12):
        eta = {1: np.array([0.45 + 0.005 * k, 0.1, 0.26, 0.7]), 2: np.array([-0.4, -0.05 - 0.003 * k, 0.34, 0.05 * k])}
        writer.write(cv2.cvtColor(scene.frame(eta), BAYER_TO_BGR))
        for robot, (x, y, z, yaw) in eta.items():
            lines.append(f"{robot},{k},{yaw},{x},{y + (0.008 if robot == 2 else 0.0)},{z}")
    writer.release()
    (tmp_path / "truth.csv").write_text("\n".join(lines) + "\n")
    return tmp_path / "pool.avi", tmp_path / "truth.csv"


@pytest.mark.long
def test_a_video_of_the_pool_is_localized_again_with_and_without_markers(tmp_path: Path) -> None:
    video, truth = pool_video(tmp_path)
    out = tmp_path / "rows.json"
    command = ["evaluate", str(video), "--truth", str(truth), "--experiment", "pool", "--json", str(out)]
    done = CliRunner().invoke(cli, command)
    assert done.exit_code == 0, (done.output, done.exception)
    rows = {row["subject"]: row for row in json.loads(out.read_text())}
    assert rows["robot 1"]["rms_mm"] < 1.5 and rows["robot 1"]["rms_deg"] < 0.5
    assert rows["robot 2"]["rms_mm"] == pytest.approx(8.0, abs=1.5)
    assert rows["marker"]["poses"] == 22, "of twelve pictures; nobody is believed to be seen in the first"

    with truth.open("a") as more:
        more.write("1,12,0,0,0,0.3\n")
    done = CliRunner().invoke(cli, command)
    assert done.exit_code == 1 and f"{truth}: tells of 13 frames, and the video has 12" in done.stderr
    command += ["--frames", "12"]

    starts = ["--set", "robots.0.start=[0.45,0.1,0.26,0.7]", "--set", "robots.1.start=[-0.4,-0.05,0.34,0.0]"]
    done = CliRunner().invoke(cli, [*command, "--no-marker", *starts])
    assert done.exit_code == 0, (done.output, done.exception)
    rows = {row["subject"]: row for row in json.loads(out.read_text())}
    assert "marker" not in rows and rows["kcf"]["poses"] > 18
    assert rows["robot 1"]["rms_mm"] < 3.0


# --- what cannot be


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["nowhere.mp4"], "a video needs --truth"),
        (["nowhere.mcap"], "nowhere.mcap: No such file"),
        (["nowhere.mp4", "--truth", "good.txt"], "a video needs --truth FILE and --experiment"),
        (["nowhere.mp4", "--truth", "good.txt", "--experiment", "pool"], "nowhere.mp4: no such file"),
        (["film.avi", "--truth", "nowhere.txt", "--experiment", "pool"], "nowhere.txt"),
        (["film.avi", "--truth", "good.txt", "--experiment", "pool"], "good.txt: the first line lacks frame, robot"),
        (["film.avi", "--truth", "robot9.csv", "--experiment", "pool"], "robot 9: not in experiment 'pool'"),
        (["film.avi", "--truth", "short.csv", "--experiment", "pool"], "short.csv: line 2: 5 values, but the first line"),
        (["film.avi", "--truth", "half.csv", "--experiment", "pool"], "half.csv: line 3, column frame: '0.5' must be a whole"),
        (["film.avi", "--truth", "word.csv", "--experiment", "pool"], "word.csv: line 2, column x_m: 'far' is no number"),
        (["film.avi", "--truth", "nan.csv", "--experiment", "pool"], "nan.csv: line 2, column robot: 'nan' must be a whole"),
        (["film.avi", "--truth", "marked.csv", "--experiment", "pool"], "film.avi: 480x400, but camera.size_px of experiment"),
        (["empty.mcap"], "empty.mcap"),
    ],
)
def test_a_recording_or_truth_that_cannot_be_is_explained(
    arguments: list[str], complaint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("good.txt").write_text("X1\tY1\tProbId1\n5\t6\tNaN\n7\t8\tNaN\n")
    Path("robot9.csv").write_text("frame,robot,x_m,y_m,yaw_rad\n0,9,0,0,0\n")
    Path("short.csv").write_text("frame,robot,x_m,y_m,yaw_rad,depth_m\n0,1,0,0,0\n")
    names = "frame,robot,x_m,y_m,yaw_rad\n"
    Path("half.csv").write_text(f"{names}0,1,0,0,0\n0.5,1,0,0,0\n")
    Path("word.csv").write_text(f"{names}0,1,far,0,0\n")
    Path("nan.csv").write_text(f"{names}0,nan,0,0,0\n")
    Path("marked.csv").write_text(f"\ufeff{names}0,1,,inf,nan\n", encoding="utf-8")  # as spreadsheets save it
    writer = cv2.VideoWriter("film.avi", cv2.VideoWriter.fourcc(*"HFYU"), 30.0, (480, 400))
    writer.write(np.zeros((400, 480, 3), np.uint8))
    writer.release()
    Path("empty.mcap").write_bytes(b"")
    done = CliRunner().invoke(cli, ["evaluate", *arguments])
    assert complaint in str(done.exception), (done.output, done.exception)

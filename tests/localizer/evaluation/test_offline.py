"""`localizer track`: a video of two robots becomes a table of poses, in one go and in two."""

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from localizer.__main__ import cli
from localizer.detection.image_regions import BAYER_TO_BGR
from tests.localizer.scene import Scene
from wire.config.experiment import load_experiment
from wire.frames import Array

pytestmark = pytest.mark.long

FRAMES = 10


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    experiment, path = load_experiment("pool"), tmp_path_factory.mktemp("track") / "pool.avi"
    scene = Scene(experiment)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"HFYU"), 20.0, experiment.camera.size_px)
    for k in range(FRAMES):
        writer.write(cv2.cvtColor(scene.frame({1: _place(k), 2: np.array([-0.4, 0.1, 0.3, 1.0])}), BAYER_TO_BGR))
    writer.release()
    return path


def _place(frame: int) -> Array:
    return np.array([0.4 + 0.01 * frame, 0.1, 0.3, 0.7])


def _track(video: Path, out: Path, *options: str) -> None:
    done = CliRunner().invoke(cli, ["track", str(video), "--experiment", "pool", "--out", str(out), *options])
    assert done.exit_code == 0, (done.output, done.exception)


def test_the_table_has_a_row_for_each_robot_and_frame(video: Path, tmp_path: Path) -> None:
    _track(video, tmp_path / "poses.csv")
    with (tmp_path / "poses.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(int(row["frame"]), int(row["robot"])) for row in rows] == [(k, i) for k in range(1, FRAMES) for i in (1, 2)]
    for row in rows[::2]:
        assert float(row["x_m"]) == pytest.approx(_place(int(row["frame"]))[0], abs=2e-3)
        assert row["track"] == "marker" and row["identity_verified"] == "1" and float(row["sigma_x_m"]) < 0.01


def test_a_run_that_was_cut_goes_on_to_the_same_table(video: Path, tmp_path: Path) -> None:
    whole, cut = tmp_path / "whole.csv", tmp_path / "cut.csv"
    _track(video, whole)
    text = whole.read_text()
    cut.write_text(text[: int(0.55 * len(text))])  # in the middle of a row
    _track(video, cut, "--resume")
    assert cut.read_text() == text


def test_a_table_is_not_overwritten(video: Path, tmp_path: Path) -> None:
    out = tmp_path / "poses.csv"
    out.write_text("kept\n")
    done = CliRunner().invoke(cli, ["track", str(video), "--experiment", "pool", "--out", str(out)])
    assert "is there already" in str(done.exception)
    done = CliRunner().invoke(cli, ["track", str(video), "--experiment", "pool", "--out", str(out), "--resume"])
    assert "its columns are not" in str(done.exception) and out.read_text() == "kept\n"

"""The correlation filter follows objects in plain videos, and errors that were put into their truth are found again."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from localizer.detection.image_regions import Pixels
from shoal.frames import Array
from tests.localizer.plain_video.idtracker import PixelRow, evaluate_plain
from tests.localizer.plain_video.single_object import SingleObjectTracker


def textured(seed: int, size: int) -> Pixels:
    coarse = np.random.default_rng(seed).integers(30, 220, (6, 6, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)


def places(frame: int) -> tuple[Array, Array]:
    """Two look-alikes on ways of their own, whole pixels."""
    return np.array([80.0 + 2 * frame, 100.0 + frame]), np.array([400.0 - 2 * frame, 300.0])


def plain_video(path: Path, frames: int) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"HFYU"), 30.0, (480, 400))
    floor = np.asarray(cv2.resize(textured(1, 100), (480, 400)), dtype=np.uint8) // 3 + 60
    for k in range(frames):
        picture = floor.copy()
        for x, y in places(k):
            left, top = int(x) - 20, int(y) - 20
            picture[top : top + 41, left : left + 41] = textured(2, 41)
        writer.write(picture)
    writer.release()
    return path


def idtracker(path: Path, rows: list[list[Array]]) -> Path:
    """1-based, a probability behind each target, as idTracker writes."""
    count = len(rows[0])
    head = "\t".join(f"X{i + 1}\tY{i + 1}\tProbId{i + 1}" for i in range(count))
    lines = ["\t".join(f"{p[0] + 1:.2f}\t{p[1] + 1:.2f}\tNaN" for p in row) for row in rows]
    path.write_text("\n".join([head, *lines]) + "\n")
    return path


def evaluate_video(tmp_path: Path, rows: list[list[Array]]) -> dict[str, PixelRow]:
    video, truth = plain_video(tmp_path / "v.avi", len(rows)), idtracker(tmp_path / "truth.txt", rows)
    return {row.subject: row for row in evaluate_plain(video, truth, 64.0)}


def test_targets_are_followed_and_an_error_of_the_truth_is_found_again(tmp_path: Path) -> None:
    """Target 1 as it is; of target 2 the file is (3, 4) px wrong but for the first frame, from which it is shown."""
    rows = [[places(k)[0], places(k)[1] + (np.array([3.0, 4.0]) if k else 0.0)] for k in range(40)]
    result = evaluate_video(tmp_path, rows)
    assert result["target 1"].median_px < 0.3 and result["target 1"].max_px < 0.8
    assert result["target 2"].median_px == pytest.approx(5.0, abs=0.3)
    assert [result[t].failures for t in ("target 1", "target 2")] == [0, 0]
    assert result["target 1"].frames == 39 and result["target 1"].median_ms > 0.0


def test_a_video_of_many_targets_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two targets, each followed as if it were alone."""
    video, opened = plain_video(tmp_path / "v.avi", 20), [0]
    both = idtracker(tmp_path / "both.txt", [list(places(k)[:2]) for k in range(20)])
    alone = [idtracker(tmp_path / f"{i}.txt", [[places(k)[i]] for k in range(20)]) for i in (0, 1)]
    open_video = cv2.VideoCapture

    def counted(*args: Any) -> Any:
        opened[0] += 1
        return open_video(*args)

    monkeypatch.setattr(cv2, "VideoCapture", counted)
    together = evaluate_plain(video, both, 64.0)
    assert opened[0] == 2, "its index, and its pictures"
    for row, truth in zip(together, alone, strict=True):
        (single,) = evaluate_plain(video, truth, 64.0)
        assert (row.frames, row.median_px, row.max_px) == (single.frames, single.median_px, single.max_px)


def test_a_failure_is_counted_once_and_the_target_shown_again(tmp_path: Path) -> None:
    """From frame 30 on the truth slides off the animal by 8 px a frame: in the fifth it is half a box away."""
    rows = [[places(k)[0] + np.array([0.0, 8.0 * max(k - 30, 0)])] for k in range(39)]
    row = evaluate_video(tmp_path, rows)["target 1"]
    assert row.frames == 38 and row.failures == 1
    assert row.failures_per_1000 == pytest.approx(1000 / 38)


def test_a_leap_of_the_truth_itself_is_no_failure(tmp_path: Path) -> None:
    """From frame 20 on the truth is the other animal, and after an unknown frame the first one again: both times the target is
    shown anew, and that frame does not count."""
    rows = [[places(k)[20 <= k < 30]] for k in range(40)]
    rows[30] = [np.full(2, np.nan)]
    row = evaluate_video(tmp_path, rows)["target 1"]
    assert row.frames == 36 and row.failures == 0 and row.max_px < 1.0


def test_a_turn_that_nothing_confirms_any_more_ends() -> None:
    """An animal turns by 0.1 rad a picture, then a sheet without texture is laid over it."""
    look, floor = textured(2, 81), np.full((200, 200, 3), 90, np.uint8)

    def picture(turn_rad: float) -> Pixels:
        about = cv2.getRotationMatrix2D((40.0, 40.0), -np.degrees(turn_rad), 1.0)
        there = floor.copy()
        there[60:141, 60:141] = cv2.warpAffine(look, about, (81, 81), borderMode=cv2.BORDER_REFLECT)
        return there

    follower = SingleObjectTracker(picture(0.0), np.array([100.0, 100.0]), 64.0)
    turns = [follower.step(picture(0.1 * k))[0][2] for k in range(1, 40)]
    assert turns[-1] == pytest.approx(3.9, abs=0.3)
    covered = [follower.step(floor)[0][2] for _ in range(40)]
    assert abs(covered[-1] - turns[-1]) < 1.0, "at its old rate it turns by 4 rad"

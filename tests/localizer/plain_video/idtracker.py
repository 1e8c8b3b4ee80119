"""An object in a plain video of an unknown camera, followed in pixels, beside the places that idTracker has found."""

import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from localizer.detection.image_regions import Pixels
from localizer.sources.video import VideoReader
from shoal.frames import Array
from tests.localizer.plain_video.single_object import SingleObjectTracker


@dataclass(frozen=True)
class PixelRow:
    """One target followed in a plain video. A failure is an error of more than half the box; the tracker is then started
    anew."""

    subject: str
    frames: int  # with a known place
    median_px: float
    p95_px: float
    max_px: float
    failures: int
    failures_per_1000: float
    median_ms: float
    p95_ms: float


def pixel_row(subject: str, errors_px: Sequence[float], failures: int, times_ms: Sequence[float]) -> PixelRow:
    """A row from the errors of all frames, failures included."""
    errors, times = np.array(errors_px), np.array(times_ms)
    return PixelRow(
        subject, len(errors),
        float(np.median(errors)), float(np.quantile(errors, 0.95)), float(np.max(errors)),
        failures, 1e3 * failures / len(errors),
        float(np.median(times)), float(np.quantile(times, 0.95)),
    )  # fmt: skip


def read_idtracker(path: Path) -> list[Array]:
    """Places (frames, 2) in pixels of each target of idTracker's text: a line of names, then X, Y and a probability per
    target and frame. Its first pixel is 1; ours is 0. Unknown places are NaN."""
    columns = np.loadtxt(path, skiprows=1, ndmin=2)
    return [columns[:, first : first + 2] - 1.0 for first in range(0, columns.shape[1] - 1, 3)]


class _Target:
    """One target of a plain video, with its true places (frames, 2) px, and the errors of following it."""

    def __init__(self, number: int, places_px: Array, box_px: float) -> None:
        self.number = number
        self._places_px, self._box_px = places_px, box_px
        self._follower: SingleObjectTracker | None = None
        self._errors_px: list[float] = []
        self._times_ms: list[float] = []
        self._failures = 0

    def step(self, frame: int, picture: Pixels) -> None:
        """Follow the target into the next picture. Farther off than half the box is a failure: the tracker starts anew at
        the truth. So it does, but not as a failure, where the truth itself leaps as far, or comes back from a gap there."""
        place = self._places_px[frame]
        is_known = bool(np.all(np.isfinite(place)))
        reach_px = self._box_px / 2.0
        if self._follower is None:
            self._follower = SingleObjectTracker(picture, place, self._box_px) if is_known else None
            return
        started = time.perf_counter()
        pose, _ = self._follower.step(picture)
        self._times_ms.append(1e3 * (time.perf_counter() - started))
        if not is_known:
            return
        error_px = float(np.linalg.norm(pose[:2] - place))
        has_lost_it = error_px > reach_px
        truth_is_steady = bool(np.linalg.norm(place - self._places_px[frame - 1]) <= reach_px)  # False if that was not known
        if truth_is_steady or not has_lost_it:
            self._errors_px.append(error_px)
            self._failures += has_lost_it
        if has_lost_it:
            self._follower = SingleObjectTracker(picture, place, self._box_px)

    def row(self) -> PixelRow:
        """The figures of a target that was seen twice."""
        return pixel_row(f"target {self.number}", self._errors_px, self._failures, self._times_ms)


def evaluate_plain(path: Path, truth: Path, box_px: float, limit: int | None = None) -> list[PixelRow]:
    """Follow each target of an idTracker file from its first known place on, all in one pass through the video."""
    places = read_idtracker(truth)
    targets = [_Target(number, places_px, box_px) for number, places_px in enumerate(places, start=1)]
    with closing(VideoReader(path)) as video:
        for picture in video.pictures(limit or len(places[0])):
            for target in targets:
                target.step(picture.number, picture.pixels)
    return [target.row() for target in targets]

"""One target followed through pictures, by the same rule for every tracker: ours runs it here, a peer in its own environment.

Needs numpy and some OpenCV, nothing else of ours.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.harness import Row

Picture = NDArray[np.uint8]
Place = tuple[float, float]
Step = Callable[[Picture], Place | None]  # the target's centre in the next picture, px; None if it cannot say
Begin = Callable[[Picture, Place], Step]  # shown the target once


@dataclass(frozen=True)
class Task:
    """Pictures, where the target truly is in each, and how large a square around it a tracker looks at."""

    case: str
    pictures: str  # a video, or an array (frames, height, width) of Bayer RGGB in a .npy file
    places_px: list[Place]
    window_px: float

    def as_dict(self) -> dict[str, Any]:
        """The row as a dictionary for JSON."""
        return asdict(self)


def pictures(task: Task) -> Iterator[Picture]:
    """BGR (height, width, 3)."""
    if task.pictures.endswith(".npy"):
        for frame in np.load(task.pictures, mmap_mode="r"):
            yield np.asarray(cv2.cvtColor(np.asarray(frame), cv2.COLOR_BayerRGGB2BGR), dtype=np.uint8)
        return
    video = cv2.VideoCapture(task.pictures)
    try:
        while (read := video.read())[0]:
            yield np.asarray(read[1], dtype=np.uint8)
    finally:
        video.release()


def follow(task: Task, subject: str, begin: Begin) -> list[Row]:
    """Follow the target. Farther off than half the window, or without an answer, it has failed and is shown the target again;
    the error of that picture counts as well, where there is one. Showing it is not in the time."""
    step: Step | None = None
    errors_px, updates_ms, failures = [], [], 0
    for picture, place in zip(pictures(task), task.places_px, strict=False):
        if step is None:
            step = begin(picture, place)
            continue
        start_ns = time.perf_counter_ns()
        place_px = step(picture)
        updates_ms.append((time.perf_counter_ns() - start_ns) * 1e-6)
        error_px = float("inf") if place_px is None else float(np.hypot(place_px[0] - place[0], place_px[1] - place[1]))
        errors_px += [error_px] if place_px is not None else []
        if error_px > task.window_px / 2.0:
            failures += 1
            step = begin(picture, place)
    mean_ms = sum(updates_ms) / len(updates_ms)  # a tracker that learns from every fourth picture has two kinds of updates
    rate = 1000.0 * failures / len(updates_ms)
    return [
        Row.of("localizer", task.case, subject, "ms per update", updates_ms),
        Row("localizer", task.case, subject, "ms per update, mean", mean_ms, mean_ms, mean_ms, len(updates_ms)),
        Row.of("localizer", task.case, subject, "px off", errors_px),
        Row("localizer", task.case, subject, "failures per 1,000", rate, rate, rate, len(updates_ms)),
    ]

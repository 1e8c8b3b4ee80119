"""Stand-ins for the tests of sources: a clock moved by hand, and pictures that differ in brightness."""

from typing import Any

import numpy as np

from localizer.detection.image_regions import Pixels
from localizer.sources.base import CapturedFrame
from shoal.bus.bus import Received

MS = 1_000_000


class HandClock:
    """Moves only when told to, or when somebody sleeps by it."""

    waits = False

    def __init__(self) -> None:
        self.ns = 1_000_000_000_000

    def now_ns(self) -> int:
        return self.ns

    def arrival_ns(self, stamp_ns: int) -> int:
        return self.now_ns()

    def instant_ns(self, received: Received[Any]) -> int:
        raise NotImplementedError

    def sleep(self, seconds: float) -> None:
        self.ns += round(seconds * 1e9)


def level(captured: CapturedFrame | None) -> int:
    """Which picture it was: its brightness."""
    assert captured is not None
    return round(float(captured.pixels.mean()))


def flat(value: int, height: int = 48, width: int = 64) -> Pixels:
    return np.full((height, width, 3), value, np.uint8)

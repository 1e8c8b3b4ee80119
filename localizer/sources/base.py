"""A picture with its times, and what a source of pictures is. Pure; localizer/sources/factory.py opens one.

Whatever the source, the localizer sees raw Bayer RGGB and the instant of the middle of the exposure on its own clock. A
colour picture is turned back into the mosaic it once was (0.5 ms at 1280 x 960): so there is one way through the core, the
one that is tested most, and only the regions around robots are ever demosaiced.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.detection.image_regions import BAYER_TO_BGR, Pixels
from wire.process.runtime import Stop

SILENT_FRAMES = 5  # periods without a picture: then the camera is absent, and that is said again and again
_HICCUP_S = 0.1  # of a busy computer: nobody is absent for so short a time, however fast the camera


@dataclass(frozen=True, eq=False)
class CapturedFrame:
    """One picture (height, width) uint8 raw Bayer RGGB, and its times."""

    pixels: Pixels
    stamp_ns: int  # middle of the exposure on the camera's clock: poses carry it on, logs are ordered by it
    instant_ns: int  # the same on the localizer's own clock: what the filter runs on and ages are counted from
    arrived_ns: int  # own clock
    dropped: int = 0  # pictures lost on the way or overtaken by newer ones, since the source was opened
    stamped: bool = True  # the camera said when; False: guessed from the arrival
    inputs_up_to_ns: int | None = None  # lockstep: the newest robots' states that count


class FrameSource(Protocol):
    """A camera, or what stands in for one."""

    @property
    def silent_after_s(self) -> float:
        """Without a picture for so long, it says that there is none."""

    def frames(self, stop: Stop) -> Iterator[CapturedFrame | None]:
        """The newest picture whenever there is a new one; None after each `silent_after_s` without. Ends when told to stop, or
        when no more can come. A source that fails recovers by itself and keeps yielding None meanwhile."""

    @property
    def trouble(self) -> str:
        """Why no picture comes, as far as it is known."""

    def close(self) -> None:
        """Let go of the camera."""


def silent_after_s(rate_hz: float) -> float:
    """When a camera of this rate is absent."""
    return max(SILENT_FRAMES / rate_hz, _HICCUP_S)


# Files that count as pictures, wherever pictures are read from files.
SUFFIXES = (".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp")


def as_bayer(picture: NDArray[Any]) -> Pixels | None:
    """A picture as OpenCV reads it, as the RGGB mosaic (height, width) that BAYER_TO_BGR turns back into it.

    One channel is taken to be raw already, as everywhere (a grey picture is its own mosaic, a little softer when it is turned
    into colours); BGR and BGRA lose two colours of three per pixel, as in the camera. None for anything that is not 8 bits
    deep."""
    if picture.dtype != np.uint8:
        return None
    if picture.ndim == 2:
        return np.ascontiguousarray(picture)
    if picture.ndim != 3 or picture.shape[2] not in (3, 4):
        return None
    mosaic = np.empty(picture.shape[:2], np.uint8)
    mosaic[0::2, 0::2] = picture[0::2, 0::2, 2]
    mosaic[0::2, 1::2] = picture[0::2, 1::2, 1]
    mosaic[1::2, 0::2] = picture[1::2, 0::2, 1]
    mosaic[1::2, 1::2] = picture[1::2, 1::2, 0]
    return mosaic


def as_colour(picture: NDArray[Any], grey: bool = False) -> Pixels | None:
    """A picture as OpenCV reads it, as BGR (height, width, 3). One channel is taken to be raw Bayer RGGB, as in `as_bayer`, or
    (`grey`) to be grey. None for anything that is not 8 bits deep."""
    if picture.dtype != np.uint8:
        return None
    if picture.ndim == 2:
        return np.asarray(cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR if grey else BAYER_TO_BGR), dtype=np.uint8)
    if picture.ndim != 3 or picture.shape[2] not in (3, 4):
        return None
    return np.ascontiguousarray(picture[..., :3])

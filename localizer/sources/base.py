"""A captured frame with its times, and the interface of frame sources. Pure; localizer/sources/factory.py opens one.

From every source the localizer gets raw Bayer RGGB and the instant of the middle of the exposure on its own clock. A
colour picture is converted back into a mosaic (0.5 ms at 1280 x 960). So there is one way through the core, and only the
regions around robots are ever demosaiced.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.detection.image_regions import BAYER_TO_BGR, Pixels
from shoal.runtime.runtime import Stop

SILENT_FRAMES = 5  # periods without a frame after which the camera is reported absent, repeatedly
_HICCUP_S = 0.1  # s, least time without a frame before that: a busy computer may pause this long


@dataclass(frozen=True, eq=False)
class CapturedFrame:
    """One frame (height, width) uint8 raw Bayer RGGB, and its times."""

    pixels: Pixels
    stamp_ns: int  # middle of the exposure on the camera's clock; poses carry it, and logs are ordered by it
    instant_ns: int  # the same on the localizer's own clock; the filter uses it, and ages are counted from it
    arrived_ns: int  # arrival, own clock
    dropped: int = 0  # frames lost on the way or replaced by newer ones, since the source was opened
    stamped: bool = True  # the camera gave the stamp; False: it is guessed from the arrival
    inputs_up_to_ns: int | None = None  # stamp of the newest robots' states to use
    session: int = 0  # of the program that sent it: another one may have another clock; 0: this one


class FrameSource(Protocol):
    """A camera or its replacement."""

    @property
    def silent_after_s(self) -> float:
        """Time without a frame after which the source yields None."""

    def frames(self, stop: Stop) -> Iterator[CapturedFrame | None]:
        """The newest frame whenever there is a new one; None after each `silent_after_s` without. Ends when told to stop,
        or when no more can come. A source that fails recovers by itself and keeps yielding None meanwhile."""

    @property
    def trouble(self) -> str:
        """The reason for missing frames, as far as it is known."""

    def close(self) -> None:
        """Release the camera."""


def silent_after_s(rate_hz: float) -> float:
    """Time without a frame after which a camera of this rate is absent."""
    return max(SILENT_FRAMES / rate_hz, _HICCUP_S)


# Suffixes of picture files, for all readers.
SUFFIXES = (".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp")


def as_bayer(picture: NDArray[Any]) -> Pixels | None:
    """Convert a picture as OpenCV reads it to the RGGB mosaic (height, width) that BAYER_TO_BGR turns back into it.

    One channel is taken to be raw already (a grey picture is its own mosaic, a little softer when demosaiced). BGR and
    BGRA lose two colours of three per pixel, as in the camera. None for anything that is not 8 bits deep.
    """
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
    """Convert a picture as OpenCV reads it to BGR (height, width, 3). One channel is raw Bayer RGGB, or grey with `grey`.
    None for anything that is not 8 bits deep."""
    if picture.dtype != np.uint8:
        return None
    if picture.ndim == 2:
        return np.asarray(cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR if grey else BAYER_TO_BGR), dtype=np.uint8)
    if picture.ndim != 3 or picture.shape[2] not in (3, 4):
        return None
    return np.ascontiguousarray(picture[..., :3])

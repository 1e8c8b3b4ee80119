"""Drawing into BGR pictures (height, width, 3) uint8: lines to a 16th of a pixel, dots, crosses, readable text. Pure.

What lies at no pixel (NaN, as points behind the lens) is not drawn.
"""

import cv2
import numpy as np

from localizer.detection.image_regions import Pixels
from shoal.frames import Array

Bgr = tuple[int, int, int]

_FRACTION_BITS = 4  # OpenCV draws in 16ths of a pixel
_FARTHEST_PX = 1e4  # coordinates beyond overflow OpenCV's fixed-point numbers


def polyline(picture: Pixels, pixels: Array, colour: Bgr, thickness: int = 1, closed: bool = False) -> None:
    """Draw a line through pixels (n, 2)."""
    if np.isnan(pixels).any():
        return
    fixed = np.round(np.clip(pixels, -_FARTHEST_PX, _FARTHEST_PX) * 2**_FRACTION_BITS).astype(np.int32)
    cv2.polylines(picture, [fixed], closed, colour, thickness, cv2.LINE_AA, _FRACTION_BITS)


def write(picture: Pixels, text: str, at_px: Array, colour: Bgr, size: float = 0.45) -> None:
    """Write small text, its lower left corner at a pixel (2,), with a shadow that keeps it readable over anything."""
    if np.isnan(at_px).any():
        return
    x, y = _rounded(at_px)
    for ink, shift in (((0, 0, 0), 1), (colour, 0)):
        cv2.putText(picture, text, (x + shift, y + shift), cv2.FONT_HERSHEY_SIMPLEX, size, ink, 1, cv2.LINE_AA)


def dot(picture: Pixels, pixel: Array, colour: Bgr, radius: int = 2) -> None:
    """Draw a filled circle around a pixel (2,)."""
    if not np.isnan(pixel).any():
        cv2.circle(picture, _rounded(pixel), radius, colour, -1, cv2.LINE_AA)


def cross(picture: Pixels, pixel: Array, colour: Bgr) -> None:
    """Draw an upright cross, 18 px wide, at a pixel (2,)."""
    for arm in (np.array([9.0, 0.0]), np.array([0.0, 9.0])):
        polyline(picture, np.array([pixel - arm, pixel + arm]), colour, 2)


def _rounded(pixel: Array) -> tuple[int, int]:
    x, y = (round(float(value)) for value in np.clip(pixel, -_FARTHEST_PX, _FARTHEST_PX))
    return x, y

"""Pieces of the raw picture: regions around robots, and the body-frame patches and rings that the filters look at.

Only regions are demosaiced. Pixel (0, 0) is the centre of the first pixel everywhere, so a picture at half scale has its
pixel i at 2 i + 0.5 of the full one.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from wire.frames import Array

# Frames are RGGB, the first pixel red. OpenCV's older names (BayerBG for this one) count from the second row and column;
# its RGGB alias is the one that returns red for a red pixel at (0, 0).
BAYER_TO_BGR = cv2.COLOR_BayerRGGB2BGR
BAYER_TO_GREY = cv2.COLOR_BayerRGGB2GRAY

Pixels = NDArray[np.uint8]

_RINGS = 10
_ANGLES = 128
_INNER_RING = 0.15  # of the outer: nearer the centre a turn moves nothing
_LEAST_SIDE_PX = 16


@dataclass(frozen=True)
class Region:
    """A rectangle of the raw picture, cut so that its first pixel is red again."""

    bayer: Pixels
    left_px: int
    top_px: int

    def grey(self) -> Pixels:
        """Shape (height, width)."""
        return np.asarray(cv2.cvtColor(self.bayer, BAYER_TO_GREY), dtype=np.uint8)

    def colour_half(self) -> Pixels:
        """Shape (height / 2, width / 2, 3), BGR. Filters sample 2-3 px apart: averaging first keeps noise from aliasing."""
        height, width = self.bayer.shape
        colour = cv2.cvtColor(self.bayer, BAYER_TO_BGR)
        return np.asarray(cv2.resize(colour, (width // 2, height // 2), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def whole(frame: Pixels) -> Region:
    """All of the picture."""
    return Region(frame, 0, 0)


def cut(frame: Pixels, centre_px: Array, half_px: float) -> Region | None:
    """The region of `frame` (height, width) around a point, clipped to the picture; None if hardly any of it is left."""
    height, width = frame.shape
    left, top = (2 * int(np.floor((c - half_px) / 2.0)) for c in centre_px)
    right, bottom = (2 * int(np.ceil((c + half_px) / 2.0)) + 2 for c in centre_px)
    left, top = max(left, 0), max(top, 0)
    right, bottom = min(right, width // 2 * 2), min(bottom, height // 2 * 2)
    if right - left < _LEAST_SIDE_PX or bottom - top < _LEAST_SIDE_PX:
        return None
    return Region(frame[top:bottom, left:right], left, top)


@dataclass(frozen=True)
class BodyFrame:
    """Where a robot is drawn in the picture: its centre, and the affine map from metres ahead and to starboard to pixels."""

    centre_px: Array  # (2,)
    body_to_px: Array  # (2, 2) px/m


class Sampler:
    """Resamples a region in a robot's own frame. Sample (size // 2, size // 2) is the robot's centre; columns run ahead,
    rows to starboard, `pitch_m` apart."""

    channels = 3
    angles = _ANGLES
    ring_channels = 3 * _RINGS

    def __init__(self, size: int, pitch_m: float, ring_radius_m: float) -> None:
        self.size, self.pitch_m = size, pitch_m
        turn = 2.0 * np.pi * np.arange(_ANGLES) / _ANGLES
        radius = ring_radius_m * np.linspace(_INNER_RING, 1.0, _RINGS)
        self._rings_m = np.stack([np.outer(radius, np.cos(turn)), np.outer(radius, np.sin(turn))])  # (2, rings, angles)

    def patch(self, colour_half: Pixels, region: Region, body: BodyFrame) -> NDArray[np.float32]:
        """Shape (channels, size, size)."""
        step = body.body_to_px * self.pitch_m / 2.0  # half-scale pixels per sample
        origin = _half_scale(body.centre_px, region) - step @ np.full(2, float(self.size // 2))
        matrix = np.column_stack([step, origin])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        patch = cv2.warpAffine(colour_half, matrix, (self.size, self.size), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return np.ascontiguousarray(np.moveaxis(patch, -1, 0), dtype=np.float32)

    def rings(self, colour_half: Pixels, region: Region, body: BodyFrame) -> NDArray[np.float32]:
        """Shape (ring_channels, 1, angles): circles around the centre, the first sample ahead, towards starboard."""
        offset = np.tensordot(body.body_to_px / 2.0, self._rings_m, axes=1)
        place = (offset + _half_scale(body.centre_px, region)[:, None, None]).astype(np.float32)
        rings = cv2.remap(colour_half, place[0], place[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.ascontiguousarray(np.moveaxis(rings, -1, 0).reshape(self.ring_channels, 1, _ANGLES), dtype=np.float32)


def _half_scale(point_px: Array, region: Region) -> Array:
    """A full-picture pixel in the region's half-scale picture."""
    return np.asarray((point_px - np.array([region.left_px, region.top_px]) - 0.5) / 2.0)

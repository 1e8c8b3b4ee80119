"""Image regions around robots, and the body-frame patches and rings that the correlation filters use.

Only regions are demosaiced. Pixel (0, 0) is the centre of the first pixel everywhere, so a picture at half scale has its
pixel i at 2 i + 0.5 of the full one.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer import kernels
from shoal.frames import Array

# Frames are RGGB: the first pixel is red. OpenCV's older names (BayerBG for this pattern) count from the second row and
# column; its RGGB alias returns red for a red pixel at (0, 0).
BAYER_TO_BGR = cv2.COLOR_BayerRGGB2BGR
BAYER_TO_GREY = cv2.COLOR_BayerRGGB2GRAY

Pixels = NDArray[np.uint8]

_RINGS = 10
_ANGLES = 128
_INNER_RING = 0.15  # radius of the innermost ring over the outermost; nearer the centre a turn moves nothing
_LEAST_SIDE_PX = 16  # smaller regions hold too little of a robot to be measured
_LEAST_FACING = 0.3  # cosine; nearer the rim a robot's pixels are mixed with the water beside it
_HUE_BLUR_PX = 1.0  # standard deviation of the blur of colour differences; less leaves the aliasing of `_without_false_colour`


@dataclass(frozen=True)
class ImageRegion:
    """A rectangle of the raw picture, cut so that its first pixel is red again."""

    bayer: Pixels
    left_px: int
    top_px: int

    def grey(self) -> Pixels:
        """The region in grey, (height, width)."""
        return np.asarray(cv2.cvtColor(self.bayer, BAYER_TO_GREY), dtype=np.uint8)

    def demosaiced(self, shrink: int) -> "DemosaicedRegion":
        """The region in colour, at full scale or, with `shrink` 2, each pixel the mean of four."""
        height, width = self.bayer.shape
        bgr = np.asarray(cv2.cvtColor(self.bayer, BAYER_TO_BGR), dtype=np.uint8)
        half = (width // 2, height // 2)
        pixels = _without_false_colour(bgr) if shrink == 1 else cv2.resize(bgr, half, interpolation=cv2.INTER_AREA)
        return DemosaicedRegion(np.asarray(pixels, dtype=np.uint8), self.left_px, self.top_px, shrink)


def in_polygons(pixel: Array, polygons_px: Sequence[Sequence[Sequence[float]]]) -> bool:
    """True if a pixel (2,) lies in one of some polygons, each a list of corners, or on its edge."""
    place = (float(pixel[0]), float(pixel[1]))
    return any(cv2.pointPolygonTest(np.array(p, dtype=np.float32), place, False) >= 0 for p in polygons_px)


def _without_false_colour(bgr: Pixels) -> Pixels:
    """Keep detail of the green channel, and smooth the differences of the other two to it.

    Red and blue are sampled every second pixel only. Their aliasing changed the appearance of a robot 18 px across with
    every fraction of a pixel (errors of 6 mm instead of 3, and lost robots). A mean of four pixels does not alias.
    """
    green = bgr[..., 1:2].astype(np.int16)
    hue = cv2.GaussianBlur(bgr[..., ::2].astype(np.int16) - green, (0, 0), _HUE_BLUR_PX)
    smooth = bgr.copy()
    smooth[..., ::2] = np.clip(green + hue, 0, 255)
    return smooth


@dataclass(frozen=True)
class DemosaicedRegion:
    """A region's colours, BGR (height, width, 3), at 1 / `shrink` of the picture's scale.

    Filters that sample several pixels apart need the mean of four pixels, or noise aliases. For a robot 18 px across full
    scale is needed.
    """

    bgr: Pixels
    left_px: int
    top_px: int
    shrink: int

    def place(self, point_px: Array) -> Array:
        """Position (2,) in this region of a pixel (2,) of the whole picture."""
        return np.asarray((point_px - np.array([self.left_px, self.top_px]) - (self.shrink - 1) / 2.0) / self.shrink)


def whole(frame: Pixels) -> ImageRegion:
    return ImageRegion(frame, 0, 0)


def cut(frame: Pixels, centre_px: Array, half_px: float) -> ImageRegion | None:
    """The region of `frame` (height, width) around a point, of at least 16 px a side, clipped to the picture. None if less is
    left, or the point is not finite."""
    u, v = centre_px.tolist()
    if not (math.isfinite(u) and math.isfinite(v) and math.isfinite(half_px)):
        return None
    half_px = max(half_px, _LEAST_SIDE_PX / 2.0)
    height, width = frame.shape
    left, top = max(2 * math.floor((u - half_px) / 2.0), 0), max(2 * math.floor((v - half_px) / 2.0), 0)
    right = min(2 * math.ceil((u + half_px) / 2.0) + 2, width // 2 * 2)
    bottom = min(2 * math.ceil((v + half_px) / 2.0) + 2, height // 2 * 2)
    if right - left < _LEAST_SIDE_PX or bottom - top < _LEAST_SIDE_PX:
        return None
    return ImageRegion(frame[top:bottom, left:right], left, top)


@dataclass(frozen=True)
class BodyProjection:
    """The projection of a robot's body into the picture, linear around its top."""

    top_px: Array  # (2,)
    body_to_px: Array  # (2, 3) px/m: of the body's own axes ahead, to starboard and down
    to_camera: Array  # (3,) unit vector, of the same axes


@dataclass(frozen=True)
class RobotShape:
    """A robot's surface seen from above: a sphere with its top at `top_m` above the centre, and a flat plate there (half its
    side; 0 for none).

    Seen obliquely a sphere's rim moves out from under its top, by 19 px at the pool's edge. With a flat disc instead,
    filters were 4-10 mm and up to 3 deg off after half a metre.
    """

    radius_m: float
    top_m: float
    plate_half_m: float

    def normals(self, points_m: Array) -> Array:
        """Unit vectors (3, ...) out of the surface at points (2, ...) ahead and to starboard; 0 beyond the hull."""
        away = points_m / self.radius_m if self.radius_m > 0.0 else np.zeros_like(points_m)
        squared = np.sum(away**2, axis=0)
        on_plate = np.max(np.abs(points_m), axis=0) <= self.plate_half_m
        normals = np.concatenate([away, -np.sqrt(np.maximum(1.0 - squared, 0.0))[None]]) * (squared < 1.0)
        return np.where(on_plate, np.array([0.0, 0.0, -1.0]).reshape(3, *[1] * (points_m.ndim - 1)), normals)

    def drop_m(self, points_m: Array) -> Array:
        """Depth (...) of the surface below the robot's top at points (2, ...) ahead and to starboard."""
        inside = np.maximum(self.radius_m**2 - np.sum(points_m**2, axis=0), 0.0)
        on_plate = np.max(np.abs(points_m), axis=0) <= self.plate_half_m
        return np.asarray(np.where(on_plate, 0.0, np.maximum(self.top_m - np.sqrt(inside), 0.0)))


class BodySampler:
    """Resampling of a region in a robot's body frame.

    Sample (size // 2, size // 2) of a patch is the robot's centre; columns run ahead, rows to starboard, `pitch_m` apart.
    """

    channels = 3
    angles = _ANGLES
    ring_channels = 3 * _RINGS

    def __init__(self, size: int, pitch_m: float, ring_radius_m: float, hull: RobotShape) -> None:
        self.pitch_m = pitch_m
        along = (np.arange(size) - size // 2) * pitch_m
        grid_m = np.stack(np.meshgrid(along, along))
        self._grid, self._normals = _with_drop(grid_m, hull), hull.normals(grid_m)
        turn = 2.0 * np.pi * np.arange(_ANGLES) / _ANGLES
        radius = ring_radius_m * np.linspace(_INNER_RING, 1.0, _RINGS)
        self._rings = _with_drop(np.stack([np.outer(radius, np.cos(turn)), np.outer(radius, np.sin(turn))]), hull)

    def patch(self, colour: DemosaicedRegion, body: BodyProjection) -> NDArray[np.float32]:
        """Square patch (channels, size, size)."""
        return _sample(colour, self._grid, body)

    def facing(self, body: BodyProjection) -> NDArray[np.float32]:
        """Cosine (size, size) of the angle between the surface's normal and the line of sight at each sample of a patch; 0 of
        those that are hidden, or seen aslant along the rim."""
        cosine = np.tensordot(body.to_camera, self._normals, axes=1)
        return np.where(cosine > _LEAST_FACING, cosine, 0.0).astype(np.float32)

    def rings(self, colour: DemosaicedRegion, body: BodyProjection) -> NDArray[np.float32]:
        """Circles around the centre, (ring_channels, 1, angles): the first sample ahead, then towards starboard."""
        return _sample(colour, self._rings, body).reshape(self.ring_channels, 1, _ANGLES)


def _with_drop(points_m: Array, hull: RobotShape) -> Array:
    """Points (2, rows, columns) with their depth below the robot's top as third row."""
    return np.concatenate([points_m, hull.drop_m(points_m)[None]])


def _sample(colour: DemosaicedRegion, points_m: Array, body: BodyProjection) -> NDArray[np.float32]:
    """Sample the region at body points (3, rows, columns): (3, rows, columns), BGR."""
    left, top = colour.place(body.top_px)
    samples = np.empty(points_m.shape, np.float32)
    to_px = body.body_to_px / colour.shrink
    kernels.sample_colours(colour.bgr, points_m.reshape(3, -1), to_px, left, top, samples.reshape(3, -1))
    return samples

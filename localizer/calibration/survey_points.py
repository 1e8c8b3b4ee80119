"""Surveyed points of the pool and their pixels: the file of `localizer calibrate --pool-points`. Pure."""

from collections.abc import Sequence
from typing import Annotated, Self

import cv2
import numpy as np
from pydantic import Field, model_validator

from localizer.detection.fiducials import marker_centres, marker_dictionary
from localizer.detection.image_regions import Pixels
from shoal.config.loader import Section
from shoal.config.perception import MarkerFamily
from shoal.config.scene import PoolConfig, Vec2, Vec3
from shoal.errors import ConfigError
from shoal.frames import Array

FEWEST_POINTS = 4
_OUTSIDE_M = 0.5  # m outside the walls that a rim may lie
_HIGHEST_M = -1.5  # m, highest point that is accepted; beyond, a sign is probably missing, as z points down
CORNER_REACH_PX = 5  # px from a click in which a corner is looked for
_CORNER_BLOCK_PX, _CORNER_WINDOW_PX = 3, (2, 2)  # px; with a half side of 3 the next cell, 5 px away, pulls by 1 px
_CORNER_SLOPE = (
    8.0  # grey levels per px (OpenCV's scale), least slope in any direction; noise of 2 makes 2, an edge with it 3.5
)
_CORNER_SHARE = 0.3  # of the strongest corner's response
_LINE_SHARE = 0.05  # width over length of the cloud of points; below it, rotation about the line is not determined


class SurveyPoint(Section):
    """A point of known place in the pool frame: seen at `pixel_px`, or the centre of the marker `marker_id`, which is then
    looked for in the picture."""

    name: Annotated[str, Field(min_length=1)]
    pool_m: Vec3
    pixel_px: Vec2 | None = None
    marker_id: Annotated[int, Field(ge=0)] | None = None

    @model_validator(mode="after")
    def _seen_somewhere(self) -> Self:
        if (self.pixel_px is None) == (self.marker_id is None):
            raise ValueError("needs either pixel_px or marker_id")
        return self


def marker_fault(point: SurveyPoint, family: MarkerFamily) -> str:
    """The reason why a point's marker cannot be one of a family; empty if it can."""
    count = len(marker_dictionary(family).bytesList)
    if point.marker_id is None or point.marker_id < count:
        return ""
    return f"{point.name!r}: marker_id = {point.marker_id}: {family} has no such marker (allowed: 0 to {count - 1})"


class SurveyFile(Section):
    """The file of `--pool-points`. `image`: the picture they were seen in, beside the file. `marker_family`: of the points'
    markers."""

    pool: PoolConfig  # the experiment's [pool]
    image: str | None = None
    marker_family: MarkerFamily = "4x4_50"
    points: tuple[SurveyPoint, ...]

    @model_validator(mode="after")
    def _usable(self) -> Self:
        """Refuse points that are too few, doubled, outside the pool, or on one line."""
        size = self.pool.size_m
        if len(self.points) < FEWEST_POINTS:
            raise ValueError(f"points: {len(self.points)} given, at least {FEWEST_POINTS} are needed, better 8")
        for key in ("name", "pool_m", "pixel_px", "marker_id"):
            values = [getattr(point, key) for point in self.points]
            doubled = [value for value in values if value is not None and values.count(value) > 1]
            if doubled:
                raise ValueError(f"points: {key} = {doubled[0]!r} is used twice")
        low = (-size[0] / 2 - _OUTSIDE_M, -size[1] / 2 - _OUTSIDE_M, _HIGHEST_M)
        high = (size[0] / 2 + _OUTSIDE_M, size[1] / 2 + _OUTSIDE_M, size[2])
        for point in self.points:
            if fault := marker_fault(point, self.marker_family):
                raise ValueError(f"points: {fault}")
            for axis, value, least, most in zip("xyz", point.pool_m, low, high, strict=True):
                if not least <= value <= most:
                    allowed = f"allowed: {least:g} to {most:g}; z is positive under water"
                    raise ValueError(f"points: {point.name!r}: pool_m {axis} = {value:g} is outside the pool ({allowed})")
        if is_line(np.array([point.pool_m for point in self.points])):
            raise ValueError("points: they lie on one line; take some beside it")
        return self


def seen_pixels(points: Sequence[SurveyPoint], picture: Pixels | None, family: MarkerFamily = "4x4_50") -> Array:
    """Pixels (n, 2) of the points: as written, or as their markers are found in the picture. Raises ConfigError."""
    markers = {} if picture is None else marker_centres(picture, family)
    pixels = []
    for point in points:
        if point.pixel_px is not None:
            pixels.append(np.array(point.pixel_px))
            continue
        what = f"points: {point.name!r}: marker_id = {point.marker_id}"
        if picture is None:
            raise ConfigError(f"{what}: there is no picture to find it in (name one: image = ..., or --pool-points-image)")
        centres = markers.get(point.marker_id or 0, [])
        if len(centres) != 1:
            ids = ", ".join(map(str, sorted(markers))) or "none"
            raise ConfigError(f"{what}: {len(centres)} markers of that id are in the picture (found in it: {ids})")
        pixels.append(centres[0])
    return np.array(pixels)


def refined_corner(grey: Pixels, pixel: Array) -> Array | None:
    """The corner (2,) nearest to a pixel (2,) of a grey picture (height, width), to some 0.4 px; None if there is none."""
    left, top = (int(value) - CORNER_REACH_PX for value in np.rint(pixel))
    side = 2 * CORNER_REACH_PX + 1
    around = grey[max(top, 0) : top + side, max(left, 0) : left + side]
    if left < 0 or top < 0 or around.shape != (side, side):
        return None
    # the weaker of the two slopes around each pixel, squared; along an edge and in plain water it is that of noise
    slopes = cv2.cornerMinEigenVal(around.astype(np.float32), _CORNER_BLOCK_PX, ksize=3)
    strong = (slopes == cv2.dilate(slopes, np.ones((3, 3)))) & (slopes > max(_CORNER_SHARE * slopes.max(), _CORNER_SLOPE**2))
    places = np.argwhere(strong)[:, ::-1] + np.array([left, top], dtype=np.float64)
    if not len(places):
        return None
    nearest = places[np.argmin(np.linalg.norm(places - pixel, axis=1))].astype(np.float32).reshape(1, 1, 2)
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-3)
    return np.asarray(cv2.cornerSubPix(grey, nearest, _CORNER_WINDOW_PX, (-1, -1), until), dtype=np.float64).reshape(2)


def is_line(cloud: Array) -> bool:
    """True if points (n, 2 or 3) lie so close to one line that rotation about it is not determined."""
    sizes = np.linalg.svd(cloud - cloud.mean(axis=0), compute_uv=False)
    return bool(sizes[1] <= _LINE_SHARE * sizes[0])

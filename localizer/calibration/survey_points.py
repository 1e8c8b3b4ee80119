"""Surveyed points of the pool and their pixels: the file of `localizer calibrate --pool-points`. Pure."""

from collections.abc import Sequence
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from localizer.detection.fiducials import marker_centres
from localizer.detection.image_regions import Pixels
from wire.config.scene import PoolConfig, Vec2, Vec3
from wire.frames import Array
from wire.toml_loader import ConfigError, Section

FEWEST_POINTS = 4
_OUTSIDE_M = 0.5  # m outside the walls that a rim may lie
_HIGHEST_M = -1.5  # m, highest point that is accepted; beyond, a sign is probably missing, as z points down
_LINE_SHARE = 0.05  # width over length of the cloud of points; below it, rotation about the line is not determined


class SurveyPoint(Section):
    """A point of known place in the pool frame: seen at `pixel_px`, or the centre of the ArUco marker `marker_id`
    (DICT_4X4_50), which is then looked for in the picture."""

    name: Annotated[str, Field(min_length=1)]
    pool_m: Vec3
    pixel_px: Vec2 | None = None
    marker_id: Annotated[int, Field(ge=0, le=49)] | None = None

    @model_validator(mode="after")
    def _seen_somewhere(self) -> Self:
        if (self.pixel_px is None) == (self.marker_id is None):
            raise ValueError("needs either pixel_px or marker_id")
        return self


class SurveyFile(Section):
    """The file of `--pool-points`. `image`: the picture they were seen in, beside the file."""

    pool: PoolConfig  # the experiment's [pool]
    image: str | None = None
    points: tuple[SurveyPoint, ...]

    @model_validator(mode="after")
    def _usable(self) -> Self:
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
            for axis, value, least, most in zip("xyz", point.pool_m, low, high, strict=True):
                if not least <= value <= most:
                    allowed = f"allowed: {least:g} to {most:g}; z is positive under water"
                    raise ValueError(f"points: {point.name!r}: pool_m {axis} = {value:g} is outside the pool ({allowed})")
        if is_line(np.array([point.pool_m for point in self.points])):
            raise ValueError("points: they lie on one line; take some beside it")
        return self


def seen_pixels(points: Sequence[SurveyPoint], picture: Pixels | None) -> Array:
    """Pixels (n, 2) of the points: as written, or as their markers are found in the picture. Raises ConfigError."""
    markers = {} if picture is None else marker_centres(picture)
    pixels = []
    for point in points:
        if point.pixel_px is not None:
            pixels.append(np.array(point.pixel_px))
            continue
        what = f"points: {point.name!r}: marker_id = {point.marker_id}"
        if picture is None:
            raise ConfigError(f"{what}: there is no picture to find it in (name one: image = ..., or --pool-points-image)")
        found = markers.get(point.marker_id or 0, [])
        if len(found) != 1:
            seen = ", ".join(map(str, sorted(markers))) or "none"
            raise ConfigError(f"{what}: {len(found)} markers of that id are in the picture (found in it: {seen})")
        pixels.append(found[0])
    return np.array(pixels)


def is_line(cloud: Array) -> bool:
    """True if points (n, 2 or 3) lie so close to one line that rotation about it is not determined."""
    sizes = np.linalg.svd(cloud - cloud.mean(axis=0), compute_uv=False)
    return bool(sizes[1] <= _LINE_SHARE * sizes[0])

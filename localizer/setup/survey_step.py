"""Survey points that are clicked in the picture, and the corners of the pool's outline that are dragged. Pure.

Both are points of known place, in the form of `localizer calibrate --pool-points`, and go to the same solver.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from localizer.calibration.extrinsics import PoseFit, fit_pose, place_errors_m
from localizer.calibration.survey_points import (
    CORNER_REACH_PX,
    SurveyFile,
    SurveyPoint,
    marker_fault,
    refined_corner,
    seen_pixels,
)
from localizer.camera_model import RefractiveCamera
from localizer.detection.image_regions import Pixels
from shoal.config.loader import check
from shoal.config.perception import Camera, MarkerFamily
from shoal.config.scene import PoolConfig
from shoal.errors import ConfigError
from shoal.frames import Array


@dataclass(frozen=True)
class PointResidual:
    """A survey point's error by the fitted pose, in the picture and in the pool. `bad`: the others agree without it."""

    name: str
    seen_px: tuple[float, float]
    error_px: float
    error_mm: float
    bad: bool


class SurveyStep:
    """The points of one camera."""

    def __init__(self, pool: PoolConfig, family: MarkerFamily) -> None:
        self._pool, self._family = pool, family
        self.points: dict[str, SurveyPoint] = {}
        self.residuals: dict[str, PointResidual] = {}  # by the newest fit, of the points that are as they were then

    def put(
        self,
        name: str,
        pool_m: tuple[float, float, float],
        pixel_px: Array | None,
        marker_id: int | None,
        grey: Pixels | None,
    ) -> str:
        """Add a point, or move the one of that name. A clicked pixel goes to the corner next to it in the grey picture;
        returns what became of it, in words. Raises ConfigError."""
        message, pixel = f"{name}: its marker is looked for", None
        if pixel_px is not None:
            corner = None if grey is None else refined_corner(grey, pixel_px)
            at = pixel_px if corner is None else corner
            pixel = (round(float(at[0]), 2), round(float(at[1]), 2))
            moved = float(np.linalg.norm(at - pixel_px))
            message = f"{name}: " + (
                f"as clicked, as there is no corner within {CORNER_REACH_PX} px"
                if corner is None
                else f"at a corner {moved:.1f} px from the click"
            )
        table = {"name": name, "pool_m": pool_m, "pixel_px": pixel, "marker_id": marker_id}
        point = check(SurveyPoint, {k: v for k, v in table.items() if v is not None}, "this point")
        if fault := marker_fault(point, self._family):
            raise ConfigError(f"this point: {fault}")
        self.residuals.pop(name, None)
        self.points[name] = point
        return message

    def remove(self, name: str) -> None:
        """Forget a point."""
        self.points.pop(name, None)
        self.residuals.pop(name, None)

    def fit(self, camera: Camera, grey: Pixels | None) -> tuple[PoseFit, tuple[SurveyPoint, ...]]:
        """The camera's pose, and the points that it is from: others may change them meanwhile. Markers are looked for in the
        grey picture. Raises ConfigError."""
        points = tuple(self.points.values())
        table = {
            "pool": self._pool.model_dump(),
            "points": [point.model_dump() for point in points],
            "marker_family": self._family,
        }
        check(SurveyFile, table, "the survey")
        return fit_pose(camera, points, seen_pixels(points, grey, self._family)), points

    def note_errors(self, fit: PoseFit, points: Sequence[SurveyPoint]) -> None:
        """Keep the errors of a fit, of the points that are still as they were for it."""
        unchanged = {point.name for point in points if self.points.get(point.name) == point}
        self.residuals = {name: error for name, error in _residuals(fit, points).items() if name in unchanged}


def _residuals(fit: PoseFit, points: Sequence[SurveyPoint]) -> dict[str, PointResidual]:
    """Errors of the points that `fit` was made from, by name."""
    off_px, off_m = np.linalg.norm(fit.residuals_px, axis=1), np.linalg.norm(place_errors_m(fit, points), axis=1)
    return {
        point.name: PointResidual(
            point.name, (float(px[0]), float(px[1])), float(off_px[i]), 1e3 * float(off_m[i]), i == fit.suspect
        )
        for i, (point, px) in enumerate(zip(points, fit.seen_px, strict=True))
    }


def outline_corners(pool: PoolConfig) -> dict[str, tuple[float, float, float]]:
    """The eight corners of the pool's outline, by name."""
    half_x, half_y, floor = pool.size_m[0] / 2, pool.size_m[1] / 2, pool.size_m[2]
    levels, sides = {"surface": 0.0, "floor": floor}, {"-": -1.0, "+": 1.0}
    return {
        f"{level} corner {x}x {y}y": (sides[x] * half_x, sides[y] * half_y, levels[level])
        for level, x, y in product(levels, sides, sides)
    }


def outline_px(camera: Camera, pool: PoolConfig) -> dict[str, list[float]]:
    """Pixels of the outline's corners by the camera's calibration, those that lie in the picture."""
    corners = outline_corners(pool)
    pixels = RefractiveCamera(camera).pool_to_pixel(np.array(list(corners.values())))
    width, height = camera.size_px
    inside = np.all((pixels >= 0) & (pixels <= [width - 1, height - 1]), axis=1)
    return {name: px.tolist() for name, px, is_inside in zip(corners, pixels.round(2), inside, strict=True) if is_inside}

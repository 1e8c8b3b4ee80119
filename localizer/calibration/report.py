"""Report of `localizer calibrate` and `localizer check`: lines of text, and a picture."""

from collections.abc import Mapping, Sequence

import numpy as np

from localizer.calibration.extrinsics import PoseFit, place_errors_m
from localizer.calibration.intrinsics import IntrinsicsFit, intrinsics_warnings
from localizer.calibration.pool_grid import ViewFigures, draw_grid
from localizer.calibration.survey_points import FEWEST_POINTS, SurveyPoint
from localizer.detection.image_regions import Pixels
from localizer.view.drawing import cross, dot, polyline, write
from shoal.config.scene import PoolConfig
from shoal.frames import Array

MAGNIFIED = 20.0  # length of arrows over the errors that they show
_SHADES = "·-+*#"  # corners in a cell: 0, 1 or more, and more
_SHADE_FROM = (1, 5, 15, 40)
_FEW_POINTS = 6
_POOR_POINT_PX = 2.0
_SEEN, _PREDICTED, _ARROW, _BAD, _INK = (80, 220, 80), (60, 160, 255), (60, 60, 230), (40, 40, 160), (230, 230, 230)


def intrinsics_lines(fit: IntrinsicsFit, left_out: Mapping[str, str]) -> list[str]:
    """Lines about the intrinsics: every view's error, coverage, values with one standard deviation, warnings.

    `left_out`: pictures that were not used, by name, with the reasons.
    """
    lens, sigma = fit.lens, fit.deviations
    lines = [f"Lens, from {len(fit.views)} views of the board", "", "  picture                        corners   RMS px"]
    lines += [
        f"  {_short(v.name):30} {len(v.pixels):7d} {rms:8.3f}" for v, rms in zip(fit.views, fit.view_rms_px, strict=True)
    ]
    lines += [f"  {_short(view.name):30} {len(view.pixels):7d} {rms:8.3f}   left out: bad" for view, rms in fit.rejected]
    lines += [f"  {_short(name):30}       -        -   left out: {reason}" for name, reason in left_out.items()]
    lines += [f"  {'all that were kept':30} {len(fit.corners_px):7d} {fit.rms_px:8.3f}"]
    held_out_px = fit.held_out_rms_px
    lines += [] if held_out_px is None else [f"  {'each third by the lens of the rest':38} {held_out_px:8.3f}"]
    lines += [""]
    lines += [f"  size_px    {lens.size_px[0]} x {lens.size_px[1]}"]
    lines += [
        "  focal_px   " + _with_sigma(lens.focal_px, sigma[:2], 2),
        "  centre_px  " + _with_sigma(lens.centre_px, sigma[2:4], 2),
    ]
    names = ("k1", "k2", "p1", "p2", "k3")
    lines += [
        f"  {name}         {_with_sigma([k], [s], 5)}" for name, k, s in zip(names, lens.distortion, sigma[4:], strict=True)
    ]
    if lens.distortion[4] == 0.0:
        lines[-1] = "  k3         0 (the views cannot tell it from zero)"
    covered = np.mean(fit.coverage > 0)
    lines += ["", f"  Corners fall into {covered:.0%} of the picture ({_legend()}):", ""]
    lines += [
        "    " + " ".join(_SHADES[int(np.searchsorted(_SHADE_FROM, count, "right"))] for count in row) for row in fit.coverage
    ]
    return [*lines, *_warnings(intrinsics_warnings(fit))]


def pose_lines(fit: PoseFit, points: Sequence[SurveyPoint], pool: PoolConfig) -> list[str]:
    """Lines about the pose: every point's error, position and rotation with one standard deviation, the resulting error of
    places in the pool, warnings."""
    lines = [
        f"Pose, from {len(points)} points of the pool",
        "",
        "  point                          x m     y m     z m    error px    (x,     y)   error mm",
    ]
    errors_mm = 1e3 * np.linalg.norm(place_errors_m(fit, points), axis=1)
    for point, error, error_mm in zip(points, fit.residuals_px, errors_mm, strict=True):
        place, pixels = " ".join(f"{value:7.3f}" for value in point.pool_m), ", ".join(f"{value:5.2f}" for value in error)
        lines.append(f"  {_short(point.name, 24):24}   {place} {np.hypot(*error):11.2f}   ({pixels}) {error_mm:10.1f}")
    sigma = np.sqrt(np.diag(fit.covariance))
    depth_m = pool.size_m[2] / 2
    width, height = fit.camera.size_px
    middle_m, corner_m = fit.place_sigma_m(np.array([[width / 2, height / 2], [0.0, 0.0]]), depth_m)
    lines += [
        f"  RMS {fit.rms_px:.2f} px",
        "",
        f"  position_m    {_with_sigma(fit.camera.position_m, sigma[3:], 4)}",
        f"  rotation_rad  {_with_sigma(fit.camera.rotation_rad, sigma[:3], 5)}",
        f"  Places {depth_m:g} m deep are known to {1e3 * middle_m:.1f} mm in the picture's middle,",
        f"  to {1e3 * corner_m:.1f} mm in its corner (one standard deviation; the lens's own comes on top).",
    ]
    return [*lines, *_warnings(_pose_warnings(fit, points))]


def view_lines(camera_figures: ViewFigures, depth_m: float) -> list[str]:
    """Lines about field of view and scale at a depth."""
    f = camera_figures
    middle_mm, corner_mm = f.mm_per_cm_depth
    return [
        f"At {depth_m:g} m depth:",
        f"  field of view            {f.field_m[0]:.2f} m x {f.field_m[1]:.2f} m, {f.seen_share:.0%} of the pool",
        f"  one pixel                {f.mm_per_px[0]:.2f} mm in the middle, {f.mm_per_px[1]:.2f} mm in the worst corner",
        f"  1 cm of depth error      {middle_mm:.1f} mm in the middle, {corner_mm:.1f} mm in the worst corner",
    ]


def intrinsics_picture(backdrop: Pixels, fit: IntrinsicsFit) -> Pixels:
    """All corners over a darkened picture (height, width, 3) BGR, with their errors as arrows; bad views' corners as dots."""
    picture = np.asarray(backdrop // 3, dtype=np.uint8)
    for view, _ in fit.rejected:
        for pixel in view.pixels:
            dot(picture, pixel, _BAD)
    for view, residuals in zip(fit.views, fit.residuals_px, strict=True):
        for pixel, error in zip(view.pixels, residuals, strict=True):
            dot(picture, pixel, _SEEN)
            polyline(picture, np.array([pixel, pixel + MAGNIFIED * error]), _ARROW)
    title = f"{len(fit.views)} views, RMS {fit.rms_px:.2f} px; red: errors x{MAGNIFIED:g}, dark red: views left out"
    write(picture, title, np.array([10, 22]), _INK, 0.6)
    return picture


def pose_picture(backdrop: Pixels, fit: PoseFit, points: Sequence[SurveyPoint], pool: PoolConfig) -> Pixels:
    """The pool's grid half-way down and the points, seen and predicted, over a picture (height, width, 3) BGR."""
    picture = backdrop.copy()
    draw_grid(picture, fit.camera, pool, pool.size_m[2] / 2)
    seen_px = fit.seen_px
    for i, (point, pixel, error) in enumerate(zip(points, seen_px, fit.residuals_px, strict=True)):
        cross(picture, pixel, _BAD if i == fit.suspect else _SEEN)
        dot(picture, pixel - error, _PREDICTED, 4)
        polyline(picture, np.array([pixel, pixel + MAGNIFIED * error]), _ARROW, 2)
        write(picture, point.name, pixel + np.array([12.0, -12.0]), _INK)
    title = f"{len(points)} points, RMS {fit.rms_px:.2f} px; green: seen, orange: predicted, red: errors x{MAGNIFIED:g}"
    write(picture, title, np.array([10, 22]), _INK, 0.6)
    return picture


def _pose_warnings(fit: PoseFit, points: Sequence[SurveyPoint]) -> list[str]:
    """Warnings about a camera's fitted pose: few points, one that does not fit, a poor fit, none under water."""
    warnings = []
    if len(points) < _FEW_POINTS:
        remark = (
            "a wrong one cannot be told from the rest" if len(points) == FEWEST_POINTS else "one more or two would tell more"
        )
        warnings.append(f"only {len(points)} points: {remark}; take 8, half of them on the floor")
    if fit.suspect is not None:
        warnings.append(
            f"point {points[fit.suspect].name!r} does not fit: without it the others agree; look at its pool_m and pixel"
        )
    elif fit.rms_px > _POOR_POINT_PX:
        warnings.append(f"an RMS of {fit.rms_px:.1f} px is poor: measure the points again, and see whether the floor is flat")
    if all(point.pool_m[2] <= 0 for point in points):
        warnings.append(
            "no point lies under water: nothing tests the refraction; `localizer check` over a picture shows the floor"
        )
    return warnings


def _warnings(texts: Sequence[str]) -> list[str]:
    return ["", *(f"  WARNING: {text}" for text in texts)] if texts else []


def _with_sigma(values: Sequence[float] | Array, sigmas: Sequence[float] | Array, digits: int) -> str:
    return "   ".join(f"{v:.{digits}f} ± {s:.{digits}f}" for v, s in zip(values, sigmas, strict=True))


def _legend() -> str:
    return ", ".join(f"{shade} {text}" for shade, text in zip(_SHADES, ("none", "1+", "5+", "15+", "40+"), strict=True))


def _short(name: str, length: int = 30) -> str:
    return name if len(name) <= length else f"...{name[3 - length :]}"

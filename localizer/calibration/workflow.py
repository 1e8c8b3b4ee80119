"""SHELL: `localizer calibrate`: from files to a camera file, a picture and a report.

pictures -> target's corners -> intrinsics --+ points file (+ picture) ---------------------+-> pose over the pool ->
camera.toml, picture, lines
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from localizer.calibration.extrinsics import PoseFit, fit_pose
from localizer.calibration.images import pictures, read_picture, write_picture
from localizer.calibration.intrinsics import IntrinsicsFit, fit_intrinsics
from localizer.calibration.report import intrinsics_lines, intrinsics_picture, pose_lines, pose_picture
from localizer.calibration.survey_points import SurveyFile, seen_pixels
from localizer.calibration.targets import EXAMPLES, TargetView, parse_target
from localizer.detection.image_regions import Pixels
from wire.config.perception import Camera, CameraFile
from wire.process.output_files import check_output, replace_text
from wire.toml_loader import ConfigError, check, read_toml, toml_value

_NO_POSE = "Without --pool-points the camera has no pose yet: --lens {out} --pool-points FILE finds it."
_DEFAULTS = {"rate_hz": 20.0, "exposure_s": 0.008}
_ANY_POSE = {"position_m": (0.0, 0.0, -1.0), "rotation_rad": (0.0, 0.0, 0.0)}
_MOST_VIEWS = 60  # views that are used, evenly taken; 200 with bad ones take five minutes and add little
_DIGITS = {"focal_px": 3, "centre_px": 3, "distortion": 7, "position_m": 5, "rotation_rad": 6}  # for 0.01 px and 0.01 mm


@dataclass(frozen=True)
class CalibrationRequest:
    """Options of `localizer calibrate`; the file formats are those of docs/calibration.md."""

    sources: tuple[Path, ...]
    board: str | None
    every: int
    lens: Path | None
    points: Path | None
    image: Path | None
    out: Path
    rate_hz: float | None = None  # these three cannot be measured: given, or as in `lens`, or default
    exposure_s: float | None = None
    water_index: float | None = None
    grey: bool = False  # pictures of one channel are grey, not raw Bayer RGGB


def calibrate(request: CalibrationRequest) -> list[str]:
    """Find the intrinsics from pictures of a target (or take them from a file), then the pose from points of the pool.

    Writes the camera file and a picture beside it; returns the report's lines. Raises ConfigError.
    """
    _check_request(request)
    points = None if request.points is None else check(SurveyFile, read_toml(request.points), str(request.points))
    image, drawn = _points_image(request, points), request.out.with_suffix(".png")
    _check_outputs(request, image, drawn)
    summary, lines, panels = [], [], []
    if request.lens is not None:
        camera = _read_lens(request)
        lines.append(f"Lens from {request.lens}")
    else:
        fit, missing, spare, backdrop = _fit_lens(request)
        camera = _without_pose(fit.lens.model_dump(), "the camera found", request)
        lines += intrinsics_lines(fit, missing, spare)
        panels.append(intrinsics_picture(backdrop, fit))
        summary.append(f"lens: {len(fit.views)} views, RMS {fit.rms_px:.2f} px")
    if points is not None:
        pose, backdrop = _fit_pose(camera, points, request)
        camera = pose.camera
        lines += ["", *pose_lines(pose, points.points, points.pool)]
        panels.append(pose_picture(backdrop, pose, points.points, points.pool))
        summary.append(f"pose: {len(points.points)} points, RMS {pose.rms_px:.2f} px")
    left_out = set() if points else set(_ANY_POSE)
    lines += ["", *_write(request.out, camera.model_dump(mode="json", exclude=left_out), "; ".join(summary), panels)]
    return [*lines, *([] if points else [_NO_POSE.format(out=request.out)])]


def _check_request(request: CalibrationRequest) -> None:
    """Refuse bad combinations of options before minutes of work."""
    if (request.lens is None) == (not request.sources):
        raise ConfigError("give either pictures of a board (files, folders, videos), or --lens FILE with a lens found earlier")
    if request.lens is not None and request.points is None:
        raise ConfigError("--lens finds nothing new by itself: give --pool-points too")
    if request.image is not None and request.points is None:
        raise ConfigError("--pool-points-image is the picture that --pool-points were seen in: give both")
    if request.out.suffix != ".toml" or not request.out.parent.is_dir():
        raise ConfigError(f"--out {request.out}: must end in .toml, in a folder that exists")


def _check_outputs(request: CalibrationRequest, image: Path | None, drawn: Path) -> None:
    """Refuse outputs that are read as inputs. The lens file may be given again as --out: its intrinsics go into the new
    one."""
    read = [*request.sources, *(file for source in request.sources if source.is_dir() for file in source.iterdir())]
    read += [path for path in (request.points, image) if path is not None]
    for path in (request.out, drawn):
        try:
            check_output(path, read)
        except ConfigError as error:
            raise ConfigError(f"--out {request.out}: {error}") from None


def _fit_lens(request: CalibrationRequest) -> tuple[IntrinsicsFit, list[str], int, Pixels]:
    """The intrinsics, the names of pictures without the target, the number of unused views, and a picture to draw on."""
    if request.board is None:
        raise ConfigError(f"--board: which board do the pictures show? (allowed: {EXAMPLES})")
    board = parse_target(request.board)
    views, missing, backdrop = list[TargetView](), list[str](), np.empty((0, 0, 3), np.uint8)
    for name, picture in pictures(request.sources, request.every, request.grey):
        view = board.find(np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), dtype=np.uint8), name)
        if view is None:
            missing.append(name)
        else:
            views.append(view)
            backdrop = picture
    if not views:
        raise ConfigError(f"--board {request.board}: found in none of {len(missing)} pictures; are counts and kind right?")
    used = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, _MOST_VIEWS).astype(int))]
    height, width, _ = backdrop.shape
    return fit_intrinsics(used, (width, height)), missing, len(views) - len(used), backdrop


def _fit_pose(camera: Camera, points: SurveyFile, request: CalibrationRequest) -> tuple[PoseFit, Pixels]:
    """The pose, and the picture it was found in, black if there was none."""
    image = _points_image(request, points)
    width, height = camera.size_px
    picture = None if image is None else read_picture(image, request.grey)
    if picture is not None and picture.shape[:2] != (height, width):
        raise ConfigError(f"{image}: {picture.shape[1]}x{picture.shape[0]}, but the lens was found at {width}x{height}")
    grey = None if picture is None else np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    try:
        pose = fit_pose(camera, points.points, seen_pixels(points.points, grey, points.marker_family))
    except ConfigError as error:
        raise ConfigError(f"{request.points}: {error}") from None
    return pose, np.zeros((height, width, 3), np.uint8) if picture is None else picture


def _points_image(request: CalibrationRequest, points: SurveyFile | None) -> Path | None:
    """The picture that the points were seen in, if there is one."""
    if request.image is not None or points is None or points.image is None or request.points is None:
        return request.image
    return request.points.parent / points.image


def _read_lens(request: CalibrationRequest) -> Camera:
    assert request.lens is not None
    camera = read_toml(request.lens).get("camera", {})
    if not isinstance(camera, dict):
        raise ConfigError(f"{request.lens}: camera = {camera!r}: must be a table")
    return _without_pose(camera, str(request.lens), request)


def _without_pose(table: dict[str, Any], source: str, request: CalibrationRequest) -> Camera:
    """A camera with the intrinsics of `table`, an arbitrary pose, and the requested values."""
    asked = {key: getattr(request, key) for key in ("rate_hz", "exposure_s", "water_index")}
    asked = {key: value for key, value in asked.items() if value is not None}
    return check(CameraFile, {"camera": _DEFAULTS | table | asked | _ANY_POSE}, source).camera


def significant(table: dict[str, Any]) -> dict[str, Any]:
    """A camera's table with significant digits only."""
    return {k: [round(v, _DIGITS[k]) for v in value] if k in _DIGITS else value for k, value in table.items()}


def _write(out: Path, table: dict[str, Any], summary: str, panels: list[Pixels]) -> list[str]:
    """Write the camera file, with significant digits only, and the picture."""
    table = significant(table)
    text = f"# Found by `localizer calibrate`, {time.strftime('%Y-%m-%d %H:%M')}: {summary}.\n"
    text += f'# In an experiment: camera = "{out.name}", or this table.\n\n[camera]\n'
    text += "".join(f"{key} = {toml_value(value)}\n" for key, value in table.items())
    try:
        replace_text(out, text)
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written: {error.strerror}") from None
    picture = out.with_suffix(".png")
    write_picture(picture, np.concatenate(panels, axis=1))
    return [f"Wrote {out} and {picture}"]

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
from localizer.calibration.images import pictures, read_picture, shown
from localizer.calibration.intrinsics import IntrinsicsFit, distinct_views, fit_intrinsics, intrinsics_faults
from localizer.calibration.report import intrinsics_lines, intrinsics_picture, pose_lines, pose_picture
from localizer.calibration.survey_points import SurveyFile, seen_pixels
from localizer.calibration.targets import EXAMPLES, TargetView, parse_target
from localizer.detection.image_regions import Pixels
from shoal.config.loader import check, read_toml, toml_value
from shoal.config.perception import Camera, CameraFile
from shoal.errors import ConfigError, os_errors_as_config_errors
from shoal.runtime.output_files import check_output, dated, replacing_together

_NO_POSE = "Without --pool-points the camera has no pose yet: --lens {out} --pool-points FILE finds it."
_OLD_POSE = (
    "WARNING: the pose in it is the earlier one, found with the earlier lens: --lens {out} --pool-points FILE finds it again."
)
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
    force: bool = False  # write a lens that should not be used


@dataclass(frozen=True)
class CalibrationReport:
    """The report's lines, and the reason why no camera file was written; "" if one was."""

    lines: list[str]
    refusal: str = ""


def calibrate(request: CalibrationRequest) -> CalibrationReport:
    """Find the intrinsics from pictures of a target (or take them from a file), then the pose from points of the pool.

    Writes the camera file and a picture beside it. What an earlier file at that place holds and this run does not find stays,
    and the file itself is kept beside. Raises ConfigError.
    """
    _check_request(request)
    earlier = _earlier(request.out)
    points = None if request.points is None else check(SurveyFile, read_toml(request.points), str(request.points))
    image, drawn = _points_image(request, points), request.out.with_suffix(".png")
    _check_outputs(request, image, drawn)
    summary, lines, panels = [], [], []
    if request.lens is not None:
        camera = _read_lens(request, earlier)
        lines.append(f"Lens from {request.lens}")
    else:
        fit, left_out, backdrop = _fit_lens(request)
        _check_same_size(request.out, earlier, fit.lens.size_px)
        camera = _without_pose(earlier | fit.lens.model_dump(), "the camera found", request)
        lines += intrinsics_lines(fit, left_out)
        if (faults := intrinsics_faults(fit)) and not request.force:
            return CalibrationReport(lines, f"No camera file was written: {faults[0]} (--force writes it all the same)")
        panels.append(intrinsics_picture(backdrop, fit))
        summary.append(f"lens: {len(fit.views)} views, RMS {fit.rms_px:.2f} px")
    if points is not None:
        pose, backdrop = _fit_pose(camera, points, request)
        camera = pose.camera
        lines += ["", *pose_lines(pose, points.points, points.pool)]
        panels.append(pose_picture(backdrop, pose, points.points, points.pool))
        summary.append(f"pose: {len(points.points)} points, RMS {pose.rms_px:.2f} px")
    table = camera.model_dump(mode="json", exclude=set() if points else set(_ANY_POSE))
    if points is None:
        table |= {key: earlier[key] for key in _ANY_POSE if key in earlier}
    lines += ["", *_write(request.out, table, "; ".join(summary), panels)]
    if points is None:
        lines.append((_OLD_POSE if "position_m" in table else _NO_POSE).format(out=request.out))
    return CalibrationReport(lines)


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


def _earlier(out: Path) -> dict[str, Any]:
    """The table [camera] of the file that is there, {} if there is none. Raises ConfigError if it is no camera file."""
    if not out.exists():
        return {}
    content = read_toml(out)
    if set(content) != {"camera"} or not isinstance(content["camera"], dict):
        raise ConfigError(f"--out {out}: is there already, and holds something else than a camera (write to another file)")
    return content["camera"]


def _check_same_size(out: Path, earlier: dict[str, Any], size_px: tuple[int, int]) -> None:
    """Refuse points marked in pictures of one size together with a lens for another."""
    given = earlier.get("size_px")
    held = given if isinstance(given, list) else ["?"]
    if earlier and tuple(held) != size_px:
        sizes = ["x".join(map(str, size)) for size in (held, size_px)]
        raise ConfigError(
            f"--out {out}: holds a camera with pictures of {sizes[0]}, these are {sizes[1]}: its masks and pose would not fit "
            "(write to another file)"
        )


def _fit_lens(request: CalibrationRequest) -> tuple[IntrinsicsFit, dict[str, str], Pixels]:
    """The intrinsics, the pictures that were left out with the reasons, and a picture to draw on."""
    if request.board is None:
        raise ConfigError(f"--board: which board do the pictures show? (allowed: {EXAMPLES})")
    board = parse_target(request.board)
    left_out, backdrops = dict[str, str](), dict[tuple[int, int], Pixels]()
    views: dict[tuple[int, int], list[TargetView]] = {}  # by the picture's size
    sizes: dict[str, tuple[int, int]] = {}  # of pictures by name
    for name, picture in pictures(request.sources, request.every, request.grey, left_out):
        sizes[name] = size_px = (picture.shape[1], picture.shape[0])
        view = board.find(np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), dtype=np.uint8), name)
        if view is None:
            left_out[name] = "no board found"
        else:
            views.setdefault(size_px, []).append(view)
            backdrops[size_px] = picture
    if not views:
        legacy = ", or is it drawn by an OpenCV before 4.6 (:legacy)" if request.board.startswith("charuco") else ""
        where = f"found in none of {len(sizes)} pictures"
        raise ConfigError(f"--board {request.board}: {where}; are counts and kind right{legacy}?")
    size_px = max(views, key=lambda size: (len(views[size]), size))
    _leave_out_other_sizes(request, sizes, size_px, left_out)
    kept, repeated = distinct_views(views[size_px])
    left_out |= {view.name: f"shows the board as in {Path(same.name).name}" for view, same in repeated}
    used = [kept[i] for i in np.unique(np.linspace(0, len(kept) - 1, _MOST_VIEWS).astype(int))]
    if len(kept) > len(used):
        left_out[f"{len(kept) - len(used)} more views"] = "evenly taken out, not needed"
    return fit_intrinsics(used, size_px), left_out, backdrops[size_px]


def _leave_out_other_sizes(
    request: CalibrationRequest, sizes: dict[str, tuple[int, int]], size_px: tuple[int, int], left_out: dict[str, str]
) -> None:
    """Leave out a folder's pictures of another size, such as a camera's thumbnails. Raises ConfigError for one that was named
    itself: it shows another camera, or a mistake."""
    named = {shown(source) for source in request.sources}
    for name, size in sizes.items():
        if size == size_px:
            continue
        text = f"{size[0]}x{size[1]}, but most boards are in pictures of {size_px[0]}x{size_px[1]}"
        if name in named:
            raise ConfigError(f"{name}: {text}: all must come from one camera at one size")
        left_out[name] = text


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


def _read_lens(request: CalibrationRequest, earlier: dict[str, Any]) -> Camera:
    """The lens of a file, with the other sections of an earlier file at the output's place."""
    assert request.lens is not None
    camera = read_toml(request.lens).get("camera", {})
    if not isinstance(camera, dict):
        raise ConfigError(f"{request.lens}: camera = {camera!r}: must be a table")
    size_px = camera.get("size_px")
    if isinstance(size_px, list):
        _check_same_size(request.out, earlier, tuple(size_px))
    return _without_pose(earlier | {key: value for key, value in camera.items() if value != []}, str(request.lens), request)


def _without_pose(table: dict[str, Any], source: str, request: CalibrationRequest) -> Camera:
    """A camera with the intrinsics of `table`, an arbitrary pose, and the requested values."""
    overrides = {key: getattr(request, key) for key in ("rate_hz", "exposure_s", "water_index")}
    overrides = {key: value for key, value in overrides.items() if value is not None}
    return check(CameraFile, {"camera": _DEFAULTS | table | overrides | _ANY_POSE}, source).camera


def significant(table: dict[str, Any]) -> dict[str, Any]:
    """A camera's table with significant digits only."""
    return {k: [round(v, _DIGITS[k]) for v in value] if k in _DIGITS else value for k, value in table.items()}


def _write(out: Path, table: dict[str, Any], summary: str, panels: list[Pixels]) -> list[str]:
    """Write the camera file, with significant digits only, and the picture."""
    table = significant(table)
    text = f"# Found by `localizer calibrate`, {time.strftime('%Y-%m-%d %H:%M')}: {summary}.\n"
    text += f'# In an experiment: camera = "{out.name}", or this table.\n\n[camera]\n'
    text += "".join(f"{key} = {toml_value(value)}\n" for key, value in table.items())
    picture = out.with_suffix(".png")
    _, drawn = cv2.imencode(picture.suffix, np.concatenate(panels, axis=1))
    with os_errors_as_config_errors(out), replacing_together() as opened:
        file = opened(out, keep=dated)
        file.write(text.encode())
        beside = opened(picture, keep=dated)
        beside.write(drawn.tobytes())
    kept = [str(new.kept) for new in (file, beside) if new.kept is not None]
    return [f"Wrote {out} and {picture}{'; kept of before: ' if kept else ''}{', '.join(kept)}"]

"""SHELL: `localizer calibrate` and `localizer check`: files in, files and lines out.

pictures -> board's corners -> lens --+
points file (+ picture) --------------+-> pose over the pool -> camera.toml, picture, lines
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tomli_w

from localizer.board_files import pictures, read_picture, write_picture
from localizer.board_views import EXAMPLES, BoardView, parse_board
from localizer.calibrate import Lens, LensFit, fit_lens
from localizer.calibrate_report import figure_lines, lens_lines, lens_picture, pose_lines, pose_picture
from localizer.patch import BAYER_TO_BGR, Pixels
from localizer.pool_grid import GRID_M, draw_grid, figures
from localizer.pool_pose import PoolPoints, PoseFit, fit_pose, seen_pixels
from wire import topics
from wire.bus import Bus
from wire.experiment import Camera, Experiment
from wire.messages import Frame
from wire.runtime import Stop, wait
from wire.toml_file import ConfigError, Section, check, read_toml

LIVE_PATIENCE_S = 5.0
_NO_POSE = "Without --pool-points the camera has no pose yet: --lens {out} --pool-points FILE finds it."
_MOST_VIEWS = 60  # more add seconds, not knowledge
_DIGITS = {"focal_px": 3, "centre_px": 3, "distortion": 7, "position_m": 5, "rotation_rad": 6}  # 0.01 px and 0.01 mm


class LensFile(Section):
    """The part of a camera file that `--lens` takes over."""

    camera: Lens


@dataclass(frozen=True)
class Request:
    """What `localizer calibrate` was asked for; the file formats are those of docs/calibration.md."""

    sources: tuple[Path, ...]
    board: str | None
    every: int
    lens: Path | None
    points: Path | None
    image: Path | None
    out: Path
    rate_hz: float
    exposure_s: float
    water_index: float


def calibrate(request: Request) -> list[str]:
    """Find the lens from pictures of a board (or take it from a file), then the pose from points of the pool. Writes the
    camera file and a picture beside it; returns the report's lines. Raises ConfigError."""
    _check_request(request)
    points = None if request.points is None else check(PoolPoints, read_toml(request.points), str(request.points))
    summary, lines, panels = [], [], []
    if request.lens is not None:
        lens = _read_lens(request.lens)
        lines.append(f"Lens from {request.lens}")
    else:
        fit, missing, backdrop = _fit_lens(request)
        lens = fit.lens
        lines += lens_lines(fit, missing)
        panels.append(lens_picture(backdrop, fit))
        summary.append(f"lens: {len(fit.views)} views, RMS {fit.rms_px:.2f} px")
    table = _rounded(lens.model_dump(mode="json")) | {
        "water_index": request.water_index, "rate_hz": request.rate_hz, "exposure_s": request.exposure_s
    }  # fmt: skip
    if points is not None:
        pose, backdrop = _fit_pose(table, points, request)
        lines += ["", *pose_lines(pose, points.points, points.pool)]
        panels.append(pose_picture(backdrop, pose, points.points, points.pool))
        summary.append(f"pose: {len(points.points)} points, RMS {pose.rms_px:.2f} px")
        table = _rounded(pose.camera.model_dump(mode="json"))
    lines += ["", *_write(request.out, table, "; ".join(summary), panels)]
    return [*lines, *([] if points else [_NO_POSE.format(out=request.out)])]


def check_camera(experiment: Experiment, picture: Pixels | None, what: str, depth_m: float, out: Path) -> list[str]:
    """Draw the experiment's pool over a BGR picture called `what` (on black without one) into `out`; returns the report's
    lines. Raises ConfigError."""
    width, height = experiment.camera.size_px
    if picture is None:
        picture = np.zeros((height, width, 3), np.uint8)
    if picture.shape[:2] != (height, width):
        found = f"{picture.shape[1]}x{picture.shape[0]}"
        raise ConfigError(f"{what}: {found}, but camera.size_px of experiment {experiment.name!r} is {width}x{height}")
    lines = figure_lines(figures(experiment.camera, experiment.pool, depth_m), depth_m)
    drawn = picture.copy()
    draw_grid(drawn, experiment.camera, experiment.pool, depth_m)
    write_picture(out, drawn)
    return [*lines, f"Wrote {out}: pink the grid ({GRID_M} m) at {depth_m:g} m, yellow the surface's edge, green the floor's."]


def live_picture(bus: Bus, stop: Stop) -> Pixels:
    """The newest frame on the bus, as BGR. Raises ConfigError when there is none."""
    frames = bus.inbox(topics.FRAME, Frame)
    wait(bus, stop, lambda: frames.newest_header() is not None, LIVE_PATIENCE_S)
    received = frames.newest()
    if received is None:
        why = frames.last_error or "is the station up, and a camera or simulator running?"
        raise ConfigError(f"--live: no frame on {frames.name} within {LIVE_PATIENCE_S:g} s: {why}")
    return np.asarray(cv2.cvtColor(received.message.pixels, BAYER_TO_BGR), dtype=np.uint8)


def _check_request(request: Request) -> None:
    """What can be refused before minutes of work."""
    if (request.lens is None) == (not request.sources):
        raise ConfigError("give either pictures of a board (files, folders, videos), or --lens FILE with a lens found earlier")
    if request.lens is not None and request.points is None:
        raise ConfigError("--lens finds nothing new by itself: give --pool-points too")
    if request.image is not None and request.points is None:
        raise ConfigError("--pool-points-image is the picture that --pool-points were seen in: give both")
    if request.out.suffix != ".toml" or not request.out.parent.is_dir():
        raise ConfigError(f"--out {request.out}: must end in .toml, in a folder that exists")


def _fit_lens(request: Request) -> tuple[LensFit, list[str], Pixels]:
    """The lens, the names of pictures without the board, and a picture to draw on."""
    if request.board is None:
        raise ConfigError(f"--board: which board do the pictures show? (allowed: {EXAMPLES})")
    board = parse_board(request.board)
    views, missing, backdrop = list[BoardView](), list[str](), np.empty((0, 0, 3), np.uint8)
    for name, picture in pictures(request.sources, request.every):
        view = board.find(np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), dtype=np.uint8), name)
        backdrop = picture
        if view is None:
            missing.append(name)
        else:
            views.append(view)
    if not views:
        raise ConfigError(f"--board {request.board}: found in none of {len(missing)} pictures; are counts and kind right?")
    if len(views) > _MOST_VIEWS:
        views = [views[i] for i in np.linspace(0, len(views) - 1, _MOST_VIEWS).astype(int)]
    height, width, _ = backdrop.shape
    return fit_lens(views, (width, height)), missing, backdrop


def _fit_pose(table: dict[str, Any], points: PoolPoints, request: Request) -> tuple[PoseFit, Pixels]:
    """The pose, and the picture it was found in, black if there was none."""
    somewhere = {"position_m": (0.0, 0.0, -1.0)}
    camera = check(Camera, table | somewhere, "the camera found")
    image = request.image
    assert request.points is not None
    if image is None and points.image is not None:
        image = request.points.parent / points.image
    width, height = camera.size_px
    picture = None if image is None else read_picture(image)
    if picture is not None and picture.shape[:2] != (height, width):
        raise ConfigError(f"{image}: {picture.shape[1]}x{picture.shape[0]}, but the lens was found at {width}x{height}")
    grey = None if picture is None else np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    try:
        pose = fit_pose(camera, points.points, seen_pixels(points.points, grey))
    except ConfigError as error:
        raise ConfigError(f"{request.points}: {error}") from None
    return pose, np.zeros((height, width, 3), np.uint8) if picture is None else picture


def _read_lens(path: Path) -> Lens:
    table = read_toml(path)
    camera = table.get("camera", {})
    if isinstance(camera, dict):
        camera = {key: value for key, value in camera.items() if key in Lens.model_fields}
    return check(LensFile, {"camera": camera}, str(path)).camera


def _rounded(table: dict[str, Any]) -> dict[str, Any]:
    """Digits that mean something: the rest would only look precise."""
    return {k: [round(v, _DIGITS[k]) for v in value] if k in _DIGITS else value for k, value in table.items()}


def _write(out: Path, table: dict[str, Any], summary: str, panels: list[Pixels]) -> list[str]:
    """The camera file, checked if it is complete, and the picture."""
    if "position_m" in table:
        check(Camera, table, str(out))
    text = f"# Found by `localizer calibrate`, {time.strftime('%Y-%m-%d %H:%M')}: {summary}.\n"
    text += f'# In an experiment: camera = "{out.name}", or this table.\n\n'
    try:
        out.write_text(text + tomli_w.dumps({"camera": table}), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written: {error.strerror}") from None
    picture = out.with_suffix(".png")
    write_picture(picture, np.concatenate(panels, axis=1))
    return [f"Wrote {out} and {picture}"]

"""SHELL: the work of a setup, and its results. The page's requests, the camera's thread and the board's thread meet
here, under one lock; fits run outside it.

All work belongs to a size of picture. When the camera changes its size the work for the old size is kept, and counts again
when that size is back.
"""

import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import cv2
import numpy as np

from localizer.calibration.extrinsics import PoseFit
from localizer.calibration.intrinsics import IntrinsicsFit, intrinsics_warnings
from localizer.calibration.pool_grid import draw_grid
from localizer.calibration.report import intrinsics_lines, pose_lines
from localizer.calibration.workflow import significant
from localizer.camera_model import Intrinsics
from localizer.detection.fiducials import marker_centres
from localizer.detection.image_regions import BAYER_TO_BGR, BAYER_TO_GREY, Pixels
from localizer.setup.experiment_file import ExperimentFile
from localizer.setup.lens_step import LensStep
from localizer.setup.picture_figures import PictureFigures, PictureJudge, rate_verdict
from localizer.setup.survey_step import SurveyStep, outline_corners, outline_px
from localizer.sources.base import CapturedFrame
from localizer.sources.v4l2_controls import EXPOSURE_UNIT_S, EXPOSURES, CameraControl, CameraControls
from shoal.config.experiment import Experiment
from shoal.config.perception import Camera
from shoal.errors import ConfigError

DEFAULT_BOARD = "charuco:7x5:0.04:0.03:DICT_4X4_50"
_JPEG_QUALITY = 80  # 200 kB at 1280 x 960; corners in the magnifier stay clean
_GUESSED_FOCAL = 0.8  # of the picture's width: a lens of 64 degrees, by which tilts of a board are told until one is found
_ASK_AGAIN_S = 2.0  # s
_RATE_WEIGHT = 0.1  # of a new interval in the running mean that gives the rate


@dataclass(eq=False)
class CameraWork:
    """The work at one size of picture. `camera`: the experiment's with the lens and pose found so far; None while no lens is
    known for this size."""

    size_px: tuple[int, int]
    camera: Camera | None
    survey: SurveyStep
    lens: LensStep
    masks: dict[int, list[list[float]]] = field(default_factory=dict)
    lens_fit: IntrinsicsFit | None = None
    pose_fit: PoseFit | None = None
    lens_said: list[str] = field(default_factory=list)
    pose_said: list[str] = field(default_factory=list)


class SetupSession:
    """One camera's setup. Requests come by name through `do`; every trouble is a ConfigError in words."""

    def __init__(self, experiment: Experiment, file: ExperimentFile, source: str, controls: CameraControls | None) -> None:
        self._experiment, self._file, self._source, self._controls = experiment, file, source, controls
        self._lock = threading.RLock()
        self._judge = PictureJudge()
        self._figures: PictureFigures | None = None
        self._captured: CapturedFrame | None = None
        self._grey: Pixels | None = None
        self._mean_interval_s, self.trouble = 0.0, "waiting for the first picture"
        self._over = False  # the source was a recording, and there is no more of it
        self._board = DEFAULT_BOARD
        self._works: dict[tuple[int, int], CameraWork] = {}
        self._work = self._work_at(experiment.camera.size_px)
        self._collecting = False
        self._grid_depth_m: float | None = None
        self._set: dict[str, int] = {}  # controls that were set here
        self._controls_now: tuple[tuple[CameraControl, ...], str] = (), ""
        self._asked_s = -math.inf  # when the camera was asked for its controls
        self._next_mask = 1 + len(self._work.masks)
        self._note = ""
        self._commands: dict[str, Callable[[Mapping[str, Any]], Any]] = {
            "grid": self._show_grid,
            "focus": lambda _: self._judge.forget_focus(),
            "control": lambda arguments: self._set_control(str(arguments["name"]), int(arguments["value"])),
            "defaults": self._set_defaults,
            "board": lambda arguments: self._choose_board(str(arguments["board"])),
            "collect": self._collect,
            "drop-view": lambda arguments: self._work.lens.drop(str(arguments["name"])),
            "fit-lens": self._fit_lens,
            "point": self._put_point,
            "remove-point": lambda arguments: self._work.survey.remove(str(arguments["name"])),
            "markers": self._find_markers,
            "fit-pose": self._fit_pose,
            "mask": self._put_mask,
            "difference": lambda _: {"path": str(self._file.path), "lines": self._file.difference(self._changes())},
            "save": self._save,
            "reload": self._reload,
        }

    # --- from the camera's thread and the board's

    def take(self, captured: CapturedFrame, interval_s: float) -> None:
        """Take in the newest frame, which came `interval_s` after the previous one: keep it, and judge it."""
        grey = np.asarray(cv2.cvtColor(captured.pixels, BAYER_TO_GREY), dtype=np.uint8)
        height, width = grey.shape
        with self._lock:
            weight = _RATE_WEIGHT if self._mean_interval_s else 1.0
            self._mean_interval_s += weight * (interval_s - self._mean_interval_s)
            self._captured, self._grey, self.trouble = captured, grey, ""
            if (width, height) != self._work.size_px:
                self._resize((width, height))
            camera = self._work.camera
            px_per_m = None if camera is None else camera.px_per_m
        self._figures = self._judge.judge(captured.pixels, grey, self._exposure_s(), px_per_m)

    def end_recording(self) -> None:
        """Take in that no picture comes any more: the last one stays, which is no trouble."""
        with self._lock:
            self._over = True
            if self._captured is not None:
                self.trouble = ""

    def look_for_board(self) -> None:
        """Offer the newest picture to the lens's step, if views are being collected."""
        with self._lock:
            lens, grey, wanted = self._work.lens, self._grey, self._collecting
        if wanted and grey is not None and grey.shape == self._work.size_px[::-1]:
            lens.offer(grey)

    def _resize(self, size_px: tuple[int, int]) -> None:
        before = self._work
        self._work = self._work_at(size_px)
        here, there = ("x".join(map(str, work.size_px)) for work in (self._work, before))
        self._note = f"pictures are {here} now; views, points and masks for {there} are kept, and count when that size is back"

    def _work_at(self, size_px: tuple[int, int]) -> CameraWork:
        """The work for a size of picture, begun if there was none."""
        if size_px not in self._works:
            camera = self._experiment.camera
            camera_of_size = camera if camera.size_px == size_px and self._file.has_camera else None
            survey = SurveyStep(self._experiment.pool, self._experiment.localizer.marker_family)
            lens = LensStep(self._board, _guess(size_px) if camera_of_size is None else Intrinsics.of(camera_of_size))
            masks = {} if camera_of_size is None else _masks(camera_of_size)
            self._works[size_px] = CameraWork(size_px, camera_of_size, survey, lens, masks)
        return self._works[size_px]

    # --- what the page shows

    @property
    def overlay(self) -> tuple[Camera | None, float | None]:
        """The camera and the depth, if any, of the grid that is drawn over the picture."""
        with self._lock:
            return self._work.camera, self._grid_depth_m

    def jpeg(self) -> bytes:
        """The newest picture, with the pool's grid if that was asked for; empty before the first."""
        with self._lock:
            captured, (camera, depth_m) = self._captured, self.overlay
        if captured is None:
            return b""
        picture = np.asarray(cv2.cvtColor(captured.pixels, BAYER_TO_BGR), dtype=np.uint8)
        if depth_m is not None and camera is not None:
            draw_grid(picture, camera, self._experiment.pool, depth_m)
        return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()

    def state(self, pages: int) -> dict[str, Any]:
        """All that the page shows, as JSON has it; `pages` are open."""
        controls, no_controls = self._offered()
        with self._lock:
            work, camera = self._work, self._experiment.camera
            dropped = 0 if self._captured is None else self._captured.dropped
            rate_hz = 1.0 / self._mean_interval_s if self._mean_interval_s else 0.0
            notes = [self._note] if self._note else []
            if pages > 1:
                notes.append(f"{pages} pages are open: all see and change the same setup")
            if self._over:
                notes.append("the recording is over; its last picture stays")
            if work.camera is None:
                notes.append(self._no_lens())
            if work.lens_fit is not None and work.pose_fit is None:
                notes.append("the pose is older than the lens, and wrong with it: find the pose again")
            return {
                "experiment": self._experiment.name,
                "source": self._source,
                "trouble": self.trouble,
                "said": notes,
                "size_px": work.size_px,
                "rate": asdict(rate_verdict(rate_hz, camera.rate_hz, dropped)),
                "figures": None if self._figures is None else asdict(self._figures),
                "controls": [asdict(control) for control in controls],
                "no_controls": no_controls,
                "grid_depth_m": self._grid_depth_m,
                "lens": self._lens_state(work),
                "survey": self._survey_state(work),
                "outline": {} if work.camera is None else outline_px(work.camera, self._experiment.pool),
                "outline_m": outline_corners(self._experiment.pool),
                "masks": [{"id": number, "corners_px": corners} for number, corners in work.masks.items()],
                "path": str(self._file.path),
                "changed": dict(sorted(self._changes().items())),
            }

    def _lens_state(self, work: CameraWork) -> dict[str, Any]:
        """State of the lens step, for the page."""
        lens = work.lens
        return {
            "board": lens.board,
            "collecting": self._collecting,
            "said": lens.advice,
            "seen_px": lens.seen_px.round(1).tolist(),
            "coverage": lens.coverage,
            "tilts_deg": [np.degrees(posture.tilt_rad).round(1).tolist() for posture in lens.postures],
            "views": [view.name for view in lens.views],
            "missing": lens.missing,
            "report": work.lens_said,
        }

    def _survey_state(self, work: CameraWork) -> dict[str, Any]:
        survey = work.survey
        return {
            "points": [point.model_dump(mode="json") for point in survey.points.values()],
            "residuals": [asdict(residual) for residual in survey.residuals.values()],
            "report": work.pose_said,
        }

    # --- what the page asks for

    def do(self, name: str, arguments: Mapping[str, Any]) -> Any:
        """Do what a page asks for; returns the answer, which is not part of the state. Raises ConfigError."""
        if name not in self._commands:
            raise ConfigError(f"{name!r}: no such request (allowed: {', '.join(self._commands)})")
        if not _is_finite(arguments):
            raise ConfigError(f"{name}: NaN or an infinity (allowed: finite numbers)")
        try:
            return self._commands[name](arguments)
        except (KeyError, TypeError, ValueError) as error:
            raise ConfigError(f"{name}: {type(error).__name__}: {error}") from None

    def _show_grid(self, arguments: Mapping[str, Any]) -> None:
        depth_m = arguments.get("depth_m")
        self._grid_depth_m = None if depth_m is None else float(np.clip(float(depth_m), -1.0, 20.0))

    def _offered(self) -> tuple[tuple[CameraControl, ...], str]:
        """The camera's controls, and the reason if there are none; asked for now and then, as that opens the device."""
        if self._controls is None:
            return (), "this source offers no controls"
        if time.monotonic() - self._asked_s > _ASK_AGAIN_S:
            self._asked_s = time.monotonic()
            try:
                offered = self._controls.offered()
                self._controls_now = offered, "" if offered else "this camera offers no controls"
            except ConfigError as error:
                self._controls_now = (), str(error)
        return self._controls_now

    def _set_control(self, name: str, value: int) -> None:
        if self._controls is None:
            raise ConfigError("this source offers no controls")
        self._controls.set(name, value)
        self._set[name], self._asked_s = value, -math.inf

    def _set_defaults(self, arguments: Mapping[str, Any]) -> None:
        for control in self._offered()[0]:
            if control.usable:
                self._set_control(control.name, control.default)

    def _exposure_s(self) -> float:
        exposures_s = [self._set[name] * EXPOSURE_UNIT_S for name in EXPOSURES if name in self._set]
        return exposures_s[0] if exposures_s else self._experiment.camera.exposure_s

    def _choose_board(self, board: str) -> None:
        """Begin with another board. Views of the one before are gone: their corners are other places."""
        with self._lock:
            if board != self._work.lens.board:
                camera = self._work.camera
                lens = _guess(self._work.size_px) if camera is None else Intrinsics.of(camera)
                self._work.lens, self._board = LensStep(board, lens), board

    def _collect(self, arguments: Mapping[str, Any]) -> None:
        self._collecting = bool(arguments["on"])

    def _fit_lens(self, arguments: Mapping[str, Any]) -> None:
        """Fit the lens to the collected views. What was fitted with the lens before is dropped."""
        with self._lock:
            work = self._work
        fit = work.lens.fit()
        lines, warnings, held_out_px = intrinsics_lines(fit, {}), intrinsics_warnings(fit), fit.held_out_rms_px
        summary = f"lens: {len(fit.views)} views, RMS {fit.rms_px:.2f} px"
        summary += "" if held_out_px is None else f", {held_out_px:.2f} px in views held out"
        summary += f"; look at: {'; '.join(warnings)}" if warnings else ""
        with self._lock:
            work.lens_fit, work.pose_fit, work.pose_said = fit, None, []
            work.survey.residuals.clear()
            work.camera = self._experiment.camera.model_copy(update=fit.lens.model_dump())
            work.lens_said, self._note = lines, summary

    def _put_point(self, arguments: Mapping[str, Any]) -> None:
        """Note a survey point, given by a pixel or a marker."""
        x, y, z = (float(value) for value in arguments["pool_m"])
        pixel, marker = arguments.get("pixel_px"), arguments.get("marker_id")
        with self._lock:
            self._note = self._work.survey.put(
                str(arguments["name"]).strip(),
                (x, y, z),
                None if pixel is None else np.array(pixel, dtype=np.float64).reshape(2),
                None if marker is None else int(marker),
                self._grey,
            )

    def _find_markers(self, arguments: Mapping[str, Any]) -> list[int]:
        if self._grey is None:
            raise ConfigError("no picture yet")
        return sorted(marker_centres(self._grey, self._experiment.localizer.marker_family))

    def _fit_pose(self, arguments: Mapping[str, Any]) -> None:
        """Find the camera's pose from the points that were marked. Raises ConfigError."""
        with self._lock:
            work, grey, camera = self._work, self._grey, self._work.camera
        if camera is None:
            raise ConfigError(self._no_lens())
        fit, points = work.survey.fit(camera, grey)
        with self._lock:
            if work.camera is None or Intrinsics.of(work.camera) != Intrinsics.of(camera):
                raise ConfigError("another lens was found meanwhile: find the pose again")
            work.survey.note_errors(fit, points)
            work.pose_fit, work.camera = fit, fit.camera
            work.pose_said = pose_lines(fit, points, self._experiment.pool)
            self._note = f"pose: {len(points)} points, RMS {fit.rms_px:.2f} px"
            if fit.suspect is not None:
                self._note += f"; point {points[fit.suspect].name!r} does not fit: without it the others agree"

    def _put_mask(self, arguments: Mapping[str, Any]) -> None:
        """Add a polygon, or with its id change it; fewer than three corners delete it."""
        corners = [[round(float(u), 1), round(float(v), 1)] for u, v in arguments["corners_px"]]
        with self._lock:
            number = int(arguments.get("id") or self._next_mask)
            if len(corners) < 3:
                self._work.masks.pop(number, None)
                return
            self._next_mask = max(self._next_mask, number + 1)
            self._work.masks[number] = corners

    def _no_lens(self) -> str:
        here, there = ("x".join(map(str, size)) for size in (self._work.size_px, self._experiment.camera.size_px))
        lens = f"the experiment's lens is for {there}" if self._file.has_camera else "the experiment has no camera yet"
        return f"pictures are {here}, and {lens}: find the lens first"

    def _changes(self) -> dict[str, Any]:
        """Keys of [camera] with the values found in this setup, as far as they differ; all where the file has no camera."""
        work, before = self._work, self._experiment.camera
        results: dict[str, Any] = {}
        if work.lens_fit is not None:
            results |= work.lens_fit.lens.model_dump(mode="json")
        if work.pose_fit is not None:
            results |= work.pose_fit.camera.model_dump(mode="json", include={"position_m", "rotation_rad"})
        if work.camera is not None:
            results["masks_px"] = list(work.masks.values())
        values = {name: value for name, value in self._set.items() if name not in EXPOSURES}
        if values:
            results["controls"] = [[name, value] for name, value in (dict(before.controls) | values).items()]
        if values != self._set:
            results["exposure_s"] = round(self._exposure_s(), 5)
        if results and not self._file.has_camera:
            rate_hz = float(max(round(1.0 / self._mean_interval_s), 1)) if self._mean_interval_s else before.rate_hz
            results = {"rate_hz": rate_hz, "exposure_s": round(self._exposure_s(), 5)} | results
        was = before.model_dump(mode="json") if self._file.has_camera else {}
        return {key: value for key, value in significant(results).items() if key not in was or value != was[key]}

    def _save(self, arguments: Mapping[str, Any]) -> None:
        changes = self._changes()
        if not changes:
            raise ConfigError("nothing was changed: there is nothing to save")
        self._note = self._file.save(changes)
        self._take_up_file()

    def _reload(self, arguments: Mapping[str, Any]) -> None:
        self._file.reload()
        self._take_up_file()

    def _take_up_file(self) -> None:
        """Compare changes with the present file. Keys that the setup did not change come from the file, as somebody else may
        have written them meanwhile; a pose found with another lens than the file's is dropped."""
        with self._lock:
            before, held = self._experiment.camera, self._file.camera
            self._experiment = self._experiment.model_copy(update={"camera": held})
            for work in self._works.values():
                of_file = held if self._file.has_camera and held.size_px == work.size_px else None
                lens = work.lens_fit.lens if work.lens_fit is not None else of_file and Intrinsics.of(of_file)
                if lens != (work.camera and Intrinsics.of(work.camera)):
                    if work.pose_fit is not None:
                        self._note = "the file holds another lens now: find the pose again"
                    work.pose_fit, work.pose_said = None, []
                    work.survey.residuals.clear()
                camera = None if lens is None else held.model_copy(update=lens.model_dump())
                if camera is not None and work.pose_fit is not None:
                    pose = work.pose_fit.camera.model_dump(include={"position_m", "rotation_rad"})
                    camera = camera.model_copy(update=pose)
                work.camera = camera
                if of_file is not None and list(work.masks.values()) == list(_masks(before).values()):
                    work.masks = _masks(of_file)
            self._next_mask = max(self._next_mask, 1 + max(self._work.masks, default=0))


def _is_finite(content: Any) -> bool:
    """False if there is a NaN or an infinity in what a page sent."""
    if isinstance(content, Mapping):
        return all(_is_finite(value) for value in content.values())
    if isinstance(content, list):
        return all(_is_finite(value) for value in content)
    return not isinstance(content, float) or math.isfinite(content)


def _masks(camera: Camera) -> dict[int, list[list[float]]]:
    """A camera's masks by number."""
    return {i + 1: [list(px) for px in mask] for i, mask in enumerate(camera.masks_px)}


def _guess(size_px: tuple[int, int]) -> Intrinsics:
    """A lens for a size of picture that none is known for."""
    width, height = size_px
    focal = _GUESSED_FOCAL * width
    return Intrinsics(size_px=size_px, focal_px=(focal, focal), centre_px=((width - 1) / 2, (height - 1) / 2))

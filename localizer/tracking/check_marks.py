"""Check marks: markers at known places that a fixed camera reads in turns, so that a bump or sunken water is noticed.

One mark that is not at its place was moved itself. Most of them are not: the camera was moved. Marks on the floor that another
water level (one number) brings back to their places: the water sank or rose. In both cases the shift in the pool [m] is added
to every pose's covariance, and the operator is told. The median of a mark's last readings takes out waves and misreadings.
After a knock that no waves explain the last reading of each mark counts: most of them have one within the next pictures.
Fewer than most of the marks can tell that the camera was moved, never that it is back: covered marks clear nothing.
"""

import math
from collections import deque
from collections.abc import Sequence

import cv2
import numpy as np

from localizer.camera_model import LARGEST_FOLD_PX, Intrinsics, LocalLinearization, RefractiveCamera, fold_px
from localizer.detection.fiducials import find_markers, marker_detector
from localizer.detection.image_regions import ImageRegion, Pixels, cut, whole
from localizer.tracking.camera_pose import FixedCameraPose, corners_of, fit_camera_pose
from shoal.config.experiment import Experiment
from shoal.config.perception import LANDMARKS_NEEDED, Camera, Landmark, MarkerFamily
from shoal.errors import ConfigError
from shoal.frames import Array, wrap

REACH_PX = 40.0  # px around a mark in which it is looked for; when most are farther off, the whole picture is searched
SHIFTED_PX = 1.5  # px; ripples shift a mark by 0.3 px, and calibrations are good to 0.5 px
KNOCKED_PX = 8.0  # px; waves of 5 mm shift a mark by 3 px (0.05 rad, 0.25 of it over 1 m, 300 px/m)
READINGS = 5  # of a mark, of which the median counts; read in turns, four marks at 20 Hz have theirs within a second
_EARLY_MARKS = 2  # marks of the last pictures that are enough to doubt the poses, not to blame the camera
LEAST_DROP_M = 0.01  # m of water level that is told; ripples of 0.3 px make 5 mm of it with four marks on the floor
MOST_DROP_M = 0.2  # m; marks must be deeper than this to tell the level
_LEVEL_STEP_M = 1e-3  # m, step of the difference that gives the shifts' slope over the water level
_LEVEL_ROUNDS = 5  # Gauss-Newton iterations; the shifts are linear in the level to 1 % over 5 cm


def with_camera(experiment: Experiment, camera: str) -> Experiment:
    """The experiment with one of several cameras alone, and those of the check marks that its picture shows whole; as it is
    for "", the only camera. Raises ConfigError if there is no such camera, or if its lens cannot be undone."""
    alone = experiment.of_camera(camera)
    _check_lens(alone)
    if not camera or not alone.check_marks:
        return alone
    pixels = RefractiveCamera(alone.camera).pool_to_pixel(np.array([corners_of(mark) for mark in alone.check_marks]))
    inside = np.all((pixels >= 0.0) & (pixels <= np.array(alone.camera.size_px) - 1.0), axis=(1, 2))
    marks = tuple(mark for mark, is_inside in zip(alone.check_marks, inside, strict=True) if is_inside)
    return alone.model_copy(update={"check_marks": marks})


def _check_lens(experiment: Experiment) -> None:
    """Raise ConfigError for a lens whose distortion cannot be undone in all of the picture."""
    camera = experiment.camera
    if (fold := fold_px(Intrinsics.of(camera))) > LARGEST_FOLD_PX:
        raise ConfigError(
            f"{experiment.name}: camera.distortion = {list(camera.distortion)}: cannot be undone in all of the picture "
            f"({fold:.1f} px off), so places there would be wrong: calibrate again (docs/calibration.md), or take a lens "
            "that is less wide"
        )


class CheckedCameraPose(FixedCameraPose):
    """The pose of a fixed camera, watched by check marks."""

    def __init__(self, camera: Camera, marks: Sequence[Landmark], family: MarkerFamily = "4x4_50") -> None:
        super().__init__(camera)
        self._camera = camera
        self._corners = np.array([corners_of(mark) for mark in marks])  # (marks, 4, 3)
        self._ids = [mark.id for mark in marks]
        self._expected_px = self.view.pool_to_pixel(self._corners)  # (marks, 4, 2)
        self._places_px = self._expected_px.mean(axis=1)  # (marks, 2), where each was seen last
        self._detector = marker_detector(family)
        self._readings = [deque[Array | None](maxlen=READINGS) for _ in marks]  # corners (4, 2) px; None: not seen
        self._frames = 0
        self._covariance = self._early = np.zeros((3, 3))
        self._searched = False  # in the whole picture, since most marks were not seen
        self._verdict = ""  # on the camera or the water; empty if both are as the experiment says
        self.moved = self.marks_seen = False
        self.trouble = ""

    def update(self, frame: Pixels) -> None:
        """Read the next mark in a picture (height, width), and judge the mapping by all of them: after each round, or at once
        after a knock."""
        turn = self._frames % len(self._ids)
        self._frames += 1
        lost = sum(bool(readings) and readings[-1] is None for readings in self._readings)
        if 2 * lost <= len(self._ids):
            half_px = np.linalg.norm(self._expected_px[turn] - self._expected_px[turn].mean(axis=0), axis=1).max()
            self._read_marks([turn], cut(frame, self._places_px[turn], float(half_px) + REACH_PX))
            self._searched = False
        elif turn == 0 or not self._searched:  # as after a hard knock: a look at the whole picture at once, then one a round
            self._read_marks(range(len(self._ids)), whole(frame))
            self._searched = True
        self._early = self._early_covariance(turn)
        last = {k: px for k, readings in enumerate(self._readings) if readings and (px := readings[-1]) is not None}
        knocked = {k: px for k, px in last.items() if self._shift_px(k, px) > KNOCKED_PX}
        if 2 * len(knocked) > max(len(last), 2):
            self._judge(knocked)  # what was read before the knock counts no more
        elif turn == len(self._ids) - 1:
            by_mark = self._readings_by_mark()
            # of an even number the median would be half-way between the old and the new
            odd = {k: by_mark[k][1 - len(by_mark[k]) % 2 :] for k in last if len(by_mark[k]) > READINGS // 2}
            self._judge({k: np.median(readings, axis=0) for k, readings in odd.items()})

    def uncertainty(self, tangents: Sequence[LocalLinearization], depths_m: Sequence[float]) -> Array:
        """Covariances (n, 3, 3) of [x, y, yaw]: of the shift that the marks show, the same everywhere in the pool."""
        covariance = self._covariance if self._verdict else np.maximum(self._covariance, self._early)
        return np.tile(covariance, (len(tangents), 1, 1))

    def _early_covariance(self, turn: int) -> Array:
        """Covariance (3, 3) of the shift that the marks of the last _EARLY_MARKS pictures show if all have moved the same way;
        otherwise zero. `turn`: index of the mark that is read in this picture.

        The verdict on a small knock takes rounds, since waves move marks as far, but each in another direction. Poses get
        their greater uncertainty before it."""
        newest_px: dict[int, Array] = {}  # corners (4, 2) of each mark in the last pictures; a picture shows one in turn
        for k in sorted({(turn - back) % len(self._ids) for back in range(_EARLY_MARKS)}):
            corners_px = self._readings[k][-1] if self._readings[k] else None
            if corners_px is not None:
                newest_px[k] = corners_px
        if len(newest_px) < _EARLY_MARKS:
            return np.zeros((3, 3))
        shifts_px = np.array([(px - self._expected_px[k]).mean(axis=0) for k, px in newest_px.items()])
        mean_px = shifts_px.mean(axis=0)
        spread_px = np.linalg.norm(shifts_px - mean_px, axis=1).max()
        are_alike = spread_px < max(SHIFTED_PX / 2.0, 0.5 * float(np.linalg.norm(mean_px)))
        have_moved = np.linalg.norm(shifts_px, axis=1).min() > SHIFTED_PX
        return self._shift_covariance(newest_px) if have_moved and are_alike else np.zeros((3, 3))

    def _read_marks(self, marks: Sequence[int], region: ImageRegion | None) -> None:
        """Read some marks in a region of the picture, and keep the corners of each; without a region, keep that the marks are
        not seen."""
        images = [] if region is None else find_markers(self._detector, region)
        corners_by_id = {image.id: image.corners_px for image in images}
        for k in marks:
            corners = corners_by_id.get(self._ids[k])
            self._readings[k].append(corners)
            if corners is not None:
                self._places_px[k] = corners.mean(axis=0)

    def _readings_by_mark(self) -> list[list[Array]]:
        """The last readings of each mark in which it was seen: corners (4, 2) px."""
        return [[px for px in readings if px is not None] for readings in self._readings]

    def _judge(self, corners_px: dict[int, Array]) -> None:
        """Find the marks that are shifted among those with corners `corners_px` (4, 2), and what that means."""
        self.marks_seen = 2 * len(corners_px) > len(self._ids)
        missed = [k for k, readings in enumerate(self._readings) if len(readings) == READINGS and readings[-1] is None]
        unseen = [k for k in missed if len(self._readings_by_mark()[k]) <= READINGS // 2]
        shift_px = {k: self._shift_px(k, px) for k, px in corners_px.items()}
        shifted = [k for k, px in shift_px.items() if px > SHIFTED_PX]
        places, pixels = self._corners[list(corners_px)], np.array(list(corners_px.values())).reshape(-1, 4, 2)
        rms_px = float(np.sqrt(np.mean(np.square(list(shift_px.values()))))) if corners_px else 0.0
        drop_m, left_px = fit_water_drop(self._camera, places, pixels)
        sunk = abs(drop_m) > LEAST_DROP_M and left_px < rms_px / 2.0
        bumped = 2 * len(shifted) > len(corners_px) and (len(shifted) > 1 or len(self._ids) == 1)
        verdict = ""
        if sunk:
            higher = "lower" if drop_m > 0.0 else "higher"
            verdict = f"the water stands {abs(drop_m) * 1e3:.0f} mm {higher} than the experiment says"
        elif bumped:
            verdict = f"the camera was moved: check marks are {rms_px:.1f} px from their places{self._motion(places, pixels)}"
        moved = bumped and not sunk
        if self.marks_seen or moved or not self._verdict:
            covariance = self._shift_covariance(corners_px) if verdict else np.zeros((3, 3))
            self._covariance = covariance if self.marks_seen else np.maximum(covariance, self._covariance)
            self._verdict, self.moved = verdict, moved
        troubles = [f"check mark {self._ids[k]} is not seen" for k in unseen]
        if self._verdict:
            troubles.append(self._verdict)
        else:
            troubles += [f"check mark {self._ids[k]} is {shift_px[k]:.1f} px from its place: it was moved" for k in shifted]
        self.trouble = "; ".join(troubles)

    def _shift_px(self, mark: int, pixels: Array) -> float:
        """Distance of a mark, found with its corners at pixels (4, 2), from its place; infinite if that is not before the
        lens."""
        shift_px = float(np.linalg.norm((pixels - self._expected_px[mark]).mean(axis=0)))
        return shift_px if math.isfinite(shift_px) else math.inf

    def _shift_covariance(self, corners_px: dict[int, Array]) -> Array:
        """Covariance (3, 3) of [x, y, yaw]: the marks' mean square shift [m^2] and turn [rad^2] in the pool."""
        shifts, turns = [], []
        for k, pixels in corners_px.items():
            measured_m, true = self.view.pixel_to_pool(pixels, self._corners[k, :, 2]), self._corners[k, :, :2]
            shifts.append((measured_m - true).mean(axis=0))
            turns.append(wrap(_direction(measured_m) - _direction(true)))
        return np.diag([*np.mean(np.square(shifts), axis=0), np.mean(np.square(turns))])

    def _motion(self, places: Array, pixels: Array) -> str:
        """The camera's displacement as the end of a sentence, as far as enough marks show it."""
        if len(places) < LANDMARKS_NEEDED:
            return ""
        fitted, residuals_px = fit_camera_pose(self._camera, places, pixels)
        if not np.all(np.isfinite(residuals_px)):
            return ""
        old, new = (np.asarray(cv2.Rodrigues(np.array(c.rotation_rad))[0]) for c in (self._camera, fitted.camera))
        turn_rad = np.linalg.norm(np.asarray(cv2.Rodrigues(new @ old.T)[0]))
        moved_m = np.linalg.norm(np.subtract(fitted.camera.position_m, self._camera.position_m))
        return f", as if by {moved_m * 1e3:.0f} mm and {np.degrees(turn_rad):.1f} deg"


def fit_water_drop(camera: Camera, places: Array, pixels: Array) -> tuple[float, float]:
    """The drop of the water [m] below the level at which places (n, 4, 3) and camera were measured, fitted to corners that
    were found at pixels (n, 4, 2); and the RMS shift of the marks [px] that is left. 0 and infinity where no mark is
    under water."""
    if not np.any(places[:, :, 2] > MOST_DROP_M):
        return 0.0, math.inf
    drop_m = 0.0
    for _ in range(_LEVEL_ROUNDS):
        here = _with_drop(camera, places, drop_m)
        slope = (_with_drop(camera, places, drop_m + _LEVEL_STEP_M) - here) / _LEVEL_STEP_M
        change_m = float(np.sum(slope * (pixels - here)) / np.sum(slope * slope))
        drop_m = min(max(drop_m + change_m, -MOST_DROP_M), MOST_DROP_M)
    residuals_px = (pixels - _with_drop(camera, places, drop_m)).mean(axis=1)
    return drop_m, float(np.sqrt(np.mean(np.sum(residuals_px**2, axis=1))))


def _with_drop(camera: Camera, places: Array, drop_m: float) -> Array:
    """Pixels (n, 4, 2) of places when the water stands `drop_m` lower: its surface is z = 0, all else is higher by that."""
    higher = (camera.position_m[0], camera.position_m[1], camera.position_m[2] - drop_m)
    return RefractiveCamera(camera.model_copy(update={"position_m": higher})).pool_to_pixel(places - [0.0, 0.0, drop_m])


def _direction(corners: Array) -> float:
    """Heading of a mark's upper edge's normal, up to a constant, from its corners (4, 2)."""
    edge = corners[1] - corners[0]
    return math.atan2(edge[1], edge[0])

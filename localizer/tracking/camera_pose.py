"""The pose of a moving camera, estimated in every frame from landmarks: markers at known places of the pool.

    last pose -> predicted place of each landmark -> read it there -> fit the pose to all corners -> gates -> mapping

Landmarks under water are seen through the surface like everything else: the fit uses the exact mapping of camera_model.py.
Corners are weighted by their residual (Cauchy). A landmark that disagrees with the rest, because it was moved or misread,
does not count. With fewer than LANDMARKS_NEEDED that agree the mapping stays unchanged and grows stale.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from localizer.camera_model import LocalLinearization, RefractiveCamera
from localizer.detection.fiducials import find_markers, marker_detector, square
from localizer.detection.image_regions import ImageRegion, Pixels, cut, whole
from shoal.config.perception import LANDMARKS_NEEDED, Camera, Landmark, MarkerFamily
from shoal.frames import Array, body_to_pool

STALE_AFTER_S = 0.3  # s; with an older pose no robot is measured
_MARGIN_PX = 30.0  # px around the predicted place of a landmark: a drone moves it by 3 px a frame, a gust by ten
_SCAN_EVERY = 4  # frames between scans of the whole picture (15 ms each) while the pose is not known
_AGREES_PX = 2.0  # px, RMS of a landmark's four corners; ripples over 1 m of water move them by 0.3 px
_WEIGHT_PX = 0.7  # px, scale of the Cauchy weights
_LEAST_SPREAD_PX = 0.1  # px, least standard deviation of landmarks: a few may agree better by chance
_ROUNDS = 20  # most Gauss-Newton iterations; it takes four from the last frame's pose, seven from the experiment's
_SETTLED = 1e-5  # m and rad, step at which the iteration ends: a hundredth of a pixel
_SAME_SLOPES = 0.02  # m and rad; after a smaller step the derivatives of the corners are kept
_STEP = 1e-4  # m and rad, step of the differences; below 1e-5 rad OpenCV's Rodrigues returns no rotation
# Drift of the pose while landmarks are not seen, from a drone that sways by 0.25 m and tilts by 3 deg every 9 s.
_DRIFT_MPS, _DRIFT_RADPS = 0.2, 0.05


@dataclass(frozen=True)
class CameraPoseEstimate:
    """A camera's pose, and the covariance (6, 6) of its position [m] and of a small rotation in its own frame [rad]."""

    camera: Camera
    covariance: Array


class FixedCameraPose:
    """The pose of a camera that is fixed, as the experiment gives it."""

    fresh = usable = True
    moved = marks_seen = False
    trouble = ""

    def __init__(self, camera: Camera) -> None:
        self.view = RefractiveCamera(camera)

    def advance(self, elapsed_s: float) -> None:
        """Do nothing: the pose does not depend on time."""

    def update(self, frame: Pixels) -> None:
        """Do nothing: the pose does not depend on the picture."""

    def uncertainty(self, tangents: Sequence[LocalLinearization], depths_m: Sequence[float]) -> Array:
        """Zero covariances (n, 3, 3): a calibration error is the same in every frame, and no noise."""
        return np.zeros((len(tangents), 3, 3))


class CameraPoseTracker:
    """Tracker of a moving camera's pose. `view` is the newest mapping; before the first fit it is the experiment's guess."""

    def __init__(self, camera: Camera, landmarks: Sequence[Landmark], family: MarkerFamily = "4x4_50") -> None:
        self.view = RefractiveCamera(camera)
        self.pose = CameraPoseEstimate(camera, np.zeros((6, 6)))
        self._corners = np.array([corners_of(landmark) for landmark in landmarks])  # (landmarks, 4, 3)
        self._index = {landmark.id: i for i, landmark in enumerate(landmarks)}
        self._detector = marker_detector(family)
        self._age_s = np.inf  # of the pose
        self._frames = 0
        self._agreeing = 0

    moved = marks_seen = False  # that it moves is no news, and it has no check marks

    @property
    def fresh(self) -> bool:
        """True if the pose is of this frame."""
        return self._age_s == 0.0

    @property
    def usable(self) -> bool:
        """True if the pose is young enough to measure with."""
        return bool(self._age_s <= STALE_AFTER_S)

    @property
    def trouble(self) -> str:
        """The reason for an unknown pose, for the operator; empty when it is known."""
        if self._agreeing >= LANDMARKS_NEEDED:
            return ""
        age = f" for {self._age_s:.1f} s" if np.isfinite(self._age_s) else ""
        return f"camera's pose unknown{age}: {self._agreeing} of {LANDMARKS_NEEDED} landmarks in view"

    def advance(self, elapsed_s: float) -> None:
        """Age the pose by the time since the last picture."""
        self._age_s += elapsed_s

    def update(self, frame: Pixels) -> None:
        """Estimate the pose from a picture (height, width)."""
        self._frames += 1
        corners = self._read_landmarks(frame)
        if corners is None:
            return
        self._agreeing = len(corners)
        if len(corners) < LANDMARKS_NEEDED:
            return
        places, pixels = self._corners[list(corners)], np.array(list(corners.values()))
        fitted, residuals = fit_camera_pose(self.pose.camera, places, pixels)
        agrees = np.sqrt(np.mean(np.sum(residuals**2, axis=2), axis=1)) < _AGREES_PX
        self._agreeing = int(np.sum(agrees))
        if self._agreeing < LANDMARKS_NEEDED or not fitted.camera.position_m[2] < 0.0:
            return
        self.pose, self.view, self._age_s = fitted, RefractiveCamera(fitted.camera), 0.0

    def uncertainty(self, tangents: Sequence[LocalLinearization], depths_m: Sequence[float]) -> Array:
        """Covariances (n, 3, 3) of [x, y, yaw] measured at some places, due to the error of the camera's pose."""
        if not tangents:
            return np.zeros((0, 3, 3))
        pixels, depths = np.array([tangent.pixel for tangent in tangents]), np.array(depths_m)
        moved = np.zeros((len(tangents), 3, 6))
        here = self.view.pixel_to_pool(pixels, depths)
        for k, step in enumerate(_STEP * np.eye(6)):
            moved[:, :2, k] = (
                RefractiveCamera(_moved_camera(self.pose.camera, step)).pixel_to_pool(pixels, depths) - here
            ) / _STEP
        moved[:, 2, 3:] = -self.view.down  # a camera turned about the vertical sees every heading turned back
        drift = (self._age_s * np.array([_DRIFT_MPS, _DRIFT_MPS, _DRIFT_RADPS])) ** 2
        return np.asarray(moved @ self.pose.covariance @ np.swapaxes(moved, 1, 2) + np.diag(drift))

    def _read_landmarks(self, frame: Pixels) -> dict[int, Array] | None:
        """Corners (4, 2) px of the landmarks seen, by index, in a fixed order; None in frames without an attempt."""
        if not self.usable:
            return self._read_in([whole(frame)]) if self._frames % _SCAN_EVERY == 1 else None
        corners = self._read_in(self._expected_regions(frame))
        return corners if len(corners) >= LANDMARKS_NEEDED else self._read_in([whole(frame)])

    def _expected_regions(self, frame: Pixels) -> list[ImageRegion]:
        """The parts of a frame in which the present pose puts the landmarks."""
        middles_px = self.view.pool_to_pixel(self._corners.mean(axis=1))
        to_corners_px = np.linalg.norm(self.view.pool_to_pixel(self._corners) - middles_px[:, None], axis=2)
        reaches_px = to_corners_px.max(axis=1) + _MARGIN_PX
        regions = [cut(frame, middle, reach) for middle, reach in zip(middles_px, reaches_px, strict=True)]
        return [region for region in regions if region is not None]

    def _read_in(self, regions: Sequence[ImageRegion]) -> dict[int, Array]:
        """Corners (4, 2) px of the landmarks that are read in regions of a frame, by index in rising order."""
        images = [image for region in regions for image in find_markers(self._detector, region)]
        corners = {self._index[image.id]: image.corners_px for image in images if image.id in self._index}
        return {i: corners[i] for i in sorted(corners)}


def corners_of(landmark: Landmark) -> Array:
    """Corners (4, 3) of a mark in the pool frame, in ArUco's order."""
    flat = np.array(landmark.position_m[:2]) + body_to_pool(square(landmark.side_m), landmark.yaw_rad)
    return np.column_stack([flat, np.full(4, landmark.position_m[2])])


def _moved_camera(camera: Camera, step: Array) -> Camera:
    """The camera moved by `step` (6,): a displacement in the pool frame, and a small rotation in the camera's own."""
    turn = np.asarray(cv2.Rodrigues(step[3:])[0]) @ np.asarray(cv2.Rodrigues(np.array(camera.rotation_rad))[0])
    position = np.array(camera.position_m) + step[:3]
    rotation = np.asarray(cv2.Rodrigues(turn)[0]).ravel()
    return camera.model_copy(update={"position_m": tuple(position.tolist()), "rotation_rad": tuple(rotation.tolist())})


def fit_camera_pose(camera: Camera, places: Array, pixels: Array) -> tuple[CameraPoseEstimate, Array]:
    """Fit the pose, starting at `camera`, to corners (n, 4, 3) that were found at pixels (n, 4, 2); also the residuals (n, 4,
    2) px, infinite where a place came behind the lens: then there is no fit.

    Ripples move the four corners of a landmark together, so each landmark counts as one point in the covariance.
    """
    slope, move = np.empty((*pixels.shape, 6)), np.full(6, np.inf)
    for _ in range(_ROUNDS):
        measurement = RefractiveCamera(camera).pool_to_pixel(places)
        if not np.all(np.isfinite(measurement)):
            return CameraPoseEstimate(camera, np.full((6, 6), np.inf)), np.full(pixels.shape, np.inf)
        if np.max(np.abs(move)) > _SAME_SLOPES:
            for k, step in enumerate(_STEP * np.eye(6)):
                slope[..., k] = (RefractiveCamera(_moved_camera(camera, step)).pool_to_pixel(places) - measurement) / _STEP
        residuals = pixels - measurement
        weight = 1.0 / (1.0 + np.sum(residuals**2, axis=2) / _WEIGHT_PX**2)
        weighted = slope * weight[..., None, None]
        normal = np.tensordot(weighted, slope, axes=((0, 1, 2), (0, 1, 2)))
        move = np.linalg.solve(normal, np.tensordot(weighted, residuals, axes=((0, 1, 2), (0, 1, 2))))
        camera = _moved_camera(camera, move)
        if np.max(np.abs(move)) < _SETTLED:
            break
    shifts = residuals.mean(axis=1)  # of whole landmarks; corners are all found 0.3 px inside, which cancels
    trust = weight.mean(axis=1)
    variance = np.sum(trust[:, None] * shifts**2) / (2.0 * np.sum(trust)) * len(places) / max(len(places) - 3, 1)
    covariance = 4.0 * max(variance, _LEAST_SPREAD_PX**2) * np.linalg.inv(normal)
    return CameraPoseEstimate(camera, covariance), residuals

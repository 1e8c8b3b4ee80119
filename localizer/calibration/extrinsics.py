"""Extrinsic calibration: the camera's pose from surveyed points in one picture, through the water's surface. Pure.

Points on the rim are seen straight, those on the floor through refraction; both enter one least-squares fit of the pixels.
Without refraction a floor 1 m deep would appear at 0.75 m, and the camera would be centimetres off.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import least_squares

from localizer.calibration.survey_points import FEWEST_POINTS, SurveyPoint, is_line
from localizer.camera_model import Intrinsics, RefractiveCamera
from shoal.config.perception import Camera
from shoal.errors import ConfigError
from shoal.frames import Array

_LEAST_SIGMA_PX = 0.2  # px, least standard deviation of a pixel: residuals of four points may be small by chance
_SUSPECT_RATIO, _SUSPECT_PX = 3.0, 1.0  # improvement without a point, and RMS in px, from which that point is suspect
_SUSPECT_STEPS = 20  # most evaluations of a fit without one point; five are needed from the fit to all points
_UNUSABLE_PX = 10.0  # px of a picture 1280 wide; a larger RMS means confused points, not careless clicks
_LOWEST_CAMERA_M = -0.05  # m, largest z of a camera above the water
_BEHIND_PX = 1e5  # px, error of a point that does not lie before the lens: more than any in a picture
_STEP = 1e-5  # m and rad, step of derivatives: 0.01 px, far above rounding and far below curvature


@dataclass(frozen=True, eq=False)
class PoseFit:
    """The camera over the pool. `seen_px` (points, 2) as given, `residuals_px` (points, 2): seen less predicted.
    `covariance` (6, 6) of rotation_rad and position_m, from the points' scatter. `suspect`: the point without which the
    others agree."""

    camera: Camera
    seen_px: Array
    residuals_px: Array
    covariance: Array
    suspect: int | None

    @property
    def rms_px(self) -> float:
        """RMS over the points of the distance in px."""
        return _rms(self.residuals_px)

    def place_sigma_m(self, pixels: Array, depth_m: float) -> Array:
        """One standard deviation (n,) of the places of pixels (n, 2) at a depth, in the worse direction."""
        at = _parameters(self.camera)

        def place(step: Array) -> Array:
            return RefractiveCamera(_moved(self.camera, at + step)).pixel_to_pool(pixels, depth_m)

        steps = _STEP * np.eye(6)
        jacobian = np.stack([(place(step) - place(-step)) / (2 * _STEP) for step in steps], axis=-1)  # (n, 2, 6)
        spread = jacobian @ self.covariance @ jacobian.swapaxes(1, 2)
        return np.asarray(np.sqrt(np.linalg.eigvalsh(spread)[:, 1]))


def fit_pose(camera: Camera, points: Sequence[SurveyPoint], pixels: Array) -> PoseFit:
    """The pose of `camera` that puts `points` at pixels (n, 2). Its lens and water_index are used, its pose is not.

    Raises ConfigError when the pixels cannot be used or no pose explains them.
    """
    places = np.array([point.pool_m for point in points])
    _check_pixels(camera, points, pixels)
    best = _best_pose(camera, places, pixels)
    fit = _assessed(best, places, pixels)
    if fit.rms_px > _UNUSABLE_PX * max(camera.size_px) / 1280.0:
        worst = points[int(np.argmax(np.linalg.norm(fit.residuals_px, axis=1)) if fit.suspect is None else fit.suspect)].name
        raise ConfigError(
            f"points: no pose of the camera explains them: they are {fit.rms_px:.0f} px off (RMS), worst {worst!r}; "
            "is z positive under water, x right and y down in the picture, the origin at the pool's centre?"
        )
    return fit


def place_errors_m(fit: PoseFit, points: Sequence[SurveyPoint]) -> Array:
    """Places that the fit gives for the points' pixels, at their depths, less the surveyed ones, (n, 2)."""
    places = np.array([point.pool_m for point in points])
    return np.asarray(RefractiveCamera(fit.camera).pixel_to_pool(fit.seen_px, places[:, 2]) - places[:, :2])


def _check_pixels(camera: Camera, points: Sequence[SurveyPoint], pixels: Array) -> None:
    """Raise ConfigError for points outside the picture, and for points on one line."""
    width, height = camera.size_px
    for point, (u, v) in zip(points, pixels, strict=True):
        if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
            allowed = f"allowed: 0 to {width - 1}, 0 to {height - 1}"
            raise ConfigError(f"points: {point.name!r}: pixel_px = [{u:g}, {v:g}] is outside the picture ({allowed})")
    if is_line(pixels):
        raise ConfigError("points: their pixels lie on one line; take some beside it")


def _best_pose(camera: Camera, places: Array, pixels: Array) -> Camera:
    """The pose with the least squared error, from each start in turn."""
    fits = [
        least_squares(_errors, start, args=(camera, places, pixels), x_scale="jac")
        for start in _starts(camera, places, pixels)
    ]
    above = [fit for fit in fits if fit.x[5] < _LOWEST_CAMERA_M and _is_seen(_moved(camera, fit.x), places)]
    if not above:
        raise ConfigError(
            "points: no camera above the water sees them so; is z positive under water, and y down in the picture?"
        )
    best = min(above, key=lambda fit: float(fit.cost)).x
    best[:3] = cv2.Rodrigues(cv2.Rodrigues(best[:3])[0])[0].ravel()  # of all vectors for one turn the shortest
    return _moved(camera, best)


def _is_seen(camera: Camera, places: Array) -> bool:
    """True if all places lie before the lens: a camera that looks away from them would explain a mirrored picture."""
    return bool(np.isfinite(RefractiveCamera(camera).pool_to_pixel(places)).all())


def _starts(camera: Camera, places: Array, pixels: Array) -> list[Array]:
    """Initial poses: those that explain the points if each one under water is seen at its apparent depth / n, straight.

    Raises ConfigError if there are none."""
    apparent = places.copy()
    apparent[:, 2] = np.where(places[:, 2] > 0, places[:, 2] / camera.water_index, places[:, 2])
    lens = Intrinsics.of(camera)
    try:
        _, turns, moves, _ = cv2.solvePnPGeneric(
            apparent, pixels, lens.matrix, np.array(lens.distortion), flags=cv2.SOLVEPNP_SQPNP
        )
    except cv2.error:  # it asks for some spread
        raise ConfigError("points: their pixels lie too near to one another to tell a pose") from None
    starts = []
    for turn, move in zip(turns, moves, strict=True):
        position = -np.asarray(cv2.Rodrigues(turn)[0]).T @ move.ravel()
        starts.append(np.concatenate([turn.ravel(), position[:2], [min(float(position[2]), 2 * _LOWEST_CAMERA_M)]]))
    return starts


def _assessed(camera: Camera, places: Array, pixels: Array) -> PoseFit:
    """The fit with residuals, covariance, and the point that does not fit."""
    at = _parameters(camera)
    residuals = -_errors(at, camera, places, pixels)
    steps = _STEP * np.eye(6)
    jacobian = np.column_stack(
        [(_errors(at + s, camera, places, pixels) - _errors(at - s, camera, places, pixels)) / (2 * _STEP) for s in steps]
    )
    spare = max(len(residuals) - 6, 1)
    variance = max(float(residuals @ residuals) / spare, _LEAST_SIGMA_PX**2)
    covariance: Array = np.asarray(variance * np.linalg.pinv(jacobian.T @ jacobian), dtype=np.float64)
    residuals = residuals.reshape(-1, 2)
    return PoseFit(camera, pixels, residuals, covariance, _suspect(camera, residuals, places, pixels))


def _suspect(camera: Camera, residuals: Array, places: Array, pixels: Array) -> int | None:
    """The point without which the rest fit at least three times better. With four points there is none."""
    if len(places) <= FEWEST_POINTS or _rms(residuals) < _SUSPECT_PX:
        return None
    without = []
    for i in range(len(places)):
        rest = np.delete(places, i, axis=0), np.delete(pixels, i, axis=0)
        solution = least_squares(_errors, _parameters(camera), args=(camera, *rest), x_scale="jac", max_nfev=_SUSPECT_STEPS)
        without.append(_rms(solution.fun.reshape(-1, 2)))
    best = int(np.argmin(without))
    return best if without[best] * _SUSPECT_RATIO < _rms(residuals) else None


def _errors(parameters: Array, camera: Camera, places: Array, pixels: Array) -> Array:
    """Predicted less seen pixels, (2 n,)."""
    errors = RefractiveCamera(_moved(camera, parameters)).pool_to_pixel(places) - pixels
    return np.nan_to_num(errors, nan=_BEHIND_PX).ravel()


def _moved(camera: Camera, parameters: Array) -> Camera:
    turn, place = parameters[:3].tolist(), parameters[3:].tolist()
    return camera.model_copy(update={"rotation_rad": tuple(turn), "position_m": tuple(place)})


def _parameters(camera: Camera) -> Array:
    return np.array([*camera.rotation_rad, *camera.position_m])


def _rms(residuals: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))

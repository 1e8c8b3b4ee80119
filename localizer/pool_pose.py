"""Points of the pool in one picture -> where the camera hangs, looking through the water's surface.

The rim's points are seen straight, the floor's through refraction; both go into one least squares fit of the pixels.
Ignoring refraction puts a floor 1 m deep at 0.75 m, and the camera centimetres off. Pure.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Self

import cv2
import numpy as np
from pydantic import Field, model_validator
from scipy.optimize import least_squares

from localizer.board_views import marker_centres
from localizer.calibrate import Lens
from localizer.calibration import PoolView
from localizer.patch import Pixels
from wire.experiment import Camera, Pool, Vec2, Vec3
from wire.frames import Array
from wire.toml_file import ConfigError, Section

FEWEST_POINTS = 4
_OUTSIDE_M = 0.5  # a rim may lie this far outside the walls
_HIGHEST_M = -1.5  # a point so far above the water is a sign that got lost: z points down
_LINE_SHARE = 0.05  # width over length of the cloud of points, below which the pose may turn around the line
_LEAST_SIGMA_PX = 0.2  # residuals of four points may be small by luck
_SUSPECT_RATIO, _SUSPECT_PX = 3.0, 1.0
_SUSPECT_STEPS = 20  # a start from the fit to all points needs five; points beyond hope would take hundreds
_UNUSABLE_PX = 10.0  # of 1280: two places confused, not a careless click
_LOWEST_CAMERA_M = -0.05
_STEP = 1e-5  # m and rad, for derivatives: 0.01 px, far above rounding, far below curvature


class PoolPoint(Section):
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


class PoolPoints(Section):
    """The file of `--pool-points`. `image`: the picture they were seen in, beside the file."""

    pool: Pool  # as in the experiment
    image: str | None = None
    points: tuple[PoolPoint, ...]

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
        if _is_line(np.array([point.pool_m for point in self.points])):
            raise ValueError("points: they lie on one line; take some beside it")
        return self


@dataclass(frozen=True, eq=False)
class PoseFit:
    """The camera over the pool. `seen_px` (points, 2) as given, `residuals_px` (points, 2): seen less predicted.
    `covariance` (6, 6) of rotation_rad and position_m, from the points' scatter; `suspect`: the point without which the
    others agree."""

    camera: Camera
    seen_px: Array
    residuals_px: Array
    covariance: Array
    suspect: int | None

    @property
    def rms_px(self) -> float:
        """Over points, of the distance."""
        return _rms(self.residuals_px)

    def place_sigma_m(self, pixels: Array, depth_m: float) -> Array:
        """One standard deviation (n,) of where pixels (n, 2) lie at a depth, in the worse direction."""
        at = _parameters(self.camera)

        def place(step: Array) -> Array:
            return PoolView(_moved(self.camera, at + step)).pool(pixels, depth_m)

        steps = _STEP * np.eye(6)
        jacobian = np.stack([(place(step) - place(-step)) / (2 * _STEP) for step in steps], axis=-1)  # (n, 2, 6)
        spread = jacobian @ self.covariance @ jacobian.swapaxes(1, 2)
        return np.asarray(np.sqrt(np.linalg.eigvalsh(spread)[:, 1]))


def seen_pixels(points: Sequence[PoolPoint], picture: Pixels | None) -> Array:
    """Where the points are in the picture, (n, 2): as written, or as their markers are found. Raises ConfigError."""
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


def fit_pose(camera: Camera, points: Sequence[PoolPoint], pixels: Array) -> PoseFit:
    """The pose of `camera` (its lens and water_index are taken, its pose is not) that puts `points` at pixels (n, 2).

    Raises ConfigError when the pixels cannot be used or no pose explains them.
    """
    places = np.array([point.pool_m for point in points])
    _check_pixels(camera, points, pixels)
    best = _best(camera, places, pixels)
    fit = _judged(best, places, pixels)
    if fit.rms_px > _UNUSABLE_PX * max(camera.size_px) / 1280.0:
        worst = points[int(np.argmax(np.linalg.norm(fit.residuals_px, axis=1)) if fit.suspect is None else fit.suspect)].name
        raise ConfigError(
            f"points: no pose of the camera explains them: they are {fit.rms_px:.0f} px off (RMS), worst {worst!r}; "
            "is z positive under water, x right and y down in the picture, the origin at the pool's centre?"
        )
    return fit


def _check_pixels(camera: Camera, points: Sequence[PoolPoint], pixels: Array) -> None:
    width, height = camera.size_px
    for point, (u, v) in zip(points, pixels, strict=True):
        if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
            allowed = f"allowed: 0 to {width - 1}, 0 to {height - 1}"
            raise ConfigError(f"points: {point.name!r}: pixel_px = [{u:g}, {v:g}] is outside the picture ({allowed})")
    if _is_line(pixels):
        raise ConfigError("points: their pixels lie on one line; take some beside it")


def _is_line(cloud: Array) -> bool:
    sizes = np.linalg.svd(cloud - cloud.mean(axis=0), compute_uv=False)
    return bool(sizes[1] <= _LINE_SHARE * sizes[0])


def _best(camera: Camera, places: Array, pixels: Array) -> Camera:
    """The pose with the least squared error, from each start in turn."""
    fits = [
        least_squares(_errors, start, args=(camera, places, pixels), x_scale="jac")
        for start in _starts(camera, places, pixels)
    ]
    above = [fit for fit in fits if fit.x[5] < _LOWEST_CAMERA_M]
    if not above:
        raise ConfigError(
            "points: no camera above the water sees them so; is z positive under water, and y down in the picture?"
        )
    best = min(above, key=lambda fit: float(fit.cost)).x
    best[:3] = cv2.Rodrigues(cv2.Rodrigues(best[:3])[0])[0].ravel()  # of all vectors for one turn the shortest
    return _moved(camera, best)


def _starts(camera: Camera, places: Array, pixels: Array) -> list[Array]:
    """Poses to refine: those that explain the points if each one under water is seen where it appears from right above,
    at depth / n, straight."""
    apparent = places.copy()
    apparent[:, 2] = np.where(places[:, 2] > 0, places[:, 2] / camera.water_index, places[:, 2])
    lens = Lens.of(camera)
    _, turns, moves, _ = cv2.solvePnPGeneric(
        apparent, pixels, lens.matrix, np.array(lens.distortion), flags=cv2.SOLVEPNP_SQPNP
    )
    starts = []
    for turn, move in zip(turns, moves, strict=True):
        position = -np.asarray(cv2.Rodrigues(turn)[0]).T @ move.ravel()
        starts.append(np.concatenate([turn.ravel(), position[:2], [min(float(position[2]), 2 * _LOWEST_CAMERA_M)]]))
    return starts


def _judged(camera: Camera, places: Array, pixels: Array) -> PoseFit:
    """Residuals, covariance, and the point that does not belong."""
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
    """The point without which the rest fit at least three times better. Four points leave nothing to tell it from."""
    if len(places) <= FEWEST_POINTS or _rms(residuals) < _SUSPECT_PX:
        return None
    without = []
    for i in range(len(places)):
        rest = np.delete(places, i, axis=0), np.delete(pixels, i, axis=0)
        found = least_squares(_errors, _parameters(camera), args=(camera, *rest), x_scale="jac", max_nfev=_SUSPECT_STEPS)
        without.append(_rms(found.fun.reshape(-1, 2)))
    best = int(np.argmin(without))
    return best if without[best] * _SUSPECT_RATIO < _rms(residuals) else None


def _errors(parameters: Array, camera: Camera, places: Array, pixels: Array) -> Array:
    """Predicted less seen, (2 n,)."""
    return (PoolView(_moved(camera, parameters)).pixel(places) - pixels).ravel()


def _moved(camera: Camera, parameters: Array) -> Camera:
    turn, place = parameters[:3].tolist(), parameters[3:].tolist()
    return camera.model_copy(update={"rotation_rad": tuple(turn), "position_m": tuple(place)})


def _parameters(camera: Camera) -> Array:
    return np.array([*camera.rotation_rad, *camera.position_m])


def _rms(residuals: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))

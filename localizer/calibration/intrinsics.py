"""Intrinsic calibration: focal lengths, centre and distortion from views of a target, with their uncertainty. Pure.

    views -> fit -> drop the worst view while it is far worse than the rest -> k3 only if the views can tell it from zero

Zhang (2000) by OpenCV. The pose over the pool comes after, from points of the pool (extrinsics.py).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.calibration.targets import TargetView
from localizer.camera_model import LARGEST_FOLD_PX, Intrinsics, fold_px
from shoal.errors import ConfigError
from shoal.frames import Array

FEWEST_VIEWS = 5  # nine parameters need three; with five a bad view can be recognised
ADVISED_VIEWS = 12
_BAD_RATIO, _BAD_PX = 2.5, 0.3  # RMS over the median, and in px, above which a view is taken for blurred or misread
_BAD_SHARE = 1 / 3  # largest share of views to drop; if more are bad, the fault is elsewhere
_SIGNIFICANT = 3.0  # standard deviations of k3; below, it fits noise and distorts the picture's corners
_MATTERS = 0.98  # of the RMS without k3; k3 must lower it at least to this
CELLS = (8, 6)  # columns and rows in which coverage is counted
_COVERED = 0.6  # share of cells with corners; below it, distortion is extrapolated in places
_REACHED = 0.7  # of the distance from the centre to each of the picture's corners; below it, a warning
_LOOSE_FOCAL, _LOOSE_CENTRE_PX = 0.002, 2.0  # standard deviations for a warning; 0.2 % is 2 mm at 1 m from the foot
_UNKNOWN_FOCAL, _UNKNOWN_CENTRE_PX = 0.01, 10.0  # standard deviations from which on a lens is not written: 1 cm at 1 m
_POOR_RMS_PX = 1.0  # px of a picture 1280 wide, above which a lens is not written
_TILTED_RAD, _FEWEST_TILTED = np.radians(10.0), 4  # views whose board is tilted so far; fewer do not tell the focal length
_SAME_VIEW_PX = 0.7  # px, RMS distance of the corners of two views that show one board at one place: noise and a hand's shake
_POSE, _INTRINSICS = 6, 9  # columns of a view's derivatives: its rotation and place, then fx, fy, cx, cy, k1, k2, p1, p2, k3
_SINGULAR = 1e-12  # of the largest eigenvalue of the scaled information; below it there is rounding only
_NO_SHARE = 1e-9  # of a unit vector, squared: so little of a direction that is not determined is rounding
_FOLDS = 3  # parts of the views, each of which is predicted by a lens that it did not help to find


@dataclass(frozen=True, eq=False)
class IntrinsicsFit:
    """Intrinsics with the views they were found from. `deviations` (9,): one standard deviation of fx, fy, cx, cy, k1, k2,
    p1, p2, k3."""

    lens: Intrinsics
    deviations: Array
    rms_px: float
    views: tuple[TargetView, ...]
    view_rms_px: Array  # (views,)
    residuals_px: tuple[Array, ...]  # found less predicted, (corners, 2) per view
    tilts_rad: Array  # (views,): between the board's normal and the line of sight
    rejected: tuple[tuple[TargetView, float], ...] = ()  # with the RMS they had when they went

    @property
    def corners_px(self) -> Array:
        """All corners of the views that were kept, (n, 2)."""
        return np.concatenate([view.pixels for view in self.views])

    @cached_property
    def held_out_rms_px(self) -> float | None:
        """RMS error in px of views that the lens did not see: a third of them at a time, their poses fitted to the lens of the
        rest. None where too few views are left. The fit's own RMS is lower, as it was made to be. Takes as long as a fit."""
        return _held_out_rms_px(self)

    @property
    def coverage(self) -> Array:
        """Number of corners in each cell of the picture, (rows, columns)."""
        width, height = self.lens.size_px
        edges_x, edges_y = (np.linspace(-0.5, size - 0.5, n + 1) for size, n in zip((width, height), CELLS, strict=True))
        counts, _, _ = np.histogram2d(self.corners_px[:, 1], self.corners_px[:, 0], bins=(edges_y, edges_x))
        return np.asarray(counts)


def distinct_views(views: Sequence[TargetView]) -> tuple[list[TargetView], list[tuple[TargetView, TargetView]]]:
    """The views without repetitions; and each repetition, with the earlier view that it repeats.

    A repeated view adds nothing but confidence: its errors are the same once more.
    """
    kept, repeated = list[TargetView](), list[tuple[TargetView, TargetView]]()
    for view in views:
        same = next((one for one in kept if _is_same(one, view)), None)
        if same is None:
            kept.append(view)
        else:
            repeated.append((view, same))
    return kept, repeated


def _is_same(one: TargetView, other: TargetView) -> bool:
    if one.board_m.shape != other.board_m.shape or not np.array_equal(one.board_m, other.board_m):
        return False
    return float(np.sqrt(np.mean(np.sum((one.pixels - other.pixels) ** 2, axis=1)))) < _SAME_VIEW_PX


def fit_intrinsics(views: Sequence[TargetView], size_px: tuple[int, int]) -> IntrinsicsFit:
    """The intrinsics that explain the views, bad and repeated ones dropped. Raises ConfigError if there are too few."""
    kept, _ = distinct_views(views)
    if len(kept) < FEWEST_VIEWS:
        names = ", ".join(view.name for view in kept) or "none"
        different = "different " if len(kept) < len(views) else ""
        raise ConfigError(
            f"the board was found in {len(kept)} {different}pictures ({names}), at least {FEWEST_VIEWS} are needed"
        )
    rejected = list[tuple[TargetView, float]]()
    fit, count = _fit(kept, size_px), len(kept)
    while len(kept) > FEWEST_VIEWS and len(rejected) < int(count * _BAD_SHARE):
        worst = int(np.argmax(fit.view_rms_px))
        if fit.view_rms_px[worst] <= max(_BAD_RATIO * float(np.median(fit.view_rms_px)), _BAD_PX):
            break
        rejected.append((kept.pop(worst), float(fit.view_rms_px[worst])))
        fit = _fit(kept, size_px)
    return replace(fit, rejected=tuple(rejected))


def _fit(views: Sequence[TargetView], size_px: tuple[int, int]) -> IntrinsicsFit:
    """Fit with k3 only if it is significant and lowers the error: views of a video repeat one another, and so do their
    errors."""
    plain, with_k3 = _solve(views, size_px, cv2.CALIB_FIX_K3), _solve(views, size_px, 0)
    is_sure = abs(with_k3.lens.distortion[4]) > _SIGNIFICANT * with_k3.deviations[8]
    return with_k3 if is_sure and with_k3.rms_px < _MATTERS * plain.rms_px else plain


def _solve(views: Sequence[TargetView], size_px: tuple[int, int], flags: int) -> IntrinsicsFit:
    """Fit a lens to views of a board. Raises ConfigError if none explains them."""
    boards = [view.board_m.astype(np.float32)[:, None] for view in views]
    pixels = [view.pixels.astype(np.float32)[:, None] for view in views]
    try:
        rms, matrix, distortion, turns, moves, _, _, errors = cv2.calibrateCameraExtended(
            boards, pixels, size_px, np.eye(3), np.zeros(5), flags=flags
        )
    except cv2.error as error:
        raise ConfigError(f"no lens explains the {len(views)} views of the board: {error.err}") from None
    distortion = np.asarray(distortion).ravel()[:5]
    (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
    k1, k2, p1, p2, k3 = distortion.tolist()
    if not np.all(np.isfinite([fx, fy, cx, cy, k1, k2, p1, p2, k3])) or min(fx, fy) <= 0:
        raise ConfigError(f"no lens explains the {len(views)} views of the board: tilt it by 20 to 40 degrees, each way")
    lens = Intrinsics(size_px=size_px, focal_px=(fx, fy), centre_px=(cx, cy), distortion=(k1, k2, p1, p2, k3))
    residuals, jacobians, tilts_rad = list[Array](), list[Array](), list[float]()
    for view, turn, move in zip(views, turns, moves, strict=True):
        places, jacobian = cv2.projectPoints(view.board_m, turn, move, matrix, distortion)
        residuals.append(view.pixels - places.reshape(-1, 2))
        jacobians.append(np.asarray(jacobian))
        rotation = np.asarray(cv2.Rodrigues(turn)[0])
        tilts_rad.append(float(np.arccos(abs(rotation[2, 2]))))  # of the board's normal against the line of sight
    deviations = _deviations(jacobians, residuals, flags == cv2.CALIB_FIX_K3)
    view_rms = np.asarray(errors, dtype=np.float64).ravel()
    return IntrinsicsFit(lens, deviations, float(rms), tuple(views), view_rms, tuple(residuals), np.array(tilts_rad))


def _deviations(jacobians: Sequence[Array], residuals: Sequence[Array], without_k3: bool) -> Array:
    """One standard deviation of the nine intrinsics, from derivatives by each view's pose (6 columns) and the intrinsics (9).

    Infinite where the views do not determine them: OpenCV's own deviations come from a pseudo-inverse, which leaves such a
    direction out, as if it were known.
    """
    lens_columns = _POSE + np.arange(_INTRINSICS - without_k3)
    unknowns = _POSE * len(jacobians) + len(lens_columns)
    numbers = sum(residual.size for residual in residuals)
    squares = sum(float(np.sum(residual**2)) for residual in residuals)
    pixel_variance = squares / max(numbers - unknowns, 1)
    information = _lens_information(jacobians, lens_columns)
    scale = np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))  # focal lengths count in 1000 px, k3 in 0.01
    deviations = np.sqrt(pixel_variance * _inverse_diagonal(information / np.outer(scale, scale))) / scale
    return np.append(deviations, 0.0) if without_k3 else deviations


def _lens_information(jacobians: Sequence[Array], lens_columns: NDArray[np.intp]) -> Array:
    """Information on the lens's parameters (k, k) when each view's pose is unknown too: a sum of Schur complements."""
    information = np.zeros((len(lens_columns), len(lens_columns)))
    for jacobian in jacobians:
        by_lens, by_pose = jacobian[:, lens_columns], jacobian[:, :_POSE]
        mixed = by_lens.T @ by_pose
        information += by_lens.T @ by_lens - mixed @ np.linalg.pinv(by_pose.T @ by_pose) @ mixed.T
    return information


def _inverse_diagonal(matrix: Array) -> Array:
    """Diagonal of a symmetric matrix's inverse; infinite for a row that takes part in a direction with eigenvalue zero."""
    eigenvalues, vectors = np.linalg.eigh(matrix)
    is_singular = eigenvalues <= _SINGULAR * eigenvalues[-1]
    inverses = np.where(is_singular, np.inf, 1.0 / np.maximum(eigenvalues, np.finfo(float).tiny))
    with np.errstate(invalid="ignore"):  # where a share is zero, zero times infinity is not used
        shares = np.where(vectors**2 > _NO_SHARE, vectors**2 * inverses, 0.0)
    return np.asarray(shares.sum(axis=1))


def _held_out_rms_px(fit: IntrinsicsFit) -> float | None:
    """RMS error in views that a lens was not fitted to, by cross-validation; None with too few views."""
    views, flags = fit.views, 0 if fit.lens.distortion[4] else cv2.CALIB_FIX_K3
    if len(views) - len(views) // _FOLDS - 1 < FEWEST_VIEWS:
        return None
    errors = []
    for fold in range(_FOLDS):
        lens = _solve([view for i, view in enumerate(views) if i % _FOLDS != fold], fit.lens.size_px, flags).lens
        for view in views[fold::_FOLDS]:
            corners, distortion = view.pixels[:, None], np.array(lens.distortion)
            _, turn, move = cv2.solvePnP(view.board_m, corners, lens.matrix, distortion)
            predicted, _ = cv2.projectPoints(view.board_m, turn, move, lens.matrix, distortion)
            errors.append(np.sum((predicted - corners) ** 2, axis=(1, 2)))
    return float(np.sqrt(np.mean(np.concatenate(errors))))


def intrinsics_faults(fit: IntrinsicsFit) -> list[str]:
    """Reasons not to use a lens, with advice: places by it will be wrong."""
    faults = []
    tilted = int(np.sum(fit.tilts_rad > _TILTED_RAD))
    if tilted < min(_FEWEST_TILTED, len(fit.views)):
        faults.append(f"only {tilted} views of a tilted board: a board that faces the camera does not tell the focal length")
    if max(fit.deviations[:2] / fit.lens.focal_px) > _UNKNOWN_FOCAL or max(fit.deviations[2:4]) > _UNKNOWN_CENTRE_PX:
        faults.append("focal length or centre is not known: tilt the board by 20 to 40 degrees each way, and come near")
    if fit.rms_px > _POOR_RMS_PX * max(1.0, max(fit.lens.size_px) / 1280.0):
        faults.append(f"an RMS of {fit.rms_px:.2f} px is poor: is the board flat, the --board right, the picture sharp?")
    if (fold := fold_px(fit.lens)) > LARGEST_FOLD_PX:
        faults.append(
            f"the distortion folds over within the picture ({fold:.1f} px off): places there will be wrong; the lens "
            "is a fish-eye, or the board was not shown near the edges"
        )
    return faults


def intrinsics_warnings(fit: IntrinsicsFit) -> list[str]:
    """Warnings about a fit, with advice; its faults last."""
    warnings = []
    if len(fit.views) < ADVISED_VIEWS:
        warnings.append(f"only {len(fit.views)} views: take {ADVISED_VIEWS} or more")
    covered = float(np.mean(fit.coverage > 0))
    if covered < _COVERED:
        warnings.append(f"corners cover {covered:.0%} of the picture (wanted: {_COVERED:.0%}): show it where the map is empty")
    if (reach := _least_reach(fit)) < _REACHED:
        warnings.append(
            f"towards a corner of the picture the board goes only {reach:.0%} of the way: beyond, the lens is a guess"
        )
    faults = intrinsics_faults(fit)
    loose = max(fit.deviations[:2] / fit.lens.focal_px) > _LOOSE_FOCAL or max(fit.deviations[2:4]) > _LOOSE_CENTRE_PX
    if loose and not any("is not known" in fault for fault in faults):
        warnings.append("focal length or centre is loose: tilt the board by 20 to 40 degrees each way, and come near")
    return [*warnings, *faults]


def _least_reach(fit: IntrinsicsFit) -> float:
    """Distance that the corners reach towards each of the picture's corners, over the whole distance; the least of the
    four."""
    width, height = fit.lens.size_px
    corners = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], dtype=np.float64)
    reach = corners - fit.lens.centre_px
    went = (fit.corners_px - fit.lens.centre_px) @ (reach / np.sum(reach**2, axis=1, keepdims=True)).T
    return float(went.max(axis=0).min())

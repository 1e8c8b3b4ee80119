"""Intrinsic calibration: focal lengths, centre and distortion from views of a target, with their uncertainty. Pure.

    views -> fit -> drop the worst view while it is far worse than the rest -> k3 only if the views can tell it from zero

Zhang (2000) by OpenCV. The pose over the pool comes after, from points of the pool (extrinsics.py).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from localizer.calibration.targets import TargetView
from localizer.camera_model import Intrinsics
from wire.frames import Array
from wire.toml_loader import ConfigError

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
_POOR_RMS_PX = 1.0  # px, for a warning
_FOLD_PX = 0.1  # px, for a warning
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
    rejected: tuple[tuple[TargetView, float], ...] = ()  # with the RMS they had when they went

    @property
    def corners_px(self) -> Array:
        """All corners of the views that were kept, (n, 2)."""
        return np.concatenate([view.pixels for view in self.views])

    @property
    def coverage(self) -> Array:
        """Number of corners in each cell of the picture, (rows, columns)."""
        width, height = self.lens.size_px
        edges_x, edges_y = (np.linspace(-0.5, size - 0.5, n + 1) for size, n in zip((width, height), CELLS, strict=True))
        counts, _, _ = np.histogram2d(self.corners_px[:, 1], self.corners_px[:, 0], bins=(edges_y, edges_x))
        return np.asarray(counts)


def fit_intrinsics(views: Sequence[TargetView], size_px: tuple[int, int]) -> IntrinsicsFit:
    """The intrinsics that explain the views, bad ones dropped. Raises ConfigError if there are too few."""
    if len(views) < FEWEST_VIEWS:
        names = ", ".join(view.name for view in views) or "none"
        raise ConfigError(f"the board was found in {len(views)} pictures ({names}), at least {FEWEST_VIEWS} are needed")
    kept, rejected = list(views), list[tuple[TargetView, float]]()
    fit = _fit(kept, size_px)
    while len(kept) > FEWEST_VIEWS and len(rejected) < int(len(views) * _BAD_SHARE):
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
        rms, matrix, distortion, turns, moves, deviations, _, errors = cv2.calibrateCameraExtended(
            boards, pixels, size_px, np.eye(3), np.zeros(5), flags=flags
        )
    except cv2.error as error:
        raise ConfigError(f"no lens explains the {len(views)} views of the board: {error.err}") from None
    found = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *distortion.ravel()[:5]])
    if not np.all(np.isfinite(found)) or min(found[:2]) <= 0:
        raise ConfigError(f"no lens explains the {len(views)} views of the board: tilt it by 20 to 40 degrees, each way")
    predicted = [
        cv2.projectPoints(b, r, t, matrix, distortion)[0].reshape(-1, 2) for b, r, t in zip(boards, turns, moves, strict=True)
    ]
    residuals = tuple(view.pixels - place for view, place in zip(views, predicted, strict=True))
    fx, fy, cx, cy, *ks = (float(value) for value in found)
    lens = Intrinsics(size_px=size_px, focal_px=(fx, fy), centre_px=(cx, cy), distortion=(ks[0], ks[1], ks[2], ks[3], ks[4]))
    sigma, view_rms = (np.asarray(values, dtype=np.float64).ravel() for values in (deviations, errors))
    return IntrinsicsFit(lens, sigma[:9], float(rms), tuple(views), view_rms, residuals)


def held_out_rms_px(fit: IntrinsicsFit) -> float | None:
    """RMS error in px of views that the lens did not see: a third of them at a time, their poses fitted to the lens of the
    rest. None where too few views are left. The fit's own RMS is lower, as it was made to be."""
    views, flags = fit.views, 0 if fit.lens.distortion[4] else cv2.CALIB_FIX_K3
    if len(views) - len(views) // _FOLDS - 1 < FEWEST_VIEWS:
        return None
    errors = []
    for fold in range(_FOLDS):
        lens = _solve([view for i, view in enumerate(views) if i % _FOLDS != fold], fit.lens.size_px, flags).lens
        for view in views[fold::_FOLDS]:
            seen, distortion = view.pixels[:, None], np.array(lens.distortion)
            _, turn, move = cv2.solvePnP(view.board_m, seen, lens.matrix, distortion)
            predicted, _ = cv2.projectPoints(view.board_m, turn, move, lens.matrix, distortion)
            errors.append(np.sum((predicted - seen) ** 2, axis=(1, 2)))
    return float(np.sqrt(np.mean(np.concatenate(errors))))


def intrinsics_warnings(fit: IntrinsicsFit) -> list[str]:
    """Warnings about a fit, with advice."""
    said = []
    if len(fit.views) < ADVISED_VIEWS:
        said.append(f"only {len(fit.views)} views: take {ADVISED_VIEWS} or more")
    covered = float(np.mean(fit.coverage > 0))
    if covered < _COVERED:
        said.append(f"corners cover {covered:.0%} of the picture (wanted: {_COVERED:.0%}): show it where the map is empty")
    if (reach := _least_reach(fit)) < _REACHED:
        said.append(f"towards a corner of the picture the board goes only {reach:.0%} of the way: beyond, the lens is a guess")
    if max(fit.deviations[:2] / fit.lens.focal_px) > _LOOSE_FOCAL or max(fit.deviations[2:4]) > _LOOSE_CENTRE_PX:
        said.append("focal length or centre is loose: tilt the board by 20 to 40 degrees each way, and come near")
    if fit.rms_px > _POOR_RMS_PX:
        said.append(f"an RMS of {fit.rms_px:.2f} px is poor: is the board flat, the --board right, the picture sharp?")
    if (fold := fold_px(fit.lens)) > _FOLD_PX:
        said.append(f"the distortion folds over before the picture's edge ({fold:.1f} px off): places there will be wrong")
    return said


def _least_reach(fit: IntrinsicsFit) -> float:
    """Distance that the corners reach towards each of the picture's corners, over the whole distance; the least of the
    four."""
    width, height = fit.lens.size_px
    corners = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], dtype=np.float64)
    way = corners - fit.lens.centre_px
    went = (fit.corners_px - fit.lens.centre_px) @ (way / np.sum(way**2, axis=1, keepdims=True)).T
    return float(went.max(axis=0).min())


def fold_px(lens: Intrinsics) -> float:
    """Largest error of undistorting and distorting the picture's edge, px; above zero where the polynomial folds over."""
    width, height = lens.size_px
    x, y = np.linspace(0.0, width - 1.0, 33), np.linspace(0.0, height - 1.0, 25)
    edge = np.concatenate([np.stack(np.broadcast_arrays(x, v), axis=-1) for v in (y[0], y[-1])])
    edge = np.concatenate([edge, *(np.stack(np.broadcast_arrays(u, y), axis=-1) for u in (x[0], x[-1]))])
    rays = lens.rays(edge)
    back, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), lens.matrix, np.array(lens.distortion))
    return float(np.abs(np.asarray(back)[:, 0] - edge).max())

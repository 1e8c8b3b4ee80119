"""The pool's grid drawn over a picture by the calibration, and the scale and field of view at a depth.

Lens and water bend straight lines of the pool into curves of the picture, so they are drawn in short pieces.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from localizer.camera_model import RefractiveCamera
from localizer.detection.image_regions import Pixels
from localizer.view.drawing import Bgr, polyline, write
from shoal.config.perception import Camera
from shoal.config.scene import PoolConfig
from shoal.frames import Array

GRID_M = 0.25
_NAMED_M = 0.5
GRID: Bgr = (235, 120, 235)  # pink, which no pool is
SURFACE: Bgr = (80, 220, 255)
FLOOR: Bgr = (80, 160, 80)
MARK: Bgr = (60, 60, 230)
_PIECE_M = 0.02  # m, length of a straight piece, which bends by less than 0.01 px
_MARK_M = 0.15  # m, arms of the origin's mark
_TRUE_M = 1e-3  # m; a point that maps back with a larger error lies where the lens's polynomial folds over: not drawn
_SAMPLES = 41  # per axis of the pool, to measure the share of it that is in the picture


@dataclass(frozen=True)
class ViewFigures:
    """Field of view and scale of a camera at one depth."""

    field_m: tuple[float, float]  # width through the picture's middle, height
    seen_share: float  # of the pool's area at that depth
    mm_per_px: tuple[float, float]  # in the picture's middle, in its worst corner
    mm_per_cm_depth: tuple[float, float]  # error of a place per cm of depth error, likewise


def view_figures(camera: Camera, pool: PoolConfig, depth_m: float) -> ViewFigures:
    """The figures for one depth."""
    view = RefractiveCamera(camera)
    width, height = camera.size_px
    left, right, top, bottom = -0.5, width - 0.5, -0.5, height - 0.5
    middle_x, middle_y = (left + right) / 2, (top + bottom) / 2

    edge_middles = np.array([[left, middle_y], [right, middle_y], [middle_x, top], [middle_x, bottom]])
    at_left_m, at_right_m, at_top_m, at_bottom_m = view.pixel_to_pool(edge_middles, depth_m)

    last_x, last_y = width - 1.0, height - 1.0
    middle_and_corners = np.array([[middle_x, middle_y], [0.0, 0.0], [last_x, 0.0], [last_x, last_y], [0.0, last_y]])
    jacobians = view.jacobian(middle_and_corners, depth_m)  # of the place in the pool, by pixel (2) and depth
    mm_per_px = 1e3 * np.linalg.norm(jacobians[:, :, :2], axis=(1, 2), ord=2)
    mm_per_cm_depth = 10.0 * np.linalg.norm(jacobians[:, :, 2], axis=1)

    length_m, width_m, _ = pool.size_m
    x = np.linspace(-length_m / 2, length_m / 2, _SAMPLES)
    y = np.linspace(-width_m / 2, width_m / 2, _SAMPLES)
    plane = np.stack([*np.meshgrid(x, y), np.full((_SAMPLES, _SAMPLES), depth_m)], axis=-1).reshape(-1, 3)
    return ViewFigures(
        field_m=(float(np.linalg.norm(at_right_m - at_left_m)), float(np.linalg.norm(at_bottom_m - at_top_m))),
        seen_share=float(np.mean(_in_picture(camera, _true_pixels(view, plane)))),
        mm_per_px=(float(mm_per_px[0]), float(mm_per_px[1:].max())),
        mm_per_cm_depth=(float(mm_per_cm_depth[0]), float(mm_per_cm_depth[1:].max())),
    )


def draw_grid(picture: Pixels, camera: Camera, pool: PoolConfig, depth_m: float) -> None:
    """Draw into a BGR picture (height, width, 3): a grid at `depth_m`, the pool's outline at surface and floor, its
    upright edges, and the origin's mark with the axes' names."""
    view = RefractiveCamera(camera)
    for line in _grid_lines(pool, depth_m):
        _curve(picture, view, line, GRID, 1)
    half_x, half_y, floor = pool.size_m[0] / 2, pool.size_m[1] / 2, pool.size_m[2]
    ring = np.array([[-half_x, -half_y], [half_x, -half_y], [half_x, half_y], [-half_x, half_y]])
    for corner, after in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        _curve(picture, view, _line((*corner, floor), (*after, floor)), FLOOR, 2)
        _curve(picture, view, _line((*corner, 0.0), (*corner, floor)), FLOOR, 1)
        _curve(picture, view, _line((*corner, 0.0), (*after, 0.0)), SURFACE, 2)
    for arm in ((_MARK_M, 0.0), (0.0, _MARK_M)):
        _curve(picture, view, _line((-arm[0], -arm[1], 0.0), (*arm, 0.0)), MARK, 2)
        _name(picture, view, "x" if arm[0] else "y", (1.3 * arm[0], 1.3 * arm[1], 0.0), MARK)
    for x in _steps(half_x, _NAMED_M):
        _name(picture, view, f"{x:g}", (x, 0.0, depth_m), GRID)
    for y in _steps(half_y, _NAMED_M):
        if y:
            _name(picture, view, f"{y:g}", (0.0, y, depth_m), GRID)


def _grid_lines(pool: PoolConfig, depth_m: float) -> Iterator[Array]:
    half_x, half_y = pool.size_m[0] / 2, pool.size_m[1] / 2
    yield from (_line((x, -half_y, depth_m), (x, half_y, depth_m)) for x in _steps(half_x))
    yield from (_line((-half_x, y, depth_m), (half_x, y, depth_m)) for y in _steps(half_y))


def _steps(half_m: float, step_m: float = GRID_M) -> Array:
    """Multiples of a step within the walls, the origin included."""
    count = int(half_m / step_m + 1e-9)
    return np.arange(-count, count + 1, dtype=np.float64) * step_m


def _line(start: Sequence[float], end: Sequence[float]) -> Array:
    """Points (n, 3) of a straight line."""
    first, last = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    pieces = max(int(np.ceil(np.linalg.norm(last - first) / _PIECE_M)), 1)
    return np.asarray(first + np.linspace(0.0, 1.0, pieces + 1)[:, None] * (last - first))


def _true_pixels(view: RefractiveCamera, points: Array) -> Array:
    """Pixels (n, 2) of points (n, 3); NaN for those that lie behind the camera or where the lens model folds over."""
    pixels = view.pool_to_pixel(points)
    true = np.linalg.norm(view.pixel_to_pool(pixels, points[:, 2]) - points[:, :2], axis=1) < _TRUE_M
    return np.where(true[:, None], pixels, np.nan)


def _in_picture(camera: Camera, pixels: Array) -> NDArray[np.bool_]:
    return np.asarray(np.all((pixels >= -0.5) & (pixels <= np.array(camera.size_px) - 0.5), axis=1))


def _curve(picture: Pixels, view: RefractiveCamera, points: Array, colour: Bgr, thickness: int) -> None:
    """Draw a line through pool points (n, 3) as the camera sees it; pieces that it cannot see are left out."""
    pixels = _true_pixels(view, points)
    good = np.isfinite(pixels[:, 0])
    for run in np.split(np.arange(len(points)), np.flatnonzero(np.diff(good)) + 1):
        if good[run[0]] and len(run) > 1:
            polyline(picture, pixels[run], colour, thickness)


def _name(picture: Pixels, view: RefractiveCamera, text: str, point: tuple[float, float, float], colour: Bgr) -> None:
    pixel = _true_pixels(view, np.array([point]))[0]
    if np.all(np.isfinite(pixel)):
        write(picture, text, pixel + np.array([3.0, -4.0]), colour)

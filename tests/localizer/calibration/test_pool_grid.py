"""The drawn grid against the simulator's optics, and the figures against geometry by hand."""

import numpy as np
import pytest

from localizer.calibration.pool_grid import FLOOR, GRID, GRID_M, MARK, SURFACE, draw_grid, view_figures
from localizer.camera_model import RefractiveCamera
from shoal.config.experiment import load_experiment
from shoal.config.perception import Camera
from shoal.config.scene import PoolConfig
from shoal.frames import Array
from sim_bridge.camera.optics import project

EXPERIMENT = load_experiment("pool")
TILTED = EXPERIMENT.camera.model_copy(
    update={"rotation_rad": (0.06, -0.05, 0.4), "position_m": (0.2, -0.1, -2.9), "focal_px": (760.0, 765.0)}
)
PLAIN = EXPERIMENT.camera.model_copy(update={"distortion": (0.0,) * 5})
DEPTH_M = 0.3
CAMERAS = pytest.mark.parametrize("camera", [EXPERIMENT.camera, TILTED], ids=["pool", "tilted"])


def _drawn(camera: Camera, pool: PoolConfig = EXPERIMENT.pool) -> Array:
    picture = np.zeros((camera.size_px[1], camera.size_px[0], 3), np.uint8)
    draw_grid(picture, camera, pool, DEPTH_M)
    return picture.astype(np.float64)


def _share(picture: Array, camera: Camera, point: tuple[float, float, float], colour: tuple[int, int, int]) -> float:
    """Share of a colour at the pixel at which the simulator sees a point: 1 all, 0 none."""
    u, v = np.rint(project(camera, np.array([point]))[0]).astype(int)
    return float(picture[v, u] @ np.array(colour) / np.sum(np.square(colour)))


@CAMERAS
@pytest.mark.parametrize("point", [(0.5, 0.25), (-1.25, 0.625), (1.1, -0.75), (-0.6, 1.0), (1.5, 1.15)])
def test_grid_lines_pass_where_the_camera_sees_them(camera: Camera, point: tuple[float, float]) -> None:
    picture = _drawn(camera)
    assert _share(picture, camera, (*point, DEPTH_M), GRID) > 0.5
    assert _share(picture, camera, (point[0] + 0.06, point[1] + 0.08, DEPTH_M), GRID) < 0.1


@CAMERAS
def test_outlines_and_origin_lie_where_the_camera_sees_them(camera: Camera) -> None:
    picture = _drawn(camera)
    for x, y in ((1.75, 0.3), (-1.75, -0.6), (0.4, 1.25), (-1.1, -1.25)):
        assert _share(picture, camera, (x, y, 0.0), SURFACE) > 0.5
        assert _share(picture, camera, (x, y, 1.0), FLOOR) > 0.5
        assert _share(picture, camera, (x, y, 0.8), FLOOR) < 0.3
    assert _share(picture, camera, (1.75, 1.25, 0.6), FLOOR) > 0.3  # an upright edge
    for x, y in ((0.0, 0.0), (0.13, 0.0), (-0.13, 0.0), (0.0, 0.13)):
        assert _share(picture, camera, (x, y, 0.0), MARK) > 0.5


def test_a_camera_that_looks_away_shows_nothing_of_the_pool() -> None:
    pool, camera = load_experiment("pool").pool, load_experiment("pool").camera
    away = camera.model_copy(update={"rotation_rad": (0.0, np.pi, 0.0)})
    picture = np.zeros((camera.size_px[1], camera.size_px[0], 3), np.uint8)
    draw_grid(picture, away, pool, 0.3)
    assert not picture.any() and view_figures(away, pool, 0.3).seen_share == 0.0


def test_a_lens_that_folds_over_draws_nothing_that_is_not_there() -> None:
    """r (1 - 0.35 r^2) turns back at r = 0.98: walls beyond would come back into the picture."""
    camera = EXPERIMENT.camera.model_copy(update={"focal_px": (900.0, 900.0), "distortion": (-0.35, 0.0, 0.0, 0.0, 0.0)})
    large = PoolConfig(size_m=(16.0, 16.0, 1.0))
    blue, green, red = np.moveaxis(_drawn(camera, large), 2, 0)
    pixels = np.argwhere((blue > 140.0) & (red > 140.0) & (green < 0.7 * blue))[:, ::-1].astype(np.float64)
    assert len(pixels) > 1000
    place = RefractiveCamera(camera).pixel_to_pool(pixels, DEPTH_M)
    off = np.abs(place - GRID_M * np.rint(place / GRID_M)).min(axis=1)
    assert np.mean(off > 0.01) < 0.05  # lines are a pixel or two wide, 3 mm each; the rest is text


@pytest.mark.parametrize("depth_m", [-0.2, 0.0, 0.3, 0.9])
def test_figures_of_a_plain_camera(depth_m: float) -> None:
    """Looking straight down, without distortion: similar triangles, and Snell's law at the edge."""
    height_m, focal_px = 2.8, 1005.0
    edges = np.array([1280 / 2, 960 / 2]) / focal_px
    in_water = edges / np.sqrt(edges**2 + 1.0) / 1.333
    slope = in_water / np.sqrt(1.0 - in_water**2) if depth_m > 0 else edges
    result = view_figures(PLAIN, EXPERIMENT.pool, depth_m)
    assert result.field_m == pytest.approx(2.0 * (height_m * edges + depth_m * slope))
    to_centre = height_m + (depth_m / 1.333 if depth_m > 0 else depth_m)
    assert result.mm_per_px[0] == pytest.approx(1e3 * to_centre / focal_px, rel=1e-4)
    assert result.mm_per_cm_depth[0] == pytest.approx(0.0, abs=0.01)
    corner = np.hypot(1279 / 2, 959 / 2) / focal_px
    sine = corner / np.sqrt(corner**2 + 1.0) / 1.333
    lean = sine / np.sqrt(1.0 - sine**2) if depth_m > 0 else corner
    assert result.mm_per_cm_depth[1] == pytest.approx(10.0 * lean, rel=1e-3)
    assert (result.seen_share == 1.0) == (depth_m >= 0.0)


def test_how_much_of_the_pool_is_seen() -> None:
    """The picture is 3.57 m x 2.67 m at the surface."""
    twice = PoolConfig(size_m=(2 * 3.566, 2 * 2.675, 1.0))
    assert view_figures(PLAIN, twice, 0.0).seen_share == pytest.approx(0.25, abs=0.02)

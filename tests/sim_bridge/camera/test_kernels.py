"""The compiled parts of the picture against plain NumPy and OpenCV, and without compilation."""

import os
import subprocess
import sys

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from shoal.config.experiment import load_experiment
from sim_bridge.camera import kernels
from sim_bridge.camera.kernels import (
    AIR_X,
    AIR_Y,
    GLARE,
    LAMP_UP,
    LAMP_X,
    LAMP_Y,
    LIGHT,
    PENUMBRA,
    SHADOW,
    SURFACE_X,
    SURFACE_Y,
    WATER_X,
    WATER_Y,
    ImageRect,
    RayBundle,
)
from sim_bridge.camera.rays import CameraRays
from sim_bridge.camera.scene import WaterView
from sim_bridge.camera.water_optics import CAUSTIC_UNIT, Blend, RowLight, WaterLight, blend_lit_view

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"


def test_a_sample_is_bilinear_and_repeats_the_edge() -> None:
    """One layer for even lanes and another for odd ones; lanes that are not used keep no trace of the texture."""
    random = np.random.default_rng(1)
    texture = random.integers(0, 256, (3, 9, 13), dtype=np.uint8)
    lanes, corners = np.zeros((kernels.LANE_ROWS, kernels.LANES)), np.empty((2, kernels.LANES), np.int32)
    for _ in range(10):
        used = random.random(kernels.LANES) < 0.8
        places = random.uniform(-3.0, 15.0, (2, kernels.LANES))
        lanes[kernels.SPHERE_COVER], lanes[kernels.SKIN_COLUMN : kernels.SKIN_ROW + 1] = used, places
        kernels.sample(texture, 1, 2, lanes, kernels.SPHERE_COVER, kernels.SKIN_COLUMN, kernels.PAINT, corners)
        for n in np.flatnonzero(used):
            expected = map_coordinates(texture[1 + n % 2].astype(float), places[::-1, n : n + 1], order=1, mode="nearest")[0]
            assert lanes[kernels.PAINT, n] == pytest.approx(expected, abs=0.3)  # the last texel's last thousandth


def test_a_line_meets_the_sphere_on_its_upper_side() -> None:
    """The point lies on the sphere and on the line; a line beside it covers nothing."""
    random = np.random.default_rng(2)
    for x, y, slope_x, slope_y in random.uniform(-0.2, 0.2, (200, 4)):
        normal_x, normal_y, up, cover = kernels.intersect_sphere(x, y, slope_x, slope_y, 0.15, 250.0)
        line = np.array([slope_x, slope_y, 1.0])
        distance = np.linalg.norm(np.cross([x, y, 0.0], line)) / np.linalg.norm(line)
        assert cover == pytest.approx(np.clip((0.15 - distance) * 250.0 + 0.5, 0.0, 1.0), abs=1e-9)
        if distance < 0.15:
            assert normal_x**2 + normal_y**2 + up**2 == pytest.approx(1.0)
            point = np.array([x, y, 0.0]) - 0.15 * up * line
            assert point == pytest.approx([0.15 * normal_x, 0.15 * normal_y, -0.15 * up])
            assert normal_x * slope_x + normal_y * slope_y - up <= 0.0  # towards the camera


@pytest.mark.parametrize("rect", [ImageRect(10, 60, 20, 90, 0, 9, 1, 13), ImageRect(0, 75, 0, 101, 0, 10, 0, 13)])
def test_a_shadow_is_the_picture_times_the_light_that_is_left(rect: ImageRect) -> None:
    """Against the light at the blocks' middles in NumPy, interpolated by OpenCV; also up to the edges of an odd picture."""
    random = np.random.default_rng(3)
    raw, lines = (
        random.integers(0, 256, (75, 101), dtype=np.uint8),
        random.uniform(-0.02, 0.02, (6, 10, 13)).astype(np.float32),
    )
    rows, columns = np.mgrid[:10, :13]
    lines[0] += 0.04 * columns - 0.3
    lines[1] += 0.04 * rows - 0.2
    depth_m = random.uniform(0.9, 1.1, (10, 13)).astype(np.float32)
    place, radius_m = np.array([0.1, 0.05, 0.4, 0.0]), 0.15
    below = depth_m - place[2]
    off = [lines[k] + depth_m * lines[4 + k] - place[k] + below * lamp / LAMP_UP for k, lamp in enumerate((LAMP_X, LAMP_Y))]
    inside = np.clip((radius_m - np.hypot(*off)) / (PENUMBRA * below) * 0.5 + 0.5, 0.0, 1.0)
    light = 1.0 - SHADOW * inside**2 * (3.0 - 2.0 * inside)
    assert light.min() < 0.8
    fine = cv2.resize(light, (8 * 13, 8 * 10), interpolation=cv2.INTER_LINEAR)
    expected, spot = raw.astype(float), np.s_[rect.top : rect.bottom, rect.left : rect.right]
    expected[spot] *= fine[spot]
    part = np.empty(light[rect.blocks].shape)
    left_over = np.empty(8 * (part.shape[1] + 1), np.float32)
    kernels.draw_shadow(raw, rect, RayBundle(*lines), depth_m, place, radius_m, part, left_over)
    off_by = np.abs(raw - expected)
    assert off_by[4:71, 4:97].max() < 0.51
    assert off_by.max() < 12.0  # beyond the outermost blocks' middles the light goes on straight here, and is constant there


def test_noise_is_added_and_clipped() -> None:
    random = np.random.default_rng(4)
    raw = np.tile(np.array([0, 1, 100, 254, 255], np.uint8), (6, 8))
    field = random.integers(-127, 128, (20, 60)).astype(np.int8)
    noisy = np.empty_like(raw)
    kernels.add_noise(raw, field, 7, 11, 0.01, 0.0004, noisy)
    exact = raw + np.sqrt(0.01 + 0.0004 * raw) * field[7:13, 11:51]
    assert np.abs(noisy - np.clip(exact, 0, 255)).max() < 0.501


def test_fields_of_a_rectangle_are_those_of_the_whole_picture() -> None:
    """Bent lines, caustic light and glare by block against the same in NumPy and OpenCV, whose samples are 1/32 px apart."""
    size = ("camera.size_px=[320, 240]", "camera.focal_px=[251.25, 251.25]", "camera.centre_px=[159.5, 119.5]")
    experiment = load_experiment("pool", size)
    view, waters = CameraRays(experiment.camera), WaterLight(experiment, np.random.default_rng(5))
    scene = WaterView(waters, view, np.ones_like(view.blocks.surface_x))
    depth_m, time_s = 0.6, 0.7
    lines, slopes = view.blocks, scene.slopes(waters.ripple_clock.loop_s(time_s))
    x, y = lines.surface_x + depth_m * lines.water_x, lines.surface_y + depth_m * lines.water_y
    light = waters.light(*waters.caustics.grid_coordinates(x, y), np.float32(waters.reach(depth_m)), time_s)
    fields = scene.fields(ImageRect(0, 240, 0, 320, 0, 30, 0, 40), depth_m, time_s)
    bent = lines.deflected(scene.bending * slopes[0], scene.bending * slopes[1])
    assert fields[[SURFACE_X, SURFACE_Y, AIR_X, AIR_Y, WATER_X, WATER_Y]] == pytest.approx(np.stack(bent), abs=1e-6)
    assert np.abs(fields[LIGHT] - light).max() < 0.05 < np.ptp(light)
    assert fields[GLARE] == pytest.approx(scene.glare(slopes), abs=0.01)
    assert fields[GLARE].max() > 1.0
    part = ImageRect(16, 80, 24, 120, 1, 11, 2, 16)
    assert np.array_equal(scene.fields(part, depth_m, time_s), fields[:, *part.blocks])


def test_a_picture_lies_between_two_of_each_loop() -> None:
    """The same in NumPy, of an odd size: view between two views, times light between two patterns, and the glare."""
    random = np.random.default_rng(6)
    view, next_view = random.integers(0, 256, (2, 7, 11), dtype=np.uint8)
    glare, next_glare, levels, next_levels = random.integers(0, 201, (4, 4, 6), dtype=np.uint8)
    reach, raw = random.uniform(0.0, 1.0, (4, 6)).astype(np.float32), np.empty((7, 11), np.uint8)
    scratch = RowLight(*(np.empty(n, np.float32) for n in (6, 6, 12, 12)))
    views, glares = Blend(view, next_view, 0.3), Blend(glare, next_glare, 0.3)
    blend_lit_view(views, glares, Blend(levels, next_levels, 0.8), reach, scratch, raw)
    light = 1.0 + reach * ((0.2 * levels + 0.8 * next_levels) / CAUSTIC_UNIT - 1.0)
    pixels = np.ones((2, 2))
    lit = (0.7 * view + 0.3 * next_view) * np.kron(light, pixels)[:7, :11]
    exact = lit + np.kron(0.7 * glare + 0.3 * next_glare, pixels)[:7, :11]
    assert np.abs(raw - np.clip(exact, 0.0, 255.0)).max() < 0.501


@pytest.mark.long
@pytest.mark.skipif(INTERPRETED, reason="runs within itself")
def test_the_kernels_are_plain_python_too() -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", __file__]
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout

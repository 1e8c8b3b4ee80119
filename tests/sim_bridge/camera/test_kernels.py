"""The compiled parts of the picture against plain NumPy and OpenCV, and without compilation."""

import os
import subprocess
import sys

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from sim_bridge.camera import kernels
from sim_bridge.camera.rays import CameraRays, ImageRect
from sim_bridge.camera.scene import WaterView
from sim_bridge.camera.water_optics import CAUSTIC_UNIT, WaterLight, light_up
from wire.config.experiment import load_experiment

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"


def test_a_sample_is_bilinear_and_repeats_the_edge() -> None:
    random = np.random.default_rng(1)
    texture = random.integers(0, 256, (2, 9, 13), dtype=np.uint8)
    for column, row in random.uniform(-3.0, 15.0, (200, 2)):
        expected = map_coordinates(texture[1].astype(float), [[row], [column]], order=1, mode="nearest")[0]
        assert kernels.sample(texture, 1, column, row) == pytest.approx(expected, abs=0.3)  # the last texel's last thousandth


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


def test_darkening_is_a_product() -> None:
    random = np.random.default_rng(3)
    raw, light = random.integers(0, 256, (20, 30), dtype=np.uint8), random.uniform(0.5, 1.0, (8, 12)).astype(np.float32)
    expected = raw.copy()
    spot = expected[4:12, 6:18]
    spot[:] = cv2.multiply(spot, light, dtype=cv2.CV_8U)
    kernels.darken(raw, 4, 6, light)
    assert np.abs(raw.astype(int) - expected).max() <= 1
    assert np.mean(raw != expected) < 0.02  # halves are rounded up here, and to even there


def test_noise_is_added_and_clipped() -> None:
    random = np.random.default_rng(4)
    raw = np.tile(np.array([0, 1, 100, 254, 255], np.uint8), (6, 8))
    field = random.integers(-127, 128, (20, 60)).astype(np.int8)
    noisy = np.empty_like(raw)
    kernels.add_noise(raw, field, 7, 11, np.float32(0.01), np.float32(0.0004), noisy)
    exact = raw + np.sqrt(0.01 + 0.0004 * raw) * field[7:13, 11:51]
    assert np.abs(noisy - np.clip(exact, 0, 255)).max() < 0.501


def test_fields_of_a_rectangle_are_those_of_the_whole_picture() -> None:
    """Slopes, caustic light and glare by block against the same in NumPy and OpenCV, whose samples are 1/32 px apart."""
    size = ("camera.size_px=[320, 240]", "camera.focal_px=[251.25, 251.25]", "camera.centre_px=[159.5, 119.5]")
    experiment = load_experiment("pool", size)
    view, waters = CameraRays(experiment.camera), WaterLight(experiment, np.random.default_rng(5))
    scene = WaterView(waters, view, np.ones_like(view.blocks.surface_x), np.ones((240, 320), np.float32))
    window, depth_m, time_s = view.whole, 0.6, 0.7
    lines, slopes = view.blocks, scene.slopes(window, waters.ripple_clock.loop_s(time_s))
    x, y = lines.surface_x + depth_m * lines.water_x, lines.surface_y + depth_m * lines.water_y
    light = waters.light(*waters.caustics.grid_coordinates(x, y), np.float32(waters.reach(depth_m)), time_s)
    found = scene.fields(window, depth_m, time_s)
    assert found[..., :2] == pytest.approx(np.moveaxis(scene.bending * slopes, 0, -1), abs=1e-6)
    assert np.abs(found[..., 2] - light).max() < 0.05 < np.ptp(light)
    assert found[..., 3] == pytest.approx(scene.glare(window, slopes), abs=0.01)
    assert found[..., 3].max() > 1.0
    part = ImageRect(16, 80, 24, 120, 1, 11, 2, 16)
    assert np.array_equal(scene.fields(part, depth_m, time_s), found[part.blocks])


def test_a_picture_lies_between_two_of_each_loop() -> None:
    """The same in NumPy, of an odd size: view between two views, times light between two patterns, and the glare."""
    random = np.random.default_rng(6)
    view, next_view = random.integers(0, 256, (2, 7, 11), dtype=np.uint8)
    glare, next_glare, levels, next_levels = random.integers(0, 201, (4, 4, 6), dtype=np.uint8)
    reach, raw = random.uniform(0.0, 1.0, (4, 6)).astype(np.float32), np.empty((7, 11), np.uint8)
    scratch = tuple(np.empty(n, np.float32) for n in (6, 6, 12, 12))
    light_up(view, next_view, glare, next_glare, np.float32(0.3), levels, next_levels, np.float32(0.8), reach, scratch, raw)
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

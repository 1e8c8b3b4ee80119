"""The compiled parts of the picture against plain NumPy and OpenCV, and without compilation."""

import os
import subprocess
import sys

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from sim_bridge.camera import kernels

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


@pytest.mark.skipif(INTERPRETED, reason="runs within itself")
def test_the_kernels_are_plain_python_too() -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", __file__]
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout

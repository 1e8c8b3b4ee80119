"""Each kernel against NumPy and OpenCV, compiled and as plain Python."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from localizer import kernels
from localizer.camera_model import RefractiveCamera
from shoal.config.perception import Camera
from shoal.frames import Array
from tests.localizer import numpy_geometry as reference
from tests.localizer.cameras import CAMERA, TILTED

pytestmark = pytest.mark.long

CAMERAS = pytest.mark.parametrize("camera", [CAMERA, TILTED], ids=["pool", "tilted"])
COUNT = 40


def _pixels(random: np.random.Generator) -> tuple[Array, Array]:
    """Pixels (n, 2) over the whole picture, and depths (n,) above and below the surface."""
    return random.uniform([0.0, 0.0], [1279.0, 959.0], (COUNT, 2)), random.uniform(-0.3, 1.2, COUNT)


def _state(random: np.random.Generator) -> tuple[Array, Array]:
    root = random.normal(size=(6, 6)) * np.array([0.01, 0.01, 0.05, 0.1, 0.1, 0.5])[:, None]
    return random.normal(size=6) * 2.0, root @ root.T + 1e-8 * np.eye(6)


@CAMERAS
def test_pixels_and_pool(camera: Camera) -> None:
    pixels, depths = _pixels(np.random.default_rng(1))
    view = RefractiveCamera(camera)
    places = view.pixel_to_pool(pixels, depths)
    assert places == pytest.approx(reference.pool_points(camera, pixels, depths), abs=1e-9)
    points = np.column_stack([places, depths])
    points[0, :2] = camera.position_m[:2]  # under the camera's foot
    assert view.pool_to_pixel(points) == pytest.approx(reference.pixels_of(camera, points), abs=1e-8)
    assert view.jacobian(pixels, depths) == pytest.approx(reference.jacobians(camera, pixels, depths), abs=1e-9)


@CAMERAS
def test_marker_poses(camera: Camera) -> None:
    """Also of corners that are no square."""
    random, view = np.random.default_rng(2), RefractiveCamera(camera)
    corners, depths = np.empty((COUNT, 4, 2)), random.uniform(-0.1, 0.9, COUNT)
    for i in range(COUNT):
        yaw, place = random.uniform(-np.pi, np.pi), random.uniform([-1.2, -0.9], [1.2, 0.9])
        turn = yaw + np.pi / 4.0 * np.array([-1.0, 1.0, 3.0, 5.0])
        plate = place + 0.07 * np.column_stack([np.cos(turn), np.sin(turn)])
        corners[i] = view.pool_to_pixel(np.column_stack([plate, np.full(4, depths[i])])) + random.normal(0.0, 2.0, (4, 2))
    tilts = random.normal(0.0, 0.1, (COUNT, 2))
    poses, misfits = np.empty((COUNT, 3)), np.empty((COUNT, 2))
    kernels.marker_poses(view.numbers, corners, depths, tilts, 0.1, poses, misfits)
    for i in range(COUNT):
        pose, misfit = reference.marker_pose(camera, corners[i], float(depths[i]), tilts[i], 0.1)
        assert poses[i] == pytest.approx(pose, abs=1e-9) and misfits[i] == pytest.approx(misfit, abs=1e-7)


def test_measurement_covariance() -> None:
    random = np.random.default_rng(3)
    slopes, root, result = random.normal(size=(2, 3)), random.normal(size=(3, 3)), np.empty((3, 3))
    kernels.measurement_covariance(slopes, root @ root.T, 0.2, 0.05, 0.3, 0.7, result)
    expected = root @ root.T + np.diag([0.3, 0.3, 0.7])
    expected[:2, :2] += slopes @ np.diag([0.04, 0.04, 0.0025]) @ slopes.T
    assert result == pytest.approx(expected, abs=1e-12)


def test_kalman_filter() -> None:
    """A thousand steps, each from the kernels' own state: covariances stay symmetric to the last bit, and right to 1e-9 of the
    standard deviations."""
    random = np.random.default_rng(4)
    (mean, covariance), after, spread = _state(random), np.empty(6), np.empty((6, 6))
    for _ in range(1000):
        step = float(random.choice([0.0, 0.02, 0.05, 0.1]))
        kernels.kalman_predict(mean, covariance, step, 1.0, 6.0, after, spread)
        expected = reference.kalman_predict(mean, covariance, step, 1.0, 6.0)
        assert after == pytest.approx(expected[0], abs=1e-9) and _differ(spread, expected[1]) < 1e-9
        root = random.normal(size=(3, 3)) * 0.001
        ahead, before, noise = after.copy(), spread.copy(), root @ root.T + 1e-8 * np.eye(3)
        pose = ahead[:3] + np.linalg.cholesky(before[:3, :3] + noise) @ random.normal(size=3)
        squared = kernels.kalman_update(ahead, before, pose, noise, mean, covariance)
        distance, state, width = reference.kalman_update(ahead, before, pose, noise)
        assert squared == pytest.approx(distance, rel=1e-6)
        assert mean == pytest.approx(state, abs=1e-9) and _differ(covariance, width) < 1e-9
        assert np.array_equal(covariance, covariance.T)


def _differ(result: Array, expected: Array) -> float:
    """Largest difference of two covariances, in products of the expected standard deviations."""
    sigma = np.sqrt(np.diag(expected))
    return float(np.abs((result - expected) / np.outer(sigma, sigma)).max())


def test_sampled_colours() -> None:
    """Half of the samples lie beyond the picture's border; a place that is not a number takes the first pixel."""
    random = np.random.default_rng(5)
    picture = random.integers(0, 256, (30, 40, 3), np.uint8)
    points, to_px = random.uniform(-0.2, 0.2, (3, 200)), random.uniform(-100.0, 100.0, (2, 3))
    samples = np.empty((3, 200), np.float32)
    kernels.sample_colours(picture, points, to_px, 18.3, 14.6, samples)
    expected = reference.sample_colours(picture.astype(np.float64), points, to_px, 18.3, 14.6)
    assert samples == pytest.approx(expected, abs=1e-4)
    kernels.sample_colours(picture, np.full((3, 200), np.nan), to_px, 18.3, 14.6, samples)
    assert np.array_equal(samples[:, 7], picture[0, 0])


@pytest.mark.skipif("NUMBA_DISABLE_JIT" in os.environ, reason="this is the run without compiling")
def test_kernels_as_plain_python() -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", __file__]
    root = Path(__file__).parents[2]
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(command, env=environment, cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout

"""The camera's optics against Fermat's principle, Snell's law in vectors, and OpenCV's own pinhole."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from shoal.config.experiment import load_experiment
from shoal.config.perception import Camera
from shoal.frames import Array
from sim_bridge.camera.optics import Optics, project, rays

CAMERA = load_experiment("pool").camera
TILTED = CAMERA.model_copy(
    update={
        "rotation_rad": (0.12, -0.17, 0.4),
        "position_m": (-0.3, 0.25, -2.2),
        "focal_px": (1010.0, 985.0),
        "centre_px": (655.2, 470.7),
        "distortion": (-0.2, 0.06, 0.0012, -0.0009, -0.008),
    }
)
CAMERAS = pytest.mark.parametrize("camera", [CAMERA, TILTED], ids=["pool", "tilted"])


def _travel_time_is_least(camera: Camera, point: Array) -> Array:
    """The point at which light crosses the surface: in the vertical plane through both ends, at the stationary optical
    path."""
    lens = np.array(camera.position_m)
    reach = float(np.hypot(*(point - lens)[:2]))

    def path(r: float) -> float:
        return float(np.hypot(r, lens[2]) + camera.water_index * np.hypot(reach - r, point[2]))

    step = 1e-5
    crossing = brentq(lambda r: path(r + step) - path(r - step), -0.1, reach + 0.1, xtol=1e-12)
    return np.append(lens[:2] + crossing * (point - lens)[:2] / reach, 0.0)


@CAMERAS
@pytest.mark.parametrize("place", [(0.1, 0.0, 0.3), (1.7, 1.2, 0.15), (-1.5, 0.9, 0.8), (0.4, -1.2, 1.0), (1.0, 0.4, 0.02)])
def test_light_takes_the_quickest_way(camera: Camera, place: tuple[float, float, float]) -> None:
    point = np.array(place)
    crossing = _travel_time_is_least(camera, point)
    assert Optics(camera).see(point).crossings[0] == pytest.approx(crossing, abs=1e-8)
    matrix = np.array([[camera.focal_px[0], 0, camera.centre_px[0]], [0, camera.focal_px[1], camera.centre_px[1]], [0, 0, 1]])
    ray = cv2.Rodrigues(np.array(camera.rotation_rad))[0] @ (crossing - np.array(camera.position_m))
    expected = cv2.projectPoints(ray[None], np.zeros(3), np.zeros(3), matrix, np.array(camera.distortion))[0].ravel()
    assert project(camera, point)[0] == pytest.approx(expected, abs=1e-5)


@CAMERAS
def test_rays_obey_snell(camera: Camera) -> None:
    """n1 (d1 x normal) = n2 (d2 x normal), and the ray before the surface starts at the lens."""
    pixels = np.stack(np.meshgrid(np.linspace(0, 1279, 9), np.linspace(0, 959, 7)), axis=-1)
    lines = rays(camera, pixels)
    ones = np.ones((*pixels.shape[:2], 1))
    air, water = np.concatenate([lines.air, ones], axis=-1), np.concatenate([lines.water, ones], axis=-1)
    air /= np.linalg.norm(air, axis=-1, keepdims=True)
    water /= np.linalg.norm(water, axis=-1, keepdims=True)
    down = np.array([0.0, 0.0, 1.0])
    assert np.cross(air, down) == pytest.approx(camera.water_index * np.cross(water, down), abs=1e-12)
    height = -camera.position_m[2]
    assert lines.surface_m - height * lines.air == pytest.approx(np.broadcast_to(camera.position_m[:2], lines.air.shape))


@CAMERAS
@given(u=st.floats(0, 1279), v=st.floats(0, 959), depth_m=st.floats(-0.5, 4.0))
def test_points_along_a_ray_are_seen_in_its_pixel(camera: Camera, u: float, v: float, depth_m: float) -> None:
    lines = rays(camera, np.array([u, v]))
    slope = lines.water if depth_m > 0 else lines.air
    point = np.append(lines.surface_m + depth_m * slope, depth_m)
    assert project(camera, point)[0] == pytest.approx([u, v], abs=1e-6)


def test_axes_and_parallax() -> None:
    middle, ahead, starboard = project(CAMERA, np.array([[0, 0, 0.3], [0.5, 0, 0.3], [0, 0.5, 0.3]]))
    assert middle == pytest.approx([639.5, 479.5])
    assert ahead[0] > middle[0] + 100 and ahead[1] == pytest.approx(middle[1])
    assert starboard[1] > middle[1] + 100 and starboard[0] == pytest.approx(middle[0])
    top, bottom = project(CAMERA, np.array([[0.5, 0.2, 0.1], [0.5, 0.2, 0.4]]))
    assert np.all(top > bottom), "what is nearer to the camera is seen further out"
    depths = np.column_stack([np.full(50, 0.7), np.full(50, -0.3), np.linspace(-1.0, 3.0, 50)])
    assert np.all(np.diff(project(CAMERA, depths)[:, 0]) < 0)


def test_without_refraction_it_is_a_pinhole() -> None:
    camera = TILTED.model_copy(update={"water_index": 1.0})
    points = np.random.default_rng(3).uniform([-1, -1, 0], [1, 1, 1], (40, 3))
    rotation = np.array(camera.rotation_rad)
    shift = -cv2.Rodrigues(rotation)[0] @ np.array(camera.position_m)
    matrix = np.array([[camera.focal_px[0], 0, camera.centre_px[0]], [0, camera.focal_px[1], camera.centre_px[1]], [0, 0, 1]])
    expected = cv2.projectPoints(points, rotation, shift, matrix, np.array(camera.distortion))[0][:, 0]
    assert project(camera, points) == pytest.approx(expected, abs=1e-7)


def test_behind_the_lens_is_nowhere() -> None:
    assert np.all(np.isnan(project(CAMERA, np.array([[0.0, 0.0, -3.0], [1.0, 0.0, -2.8]]))))


def test_optical_path_grows_along_a_ray() -> None:
    lines = rays(CAMERA, np.array([1200.0, 100.0]))
    depths = np.array([0.0, 0.1, 0.5, 0.9])
    points = np.column_stack([lines.surface_m + depths[:, None] * lines.water, depths])
    length = np.linalg.norm(np.append(lines.water, 1.0))
    path = Optics(CAMERA).see(points).path_m
    assert np.diff(path) == pytest.approx(CAMERA.water_index * length * np.diff(depths))
    assert path[0] == pytest.approx(np.hypot(2.8, np.linalg.norm(lines.surface_m)))

"""The mapping between pixels and pool, against Fermat's principle, straight pinhole optics and finite differences."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize

from localizer.camera_model import RefractiveCamera
from localizer.tracking.check_marks import with_camera
from shoal.config.experiment import load_experiment
from shoal.config.perception import Camera
from shoal.errors import ConfigError
from shoal.frames import Array
from sim_bridge.camera.optics import project
from tests.localizer.cameras import ASLANT, CAMERA, TILTED

CAMERAS = pytest.mark.parametrize("camera", [CAMERA, TILTED], ids=["pool", "tilted"])


@CAMERAS
@given(u=st.floats(0, 1279), v=st.floats(0, 959), depth_m=st.floats(-0.3, 1.2))
def test_pixel_to_pool_and_back(camera: Camera, u: float, v: float, depth_m: float) -> None:
    view = RefractiveCamera(camera)
    x, y = view.pixel_to_pool(np.array([u, v]), depth_m)
    assert view.pool_to_pixel(np.array([x, y, depth_m])) == pytest.approx([u, v], abs=1e-7)


def _crossing_by_fermat(camera: Camera, point: Array) -> Array:
    """The point at which light from a point under water crosses the surface: the one of least travel time."""
    lens = np.array(camera.position_m)

    def travel(xy: Array) -> float:
        surface = np.array([xy[0], xy[1], 0.0])
        return float(np.linalg.norm(surface - lens) + camera.water_index * np.linalg.norm(point - surface))

    start = (lens[:2] + point[:2]) / 2.0
    return np.append(minimize(travel, start, method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-14}).x, 0.0)


@CAMERAS
@pytest.mark.parametrize("point", [(0.0, 0.0, 0.3), (1.6, 1.1, 0.15), (-1.5, 0.9, 0.8), (0.4, -0.31, 1.0)])
def test_refraction_follows_fermat(camera: Camera, point: tuple[float, float, float]) -> None:
    place = np.array(point)
    rotation = cv2.Rodrigues(np.array(camera.rotation_rad))[0]
    matrix = np.array([[camera.focal_px[0], 0, camera.centre_px[0]], [0, camera.focal_px[1], camera.centre_px[1]], [0, 0, 1]])
    ray = rotation @ (_crossing_by_fermat(camera, place) - np.array(camera.position_m))
    expected = cv2.projectPoints(ray[None], np.zeros(3), np.zeros(3), matrix, np.array(camera.distortion))[0].ravel()
    view = RefractiveCamera(camera)
    assert view.pool_to_pixel(place) == pytest.approx(expected, abs=2e-3)
    assert view.pixel_to_pool(expected, place[2]) == pytest.approx(place[:2], abs=1e-5)


def test_the_first_pixels_centre_is_zero() -> None:
    """A pinhole with its axis on the middle of the picture looks straight down between the two middle pixels."""
    plain = CAMERA.model_copy(update={"distortion": (0.0,) * 5})
    view = RefractiveCamera(plain)
    assert view.pool_to_pixel(np.zeros(3)) == pytest.approx([639.5, 479.5])
    metres_per_px = 2.8 / 1005.0
    assert view.pixel_to_pool(np.array([0.0, 0.0]), 0.0) == pytest.approx([-639.5 * metres_per_px, -479.5 * metres_per_px])
    assert view.pixel_to_pool(np.array([1279.0, 959.0]), 0.0) == pytest.approx([639.5 * metres_per_px, 479.5 * metres_per_px])


def test_axes_of_picture_and_pool_agree() -> None:
    view = RefractiveCamera(CAMERA)
    middle = view.pool_to_pixel(np.array([0.0, 0.0, 0.3]))
    assert view.pool_to_pixel(np.array([0.1, 0.0, 0.3]))[0] > middle[0] + 20
    assert view.pool_to_pixel(np.array([0.0, 0.1, 0.3]))[1] > middle[1] + 20


def test_points_above_the_water_are_not_refracted() -> None:
    dry = RefractiveCamera(CAMERA.model_copy(update={"water_index": 1.0}))
    wet = RefractiveCamera(CAMERA)
    above, below = np.array([1.0, 0.5, -0.05]), np.array([1.0, 0.5, 0.05])
    assert wet.pool_to_pixel(above) == pytest.approx(dry.pool_to_pixel(above), abs=1e-9)
    assert np.linalg.norm(wet.pool_to_pixel(below) - dry.pool_to_pixel(below)) > 0.5


def test_depth_moves_a_robot_by_a_quarter_of_its_error() -> None:
    """The figure that the design rests on: 2.5 mm per cm of depth, 1 m off the camera's foot."""
    view = RefractiveCamera(CAMERA)
    pixel = view.pool_to_pixel(np.array([1.0, 0.0, 0.15]))
    shift_m = view.pixel_to_pool(pixel, 0.16) - view.pixel_to_pool(pixel, 0.15)
    assert shift_m[0] == pytest.approx(0.0025, rel=0.1)


@CAMERAS
@given(x=st.floats(-1.2, 1.2), y=st.floats(-0.9, 0.9), depth_m=st.floats(-0.2, 0.9))
def test_tangent_is_the_derivative(camera: Camera, x: float, y: float, depth_m: float) -> None:
    view = RefractiveCamera(camera)
    tangent = view.linearize([np.array([x, y])], [depth_m])[0]
    assert tangent.pixel == pytest.approx(view.pool_to_pixel(np.array([x, y, depth_m])))
    step = np.array([0.004, -0.003])
    assert tangent.nearby_px(np.array([x, y]) + step) == pytest.approx(
        view.pool_to_pixel(np.array([x + step[0], y + step[1], depth_m])), abs=0.01
    )
    h = 1e-4
    for column, (du, dv, dz) in enumerate(((h, 0, 0), (0, h, 0), (0, 0, h if depth_m > 0 else -h))):
        moved = view.pixel_to_pool(tangent.pixel + np.array([du, dv]), depth_m + dz) - np.array([x, y])
        assert tangent.jacobian[:, column] == pytest.approx(moved / (du + dv + dz), abs=2e-5)


def test_points_behind_the_lens_have_no_pixel() -> None:
    """They would have mirrored ones, some of them in the picture. The simulator's camera, written without ours, agrees."""
    points = np.random.default_rng(1).uniform([-6.0, -4.0, -2.5], [6.0, 4.0, 1.2], (3000, 3))
    pixels, expected = RefractiveCamera(ASLANT).pool_to_pixel(points), project(ASLANT, points)
    behind = np.isnan(expected[:, 0])
    assert 500 < behind.sum() < 2500 and (np.isnan(pixels).any(axis=1) == behind).all()
    assert pixels[~behind] == pytest.approx(expected[~behind], rel=1e-6, abs=1e-6)
    level = ASLANT.model_copy(update={"rotation_rad": (0.0, 0.0, 0.0)})
    for place in (level.position_m, np.add(level.position_m, [1.0, 0.0, 0.0])):  # in the lens, and beside it
        assert np.isnan(RefractiveCamera(level).pool_to_pixel(np.array(place))).all()


def test_no_points_is_no_trouble() -> None:
    assert RefractiveCamera(CAMERA).linearize([], []) == []


@pytest.mark.parametrize("distortion", ["[-0.5, 0.0, 0.0, 0.0, 0.0]", "[-0.576, -0.695, 0.0, 0.0, 0.743]"])
def test_an_experiment_whose_lens_cannot_be_undone_is_refused(distortion: str) -> None:
    """r (1 - 0.5 r^2) turns back at r = 0.82, which this wide picture reaches: pixels beyond have no place in the pool. With
    k3 it turns back twice, and all is well again at the edge."""
    settings = ["camera.focal_px=[598.0, 598.0]", f"camera.distortion={distortion}"]
    with pytest.raises(ConfigError, match=r"pool: camera\.distortion = .* cannot be undone in all of the picture"):
        with_camera(load_experiment("pool", settings), "")
    with_camera(load_experiment("pool"), "")  # as it is shipped

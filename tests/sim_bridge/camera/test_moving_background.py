"""The picture from a camera that moves: against projected points, and against the other way of drawing a background."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from shoal.config.experiment import Experiment, load_experiment
from shoal.config.perception import Camera
from shoal.config.simulation import CameraMotion
from shoal.frames import Array, body_to_pool
from sim_bridge.camera.moving_background import CameraSway
from sim_bridge.camera.optics import project
from sim_bridge.camera.rays import CameraRays
from sim_bridge.camera.renderer import Renderer

pytestmark = pytest.mark.long

STILL = tuple(f"sim.picture.{key}=0" for key in ("noise", "ripples_m", "caustics", "glare"))
CLEAN = (*STILL, "sim.picture.shadows=false")
AWAY, REST = np.tile([50.0, 0.0, 0.3, 0.0], (2, 1)), np.zeros((2, 4))
HARDLY = ("sim.camera_motion.sway_m=1e-9", "sim.camera_motion.tilt_rad=0")


def _colour(raw: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(raw, cv2.COLOR_BayerRGGB2BGR), dtype=np.uint8)


def _camera(renderer: Renderer, time_s: float) -> Camera:
    return renderer.backdrop.at(time_s)[0].view.camera


def _corners_px(experiment: Experiment, camera: Camera) -> dict[int, Array]:
    corners = {}
    for landmark in experiment.landmarks:
        half = landmark.side_m / 2.0
        body = half * np.array([[1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]])
        flat = np.array(landmark.position_m[:2]) + body_to_pool(body, landmark.yaw_rad)
        corners[landmark.id] = project(camera, np.column_stack([flat, np.full(4, landmark.position_m[2])]))
    return corners


@pytest.fixture(scope="module")
def clean() -> tuple[Experiment, Renderer]:
    turned = [f"landmarks.{i}.yaw_rad={0.7 * i}" for i in range(8)]
    raised = ["landmarks.0.position_m=[-1.2, -0.8, -0.05]", "landmarks.4.position_m=[1.3, 0.9, 0.4]"]
    experiment = load_experiment("drone", [*CLEAN, *turned, *raised])
    return experiment, Renderer(experiment, 1)


@pytest.mark.parametrize("time_s", [0.0, 3.1, 7.7])
def test_landmarks_are_drawn_where_they_are_seen(clean: tuple[Experiment, Renderer], time_s: float) -> None:
    """In air, in the water and on the floor, turned any way. OpenCV pulls corners inwards, so centres are compared closely."""
    experiment, renderer = clean
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    settings.cornerRefinementWinSize = 3
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), settings)
    corners, ids, _ = detector.detectMarkers(_colour(renderer.render(AWAY, REST, time_s, 0)))
    expected = _corners_px(experiment, _camera(renderer, time_s))
    assert ids is not None and set(ids.ravel().tolist()) == set(expected)
    for i, quad in zip(map(int, ids.ravel()), corners, strict=True):
        off = np.asarray(quad, dtype=np.float64).reshape(4, 2) - expected[i]
        assert np.linalg.norm(off.mean(axis=0)) < 0.15
        assert np.linalg.norm(off, axis=1).max() < 0.7


@pytest.mark.parametrize("time_s", [0.0, 3.1, 7.7])
def test_the_floor_lies_where_it_is_seen(clean: tuple[Experiment, Renderer], time_s: float) -> None:
    """The red mark on the floor, through tilted lens and water."""
    picture = _colour(clean[1].render(AWAY, REST, time_s, 0)).astype(float)
    red = np.clip(picture[..., 2] - picture[..., 0] + 60.0, 0.0, None)
    turn = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    rim = project(_camera(clean[1], time_s), np.column_stack([0.09 * np.cos(turn), 0.09 * np.sin(turn), np.ones(60)]))
    x, y = rim.mean(axis=0)
    left, top = round(x) - 40, round(y) - 40
    spot = red[top : top + 81, left : left + 81]
    rows, columns = np.mgrid[top : top + 81, left : left + 81]
    assert np.sum(columns * spot) / np.sum(spot) == pytest.approx(x, abs=0.3)
    assert np.sum(rows * spot) / np.sum(spot) == pytest.approx(y, abs=0.3)


def test_hardly_moving_it_draws_what_a_still_camera_sees() -> None:
    """Two ways to the same picture: cached phases in the picture's frame, and a plan traced anew. Ripples, caustics, glare."""
    settings = ("sim.picture.noise=0", "camera.position_m=[0, 0, -3.4]")  # walls and deck in the picture
    still = Renderer(load_experiment("pool", settings), 1).render(AWAY, REST, 0.35, 0)
    hover = Renderer(load_experiment("pool", [*settings, *HARDLY]), 1).render(AWAY, REST, 0.35, 0)
    a, b = (cv2.GaussianBlur(_colour(raw), (0, 0), 2.0).astype(float) for raw in (still, hover))
    off = np.abs(a - b).max(axis=2)
    assert np.median(off) < 4.0 and np.mean(off > 20.0) < 0.03  # the deck has grain of its own, the waterline is soft
    floor = np.s_[200:760, 250:1030]
    assert np.corrcoef(a[floor].ravel(), b[floor].ravel())[0, 1] > 0.98


def test_swings_are_smooth_bounded_and_repeatable() -> None:
    camera, motion = load_experiment("drone").camera, CameraMotion(sway_m=0.25, tilt_rad=0.05, period_s=9.0)
    times = np.arange(0.0, 120.0, 0.05)
    first, again, other = (
        [CameraSway(camera, motion, np.random.default_rng(seed)).at(float(t)) for t in times] for seed in (1, 1, 2)
    )
    assert first == again and first != other
    places = np.array([c.position_m for c in first]) - camera.position_m
    turns = np.array([c.rotation_rad for c in first])
    assert 0.15 < np.abs(places).max() <= 0.25 and 0.03 < np.abs(turns).max() <= 0.05 + 1e-6
    assert np.abs(np.diff(places, axis=0)).max() < 0.05 * 0.4 and np.abs(np.diff(turns, axis=0)).max() < 0.05 * 0.08


@pytest.mark.parametrize("motion", ["sway_m=0.2, tilt_rad=0.0", "sway_m=0.0, tilt_rad=0.05"])
def test_the_floor_moves_in_the_picture_of_a_camera_that_only_sways_or_only_tilts(motion: str) -> None:
    settings = (
        "sim.picture.noise=0",
        "sim.picture.ripples_m=0",
        "sim.picture.caustics=0",
        f"sim.camera_motion={{{motion}, period_s=4.0}}",
    )
    renderer = Renderer(load_experiment("drone", settings), 1)
    early, late = (_colour(renderer.render(AWAY, REST, time_s, 0)).astype(float) for time_s in (1.0, 2.5))
    assert np.abs(early - late).mean() > 2.0


@pytest.mark.parametrize("step_px, most_px", [(8.0, 0.002), (9.7, 0.006)], ids=["blocks", "between and around them"])
def test_lines_of_sight_of_a_moved_camera(step_px: float, most_px: float) -> None:
    """In a tilted pose, to the floor and back by projection; between blocks interpolated, and beyond the outermost straight
    on."""
    camera = load_experiment("drone").camera
    tilted = camera.model_copy(update={"rotation_rad": (0.06, -0.05, 0.4), "position_m": (0.3, -0.2, -3.0)})
    lines = CameraRays(camera).moved(tilted).blocks
    blocks = np.arange(3.5, 960.0, 8.0), np.arange(3.5, 1280.0, 8.0)
    start_px = 3.5 if step_px == 8.0 else 0.0
    wanted = np.stack(
        np.meshgrid(np.arange(start_px, 960.0, step_px), np.arange(start_px, 1280.0, step_px), indexing="ij"), -1
    )
    ends = [lines.surface_x + lines.water_x, lines.surface_y + lines.water_y]
    x, y = (RegularGridInterpolator(blocks, plane, bounds_error=False, fill_value=None)(wanted) for plane in ends)
    pixels = project(tilted, np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)]))[:, ::-1].reshape(wanted.shape)
    assert np.abs(pixels - wanted).max() < most_px


def test_a_picture_of_odd_size_is_the_even_one_less_its_edge() -> None:
    small = (*STILL, "sim.picture.vignetting=0", "camera.focal_px=[250.0, 250.0]", "camera.centre_px=[160.0, 120.0]")
    odd, even = (
        Renderer(load_experiment("drone", [*small, f"camera.size_px={size}"]), 1).render(AWAY, REST, 1.7, 0)
        for size in ("[321, 241]", "[322, 242]")
    )
    assert odd.shape == (241, 321)
    np.testing.assert_array_equal(odd, even[:241, :321])

"""Markers: place and heading in the pool frame, the pixel convention, and readings that must be refused."""

import cv2
import numpy as np
import pytest

from localizer.camera_model import RefractiveCamera
from localizer.detection.fiducials import MarkerReader, find_markers, marker_detector, marker_poses
from localizer.detection.image_regions import ImageRegion, cut, whole
from shoal.config.experiment import load_experiment
from shoal.frames import wrap
from tests.localizer.scene import Pixels, Scene, bayer

EXPERIMENT = load_experiment("pool")
VIEW = RefractiveCamera(EXPERIMENT.camera)
PLATE_M = 0.15
SIDE_M = EXPERIMENT.vehicle.marker.side_m
LEVEL = np.zeros((1, 2))  # roll and pitch


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(EXPERIMENT)


def _reader() -> MarkerReader:
    return MarkerReader(SIDE_M, {1: 0, 2: 1})


def _region(frame: Pixels, x_m: float, y_m: float) -> ImageRegion:
    region = cut(frame, VIEW.pool_to_pixel(np.array([x_m, y_m, PLATE_M])), 80.0)
    assert region is not None
    return region


@pytest.mark.long
def test_place_and_heading_all_over_the_pool(scene: Scene) -> None:
    """Every heading, also across the wrap; near the edges lens and water turn its picture by up to 1.5 deg."""
    random = np.random.default_rng(5)
    errors = []
    for yaw in np.linspace(-np.pi, np.pi, 24):
        x, y = random.uniform([-1.4, -1.0], [1.4, 1.0])
        frame = scene.frame({1: np.array([x, y, 0.3, yaw])})
        pose = _reader().read(VIEW, [_region(frame, x, y)], np.array([PLATE_M, PLATE_M]), np.zeros((2, 2)))[0][0].pose
        errors.append([pose[0] - x, pose[1] - y, wrap(float(pose[2] - yaw))])
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert rms[:2] == pytest.approx(0.0, abs=4e-4)
    assert rms[2] < np.deg2rad(0.35)
    assert np.abs(np.mean(errors, axis=0))[:2].max() < 2e-4, "half a pixel would be 1.5 mm"


@pytest.mark.parametrize(("left", "top"), [(20, 30), (21, 30), (20, 31), (33, 37)])
def test_corners_count_from_the_first_pixels_centre(left: int, top: int) -> None:
    """An upright marker drawn in whole pixels: its black square spans left - 0.5 to left + 35.5 whatever the Bayer phase."""
    grey = np.full((100, 110), 230, np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    grey[top : top + 36, left : left + 36] = cv2.aruco.generateImageMarker(dictionary, 7, 36)
    blurred = cv2.GaussianBlur(np.repeat(grey[:, :, None], 3, axis=2), (3, 3), 0)
    markers = find_markers(marker_detector(), ImageRegion(bayer(np.asarray(blurred, np.uint8)), 200, 100))
    assert [marker.id for marker in markers] == [7]
    upper_left, lower_right = np.array([left, top]) - 0.5, np.array([left, top]) + 35.5
    corners = markers[0].corners_px - np.array([200.0, 100.0])
    assert corners[0] == pytest.approx(upper_left, abs=0.35)  # blur rounds all four corners inwards alike
    assert corners[2] == pytest.approx(lower_right, abs=0.35)
    assert corners.mean(axis=0) == pytest.approx((upper_left + lower_right) / 2, abs=0.06)


def test_whole_picture_and_region_agree(scene: Scene) -> None:
    frame = scene.frame({1: np.array([0.6, -0.3, 0.3, 1.0]), 2: np.array([-0.7, 0.5, 0.3, -2.0])})
    plates = np.array([PLATE_M, PLATE_M])
    everywhere = _reader().read(VIEW, [whole(frame)], plates, np.zeros((2, 2)))
    regions = [_region(frame, 0.6, -0.3), _region(frame, -0.7, 0.5)]
    near = _reader().read(VIEW, regions, plates, np.zeros((2, 2)))
    assert sorted(everywhere) == sorted(near) == [0, 1]
    for robot in (0, 1):
        assert everywhere[robot][0].pose == pytest.approx(near[robot][0].pose, abs=5e-4)


def test_strangers_and_wrong_sizes_are_refused(scene: Scene) -> None:
    frame = scene.frame({1: np.array([0.2, 0.1, 0.3, 0.5])})
    region = _region(frame, 0.2, 0.1)
    stranger = MarkerReader(SIDE_M, {9: 0})
    assert stranger.read(VIEW, [region], np.array([PLATE_M]), LEVEL) == {}
    too_deep = PLATE_M + 1.0  # there the same picture would be a marker a quarter larger
    assert _reader().read(VIEW, [region], np.array([too_deep, too_deep]), np.zeros((2, 2))) == {}
    assert 0 in _reader().read(VIEW, [region], np.array([PLATE_M + 0.1, PLATE_M]), np.zeros((2, 2)))


def test_a_hidden_marker_is_not_imagined(scene: Scene) -> None:
    frame = scene.frame({1: np.array([0.2, 0.1, 0.3, 0.5])}, hidden=frozenset({1}))
    assert _reader().read(VIEW, [whole(frame)], np.array([PLATE_M, PLATE_M]), np.zeros((2, 2))) == {}


def test_misfit_tells_a_square_from_a_squashed_one(scene: Scene) -> None:
    frame = scene.frame({1: np.array([0.2, 0.1, 0.3, 0.5])})
    image = find_markers(marker_detector(), _region(frame, 0.2, 0.1))[0]
    (good,) = marker_poses([image], VIEW, np.array([PLATE_M]), LEVEL, SIDE_M)
    squashed = image.corners_px.copy()
    squashed[:2] += 0.25 * (squashed[2:][::-1] - squashed[:2])
    (bad,) = marker_poses([type(image)(image.id, squashed)], VIEW, np.array([PLATE_M]), LEVEL, SIDE_M)
    assert good.misfit < 0.03 < 0.1 < bad.misfit

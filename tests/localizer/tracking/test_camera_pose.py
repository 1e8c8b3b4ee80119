"""A camera that moves: its pose from landmarks, against the simulator's own optics and rendered frames of the drone scene."""

from collections.abc import Callable, Iterator
from functools import cache

import cv2
import numpy as np
import pytest

from localizer.tracking.camera_pose import STALE_AFTER_S, CameraPoseTracker, fit_camera_pose
from localizer.tracking.fleet_localizer import FleetLocalizer, LocalizationResult
from shoal.config.experiment import load_experiment
from shoal.config.perception import Camera
from shoal.errors import ConfigError
from shoal.frames import Array, wrap
from shoal.messages.messages import Track
from sim_bridge.camera.optics import project
from sim_bridge.camera.renderer import Renderer
from tests.localizer.scene import Pixels

pytestmark = pytest.mark.long

DRONE = load_experiment("drone", ["localizer.tilt_sigma_rad=0", "localizer.tilt_rad_per_n=0"])  # robots are drawn level
PERIOD_S = 0.1  # half the camera's rate: the pose changes by twice as much between pictures
SEED = 3


@cache
def _renderer() -> Renderer:
    return Renderer(DRONE, SEED)


def _eta(t_s: float) -> Array:
    angle = 0.3 * t_s
    swing = 0.5 * np.array([np.cos(angle), np.sin(angle)])
    depth = 0.3 + 0.03 * np.sin(0.5 * t_s + np.array([0.0, 1.0]))
    yaw = angle + np.array([1.5, -2.0]) + 0.4 * np.sin(0.7 * t_s)
    return np.column_stack([np.array([[0.4, 0.1], [-0.4, -0.1]]) + swing, depth, yaw])


def _frame(k: int) -> Pixels:
    return _renderer().render(_eta(k * PERIOD_S), np.zeros((2, 4)), k * PERIOD_S, k)


def _true_camera(k: int) -> Camera:
    return _renderer().backdrop.at(k * PERIOD_S)[0].view.camera


def _run(
    locator: FleetLocalizer, frames: range, spoil: Callable[[int, Pixels], None] = lambda k, frame: None
) -> Iterator[tuple[Array, LocalizationResult]]:
    for k in frames:
        frame, eta = _frame(k), _eta(k * PERIOD_S)
        spoil(k, frame)
        yield eta, locator.step(frame, round(k * PERIOD_S * 1e9), {1: float(eta[0, 2]), 2: float(eta[1, 2])})


def _errors(run: list[tuple[Array, LocalizationResult]]) -> Array:
    """x, y, yaw: (frames, robots, 3)."""
    rows = [[(p.x_m, p.y_m, p.yaw_rad) - e[[0, 1, 3]] for (_, p), e in zip(x.poses, eta, strict=True)] for eta, x in run]
    errors = np.array(rows)
    errors[..., 2] = np.vectorize(wrap)(errors[..., 2])
    return errors


def _hide(keep: int) -> Callable[[int, Pixels], None]:
    """Paints over all landmarks but `keep` where they truly are."""

    def spoil(k: int, frame: Pixels) -> None:
        for landmark in DRONE.landmarks[keep:]:
            x, y, z = landmark.position_m
            place = project(_true_camera(k), np.array([[x, y, z]]))[0]
            if np.all(np.isfinite(place)):
                cv2.circle(frame, (round(place[0]), round(place[1])), 40, (120,), -1)

    return spoil


def test_robots_are_found_from_a_swaying_camera() -> None:
    _, *run = _run(FleetLocalizer(DRONE), range(200))
    errors = _errors(run)
    rms = np.sqrt(np.mean(errors**2, axis=(0, 1)))
    assert np.hypot(*rms[:2]) < 2.5e-3 and rms[2] < np.deg2rad(0.5), "the limit to keep is 10 mm"
    assert all(pose.track is Track.MARKER for _, located in run for _, pose in located.poses)
    assert all(located.status.message == "" for _, located in run)
    covariances = np.array([[pose.covariance for _, pose in located.poses] for _, located in run])
    squared = np.sum(errors * np.linalg.solve(covariances, errors[..., None])[..., 0], axis=-1)
    assert 1.0 < np.mean(squared) < 4.7
    still = FleetLocalizer(DRONE.model_copy(update={"landmarks": ()}))
    blind = _errors([step for step in _run(still, range(20)) if len(step[1].poses) == 2])
    assert np.abs(blind[..., :2]).max() > 0.05, "with the camera taken to be still the poses would be worthless"


def test_the_camera_itself_is_found() -> None:
    eye = CameraPoseTracker(DRONE.camera, DRONE.landmarks)
    for k in range(15):
        eye.advance(PERIOD_S)
        eye.update(_frame(k))
        truth, camera = _true_camera(k), eye.pose.camera
        assert eye.fresh and eye.trouble == ""
        assert np.linalg.norm(np.subtract(truth.position_m, camera.position_m)) < 0.02
        corners = np.array([[x, y, 0.15] for x in (-1.0, 1.0) for y in (-0.7, 0.7)])
        assert np.linalg.norm(project(truth, corners) - project(camera, corners), axis=1).max() < 1.0


@pytest.mark.parametrize("seed", range(5))
def test_fit_is_exact_for_landmarks_in_air_and_under_water(seed: int) -> None:
    """Corners on the rim, above it and on the floor, as the simulator's optics projects them; the guess is 0.3 m off."""
    random = np.random.default_rng(seed)
    turn, place = random.normal(0.0, 0.05, 3), np.array([0.0, 0.0, -3.2]) + random.normal(0.0, 0.15, 3)
    truth = DRONE.camera.model_copy(update={"rotation_rad": tuple(turn), "position_m": tuple(place)})
    centres = np.array([[-1.4, -1.0, 0.0], [1.4, -1.0, -0.1], [1.3, 1.0, 1.0], [-1.3, 0.9, 1.0], [0.1, 1.0, 0.4]])
    square = 0.1 * np.array([[1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0]])
    places = centres[:, None] + square
    pixels = project(truth, places.reshape(-1, 3)).reshape(-1, 4, 2)
    fitted, residuals = fit_camera_pose(DRONE.camera, places, pixels)
    assert fitted.camera.position_m == pytest.approx(truth.position_m, abs=2e-5)
    assert fitted.camera.rotation_rad == pytest.approx(truth.rotation_rad, abs=1e-5)
    assert np.abs(residuals).max() < 0.05
    assert np.all(np.linalg.eigvalsh(fitted.covariance) > 0)


def test_a_landmark_that_was_kicked_does_not_count() -> None:
    """The experiment believes one 10 cm away from where it lies. Eight outvote it; among four nobody knows which one is wrong,
    and there is no pose."""
    x, y, z = DRONE.landmarks[2].position_m
    kicked = (
        *DRONE.landmarks[:2],
        DRONE.landmarks[2].model_copy(update={"position_m": (x + 0.1, y, z)}),
        *DRONE.landmarks[3:],
    )
    eye = CameraPoseTracker(DRONE.camera, kicked)
    eye.update(_frame(0))
    assert eye.fresh and eye.trouble == ""
    assert np.linalg.norm(np.subtract(_true_camera(0).position_m, eye.pose.camera.position_m)) < 0.02
    few = CameraPoseTracker(DRONE.camera, kicked[:4])
    few.update(_frame(0))
    assert not few.fresh and not few.usable
    assert "of 4 landmarks" in few.trouble


def test_without_four_landmarks_poses_grow_stale_and_come_back() -> None:
    locator = FleetLocalizer(DRONE)
    before = list(_run(locator, range(8)))
    hidden = list(_run(locator, range(8, 24), _hide(keep=3)))
    after = list(_run(locator, range(24, 34)))
    verified_now, less_sure = (np.trace(step[1].poses[0][1].covariance[:2, :2]) for step in (before[-1], hidden[0]))
    assert less_sure > 4.0 * verified_now
    for k, (eta, located) in enumerate(hidden, start=1):
        assert "camera's pose unknown" in located.status.message and "3 of 4 landmarks" in located.status.message
        for i, (_, pose) in enumerate(located.poses):
            assert (pose.track is Track.MARKER) == (k * PERIOD_S < STALE_AFTER_S - 1e-9)
            away = np.array([pose.x_m, pose.y_m]) - eta[i, :2]
            assert pose.track is Track.LOST or away @ np.linalg.solve(pose.covariance[:2, :2], away) < 16.0
    assert all(pose.track is Track.LOST for _, pose in hidden[-1][1].poses)
    assert all(pose.track is Track.MARKER for _, located in after[-4:] for _, pose in located.poses)
    assert np.abs(_errors(after[-4:])[..., :2]).max() < 0.01


def test_no_pose_before_the_camera_was_found() -> None:
    locator = FleetLocalizer(DRONE)
    for _, located in _run(locator, range(3), _hide(keep=2)):
        assert located.poses == () and "2 of 4 landmarks" in located.status.message


def test_same_frames_same_bits() -> None:
    def run() -> list[bytes]:
        steps = _run(FleetLocalizer(DRONE), range(6))
        return [np.array([p.x_m, p.yaw_rad, *p.covariance.ravel()]).tobytes() for _, x in steps for _, p in x.poses]

    assert run() == run()


@pytest.mark.parametrize(
    "setting,says",
    [
        ("landmarks.0.id=2", "landmarks: id 2 is the marker of robot 2 (free: 0, 3,"),
        ("landmarks.0.id=41", "landmarks: id 41 is used twice"),
        ("landmarks.0.position_m=[0, 0, 1.2]", "landmarks: id 40 at z = 1.2 lies below the floor"),
        ("landmarks.0.id=50", "less than or equal to 49"),
    ],
)
def test_landmarks_that_cannot_be_told_apart_are_refused(setting: str, says: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_experiment("drone", [setting])
    assert says in str(caught.value)


def test_too_few_landmarks_are_refused() -> None:
    marks = [f"{{id={30 + i}, position_m=[{i}, 0, 0]}}" for i in range(3)]
    with pytest.raises(ConfigError, match=r"landmarks: 3 cannot place a camera \(allowed: none, or 4 and more\)"):
        load_experiment("pool", [f"landmarks=[{', '.join(marks)}]"])

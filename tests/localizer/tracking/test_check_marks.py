"""Check marks of a fixed camera, in pictures of the simulator's renderer, which knows nothing of the localizer's optics.

The renderer's camera is moved, or its water sunk, while the localizer keeps the experiment's. Seeds are in the scene.
"""

from functools import cache

import numpy as np
import pytest

from localizer.detection.image_regions import Pixels
from localizer.tracking.camera_pose import corners_of
from localizer.tracking.check_marks import READINGS, CheckedCameraPose
from localizer.tracking.fleet_localizer import FleetLocalizer, LocalizationResult
from shoal.config.experiment import Experiment, load_experiment
from shoal.config.perception import Landmark
from shoal.errors import ConfigError
from shoal.frames import Array
from sim_bridge.camera.renderer import Renderer

pytestmark = pytest.mark.long

MARKS = tuple(
    Landmark(id=40 + k, position_m=place, yaw_rad=0.3 * k)
    for k, place in enumerate([(-1.3, -0.9, 1.0), (1.3, -0.9, 0.0), (1.3, 0.9, 1.0), (-1.3, 0.9, 0.0), (0.0, 1.0, 1.0)])
)
FRAMES = 25  # at 20 Hz: five marks in turns have their five readings
SETTINGS = ["localizer.tilt_sigma_rad=0", "localizer.tilt_rad_per_n=0", "localizer.surface_slope_rad=0"]
ETA = np.array([[0.5, 0.1, 0.3, 1.0], [-0.5, -0.1, 0.3, -1.0]])


def pool(marks: tuple[Landmark, ...] = MARKS) -> Experiment:
    return load_experiment("pool", SETTINGS).model_copy(update={"check_marks": marks})


def moved_camera(experiment: Experiment, by_m: tuple[float, float, float], turn_rad: float = 0.0) -> Experiment:
    """The experiment with its camera elsewhere."""
    camera = experiment.camera
    place = tuple(np.add(camera.position_m, by_m).tolist())
    rotation = tuple(np.add(camera.rotation_rad, (turn_rad, 0.0, 0.0)).tolist())
    return experiment.model_copy(update={"camera": camera.model_copy(update={"position_m": place, "rotation_rad": rotation})})


def sunken_water(experiment: Experiment, drop_m: float) -> Experiment:
    """The experiment with its water lower: seen from the surface, marks, camera and floor are higher."""
    marks = tuple(
        mark.model_copy(update={"position_m": (*mark.position_m[:2], mark.position_m[2] - drop_m)})
        for mark in experiment.check_marks
    )
    return moved_camera(experiment.model_copy(update={"check_marks": marks}), (0.0, 0.0, -drop_m))


def seen(true: Experiment, believed: Experiment, frames: int = FRAMES) -> LocalizationResult:
    """The localizer's last word on pictures of the true world."""
    renderer, localizer = Renderer(true, true.seed), FleetLocalizer(believed)
    depths = {1: 0.3, 2: 0.3}
    for k in range(frames):
        picture = renderer.render(ETA, np.zeros((2, 4)), 0.05 * k, k)
        result = localizer.step(picture, round(0.05e9 * k), depths)
    return result


def errors_m(result: LocalizationResult) -> Array:
    """x and y of the robots' errors, (2, 2)."""
    return np.asarray(np.array([(pose.x_m, pose.y_m) for _, pose in result.poses]) - ETA[:, :2])


def test_a_camera_at_its_place_has_no_trouble_and_adds_nothing_to_covariances() -> None:
    result = seen(pool(), pool())
    plain = seen(pool(), pool(()))
    assert result.status.message == ""
    assert np.array_equal([pose.covariance for _, pose in result.poses], [pose.covariance for _, pose in plain.poses])


@pytest.mark.parametrize(("by_m", "turn_rad"), [((0.02, 0.0, 0.0), 0.0), ((0.0, 0.0, 0.0), 0.01), ((0.03, -0.02, 0.0), 0.005)])
def test_a_bumped_camera_is_noticed_within_a_second_and_poses_claim_their_error(
    by_m: tuple[float, float, float], turn_rad: float
) -> None:
    believed = pool()
    result = seen(moved_camera(believed, by_m, turn_rad), believed)
    assert result.status.moved and "the camera was moved: check marks are" in result.status.message
    sigmas_m = np.array([np.sqrt(np.diag(np.reshape(pose.covariance, (3, 3))))[:2] for _, pose in result.poses])
    assert np.all(np.linalg.norm(errors_m(result), axis=1) < 2.0 * np.linalg.norm(sigmas_m, axis=1))


@pytest.mark.parametrize("drop_m", [0.02, 0.05, -0.03])
def test_sunken_water_is_told_from_a_bump_and_measured(drop_m: float) -> None:
    believed = pool()
    status = seen(sunken_water(believed, drop_m), believed).status
    message = status.message
    assert not status.moved
    found_mm = float(message.partition("the water stands ")[2].partition(" mm")[0])
    assert ("lower" in message) == (drop_m > 0.0)
    assert found_mm == pytest.approx(abs(drop_m) * 1e3, abs=4.0)


def test_a_small_knock_enters_the_covariances_within_three_pictures() -> None:
    """3 mm and 0.3 deg move the picture by some 6 px: too little to blame the camera at once, and 10 to 20 mm of the poses."""
    still = pool()
    knocked = moved_camera(still, (0.003, 0.0, 0.0), np.radians(0.3))
    before, after, localizer = Renderer(still, 1), Renderer(knocked, 1), FleetLocalizer(still)
    for k in range(40):
        picture = (after if k >= 30 else before).render(ETA, np.zeros((2, 4)), 0.05 * k, k)
        result = localizer.step(picture, round(0.05e9 * k), {1: 0.3, 2: 0.3})
        errors = errors_m(result) if len(result.poses) == 2 else np.zeros((2, 2))
        sigmas = np.array([np.sqrt(pose.covariance[0, 0] + pose.covariance[1, 1]) for _, pose in result.poses])
        if k >= 30:
            assert np.linalg.norm(errors, axis=1).max() > 0.008
        if k >= 32:
            assert np.all(np.linalg.norm(errors, axis=1) < 3.0 * sigmas), k
        elif 5 < k < 30:
            assert sigmas.max() < 0.004


def test_a_missed_reading_makes_no_moved_mark_of_a_knock() -> None:
    """Four readings of one mark, two before and two after: their median is no place at all."""
    camera = CheckedCameraPose(pool().camera, MARKS)
    expected = camera.view.pool_to_pixel(np.array([corners_of(mark) for mark in MARKS]))
    # private: what pictures would show is put in directly
    for k, readings in enumerate(camera._readings):
        at = expected[k]
        readings.extend([at, at, None, at + 4.0, at + 4.0] if k == 3 else [at, at, at + 4.0, at + 4.0, at + 4.0])
    camera._frames = len(MARKS) - 1  # private: the end of a round
    camera.update(np.zeros(pool().camera.size_px[::-1], np.uint8))
    assert "was moved" in camera.trouble and "check mark 43 is" not in camera.trouble


def test_one_mark_that_was_moved_is_named_and_changes_no_covariance() -> None:
    believed = pool()
    x, y, z = MARKS[2].position_m
    carried = MARKS[2].model_copy(update={"position_m": (x - 0.03, y, z)})
    result = seen(pool((*MARKS[:2], carried, *MARKS[3:])), believed)
    assert "check mark 42 is" in result.status.message
    assert "it was moved" in result.status.message and not result.status.moved
    plain = seen(pool(), pool(()))
    assert np.allclose([p.covariance for _, p in result.poses], [p.covariance for _, p in plain.poses], rtol=0.2)


def test_a_hard_knock_that_takes_all_marks_out_of_their_places_is_noticed() -> None:
    believed = pool()
    result = seen(moved_camera(believed, (0.25, 0.0, 0.0)), believed, 60)
    assert "check marks are" in result.status.message


def test_a_knock_is_noticed_in_the_next_pictures_and_its_end_as_soon_as_most_readings_are_later() -> None:
    """35 px: three of five marks in turns are read in three pictures; the median of five readings is right again after three
    rounds."""
    believed, moved = pool(), []
    knocked = moved_camera(believed, (0.1, 0.0, 0.0))
    renderers, localizer = [Renderer(true, true.seed) for true in (believed, knocked)], FleetLocalizer(believed)
    for k in range(60):
        picture = renderers[7 <= k < 27].render(ETA, np.zeros((2, 4)), 0.05 * k, k)
        moved.append(localizer.step(picture, round(0.05e9 * k), {1: 0.3, 2: 0.3}).status.moved)
    frames_moved = [k for k, is_moved in enumerate(moved) if is_moved]
    assert frames_moved[0] == 9 and frames_moved == list(range(9, frames_moved[-1] + 1)) and 27 < frames_moved[-1] < 27 + 4 * 5


@pytest.mark.parametrize(("visible", "pictures"), [((), 1), ((2,), 3), ((1, 4), 3)])
def test_a_bumped_camera_is_not_cleared_by_marks_that_are_covered(visible: tuple[int, ...], pictures: int) -> None:
    """All but the `visible` are covered after so many pictures of each mark. Then the camera is put back, and at last all of
    them are seen again."""
    believed, few = pool(), tuple(MARKS[k] for k in visible)
    at_place, bumped, covered = picture(MARKS, 0.0), picture(MARKS, 0.1), picture(few, 0.0)
    pose = CheckedCameraPose(believed.camera, MARKS)
    watch(pose, at_place, READINGS)
    assert not pose.moved and pose.marks_seen
    watch(pose, bumped, pictures)
    assert pose.moved and pose.marks_seen
    wide = shift_variance_m2(pose)
    for hidden in (picture(few, 0.1), covered):
        for _ in range(READINGS + 1):
            watch(pose, hidden, 1)
            assert pose.moved and "the camera was moved" in pose.trouble
            assert shift_variance_m2(pose) >= wide
    assert not pose.marks_seen and "check mark 40 is not seen" in pose.trouble
    watch(pose, at_place, READINGS)
    assert not pose.moved and pose.marks_seen
    assert shift_variance_m2(pose) == 0.0 and pose.trouble == ""


def test_two_marks_of_five_can_tell_a_bump() -> None:
    believed, few = pool(), MARKS[:2]
    pose = CheckedCameraPose(believed.camera, MARKS)
    watch(pose, picture(few, 0.1), READINGS)
    assert pose.moved and shift_variance_m2(pose) > 0.0 and not pose.marks_seen


@cache
def picture(marks: tuple[Landmark, ...], aside_m: float) -> Pixels:
    """Picture of a pool with these marks from a camera that is so far from its place."""
    true = moved_camera(pool(marks), (aside_m, 0.0, 0.0))
    return np.asarray(Renderer(true, true.seed).render(ETA, np.zeros((2, 4)), 0.0, 0))


def watch(pose: CheckedCameraPose, picture: Pixels, rounds: int) -> None:
    for _ in range(rounds * len(MARKS)):
        pose.update(picture)


def shift_variance_m2(pose: CheckedCameraPose) -> float:
    return float(np.trace(pose.uncertainty(pose.view.linearize([ETA[0, :2]], [0.3]), [0.3])[0][:2, :2]))


@pytest.mark.parametrize(("aside_m", "turn_rad"), [(0.03, 0.0), (0.0, 0.05)])
def test_headings_are_as_uncertain_as_the_marks_are_turned(aside_m: float, turn_rad: float) -> None:
    """A camera that was moved aside, or turned around the pool's middle, sees all marks moved aside or turned."""
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    moved = tuple(
        Landmark(id=mark.id, position_m=(c * x - s * y + aside_m, s * x + c * y, z), yaw_rad=mark.yaw_rad + turn_rad)
        for mark in MARKS
        for x, y, z in [mark.position_m]
    )
    pose = CheckedCameraPose(pool().camera, MARKS)
    watch(pose, picture(moved, 0.0), READINGS)
    covariance = pose.uncertainty(pose.view.linearize([ETA[0, :2]], [0.3]), [0.3])[0]
    assert pose.moved and np.sqrt(covariance[2, 2]) == pytest.approx(turn_rad, abs=0.01)


def test_a_covered_mark_is_said_and_the_others_still_count() -> None:
    result = seen(pool(MARKS[1:]), pool())
    assert result.status.message == "check mark 40 is not seen"


def test_check_marks_of_a_moving_camera_and_a_robots_marker_are_refused() -> None:
    mark = "[{id=1, position_m=[0,0,0]}]"
    with pytest.raises(ConfigError, match=r"check_marks: id 1 is the marker of robot 1 \(free: 0, "):
        load_experiment("pool", [f"check_marks={mark}"])
    with pytest.raises(ConfigError, match="check_marks: they check a fixed camera"):
        load_experiment("drone", ["check_marks=[{id=49, position_m=[0,0,0]}]"])

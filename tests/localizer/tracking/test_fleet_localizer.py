"""The whole localizer, frame by frame, against robots drawn at known places."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import pytest

from localizer.tracking.fleet_localizer import FleetLocalizer, LocalizationResult
from localizer.view.overlay import draw
from shoal.config.experiment import Experiment, load_experiment
from shoal.frames import Array, body_to_pool, wrap
from shoal.messages.messages import CameraHealth, Obstacles, Pose, Track
from tests.localizer.scene import Pixels, Scene

pytestmark = pytest.mark.long

EXPERIMENT = load_experiment("pool")
STEP_NS = 50_000_000
LEVEL = load_experiment("pool", ["localizer.tilt_sigma_rad=0", "localizer.tilt_rad_per_n=0"])
DEPTH_M = 0.3
DEPTHS_M = {1: DEPTH_M, 2: DEPTH_M}
SIDE = Scene(EXPERIMENT, seed=3)  # drawn once: its textures are the slow part


@dataclass(frozen=True)
class Step:
    """The truth of a frame, and the localizer's result."""

    truth: Mapping[int, Array]
    located: LocalizationResult

    def pose(self, robot: int) -> Pose:
        return dict(self.located.poses)[robot]

    def error(self, robot: int) -> Array:
        """x, y, yaw."""
        pose, eta = self.pose(robot), self.truth[robot]
        return np.array([pose.x_m - eta[0], pose.y_m - eta[1], wrap(pose.yaw_rad - eta[3])])


def _circling(t_s: float) -> dict[int, Array]:
    """Two robots on circles, far faster than the pool scene asks: 0.2 m/s, turning at up to 0.9 rad/s with reversals."""
    angle, yaw = 0.9 * t_s, 1.2 * np.sin(0.75 * t_s)
    swing = 0.22 * np.array([np.cos(angle), np.sin(angle)])
    return {
        1: np.array([0.5 + swing[0], swing[1], DEPTH_M, yaw + 2.5]),
        2: np.array([-0.4 + swing[1], 0.1 + swing[0], DEPTH_M, -yaw - 0.4]),
    }


def _fly(
    locator: FleetLocalizer,
    frames: int,
    truth: Callable[[float], Mapping[int, Array]] = _circling,
    hidden: Callable[[int], frozenset[int]] = lambda k: frozenset(),
    first: int = 0,
    depths_m: Mapping[int, float] = DEPTHS_M,
) -> Iterator[Step]:
    for k in range(first, first + frames):
        poses = truth(k * STEP_NS * 1e-9)
        yield Step(poses, locator.step(SIDE.frame(poses, hidden(k)), k * STEP_NS, depths_m))


def _found(truth: Callable[[float], Mapping[int, Array]] = _circling) -> FleetLocalizer:
    """A localizer that has read each marker once, a frame before the first."""
    locator = FleetLocalizer(EXPERIMENT)
    locator.step(SIDE.frame(truth(0.0)), -STEP_NS, DEPTHS_M)
    return locator


def _rms(steps: list[Step], robots: tuple[int, ...] = (1, 2)) -> Array:
    return np.asarray(np.sqrt(np.mean([step.error(robot) ** 2 for step in steps for robot in robots], axis=0)))


def _without_markers() -> Experiment:
    plain = EXPERIMENT.localizer.model_copy(update={"markers": False})
    starts = [robot.model_copy(update={"start": tuple(_circling(0.0)[robot.id])}) for robot in EXPERIMENT.robots]
    return EXPERIMENT.model_copy(update={"localizer": plain, "robots": tuple(starts)})


def test_markers_are_found_in_the_first_frame_and_believed_in_the_second() -> None:
    first, *steps = _fly(FleetLocalizer(EXPERIMENT), 30)
    assert first.located.poses == (), "one reading may be a misreading"
    for step in steps:
        assert [robot for robot, _ in step.located.poses] == [1, 2]
        assert all(pose.track is Track.MARKER and pose.identity_verified for _, pose in step.located.poses)
        assert step.located.status.camera is CameraHealth.OK and step.located.status.message == ""
    assert _rms(steps)[:2].max() < 0.6e-3 and _rms(steps)[2] < np.deg2rad(0.5)
    assert min(step.pose(1).peak for step in steps[5:]) > 0.5, "learnt and compared in every fourth frame"


def test_looks_alone_follow_fast_turning_robots() -> None:
    """No marker in sight for 5 s: the correlation filters carry on, and carry the identity."""
    everyone = frozenset({1, 2})
    steps = list(_fly(FleetLocalizer(_without_markers()), 100, hidden=lambda k: everyone))
    assert all(step.pose(robot).track is Track.KCF for step in steps[1:] for robot in (1, 2))
    assert all(step.pose(robot).identity_verified for step in steps for robot in (1, 2))
    assert _rms(steps)[:2].max() < 3e-3 and _rms(steps)[2] < np.deg2rad(1.0)


def _cover_marker(frame: Pixels, locator: FleetLocalizer, eta: Array) -> None:
    """Lay a dark bar across a robot at eta (4,): it spoils the marker and a part of the look."""
    bar = np.array([[-0.08, -0.02], [0.08, -0.02], [0.08, 0.005], [-0.08, 0.005]])
    places = eta[:2] + body_to_pool(bar, eta[3])
    corners = locator.view.pool_to_pixel(np.column_stack([places, np.full(4, DEPTH_M - locator.marker_height_m)]))
    cv2.fillPoly(frame, [np.rint(corners).astype(np.int32)], (40,))


@pytest.mark.parametrize("covered", [12, 15, *(pytest.param(frame, marks=pytest.mark.slow) for frame in (13, 14))])
def test_a_cable_over_the_marker_is_bridged(covered: int) -> None:
    """The rest of the look is enough, and fresh enough: it is learnt in every fourth frame, whichever of them is the last with
    a marker. The light falls by 2 % a frame until then."""
    locator = FleetLocalizer(EXPERIMENT)
    errors = []
    for k in range(covered + 30):
        truth = _circling(0.05 * k)
        frame = np.asarray(SIDE.frame(truth) * 0.98 ** min(k, covered), dtype=np.uint8)
        if k >= covered:
            for eta in truth.values():
                _cover_marker(frame, locator, eta)
        step = Step(truth, locator.step(frame, k * STEP_NS, DEPTHS_M))
        if k >= covered:
            assert all(pose.track is Track.KCF and pose.identity_verified for _, pose in step.located.poses)
            errors.append(step)
    assert _rms(errors)[:2].max() < 3e-3 and _rms(errors)[2] < np.deg2rad(1.0)


def test_a_rolling_shutter_dates_each_marker_by_its_row() -> None:
    """The last row is exposed 30 ms after the first, in which a robot at 0.3 m/s moves by 9 mm. Poses are of the
    middle row."""
    readout_s, speed = 0.03, np.array([0.3, -0.2])

    def truth(t_s: float, row: float) -> Array:
        return np.array([*(speed * (t_s + readout_s * (row / 960.0 - 0.5) - 0.6)), DEPTH_M, 0.4])

    rolling = load_experiment("pool", [f"camera.readout_s={readout_s}", "localizer.tilt_rad_per_n=0"])
    locator, steps, row = FleetLocalizer(rolling), [], 480.0
    for k in range(24):
        for _ in range(3):  # the row that it is in while that row is exposed
            x, y, _, _ = truth(0.05 * k, row)
            row = float(locator.view.pool_to_pixel(np.array([x, y, DEPTH_M - locator.marker_height_m]))[1])
        located = locator.step(SIDE.frame({1: truth(0.05 * k, row)}), k * STEP_NS, DEPTHS_M)
        steps.append(Step({1: truth(0.05 * k, 480.0)}, located))
    assert _rms(steps[8:], (1,))[:2].max() < 0.6e-3


def test_covariance_is_honest() -> None:
    """Errors lie within what is published: not by a wide margin in either direction. These robots are level."""
    _, *steps = _fly(FleetLocalizer(LEVEL), 40)
    squared = [step.error(r) @ np.linalg.solve(step.pose(r).covariance, step.error(r)) for step in steps for r in (1, 2)]
    assert 0.2 < np.mean(squared) / 3.0 < 1.5
    assert np.max(squared) < 25.0


def test_depth_error_is_covered_by_the_covariance() -> None:
    """A robot reports 1 cm too deep: 2 sigma of its sensor. The error grows by 2.5 mm per metre off the axis, and so does
    the published uncertainty, in that direction only."""
    still = {1: np.array([1.2, 0.0, DEPTH_M, 0.3]), 2: np.array([-0.4, 0.0, DEPTH_M, 0.0])}
    steps = list(_fly(FleetLocalizer(LEVEL), 5, lambda t: still, depths_m={1: DEPTH_M + 0.01, 2: DEPTH_M}))
    error, covariance = steps[-1].error(1), steps[-1].pose(1).covariance
    assert error[0] == pytest.approx(0.003, abs=1e-3)
    assert abs(error[0]) < 3.0 * np.sqrt(covariance[0, 0])
    assert covariance[0, 0] > 2.0 * covariance[1, 1]


def test_unreported_depth_is_the_experiments_and_less_sure() -> None:
    steps = list(_fly(FleetLocalizer(LEVEL), 3, depths_m={2: float("nan")}))
    assert steps[-1].pose(1).depth_m == DEPTH_M and steps[-1].pose(2).depth_m == DEPTH_M
    located = list(_fly(FleetLocalizer(LEVEL), 3))
    assert np.trace(steps[-1].pose(1).covariance) > 1.5 * np.trace(located[-1].pose(1).covariance)


def test_lost_and_found_elsewhere() -> None:
    """A robot is taken out of the water and put back a metre away. The other one does not notice."""

    def truth(t_s: float) -> dict[int, Array]:
        poses = _circling(t_s)
        k = round(t_s / 0.05)
        if 10 <= k < 35:
            del poses[1]
        if k >= 35:
            poses[1] = poses[1] + np.array([0.3, -0.8, 0.0, 2.0])
        return poses

    steps = list(_fly(_found(truth), 45, truth))
    tracks = [step.pose(1).track for step in steps]
    assert tracks[9] is Track.MARKER and tracks[10] is Track.COAST and tracks[34] is Track.LOST
    assert tracks.index(Track.LOST) - 10 == pytest.approx(EXPERIMENT.localizer.lost_after_s / 0.05, abs=1)
    assert not any(steps[k].pose(1).identity_verified for k in range(26, 35))
    assert "lost: robot 1" in steps[30].located.status.message
    assert tracks[40] is Track.MARKER and np.abs(steps[40].error(1)[:2]).max() < 2e-3
    assert all(step.pose(2).track is Track.MARKER for step in steps)


def test_a_robot_that_is_not_seen_after_a_long_gap_between_pictures_is_lost() -> None:
    """However long the experiment lets robots coast: the camera was gone for a minute, and nobody knows where they went."""
    locator = FleetLocalizer(load_experiment("pool", ["localizer.lost_after_s=2"]))
    still = _circling(0.0)
    for k in range(3):
        before = locator.step(SIDE.frame(still), k * STEP_NS, DEPTHS_M)
    assert {pose.track for _, pose in before.poses} == {Track.MARKER}
    after = locator.step(SIDE.frame({2: still[2]}), 60_000_000_000, DEPTHS_M)
    assert {robot: pose.track for robot, pose in after.poses} == {1: Track.LOST, 2: Track.MARKER}


def test_a_robot_nobody_saw_has_no_pose() -> None:
    only_second = {2: np.array([-0.4, 0.1, DEPTH_M, 0.5])}
    steps = list(_fly(FleetLocalizer(EXPERIMENT), 7, lambda t: only_second))
    assert all([robot for robot, _ in step.located.poses] == [2] for step in steps[1:])
    assert "lost: robot 1" in steps[-1].located.status.message


def test_out_of_the_picture_and_back() -> None:
    def truth(t_s: float) -> dict[int, Array]:
        return {1: np.array([1.2 + 0.9 * np.sin(1.5 * t_s), 0.9, DEPTH_M, 0.2]), 2: _circling(t_s)[2]}

    steps = list(_fly(_found(truth), 46, truth))
    assert any(step.pose(1).track is not Track.MARKER for step in steps)
    assert steps[-1].pose(1).track is Track.MARKER and np.abs(steps[-1].error(1)[:2]).max() < 2e-3


def test_crossing_without_markers_is_never_silent() -> None:
    """Two identical robots brush past each other while their markers cannot be read. Whoever follows whom afterwards, both
    identities are doubted from the moment they are near until a marker is read, and then they are right."""
    offset, speed = 0.26, 0.33

    def truth(t_s: float) -> dict[int, Array]:
        along = speed * (t_s - 1.5)
        return {
            1: np.array([along, offset / 2, DEPTH_M, 0.0]),
            2: np.array([-along, -offset / 2, DEPTH_M, 0.0]),
        }

    steps = list(_fly(_found(truth), 64, truth, hidden=lambda k: frozenset({1, 2}) if 12 <= k < 56 else frozenset()))
    touched = False
    for k, step in enumerate(steps):
        touched |= float(np.linalg.norm(step.truth[1][:2] - step.truth[2][:2])) < 2.2 * EXPERIMENT.vehicle.radius_m
        for robot in (1, 2):
            wrong = float(np.linalg.norm(step.error(robot)[:2])) > 0.15
            assert not (wrong and step.pose(robot).identity_verified), f"frame {k}"
            if touched and k < 56:
                assert not step.pose(robot).identity_verified
    for robot in (1, 2):
        assert steps[-1].pose(robot).identity_verified and np.abs(steps[-1].error(robot)[:2]).max() < 2e-3


def test_swapped_labels_are_noticed_at_once() -> None:
    """Somebody swaps the robots between two frames: both are doubted in the next one, and right in the one after."""

    def truth(t_s: float) -> dict[int, Array]:
        places = [np.array([0.4, 0.0, DEPTH_M, 0.5]), np.array([-0.4, 0.0, DEPTH_M, -0.5])]
        return dict(zip((1, 2), places if t_s < 0.49 else places[::-1], strict=True))

    steps = list(_fly(FleetLocalizer(EXPERIMENT), 14, truth))
    for robot in (1, 2):
        assert not steps[10].pose(robot).identity_verified
        assert (
            steps[11].pose(robot).identity_verified
            and steps[12].pose(robot).identity_verified
            and np.abs(steps[12].error(robot)[:2]).max() < 2e-3
        )


def test_two_false_markers_at_different_places_move_nobody() -> None:
    """Robot 1 has left the water. Later something with its marker shows up for one frame, and elsewhere for the next one: its
    pose stays where it was lost. The same thing at one place for two frames is believed."""
    third = EXPERIMENT.robots[0].model_copy(update={"id": 3, "marker_id": EXPERIMENT.robots[0].marker})
    three = EXPERIMENT.model_copy(update={"robots": (*EXPERIMENT.robots, third)})
    scene, locator = Scene(three, seed=3), FleetLocalizer(EXPERIMENT)
    still = {2: np.array([-0.4, 0.1, DEPTH_M, 0.5])}
    false = {32: (-1.0, -0.7, 0.3), 33: (-0.85, -0.6, -2.0), 37: (1.1, -0.6, -2.0), 38: (1.1, -0.6, -2.0)}  # scanned at 32, 37

    def poses(k: int) -> dict[int, Pose]:
        there = still | ({1: np.array([0.5, 0.0, DEPTH_M, 0.0])} if k <= 10 else {})
        if k in false:
            x, y, yaw = false[k]
            there = there | {3: np.array([x, y, DEPTH_M, yaw])}
        return dict(locator.step(scene.frame(there), k * STEP_NS, DEPTHS_M).poses)

    measurement = [poses(k) for k in range(1, 39)]
    assert measurement[29][1].track is Track.LOST
    for k in (32, 33, 37):
        pose = measurement[k - 1][1]
        assert pose.track is Track.LOST and not pose.identity_verified
        assert np.hypot(pose.x_m - 0.5, pose.y_m) < 2e-3
    assert measurement[37][1].track is Track.MARKER and measurement[37][1].identity_verified
    assert abs(measurement[37][1].x_m - 1.1) < 3e-3
    assert all(pose[2].track is Track.MARKER for pose in measurement[1:])


def test_a_frames_poses_do_not_wait_for_what_comes_after_them() -> None:
    """The poses of `locate` are those of `step`; what `finish` finds is in the next frame's."""
    both, parts = FleetLocalizer(EXPERIMENT), FleetLocalizer(EXPERIMENT)
    for k in range(30):
        frame = SIDE.frame(_circling(0.05 * k), frozenset({1}) if 12 <= k < 20 else frozenset())
        together, first = both.step(frame, k * STEP_NS, DEPTHS_M), parts.locate(frame, k * STEP_NS, DEPTHS_M)
        parts.finish()
        parts.finish()  # a second call does nothing
        assert together.status.message == first.status.message and len(together.poses) == len(first.poses)
        for (_, a), (_, b) in zip(together.poses, first.poses, strict=True):
            assert (a.x_m, a.y_m, a.yaw_rad, a.peak, a.track) == (b.x_m, b.y_m, b.yaw_rad, b.peak, b.track)


MORE_PLACES_M = [pytest.param(y_m, marks=pytest.mark.slow) for y_m in (-0.65, -0.38, 0.0, 0.25, 1.0)]


@pytest.mark.parametrize("y_m", [-1.2, -0.2, 0.55, *MORE_PLACES_M])
def test_a_lost_robot_is_found_within_five_frames_wherever_it_comes_back(y_m: float) -> None:
    """At every height of the picture, also across the borders of strips, and in each phase of the scan."""
    for back in range(20, 25):
        locator = FleetLocalizer(EXPERIMENT)
        for k in range(back + 6):
            there = {2: np.array([-0.4, 0.1, DEPTH_M, 0.5])} | ({1: np.array([0.9, y_m, DEPTH_M, 0.8])} if k >= back else {})
            poses = dict(locator.step(SIDE.frame(there), k * STEP_NS, DEPTHS_M).poses)
            if 1 in poses and poses[1].identity_verified:
                break
        assert 1 <= k - back <= 5 and abs(poses[1].y_m - y_m) < 3e-3


def test_frozen_black_and_missized_pictures_give_no_poses() -> None:
    locator = FleetLocalizer(EXPERIMENT)
    *_, last = _fly(locator, 5)
    frame = SIDE.frame(last.truth)
    tracks = []
    for k in range(5, 12):
        located = locator.step(frame, k * STEP_NS, DEPTHS_M)
        tracks.append((located.status.camera, [pose.track for _, pose in located.poses]))
    assert tracks[0] == (CameraHealth.OK, [Track.MARKER, Track.MARKER])
    assert tracks[1:4] == [(CameraHealth.OK, [Track.COAST, Track.COAST])] * 3, "a repeated picture is no news"
    assert tracks[4:] == [(CameraHealth.FROZEN, [])] * 3
    for bad, health in ((np.zeros_like(frame), CameraHealth.BLACK), (frame[::2, ::2].copy(), CameraHealth.WRONG_SIZE)):
        located = locator.step(bad, 12 * STEP_NS, DEPTHS_M)
        assert located.status.camera is health and located.poses == ()
        assert health.name.lower().split("_")[0] in located.status.message
    *_, again = _fly(locator, 2, first=13)
    assert again.pose(1).track is Track.MARKER and np.abs(again.error(1)[:2]).max() < 2e-3


def test_stamps_may_jump_either_way() -> None:
    locator = FleetLocalizer(EXPERIMENT)
    still = _circling(0.0)
    locator.step(SIDE.frame(still), 10**18 - STEP_NS, DEPTHS_M)
    for stamp_ns in (10**18, 10**18 + STEP_NS, 5, 10**15, 10**15 - 7 * STEP_NS):
        located = locator.step(SIDE.frame(still), stamp_ns, DEPTHS_M)
        for robot, pose in located.poses:
            assert np.isfinite(pose.covariance).all()
            assert abs(pose.x_m - still[robot][0]) < 2e-3 and pose.track is Track.MARKER


def test_same_frames_same_bits() -> None:
    frames = [SIDE.frame(_circling(0.05 * k), frozenset({1}) if k > 8 else frozenset()) for k in range(16)]

    def run() -> list[bytes]:
        locator = FleetLocalizer(EXPERIMENT)
        results = [locator.step(frame, k * STEP_NS, DEPTHS_M) for k, frame in enumerate(frames)]
        return [
            np.array([p.x_m, p.y_m, p.yaw_rad, p.peak, *p.covariance.ravel()]).tobytes() for r in results for _, p in r.poses
        ]

    assert run() == run()


def test_the_frame_is_only_read() -> None:
    frame: Pixels = SIDE.frame(_circling(0.0))
    frame.setflags(write=False)  # as it comes out of a message
    locator = FleetLocalizer(EXPERIMENT)
    locator.step(frame, 0, DEPTHS_M)
    again = SIDE.frame(_circling(0.0))
    again.setflags(write=False)
    assert len(locator.step(again, STEP_NS, DEPTHS_M).poses) == 2


def test_a_marker_of_nobody_is_named_until_the_right_one_is_on() -> None:
    wrong, locator = Scene(load_experiment("pool", ["robots.1.marker_id=9"]), seed=3), FleetLocalizer(EXPERIMENT)
    messages = [locator.step(wrong.frame(_circling(0.05 * k)), k * STEP_NS, DEPTHS_M).status.message for k in range(12)]
    assert messages[0] == "lost: robot 1, 2" and messages[1] == "lost: robot 2", "one sight of it may be a misreading"
    assert messages[-1] == "lost: robot 2; in view, but no robot's: marker 9"
    *_, step = _fly(locator, 8, first=12)
    assert step.located.status.message == ""


def test_overlay_marks_robots_where_they_are() -> None:
    locator = FleetLocalizer(EXPERIMENT)
    *_, step = _fly(locator, 2)
    frame = SIDE.frame(step.truth)
    nobody = replace(step.located, poses=())
    bare, marked = draw(locator, frame, nobody, Obstacles()), draw(locator, frame, step.located, Obstacles())
    assert marked.shape == (480, 640, 3) and marked.dtype == np.uint8
    changed = np.argwhere(np.any(bare != marked, axis=2))[:, ::-1]
    for robot in (1, 2):
        eta = step.truth[robot]
        centre = (locator.view.pool_to_pixel(np.array([eta[0], eta[1], eta[2] - locator.marker_height_m])) + 0.5) / 2 - 0.5
        near = changed[np.linalg.norm(changed - centre, axis=1) < 80]
        assert len(near) > 200 and np.linalg.norm(near - centre, axis=1).min() < 3
    unlabelled = draw(locator, frame, step.located, Obstacles(), labels=False)
    assert 0 < np.any(bare != unlabelled, axis=2).sum() < np.any(bare != marked, axis=2).sum()
    assert draw(locator, np.zeros((200, 300), np.uint8), nobody, Obstacles()).shape == (480, 640, 3)


def test_overlay_outlines_obstacles_where_they_are() -> None:
    locator = FleetLocalizer(EXPERIMENT)
    *_, step = _fly(locator, 1)
    frame, middle = SIDE.frame(step.truth), np.array([-1.0, 0.6])
    turn = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    outline = middle + 0.1 * np.column_stack([np.cos(turn), np.sin(turn)])
    obstacles = Obstacles(ids=(3,), outline=outline[None], velocity=np.array([[0.2, 0.0]]), depth_m=0.5, unseen_s=np.zeros(1))
    bare, marked = draw(locator, frame, step.located, Obstacles()), draw(locator, frame, step.located, obstacles)
    changed = np.argwhere(np.any(bare != marked, axis=2))[:, ::-1]
    for point in (*outline, middle + np.array([0.15, 0.0])):  # its rim, and the way it drifts
        measurement = (locator.view.pool_to_pixel(np.append(point, 0.5)) + 0.5) / 2 - 0.5
        assert np.linalg.norm(changed - measurement, axis=1).min() < 2.0


# --- one id at two places


def test_two_robots_with_one_id_are_neither() -> None:
    """From the first picture on: whichever it is taken for, the other one is 1.4 m away."""
    locator, message = FleetLocalizer(EXPERIMENT), ""
    for k in range(40):
        places = {1: np.array([0.7, -0.4, 0.3, 0.4]), 2: np.array([-0.7, -0.4, 0.3, 1.0])}
        located = locator.step(SIDE.frame(places, swapped={2: 1}), k * STEP_NS, DEPTHS_M)
        assert 1 not in dict(located.poses) or not dict(located.poses)[1].identity_verified
        message = located.status.message
    assert "in view twice: the marker of robot 1" in message


def test_a_spare_plate_that_comes_beside_a_followed_robot_takes_its_verification() -> None:
    """The robot is followed on, but is it the right one? While the plate is away again, it is."""
    locator, verified, messages = FleetLocalizer(EXPERIMENT), list[bool](), list[str]()
    for k in range(220):
        places = {1: np.array([0.7, -0.4, 0.3, 0.4]), 2: np.array([-0.7, 0.1, 0.3, 1.0])}
        spare = {3: np.array([-0.2, -0.7, 0.3, 0.2])} if 20 <= k < 90 else {}
        located = locator.step(SIDE.frame(places | spare, swapped={3: 1}), k * STEP_NS, DEPTHS_M)
        if k > 1:
            pose = dict(located.poses)[1]
            assert np.hypot(pose.x_m - 0.7, pose.y_m + 0.4) < 2e-3
            assert dict(located.poses)[2].identity_verified
            verified.append(pose.identity_verified)
            messages.append(located.status.message)
    assert all(verified[:18]) and not any(verified[80:100]) and all(verified[-20:])
    assert "in view twice: the marker of robot 1" in messages[85] and messages[-1] == ""


def test_a_spare_plate_in_a_mask_hides_no_robot() -> None:
    """The better square lies where no robot can be."""
    mask = ((200.0, 200.0), (520.0, 200.0), (520.0, 460.0), (200.0, 460.0))
    masked = EXPERIMENT.model_copy(update={"camera": EXPERIMENT.camera.model_copy(update={"masks_px": (mask,)})})
    for depth_m in (0.3, 0.5):
        locator = FleetLocalizer(masked)
        for k in range(8):
            places = {1: np.array([0.7, -0.4, depth_m, 0.4]), 2: np.array([-0.7, -0.4, 0.3, 1.0])}
            located = locator.step(SIDE.frame(places, swapped={2: 1}), k * STEP_NS, {1: depth_m, 2: 0.3})
        pose = dict(located.poses)[1]
        assert pose.identity_verified and np.hypot(pose.x_m - 0.7, pose.y_m + 0.4) < 4e-3


def test_a_marker_that_was_read_is_looked_for_on_its_plate_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """The whole region of a robot costs twice as much, and is read where the plate alone shows no marker."""
    locator, sides = _found(), list[list[int]]()
    # private: what is cut out of the picture shows in no result
    read = locator._reader.read

    def noted(view: Any, regions: Any, plates_m: Any, tilts_rad: Any) -> Any:
        sides.append([region.bayer.shape[0] for region in regions])
        return read(view, regions, plates_m, tilts_rad)

    list(_fly(locator, 3))
    monkeypatch.setattr(locator._reader, "read", noted)  # private: as above
    list(_fly(locator, 1, first=3))
    plates, missed = sides[0], sides[1]
    assert len(plates) == 2 and missed == []
    sides.clear()
    list(_fly(locator, 1, hidden=lambda k: frozenset({2}), first=4))
    assert len(sides[0]) == 2 and len(sides[1]) == 1 and sides[1][0] > 1.3 * max(plates)
    sides.clear()
    list(_fly(locator, 1, first=5))
    assert len(sides[0]) == 1 and len(sides[1]) == 1, "robot 2 is followed by its look: its whole region is read"


# --- sizes


def _taken_anew(picture: Pixels, k: int) -> Pixels:
    """The picture with other noise in its first rows: one that comes again is a hung camera's."""
    new = picture.copy()
    new[:8] += np.uint8(k)
    return new


def test_a_depth_that_is_wrong_by_10_cm_is_told() -> None:
    """Of one of three robots: the others' markers look right."""
    three = EXPERIMENT.model_copy(update={"robots": (*EXPERIMENT.robots, EXPERIMENT.robots[0].model_copy(update={"id": 3}))})
    places = {1: np.array([0.7, -0.4, 0.3, 0.4]), 2: np.array([-0.7, 0.1, 0.4, 1.0]), 3: np.array([0.1, 0.7, 0.3, 2.0])}
    scene = Scene(three, seed=3)
    frames = [scene.frame(places) for _ in range(3)]  # drawing is slow
    for wrong_m, looks in ((0.0, ""), (0.1, "too large"), (-0.1, "too small")):
        locator = FleetLocalizer(three)
        for k in range(50):
            located = locator.step(_taken_anew(frames[k % 3], k), k * STEP_NS, {1: 0.3, 2: 0.4 + wrong_m, 3: 0.3})
        message = located.status.message
        assert (looks in message and message.endswith("robot 2")) if looks else message == ""


@pytest.mark.parametrize(("printed", "words"), [(0.8, "too small, and is not believed"), (0.94, "too small for its depth")])
def test_a_marker_that_was_not_printed_at_true_scale_is_told(printed: float, words: str) -> None:
    marker = EXPERIMENT.vehicle.marker
    small = marker.model_copy(update={"side_m": printed * marker.side_m})
    scene = Scene(EXPERIMENT.model_copy(update={"vehicle": EXPERIMENT.vehicle.model_copy(update={"marker": small})}), seed=3)
    frames, locator = [scene.frame({1: np.array([0.7, -0.4, 0.3, 0.4])}) for _ in range(3)], FleetLocalizer(EXPERIMENT)
    for k in range(50):
        located = locator.step(_taken_anew(frames[k % 3], k), k * STEP_NS, DEPTHS_M)
    assert words in located.status.message and "robot 1" in located.status.message

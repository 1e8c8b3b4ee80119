"""Fusion of several cameras' poses: honest whatever the errors have in common, without a jump, with a camera that fails."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest

from localizer.detection.blob_tracker import convex_outline
from localizer.tracking.camera_fusion import (
    CameraFusion,
    CameraView,
    FusionResult,
    covariance_intersection,
    fuse_obstacles,
)
from localizer.tracking.check_marks import with_camera
from shoal.config.experiment import load_experiment
from shoal.frames import Array
from shoal.messages.messages import CameraHealth, LocalizerStatus, Obstacles, Pose, Track

EXPERIMENT = load_experiment("two-cameras")
PERIOD_NS = 50_000_000
SIGMA = np.diag([0.002, 0.002, 0.005])
WELL = LocalizerStatus(camera=CameraHealth.OK, marks_seen=True)
COVERED = replace(WELL, marks_seen=False)


def pose(eta: Sequence[float] | Array, covariance: Array = SIGMA**2, track: Track = Track.MARKER, sure: bool = True) -> Pose:
    x_m, y_m, yaw_rad = np.asarray(eta, dtype=np.float64).tolist()
    return Pose(x_m, y_m, yaw_rad, covariance, track, sure)


def view(instant_ns: int, poses: Mapping[int, Pose], status: LocalizerStatus = WELL) -> CameraView:
    return CameraView(instant_ns, status, poses)


def fused(result: FusionResult, robot: int = 1) -> Array:
    pose_of_robot = dict(result.poses)[robot]
    return np.array([pose_of_robot.x_m, pose_of_robot.y_m, pose_of_robot.yaw_rad])


# --- honest


@pytest.mark.parametrize(
    ("shared", "from_optimum", "naive_nees"), [(-0.5, 1.1, 1.7), (0.0, 1.02, 3.0), (0.5, 1.1, 4.2), (0.95, 2.1, 5.5)]
)
def test_fused_poses_are_consistent_at_any_correlation_and_near_the_optimum(
    shared: float, from_optimum: float, naive_nees: float
) -> None:
    """Against the information form of the estimate that knows the joint covariance of both cameras' errors, which nobody does
    in a pool. An estimate that takes them as independent is not consistent where they are not. The cameras see along different
    lines of sight, so that their ellipses differ."""
    random, count = np.random.default_rng(7), 4000
    turns = [np.array([[np.cos(a), -np.sin(a), 0.0], [np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]]) for a in (0.3, 1.4)]
    parts = [turn @ np.diag([0.003, 0.0015, 0.004]) ** 2 @ turn.T for turn in turns]
    halves = [np.linalg.cholesky(part) for part in parts]
    cross = shared * halves[0] @ halves[1].T
    joint = np.block([[parts[0], cross], [cross.T, parts[1]]])
    errors = random.multivariate_normal(np.zeros(6), joint, count)
    stacked = np.vstack([np.eye(3), np.eye(3)])
    best_covariance = np.linalg.inv(stacked.T @ np.linalg.inv(joint) @ stacked)
    best = errors @ np.linalg.inv(joint) @ stacked @ best_covariance
    naive_covariance = np.linalg.inv(sum(map(np.linalg.inv, parts)))
    naive = sum(errors[:, 3 * k : 3 * k + 3] @ np.linalg.inv(part) for k, part in enumerate(parts)) @ naive_covariance

    fusions = [covariance_intersection([(e[:3].copy(), parts[0]), (e[3:].copy(), parts[1])]) for e in errors]
    nees = np.mean([e @ np.linalg.solve(covariance, e) for e, covariance in fusions])
    rms = np.sqrt(np.mean([e[:2] @ e[:2] for e, _ in fusions]))
    assert 0.5 < nees < 3.1
    assert rms < from_optimum * np.sqrt(np.mean(np.sum(best[:, :2] ** 2, axis=1)))
    assert rms < np.sqrt(np.mean(np.sum(errors[:, :2] ** 2, axis=1)))  # than one camera alone
    independent = np.mean(np.einsum("ni,ij,nj->n", naive, np.linalg.inv(naive_covariance), naive))
    assert independent == pytest.approx(naive_nees, abs=0.2)


def test_a_heading_across_half_a_turn_is_averaged_the_short_way() -> None:
    mean, _ = covariance_intersection([(np.array([0.0, 0.0, 3.13]), SIGMA**2), (np.array([0.0, 0.0, -3.13]), SIGMA**2)])
    assert abs(abs(mean[2]) - np.pi) < 1e-6


@pytest.mark.parametrize("offset_ns", [0, PERIOD_NS // 2], ids=["together", "in turns"])
def test_a_moving_robot_seen_by_two_cameras_is_located_as_well_as_its_covariance_says(offset_ns: int) -> None:
    """Three quarters of each camera's error are common to both; exposed together, or half a period apart."""
    nees, errors = [], []
    for seed in range(8):
        random, fusion, views = np.random.default_rng(seed), CameraFusion(EXPERIMENT), dict[str, CameraView]()
        common = SIGMA @ random.normal(size=3) * np.sqrt(0.75)
        for k in range(120):
            camera = ("west", "east")[k % 2]
            at_ns = (k // 2) * PERIOD_NS + (k % 2) * offset_ns
            true = np.array([0.3 * at_ns * 1e-9, 0.1 * np.sin(at_ns * 1e-9), 0.5 * at_ns * 1e-9])
            views[camera] = view(at_ns, {1: pose(true + common + SIGMA @ random.normal(size=3) * 0.5)})
            if offset_ns == 0 and camera == "west":
                continue
            result = fusion.step(views, at_ns)
            fused_pose = dict(result.poses)[1]
            error = fused(result) - true
            if k > 20:
                nees.append(error @ np.linalg.solve(fused_pose.covariance, error))
                errors.append(error)
    assert 0.8 < np.mean(nees) < 3.6
    assert np.sqrt(np.mean(np.sum(np.array(errors)[:, :2] ** 2, axis=1))) < 1.1 * np.sqrt(2.0) * SIGMA[0, 0]


# --- from picture to picture


def test_a_robot_that_crosses_over_moves_no_more_than_its_covariances_claim() -> None:
    """The cameras are 3 mm apart, as after two calibrations. West sees the robot until x = 0.4 m, east from -0.4 m on."""
    fusion, bias, last = CameraFusion(EXPERIMENT), np.array([0.0015, 0.0, 0.0]), None
    for k in range(160):
        true, at_ns = np.array([-0.8 + 0.01 * k, 0.0, 0.0]), k * PERIOD_NS
        west = {1: pose(true - bias)} if true[0] < 0.4 else {1: pose(true - bias, track=Track.LOST)}
        east = {1: pose(true + bias)} if true[0] > -0.4 else {}
        result = fusion.step({"west": view(at_ns, west), "east": view(at_ns, east)}, at_ns)
        error, covariance = fused(result) - true, dict(result.poses)[1].covariance
        if last is not None:
            change = error - last[0]
            assert change @ np.linalg.solve(covariance + last[1], change) < 3.0
            assert np.hypot(*change[:2]) < 0.0016
        last = error, covariance
    assert result.status.message == ""


def test_a_robot_seen_by_one_camera_is_where_that_camera_says() -> None:
    estimate = pose([1.0, 0.2, 0.3])
    result = CameraFusion(EXPERIMENT).step({"west": view(0, {}), "east": view(0, {1: estimate})}, 0)
    assert fused(result) == pytest.approx([1.0, 0.2, 0.3])
    assert np.array_equal(dict(result.poses)[1].covariance, estimate.covariance)
    assert result.status.frames == 1


def test_measured_and_verified_poses_come_before_coasting_and_doubtful_ones() -> None:
    far = [0.0, 0.5, 0.0]
    for worse in (pose(far, track=Track.COAST), pose(far, sure=False), pose(far, -(SIGMA**2)), pose(far, track=Track.LOST)):
        result = CameraFusion(EXPERIMENT).step({"west": view(0, {1: worse}), "east": view(0, {1: pose([0.0, 0.0, 0.0])})}, 0)
        assert fused(result) == pytest.approx([0.0, 0.0, 0.0]), worse.track


def test_a_robot_that_every_camera_has_lost_is_told_as_lost_where_it_was() -> None:
    fusion = CameraFusion(EXPERIMENT)
    fusion.step({"west": view(0, {1: pose([0.1, 0.2, 0.3])}), "east": view(0, {})}, 0)
    gone = {1: pose([0.1, 0.2, 0.3], track=Track.LOST)}
    result = fusion.step({"west": view(PERIOD_NS, gone), "east": view(PERIOD_NS, {})}, PERIOD_NS)
    assert dict(result.poses)[1].track is Track.LOST and not dict(result.poses)[1].identity_verified
    assert fused(result) == pytest.approx([0.1, 0.2, 0.3])
    assert "lost: robot 1" in result.status.message


# --- a camera fails


@pytest.mark.parametrize(
    ("failure", "why"),
    [
        (LocalizerStatus(camera=CameraHealth.FROZEN, message="camera frozen"), "camera west is out: camera frozen"),
        (LocalizerStatus(camera=CameraHealth.BLACK), "camera west is out: black"),
        (None, "camera west is out: its last picture is more than 0.25 s old"),
    ],
    ids=["frozen", "black", "gone"],
)
def test_with_a_camera_out_the_other_goes_on_and_the_status_says_which(failure: LocalizerStatus | None, why: str) -> None:
    """Robot 2 is seen by the failing camera alone: nothing is told of it any more."""
    fusion, west = CameraFusion(EXPERIMENT), view(0, {})
    for k in range(20):
        at_ns, true = k * PERIOD_NS, [0.01 * k, 0.0, 0.0]
        if k < 10:
            west = view(at_ns, {1: pose(true), 2: pose([-1.0, 0.0, 0.0])})
        elif failure is not None:
            west = view(at_ns, {}, failure)
        result = fusion.step({"west": west, "east": view(at_ns, {1: pose(true)})}, at_ns)
        assert np.hypot(*(fused(result) - true)[:2]) < 0.002
        assert (2 in dict(result.poses)) == (k < 10)
    assert result.status.out == ("west",) and why in result.status.message
    assert result.status.camera is CameraHealth.OK


def test_with_all_cameras_out_there_are_no_poses_and_the_health_says_why() -> None:
    dark = LocalizerStatus(camera=CameraHealth.BLACK)
    result = CameraFusion(EXPERIMENT).step({"east": view(0, {}, dark)}, 0)
    assert result.poses == () and result.status.camera is CameraHealth.BLACK
    assert result.status.out == ("west", "east")


def test_a_camera_that_is_late_is_carried_on_and_counts_less() -> None:
    fusion = CameraFusion(EXPERIMENT)
    for k in range(2, 40):
        at_ns, late_ns = k * PERIOD_NS, (k - 2) * PERIOD_NS
        views = {"west": view(late_ns, {1: pose([0.015 * (k - 2), 0.0, 0.0])}), "east": view(at_ns, {})}
        result = fusion.step(views, at_ns)
        alone = dict(result.poses)[1]
    assert fused(result) == pytest.approx([0.015 * 39, 0.0, 0.0], abs=0.003)
    assert alone.covariance[0, 0] > 2.0 * SIGMA[0, 0] ** 2


# --- a camera is moved

LEAP = np.array([0.03, 0.04, 0.0])
MOVED = LocalizerStatus(camera=CameraHealth.OK, message="the camera was moved: check marks are 28 px off", moved=True)


def test_a_camera_whose_poses_leave_the_robots_motions_is_out_until_it_agrees_again() -> None:
    """As when it is bumped: its poses leap by 50 mm. Robot 1 goes on as the other camera sees it. Of robot 2, which it alone
    sees, nothing wrong is ever told."""
    fusion, out = CameraFusion(EXPERIMENT), []
    for k in range(130):  # its check marks are covered
        bumped = 30 <= k < 60
        at_ns, true, leap = k * PERIOD_NS, np.array([0.01 * k, 0.0, 0.0]), LEAP * bumped
        east = {1: pose(true + leap), 2: pose(np.array([1.5, 0.0, 0.0]) + leap)}
        result = fusion.step({"west": view(at_ns, {1: pose(true)}), "east": view(at_ns, east, COVERED)}, at_ns)
        assert np.hypot(*(fused(result) - true)[:2]) < 0.002
        assert np.sqrt(dict(result.poses)[1].covariance[0, 0]) < 0.004  # the other camera is not in doubt
        assert (2 in dict(result.poses)) == (k < 30 or "east" not in result.distrusted)
        assert ("east" in result.distrusted) == (30 <= k < 99)  # back after 2 s
        out.append(result.status.out)
        if k == 40:
            why = "camera east is out: it seems to have been moved: its poses are 50 mm from those of another camera"
            assert result.status.message == why and result.status.camera is CameraHealth.OK
    assert [k for k in range(130) if out[k] == ("east",)] == list(range(34, 99))


def test_a_camera_whose_check_marks_are_in_place_is_not_put_out_for_its_poses() -> None:
    """A plate that was glued on anew, say: robot 1 leaps by 50 mm as east alone sees it. East is not trusted until its marks
    could have told a knock; then both are in doubt, for as long as they differ, and east's other robots have poses."""
    fusion = CameraFusion(EXPERIMENT)
    for k in range(400):
        at_ns, leap = k * PERIOD_NS, LEAP * (k >= 30)
        east = {1: pose(leap), 2: pose([1.5, 0.0, 0.0])}
        result = fusion.step({"west": view(at_ns, {1: pose(np.zeros(3))}), "east": view(at_ns, east)}, at_ns)
        assert result.status.out == () and (2 in dict(result.poses)) == (not 30 <= k < 36)
        if k >= 37:
            assert "cameras west and east disagree by 50 mm about robot 1" in result.status.message
            assert np.sqrt(dict(result.poses)[2].covariance[0, 0]) > 0.02


def test_a_camera_that_is_out_comes_back_when_its_check_marks_are_uncovered_in_place() -> None:
    fusion, out = CameraFusion(EXPERIMENT), []
    for k in range(300):
        at_ns, status = k * PERIOD_NS, COVERED if k < 100 else WELL
        views = {"west": view(at_ns, {1: pose(np.zeros(3))}), "east": view(at_ns, {1: pose(LEAP * (k >= 30))}, status)}
        out.append(fusion.step(views, at_ns).status.out)
    assert out[34] == out[100] == ("east",) and [k for k in range(300) if out[k]][-1] in range(140, 150)


def test_a_doubt_passes_while_the_cameras_see_no_common_robot_and_is_told_until_then() -> None:
    """Two pictures 160 mm apart, then each camera has robots of its own."""
    fusion, apart, sigmas_m, messages = CameraFusion(EXPERIMENT), np.array([0.16, 0.0, 0.0]), list[float](), list[str]()
    for k in range(1800):
        at_ns = k * PERIOD_NS
        east = {1: pose(apart)} if k < 2 else {2: pose([1.0, 0.0, 0.0])}
        views = {"west": view(at_ns, {1: pose(np.zeros(3))}), "east": view(at_ns, east)}
        result = fusion.step(views, at_ns)
        sigmas_m.append(float(np.sqrt(dict(result.poses)[1].covariance[0, 0])))
        messages.append(result.status.message)
    assert sigmas_m[1] > 0.15 and sigmas_m[600] < 0.04 and sigmas_m[-1] < 0.003
    assert "disagree by 160 mm" in messages[1] and messages[-1] == ""
    assert all(
        "cameras west and east disagreed" in text for text, s in zip(messages[2:], sigmas_m[2:], strict=True) if s > 0.006
    )


def test_one_misread_marker_takes_no_camera_out() -> None:
    fusion = CameraFusion(EXPERIMENT)
    for k in range(40):
        at_ns, east = k * PERIOD_NS, LEAP * (k == 20)
        views = {"west": view(at_ns, {1: pose(np.zeros(3))}), "east": view(at_ns, {1: pose(east), 2: pose([1.5, 0.0, 0.0])})}
        result = fusion.step(views, at_ns)
        assert result.status.out == () and np.hypot(*fused(result)[:2]) < 0.001
        assert (2 in dict(result.poses)) == (k != 20)  # nobody knows yet


def test_a_camera_into_whose_picture_a_robot_comes_is_not_blamed_for_the_other_ones_error() -> None:
    """Bumped while it alone saw the robot, a camera without check marks has taken the robot's motion with it. Both are in
    doubt."""
    fusion = CameraFusion(EXPERIMENT)
    for k in range(60):
        at_ns, true = k * PERIOD_NS, np.array([0.01 * k, 0.0, 0.0])
        east = {1: pose(true)} if k >= 40 else {}
        result = fusion.step({"west": view(at_ns, {1: pose(true + LEAP * (k >= 20))}), "east": view(at_ns, east)}, at_ns)
        assert result.status.out == ()
    assert result.disagreement == "cameras west and east disagree by 50 mm about robot 1"
    error, covariance = fused(result) - true, dict(result.poses)[1].covariance
    assert error @ np.linalg.solve(covariance, error) < 3.0


@pytest.mark.parametrize(("unseen_s", "blamed"), [(0.8, True), (1.2, False)])
def test_a_camera_that_has_not_seen_a_robot_for_a_second_is_not_blamed_alone(unseen_s: float, blamed: bool) -> None:
    """It is 50 mm from the other one when it sees the robot again: by then either of them may have been moved."""
    fusion, again = CameraFusion(EXPERIMENT), 20 + round(unseen_s * 20)
    for k in range(again + 1):
        at_ns, east = k * PERIOD_NS, {1: pose(LEAP * (k == again))} if k < 20 or k == again else {}
        result = fusion.step({"west": view(at_ns, {1: pose(np.zeros(3))}), "east": view(at_ns, east, COVERED)}, at_ns)
    assert result.distrusted == (("east",) if blamed else ())
    assert ("cameras west and east disagree by 50 mm" in result.disagreement) == (not blamed)


def test_a_camera_whose_check_marks_are_off_is_out_at_once_and_back_when_they_are_well_for_a_while() -> None:
    """No robot is seen by both. A doubt in both, from before the marks had told, is the moved one's alone then."""
    fusion, out = CameraFusion(EXPERIMENT), []
    for k in range(100):
        at_ns, moved = k * PERIOD_NS, 20 <= k < 40
        west = {1: pose([-1.0, 0.0, 0.0])} | ({3: pose([0.0, 0.0, 0.0])} if k < 5 else {})
        east = {2: pose([1.0, 0.0, 0.0])} | ({3: pose(LEAP)} if k < 5 else {})
        views = {"west": view(at_ns, west), "east": view(at_ns, east, MOVED if moved else WELL)}
        result = fusion.step(views, at_ns)
        out.append(result.status.out)
        assert (2 in dict(result.poses)) == (out[-1] == ()) and 1 in dict(result.poses)
        if moved:
            assert result.status.message == f"camera east is out: {MOVED.message}"
    assert [k for k in range(100) if out[k]] == list(range(20, 79))
    assert np.sqrt(dict(result.poses)[1].covariance[0, 0]) < 0.003


def test_a_leap_of_all_that_a_camera_measures_is_not_told_until_its_check_marks_can_have_told() -> None:
    """Robots 1 and 2 leap by 0.3 m in west's picture, as when it is bumped; alone, robot 1 does, as one that was carried."""
    leap = np.array([0.3, 0.0, 0.0])
    for leaping, suspects in (((1, 2), {20 + k for k in range(7)}), ((1,), set[int]())):
        fusion, silent = CameraFusion(EXPERIMENT), set()
        for k in range(40):
            west = {r: pose(np.array([-1.0, 0.4 * r, 0.0]) + leap * (k >= 20 and r in leaping)) for r in (1, 2)}
            result = fusion.step({"west": view(k * PERIOD_NS, west), "east": view(k * PERIOD_NS, {})}, k * PERIOD_NS)
            silent |= set() if 1 in dict(result.poses) else {k}
            assert result.status.out == ()
        assert silent <= suspects and bool(silent) == bool(suspects)
        assert fused(result) == pytest.approx([-0.7, 0.4, 0.0])


def test_a_camera_without_check_marks_does_not_wait_for_them_to_tell_a_leap() -> None:
    marks = set(with_camera(EXPERIMENT, "east").check_marks) - set(with_camera(EXPERIMENT, "west").check_marks)
    assert len(marks) == 3
    fusion = CameraFusion(EXPERIMENT.model_copy(update={"check_marks": tuple(marks)}))
    for k in range(24):
        at_ns, leap_m = k * PERIOD_NS, 0.3 * (k >= 20)
        west, east = {1: pose([-1.0 + leap_m, 0.4, 0.0])}, {2: pose([1.0 + leap_m, 0.4, 0.0])}
        result = fusion.step({"west": view(at_ns, west), "east": view(at_ns, east)}, at_ns)
        assert dict(result.poses).keys() == ({1, 2} if k < 20 else {1})


def test_a_bumped_camera_stays_out_while_its_check_marks_are_not_seen() -> None:
    """As when they are covered, and its localizer was started anew and knows nothing of the bump."""
    fusion, out = CameraFusion(EXPERIMENT), []
    for k in range(200):
        at_ns, status = k * PERIOD_NS, MOVED if k < 20 else COVERED if k < 120 else WELL
        result = fusion.step({"west": view(at_ns, {}), "east": view(at_ns, {2: pose([1.0, 0.0, 0.0])}, status)}, at_ns)
        out.append(result.status.out)
    assert [k for k in range(200) if out[k]] == list(range(159))  # back 2 s after its marks are seen


def test_a_gap_between_pictures_is_no_evidence() -> None:
    """A leap of all that a camera measures is not told after it either, and two pictures in contradiction put nobody out."""
    fusion = CameraFusion(EXPERIMENT)
    for k in range(20):
        fusion.step({"west": view(k * PERIOD_NS, {1: pose([-1.0, 0.4, 0.0])})}, k * PERIOD_NS)
    late_ns = 28 * PERIOD_NS
    assert fusion.step({"west": view(late_ns, {1: pose([1.0, 0.4, 0.0])})}, late_ns).poses == ()

    fusion = CameraFusion(EXPERIMENT)
    for at_ns in (*range(0, 21 * PERIOD_NS, PERIOD_NS), 20 * PERIOD_NS + 220_000_000):
        east = pose(10.0 * LEAP * (at_ns >= 20 * PERIOD_NS))
        result = fusion.step({"west": view(at_ns, {1: pose(np.zeros(3))}), "east": view(at_ns, {1: east})}, at_ns)
        assert result.status.out == () and ("east" in result.distrusted) == (at_ns >= 20 * PERIOD_NS)


def test_a_suspicion_begins_anew_when_the_camera_was_silent() -> None:
    fusion, frozen = CameraFusion(EXPERIMENT), LocalizerStatus(camera=CameraHealth.FROZEN)
    for k in range(28):
        at_ns = k * PERIOD_NS
        east = view(at_ns, {}, frozen) if k == 23 else view(at_ns, {1: pose(LEAP * (k >= 20))})
        result = fusion.step({"west": view(at_ns, {1: pose(np.zeros(3))}), "east": east}, at_ns)
        assert result.status.out == (("east",) if k == 23 else ())


def test_a_camera_whose_headings_alone_are_off_is_out_and_the_words_say_so() -> None:
    fusion = CameraFusion(EXPERIMENT)
    for k in range(30):
        at_ns, turned = k * PERIOD_NS, pose([0.0, 0.0, 0.5 * (k >= 20)])
        views = {"west": view(at_ns, {1: pose(np.zeros(3))}), "east": view(at_ns, {1: turned}, COVERED)}
        result = fusion.step(views, at_ns)
        assert fused(result)[2] == pytest.approx(0.0, abs=1e-9)
    why = "camera east is out: it seems to have been moved: its poses are 28.6 deg of heading from those of another camera"
    assert result.status.message == why
    result = CameraFusion(EXPERIMENT).step({"west": view(0, {1: pose(np.zeros(3))}), "east": view(0, {1: turned})}, 0)
    assert result.disagreement == "cameras west and east disagree by 28.6 deg of heading about robot 1"


def test_with_all_cameras_moved_there_are_no_poses() -> None:
    fusion = CameraFusion(EXPERIMENT)
    views = {name: view(0, {1: pose(np.zeros(3))}, MOVED) for name in ("west", "east")}
    result = fusion.step(views, 0)
    assert result.poses == () and result.status.out == ("west", "east")
    assert result.status.message.count("the camera was moved") == 2


def test_cameras_that_never_agreed_are_both_in_doubt_until_they_do() -> None:
    fusion, apart = CameraFusion(EXPERIMENT), np.array([0.04, 0.0, 0.0])
    for k in range(200):
        at_ns, own = k * PERIOD_NS, apart if k < 5 else 0.0 * apart
        views = {"west": view(at_ns, {1: pose(np.zeros(3)), 2: pose([-1.0, 0.0, 0.0])}), "east": view(at_ns, {1: pose(own)})}
        result = fusion.step(views, at_ns)
        if k == 2:
            assert all(np.sqrt(pose.covariance[0, 0]) > 0.03 for _, pose in result.poses)
            assert result.disagreement == "cameras west and east disagree by 40 mm about robot 1"
    assert all(np.sqrt(pose.covariance[0, 0]) < 0.006 for _, pose in result.poses)
    assert result.disagreement == ""


# --- obstacles


def square(x_m: float, y_m: float, side_m: float = 0.2) -> Array:
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * side_m / 2.0
    return np.asarray(np.repeat(corners, 3, axis=0) + np.array([x_m, y_m]))


def test_obstacles_of_all_cameras_are_in_one_list_and_one_that_two_see_is_in_it_once() -> None:
    def told(ids: tuple[int, ...], *outlines: Array) -> Obstacles:
        return Obstacles(ids, np.array(outlines), np.zeros((len(ids), 2)), 0.3, 0.8, "", np.zeros(len(ids)))

    west, east = told((1, 2), square(-1.0, 0.0), square(0.0, 0.3)), told((1, 2), square(0.05, 0.32), square(1.0, 0.0))
    both = fuse_obstacles({"west": west, "east": replace(east, blind="learning")}, ("west", "east"))
    assert both.ids == (2, 4, 5)
    assert both.outline[[0, 2]].mean(axis=1) == pytest.approx(np.array([[-1.0, 0.0], [1.0, 0.0]]))
    assert both.watched == pytest.approx(0.8) and both.blind == "camera east: learning"
    alone = fuse_obstacles({"east": east}, ("west", "east"))
    assert alone.ids == (3, 5) and alone.watched == pytest.approx(0.4)


def box(west_m: float, east_m: float) -> Array:
    """The outline of a box 0.2 m wide, as a detector makes it: some of its corners lie on each other but for rounding."""
    return convex_outline(np.array([[west_m, -0.1], [east_m, -0.1], [east_m, 0.1], [west_m, 0.1]]))


@pytest.mark.parametrize(
    ("west", "east"), [((-0.6, 0.8), (-0.6, 1.4)), ((-1.4, 0.6), (-0.6, 1.4)), ((-0.6, 1.4), (-0.2, 0.9))]
)
def test_an_obstacle_that_leaves_one_picture_is_told_as_far_as_any_camera_sees_it(
    west: tuple[float, float], east: tuple[float, float]
) -> None:
    def told(outline: Array, unseen_s: float = 0.0) -> Obstacles:
        return Obstacles((1,), outline[None], np.zeros((1, 2)), 0.3, 0.8, "", np.array([unseen_s]))

    fused = fuse_obstacles({"west": told(box(*west)), "east": told(box(*east))}, ("west", "east"))
    assert fused.ids == (2,)
    assert [fused.outline[0, :, 0].min(), fused.outline[0, :, 0].max()] == pytest.approx(
        [min(west[0], east[0]), max(west[1], east[1])]
    )
    for k in range(2):  # the one remembers it only, from before the light changed
        ages = [5.0 * (k == 0), 5.0 * (k == 1)]
        fused = fuse_obstacles({"west": told(box(*west), ages[0]), "east": told(box(*east), ages[1])}, ("west", "east"))
        assert fused.unseen_s.tolist() == [0.0]
        assert fused.outline[0] == pytest.approx(box(*(east, west)[k]))


def test_an_obstacle_of_a_camera_that_is_out_stays_with_its_age_until_it_is_too_old_or_seen_by_another() -> None:
    def told(*outlines: Array, unseen_s: float = 0.0) -> Obstacles:
        n = len(outlines)
        seen_s = np.full(n, unseen_s)
        return Obstacles(tuple(range(1, n + 1)), np.array(outlines).reshape(-1, 12, 2), np.zeros((n, 2)), 0.3, 0.8, "", seen_s)

    cameras, west = ("west", "east"), told()
    east = told(square(1.0, 0.0), square(0.0, 0.3), unseen_s=1.0)
    for since_s, ids in ((0.1, (3, 5)), (58.9, (3, 5)), (59.1, ())):
        fused = fuse_obstacles({"west": west}, cameras, {"east": (east, since_s)})
        assert fused.ids == ids and fused.unseen_s == pytest.approx([1.0 + since_s] * len(ids))
        assert fused.watched == pytest.approx(0.4)  # of the working camera alone
    reappeared = fuse_obstacles({"west": told(square(0.05, 0.32))}, cameras, {"east": (east, 5.0)})
    assert reappeared.ids == (2, 3) and reappeared.unseen_s == pytest.approx([0.0, 6.0])

"""The rules of one track: states, identity, gates, and what is published."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from localizer.tracking.observation import TrackMeasurement
from localizer.tracking.robot_track import RobotTrack, close_pairs
from shoal.messages.messages import Track

SIGMA = np.diag([1e-6, 1e-6, 1e-5])
LEVEL = np.zeros((3, 3))  # of a robot that is known not to lean
LOST_AFTER_S = 0.72
JUMP_M = 0.15
STEP_S = 0.05


def _seen(x: float, y: float = 0.0, yaw: float = 0.0, peak: float = 0.0) -> TrackMeasurement:
    return TrackMeasurement(np.array([x, y, yaw]), SIGMA, peak)


def _followed() -> RobotTrack:
    """A robot at rest at the origin whose marker was read for a second."""
    track = RobotTrack()
    for _ in range(20):
        track = track.predicted(STEP_S).with_marker(_seen(0.0), JUMP_M).end_of_frame(LOST_AFTER_S)
    return track


def test_never_seen_is_never_published() -> None:
    track = RobotTrack().predicted(STEP_S).with_match(_seen(0.0, peak=1.0), 0.3).end_of_frame(LOST_AFTER_S)
    assert track.message(0.3, LEVEL) is None and track.state is Track.LOST


def test_the_first_marker_starts_it() -> None:
    pose = _followed().message(0.3, LEVEL)
    assert pose is not None and pose.track is Track.MARKER and pose.identity_verified
    assert pose.covariance == pytest.approx(SIGMA) and pose.depth_m == 0.3


def test_published_is_the_measurement_itself() -> None:
    """No smoothing, no lag: the agent's observer wants white errors."""
    track = _followed().predicted(STEP_S).with_marker(_seen(0.004, -0.003, 0.02), JUMP_M)
    pose = track.message(0.3, LEVEL)
    assert pose is not None and (pose.x_m, pose.y_m, pose.yaw_rad) == pytest.approx((0.004, -0.003, 0.02), abs=1e-12)


def test_a_contradicted_track_does_not_claim_to_know_where_its_robot_is() -> None:
    """Its own marker is read 1 m away, or another robot's where it should be: both places are within one sigma."""
    assert not _followed().doubt(JUMP_M).any()
    elsewhere = _followed().predicted(STEP_S).with_marker(_seen(0.8, 0.6, 0.5), JUMP_M).end_of_frame(LOST_AFTER_S)
    assert elsewhere.state is Track.COAST and elsewhere.doubt(JUMP_M)[0, 0] == pytest.approx(0.64)
    pose = elsewhere.message(0.3, elsewhere.doubt(JUMP_M))
    away = np.array([0.8, 0.6, 0.5])
    assert pose is not None and away @ np.linalg.solve(pose.covariance, away) < 1.01
    assert elsewhere.predicted(STEP_S).end_of_frame(LOST_AFTER_S).doubt(JUMP_M)[0, 1] == pytest.approx(0.48)
    occupied = _followed().predicted(STEP_S).contradicted().end_of_frame(LOST_AFTER_S)
    assert np.diag(occupied.doubt(JUMP_M)) == pytest.approx([JUMP_M**2, JUMP_M**2, 0.0])
    assert not occupied.predicted(STEP_S).with_marker(_seen(0.0), JUMP_M).doubt(JUMP_M)[0, 0] > 1e-4


def test_a_leap_outside_the_gate_is_published_with_its_own_size() -> None:
    """A driver hands out an old picture with a new stamp: where the robot was is no place for a claim of a millimetre. The
    next picture is right, and so is its claim soon."""
    track, away = _followed().predicted(STEP_S), np.array([0.06, 0.0, 0.0])
    stale = track.with_marker(_seen(0.06), JUMP_M).end_of_frame(LOST_AFTER_S)
    pose = stale.message(0.3, LEVEL)
    assert pose is not None and pose.track is Track.MARKER and away @ np.linalg.solve(pose.covariance, away) < 1.01
    for _ in range(3):
        stale = stale.predicted(STEP_S).with_marker(_seen(0.0), JUMP_M).end_of_frame(LOST_AFTER_S)
    pose = stale.message(0.3, LEVEL)
    assert pose is not None and pose.covariance == pytest.approx(SIGMA)


def test_coasts_then_is_lost_then_stays_put() -> None:
    track = _followed().predicted(STEP_S).with_marker(_seen(0.005), JUMP_M).predicted(STEP_S).with_marker(_seen(0.01), JUMP_M)
    states, places = [], []
    for _ in range(20):
        track = track.predicted(STEP_S).end_of_frame(LOST_AFTER_S)
        states.append(track.state)
        assert track.motion is not None
        places.append(track.motion.position_m[0])
    assert states == [Track.COAST] * 14 + [Track.LOST] * 6
    assert places[0] < places[5] < places[14] == places[19]
    assert not track.verified


def test_a_look_must_fit_and_be_where_the_robot_can_be() -> None:
    track = _followed().predicted(STEP_S)
    assert track.with_match(_seen(0.002, peak=0.8), 0.3).state is Track.KCF
    assert track.with_match(_seen(0.002, peak=0.29), 0.3).end_of_frame(LOST_AFTER_S).state is Track.COAST
    assert track.with_match(_seen(0.10, peak=0.9), 0.3).end_of_frame(LOST_AFTER_S).state is Track.COAST
    assert track.with_match(_seen(0.0, yaw=0.5, peak=0.9), 0.3).end_of_frame(LOST_AFTER_S).state is Track.COAST
    assert track.with_match(_seen(0.0, peak=0.29), 0.3).peak == 0.29, "a low peak is reported even if it is not used"


def _matched(track: RobotTrack, places: list[float]) -> RobotTrack:
    """The track after matches at places on the x axis, one a frame; NaN is a frame without."""
    for x in places:
        track = track.predicted(STEP_S)
        track = track if np.isnan(x) else track.with_match(_seen(x, peak=0.7), 0.3)
        track = track.end_of_frame(LOST_AFTER_S)
    return track


def test_a_coasting_robot_is_matched_thrice_in_one_place_before_it_counts() -> None:
    coasting = _matched(_followed(), [np.nan] * 3)
    assert coasting.state is Track.COAST
    assert _matched(coasting, [0.004, 0.004]).state is Track.COAST
    assert _matched(coasting, [0.004, 0.005, 0.004]).state is Track.KCF
    assert _matched(coasting, [0.0, 0.03, 0.0, 0.03, 0.0, 0.03]).state is Track.COAST, "a match that jumps about is no robot's"


def test_matches_of_a_small_robot_need_not_be_steadier_than_they_are() -> None:
    """One of 9 pixels across is matched to 7 mm: three matches that scatter so much are in one place."""
    coasting = _matched(_followed(), [np.nan] * 3)
    for x in (0.0, 0.01, -0.004):
        match = replace(_seen(x, peak=0.7), covariance=np.diag([7e-3, 7e-3, 0.08]) ** 2)
        coasting = coasting.predicted(STEP_S).with_match(match, 0.3).end_of_frame(LOST_AFTER_S)
    assert coasting.state is Track.KCF


def test_the_gate_for_matches_does_not_open_with_the_time_unseen() -> None:
    """After 0.6 s one standard deviation of the prediction is 9 cm; a match 6 cm away is still none."""
    coasting = _matched(_followed(), [np.nan] * 12)
    assert coasting.motion is not None and coasting.motion.position_sigma_m > 0.08
    assert _matched(coasting, [0.06] * 3).state is not Track.KCF


def test_one_wrong_match_hardly_moves_the_velocity() -> None:
    """Three standard deviations off, just inside the gate."""
    track = _followed().predicted(STEP_S)
    wrong = track.with_match(_seen(0.004, peak=0.9), 0.3)
    assert wrong.state is Track.KCF and wrong.motion is not None and track.motion is not None
    assert np.abs(wrong.motion.mean[3:5] - track.motion.mean[3:5]).max() < 0.08
    outside = track.with_match(_seen(0.02, peak=0.9), 0.3)
    assert outside.measured is None and outside.motion is track.motion


def test_a_marker_outranks_a_look() -> None:
    track = _followed().predicted(STEP_S).with_marker(_seen(0.001), JUMP_M).with_match(_seen(0.003, peak=0.9), 0.3)
    pose = track.message(0.3, LEVEL)
    assert pose is not None and pose.track is Track.MARKER and pose.x_m == pytest.approx(0.001) and pose.peak == 0.9


def test_a_lost_robot_is_regained_by_a_good_look_but_not_believed() -> None:
    track = _followed()
    for _ in range(20):
        track = track.predicted(STEP_S).end_of_frame(LOST_AFTER_S)
    assert track.predicted(STEP_S).with_match(_seen(0.05, peak=0.4), 0.3).end_of_frame(LOST_AFTER_S).state is Track.LOST
    assert _matched(track, [0.02, 0.02]).state is Track.LOST
    regained = _matched(track, [0.02, 0.02, 0.02])
    assert regained.state is Track.KCF and not regained.verified
    assert _matched(track, [0.0, 0.01, 0.02]).state is Track.KCF, "it may move: its velocity is not known"
    assert _matched(track, [0.06, 0.06, 0.06]).state is Track.LOST, "the look of a robot nearby is not its own"
    claimed = track.predicted(STEP_S).with_marker(_seen(1.0), JUMP_M).end_of_frame(LOST_AFTER_S)
    assert claimed.state is Track.LOST and not claimed.verified
    marked = claimed.predicted(STEP_S).with_marker(_seen(1.01), JUMP_M).end_of_frame(LOST_AFTER_S)
    assert marked.state is Track.MARKER and marked.verified


def test_a_contradicting_marker_first_doubts_then_wins() -> None:
    track = (
        _followed()
        .predicted(STEP_S)
        .with_marker(_seen(0.8), JUMP_M)
        .with_match(_seen(0.0, peak=0.9), 0.3)
        .end_of_frame(LOST_AFTER_S)
    )
    assert track.state is Track.COAST and not track.verified
    pose = track.message(0.3, LEVEL)
    assert pose is not None and abs(pose.x_m) < 0.01
    track = track.predicted(STEP_S).with_marker(_seen(0.8), JUMP_M).end_of_frame(LOST_AFTER_S)
    pose = track.message(0.3, LEVEL)
    assert pose is not None and pose.identity_verified and pose.x_m == pytest.approx(0.8)


def test_a_scan_claims_what_only_a_region_confirms() -> None:
    """A scan moves no track; a marker read where the robot is, or can be, says nothing new."""
    track = _followed().predicted(STEP_S).with_marker(_seen(0.0), JUMP_M).end_of_frame(LOST_AFTER_S)
    assert track.with_scan(np.array([0.8, 0.0, 0.0]), JUMP_M) is track
    coasting = _followed().predicted(STEP_S).end_of_frame(LOST_AFTER_S)
    assert coasting.with_scan(np.array([0.05, 0.0, 0.0]), JUMP_M) is coasting
    assert coasting.with_scan(np.array([np.nan, 0.0, 0.0]), JUMP_M) is coasting
    elsewhere = coasting.with_scan(np.array([0.8, 0.0, 0.0]), JUMP_M)
    assert elsewhere.state is Track.COAST and not elsewhere.verified and elsewhere.motion is coasting.motion
    again = elsewhere.predicted(STEP_S).end_of_frame(LOST_AFTER_S).with_scan(np.array([0.8, 0.0, 0.0]), JUMP_M)
    assert again.state is Track.COAST, "two scans are not believed either"
    claim = elsewhere.predicted(STEP_S).with_marker(_seen(0.8), JUMP_M)
    assert claim.state is Track.MARKER and claim.verified


def test_a_push_is_no_contradiction() -> None:
    """Or a stamp that is a frame off: the marker counts at once, the speed is learnt anew."""
    track = _followed().predicted(STEP_S).with_marker(_seen(0.06), JUMP_M).end_of_frame(LOST_AFTER_S)
    assert track.state is Track.MARKER and track.verified
    assert track.motion is not None and track.motion.mean[3:] == pytest.approx(0.0)


def test_one_misread_marker_does_not_throw_a_track() -> None:
    track = _followed().predicted(STEP_S).with_marker(_seen(0.8), JUMP_M).end_of_frame(LOST_AFTER_S)
    for verified in (False, True):
        track = track.predicted(STEP_S).with_marker(_seen(0.0), JUMP_M).end_of_frame(LOST_AFTER_S)
        pose = track.message(0.3, LEVEL)
        assert pose is not None and pose.identity_verified is verified and pose.x_m == pytest.approx(0.0, abs=1e-3)


def test_identity_is_doubted_when_robots_touch_until_a_marker_is_read() -> None:
    track = _followed().predicted(STEP_S).with_match(_seen(0.0, peak=0.9), 0.3)
    assert track.verified
    track = track.identity_doubted().end_of_frame(LOST_AFTER_S)
    assert not track.verified
    later = track.predicted(STEP_S).with_match(_seen(0.0, peak=0.9), 0.3).end_of_frame(LOST_AFTER_S)
    assert later.state is Track.KCF and not later.verified, "going apart again is no proof of who is who"
    once = later.predicted(STEP_S).with_marker(_seen(0.0), JUMP_M)
    assert once.state is Track.MARKER and not once.verified, "one reading may be a misreading"
    assert once.predicted(STEP_S).with_marker(_seen(0.0), JUMP_M).verified
    assert _followed().predicted(STEP_S).with_marker(_seen(0.0), JUMP_M).identity_doubted().verified, (
        "the marker is being read all the while"
    )


def test_placed_robots_are_vouched_for() -> None:
    track = RobotTrack.at_start(np.array([0.5, 0.2, 1.0])).predicted(STEP_S).with_match(_seen(0.51, 0.19, 1.05, peak=0.8), 0.3)
    assert track.state is Track.KCF and track.verified


@given(
    steps=st.lists(
        st.tuples(
            st.sampled_from(["nothing", "marker", "look", "doubt", "contradict"]),
            st.floats(-2, 2), st.floats(-2, 2), st.floats(-4, 4), st.floats(0, 1), st.sampled_from([0.0, 0.05, 1.0]),
        ),
        max_size=60,
    )
)  # fmt: skip
def test_any_history_leaves_a_sound_track(steps: list[tuple[str, float, float, float, float, float]]) -> None:
    track = RobotTrack()
    for what, x, y, yaw, peak, step_s in steps:
        track = track.predicted(step_s)
        if what == "marker":
            track = track.with_marker(_seen(x, y, yaw), JUMP_M)
        elif what == "look":
            track = track.with_match(_seen(x, y, yaw, peak), 0.3)
        elif what == "contradict":
            track = track.contradicted()
        if what == "doubt":
            track = track.identity_doubted()
        track = track.end_of_frame(LOST_AFTER_S)
        pose = track.message(0.3, LEVEL)
        if pose is None:
            assert track.state is Track.LOST
            continue
        assert np.all(np.isfinite([pose.x_m, pose.y_m, pose.yaw_rad])) and -np.pi <= pose.yaw_rad < np.pi
        assert np.linalg.eigvalsh(pose.covariance).min() > 0.0
        assert pose.covariance == pytest.approx(pose.covariance.T)
        assert (pose.track is Track.LOST) == (track.state is Track.LOST)
        assert not (pose.track is Track.LOST and pose.identity_verified)
        assert (track.measured is not None) == (pose.track in (Track.KCF, Track.MARKER))


def test_near_pairs_are_found() -> None:
    tracks = [RobotTrack().with_marker(_seen(x), JUMP_M).with_marker(_seen(x), JUMP_M) for x in (0.0, 0.3, 0.9)] + [
        RobotTrack()
    ]
    assert close_pairs(tracks, 0.35) == [(0, 1)]
    assert close_pairs(tracks, 0.65) == [(0, 1), (1, 2)]
    assert close_pairs([RobotTrack()] * 3, 10.0) == []


# --- misreadings


def _doubted_by(what: str) -> RobotTrack:
    """A track of every kind that one reading alone must not move."""
    track = _followed()
    if what == "never seen":
        return RobotTrack()
    if what == "lost":
        for _ in range(20):
            track = track.predicted(STEP_S).end_of_frame(LOST_AFTER_S)
    if what == "near another":
        track = track.predicted(STEP_S).with_match(_seen(0.0, peak=0.9), 0.3).identity_doubted().end_of_frame(LOST_AFTER_S)
    if what == "contradicted":
        track = track.predicted(STEP_S).contradicted().end_of_frame(LOST_AFTER_S)
    return track


@pytest.mark.parametrize("why", ["never seen", "lost", "near another", "contradicted", "verified"])
@pytest.mark.parametrize(
    "second", [_seen(0.8, -0.9), _seen(-1.0, 0.5, 2.0), _seen(1.0, 0.5, 1.5)], ids=["elsewhere", "both", "another heading"]
)
def test_two_misreadings_that_disagree_move_no_track(why: str, second: TrackMeasurement) -> None:
    track = _doubted_by(why)
    before = track.message(0.3, LEVEL)
    for measurement in (_seen(1.0, 0.5), second):
        track = track.predicted(STEP_S).with_marker(measurement, JUMP_M).end_of_frame(LOST_AFTER_S)
        pose = track.message(0.3, LEVEL)
        assert track.state is not Track.MARKER and not track.verified
        if before is None:
            assert pose is None
        else:
            assert pose is not None and np.hypot(pose.x_m - before.x_m, pose.y_m - before.y_m) < 0.01


@pytest.mark.parametrize("why", ["never seen", "lost", "near another", "contradicted", "verified"])
def test_two_readings_that_agree_are_believed(why: str) -> None:
    """The robot swims at 0.4 m/s and turns meanwhile; a frame without a reading lies between."""
    track = _doubted_by(why).predicted(STEP_S).with_marker(_seen(1.0, 0.5, 3.1), JUMP_M).end_of_frame(LOST_AFTER_S)
    track = track.predicted(STEP_S).end_of_frame(LOST_AFTER_S)
    track = track.predicted(STEP_S).with_marker(_seen(1.04, 0.5, -3.08), JUMP_M).end_of_frame(LOST_AFTER_S)
    pose = track.message(0.3, LEVEL)
    assert pose is not None and pose.track is Track.MARKER and pose.identity_verified
    assert (pose.x_m, pose.y_m, pose.yaw_rad) == pytest.approx((1.04, 0.5, -3.08))


def test_a_claim_is_forgotten_after_half_a_second() -> None:
    track = RobotTrack().with_marker(_seen(1.0), JUMP_M)
    for _ in range(11):
        track = track.predicted(STEP_S).end_of_frame(LOST_AFTER_S)
    assert track.with_marker(_seen(1.0), JUMP_M).message(0.3, LEVEL) is None


def test_a_camera_of_one_picture_a_second_confirms_a_claim_too() -> None:
    track = RobotTrack().predicted(1.0).with_marker(_seen(1.0), JUMP_M).predicted(1.0).with_marker(_seen(1.1), JUMP_M)
    assert track.state is Track.MARKER and track.verified


def test_measurement_that_is_not_finite_is_refused() -> None:
    track, nan = _followed().predicted(STEP_S), float("nan")
    bad = [_seen(nan), _seen(0.0, 0.0, nan), _seen(0.0, peak=nan), TrackMeasurement(np.zeros(3), np.full((3, 3), np.inf), 0.9)]
    for measurement in bad:
        assert track.with_marker(measurement, JUMP_M) is track
        assert track.with_match(measurement, 0.3) is track


def test_covariance_of_a_lean_is_published_and_does_not_move_the_track() -> None:
    lean = np.diag([4e-6, 4e-6, 0.0])
    pose = _followed().message(0.3, lean)
    assert pose is not None and pose.covariance == pytest.approx(SIGMA + lean)

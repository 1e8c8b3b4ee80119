"""One robot's track: the belief about it, and the rules by which measurements change that belief. Pure.

States, worst to best: LOST, COAST (predicted only), KCF (its appearance was matched), MARKER (its marker was read). Identity
is verified by markers. It is in doubt from the moment two robots nearly touch, or a marker contradicts the track: a
correlation cannot tell two identical robots apart.

A marker is accepted at once for a verified track, where the robot can be. Everywhere else (a robot never seen, lost, doubted
or contradicted) one reading is a claim: only a second one that agrees with it in position and heading is accepted, and
verifies.

    track before        marker read           in this frame                        next agreeing one
    verified, followed  where it can be       MARKER, verified                     -
    verified, followed  elsewhere             doubted, coasts; the claim is kept   MARKER there, verified
    doubted, followed   where it can be       MARKER, not verified; claim kept     MARKER, verified
    doubted, followed   elsewhere             coasts; the claim is kept            MARKER there, verified
    lost or never seen  anywhere              lost as before; the claim is kept    MARKER there, verified

fleet_localizer.py calls the updates of a frame in this order. A field written in one row is final unless a later row names
it.

    call               condition                                  writes                          does nothing if
    predicted          always                                     state estimate, age; clears     -
                                                                  measured, refuted; ages claim
    with_marker        its marker was read                        measured, state MARKER,         the measurement is not finite
                                                                  verified, claim; or as
                                                                  contradicted, with a claim
    contradicted       another robot's marker was read here       refuted; verified = False       -
    with_match         no marker was read, it is followed,        peak, match; measured,          for all but peak: measured or
                       its appearance was matched                 state KCF                       refuted in this frame, a low
                                                                                                  peak, outside gate or reach;
                                                                                                  for all but match: coasting,
                                                                                                  and not the third steady one
    unverified         its marker is in view twice                verified = False                -
    identity_doubted   another robot is believed close            verified = False                state is MARKER
    end_of_frame       no measurement in this frame               state COAST, or LOST with       measured, or LOST before
                                                                  verified = False
    lost               it coasts out of the pool                  state LOST, verified = False    -
    message            always: the pose of this frame is published; what follows shows in the next frame's
    with_match         it is lost, its appearance was matched     peak, match; measured,          as above, without the gate
                                                                  state KCF
    with_scan          a scan found its marker                    claim; as contradicted          its marker was read, or where
                                                                                                  the robot can be
    with_peak          its marker was read, it is its turn        peak                            the peak is not finite

`identity_doubted` spares the state MARKER, also one of an earlier frame: until `end_of_frame` turns it into COAST a missed
reading is no doubt.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from localizer.tracking.kalman import GATE, KalmanState, initial_state, predict, stopped, update
from localizer.tracking.observation import TrackMeasurement
from shoal.frames import Array, body_to_pool, wrap
from shoal.messages.messages import Pose, Track

_REGAIN_PEAK = 0.5  # least correlation peak that regains a lost robot; higher than for a followed one, which has a prediction
_JUMP_SIGMAS = 3.0
MATCH_GATE = 16.3  # squared Mahalanobis distance: one of 1,000 good matches is outside; a match has no other witness
_MATCH_REACH_M = 0.05  # m, farthest that a match may be from the prediction, however little that is worth after coasting
# A robot that coasts or is lost is matched in so many pictures in a row before it counts, with steady offsets from the
# prediction: a robot accelerates by 0.3 m/s^2 (1 mm from picture to picture), a match that jumps about or slides more.
_MATCHES_NEEDED, _SAME_OFFSET = 3, np.array([0.005, 0.005, 0.05])
_STEADY_SIGMAS = 4.0  # of a match: of a robot 10 px across one match alone is as far off; a change between three adds up
# A claim is dropped when both limits have passed without a second reading. A visible marker is read ten times in 0.5 s; the
# number of pictures leaves time to a slow camera or a busy computer.
_CLAIM_S, _CLAIM_PICTURES = 0.5, 3
# Two readings agree within the error of a reading and the robot's motion in between (its limits are 0.48 m/s, 1.9 rad/s).
_AGREES_M, _AGREES_RAD = 0.03, 0.2
_FASTEST_MPS, _FASTEST_RADPS = 0.6, 2.5
_PLACED_SIGMA = np.array([0.05, 0.05, 0.1])  # m, m, rad, of robots placed by hand


@dataclass(frozen=True)
class Claim:
    """A marker's reading [x, y, yaw] that waits for a second one, its age, and the pictures since."""

    pose: Array
    age_s: float = 0.0
    pictures: int = 0

    def predicted(self, step_s: float) -> "Claim | None":
        """The claim at the next picture; None when it is too old."""
        older = replace(self, age_s=self.age_s + step_s, pictures=self.pictures + 1)
        return None if older.age_s > _CLAIM_S and older.pictures > _CLAIM_PICTURES else older

    def agrees(self, pose: Array) -> bool:
        """True if another reading, now, can be of the same robot."""
        moved_m = float(np.linalg.norm(pose[:2] - self.pose[:2]))
        turned_rad = abs(wrap(float(pose[2] - self.pose[2])))
        near = moved_m <= _AGREES_M + _FASTEST_MPS * self.age_s
        return near and turned_rad <= _AGREES_RAD + _FASTEST_RADPS * self.age_s


@dataclass(frozen=True)
class ProvisionalMatch:
    """Matches in pictures in a row of a robot that coasts or is lost: the last one's offset [x, y, yaw] from the prediction,
    its change since the one before, the time unseen, and their number."""

    offset: Array
    unseen_s: float
    step: Array | None = None
    count: int = 1

    def with_match(self, offset: Array, unseen_s: float, speed_sigma: Array, sigma: Array) -> "ProvisionalMatch":
        """These matches and one more, of standard deviations `sigma` (3,). Counts from one again if the offset changed by more
        than an error of the predicted velocity explains, of standard deviations `speed_sigma` (3,) [m/s, m/s, rad/s], or
        changed unsteadily."""
        step = offset - self.offset
        step[2] = wrap(float(step[2]))
        change_of_step = np.zeros(3) if self.step is None else step - self.step
        match_error = np.maximum(_SAME_OFFSET, _STEADY_SIGMAS * sigma)
        most_step = match_error + (unseen_s - self.unseen_s) * speed_sigma
        is_steady = bool(np.all(np.abs(step) <= most_step) and np.all(np.abs(change_of_step) <= match_error))
        return ProvisionalMatch(offset, unseen_s, step, self.count + 1) if is_steady else ProvisionalMatch(offset, unseen_s)


@dataclass(frozen=True)
class RobotTrack:
    """The belief about one robot. `motion` is None until the robot was first accepted as seen. `measured` and `refuted`
    concern this frame only. `claim` is a marker's reading that is not accepted yet, `match` are matches that are not."""

    motion: KalmanState | None = None
    state: Track = Track.LOST
    verified: bool = False
    unseen_s: float = 0.0
    measured: TrackMeasurement | None = None
    refuted: bool = False
    peak: float = 0.0
    claim: Claim | None = None
    match: ProvisionalMatch | None = None

    @classmethod
    def at_start(cls, pose: Array) -> "RobotTrack":
        """A track without markers: the robot is taken to be at [x, y, yaw], where the experiment starts it, and verified."""
        placed = ProvisionalMatch(np.zeros(3), 0.0, count=_MATCHES_NEEDED - 1)
        return cls(motion=initial_state(pose, np.diag(_PLACED_SIGMA**2)), state=Track.COAST, verified=True, match=placed)

    def predicted(self, step_s: float, elapsed_s: float | None = None) -> "RobotTrack":
        """The track at the next exposure, its motion predicted over `step_s`. A lost robot stays where it was last believed.
        `elapsed_s`: the time since the last exposure, where it is longer."""
        moving = self.motion is not None and self.state is not Track.LOST
        motion = predict(self.motion, step_s) if self.motion is not None and moving else self.motion
        claim = None if self.claim is None else self.claim.predicted(step_s)
        unseen_s = self.unseen_s + (step_s if elapsed_s is None else elapsed_s)
        return replace(self, motion=motion, unseen_s=unseen_s, measured=None, refuted=False, claim=claim)

    def with_marker(self, measurement: TrackMeasurement, jump_m: float) -> "RobotTrack":
        """The track after its marker was read, as in the table above.

        A reading farther than `jump_m` from where a followed track can be contradicts it. A nearer one may be right whatever
        the prediction was (a push), or be of an old picture: outside the gate the velocity is reset, and the leap enters the
        covariance of this frame's pose.
        """
        if not measurement.finite:
            return self
        agreed = self.claim is not None and self.claim.agrees(measurement.pose)
        if self._is_reachable(measurement.pose, jump_m):
            assert self.motion is not None
            verified_now = self.verified or agreed
            updated, squared = update(self.motion, measurement.pose, measurement.covariance)
            claim = None if verified_now else Claim(measurement.pose)
            if squared <= GATE:
                return self._measured(measurement, updated, Track.MARKER, verified_now, claim)
            leap = measurement.pose - self.motion.mean[:3]
            leap[2] = wrap(float(leap[2]))
            doubted = replace(measurement, covariance=measurement.covariance + np.outer(leap, leap))
            anew = initial_state(measurement.pose, measurement.covariance)
            return self._measured(doubted, anew, Track.MARKER, verified_now, claim)
        if agreed:
            return self._measured(measurement, None, Track.MARKER, verified=True, claim=None)
        return replace(self.contradicted(), claim=Claim(measurement.pose))

    def _is_reachable(self, pose: Array, jump_m: float) -> bool:
        """True if a pose is near enough to the predicted place of a followed robot to be the same robot."""
        if self.motion is None or self.state is Track.LOST:
            return False
        moved_m = float(np.linalg.norm(pose[:2] - self.motion.position_m))
        return moved_m <= jump_m + _JUMP_SIGMAS * self.motion.position_sigma_m

    def contradicted(self) -> "RobotTrack":
        """The track after another marker ruled its position out: nothing else counts in this frame."""
        return replace(self, verified=False, refuted=True)

    def at_stamp(self, measurement: TrackMeasurement, late_s: float) -> TrackMeasurement:
        """A measurement in a row of the picture that was exposed `late_s` after its stamp, carried back to the stamp."""
        if late_s == 0.0:
            return measurement
        motion = self.motion or initial_state(measurement.pose, measurement.covariance)
        pose = measurement.pose - late_s * motion.mean[3:]
        pose[2] = wrap(float(pose[2]))
        return replace(measurement, pose=pose, covariance=measurement.covariance + late_s**2 * motion.covariance[3:, 3:])

    def at_row(self, pose: Array, late_s: float) -> Array:
        """A pose at the stamp carried to a row of the picture that was exposed `late_s` after it."""
        return pose if late_s == 0.0 or self.motion is None else pose + late_s * self.motion.mean[3:]

    def with_match(self, measurement: TrackMeasurement, least_peak: float) -> "RobotTrack":
        """The track after its appearance was matched: a measurement if no marker was read, the peak suffices and the gate
        holds."""
        if not measurement.finite:
            return self
        matched = replace(self, peak=measurement.peak, match=None)
        if self.motion is None or self.measured is not None or self.refuted:
            return matched
        lost = self.state is Track.LOST
        if measurement.peak <= (max(least_peak, _REGAIN_PEAK) if lost else least_peak):
            return matched
        updated, squared = update(self.motion, measurement.pose, measurement.covariance)
        offset = measurement.pose - self.motion.mean[:3]
        offset[2] = wrap(float(offset[2]))
        if (squared > MATCH_GATE and not lost) or float(np.hypot(offset[0], offset[1])) > _MATCH_REACH_M:
            return matched
        if self.state in (Track.COAST, Track.LOST):
            speed_sigma = np.sqrt(np.diag(self.motion.covariance)[3:])
            before = self.match
            first = ProvisionalMatch(offset, self.unseen_s)
            sigma = np.sqrt(np.diag(measurement.covariance))
            match = first if before is None else before.with_match(offset, self.unseen_s, speed_sigma, sigma)
            if match.count < _MATCHES_NEEDED:
                return replace(matched, match=match)
        return matched._measured(measurement, None if lost else updated, Track.KCF, self.verified, self.claim)

    def with_scan(self, pose: Array, jump_m: float) -> "RobotTrack":
        """The track after a scan found its marker at [x, y, yaw]: a claim, unless the robot's own region covers the place."""
        seen_here = self.state is Track.MARKER or self._is_reachable(pose, jump_m)
        if seen_here or not np.isfinite(pose).all():
            return self
        return replace(self.contradicted(), claim=Claim(pose))

    def with_peak(self, peak: float) -> "RobotTrack":
        """The track with the correlation peak of its appearance where the marker was read."""
        return replace(self, peak=peak) if np.isfinite(peak) else self

    def identity_doubted(self) -> "RobotTrack":
        """The track when another robot nearly touches it: not verified, unless its state is MARKER."""
        return self if self.state is Track.MARKER else replace(self, verified=False)

    def unverified(self) -> "RobotTrack":
        """The track of a robot whose marker is in view twice: it may be the other one."""
        return replace(self, verified=False)

    def end_of_frame(self, lost_after_s: float) -> "RobotTrack":
        """The track after all updates: without a measurement it coasts, and after `lost_after_s` of that it is lost."""
        if self.motion is None or self.measured is not None or self.state is Track.LOST:
            return self
        return self.lost() if self.unseen_s > lost_after_s else replace(self, state=Track.COAST)

    def lost(self) -> "RobotTrack":
        """The track when its robot is given up: it stays where it was last believed."""
        return self if self.motion is None else replace(self, motion=stopped(self.motion), state=Track.LOST, verified=False)

    def message(self, depth_m: float, tilt_covariance: Array, plate_m: tuple[float, float] = (0.0, 0.0)) -> Pose | None:
        """The pose to publish, None before the first accepted measurement.

        It is the bare measurement with its own covariance, which adds no lag and leaves errors white for the agent's
        observer. Only gaps are filled by prediction. The track follows the plate, the pose is the robot's centre: `plate_m`
        is the plate's place ahead and to starboard of it, and `tilt_covariance` (3, 3) what is not known of that.
        """
        if self.motion is None:
            return None
        pose, covariance = self.motion.mean[:3], self.motion.covariance[:3, :3]
        if self.measured is not None:
            pose, covariance = self.measured.pose, self.measured.covariance
        x_m, y_m = (pose[:2] - body_to_pool(plate_m, float(pose[2]))).tolist()
        return Pose(
            x_m=x_m, y_m=y_m, yaw_rad=wrap(float(pose[2])), covariance=covariance + tilt_covariance,
            track=self.state, identity_verified=self.verified, peak=self.peak, depth_m=depth_m,
        )  # fmt: skip

    def doubt(self, hull_m: float) -> Array:
        """Covariance (3, 3) of [x, y, yaw] of a track that a marker contradicts: its robot may be where its own marker was
        read, or has to be the hull's radius `hull_m` away from another robot's."""
        if self.motion is None or self.measured is not None or (self.claim is None and not self.refuted):
            return np.zeros((3, 3))
        if self.claim is None:
            return np.diag([hull_m**2, hull_m**2, 0.0])
        away = self.claim.pose - self.motion.mean[:3]
        away[2] = wrap(float(away[2]))
        return np.outer(away, away)

    def _measured(
        self, measurement: TrackMeasurement, motion: KalmanState | None, state: Track, verified: bool, claim: Claim | None
    ) -> "RobotTrack":
        """The track after a measurement that is believed; with `motion` None the state estimate starts anew from it."""
        motion = initial_state(measurement.pose, measurement.covariance) if motion is None else motion
        return RobotTrack(motion, state, verified, 0.0, measurement, self.refuted, self.peak, claim)


def close_pairs(tracks: Sequence[RobotTrack], distance_m: float) -> list[tuple[int, int]]:
    """Index pairs (i < j) of robots believed closer than `distance_m`; a lost robot counts where it was last seen."""
    places = [(i, track.motion.position_m.tolist()) for i, track in enumerate(tracks) if track.motion is not None]
    return [(i, j) for n, (i, a) in enumerate(places) for j, b in places[n + 1 :] if math.dist(a, b) < distance_m]

"""One robot's track: what is believed of it, and the rules by which sightings change that belief. Pure.

States, worst to best: LOST, COAST (predicted only), KCF (its look was found), MARKER (its marker was read). Identity is
verified by markers, and doubted from the moment two robots nearly touch, or a marker contradicts the track: a correlation
cannot tell two identical robots apart.

Of a verified track a marker is believed at once where the robot can be. Everywhere else (a robot never seen, lost, doubted or
contradicted) one reading is a claim: only a second one that agrees with it in place and heading is believed, and verifies.

    track before        marker read           in this frame                        next agreeing one
    verified, followed  where it can be       MARKER, verified                     -
    verified, followed  elsewhere             doubted, coasts; the claim is kept   MARKER there, verified
    doubted, followed   where it can be       MARKER, not verified; claim kept     MARKER, verified
    doubted, followed   elsewhere             coasts; the claim is kept            MARKER there, verified
    lost or never seen  anywhere              lost as before; the claim is kept    MARKER there, verified
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from localizer.tracking.kalman import GATE, Motion, begin, predict, rest, surprise, update
from localizer.tracking.observation import Measurement
from wire.frames import Array, wrap
from wire.messages.messages import Pose, Track

_REGAIN_PEAK = 0.5  # a lost robot's look must fit better than a followed one's: nothing else says that it is there
_JUMP_SIGMAS = 3.0
# A claim that is not confirmed by then is forgotten: a marker is read ten times in that time, or is covered. A slow camera, or
# a computer that is held up, has some pictures to confirm it in.
_CLAIM_S, _CLAIM_PICTURES = 0.5, 3
# Two readings agree within the errors of a reading, and what a robot can do between them (its limits are 0.48 m/s, 1.9 rad/s).
_AGREES_M, _AGREES_RAD = 0.03, 0.2
_FASTEST_MPS, _FASTEST_RADPS = 0.6, 2.5
_PLACED_SIGMA = np.array([0.05, 0.05, 0.1])  # m, m, rad: how well people put a robot on its start


@dataclass(frozen=True)
class Claim:
    """A marker's reading [x, y, yaw] that waits for a second one, its age, and the pictures since."""

    pose: Array
    age_s: float = 0.0
    pictures: int = 0

    def advanced(self, step_s: float) -> "Claim | None":
        """At the next picture; None when it is too old."""
        older = replace(self, age_s=self.age_s + step_s, pictures=self.pictures + 1)
        return None if older.age_s > _CLAIM_S and older.pictures > _CLAIM_PICTURES else older

    def agrees(self, pose: Array) -> bool:
        """Whether another reading, now, is of the same robot."""
        moved_m = float(np.linalg.norm(pose[:2] - self.pose[:2]))
        turned_rad = abs(wrap(float(pose[2] - self.pose[2])))
        near = moved_m <= _AGREES_M + _FASTEST_MPS * self.age_s
        return near and turned_rad <= _AGREES_RAD + _FASTEST_RADPS * self.age_s


@dataclass(frozen=True)
class RobotTrack:
    """The belief. `motion` is None until the robot was first believed to be seen. `measured` and `refuted` are about this
    frame only. `claim` is a marker's reading that is not believed yet."""

    motion: Motion | None = None
    state: Track = Track.LOST
    verified: bool = False
    unseen_s: float = 0.0
    measured: Measurement | None = None
    refuted: bool = False
    peak: float = 0.0
    claim: Claim | None = None

    @classmethod
    def placed(cls, pose: Array) -> "RobotTrack":
        """Without markers: taken to be where the experiment says it starts, [x, y, yaw]; whoever put it there vouches."""
        return cls(motion=begin(pose, np.diag(_PLACED_SIGMA**2)), state=Track.COAST, verified=True)

    def advanced(self, step_s: float) -> "RobotTrack":
        """Predicted to the next exposure. A lost robot stays where it was last believed."""
        moving = self.motion is not None and self.state is not Track.LOST
        motion = predict(self.motion, step_s) if self.motion is not None and moving else self.motion
        claim = None if self.claim is None else self.claim.advanced(step_s)
        return replace(self, motion=motion, unseen_s=self.unseen_s + step_s, measured=None, refuted=False, claim=claim)

    def read(self, seen: Measurement, jump_m: float) -> "RobotTrack":
        """Its marker was read; the table above says what follows. Farther than `jump_m` from where a followed track can be,
        the reading contradicts it. Nearer, the marker is right whatever the prediction was (a push, a stamp off by a frame):
        only the speed is forgotten."""
        if not seen.finite:
            return self
        agreed = self.claim is not None and self.claim.agrees(seen.pose)
        if self._can_be_at(seen.pose, jump_m):
            assert self.motion is not None
            sure = self.verified or agreed
            anew = surprise(self.motion, seen.pose, seen.covariance) > GATE
            claim = None if sure else Claim(seen.pose)
            return replace(self._taken(seen, anew), state=Track.MARKER, verified=sure, claim=claim)
        if agreed:
            return replace(self._taken(seen, anew=True), state=Track.MARKER, verified=True, claim=None)
        return replace(self.contradicted(), claim=Claim(seen.pose))

    def _can_be_at(self, pose: Array, jump_m: float) -> bool:
        if self.motion is None or self.state is Track.LOST:
            return False
        moved_m = float(np.linalg.norm(pose[:2] - self.motion.position_m))
        return moved_m <= jump_m + _JUMP_SIGMAS * self.motion.position_sigma_m

    def contradicted(self) -> "RobotTrack":
        """A marker says that this robot is not where it is believed: in this frame nothing else counts."""
        return replace(self, verified=False, refuted=True)

    def found(self, seen: Measurement, least_peak: float) -> "RobotTrack":
        """Its look was found again: a measurement, unless a marker spoke, if it fits well enough where the robot can be."""
        if not seen.finite:
            return self
        looked = replace(self, peak=seen.peak)
        if self.motion is None or self.measured is not None or self.refuted:
            return looked
        lost = self.state is Track.LOST
        enough = max(least_peak, _REGAIN_PEAK) if lost else least_peak
        if seen.peak <= enough or (not lost and surprise(self.motion, seen.pose, seen.covariance) > GATE):
            return looked
        return replace(looked._taken(seen, anew=lost), state=Track.KCF)

    def doubted(self) -> "RobotTrack":
        """Another robot nearly touches this one: doubted, but for a marker that is read in this very frame."""
        return self if self.state is Track.MARKER else replace(self, verified=False)

    def settled(self, lost_after_s: float) -> "RobotTrack":
        """End of the frame: without a measurement it coasts, and after `lost_after_s` of that it is lost."""
        if self.motion is None or self.measured is not None or self.state is Track.LOST:
            return self
        if self.unseen_s > lost_after_s:
            return replace(self, motion=rest(self.motion), state=Track.LOST, verified=False)
        return replace(self, state=Track.COAST)

    def message(self, depth_m: float, lean: Array) -> Pose | None:
        """What is published, None before the first sighting: the bare measurement with its own covariance, which adds no
        lag and leaves the errors white for the agent's observer. Only gaps are filled by prediction. `lean` (3, 3) is added:
        what the track follows is the plate, what is published is the robot's centre."""
        if self.motion is None:
            return None
        pose, covariance = self.motion.mean[:3], self.motion.covariance[:3, :3]
        if self.measured is not None:
            pose, covariance = self.measured.pose, self.measured.covariance
        return Pose(
            x_m=float(pose[0]), y_m=float(pose[1]), yaw_rad=wrap(float(pose[2])), covariance=covariance + lean,
            track=self.state, identity_verified=self.verified, peak=self.peak, depth_m=depth_m,
        )  # fmt: skip

    def _taken(self, seen: Measurement, anew: bool) -> "RobotTrack":
        if anew or self.motion is None:
            motion = begin(seen.pose, seen.covariance)
        else:
            motion = update(self.motion, seen.pose, seen.covariance)
        return replace(self, motion=motion, unseen_s=0.0, measured=seen)


def near_pairs(tracks: Sequence[RobotTrack], distance_m: float) -> list[tuple[int, int]]:
    """Index pairs (i < j) of robots believed closer than `distance_m`; a lost robot is believed where it was last seen."""
    known = [(i, track.motion.position_m) for i, track in enumerate(tracks) if track.motion is not None]
    return [(i, j) for n, (i, a) in enumerate(known) for j, b in known[n + 1 :] if float(np.linalg.norm(a - b)) < distance_m]

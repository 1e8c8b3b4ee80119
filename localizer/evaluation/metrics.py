"""Error metrics of a localizer with known truth. Pure; localizer/evaluation/runner.py reads the files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaincinv

from shoal.frames import Array, wrap
from shoal.messages.messages import Pose, Track

_LONGEST_GAP_S = 0.5  # s; truth is not interpolated across a longer gap
_BAND = (0.025, 0.975)
_COMPONENTS = 3  # of an error: x, y, yaw


@dataclass(frozen=True)
class PoseRow:
    """Errors of a group of poses.

    Position errors are distances. NEES is the mean of e' P^-1 e over x, y, yaw: 3 if the published covariances are right,
    and inside the band 95 % of the time if errors are independent from frame to frame (a wrong depth or calibration makes
    them dependent).
    """

    subject: str
    poses: int
    rms_mm: float
    p95_mm: float
    max_mm: float
    rms_deg: float
    max_deg: float
    nees: float
    nees_low: float
    nees_high: float
    swapped: int  # nearer to another robot's true position than to the own one
    unflagged: int  # swapped, and published as verified


@dataclass(frozen=True, eq=False)
class GroundTruthTrajectory:
    """A robot's true trajectory: instants (n,) in ns, rising, and [x, y, yaw] (n, 3), NaN where it is not known."""

    stamp_ns: Array
    pose: Array

    def at(self, stamp_ns: int) -> Array | None:
        """The pose at an instant: linear in between, None outside, across gaps and where it is not known."""
        pose = self._interpolated(stamp_ns)
        return pose if pose is not None and np.all(np.isfinite(pose)) else None

    def _interpolated(self, stamp_ns: int) -> Array | None:
        """The true pose at an instant, between two known ones that are not far apart; None elsewhere."""
        after = int(np.searchsorted(self.stamp_ns, stamp_ns))
        if after < len(self.stamp_ns) and self.stamp_ns[after] == stamp_ns:
            return np.array(self.pose[after])
        if not 0 < after < len(self.stamp_ns):
            return None
        start_ns, end_ns = float(self.stamp_ns[after - 1]), float(self.stamp_ns[after])
        if end_ns - start_ns > _LONGEST_GAP_S * 1e9:
            return None
        step = self.pose[after] - self.pose[after - 1]
        step[2] = wrap(step[2])
        return np.asarray(self.pose[after - 1] + step * (stamp_ns - start_ns) / (end_ns - start_ns))


@dataclass(frozen=True, eq=False)
class PublishedPose:
    """A published pose of a robot: by one of several cameras, or fused from theirs or by the only one ("")."""

    robot: int
    stamp_ns: int
    pose: Pose
    camera: str = ""


@dataclass(frozen=True, eq=False)
class _PoseError:
    """Error of one pose: x, y, yaw (3,), its square in units of the covariance, and the swap flag."""

    measured: PublishedPose
    error: Array
    nees: float
    swapped: bool


def pose_rows(poses: Sequence[PublishedPose], truth: Mapping[int, GroundTruthTrajectory]) -> list[PoseRow]:
    """Rows for every robot, every state of a track, and all together. LOST poses count only in their own row, as they are
    where the robot was last seen. Poses without a truth are left out."""
    errors = [error for error in (_error(pose, truth) for pose in poses) if error is not None]
    tracked_errors = [e for e in errors if e.measured.pose.track is not Track.LOST]
    groups = {f"robot {robot}": [e for e in tracked_errors if e.measured.robot == robot] for robot in sorted(truth)}
    groups |= {
        track.name.lower(): [e for e in errors if e.measured.pose.track is track] for track in sorted(Track, reverse=True)
    }
    groups["all but lost"] = tracked_errors
    return [_pose_row(subject, group) for subject, group in groups.items() if group]


def camera_rows(poses: Sequence[PublishedPose], truth: Mapping[int, GroundTruthTrajectory]) -> list[PoseRow]:
    """Rows of a run with several cameras; none of one with a single camera.

    Of each camera; of the fused poses by how many cameras measured them; and of how their error changes from one to the next,
    where those cameras stay the same and where they change: the step that a hand-over makes. Its NEES is with the sum of both
    covariances.
    """
    measured: dict[int, dict[str, list[int]]] = {}
    for pose in poses:
        if pose.camera and pose.pose.track >= Track.KCF:
            measured.setdefault(pose.robot, {}).setdefault(pose.camera, []).append(pose.stamp_ns)
    if not measured:
        return []
    pictures = {robot: {name: np.unique(stamps) for name, stamps in each.items()} for robot, each in measured.items()}
    groups: dict[str, list[_PoseError]] = {}
    last: dict[int, tuple[set[str], _PoseError]] = {}
    for pose in sorted(poses, key=lambda pose: pose.stamp_ns):
        error = _error(pose, truth)
        if error is None or pose.pose.track is Track.LOST:
            continue
        if pose.camera:
            groups.setdefault(f"camera {pose.camera}", []).append(error)
            continue
        each = pictures.get(pose.robot, {})
        seen_by = {camera for camera, stamps_ns in each.items() if _has_picture(stamps_ns, pose.stamp_ns)}
        groups.setdefault(f"seen by {len(seen_by)}", []).append(error)
        before = last.get(pose.robot)
        if before is not None:
            same = "same cameras" if before[0] == seen_by else "hand-over"
            groups.setdefault(f"step, {same}", []).append(_change(before[1], error))
        last[pose.robot] = seen_by, error
    return [_pose_row(subject, group) for subject, group in sorted(groups.items())]


def _has_picture(stamps_ns: Array, at_ns: int) -> bool:
    """True if the nearest of a camera's pictures is less than half of the time between two of them away: stamps of several
    clocks agree to some milliseconds, and cameras need not expose at one instant."""
    period_ns = float(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else 0.0
    return bool(2.0 * np.min(np.abs(stamps_ns - at_ns)) < max(period_ns, 1.0))


def _change(before: _PoseError, after: _PoseError) -> _PoseError:
    """The change of a robot's error from one pose to the next."""
    change = after.error - before.error
    change[2] = wrap(change[2])
    covariance = before.measured.pose.covariance + after.measured.pose.covariance
    return replace(after, error=change, nees=_nees(change, covariance), swapped=False)


def _error(published: PublishedPose, truth: Mapping[int, GroundTruthTrajectory]) -> _PoseError | None:
    """Error of a published pose; None where the truth is not known. Swapped: nearer to another robot than to its own."""
    true = truth[published.robot].at(published.stamp_ns) if published.robot in truth else None
    if true is None:
        return None
    pose = published.pose
    error = np.array([pose.x_m - true[0], pose.y_m - true[1], wrap(pose.yaw_rad - true[2])])
    others = (path.at(published.stamp_ns) for robot, path in truth.items() if robot != published.robot)
    place = np.array([pose.x_m, pose.y_m])
    own_m = float(np.linalg.norm(error[:2]))
    swapped = any(float(np.linalg.norm(place - other[:2])) < own_m for other in others if other is not None)
    return _PoseError(published, error, _nees(error, pose.covariance), swapped)


def _nees(error: Array, covariance: Array) -> float:
    """e' P^-1 e; NaN for a matrix that is no covariance."""
    try:
        half = np.linalg.solve(np.linalg.cholesky(covariance), error)
    except np.linalg.LinAlgError:
        return float("nan")
    return float(half @ half)


def _pose_row(subject: str, group: Sequence[_PoseError]) -> PoseRow:
    """Row of the pose table: errors in mm and degrees, and NEES with its 95 % band."""
    errors = np.array([e.error for e in group])
    distance_mm = 1e3 * np.linalg.norm(errors[:, :2], axis=1)
    turn_deg = np.degrees(np.abs(errors[:, 2]))
    nees_values = np.array([e.nees for e in group])
    usable = nees_values[np.isfinite(nees_values)]
    count = max(len(usable), 1)
    # A quantile of chi-square: scipy.stats has it by name, and takes a quarter of a second to load.
    low, high = (2.0 * float(gammaincinv(_COMPONENTS * count / 2.0, share)) / count for share in _BAND)
    return PoseRow(
        subject=subject,
        poses=len(group),
        rms_mm=float(np.sqrt(np.mean(distance_mm**2))),
        p95_mm=float(np.quantile(distance_mm, 0.95)),
        max_mm=float(np.max(distance_mm)),
        rms_deg=float(np.sqrt(np.mean(turn_deg**2))),
        max_deg=float(np.max(turn_deg)),
        nees=float(np.mean(usable)) if len(usable) else float("nan"),
        nees_low=low,
        nees_high=high,
        swapped=sum(e.swapped for e in group),
        unflagged=sum(e.swapped and e.measured.pose.identity_verified for e in group),
    )

"""Fusion of what several cameras over one pool tell of its robots, by covariance. Pure.

    each camera's newest poses -> carried to one instant -> cameras that were moved taken out, doubt in others that disagree
    -> covariance intersection -> poses

Errors of two cameras about one robot are alike to a degree that is not known: both know its depth and its lean from the same
sensors, and look at one marker through one water. So no average may claim to be better than its best part. Covariance
intersection holds that for any correlation (Julier and Uhlmann, 1997), with the weights of Niehsen (2002), which change
steadily while a robot crosses from one picture into the other:

    P^-1 = sum w_k P_k^-1    x = P sum w_k P_k^-1 x_k    w_k = (1 / trace P_k) / sum (1 / trace P_j), of x and y

To P the scatter of the parts is added, sum w_k (x_k - x)(x_k - x)': cameras whose calibrations do not agree claim less.
Two cameras that are further apart than their covariances allow disagree. A camera that was within a robot's motion and has
left it, while the other has not, seems to have been moved (camera_bumps.py): its poses do not count. Otherwise both are in
doubt: the square of their distance is added to the covariances of all their poses, and the operator is told.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from localizer.detection.blob_tracker import convex_outline
from localizer.sources.base import silent_after_s
from localizer.tracking.camera_bumps import CameraBumps, Evidence
from localizer.tracking.check_marks import with_camera
from localizer.tracking.kalman import GATE, KalmanState, initial_state, predict, update
from shoal.config.experiment import Experiment
from shoal.frames import Array, wrap
from shoal.messages.messages import CameraHealth, LocalizerStatus, Obstacles, Pose, Track
from shoal.messages.obstacle_memory import ages_s

_FOLLOWED_S = 1.0  # s after which a camera that has not been within a robot's motion is not said to have left it
_LONGEST_STEP = 2.0  # periods between pictures that count against a camera or for it; a longer gap proves nothing more
_FORGET_S = 2.0  # s in which the square of a doubt falls to 1/e once the cameras agree again
_FORGET_ALONE_S = 10.0  # s of the same while no robot is seen by two of them: one misread marker costs no more
_REMEMBERED_S = 60.0  # s for which an obstacle of a camera that is out counts: longer bars a place that is free again
_ROUNDING_M2 = 1e-9  # m^2, of a product of two distances within an outline
_TOLD_DOUBT_M = 0.005  # m, least doubt in the poses that the operator is told of


@dataclass(frozen=True, eq=False)
class CameraView:
    """All that one camera's localizer told of one picture, exposed at `instant_ns`: its status, and poses by robot."""

    instant_ns: int
    status: LocalizerStatus
    poses: Mapping[int, Pose]


@dataclass(frozen=True, eq=False)
class FusionResult:
    """Poses (robot id, pose) at one instant of all robots that a new picture tells of, the status of all cameras, which of
    them disagree, in words, and the names of those whose obstacles do not count either."""

    poses: tuple[tuple[int, Pose], ...]
    status: LocalizerStatus
    disagreement: str
    distrusted: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A camera's pose of a robot at the instant of fusion: mean (3,) and covariance (3, 3) of [x, y, yaw]."""

    camera: str
    message: Pose
    mean: Array
    covariance: Array


class CameraFusion:
    """The fusion of all cameras of an experiment: call `step` in the order of the instants."""

    def __init__(self, experiment: Experiment) -> None:
        self._names, self._robots = experiment.camera_names, experiment.robot_ids
        rate_hz = experiment.all_cameras[0].rate_hz
        self._out_after_s, self._longest_step_s = silent_after_s(rate_hz), _LONGEST_STEP / rate_hz
        self._motions: dict[int, KalmanState] = {}
        self._last: dict[int, Pose] = {}
        self._doubts = {name: np.zeros((3, 3)) for name in self._names}  # added to the covariances of a camera's poses
        self._bumps = CameraBumps(self._names)
        self._marked = frozenset(name for name in self._names if with_camera(experiment, name).check_marks)
        self._within_s: dict[tuple[str, int], float] = {}  # since a camera was within the motion of a robot
        self._known_ns = dict.fromkeys(self._names, -1)  # instant of each camera's last view
        self._instant_ns: int | None = None
        self._frames = 0

    def step(self, views: Mapping[str, CameraView], instant_ns: int) -> FusionResult:
        """Fuse the newest views of the cameras that were heard, by name, at an instant that is not before any of theirs."""
        self._frames += 1
        step_s = 0.0 if self._instant_ns is None else max(instant_ns - self._instant_ns, 0) * 1e-9
        self._instant_ns = instant_ns
        self._motions = {robot: predict(motion, step_s) for robot, motion in self._motions.items()}
        # Which cameras count, and which of those have seen something new
        unusable = {name: why for name in self._names if (why := self._trouble(views.get(name), instant_ns))}
        usable_views = {name: view for name, view in views.items() if name not in unusable}
        renewed = {name for name, view in usable_views.items() if view.instant_ns > self._known_ns[name]}
        self._known_ns |= {name: view.instant_ns for name, view in views.items()}
        candidates = {robot: self._candidates(robot, usable_views, instant_ns) for robot in self._robots}
        doubts = self._doubt(candidates, usable_views, step_s)
        if distrusted := self._bumps.distrusted:  # what the poses themselves have shown
            renewed -= distrusted
            usable_views = {name: view for name, view in usable_views.items() if name not in distrusted}
            candidates = {robot: self._candidates(robot, usable_views, instant_ns) for robot in self._robots}
        poses = []
        for robot, robot_candidates in candidates.items():
            if any(candidate.camera in renewed for candidate in robot_candidates):
                poses.append((robot, self._fused(robot, robot_candidates)))
            elif not robot_candidates and robot in self._last and any(robot in usable_views[name].poses for name in renewed):
                poses.append((robot, self._lost(robot)))
        unwell, unusable = len(unusable), unusable | self._bumps.out
        status = self._status(views, unusable, unwell, doubts, poses)
        return FusionResult(tuple(poses), status, "; ".join(doubts), tuple({*unusable, *distrusted}))

    def _trouble(self, view: CameraView | None, instant_ns: int) -> str:
        """The reason why a camera gives no poses; empty if it does."""
        if view is None:
            return "not heard yet"
        if view.status.camera is not CameraHealth.OK:
            return view.status.message or view.status.camera.name.lower().replace("_", " ")
        age_s = (instant_ns - view.instant_ns) * 1e-9
        return f"its last picture is more than {self._out_after_s:g} s old" if age_s > self._out_after_s else ""

    def _candidates(self, robot: int, views: Mapping[str, CameraView], instant_ns: int) -> list[_Candidate]:
        """The poses of a robot to fuse: measured ones if there are any, and among these those with a verified identity."""
        poses = {name: pose for name, view in views.items() if (pose := view.poses.get(robot)) is not None}
        tracked = {n: pose for n, pose in poses.items() if pose.track is not Track.LOST and _is_covariance(pose.covariance)}
        best = [name for name, pose in tracked.items() if pose.track >= Track.KCF] or list(tracked)
        best = [name for name in best if tracked[name].identity_verified] or best
        return [self._carried(robot, name, tracked[name], (instant_ns - views[name].instant_ns) * 1e-9) for name in best]

    def _carried(self, robot: int, camera: str, pose: Pose, later_s: float) -> _Candidate:
        """A pose some time after its exposure, by the velocity that the fused poses show."""
        here = initial_state(np.array([pose.x_m, pose.y_m, pose.yaw_rad]), np.array(pose.covariance))
        motion = self._motions.get(robot)
        if motion is not None:
            here.mean[3:], here.covariance[3:, 3:] = motion.mean[3:], motion.covariance[3:, 3:]
        there = predict(here, later_s) if later_s > 0.0 else here
        return _Candidate(camera, pose, there.mean[:3], there.covariance[:3, :3])

    def _doubt(
        self, candidates: Mapping[int, Sequence[_Candidate]], views: Mapping[str, CameraView], step_s: float
    ) -> list[str]:
        """Judge the cameras by the robots that two of them measure, and by their check marks: which were moved, and which are
        in doubt. Returns what to tell the operator."""
        was_out = set(self._bumps.out)
        doubts = list[str]()  # in words
        doubted = dict[str, Array]()  # covariance of each camera that is in doubt
        agreed = set[str]()  # cameras with which another one agrees,
        backed = set[str]()  # or one that was not out
        alone_apart = dict[str, tuple[float, str]]()  # of a camera that is alone at fault, the worst
        stayed, leapt = set[str](), set[str]()  # cameras by what they measure of the robots whose motion they have followed
        for robot, robot_candidates in candidates.items():
            measured = [c for c in robot_candidates if c.message.track >= Track.KCF]
            followed, within = self._follow(robot, measured, step_s)
            stayed |= followed & within
            leapt |= followed - within
            for one, other in combinations(measured, 2):
                pair = {one.camera, other.camera}
                apart = _difference(one.mean, other.mean)
                covariance = one.covariance + other.covariance
                squared = _squared(apart, covariance)
                if squared <= GATE:
                    agreed |= pair
                    if other.camera not in was_out:
                        backed.add(one.camera)
                    if one.camera not in was_out:
                        backed.add(other.camera)
                    continue
                words = _in_words(apart, covariance)
                # The fault is one camera's alone if it was out before, or if the other one still fits the robot's motion
                suspects = (pair & was_out or pair & followed - within) - self._bumps.proven
                if len(suspects) == 1 and (suspects <= was_out or pair & within):
                    (suspect,) = suspects
                    alone_apart[suspect] = max((squared, words), alone_apart.get(suspect, (0.0, "")))
                    continue
                doubts.append(f"cameras {one.camera} and {other.camera} disagree by {words} about robot {robot}")
                away_m2 = float(apart[:2] @ apart[:2])
                grown = np.diag([away_m2, away_m2, apart[2] ** 2])
                for name in pair:
                    doubted[name] = np.maximum(doubted.get(name, grown), grown)
        moved = {name: view.status.message for name, view in views.items() if view.status.moved}
        evidence = Evidence(
            moved=moved,
            in_place=frozenset(name for name, view in views.items() if view.status.marks_seen and name not in moved),
            apart={name: words for name, (_, words) in alone_apart.items()},
            leapt=self._marked & leapt - stayed,
            agreed=frozenset(backed),
        )
        self._bumps.step(views.keys(), evidence, min(step_s, self._longest_step_s))
        if set(self._bumps.out) - was_out:  # theirs is the fault, and nobody else's
            self._doubts = {name: np.zeros((3, 3)) for name in self._names}
            doubted = {}
        for name in self._names:
            kept = self._doubts[name] * math.exp(-step_s / (_FORGET_S if name in agreed else _FORGET_ALONE_S))
            self._doubts[name] = np.maximum(kept, doubted.get(name, kept))
        return doubts or self._doubts_in_words()

    def _doubts_in_words(self) -> list[str]:
        """A sentence about a disagreement that is over, while its doubt is in the poses."""
        sigmas_m = {name: math.sqrt(doubt[0, 0]) for name, doubt in self._doubts.items()}
        doubted = {name: sigma_m for name, sigma_m in sigmas_m.items() if sigma_m > _TOLD_DOUBT_M}
        if not doubted:
            return []
        return [f"cameras {' and '.join(doubted)} disagreed: their poses are in doubt by {1e3 * max(doubted.values()):.0f} mm"]

    def _follow(self, robot: int, measured: Sequence[_Candidate], step_s: float) -> tuple[set[str], set[str]]:
        """Note which cameras measure a robot within the gate of its predicted motion. Returns, of those that measure it, the
        cameras that did so within the last _FOLLOWED_S, and those that do so now."""
        names = {candidate.camera for candidate in measured}
        followed = {name for name in names if self._within_s.get((name, robot), math.inf) <= _FOLLOWED_S}
        within = {candidate.camera for candidate in measured if not self._left_motion(robot, candidate)}
        for name in self._names:
            since_s = self._within_s.get((name, robot), math.inf) + step_s
            self._within_s[name, robot] = 0.0 if name in within else since_s
        return followed, within

    def _left_motion(self, robot: int, candidate: _Candidate) -> bool:
        """True if a camera's pose is outside the gate of the robot's predicted motion, or there is no prediction."""
        motion = self._motions.get(robot)
        if motion is None:
            return True
        return _squared(_difference(candidate.mean, motion.mean[:3]), candidate.covariance + motion.covariance[:3, :3]) > GATE

    def _fused(self, robot: int, candidates: Sequence[_Candidate]) -> Pose:
        """One pose of those that several cameras have of a robot, by covariance intersection."""
        parts = [(candidate.mean, candidate.covariance + self._doubts[candidate.camera]) for candidate in candidates]
        mean, covariance = covariance_intersection(parts)
        best = max((candidate.message for candidate in candidates), key=lambda pose: (pose.track, pose.peak))
        if best.track >= Track.KCF:
            motion, squared = update(self._motions[robot], mean, covariance) if robot in self._motions else (None, 0.0)
            is_consistent = motion is not None and squared <= GATE
            self._motions[robot] = motion if motion is not None and is_consistent else initial_state(mean, covariance)
        x_m, y_m, yaw_rad = mean.tolist()
        verified = any(candidate.message.identity_verified for candidate in candidates)
        fused = replace(best, x_m=x_m, y_m=y_m, yaw_rad=yaw_rad, covariance=covariance, identity_verified=verified)
        self._last[robot] = fused
        return fused

    def _lost(self, robot: int) -> Pose:
        """A robot that no camera follows: where it was."""
        self._motions.pop(robot, None)
        return replace(self._last[robot], track=Track.LOST, identity_verified=False)

    def _status(
        self,
        views: Mapping[str, CameraView],
        out: Mapping[str, str],
        unwell: int,
        doubts: Sequence[str],
        poses: Sequence[tuple[int, Pose]],
    ) -> LocalizerStatus:
        """One status for all cameras, with a sentence for each that is out. `unwell`: number of cameras that are out or in
        trouble."""
        statuses = [view.status for view in views.values()]
        bad = [status.camera for status in statuses if status.camera is not CameraHealth.OK]
        lost = [str(robot) for robot, pose in poses if pose.track is Track.LOST]
        parts = [f"camera {name} is out: {why}" for name, why in out.items()]
        parts += [f"camera {n}: {view.status.message}" for n, view in views.items() if n not in out and view.status.message]
        parts += [*doubts, *([f"lost: robot {', '.join(lost)}"] if lost else [])]
        return LocalizerStatus(
            camera=CameraHealth.OK if unwell < len(self._names) else max(bad, default=CameraHealth.ABSENT),
            frames=self._frames,
            dropped=sum(status.dropped for status in statuses),
            frame_ms=max((status.frame_ms for status in statuses), default=0.0),
            message="; ".join(parts),
            robots=tuple(robot for robot, _ in poses),
            failed=sum(status.failed for status in statuses),
            out=tuple(out),
        )


def covariance_intersection(parts: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Mean (3,) and covariance (3, 3) of [x, y, yaw] from those of several estimates whose errors may be correlated."""
    if len(parts) == 1:
        return parts[0]
    means = [mean for mean, _ in parts]
    covariances = [covariance for _, covariance in parts]
    precisions = np.array([1.0 / np.trace(covariance[:2, :2]) for covariance in covariances])  # of the place alone
    weights = precisions / precisions.sum()
    information = [weight * np.linalg.inv(covariance) for weight, covariance in zip(weights, covariances, strict=True)]
    covariance = np.linalg.inv(np.sum(information, axis=0))
    first = means[0]  # the others count as differences from it, for angles cannot be averaged
    pull = np.sum([info @ _difference(mean, first) for info, mean in zip(information, means, strict=True)], axis=0)
    mean = first + covariance @ pull
    mean[2] = wrap(float(mean[2]))
    differences = np.array([_difference(each, mean) for each in means])
    scatter = (weights * differences.T) @ differences
    return mean, 0.5 * (covariance + covariance.T) + scatter


class _FusedObstacle(NamedTuple):
    """A row of the fused list."""

    number: int
    outline: Array  # (12, 2) m
    velocity: Array  # (2,) m/s
    unseen_s: float


def fuse_obstacles(
    by_camera: Mapping[str, Obstacles], cameras: Sequence[str], before: Mapping[str, tuple[Obstacles, float]] | None = None
) -> Obstacles:
    """The obstacles of all cameras in one list, from those of the cameras that see. One that two of them see is in it once,
    with an outline around both: either picture may end within it. Numbers stay apart: that of camera k of n is n times its
    own plus k. `before`: the last lists of the cameras that are out, with their ages in s: what they saw stays in the list
    with its age, and those who read it let it grow. What is not seen now goes when a camera sees something there."""
    before = before or {}
    number_of = {name: k for k, name in enumerate(cameras)}
    lists = [(number_of[name], by_camera[name], 0.0) for name in cameras if name in by_camera]
    lists += [(number_of[name], *before[name]) for name in cameras if name in before]
    sightings: list[list[_FusedObstacle]] = []
    memories: list[list[_FusedObstacle]] = []
    for k, obstacles, since_s in lists:
        rows = zip(obstacles.ids, obstacles.outline, obstacles.velocity, ages_s(obstacles, since_s), strict=True)
        own = [_FusedObstacle(number * len(cameras) + k, *row) for number, *row in rows]
        sightings.append([row for row in own if row.unseen_s == 0.0])
        memories.append([row for row in own if row.unseen_s > 0.0 and (row.unseen_s <= _REMEMBERED_S or since_s == 0.0)])
    fused: list[_FusedObstacle] = []
    for own in sightings:
        earlier = len(fused)
        for row in own:
            same = next((i for i in range(earlier) if _is_same(row, fused[i])), None)
            if same is None:
                fused.append(row)
            else:
                around = convex_outline(np.vstack([fused[same].outline, row.outline]))
                fused[same] = fused[same]._replace(outline=around)
    for own in memories:
        earlier = len(fused)
        fused += [row for row in own if not any(_is_same(row, other) for other in fused[:earlier])]
    return Obstacles(
        ids=tuple(obstacle.number for obstacle in fused),
        outline=np.array([obstacle.outline for obstacle in fused]).reshape(-1, 12, 2),
        velocity=np.array([obstacle.velocity for obstacle in fused]).reshape(-1, 2),
        depth_m=next((obstacles.depth_m for obstacles in by_camera.values()), 0.0),
        watched=sum(obstacles.watched for obstacles in by_camera.values()) / len(cameras),
        blind="; ".join(f"camera {name}: {obstacles.blind}" for name, obstacles in by_camera.items() if obstacles.blind),
        unseen_s=np.array([obstacle.unseen_s for obstacle in fused]),
    )


def _is_same(one: _FusedObstacle, other: _FusedObstacle) -> bool:
    """True if the middle of either lies in the other."""
    middles = one.outline.mean(axis=0), other.outline.mean(axis=0)
    return _inside(middles[0], other.outline) or _inside(middles[1], one.outline)


def _inside(point: Array, outline: Array) -> bool:
    """True if a point (2,) lies in a convex outline (n, 2) whose corners go from x to y. Corners of a rectangle's outline lie
    on each other, but for rounding."""
    along, to = np.roll(outline, -1, axis=0) - outline, point - outline
    return bool(np.all(along[:, 0] * to[:, 1] - along[:, 1] * to[:, 0] >= -_ROUNDING_M2))


def _difference(one: Array, other: Array) -> Array:
    """one - other of two poses [x, y, yaw], with the heading's wrapped."""
    away = one - other
    away[2] = wrap(float(away[2]))
    return away


def _in_words(apart: Array, covariance: Array) -> str:
    """The part of a difference (3,) that its covariance explains least: of the places, or of the headings."""
    turned = apart[2] ** 2 / covariance[2, 2] > _squared(apart[:2], covariance[:2, :2])
    return f"{abs(np.degrees(apart[2])):.1f} deg of heading" if turned else f"{np.hypot(*apart[:2]) * 1e3:.0f} mm"


def _is_covariance(matrix: Array) -> bool:
    """False for a matrix that is not positive definite, which a message may hold."""
    return bool(np.linalg.eigvalsh(matrix)[0] > 0.0)


def _squared(away: Array, covariance: Array) -> float:
    """Squared Mahalanobis distance."""
    return float(away @ np.linalg.solve(covariance, away))

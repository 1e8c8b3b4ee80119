"""Appearance models of the robots: two correlation filters each, one for position and one for heading, and its texture."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from localizer.detection.correlation_filter import CorrelationFilter, FilterShape, Real
from localizer.detection.image_regions import BodySampler, DemosaicedRegion, RobotShape
from localizer.tracking.alignment import align
from localizer.tracking.observation import COVERED_NOISE, LOOKS_NOISE, MeasurementNoise, PredictedView
from shoal.frames import Array, body_to_pool, wrap

_SPAN = 0.9  # side of the patch over the robot's diameter; wider ones show the rim, and errors grow from 0.3 to 2.5 mm
_RING_REACH = 0.85  # outermost ring over the robot's radius; the rim beyond is hidden on one side when seen obliquely
_TARGET_WIDTH = 2.5  # samples, both filters
# Kernel widths. With narrow ones (Henriques' 0.5) the peak falls to zero as soon as a cable lies over the marker, though it is
# still in the right place. With these a robot half covered keeps 0.6 and 0.3, and bare water gives 0.2 and 0.1.
_PLACE_KERNEL = 1.0
_TURN_KERNEL = 2.0
_LEAST_TURN_PEAK = 0.2  # peak of the heading filter; a heading found with less is not used
_AVERAGED_PX = 1.3  # px between samples; wider patches are taken from a picture at half scale
_CORRELATED = 4.0  # variance of an aligned pose over that of independent samples: ripples and caustics move them together
_SAMPLINGS, _NEAR_SHIFT = 2, 0.5  # of a patch for its alignment; no second one is made where it moved by fewer samples
_USED = 1.5  # values of a sample that an alignment uses, half the samples in three colours; a pixel measures one
_FAR_SHIFT = 1.5  # samples; the window biases a peak by 4.5 % of its shift, so a larger shift is measured a second time


@dataclass(frozen=True)
class Recognition:
    """Limits of an alignment beyond which a robot is not recognised: the least share of the learnt texture and the least gain
    (the largest is its inverse); the noise of a match, beside what its pixels tell; and the number of updates over which the
    texture is averaged."""

    share: float
    gain: float
    noise: MeasurementNoise
    memory: float


# With less of the texture a pattern may be another one, or the same turned by a right angle; with any gain a grey card is a
# faint robot.
LEARNT_AT_MARKERS = Recognition(share=0.5, gain=0.6, noise=COVERED_NOISE, memory=33.0)
# An appearance that is learnt at poses of its own fits worse on its way round the robot's heading: a robot in sight shows 0.59
# of it at least, at a contrast of 0.71 to 1.21. A refusal also ends the learning, so that the robot would stay lost. With a
# short memory the texture creeps over the hull (4 mm in 30 s of `open-water`).
LEARNT_AT_MATCHES = Recognition(share=0.4, gain=0.6, noise=LOOKS_NOISE, memory=400.0)


@dataclass(frozen=True)
class Match:
    """Pose [x, y, yaw] at which a robot's appearance was found, the covariance (3, 3) that the pixels give it, and the peak of
    the position filter clipped to 0..1; peak 0 if the robot was not recognised there."""

    pose: Array
    covariance: Array
    peak: float


class AppearanceModel:
    """Appearances of all robots, learnt and matched in one batch. Poses are [x, y, yaw] in the pool frame."""

    def __init__(self, count: int, hull: RobotShape, template_px: int, recognition: Recognition) -> None:
        pitch_m = 2.0 * hull.radius_m * _SPAN / template_px
        self._sampler = BodySampler(template_px, pitch_m, _RING_REACH * hull.radius_m, hull)
        channels = self._sampler.channels
        patches = FilterShape(template_px, template_px, channels, _TARGET_WIDTH, _PLACE_KERNEL, windowed=True)
        self._place = CorrelationFilter(count, patches)
        rings = FilterShape(1, self._sampler.angles, self._sampler.ring_channels, _TARGET_WIDTH, _TURN_KERNEL, windowed=False)
        self._turn = CorrelationFilter(count, rings)
        self.recognition = recognition
        self._learnt = np.zeros(count, dtype=np.bool_)
        self._texture = np.zeros((count, channels, template_px, template_px), np.float32)  # the learnt patches
        self._weights = np.zeros((count, template_px, template_px), np.float32)  # sums of weights, of each sample
        self.reach_m = _SPAN * hull.radius_m  # half the diagonal of a patch, rounded up to its side

    def is_initialised(self, robot: int) -> bool:
        """True once the robot's appearance has been learnt."""
        return bool(self._learnt[robot])

    def match(self, views: Sequence[PredictedView], poses: Sequence[Array]) -> list[Match]:
        """Match each view's robot, which must be initialised, near the pose given: first its place, by filters of what is seen
        from above, then its heading, then both by an alignment that begins at the given pose, or else at the matched one."""
        if not views:
            return []
        robots, colours = _robot_indices(views), self._colours(views)
        matched_poses = np.array(poses)
        for _ in range(2):
            shifts, peaks = self._place.detect(robots, self._patches(views, colours, matched_poses))
            matched_poses[:, :2] += body_to_pool(shifts * self._sampler.pitch_m, matched_poses[:, 2])
            if np.max(np.abs(shifts)) < _FAR_SHIFT:
                break
        turns, turn_peaks = self._turn.detect(robots, self._rings(views, colours, matched_poses))
        matched_poses[:, 2] += turns[:, 0] * (2.0 * np.pi / self._sampler.angles)
        place_peaks, verified_peaks = np.clip(peaks, 0.0, 1.0).tolist(), _verified(peaks, turn_peaks).tolist()
        return [
            self._aligned(view, colours[i], [(poses[i], place_peaks[i]), (matched_poses[i], verified_peaks[i])])
            for i, view in enumerate(views)
        ]

    def _aligned(self, view: PredictedView, colour: DemosaicedRegion, starts: Sequence[tuple[Array, float]]) -> Match:
        """The match where the robot's texture is seen again, by an alignment from the first of some `starts` (pose and peak)
        that leads there; with peak 0 if none does.

        From the predicted pose the heading is known. Where the correlation lies its own filter has to recognise it.
        """
        limits = self.recognition
        for start, peak in starts:
            pose, covariance, share, gain = self._align(view, colour, start)
            if share > limits.share and limits.gain <= gain <= 1.0 / limits.gain:
                repeated = _USED / (self._sampler.pitch_m * view.tangent.px_per_m) ** 2
                return Match(pose, max(repeated, 1.0) * _CORRELATED / share * covariance, peak)
        return Match(pose, np.zeros((3, 3)), 0.0)

    def _align(self, view: PredictedView, colour: DemosaicedRegion, start: Array) -> tuple[Array, Array, float, float]:
        """Pose, covariance (3, 3), share of the texture and gain of an alignment that begins at a pose."""
        pose, covariance, move, to_pool = start.copy(), np.empty((3, 3)), np.zeros(4), np.eye(3)
        for _ in range(_SAMPLINGS):
            body = view.body(pose)
            weights = self._sampler.facing(body) * (self._weights[view.robot] > 0.0)
            share = align(self._texture[view.robot], self._sampler.patch(colour, body), weights, move, covariance)
            to_pool[:2, :2] = self._sampler.pitch_m * body_to_pool(view.body_to_level[:2, :2].T, float(pose[2])).T
            pose = pose + to_pool @ move[:3]
            if np.max(np.abs(move[:2])) < _NEAR_SHIFT:
                break
        pose[2] = wrap(float(pose[2]))
        return pose, to_pool @ covariance @ to_pool.T, share, float(move[3])

    def update(self, views: Sequence[PredictedView], poses: Sequence[Array], rates: Array) -> list[float]:
        """Peaks of the robots' appearances at known poses, as in `Match`; then blend in what is seen there at `rates` (n,).

        Rate 0 learns nothing. A robot that is not initialised has peak 0, and is learnt from this view alone.
        """
        if not views:
            return []
        robots, colours, at = _robot_indices(views), self._colours(views), np.array(poses)
        patches, rings = self._patches(views, colours, at), self._rings(views, colours, at)
        blend = np.where(self._learnt[robots], rates, np.sign(rates)).astype(np.float32)
        _, peaks = self._place.detect_and_learn(robots, patches, blend)
        _, turn_peaks = self._turn.detect_and_learn(robots, rings, blend)
        for view, patch, pose, rate in zip(views, patches, poses, rates.tolist(), strict=True):
            if rate > 0.0:
                self._learn_texture(view.robot, patch, self._sampler.facing(view.body(pose)))
        self._learnt[robots] |= rates > 0.0
        return [float(peak) for peak in _verified(peaks, turn_peaks)]

    def _learn_texture(self, robot: int, patch: Real, weights: Real) -> None:
        """Average the patch into the texture where it was seen: all pictures alike at first, older ones less later."""
        self._weights[robot] = np.minimum(self._weights[robot] + weights, self.recognition.memory).astype(np.float32)
        share = np.divide(weights, self._weights[robot], out=np.zeros_like(weights), where=weights > 0.0)
        self._texture[robot] += np.minimum(share, 1.0) * (patch - self._texture[robot])

    def _colours(self, views: Sequence[PredictedView]) -> list[DemosaicedRegion]:
        """Demosaiced regions, at half scale where samples lie farther apart than pixels."""
        apart_px = [self._sampler.pitch_m * view.tangent.px_per_m for view in views]
        return [view.region.demosaiced(2 if apart > _AVERAGED_PX else 1) for view, apart in zip(views, apart_px, strict=True)]

    def _patches(self, views: Sequence[PredictedView], colours: Sequence[DemosaicedRegion], poses: Array) -> Real:
        return np.stack([self._sampler.patch(c, s.body(p)) for c, s, p in zip(colours, views, poses, strict=True)])

    def _rings(self, views: Sequence[PredictedView], colours: Sequence[DemosaicedRegion], poses: Array) -> Real:
        return np.stack([self._sampler.rings(c, s.body(p)) for c, s, p in zip(colours, views, poses, strict=True)])


def _verified(peaks: Array, turn_peaks: Array) -> Array:
    """Peaks of the position filter (n,), clipped to 0..1; 0 where the heading filter did not recognise the robot."""
    return np.where(turn_peaks > _LEAST_TURN_PEAK, np.clip(peaks, 0.0, 1.0), 0.0)


def _robot_indices(views: Sequence[PredictedView]) -> NDArray[np.intp]:
    return np.array([view.robot for view in views], dtype=np.intp)

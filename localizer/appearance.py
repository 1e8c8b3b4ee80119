"""What each robot looks like from above: two correlation filters per robot, one for place and one for heading."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from localizer.kcf import CorrelationFilter, FilterShape, Real
from localizer.patch import Pixels, Sampler
from localizer.sight import Sight
from wire.frames import Array, body_to_pool, wrap

_SPAN = 1.4  # side of the patch over the robot's diameter: the cosine window leaves about half of it in view
_RING_REACH = 0.85  # of the robot's radius: its rim moves against the plate when seen from the side
_TARGET_WIDTH = 2.5  # samples, both filters
_FAR_SHIFT = 1.5  # samples; the window pulls a peak back by 4.5 % of the shift, so a larger one is looked at again


@dataclass(frozen=True)
class Match:
    """Where a robot's look was found again: pose [x, y, yaw], and the lower of both filters' peaks, clipped to 0..1."""

    pose: Array
    peak: float


class Appearance:
    """Looks of all robots, learnt and found in one batch. Poses are [x, y, yaw] in the pool frame."""

    def __init__(self, count: int, radius_m: float, template_px: int) -> None:
        self._sampler = Sampler(template_px, 2.0 * radius_m * _SPAN / template_px, _RING_REACH * radius_m)
        channels = self._sampler.channels
        self._place = CorrelationFilter(count, FilterShape(template_px, template_px, channels, _TARGET_WIDTH, windowed=True))
        rings = FilterShape(1, self._sampler.angles, self._sampler.ring_channels, _TARGET_WIDTH, windowed=False)
        self._turn = CorrelationFilter(count, rings)
        self._learnt = np.zeros(count, dtype=np.bool_)
        self.reach_m = _SPAN * radius_m  # what a filter sees of a robot's surroundings

    def knows(self, robot: int) -> bool:
        """The robot's look has been learnt."""
        return bool(self._learnt[robot])

    def find(self, sights: Sequence[Sight], poses: Sequence[Array]) -> list[Match]:
        """Each robot (its look known) near the pose given."""
        if not sights:
            return []
        robots, halves = _robots(sights), _halves(sights)
        found = np.array(poses)
        for _ in range(2):
            shifts, peaks = self._place.detect(robots, self._patches(sights, halves, found))
            found[:, :2] += body_to_pool(shifts * self._sampler.pitch_m, found[:, 2])
            if np.max(np.abs(shifts)) < _FAR_SHIFT:
                break
        turns, turn_peaks = self._turn.detect(robots, self._rings(sights, halves, found))
        found[:, 2] += turns[:, 0] * (2.0 * np.pi / self._sampler.angles)
        lower = np.clip(np.minimum(peaks, turn_peaks), 0.0, 1.0)
        return [Match(np.array([x, y, wrap(yaw)]), float(peak)) for (x, y, yaw), peak in zip(found, lower, strict=True)]

    def learn(self, sights: Sequence[Sight], poses: Sequence[Array], rate: float) -> None:
        """Blend in how robots look at these poses; one whose look is not known yet is learnt from this sight alone."""
        if not sights:
            return
        robots, halves, at = _robots(sights), _halves(sights), np.array(poses)
        rates = np.where(self._learnt[robots], rate, 1.0).astype(np.float32)
        self._place.learn(robots, self._patches(sights, halves, at), rates)
        self._turn.learn(robots, self._rings(sights, halves, at), rates)
        self._learnt[robots] = True

    def _patches(self, sights: Sequence[Sight], halves: Sequence[Pixels], poses: Array) -> Real:
        return np.stack([self._sampler.patch(h, s.region, s.body(p)) for h, s, p in zip(halves, sights, poses, strict=True)])

    def _rings(self, sights: Sequence[Sight], halves: Sequence[Pixels], poses: Array) -> Real:
        return np.stack([self._sampler.rings(h, s.region, s.body(p)) for h, s, p in zip(halves, sights, poses, strict=True)])


def _robots(sights: Sequence[Sight]) -> NDArray[np.intp]:
    return np.array([sight.robot for sight in sights], dtype=np.intp)


def _halves(sights: Sequence[Sight]) -> list[Pixels]:
    return [sight.region.colour_half() for sight in sights]

"""What each robot looks like from above: two correlation filters per robot, one for place and one for heading."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from localizer.detection.correlation_filter import CorrelationFilter, FilterShape, Real
from localizer.detection.image_regions import Colour, Hull, Sampler
from localizer.tracking.observation import Sight
from wire.frames import Array, body_to_pool, wrap

_SPAN = 0.9  # side of the patch over the robot's diameter: wider ones see the rim, and errors grow tenfold (0.3 to 2.5 mm)
_RING_REACH = 0.85  # of the robot's radius: the rim beyond is hidden on one side when seen obliquely
_TARGET_WIDTH = 2.5  # samples, both filters
# Kernel widths: narrow ones (Henriques' 0.5) drop to nothing as soon as a cable lies over the marker, though the peak is
# still in the right place. With these a robot half covered keeps 0.6 and 0.3, and bare water gives 0.2 and 0.1.
_PLACE_KERNEL = 1.0
_TURN_KERNEL = 2.0
_LEAST_TURN_PEAK = 0.2  # below it the heading is a guess, whatever the place filter says
_AVERAGED_PX = 1.3  # samples farther apart are taken from a picture at half scale
_FAR_SHIFT = 1.5  # samples; the window pulls a peak back by 4.5 % of the shift, so a larger one is looked at again


@dataclass(frozen=True)
class Match:
    """Where a robot's look was found again: pose [x, y, yaw], and the peak of the place filter clipped to 0..1; 0 if the
    heading was not recognised."""

    pose: Array
    peak: float


class Appearance:
    """Looks of all robots, learnt and found in one batch. Poses are [x, y, yaw] in the pool frame."""

    def __init__(self, count: int, hull: Hull, template_px: int) -> None:
        pitch_m = 2.0 * hull.radius_m * _SPAN / template_px
        self._sampler = Sampler(template_px, pitch_m, _RING_REACH * hull.radius_m, hull)
        channels = self._sampler.channels
        patches = FilterShape(template_px, template_px, channels, _TARGET_WIDTH, _PLACE_KERNEL, windowed=True)
        self._place = CorrelationFilter(count, patches)
        rings = FilterShape(1, self._sampler.angles, self._sampler.ring_channels, _TARGET_WIDTH, _TURN_KERNEL, windowed=False)
        self._turn = CorrelationFilter(count, rings)
        self._learnt = np.zeros(count, dtype=np.bool_)
        self.reach_m = _SPAN * hull.radius_m  # what a filter sees of a robot's surroundings

    def knows(self, robot: int) -> bool:
        """The robot's look has been learnt."""
        return bool(self._learnt[robot])

    def find(self, sights: Sequence[Sight], poses: Sequence[Array]) -> list[Match]:
        """Each robot (its look known) near the pose given."""
        if not sights:
            return []
        robots, colours = _robots(sights), self._colours(sights)
        found = np.array(poses)
        for _ in range(2):
            shifts, peaks = self._place.detect(robots, self._patches(sights, colours, found))
            found[:, :2] += body_to_pool(shifts * self._sampler.pitch_m, found[:, 2])
            if np.max(np.abs(shifts)) < _FAR_SHIFT:
                break
        turns, turn_peaks = self._turn.detect(robots, self._rings(sights, colours, found))
        found[:, 2] += turns[:, 0] * (2.0 * np.pi / self._sampler.angles)
        sure = np.where(turn_peaks > _LEAST_TURN_PEAK, np.clip(peaks, 0.0, 1.0), 0.0)
        return [Match(np.array([x, y, wrap(yaw)]), float(peak)) for (x, y, yaw), peak in zip(found, sure, strict=True)]

    def learn(self, sights: Sequence[Sight], poses: Sequence[Array], rate: float) -> None:
        """Blend in how robots look at these poses; one whose look is not known yet is learnt from this sight alone."""
        if not sights:
            return
        robots, colours, at = _robots(sights), self._colours(sights), np.array(poses)
        rates = np.where(self._learnt[robots], rate, 1.0).astype(np.float32)
        self._place.learn(robots, self._patches(sights, colours, at), rates)
        self._turn.learn(robots, self._rings(sights, colours, at), rates)
        self._learnt[robots] = True

    def _colours(self, sights: Sequence[Sight]) -> list[Colour]:
        """Averaged where samples lie farther apart than pixels."""
        apart_px = [self._sampler.pitch_m * sight.tangent.px_per_m for sight in sights]
        return [sight.region.colour(2 if apart > _AVERAGED_PX else 1) for sight, apart in zip(sights, apart_px, strict=True)]

    def _patches(self, sights: Sequence[Sight], colours: Sequence[Colour], poses: Array) -> Real:
        return np.stack([self._sampler.patch(c, s.body(p)) for c, s, p in zip(colours, sights, poses, strict=True)])

    def _rings(self, sights: Sequence[Sight], colours: Sequence[Colour], poses: Array) -> Real:
        return np.stack([self._sampler.rings(c, s.body(p)) for c, s, p in zip(colours, sights, poses, strict=True)])


def _robots(sights: Sequence[Sight]) -> NDArray[np.intp]:
    return np.array([sight.robot for sight in sights], dtype=np.intp)

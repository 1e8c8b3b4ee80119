"""Tracking of one object in plain pictures, in pixels: the correlation filters without pool, marker and gates. Pure.

For recordings of an unknown camera, and to compare the filters with other trackers. The patch turns
with the object: a second filter, over rings around its centre, tells how far. On a real animal that turns this is 0.7 px off
(median); a patch that keeps its heading is 2.8 px off, at two thirds of the processor time.
"""

import numpy as np

from localizer.detection.correlation_filter import CorrelationFilter, FilterShape, Real
from localizer.detection.image_regions import BodyProjection, BodySampler, DemosaicedRegion, Pixels, RobotShape
from shoal.frames import Array

_SAMPLES = 40  # across the box
_RING_REACH = 0.45  # outermost ring over the box
_TARGET_WIDTH, _TURN_WIDTH = 2.1, 2.5  # samples, of the patch and of the rings
_KERNEL_WIDTH, _TURN_KERNEL_WIDTH = 1.0, 2.0
_LEAST_TURN_PEAK = 0.2  # of the rings' filter; a turn found with less is not used
_TURN_EVERY = 2  # pictures between measured turns; a turn costs as much as a place, and in every picture it gains nothing
_LEARN_EVERY = 8  # pictures between updates, each of which costs as much as detecting
_LEARNING_RATE = 0.08  # per update
_FAR_SHIFT = 1.5  # samples; the window biases a shift towards zero, so a larger one is measured a second time
_SPEED_MEMORY = 0.5  # share of the old velocity per picture
_TURN_MEMORY = 0.98  # of the old turn rate: without a loss small errors of the rings add up to a rate that there is not
_FLAT = RobotShape(radius_m=0.0, top_m=0.0, plate_half_m=np.inf)
_ONE = np.zeros(1, dtype=np.intp)
_UP = np.array([0.0, 0.0, -1.0])


class SingleObjectTracker:
    """Shown a target once, locates it in each following picture (height, width, 3), BGR."""

    def __init__(self, picture: Pixels, place_px: Array, box_px: float) -> None:
        """`place_px` (2,) is the target's centre; the filters see a square of `box_px` around it."""
        self._sampler = BodySampler(_SAMPLES, box_px / _SAMPLES, _RING_REACH * box_px, _FLAT)
        patch = FilterShape(_SAMPLES, _SAMPLES, self._sampler.channels, _TARGET_WIDTH, _KERNEL_WIDTH, windowed=True)
        rings = FilterShape(
            1, self._sampler.angles, self._sampler.ring_channels, _TURN_WIDTH, _TURN_KERNEL_WIDTH, windowed=False
        )
        self._filter, self._turn_filter = CorrelationFilter(1, patch), CorrelationFilter(1, rings)
        self._pose, self._speed = np.append(np.asarray(place_px, dtype=np.float64), 0.0), np.zeros(3)  # px, px, rad
        self._pictures = 0
        self._learn(picture, 1.0)

    def step(self, picture: Pixels) -> tuple[Array, float]:
        """The target's [x px, y px, rad turned since it was shown, from x towards y] (3,) in the next picture, and the
        correlation's peak."""
        before, peak = self._pose[:2].copy(), 0.0
        self._pose = self._pose + self._speed
        for _ in range(2):
            shifts, peaks = self._filter.detect(_ONE, self._patch(picture))
            self._pose[:2] += self._turned() @ shifts[0] * self._sampler.pitch_m
            peak = float(peaks[0])
            if np.max(np.abs(shifts)) < _FAR_SHIFT:
                break
        self._speed[:2] = _SPEED_MEMORY * self._speed[:2] + (1.0 - _SPEED_MEMORY) * (self._pose[:2] - before)
        self._pictures += 1
        if self._pictures % _TURN_EVERY == 0:
            self._turn(picture)
        if self._pictures % _LEARN_EVERY == 0:
            self._learn(picture, _LEARNING_RATE)
        return self._pose.copy(), peak

    def _turn(self, picture: Pixels) -> None:
        """Follow the heading by the shift of the picture's rings around the object."""
        turns, peaks = self._turn_filter.detect(_ONE, self._rings(picture))
        if peaks[0] > _LEAST_TURN_PEAK:
            turned_rad = turns[0, 0] * 2.0 * np.pi / self._sampler.angles
            self._pose[2] += turned_rad
            self._speed[2] = _TURN_MEMORY * self._speed[2] + (1.0 - _SPEED_MEMORY) * turned_rad / _TURN_EVERY
        else:  # a rate that nothing confirms turns the patch on and on
            self._speed[2] *= _SPEED_MEMORY

    def _learn(self, picture: Pixels, rate: float) -> None:
        rates = np.full(1, rate, np.float32)
        self._filter.learn(_ONE, self._patch(picture), rates)
        self._turn_filter.learn(_ONE, self._rings(picture), rates)

    def _patch(self, picture: Pixels) -> Real:
        return self._sampler.patch(DemosaicedRegion(picture, 0, 0, 1), self._projection())[None]

    def _rings(self, picture: Pixels) -> Real:
        return self._sampler.rings(DemosaicedRegion(picture, 0, 0, 1), self._projection())[None]

    def _projection(self) -> BodyProjection:
        """The map from the target's axes to the picture: a metre of the sampler is a pixel."""
        return BodyProjection(self._pose[:2], np.column_stack([self._turned(), np.zeros(2)]), _UP)

    def _turned(self) -> Array:
        c, s = np.cos(self._pose[2]), np.sin(self._pose[2])
        return np.array([[c, -s], [s, c]])

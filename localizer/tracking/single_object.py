"""Tracking of one object in plain pictures, in pixels: the correlation filter without pool, marker and gates. Pure.

For recordings of an unknown camera (`localizer evaluate`), and to compare the filter with other trackers.
"""

import cv2
import numpy as np

from localizer.detection.correlation_filter import CorrelationFilter, FilterShape, Real
from localizer.detection.image_regions import Pixels
from wire.frames import Array

_SAMPLES = 40  # across the box; error on a real animal: 2.7 px with 36 to 48, 2.9 px with 32
_TARGET_WIDTH = 2.1  # samples
_KERNEL_WIDTH = 1.0
_LEARN_EVERY = 4  # pictures between updates; learning costs as much as detecting, and more often gains nothing
_LEARNING_RATE = 0.04  # per update; error with 0.02 and 0.08: 2.9 px
_FAR_SHIFT = 1.5  # samples; the window biases a shift towards zero, so a larger one is measured a second time
_SPEED_MEMORY = 0.5  # share of the old velocity per picture
_ONE = np.zeros(1, dtype=np.intp)


class SingleObjectTracker:
    """Shown a target once, locates it in each following picture (height, width, 3), BGR."""

    def __init__(self, picture: Pixels, place_px: Array, box_px: float) -> None:
        """`place_px` (2,) is the target's centre; the filter sees a square of `box_px` around it."""
        self._pitch_px = box_px / _SAMPLES
        shape = FilterShape(_SAMPLES, _SAMPLES, 3, _TARGET_WIDTH, _KERNEL_WIDTH, windowed=True)
        self._filter = CorrelationFilter(1, shape)
        self._place, self._speed = np.array(place_px, dtype=np.float64), np.zeros(2)
        self._pictures = 0
        self._learn(picture, 1.0)

    def step(self, picture: Pixels) -> tuple[Array, float]:
        """The target's position (2,) px in the next picture, and the correlation's peak."""
        before, peak = self._place, 0.0
        self._place = before + self._speed
        for _ in range(2):
            shifts, peaks = self._filter.detect(_ONE, self._patch(picture))
            self._place, peak = self._place + shifts[0] * self._pitch_px, float(peaks[0])
            if np.max(np.abs(shifts)) < _FAR_SHIFT:
                break
        self._speed = _SPEED_MEMORY * self._speed + (1.0 - _SPEED_MEMORY) * (self._place - before)
        self._pictures += 1
        if self._pictures % _LEARN_EVERY == 0:
            self._learn(picture, _LEARNING_RATE)
        return self._place.copy(), peak

    def _learn(self, picture: Pixels, rate: float) -> None:
        self._filter.learn(_ONE, self._patch(picture), np.full(1, rate, np.float32))

    def _patch(self, picture: Pixels) -> Real:
        pitch, first = self._pitch_px, self._place - self._pitch_px * (_SAMPLES // 2)
        matrix = np.array([[pitch, 0.0, first[0]], [0.0, pitch, first[1]]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        patch = cv2.warpAffine(picture, matrix, (_SAMPLES, _SAMPLES), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(np.moveaxis(patch, -1, 0)[None], dtype=np.float32)

"""Sensor noise on the raw mosaic: it grows with the light, and differs in every frame."""

import cv2
import numpy as np

from sim_bridge.camera.optics import Bytes

MID_GREY = 128.0
READ_SHARE = 0.3  # read noise's share of the variance at mid grey; the rest is shot noise, which grows with the light
UNIT = 32.0  # one standard deviation in the stored noise
SHIFT_BITS = 8  # a gain is noise levels * 2^SHIFT_BITS / UNIT: products stay within 16 bits up to 30 grey levels
LARGEST_GAIN = 255
SPARE_PX = (509, 251)  # px by which the field exceeds the picture; coprime, so a cut-out repeats after 127,759 frames
STRIDE = (197, 103)  # px by which the cut-out moves from frame to frame
ROWS = 96  # processed at a time, so that intermediate results stay in the processor's cache


class SensorNoise:
    """Noise from one large field, each frame with its own cut-out: drawing 1.2 million normal deviates a frame would take
    15 ms."""

    def __init__(self, size_px: tuple[int, int], noise: float, random: np.random.Generator) -> None:
        self._size = size_px
        shape = (size_px[1] + SPARE_PX[1], size_px[0] + SPARE_PX[0])
        field = random.standard_normal(shape, dtype=np.float32) * np.float32(UNIT)
        self._field = np.clip(np.rint(field), -127, 127).astype(np.int16)
        variance = READ_SHARE + (1.0 - READ_SHARE) * np.arange(256) / MID_GREY
        gain = noise * np.sqrt(variance) * 2**SHIFT_BITS / UNIT
        self._gain = np.minimum(np.rint(gain), LARGEST_GAIN).astype(np.int16)
        self._noise = np.empty((ROWS, size_px[0]), np.int16)

    def add(self, raw: Bytes, frame_index: int) -> Bytes:
        """A noisy copy of a mosaic (height, width), the same for the same frame index."""
        (width, height), (spare_x, spare_y), (stride_x, stride_y) = self._size, SPARE_PX, STRIDE
        left, top = frame_index * stride_x % spare_x, frame_index * stride_y % spare_y
        field = self._field[top : top + height, left : left + width]
        noisy = np.empty_like(raw)
        for first in range(0, height, ROWS):
            rows = slice(first, min(first + ROWS, height))
            noise = self._noise[: rows.stop - first]
            cv2.LUT(raw[rows], self._gain, dst=noise)
            noise *= field[rows]
            noise += 1 << (SHIFT_BITS - 1)
            noise >>= SHIFT_BITS
            noise += raw[rows]
            noisy[rows] = np.clip(noise, 0, 255, out=noise)
        return noisy

"""Sensor noise on the raw mosaic: it grows with the light, and differs in every frame."""

import numpy as np

from sim_bridge.camera import kernels
from sim_bridge.camera.optics import Bytes

MID_GREY = 128.0
READ_SHARE = 0.3  # read noise's share of the variance at mid grey; the rest is shot noise, which grows with the light
UNIT = 32.0  # one standard deviation in the stored noise
SPARE_PX = (509, 251)  # px by which the field exceeds the picture; coprime, so a cut-out repeats after 127,759 frames
STRIDE = (197, 103)  # px by which the cut-out moves from frame to frame


class SensorNoise:
    """Noise from one large field, each frame with its own cut-out: drawing 1.2 million normal deviates a frame would take
    15 ms."""

    def __init__(self, size_px: tuple[int, int], noise: float, random: np.random.Generator) -> None:
        """`noise`: standard deviation of a pixel at mid grey, in grey levels of 255."""
        shape = (size_px[1] + SPARE_PX[1], size_px[0] + SPARE_PX[0])
        field = random.standard_normal(shape, dtype=np.float32) * np.float32(UNIT)
        self._field = np.clip(np.rint(field), -127, 127).astype(np.int8)
        # Variances in (levels / UNIT)^2: of the read noise, and of the shot noise per grey level
        self._read_variance = READ_SHARE * (noise / UNIT) ** 2
        self._shot_variance = (1.0 - READ_SHARE) / MID_GREY * (noise / UNIT) ** 2

    def add(self, raw: Bytes, frame_index: int) -> Bytes:
        """A noisy copy of a mosaic (height, width), the same for the same frame index."""
        left, top = (frame_index * stride % spare for stride, spare in zip(STRIDE, SPARE_PX, strict=True))
        noisy = np.empty_like(raw)
        kernels.add_noise(raw, self._field, top, left, self._read_variance, self._shot_variance, noisy)
        return noisy

"""Bubbles that rise in streams, as from a leaking hose: small bright specks over whatever lies below them.

A stream wanders over the floor. Its bubbles rise straight up but for a spiral, each in its own time; where any of them is
depends on seed and time alone. Refraction is that of still water.
"""

import math

import numpy as np

from shoal.config.perception import Camera
from shoal.config.scene import PoolConfig
from shoal.frames import Array
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Floats, Table
from sim_bridge.camera.kernels import Picture
from sim_bridge.camera.optics import Bytes, project

MOST_STREAMS = 100  # the experiment's 50 and 50 of a fault; more are not drawn
STREAM_HZ = 15.0  # bubbles a second of one stream
RISE_MPS = 0.24  # of bubbles of 3 to 8 mm in tap water (Clift, Grace and Weber 1978, figure 7.3)
RADIUS_M = (0.0015, 0.004)
SPIRAL_M, SPIRAL_HZ = 0.005, 5.0
SPREAD_M = 0.02  # standard deviation of a bubble's place about its stream
LEVELS = 110.0  # grey levels that the middle of a bubble adds: the lamps, mirrored
REACH = 3.0  # standard deviations of a speck that are drawn
_RATES_RADPS = (0.05, 0.2)  # of a stream over the floor
# Steps of a sequence that fills the unit cube evenly (Roberts 2018): for angle, distance, phase and radius.
_STEPS = np.array([0.8566748838545, 0.733891856627, 0.628706721042, 0.538597267])


class Bubbles:
    """The streams of a pool."""

    def __init__(self, pool: PoolConfig, random: np.random.Generator) -> None:
        self._half_m, self._depth_m = np.array(pool.size_m[:2]) / 2.0, pool.size_m[2]
        self._rates = random.uniform(*_RATES_RADPS, (MOST_STREAMS, 2))
        self._starts = random.uniform(0.0, 2.0 * np.pi, (MOST_STREAMS, 2))

    def at(self, time_s: float, streams: int) -> Array:
        """All bubbles (k, 4) that are under way in the first so many streams: x, y, z and radius, m."""
        newest = math.floor(time_s * STREAM_HZ)
        number = np.arange(math.ceil((time_s - self._depth_m / RISE_MPS) * STREAM_HZ), newest + 1, dtype=np.float64)
        age_s = time_s - number / STREAM_HZ
        streams_bubbles = [self._stream(stream, number, age_s, time_s) for stream in range(min(streams, MOST_STREAMS))]
        return np.concatenate(streams_bubbles) if streams_bubbles else np.empty((0, 4))

    def _stream(self, stream: int, number: Array, age_s: Array, time_s: float) -> Array:
        """Its bubbles, (k, 4)."""
        left_s = (time_s - age_s)[:, None]
        place = 0.9 * self._half_m * np.sin(self._rates[stream] * left_s + self._starts[stream])
        turn, away, phase, size = ((number[:, None] + 1000.0 * stream) * _STEPS % 1.0).T
        far = SPREAD_M * np.sqrt(-2.0 * np.log(1.0 - away))
        swing = 2.0 * np.pi * (phase + SPIRAL_HZ * age_s)
        x = place[:, 0] + far * np.cos(2.0 * np.pi * turn) + SPIRAL_M * np.cos(swing)
        y = place[:, 1] + far * np.sin(2.0 * np.pi * turn) + SPIRAL_M * np.sin(swing)
        radius = RADIUS_M[0] + size * (RADIUS_M[1] - RADIUS_M[0])
        return np.column_stack([x, y, self._depth_m - RISE_MPS * age_s, radius])


def draw_bubbles(raw: Bytes, bubbles: Array, camera: Camera, robots_m: Array, hull_m: float) -> None:
    """Lay bubbles (k, 4) over a raw mosaic, in place, except those that are vertically below a robot at `robots_m` (n, 3), in
    the middle of the exposure, of radius `hull_m`: a camera that looks aslant sees some through a hull's side."""
    away = np.linalg.norm(bubbles[:, None, :2] - robots_m[None, :, :2], axis=2)
    visible_bubbles = bubbles[~np.any((away < hull_m) & (bubbles[:, None, 2] > robots_m[None, :, 2]), axis=1)]
    if len(visible_bubbles):
        sizes_px = np.maximum(0.5 * camera.px_per_m * visible_bubbles[:, 3], 0.5)  # the lens is no sharper
        specks(raw, project(camera, visible_bubbles[:, :3]), sizes_px, LEVELS)


@kernel
def specks(raw: Picture, places_px: Table, sizes_px: Floats, levels: float) -> None:
    """Add bright spots to a mosaic: at places (k, 2) column and row, of standard deviations (k,) px."""
    height, width = raw.shape
    for k in range(len(places_px)):
        x, y, size = places_px[k, 0], places_px[k, 1], sizes_px[k]
        reach = REACH * size
        if not (-reach < x < width + reach and -reach < y < height + reach):  # NaN is nowhere
            continue
        for i in range(max(int(y - reach), 0), min(int(y + reach) + 2, height)):
            for j in range(max(int(x - reach), 0), min(int(x + reach) + 2, width)):
                away2 = ((j - x) ** 2 + (i - y) ** 2) / (size * size)
                raw[i, j] = int(min(raw[i, j] + levels * math.exp(-0.5 * away2), 255.0) + 0.5)

"""Time scaling: slow a path down where a robot could not follow. The geometry stays; no limit is exceeded.

Along path time tau a rate tau' <= 1 is chosen: as low as needed where a node exceeds a limit, elsewhere 1, with smooth
slopes in between. Speeds scale with tau', accelerations with tau'^2 and tau''.
"""

from collections.abc import Callable

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import minimum_filter1d

from groundstation.planning.paths import Path, PathState
from shoal.frames import Array

SLOPE_S = 2.0  # of path time for a change of rate: braking from 0.3 m/s then takes 2 N of the available 6 N
SLOWEST = 0.05  # rate; a robot that needs less turns on the spot, which a slower rate does not cure
ROUNDS = 30  # slower slopes brake harder, so the rate is found step by step; 2-8 are usual
CAUTION = 0.99  # aim this far below the limit: rounds are few then, and interpolation cannot touch it

SlowdownFunction = Callable[[Path], Array]  # factor by which a path's worst node should be slower, at every period from 0 on


class TimeScaledPath:
    """A path flown at a varying rate. `rate` (k,) is tau' at path times `period_s` apart, from 0."""

    def __init__(self, path: Path, rate: Array, period_s: float) -> None:
        self._path = path
        tau = np.arange(len(rate), dtype=np.float64) * period_s
        pace = 0.5 * period_s * (1.0 / rate[:-1] + 1.0 / rate[1:])
        time_s = np.concatenate([[0.0], np.cumsum(pace)])
        self.warp = CubicSpline(time_s, tau)  # path time over time
        # an end that lies beyond the samples is beyond the run
        self.end_s = float(np.interp(path.end_s, tau, time_s)) if path.end_s <= tau[-1] else float("inf")

    def at(self, time_s: Array) -> PathState:
        """See `Path`; not defined beyond the samples."""
        rate, bend = self.warp(time_s, 1), self.warp(time_s, 2)
        at = self._path.at(self.warp(time_s))
        rates, bends = rate[:, None], bend[:, None]
        return PathState(
            position_m=at.position_m,
            velocity_mps=at.velocity_mps * rates,
            acceleration_mps2=at.acceleration_mps2 * rates**2 + at.velocity_mps * bends,
            yaw_rad=at.yaw_rad,
            yaw_rate_radps=at.yaw_rate_radps * rate,
            yaw_acceleration_radps2=at.yaw_acceleration_radps2 * rate**2 + at.yaw_rate_radps * bend,
            climb_rad=at.climb_rad,
        )

    def share_at(self, time_s: float) -> float:
        """See `Path`."""
        return self._path.share_at(float(self.warp(time_s)))


def scale_time(path: Path, required_slowdown: SlowdownFunction, samples: int, period_s: float) -> TimeScaledPath:
    """Path at the highest rate found at which it is nowhere too fast for `samples` periods. Where even SLOWEST is too fast it
    stays too fast: the planner reports the place."""
    allowed, time_s = np.ones(samples), np.arange(samples) * period_s
    for _ in range(ROUNDS):
        slow = TimeScaledPath(path, _smooth(allowed, period_s), period_s)
        factor = required_slowdown(slow)
        over = np.flatnonzero(factor > 1.0)
        if len(over) == 0:
            break
        rate = np.maximum(slow.warp(time_s[over], 1) * CAUTION / factor[over], SLOWEST)
        before = (slow.warp(time_s[over]) / period_s).astype(np.intp)
        for sample in (before, before + 1):
            np.minimum.at(allowed, np.minimum(sample, samples - 1), rate)
    return slow


def _smooth(allowed: Array, period_s: float) -> Array:
    """A smooth rate nowhere above `allowed`: the average over a window of the least in that window."""
    half = max(1, round(0.5 * SLOPE_S / period_s))
    least = minimum_filter1d(allowed, 2 * half + 1, mode="nearest")
    window = np.hanning(2 * half + 3)[1:-1]
    return np.convolve(np.pad(least, half, mode="edge"), window / window.sum(), mode="valid")

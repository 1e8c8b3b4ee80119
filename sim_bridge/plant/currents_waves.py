"""The water's own motion: current, shear, gusts and waves. Pure functions of place and time.

Gusts are the same everywhere: a sum of cosines whose frequencies are the quantiles of a first-order Gauss-Markov process
(Ornstein-Uhlenbeck), spectrum sigma^2 (2 T / pi) / (1 + (omega T)^2). They need no state, and their rate of change is
exact. Waves are Airy's: velocities of a potential, with the dispersion of the pool's depth.
"""

import numpy as np

from shoal.config.experiment import Experiment
from shoal.frames import Array
from sim_bridge.plant import kernels
from sim_bridge.plant.kernels import GRAVITY_MPS2
from sim_bridge.plant.random_streams import Stream, generator

GUST_WAVES = 32  # cosines per axis; with 32 the correlation follows exp(-t / T) to 0.03


class WaterFlow:
    """The water's own velocity, and its rate of change at a fixed place."""

    def __init__(self, experiment: Experiment, seed: int) -> None:
        plant, depth_m = experiment.sim.plant, experiment.pool.size_m[2]
        current, shear = np.array(plant.current_mps), np.array(plant.current_shear_per_s)
        gust_radps, gust_phase = _gusts(plant.gust_s, generator(seed, Stream.GUSTS))
        gust_mps = float(plant.gust_mps * np.sqrt(2.0 / GUST_WAVES))
        waves = plant.waves
        wave_radps = 2.0 * np.pi / waves.period_s
        wave_mps = 0.5 * waves.height_m * wave_radps
        wave_way = np.array([np.cos(waves.direction_rad), np.sin(waves.direction_rad)])
        still = gust_mps == 0.0 and wave_mps == 0.0 and not current.any() and not shear.any()
        wave_per_m = wave_number(wave_radps, depth_m)
        self.constants = (
            still, current, shear, gust_mps, gust_radps, gust_phase, wave_mps, wave_way, wave_radps, wave_per_m, depth_m
        )  # fmt: skip

    def motion(self, place_m: Array, time_s: float) -> Array:
        """Velocity m/s and acceleration m/s^2 of the water (n, 6) at fixed places (n, 3). The part of a steady flow along a
        robot's way is of second order and left out of the acceleration, as in linear wave theory."""
        motion = np.empty((len(place_m), 6))
        kernels.water_motion(place_m, time_s, self.constants, motion)
        return motion


class SurfaceWave:
    """The wave of WaterFlow as camera and pressure sensor meet it. With the phase k (x cos + y sin) - omega t:

    elevation = a cos(phase), up,    pressure as depth = z + a cosh(k (h - z)) / cosh(k h) cos(phase)
    """

    def __init__(self, experiment: Experiment) -> None:
        waves, self._depth_m = experiment.sim.plant.waves, experiment.pool.size_m[2]
        self.amplitude_m, self.radps = 0.5 * waves.height_m, 2.0 * np.pi / waves.period_s
        self._per_m = wave_number(self.radps, self._depth_m)
        self.number = self._per_m * np.array([np.cos(waves.direction_rad), np.sin(waves.direction_rad)])  # rad/m

    def at(self, time_s: float) -> Array:
        """Amplitude m, k along x and y in rad/m, and omega t: what fixes the surface at a time."""
        return np.array([self.amplitude_m, *self.number, self.radps * time_s])

    def pressure_m(self, x_m: float, y_m: float, z_m: float, time_s: float) -> float:
        """Depth by which the pressure at a place is above that of still water."""
        if self.amplitude_m == 0.0:
            return 0.0
        down_m, k, h = min(max(z_m, 0.0), self._depth_m), self._per_m, self._depth_m
        # cosh(k (h - z)) / cosh(k h), without the large numbers of a deep pool
        share = (np.exp(-k * down_m) + np.exp(-k * (2.0 * h - down_m))) / (1.0 + np.exp(-2.0 * k * h))
        phase = self.number[0] * x_m + self.number[1] * y_m - self.radps * time_s
        return float(self.amplitude_m * share * np.cos(phase))


def wave_number(radps: float, depth_m: float) -> float:
    """k in rad/m of the dispersion omega^2 = g k tanh(k depth), by Newton's method from deep water."""
    wanted = radps**2 * depth_m / GRAVITY_MPS2
    kh = max(wanted, np.sqrt(wanted))
    for _ in range(30):
        tanh = np.tanh(kh)
        kh -= (kh * tanh - wanted) / (tanh + kh * (1.0 - tanh**2))
    return float(kh / depth_m)


def _gusts(correlation_s: float, random: np.random.Generator) -> tuple[Array, Array]:
    """Frequencies and phases (2, GUST_WAVES): one of each stratum of equal energy, for x and for y."""
    share = (np.arange(GUST_WAVES) + random.uniform(0.0, 1.0, (2, GUST_WAVES))) / GUST_WAVES
    top = 1.0 - 0.5 / GUST_WAVES  # cuts off the endless tail of the spectrum, which would only shake
    return np.tan(0.5 * np.pi * np.minimum(share, top)) / correlation_s, random.uniform(0.0, 2.0 * np.pi, (2, GUST_WAVES))

"""The water's own motion: current, shear, gusts and waves. Pure functions of place and time.

Places and velocities are rows x, y, z of arrays (3, n) in the pool frame.

Gusts are the same everywhere: a sum of cosines whose frequencies are the quantiles of a first-order Gauss-Markov process
(Ornstein-Uhlenbeck), spectrum sigma^2 (2 T / pi) / (1 + (omega T)^2). They need no state, and their rate of change is
exact. Waves are Airy's: velocities of a potential, with the dispersion of the pool's depth.
"""

import numpy as np

from sim_bridge.plant.random_streams import Stream, generator
from wire.config.experiment import Experiment
from wire.frames import Array

GRAVITY_MPS2 = 9.81
GUST_WAVES = 32  # cosines per axis; with 32 the correlation follows exp(-t / T) to 0.03


class WaterFlow:
    """The water's own velocity, and its rate of change at a fixed place."""

    def __init__(self, experiment: Experiment, seed: int) -> None:
        plant = experiment.sim.plant
        self._current = np.array(plant.current_mps)[:, None]
        self._shear = np.array([*plant.current_shear_per_s, 0.0])[:, None]
        self._gust_radps, self._gust_phase = _gusts(plant.gust_s, generator(seed, Stream.GUSTS))
        self._gust = plant.gust_mps * np.sqrt(2.0 / GUST_WAVES)
        waves = plant.waves
        self._depth_m = experiment.pool.size_m[2]
        self._wave_radps = 2.0 * np.pi / waves.period_s
        self._wave_per_m = wave_number(self._wave_radps, self._depth_m)
        self._wave_mps = 0.5 * waves.height_m * self._wave_radps
        self._wave_way = np.array([np.cos(waves.direction_rad), np.sin(waves.direction_rad)])[:, None]
        self.steady = self._gust == 0.0 and self._wave_mps == 0.0
        self.still = self.steady and not self._current.any() and not self._shear.any()

    def velocity(self, place_m: Array, time_s: float) -> Array:
        """Velocity of the water at places (3, n), m/s."""
        flow: Array = self._current + self._shear * place_m[2]
        if self._gust:
            flow[:2] += self._gust * np.cos(self._gust_radps * time_s + self._gust_phase).sum(axis=1)[:, None]
        if self._wave_mps:
            flow += self._orbit(place_m, time_s, self._wave_mps)
        return flow

    def acceleration(self, place_m: Array, time_s: float) -> Array:
        """Acceleration of the water at fixed places (3, n), m/s^2. The part of a steady flow along a robot's way is of
        second order and left out, as in linear wave theory."""
        rate = np.zeros(place_m.shape)
        if self._gust:
            turning = self._gust_radps * np.sin(self._gust_radps * time_s + self._gust_phase)
            rate[:2] -= self._gust * turning.sum(axis=1)[:, None]
        if self._wave_mps:
            a_quarter_later = time_s + 0.5 * np.pi / self._wave_radps
            rate += self._orbit(place_m, a_quarter_later, self._wave_mps * self._wave_radps)
        return rate

    def _orbit(self, place_m: Array, time_s: float, amplitude: float) -> Array:
        """Wave velocity or acceleration: circles at the surface, flatter and smaller towards the floor; the crest moves
        with the wave."""
        k, down = self._wave_per_m, np.clip(place_m[2], 0.0, self._depth_m)
        falling = np.exp(-k * down)
        rising = np.exp(-k * (2.0 * self._depth_m - down))  # what the floor gives back
        scale = amplitude / -np.expm1(-2.0 * k * self._depth_m)
        phase = k * (self._wave_way * place_m[:2]).sum(axis=0) - self._wave_radps * time_s
        along = scale * (falling + rising) * np.cos(phase)
        return np.concatenate([self._wave_way * along, -scale * (falling - rising) * np.sin(phase)[None]])


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

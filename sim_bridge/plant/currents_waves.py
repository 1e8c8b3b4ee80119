"""The water's own motion: current, shear, gusts and waves. Pure functions of place and time.

Gusts are the same everywhere: a sum of cosines whose frequencies are the quantiles of a first-order Gauss-Markov process
(Ornstein-Uhlenbeck), spectrum sigma^2 (2 T / pi) / (1 + (omega T)^2). They need no state, and their rate of change is
exact. Waves are Airy's: velocities of a potential, with the dispersion of the pool's depth.
"""

import math
from typing import NamedTuple

import numpy as np

from shoal.config.experiment import Experiment
from shoal.frames import Array
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Table
from sim_bridge.plant.random_streams import Stream, generator
from sim_bridge.plant.vectors import NO_VECTOR, Vector, add, dot, row_vector, scale, set_row

GRAVITY_MPS2 = 9.81
GUST_WAVES = 32  # cosines per axis; with 32 the correlation follows exp(-t / T) to 0.03


class Flow(NamedTuple):
    """Constants of the water's own motion."""

    is_still: bool
    current_mps: Vector  # at the surface
    shear_per_s: Vector  # its change per metre of depth
    gust_mps: float  # amplitude of each cosine
    gust_radps: Table  # (2, GUST_WAVES), for x and for y
    gust_phase: Table
    wave_mps: float  # amplitude of the wave's velocity at the surface, in deep water
    wave_direction: Vector  # unit vector in which the wave travels
    wave_radps: float  # omega
    wave_per_m: float  # wave number k, rad/m
    depth_m: float  # of the pool


class WaterMotion(NamedTuple):
    """The water's motion at a fixed place, in the pool frame."""

    velocity_mps: Vector
    acceleration_mps2: Vector


@kernel(part=True)
def gust_motion(flow: Flow, time_s: float) -> WaterMotion:
    """The gusts' part of the motion: a sum of GUST_WAVES cosines on x and on y, the same everywhere."""
    x, y, rate_x, rate_y = 0.0, 0.0, 0.0, 0.0
    if flow.gust_mps > 0.0:
        for k in range(flow.gust_radps.shape[1]):
            angle_x = flow.gust_radps[0, k] * time_s + flow.gust_phase[0, k]
            angle_y = flow.gust_radps[1, k] * time_s + flow.gust_phase[1, k]
            x += flow.gust_mps * math.cos(angle_x)
            y += flow.gust_mps * math.cos(angle_y)
            rate_x -= flow.gust_mps * flow.gust_radps[0, k] * math.sin(angle_x)
            rate_y -= flow.gust_mps * flow.gust_radps[1, k] * math.sin(angle_y)
    return WaterMotion(Vector(x, y, 0.0), Vector(rate_x, rate_y, 0.0))


@kernel(inline=True, part=True)
def wave_motion(flow: Flow, place_m: Vector, time_s: float) -> WaterMotion:
    """The wave's part of the motion at a place, by Airy's theory in water of depth h (phase = k s - omega t, z down):

        horizontal velocity  a omega cosh(k (h - z)) / sinh(k h) cos(phase)
        vertical velocity   -a omega sinh(k (h - z)) / sinh(k h) sin(phase), 0 at the floor

    The hyperbolic functions are sums of an incident wave, which decays downwards, and its reflection by the floor: no large
    numbers in a deep pool.
    """
    if flow.wave_mps == 0.0:
        return WaterMotion(NO_VECTOR, NO_VECTOR)
    z_m = min(max(place_m.z, 0.0), flow.depth_m)
    incident = math.exp(-flow.wave_per_m * z_m)
    reflected = math.exp(-flow.wave_per_m * (2.0 * flow.depth_m - z_m))
    surface_mps = flow.wave_mps / -math.expm1(-2.0 * flow.wave_per_m * flow.depth_m)
    horizontal_mps, vertical_mps = surface_mps * (incident + reflected), surface_mps * (incident - reflected)
    phase = flow.wave_per_m * dot(flow.wave_direction, place_m) - flow.wave_radps * time_s
    sine, cosine = math.sin(phase), math.cos(phase)
    velocity = add(scale(horizontal_mps * cosine, flow.wave_direction), Vector(0.0, 0.0, -vertical_mps * sine))
    horizontal_mps2 = horizontal_mps * flow.wave_radps * sine
    vertical_mps2 = vertical_mps * flow.wave_radps * cosine
    return WaterMotion(velocity, add(scale(horizontal_mps2, flow.wave_direction), Vector(0.0, 0.0, vertical_mps2)))


@kernel(inline=True, part=True)
def water_motion(flow: Flow, gust: WaterMotion, place_m: Vector, time_s: float) -> WaterMotion:
    """The water's motion at a fixed place: current with shear, gust and wave. The acceleration is the partial derivative in
    time: the convective part is of second order and left out, as in linear wave theory."""
    if flow.is_still:
        return WaterMotion(NO_VECTOR, NO_VECTOR)
    wave = wave_motion(flow, place_m, time_s)
    steady = add(flow.current_mps, scale(place_m.z, flow.shear_per_s))
    velocity = add(add(steady, gust.velocity_mps), wave.velocity_mps)
    return WaterMotion(velocity, add(gust.acceleration_mps2, wave.acceleration_mps2))


@kernel
def water_motions(flow: Flow, places_m: Table, time_s: float, motion: Table) -> None:
    """Velocity and acceleration (n, 6) of the water at places (n, 3)."""
    gust = gust_motion(flow, time_s)
    for i in range(len(places_m)):
        water = water_motion(flow, gust, row_vector(places_m, i, 0), time_s)
        set_row(motion, i, 0, water.velocity_mps)
        set_row(motion, i, 3, water.acceleration_mps2)


class WaterFlow:
    """The water's own velocity, and its rate of change at a fixed place."""

    def __init__(self, experiment: Experiment, seed: int) -> None:
        plant, depth_m = experiment.sim.plant, experiment.pool.size_m[2]
        gust_radps, gust_phase = _gusts(plant.gust_s, generator(seed, Stream.GUSTS))
        gust_mps = float(plant.gust_mps * np.sqrt(2.0 / GUST_WAVES))
        waves = plant.waves
        wave_radps = 2.0 * np.pi / waves.period_s
        wave_mps = 0.5 * waves.height_m * wave_radps
        direction = Vector(math.cos(waves.direction_rad), math.sin(waves.direction_rad), 0.0)
        is_still = gust_mps == 0.0 and wave_mps == 0.0 and not any(plant.current_mps) and not any(plant.current_shear_per_s)
        current, shear = Vector(*plant.current_mps), Vector(*plant.current_shear_per_s, 0.0)
        wave_per_m = wave_number(wave_radps, depth_m)
        self.constants = Flow(
            is_still, current, shear, gust_mps, gust_radps, gust_phase, wave_mps, direction, wave_radps, wave_per_m, depth_m
        )  # fmt: skip

    def set_current(self, current_mps: Array) -> None:
        """Change the current (3,) at the surface from now on."""
        self.constants = self.constants._replace(is_still=False, current_mps=Vector(*current_mps.tolist()))

    def motion(self, places_m: Array, time_s: float) -> Array:
        """Velocity m/s and acceleration m/s^2 of the water (n, 6) in the pool frame, at fixed places (n, 3)."""
        motion = np.empty((len(places_m), 6))
        water_motions(self.constants, np.ascontiguousarray(places_m), time_s, motion)
        return motion


class SurfaceWave:
    """The wave of WaterFlow as camera and pressure sensor measure it. With the phase k (x cos + y sin) - omega t:

    elevation = a cos(phase), up,    pressure as depth = z + a cosh(k (h - z)) / cosh(k h) cos(phase)
    """

    def __init__(self, experiment: Experiment) -> None:
        waves, self._depth_m = experiment.sim.plant.waves, experiment.pool.size_m[2]
        self.amplitude_m, self.radps = 0.5 * waves.height_m, 2.0 * np.pi / waves.period_s
        self._per_m = wave_number(self.radps, self._depth_m)
        self.number = self._per_m * np.array([np.cos(waves.direction_rad), np.sin(waves.direction_rad)])  # rad/m

    def at(self, time_s: float) -> Array:
        """The surface's shape at a time (4,): amplitude m, wave number along x and y in rad/m, and omega t in rad."""
        return np.array([self.amplitude_m, *self.number, self.radps * time_s])

    def pressure_m(self, x_m: float, y_m: float, z_m: float, time_s: float) -> float:
        """Pressure at a place (pool frame, z down) less that of still water, as a depth in m."""
        if self.amplitude_m == 0.0:
            return 0.0
        z_m, k, h = min(max(z_m, 0.0), self._depth_m), self._per_m, self._depth_m
        # cosh(k (h - z)) / cosh(k h), without the large numbers of a deep pool
        share = (np.exp(-k * z_m) + np.exp(-k * (2.0 * h - z_m))) / (1.0 + np.exp(-2.0 * k * h))
        phase = self.number[0] * x_m + self.number[1] * y_m - self.radps * time_s
        return float(self.amplitude_m * share * np.cos(phase))


def wave_number(radps: float, depth_m: float) -> float:
    """k in rad/m of the dispersion omega^2 = g k tanh(k depth), by Newton's method from deep water."""
    deep_kh = radps**2 * depth_m / GRAVITY_MPS2  # k h of deep water, where tanh is 1: k h tanh(k h) has to be this
    kh = max(deep_kh, np.sqrt(deep_kh))
    for _ in range(30):
        tanh = np.tanh(kh)
        kh -= (kh * tanh - deep_kh) / (tanh + kh * (1.0 - tanh**2))
    return float(kh / depth_m)


def _gusts(correlation_s: float, random: np.random.Generator) -> tuple[Array, Array]:
    """Draw frequencies (rad/s) and phases (rad) of the gusts' cosines, (2, GUST_WAVES) each, for x and for y: one frequency in
    each stratum of equal energy."""
    quantile = (np.arange(GUST_WAVES) + random.uniform(0.0, 1.0, (2, GUST_WAVES))) / GUST_WAVES
    top = 1.0 - 0.5 / GUST_WAVES  # cuts off the endless tail of the spectrum, which would only shake
    radps = np.tan(0.5 * np.pi * np.minimum(quantile, top)) / correlation_s
    return radps, random.uniform(0.0, 2.0 * np.pi, (2, GUST_WAVES))

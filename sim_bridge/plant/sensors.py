"""Sensors of the thruster board: the true motion with noise, and with biases that depend on the robot and the seed."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shoal.config.experiment import Experiment
from shoal.frames import Array, wrap
from sim_bridge.fault_schedule import ImuFaults
from sim_bridge.plant.currents_waves import GRAVITY_MPS2, SurfaceWave
from sim_bridge.plant.random_streams import Stream, generator

ACCELEROMETER_NOISE_MPS2 = 0.02  # m/s^2, standard deviation of an ordinary MEMS part at 50 Hz; the link rounds to 0.01
LEVEL = (0.0, 0.0, 0.0, 0.0)  # roll, pitch [rad], and d/dt of them [rad/s]


@dataclass(frozen=True)
class Reading:
    """One sample of all sensors but the battery's."""

    heading_rad: float
    yaw_rate_radps: float  # about the body's third axis
    acceleration_mps2: tuple[float, float, float]  # specific force, body frame: at rest 1 g upwards, (0, 0, -g)
    depth_m: float
    tilt: tuple[float, ...] = LEVEL

    @property
    def tilt_sensed(self) -> tuple[float, float, float, float]:
        """Roll, pitch [rad], and the rates about the body's first two axes [rad/s], as ATTITUDE has them."""
        roll, pitch, roll_rate, pitch_rate = self.tilt
        about_y = (pitch_rate + self.yaw_rate_radps * math.sin(roll)) / math.cos(roll)
        return roll, pitch, roll_rate - self.heading_rate_radps * math.sin(pitch), about_y

    @property
    def heading_rate_radps(self) -> float:
        """d/dt of the heading, as an agent has it from gyroscope and tilt (shoal/mavlink/agent_link.py)."""
        roll, pitch, _, pitch_rate = self.tilt
        return (self.yaw_rate_radps + math.sin(roll) * pitch_rate) / (math.cos(roll) * math.cos(pitch))


class BoardSensors:
    """The sensors of one robot. A bias is drawn within +- the value of the experiment file, and stays. Depth is off by the
    robot's `depth_offset_m` as well."""

    def __init__(self, experiment: Experiment, robot_id: int, seed: int) -> None:
        self._sensors = sensors = experiment.sim.sensors
        self._random = generator(seed, Stream.SENSORS, robot_id)
        heading, gyro, pressure = (float(value) for value in self._random.uniform(-1.0, 1.0, 3))
        self.heading_bias_rad = heading * sensors.heading_bias_rad
        self.gyro_bias_radps = gyro * sensors.gyro_bias_radps
        self._tilt_random = generator(seed, Stream.SENSORS, robot_id, 1)
        self.tilt_bias_rad = sensors.tilt_bias_rad * self._tilt_random.uniform(-1.0, 1.0, 2)
        self._tilt_noise = np.repeat([sensors.tilt_noise_rad, sensors.gyro_noise_radps], 2)
        self.faults = ImuFaults()
        self._imu = 0.0, (0.0, 0.0, 0.0)  # yaw rate and force of the last sample
        self._wave = SurfaceWave(experiment)
        self.depth_bias_m = pressure * sensors.pressure_bias_m + experiment.robot(robot_id).depth_offset_m

    def read(
        self, eta: Array, nu: Array, acceleration: Array, tilt: Array | Sequence[float] = LEVEL, time_s: float = 0.0
    ) -> Reading:
        """Sample a motion: eta, nu and d nu / dt, each (4,), on level axes, at the plant's time: depth is a pressure, which
        waves change too.

        `tilt` is roll, pitch, and d/dt of them, which turn the sensors with the body. The rate about the body's third axis is
        cos(roll) cos(pitch) d yaw/dt - sin(roll) d pitch/dt (Fossen 2021, eq. 2.31). The board levels its heading.
        """
        sensors, faults = self._sensors, self.faults
        heading_noise, gyro_noise, pressure_noise, *force_noise = self._random.standard_normal(6).tolist()
        x, y, z, yaw = eta.tolist()
        u, v, _, r = nu.tolist()
        u_dot, v_dot, w_dot, _ = acceleration.tolist()
        roll, pitch, pitch_rate = float(tilt[0]), float(tilt[1]), float(tilt[3])
        cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)

        # Rates about the body's axes, and the specific force: on level axes, pitched, then rolled
        about_y, about_z = sr * cp * r + cr * pitch_rate, cr * cp * r - sr * pitch_rate
        level_x, level_y, level_z = u_dot - r * v, v_dot + r * u, w_dot - GRAVITY_MPS2
        pitched_z = sp * level_x + cp * level_z
        force_x = cp * level_x - sp * level_z
        force_y, force_z = cr * level_y + sr * pitched_z, cr * pitched_z - sr * level_y

        if faults.turned_rad:  # the sensor is mounted askew, about the body's first axis
            ct, st = math.cos(faults.turned_rad), math.sin(faults.turned_rad)
            about_z = ct * about_z - st * about_y
            force_y, force_z = ct * force_y + st * force_z, ct * force_z - st * force_y
        fx, fy, fz = (
            force + ACCELEROMETER_NOISE_MPS2 * noise
            for force, noise in zip((force_x, force_y, force_z), force_noise, strict=True)
        )
        rate_radps = faults.rate_share * about_z + faults.rate_radps + self.gyro_bias_radps
        if not faults.is_stuck:
            self._imu = rate_radps + sensors.gyro_noise_radps * gyro_noise, (fx, fy, fz)
        heading_rad = yaw + faults.heading_rad + self.heading_bias_rad + sensors.heading_noise_rad * heading_noise
        pressure_m = z + self._wave.pressure_m(x, y, z, time_s)
        return Reading(
            wrap(heading_rad),
            *self._imu,
            pressure_m + self.depth_bias_m + sensors.pressure_noise_m * pressure_noise,
            self._sense_tilt(np.asarray(tilt, dtype=np.float64)),
        )

    def _sense_tilt(self, tilt: Array) -> tuple[float, ...]:
        """Roll, pitch and d/dt of them as an attitude filter has them: with a constant error and noise."""
        sensed = tilt + self._tilt_noise * self._tilt_random.standard_normal(4)
        sensed[:2] += self.tilt_bias_rad
        return tuple(sensed.tolist())

    def battery_v(self, supply_v: float, load: float) -> float:
        """Voltage of a battery that has `supply_v` at rest, with this fraction of full thrust on all thrusters."""
        noise_v = self._sensors.battery_noise_v * float(self._random.standard_normal())
        return supply_v - self._sensors.battery_sag_v * load + noise_v

"""Sensors of the thruster board: the true motion with noise, and with biases that depend on the robot and the seed."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from sim_bridge.plant.kernels import GRAVITY_MPS2
from sim_bridge.plant.random_streams import Stream, generator
from wire.config.simulation import Sensors
from wire.frames import Array, wrap

ACCELEROMETER_NOISE_MPS2 = 0.02  # m/s^2, standard deviation of an ordinary MEMS part at 50 Hz; the link rounds to 0.01


@dataclass(frozen=True)
class Reading:
    """One sample of all sensors but the battery's."""

    heading_rad: float
    yaw_rate_radps: float
    acceleration_mps2: tuple[float, float, float]  # specific force, body frame: at rest 1 g upwards, (0, 0, -g)
    depth_m: float


class BoardSensors:
    """The sensors of one robot. A bias is drawn within +- the value of the experiment file, and stays."""

    def __init__(self, sensors: Sensors, robot_id: int, seed: int) -> None:
        self._sensors = sensors
        self._random = generator(seed, Stream.SENSORS, robot_id)
        heading, gyro, pressure = (float(value) for value in self._random.uniform(-1.0, 1.0, 3))
        self.heading_bias_rad = heading * sensors.heading_bias_rad
        self.gyro_bias_radps = gyro * sensors.gyro_bias_radps
        self.error = (0.0, 0.0)  # of heading (rad) and yaw rate (rad/s), when the sensor is broken
        self.depth_bias_m = pressure * sensors.pressure_bias_m

    def read(self, eta: Array, nu: Array, acceleration: Array, tilt: Array | Sequence[float] = (0.0, 0.0)) -> Reading:
        """Sample a motion: eta, nu and d nu / dt, each (4,), on level axes.

        `tilt` begins with roll and pitch, which turn the sensors with the body. The board levels the heading that it
        sends.
        """
        sensors = self._sensors
        noise = [float(value) for value in self._random.standard_normal(6)]
        _, _, z, yaw = (float(value) for value in eta)
        u, v, _, r = (float(value) for value in nu)
        du, dv, dw, _ = (float(value) for value in acceleration)
        roll, pitch = float(tilt[0]), float(tilt[1])
        cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
        ahead, side, down = du - r * v, dv + r * u, dw - GRAVITY_MPS2
        bow = sp * ahead + cp * down
        force = (cp * ahead - sp * down, cr * side + sr * bow, cr * bow - sr * side)
        fx, fy, fz = (f + ACCELEROMETER_NOISE_MPS2 * n for f, n in zip(force, noise[3:], strict=True))
        return Reading(
            wrap(yaw + self.error[0] + self.heading_bias_rad + sensors.heading_noise_rad * noise[0]),
            cr * cp * r + self.error[1] + self.gyro_bias_radps + sensors.gyro_noise_radps * noise[1],
            (fx, fy, fz),
            z + self.depth_bias_m + sensors.pressure_noise_m * noise[2],
        )

    def battery_v(self, supply_v: float, load: float) -> float:
        """Voltage of a battery that has `supply_v` at rest, with this fraction of full thrust on all thrusters."""
        noise_v = self._sensors.battery_noise_v * float(self._random.standard_normal())
        return supply_v - self._sensors.battery_sag_v * load + noise_v

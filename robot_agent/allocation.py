"""Wrench -> 4 thrusters and 4 ankles -> pulse widths, and back.

    X = sum F_i cos a_i    Z = sum F_i sin a_i    N = -sum y_i F_i cos a_i

for legs in an "H" whose ankles turn in the vertical x-z plane. Per side, front and rear leg carry the same horizontal force
h plus and minus a bias b that cancels out: it keeps small forces clear of the dead zone, and gives the ankles something to
tilt when only heave is asked for. All ankles share one tangent, tan a_i = t g(h_i) with g = -1..1 following the thruster's
sign, so an ankle never turns over when surge reverses. What does not fit gives way in this order: heave, then yaw, then surge.
"""

import math

import numpy as np

from wire.frames import Array
from wire.vehicle import Vehicle

STEEPEST_TAN = math.tan(math.radians(60.0))  # beyond, most of a thruster's force is spent on cancelling its neighbour
CROSSING_N = 0.03  # g goes from -1 to 1 over +- this horizontal force: an ankle passes level while its thruster reverses


class Allocator:
    """Allocation for one vehicle. Wrenches are [surge N, heave N, yaw N m]; pulses are 4 thrusters, then 4 ankles."""

    def __init__(self, vehicle: Vehicle) -> None:
        legs, curve = vehicle.legs, vehicle.thruster.curve
        x, y = np.array(legs.position_m).T
        if len(set(np.abs(x).round(6))) != 1 or len(set(np.abs(y).round(6))) != 1 or len(set(zip(x, y, strict=True))) != 4:
            raise ValueError(f"legs.position_m = {legs.position_m}: must be the corners of a rectangle around the centre")
        self._vehicle = vehicle
        self._arm_m = abs(float(y[0]))
        self._front = x > 0
        self._y = y
        self._ahead_n = min(vehicle.thruster.max_thrust_n, curve[-1][1])
        self._astern_n = min(vehicle.thruster.max_thrust_n, -curve[0][1])
        low, high = legs.ankle_us
        self._ankle_level_us, self._ankle_us_per_rad = 0.5 * (low + high), 0.5 * (high - low) / legs.ankle_range_rad
        level = round(self._ankle_level_us)
        self.neutral_us = (vehicle.thruster.neutral_us,) * 4 + (level,) * 4

    def pulses(self, wrench: Array) -> tuple[int, ...]:
        """Pulse widths in us for a wrench (3,), as much of it as the thrusters can give."""
        force, ankle = self.forces(wrench)
        thrust_us = np.rint(self._vehicle.thruster.pulse_us(force))
        ankle_us = np.rint(self._ankle_level_us + self._ankle_us_per_rad * ankle)
        return (*map(int, thrust_us), *map(int, ankle_us))

    def delivered(self, pulse_us: tuple[int, ...]) -> Array:
        """The wrench (3,) of eight pulse widths by the nominal thrust curve: what the estimator is told."""
        pulse = np.array(pulse_us, dtype=np.float64)
        force = self._vehicle.thruster.force_n(pulse[:4])
        ankle = (pulse[4:] - self._ankle_level_us) / self._ankle_us_per_rad
        return self.wrench(force, ankle)

    def wrench(self, force_n: Array, ankle_rad: Array) -> Array:
        """Forward equations: thruster forces (4,) and ankle angles (4,) -> wrench (3,)."""
        level = force_n * np.cos(ankle_rad)
        return np.array([level.sum(), (force_n * np.sin(ankle_rad)).sum(), -(self._y * level).sum()])

    def forces(self, wrench: Array) -> tuple[Array, Array]:
        """Thruster forces (4,) in N and ankle angles (4,) in rad for a wrench (3,)."""
        surge, heave, yaw = (float(value) for value in wrench)
        port, starboard = self._sides(surge, yaw)
        bias_port, bias_starboard = self._biases(port, starboard, abs(heave))
        level = np.where(self._y < 0, port, starboard) + np.where(self._y < 0, bias_port, bias_starboard) * np.where(
            self._front, 1.0, -1.0
        )
        side = np.clip(level / CROSSING_N, -1.0, 1.0)
        lever = float(level @ side)
        tangent = self._within_thrust(level, heave / lever) if lever > 0.0 else 0.0
        slope = tangent * side
        return level * np.sqrt(1.0 + slope * slope), np.arctan(slope)

    def _sides(self, surge: float, yaw: float) -> tuple[float, float]:
        """Horizontal force per leg, port and starboard: surge first, yaw as far as it fits."""
        mean = min(max(0.25 * surge, -self._astern_n), self._ahead_n)
        room = min(self._ahead_n - mean, self._astern_n + mean)
        turn = min(max(0.25 * yaw / self._arm_m, -room), room)
        return mean + turn, mean - turn

    def _biases(self, port: float, starboard: float, heave: float) -> tuple[float, float]:
        """The bias per side: idle thrust, faded out where the side pushes anyway, or what heave needs at 60 degrees.

        A side with force h and bias b gives 2 max(|h|, b) of lever in all, less CROSSING_N / 2 at most for passing level.
        """
        idle = self._vehicle.legs.idle_thrust_n
        need = 0.5 * (heave / STEEPEST_TAN + CROSSING_N) if heave > 0.0 else 0.0
        low, high = sorted((abs(port), abs(starboard)))
        lift = max(0.0, need - high) if need < 2.0 * high else 0.5 * need
        lift = lift if need > low + high else 0.0
        return self._bias(port, max(lift, _faded(idle, port))), self._bias(starboard, max(lift, _faded(idle, starboard)))

    def _bias(self, side: float, bias: float) -> float:
        return max(0.0, min(bias, self._ahead_n - side, self._astern_n + side, self._ahead_n + side, self._astern_n - side))

    def _within_thrust(self, level: Array, tangent: float) -> float:
        """Heave gives way: the steepest common tangent at which no thruster is asked for more than it has."""
        limit = np.where(level >= 0.0, self._ahead_n, self._astern_n)
        size = np.maximum(np.abs(level), 1e-9)
        steepest = math.sqrt(max(float(np.min(limit / size)) ** 2 - 1.0, 0.0))
        steepest = min(steepest, STEEPEST_TAN)
        return min(max(tangent, -steepest), steepest)


def _faded(idle_n: float, side_n: float) -> float:
    """Idle bias beside a side force: whole when the side is quiet, none once it pushes three times as hard."""
    return idle_n * min(1.0, max(0.0, 1.5 - 0.5 * abs(side_n) / idle_n)) if idle_n > 0.0 else 0.0

"""Wrench -> 4 thrusters and 4 ankles -> pulse widths, and back.

    X = sum F_i cos a_i    Z = sum F_i sin a_i    N = -sum y_i F_i cos a_i

for legs in an "H" whose ankles turn in the vertical x-z plane. Per side, front and rear leg carry the same horizontal force
h plus and minus a bias b that cancels out: it keeps small forces clear of the dead zone, and gives the ankles something to
tilt when only heave is asked for. All ankles share one tangent, tan a_i = t g(h_i) with g = -1..1 following the thruster's
sign, so an ankle never turns over when surge reverses. What does not fit gives way in this order: heave, then yaw, then surge.
"""

import math
from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from robot_agent.vehicle.dynamics import Wrench
from wire.config.vehicle import Vehicle
from wire.frames import Array

STEEPEST_RAD = math.radians(60.0)  # beyond, most of a thruster's force is spent on cancelling its neighbour
CROSSING_N = 0.03  # g goes from -1 to 1 over +- this horizontal force: an ankle passes level while its thruster reverses


class Leg(NamedTuple):
    """Position of a leg: 1 fore, -1 aft; port or starboard; distance to starboard."""

    fore: float
    port: bool
    y_m: float


class Allocator:
    """Allocation for one vehicle. Wrenches are [surge N, heave N, yaw N m]; pulses are 4 thrusters, then 4 ankles."""

    def __init__(self, vehicle: Vehicle) -> None:
        legs, curve = vehicle.legs, vehicle.thruster.curve
        self._legs = tuple(Leg(1.0 if along > 0.0 else -1.0, across < 0.0, across) for along, across in legs.position_m)
        self._arm_m, self._idle_n = abs(legs.position_m[0][1]), legs.idle_thrust_n
        self._ahead_n = min(vehicle.thruster.max_thrust_n, curve[-1][1])
        self._astern_n = min(vehicle.thruster.max_thrust_n, -curve[0][1])
        low, high = legs.ankle_us
        self._ankle_level_us, self._ankle_us_per_rad = 0.5 * (low + high), 0.5 * (high - low) / legs.ankle_range_rad
        level = round(self._ankle_level_us)
        self._steepest_tan = math.tan(min(STEEPEST_RAD, legs.ankle_range_rad))
        self.neutral_us = (vehicle.thruster.neutral_us,) * 4 + (level,) * 4
        # Pulses are whole microseconds: the thrust of each there is, and between them where one is nearer than the other.
        self._slowest_us = int(curve[0][0])
        pulses_us = np.arange(self._slowest_us, int(curve[-1][0]) + 1, dtype=np.float64)
        self._thrust_n: list[float] = vehicle.thruster.force_n(pulses_us).tolist()
        self._between_n: list[float] = vehicle.thruster.force_n(pulses_us[:-1] + 0.5).tolist()

    def pulses(self, wrench: Array) -> tuple[int, ...]:
        """Pulse widths (us) for a wrench (3,), as far as the thrusters can deliver it; neutral if it is not finite."""
        if not math.isfinite(sum(wrench.tolist())):
            return self.neutral_us
        force, ankle = self.forces(wrench)
        level_us, per_rad = self._ankle_level_us, self._ankle_us_per_rad
        return (*[self._pulse(f) for f in force], *[round(level_us + per_rad * angle) for angle in ankle])

    def _pulse(self, force_n: float) -> int:
        """Pulse with the nearest thrust of the curve. The smallest lies just outside the dead zone; zero force is neutral."""
        return self._slowest_us + bisect_right(self._between_n, force_n) if force_n else self.neutral_us[0]

    def delivered(self, pulse_us: tuple[int, ...]) -> Wrench:
        """Wrench of eight pulse widths by the nominal thrust curve, for the estimator."""
        return self.wrench(*self._put_out(pulse_us))

    def leg_moments(self, pulse_us: tuple[int, ...]) -> Array:
        """Yaw moment of each leg (4,) for eight pulse widths, N m."""
        force, angle = self._put_out(pulse_us)
        return np.array([-leg.y_m * f * math.cos(a) for leg, f, a in zip(self._legs, force, angle, strict=True)])

    def _put_out(self, pulse_us: tuple[int, ...]) -> tuple[list[float], list[float]]:
        """Thrusts (N) and ankle angles (rad) of eight pulse widths."""
        force = [self._thrust_n[pulse - self._slowest_us] for pulse in pulse_us[:4]]
        return force, [(pulse - self._ankle_level_us) / self._ankle_us_per_rad for pulse in pulse_us[4:]]

    def wrench(self, force_n: Sequence[float], ankle_rad: Sequence[float]) -> Wrench:
        """Forward equations: four thruster forces and ankle angles -> wrench."""
        surge = heave = yaw = 0.0
        for leg, force, angle in zip(self._legs, force_n, ankle_rad, strict=True):
            level = force * math.cos(angle)
            surge, heave, yaw = surge + level, heave + force * math.sin(angle), yaw - leg.y_m * level
        return surge, heave, yaw

    def forces(self, wrench: Sequence[float] | Array) -> tuple[list[float], list[float]]:
        """Four thruster forces in N and ankle angles in rad for a wrench."""
        surge, heave, yaw = map(float, wrench)
        port, starboard = self._sides(surge, yaw)
        bias_port, bias_starboard = self._biases(port, starboard, abs(heave))
        level = [
            (port if leg.port else starboard) + (bias_port if leg.port else bias_starboard) * leg.fore for leg in self._legs
        ]
        side = [min(max(force / CROSSING_N, -1.0), 1.0) for force in level]
        lever = sum(force * share for force, share in zip(level, side, strict=True))
        tangent = self._within_thrust(level, heave / lever) if lever > 0.0 else 0.0
        force = [h * math.sqrt(1.0 + (tangent * share) ** 2) for h, share in zip(level, side, strict=True)]
        return force, [math.atan(tangent * share) for share in side]

    def _sides(self, surge: float, yaw: float) -> tuple[float, float]:
        """Horizontal force per leg, port and starboard: surge first, yaw as far as it fits."""
        mean = min(max(0.25 * surge, -self._astern_n), self._ahead_n)
        room = min(self._ahead_n - mean, self._astern_n + mean)
        turn = min(max(0.25 * yaw / self._arm_m, -room), room)
        return mean + turn, mean - turn

    def _biases(self, port: float, starboard: float, heave: float) -> tuple[float, float]:
        """The bias per side: idle thrust, faded out where the side pushes anyway, or what heave needs at the steepest.

        A side with force h and bias b gives 2 max(|h|, b) of lever in all, less CROSSING_N / 2 at most for passing level.
        """
        idle = self._idle_n
        need = 0.5 * (heave / self._steepest_tan + CROSSING_N) if heave > 0.0 else 0.0
        low, high = sorted((abs(port), abs(starboard)))
        lift = max(0.0, need - high) if need < 2.0 * high else 0.5 * need
        lift = lift if need > low + high else 0.0
        return self._bias(port, max(lift, _faded(idle, port))), self._bias(starboard, max(lift, _faded(idle, starboard)))

    def _bias(self, side: float, bias: float) -> float:
        return max(0.0, min(bias, self._ahead_n - side, self._astern_n + side, self._ahead_n + side, self._astern_n - side))

    def _within_thrust(self, level: list[float], tangent: float) -> float:
        """Heave gives way: the steepest common tangent at which no thruster is asked for more than it has."""
        spare = min((self._ahead_n if h >= 0.0 else self._astern_n) / max(abs(h), 1e-9) for h in level)
        steepest = min(math.sqrt(max(spare * spare - 1.0, 0.0)), self._steepest_tan)
        return min(max(tangent, -steepest), steepest)


def _faded(idle_n: float, side_n: float) -> float:
    """Idle bias beside a side force: whole when the side is quiet, none once it pushes three times as hard."""
    return idle_n * min(1.0, max(0.0, 1.5 - 0.5 * abs(side_n) / idle_n)) if idle_n > 0.0 else 0.0

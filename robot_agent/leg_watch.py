"""Is a leg's force missing? Pure.

A leg that pushes f less than it is told lacks f in surge and y f in yaw at once, y being how far aside it stands. Little else
does: water pushes without turning, a wrong inertia turns without pushing. So of what the observer does not explain, in surge
and in yaw, the smaller counts:

    f = min(|X| - |Y| / 2, |N| / y)        X, Y, N: what is left of the observer's disturbance, times mass

What lasts is taken for granted: of X and Y in the pool's axes, where a current stays when the robot turns (Y, against which no
leg can push, says how restless the water is), of N in the robot's. Of the rest a share of what moves the robot may be a wrong
mass, drag, or thrust; how large that share is with this robot, in this water, shows in flight (unusual.py).

The observer takes a second or two for that; what the gyroscope feels at once is thruster_watch.py's. But where a robot turns
to and fro, a quarter of its moment may be missing without being more than a wrong inertia would make of it; the surge that
comes of it has no such excuse. Of 64 robots with masses, drags and thrusters off by up to 30 %, in still and in rough water,
two were flagged without a reason: on figures of eight, with mass and drag wrong in opposite directions.
"""

import cmath
import math

from robot_agent.unusual import Unusual
from wire.frames import Array
from wire.vehicle import Vehicle

NS = 1_000_000_000
LASTING_S = 5.0  # how fast what stays the same is taken for granted
NOISE_N = 0.02  # what the observer finds in still water with nothing broken
MEAN_S = 1.0  # shares are of means: what comes and goes with a wave is none
MOVED_HELD_S = 1.5  # what moves the robot counts for so long: as long as the observer takes
IDLE_N = 0.1  # a share of less is not asked for
FIRST_SHARE = 0.2  # before there was any
START_HELD_S = 14.0
LEAST_SHARE = 0.15
LASTS_S = 0.5
LONGEST_NS = NS // 5  # between two steps; after a longer gap it begins anew


class LegWatch:
    """One robot's legs, watched step by step."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._mass_kg, self._inertia_kg_m2 = vehicle.mass.surge_kg, vehicle.mass.yaw_kg_m2
        self._linear, self._quadratic = vehicle.drag.linear[3], vehicle.drag.quadratic[3]
        self._aside_m = max(abs(across) for _, across in vehicle.legs.position_m)
        self.reset()

    def reset(self) -> None:
        """Nothing is known of how the robot moves."""
        self.broken = False  # stays so until the next reset
        self._at_ns: int | None = None
        self._surge_n = self._turn_n = self._drag_n = 0.0  # the largest lately; of yaw as forces at the legs
        self._pushed, self._turned_n = 0j, 0.0  # what lasts: x + iy of the pool, N; yaw
        self._missing_n = self._moved_n = 0.0  # means
        self._share = Unusual(FIRST_SHARE, START_HELD_S, START_HELD_S, LEAST_SHARE, LASTS_S)

    def step(self, told: Array, yaw_rate_radps: float, disturbance: Array, yaw_rad: float, now_ns: int) -> None:
        """The wrench (3,) told to the thrusters; what the observer says of yaw and of the disturbance (4,), body frame."""
        ahead, aside, _, turn = disturbance.tolist()
        push, turn_n = self._mass_kg * complex(ahead, aside), self._inertia_kg_m2 * turn / self._aside_m
        heading = cmath.rect(1.0, yaw_rad)
        elapsed_ns = now_ns - self._at_ns if self._at_ns is not None else -1
        if not 0 <= elapsed_ns <= LONGEST_NS:
            broken = self.broken
            self.reset()
            self.broken, self._pushed, self._turned_n = broken, push * heading, turn_n
        elif elapsed_ns:
            elapsed_s = elapsed_ns / NS
            learned, mean = -math.expm1(-elapsed_s / LASTING_S), -math.expm1(-elapsed_s / MEAN_S)
            left = push - self._pushed / heading
            missing = min(abs(left.real) - 0.5 * abs(left.imag), abs(turn_n - self._turned_n)) - NOISE_N
            self._pushed += learned * (push * heading - self._pushed)
            self._turned_n += learned * (turn_n - self._turned_n)
            self._missing_n += mean * (max(missing, 0.0) - self._missing_n)
            self._moved_n += mean * (self._moved(told, yaw_rate_radps, elapsed_s) - self._moved_n)
            self.broken |= self._share.step(self._missing_n / max(self._moved_n, IDLE_N), elapsed_s, now_ns)
        self._at_ns = now_ns

    def _moved(self, wrench: Array, yaw_rate_radps: float, elapsed_s: float) -> float:
        """The largest force lately that one leg was told, or has to overcome when the robot turns."""
        surge, _, yaw = wrench.tolist()
        drag = (self._linear + self._quadratic * abs(yaw_rate_radps)) * abs(yaw_rate_radps)
        kept = math.exp(-elapsed_s / MOVED_HELD_S)
        self._surge_n = max(self._surge_n * kept, abs(surge))
        self._turn_n = max(self._turn_n * kept, abs(yaw) / self._aside_m)
        self._drag_n = max(self._drag_n * kept, drag / self._aside_m)
        return 0.25 * (self._surge_n + self._turn_n + self._drag_n)

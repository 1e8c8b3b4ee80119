"""Do the thrusters turn the robot as they are told, as far as the gyroscope can tell? Pure.

Each leg turns the robot as it pushes, and the gyroscope feels that at once: a thruster that is dead, weak, reversed or stuck
leaves a yaw moment that nothing else explains. A first-order observer of the yaw rate r,

    r^' = (N - d(r^)) / m_r + (r - r^) / T        residual = m_r (r - r^) / T

gives that moment smoothed over T, without differences of a noisy rate. Mass, voltage, drag and curve are never known exactly,
thrusters are not alike, and a gyroscope has a bias: how far the residual goes with N, with d(r) and with nothing is learned in
flight (habit.py), so a leg that is missing from a turn shows as soon as it is known how this robot turns. What is left over is
held against what was left over before (unusual.py), so a robot in rough water bears more.

What it cannot see is a thruster that is told next to nothing, or goes on doing what it did when it stuck, for as long as that
is what it is told: neither moves the robot. Limits are measured, on flights of the article's robot with masses and thrusters
off by 30 %, in waves and gusts (tests/robot_agent/test_thruster_watch.py).
"""

import math
from collections import deque

import numpy as np

from robot_agent.habit import Habit
from robot_agent.unusual import Unusual
from wire.vehicle import Vehicle

NS = 1_000_000_000
SMOOTH_S = 0.3  # T: noise of the gyroscope, 3 mrad/s, is then 1.2 mN m; one idle thruster of the article's robot turns with 12
SPREAD = (0.3, 0.3, 0.004)  # how far the residual may go with N, with d(r), and with nothing (N m), before any of it is known
NOISE_NM = (0.002, 0.0007)  # of the residual: at first, and at least
SAME_S = 2.0 * SMOOTH_S  # residuals closer together say the same
SURE = 2.0  # standard deviations of what is not yet known
SHARE = 0.07  # of the largest N in the last HELD_S, smoothed alike: lags and curves may be off
HELD_S = 0.5
FIRST_SHARE = 0.4  # starts are rough, in any water: at first a larger share is asked for,
FIRST_NM = 0.018  # and this stands for what was left over before there was anything;
FIRST_HELD_S = 4.5  # for so long
START_HELD_S = 7.0
LEAST_NM = 0.002  # noise
LASTS_S = 0.4  # a bump is shorter
LONGEST_NS = NS // 5  # between two steps; after a longer gap the observer begins anew,
APART_NS = NS // 20  # as it does if the board's clock tells otherwise how long it was: what is heard late says nothing of now
NO_CAUSE = (0.0, 0.0, 0.0)  # N, d(r), and what is always there, smoothed as the residual is since the observer began


class ThrusterWatch:
    """One robot's thrusters, watched step by step."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._mass, self._lag_s = vehicle.mass.yaw_kg_m2, vehicle.thruster.lag_s
        self._linear, self._quadratic = vehicle.drag.linear[3], vehicle.drag.quadratic[3]
        self._dead_ns = round(vehicle.thruster.dead_time_s * NS)
        self._told: deque[tuple[int, float]] = deque(maxlen=64)  # from when on it acts, yaw moment
        self.reset()

    def reset(self) -> None:
        """Nothing is known of how the robot moves."""
        self.broken = False  # stays so until the next reset
        self._rate: float | None = None
        self._at_ns = self._board_ns = 0
        self._acting = self._strongest = 0.0
        self._causes = np.array(NO_CAUSE)
        self._share = FIRST_SHARE
        self._habit = Habit(SPREAD, *NOISE_NM, SAME_S)
        self._left_over = Unusual(FIRST_NM, FIRST_HELD_S, START_HELD_S, LEAST_NM, LASTS_S)

    def told(self, moment_nm: float, now_ns: int) -> None:
        """Pulses went out that turn the robot with this moment. Of two at one instant the last counts."""
        acts_ns = now_ns + self._dead_ns
        if self._told and self._told[-1][0] == acts_ns:
            self._told.pop()
        self._told.append((acts_ns, moment_nm))

    def step(self, yaw_rate_radps: float, at_ns: int, board_ns: int) -> None:
        """The gyroscope's yaw rate at an instant, and when that was by the board's clock; one that was given before is not
        looked at again."""
        elapsed_ns, board_elapsed_ns = at_ns - self._at_ns, board_ns - self._board_ns
        if self._rate is None or not 0 <= elapsed_ns <= LONGEST_NS or abs(elapsed_ns - board_elapsed_ns) > APART_NS:
            self._begin(yaw_rate_radps, at_ns, board_ns)
        elif elapsed_ns:
            elapsed_s, self._at_ns, self._board_ns = elapsed_ns / NS, at_ns, board_ns
            drag = (self._linear + self._quadratic * abs(self._rate)) * self._rate
            push = self._push(at_ns - elapsed_ns, at_ns) / elapsed_s
            residual = self._observe(self._rate, yaw_rate_radps, push - drag, elapsed_s)
            self._causes = self._causes - math.expm1(-elapsed_s / SMOOTH_S) * (np.array([push, drag, 1.0]) - self._causes)
            self._strongest = max(self._strongest * math.exp(-elapsed_s / HELD_S), abs(float(self._causes[0])))
            self._share -= math.expm1(-elapsed_s / FIRST_HELD_S) * (SHARE - self._share)
            usual, doubt = self._habit.expect(self._causes)
            self._habit.note(self._causes, residual, elapsed_s, at_ns)
            left_over = abs(residual - usual) - SURE * doubt - self._share * self._strongest
            self.broken |= self._left_over.step(max(left_over, 0.0), elapsed_s, at_ns)

    def _begin(self, yaw_rate_radps: float, at_ns: int, board_ns: int) -> None:
        """Observe from here. What has been learned of the robot holds, if there was a gap."""
        if self._rate is not None and at_ns > self._at_ns:
            self._push(self._at_ns, at_ns)
        self._rate, self._at_ns, self._board_ns = yaw_rate_radps, at_ns, board_ns
        self._causes = np.array(NO_CAUSE)

    def _push(self, from_ns: int, to_ns: int) -> float:
        """Let the thrusters follow what they were told; the integral of their moment."""
        impulse = 0.0
        while from_ns < to_ns:
            while len(self._told) > 1 and self._told[1][0] <= from_ns:
                self._told.popleft()
            wanted = self._told[0][1] if self._told and self._told[0][0] <= from_ns else 0.0
            until_ns = min([to_ns, *(acts_ns for acts_ns, _ in self._told if acts_ns > from_ns)])
            span_s, behind = (until_ns - from_ns) / NS, self._acting - wanted
            left = math.exp(-span_s / self._lag_s) if self._lag_s > 0.0 else 0.0
            impulse += wanted * span_s + behind * self._lag_s * (1.0 - left)
            self._acting, from_ns = wanted + behind * left, until_ns
        return impulse

    def _observe(self, rate: float, measured: float, moment: float, elapsed_s: float) -> float:
        """The residual moment."""
        predicted = rate + elapsed_s * moment / self._mass
        self._rate = predicted - math.expm1(-elapsed_s / SMOOTH_S) * (measured - predicted)
        return self._mass * (measured - self._rate) / SMOOTH_S

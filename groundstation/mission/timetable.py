"""Timetable and pace of a flight: the progress that every robot has to have, and how far the formation lags behind it. Pure.

The timetable is the instant at which a flight began. START and RESUME carry the same two numbers to the robots, so the station
can compare their states with its own timetable. The progress governor is formation feedback on the virtual structure, whose
clock slows down while a robot lags.
"""

import math
from dataclasses import dataclass

from groundstation.telemetry import RobotView
from shoal.config.mission import MissionConfig
from shoal.config.vehicle import Vehicle
from shoal.messages.messages import Mode

START_IN_S = (
    0.5  # from a command to its effect in all robots at one instant; shorter, and a robot that is sent it twice joins late
)
TIME_CONSTANT_S = 0.7  # slower than a robot's own tracking (0.3 s); faster, the two loops oscillate against each other
MAX_STEP_S = 0.1  # longest integration step: after a stall of the station the rate goes on without a leap
ON_TIME = 1e-4  # a rate nearer than this to 1 is set to 1
NOTICED = 0.95  # below this rate the mission goes to SLOWED


class ProgressGovernor:
    """Rate of the virtual structure's clock (1: on time), and its lag behind the timetable in s.

    The target rate falls from 1 at `wait_from_m` to `slowest` at `wait_at_m` of the worst robot's tracking error. The rate
    follows it through a critically damped second-order lag, so that no reference jumps in velocity or acceleration.
    """

    def __init__(self, conduct: MissionConfig) -> None:
        self.lag_s = 0.0
        self.rate = 1.0
        self._change_per_s = 0.0
        self._conduct = conduct

    def reset(self) -> None:
        """Go back to full rate and keep the lag; a formation that holds waits for no robot."""
        self.rate, self._change_per_s = 1.0, 0.0

    def start(self) -> None:
        """Begin a run on time."""
        self.reset()
        self.lag_s = 0.0

    @property
    def slowed(self) -> bool:
        """True if the rate is low enough to tell people."""
        return self.rate < NOTICED

    def step(self, worst_error_m: float | None, elapsed_s: float) -> None:
        """Go on by `elapsed_s` with the worst tracking error; None: wait for no robot.

        The lag grows by all of `elapsed_s`, as the robots were told. The rate changes by no more than in MAX_STEP_S.
        """
        self.lag_s += (1.0 - self.rate) * elapsed_s
        if worst_error_m is None:
            self.reset()
            return
        target, step_s = self._target(worst_error_m), min(elapsed_s, MAX_STEP_S)
        if target == self.rate == 1.0 and self._change_per_s == 0.0:
            return  # exactly on time stays exactly so
        pull = (target - self.rate) / TIME_CONSTANT_S**2 - 2.0 / TIME_CONSTANT_S * self._change_per_s
        self._change_per_s += pull * step_s
        self.rate = min(max(self.rate + self._change_per_s * step_s, self._conduct.slowest), 1.0)
        if target == 1.0 and 1.0 - self.rate < ON_TIME and abs(self._change_per_s) < ON_TIME:
            self.reset()

    def _target(self, error_m: float) -> float:
        begin = self._conduct.wait_from_m
        if begin is None or error_m <= begin:
            return 1.0
        share = min((error_m - begin) / (self._conduct.wait_at_m - begin), 1.0)
        return 1.0 - share * (1.0 - self._conduct.slowest)


def turn_s(vehicle: Vehicle, angle_rad: float) -> float:
    """Time for a turn on the spot before a robot sets out: half of it with all of the yaw moment, half against it, and at the
    greatest rate. A vehicle with side thrust sets out at any heading."""
    if vehicle.limits.has_sway:
        return 0.0
    limits, angle = vehicle.limits, abs(angle_rad)
    return 2.0 * math.sqrt(angle * vehicle.mass.yaw_kg_m2 / limits.wrench[2]) + angle / limits.yaw_rate_radps


@dataclass(frozen=True)
class Timetable:
    """`from_s` on the timetable is at `start_ns` on the station's clock; before that it stands still."""

    start_ns: int
    from_s: float

    def at_s(self, now_ns: int) -> float:
        """Point of the timetable at an instant of the station's clock."""
        return self.from_s + max(now_ns - self.start_ns, 0) * 1e-9

    def behind_s(self, robot: RobotView, governor: ProgressGovernor, now_ns: int) -> float:
        """Lag of a robot behind the fleet, from its own state; negative: ahead. 0 if it is not flying, or not heard.

        The state has an age, and the formation's lag has changed since; both are taken into account.
        """
        if not robot.heard or robot.mode is not Mode.TRACKING:
            return 0.0
        lag_s = governor.lag_s - (1.0 - governor.rate) * robot.state_age_s
        return self.at_s(now_ns - round(robot.state_age_s * 1e9)) - lag_s - robot.trajectory_s

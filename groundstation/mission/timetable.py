"""The timetable of a flight: the instant at which it began, and so the progress that every robot has to have. Pure.

START and RESUME carry the same two numbers to the robots, so the station can compare their states with its own timetable.
"""

import math
from dataclasses import dataclass

from groundstation.mission.progress_governor import ProgressGovernor
from groundstation.telemetry import RobotView
from shoal.config.vehicle import Vehicle
from shoal.messages.messages import Mode

START_IN_S = (
    0.5  # from a command to its effect in all robots at one instant; shorter, and a robot that is sent it twice joins late
)


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

"""When a flight began, and so where along its trajectories everybody is to be. Pure. Robots are sent the same two numbers
(START, RESUME), so that the station can hold what they say of themselves against its own timetable."""

from dataclasses import dataclass

from groundstation.mission.progress_governor import Pace
from groundstation.telemetry import RobotView
from wire.messages.messages import Mode


@dataclass(frozen=True)
class Timetable:
    """`from_s` on the timetable is at `start_ns` on the station's clock; before that it stands."""

    start_ns: int
    from_s: float

    def at_s(self, now_ns: int) -> float:
        """The timetable at an instant."""
        return self.from_s + max(now_ns - self.start_ns, 0) * 1e-9

    def behind_s(self, robot: RobotView, pace: Pace, now_ns: int) -> float:
        """How far a robot is behind the fleet, by what it says of itself; negative: ahead of it. 0 if it is not flying, or not
        heard. What it says is from some time ago, and the formation's lag was another then."""
        if not robot.heard or robot.mode is not Mode.TRACKING:
            return 0.0
        lag_s = pace.lag_s - (1.0 - pace.rate) * robot.state_age_s
        return self.at_s(now_ns - round(robot.state_age_s * 1e9)) - lag_s - robot.trajectory_s

"""Limits of surge and sway that keep the hull upright, by the tilt that the board measures.

Thrust below the centre pitches the hull, and the water pitches it on, by (m_w - m_u) v^2 per radian. No file says how fast a
hull may go: its true mass enters this moment, and with less drag than in the file the same thrust makes it faster. So the
thrust that it may have is found in flight. Beyond the tilt it is lessened, quickly; below, it is renewed, slowly: a hull that
is nearly too fast swings with a period of many seconds, which a limit that followed the tilt alone would keep up.
"""

import math

import numpy as np

from robot_agent.control.nonlinear.tuning import SURGE, TILT_RAD, WRENCH_AXIS, planar_axes, planar_limits
from robot_agent.vehicle.estimate import StateMeasurement
from shoal.config.vehicle import Vehicle

WHOLE_LEAN, LAST_LEAN = 0.9, 1.3  # of TILT_RAD: up to here thrust may tilt the hull on, and from here on none may
LESSENS_PER_S = 4.0  # per TILT_RAD beyond it: within a quarter of the shortest swing of the grid, 1.2 s
RENEWS_PER_S = 0.05  # of the whole, for a hull that is level: slower than any swing, sooner than a turn of the path


class UprightThrust:
    """Thrust that a hull may have. A vehicle without a righting moment in its file keeps what the file says."""

    def __init__(self, vehicle: Vehicle) -> None:
        self.limits = planar_limits(vehicle)  # for the plan
        self.most = np.array(vehicle.limits.wrench)  # for the coming period, ahead, to starboard and so on,
        self.least = -self.most  # and the other way
        self._whole = self.limits.size.tolist()
        self._axes = planar_axes(vehicle)[:-1] if vehicle.righting is not None else ()
        swing_s = vehicle.righting.swing_s if vehicle.righting is not None else 0.0
        self._lead_s = vehicle.thruster.dead_time_s + vehicle.thruster.lag_s + swing_s / math.tau  # thrust acts then

    def step(self, measurement: StateMeasurement, period_s: float) -> None:
        """Take in a tilt: thrust ahead lifts the bow, and thrust to starboard the starboard side."""
        pitch = measurement.pitch_rad + self._lead_s * measurement.pitch_rate_radps
        roll = measurement.roll_rad + self._lead_s * measurement.roll_rate_radps
        for i, axis in enumerate(self._axes):
            lean = (pitch if axis == SURGE else -roll) / TILT_RAD
            beyond = abs(lean) - 1.0
            size_n = float(self.limits.size[i]) * math.exp(-LESSENS_PER_S * max(beyond, 0.0) * period_s)
            size_n = min(size_n + RENEWS_PER_S * max(-beyond, 0.0) * self._whole[i] * period_s, self._whole[i])
            self.limits.size[i] = size_n
            self.least[WRENCH_AXIS[axis]] = -size_n * tilting_share(-lean)
            self.most[WRENCH_AXIS[axis]] = size_n * tilting_share(lean)


def tilting_share(lean: float) -> float:
    """Share of the thrust that may tilt a hull on which leans that way already, by so many TILT_RAD."""
    return min(max((LAST_LEAN - lean) / (LAST_LEAN - WHOLE_LEAN), 0.0), 1.0)

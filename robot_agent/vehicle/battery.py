"""State of the battery for arming and flying. Pure.

One raw voltage says little: under load it sags by more than the distance between two thresholds, and one reading may be wrong
altogether. So the median of three is smoothed over 1 s, as the board smooths it (docs/board.md, rule 6).

The board's own charge state counts as well: the board measures more often, and its thresholds may differ from those of the
vehicle file.
"""

import math
from collections import deque

from shoal.config.vehicle import Battery
from shoal.messages.messages import BoardReading

SMOOTH_S = 1.0  # time constant; docs/board.md, rule 6
REPORTED_S = 5.0  # ten reports of the board: a voltage that is older is not known
NO_ARM = frozenset({3, 4, 5, 6, 7})  # MAV_BATTERY_CHARGE_STATE: critical, emergency, failed, unhealthy, charging
EMPTY = frozenset({4, 5, 6})


class BatteryMonitor:
    """Voltage and charge state of one battery, from the board's reports."""

    def __init__(self, battery: Battery) -> None:
        self.voltage_v: float | None = None  # smoothed; None: none has been told
        self.charge = 0  # the board's own opinion: MAV_BATTERY_CHARGE_STATE, 0 not known
        self._battery = battery
        self._low = False  # it may not arm, and may not until it is well above the threshold again
        self._raw_v: deque[float] = deque(maxlen=3)  # the last reports
        self._median_v = 0.0  # of them
        self._noted_ns = self._reported_ns = 0
        self._reports = -1

    def note_board(self, board: BoardReading, now_ns: int) -> None:
        """Take in the board's newest report. An old log counts no reports: there every voltage above 0 is one."""
        elapsed_s, self._noted_ns = max(now_ns - self._noted_ns, 0) * 1e-9, now_ns
        self.charge = board.charge
        if board.battery_reports == 0 and board.battery_v <= 0.0:
            return
        before_v = self._median_v
        if board.battery_reports != self._reports or board.battery_reports == 0:
            self._reports, self._reported_ns = board.battery_reports, now_ns
            self._raw_v.append(board.battery_v)
            self._median_v = sorted(self._raw_v)[len(self._raw_v) // 2]
        if self.voltage_v is None:
            self.voltage_v = board.battery_v
        else:  # until now the median before held
            self.voltage_v += (before_v - self.voltage_v) * -math.expm1(-elapsed_s / SMOOTH_S)
        above_v = self._battery.hysteresis_v if self._low else 0.0
        self._low = self.voltage_v < self._battery.no_arm_v + above_v

    @property
    def empty(self) -> bool:
        """True if thrusters have to stop; false while the voltage is unknown."""
        return self.charge in EMPTY or (self.voltage_v is not None and self.voltage_v < self._battery.neutral_v)

    def arming_refusal(self, now_ns: int) -> str:
        """Return the reason not to arm with this battery; empty if there is none."""
        if self.voltage_v is None:
            return "the battery's voltage has not been told by the thruster board yet"
        age_s = (now_ns - self._reported_ns) * 1e-9
        if age_s > REPORTED_S:
            return f"the battery's voltage was last told {age_s:.1f} s ago"
        if self._low:
            needs_v = self._battery.no_arm_v + self._battery.hysteresis_v
            below = f"since it was below {self._battery.no_arm_v:.1f} V"
            return f"the battery has {self.voltage_v:.1f} V, needs {needs_v:.1f} V {below}"
        if self.charge in NO_ARM:
            return f"the thruster board does not arm with this battery: charge state {self.charge}, {self.voltage_v:.1f} V"
        return ""

"""The thruster board as one state machine: the reference for a lab's firmware. The rules are in docs/board.md.

Bytes and the time come in, bytes and pulses go out. All times are ns of the board's own clock. Whatever the link does, the
pulses of a board that is stepped are neutral unless it is armed, and a valid override is young enough.
"""

import math
from collections.abc import Sequence
from enum import IntEnum

import numpy as np

from sim_bridge.sensors import BoardSensors, Reading
from wire import mavlink
from wire.experiment import Experiment
from wire.frames import Array
from wire.mavlink import IGNORED, Arm, BoardLink, Override, Timesync, Unsupported
from wire.vehicle import Battery

THRUSTERS = 4
MS_NS, S_NS = 1_000_000, 1_000_000_000
STATUS_NS, HEARTBEAT_NS = S_NS // 2, S_NS
BATTERY_FILTER_S = 1.0  # thrust pulls the voltage down for moments; that is no empty battery

COMPONENT_ARM_DISARM = 400  # MAV_CMD
CRITICAL, WARNING, INFO = 2, 4, 6  # MAV_SEVERITY
GYRO, ACCELEROMETER, PRESSURE, MOTORS, BATTERY = 0x1, 0x2, 0x8, 0x8000, 0x2000000  # MAV_SYS_STATUS_SENSOR


class Charge(IntEnum):
    """How low the battery is, and what that forbids."""

    GOOD = 0
    WARN = 1
    NO_ARM = 2
    NEUTRAL = 3


class BatteryWatch:
    """Smoothed voltage against thresholds. A level is entered below its threshold, and left only well above it."""

    def __init__(self, battery: Battery) -> None:
        self._thresholds_v = (battery.warn_v, battery.no_arm_v, battery.neutral_v)
        self._hysteresis_v = battery.hysteresis_v
        self._voltage: float | None = None
        self.charge = Charge.GOOD

    def update(self, voltage: float, elapsed_s: float) -> Charge:
        """The level after a measurement that comes `elapsed_s` after the one before."""
        if self._voltage is None:
            self._voltage = voltage
        self._voltage += (voltage - self._voltage) * -math.expm1(-elapsed_s / BATTERY_FILTER_S)
        below = sum(self._voltage < threshold for threshold in self._thresholds_v)
        not_clear = sum(self._voltage < threshold + self._hysteresis_v for threshold in self._thresholds_v)
        self.charge = Charge(min(max(self.charge, below), not_clear))
        return self.charge


class Board:
    """One robot's thruster board."""

    def __init__(self, experiment: Experiment, robot_id: int, seed: int) -> None:
        vehicle, sensors = experiment.vehicle, experiment.sim.sensors
        self._vehicle, self._rules, self._supply_v = vehicle, experiment.sim.board, sensors.battery_v
        self._link = BoardLink(robot_id)
        self.sensors = BoardSensors(sensors, robot_id, seed)
        self._battery = BatteryWatch(vehicle.battery)
        self._burst_ns = round(S_NS / sensors.rate_hz)
        self._outbox: list[bytes] = []
        self._command: tuple[int, ...] = ()
        self._command_ns = 0
        self._last_step_ns: int | None = None
        self._last_burst_ns: int | None = None
        self._thrusters_us = [float(vehicle.thruster.neutral_us)] * THRUSTERS
        self._ankles_us = [round(sum(vehicle.legs.ankle_us) / 2)] * THRUSTERS
        self.armed = False
        self.burst_ms = -1  # board time of the last burst sent, as ATTITUDE carries it
        self.overrides_received = 0  # every one that was for this board, refused ones too
        self.overrides_refused = 0

    @property
    def pulses(self) -> tuple[int, ...]:
        """What is on the outputs, in us: 4 thrusters, 4 ankles."""
        return (*(round(pulse) for pulse in self._thrusters_us), *self._ankles_us)

    def receive(self, data: bytes, now_ns: int) -> None:
        """Bytes from the robot's computer. Never raises, whatever they are."""
        for event in self._link.receive(data, now_ns):
            match event:
                case Override(pulses_us):
                    self._take(pulses_us, now_ns)
                case Arm(arm):
                    self._outbox.append(self._link.acknowledge(COMPONENT_ARM_DISARM, self._order(arm, now_ns)))
                case Timesync(sent_ns):
                    self._outbox.append(self._link.timesync(max(now_ns, 1), sent_ns))
                case Unsupported(command):
                    self._outbox.append(self._link.acknowledge(command, mavlink.UNSUPPORTED))

    def measures(self, now_ns: int) -> bool:
        """Whether the step to this instant reads the sensors."""
        return _crosses(self._burst_ns, self._last_step_ns, now_ns)

    def step(
        self,
        now_ns: int,
        eta: Array,
        nu: Array,
        acceleration: Array,
        supply_v: float | None = None,
        tilt: Array | Sequence[float] = (0.0, 0.0),
    ) -> bytes:
        """Run the rules, move the outputs, measure. Returns what to send, which is nothing between bursts.

        `eta`, `nu` and `acceleration` (d nu / dt), each (4,), are the robot's true motion; they count only in a step that
        `measures`. `supply_v` is the battery's voltage without load (default: the experiment's), `tilt` begins with roll and
        pitch.
        """
        if self.armed and self._is_stale(now_ns):
            self._disarm(WARNING, f"disarmed: no override for {self._rules.neutral_after_s * 1000:.0f} ms")
        voltage = None
        if self.measures(now_ns):
            voltage = self.sensors.battery_v(self._supply_v if supply_v is None else supply_v, self._load())
            self._watch(voltage, _seconds(self._last_burst_ns, now_ns))
        self._move(_seconds(self._last_step_ns, now_ns))
        if voltage is not None:
            self._burst(now_ns, self.sensors.read(eta, nu, acceleration, tilt), voltage)
            self._last_burst_ns = now_ns
        self._last_step_ns = now_ns
        data = b"".join(self._outbox)
        self._outbox.clear()
        return data

    def _is_stale(self, now_ns: int) -> bool:
        return not self._command or now_ns - self._command_ns > self._rules.neutral_after_s * S_NS

    def _take(self, pulses_us: tuple[int, ...], now_ns: int) -> None:
        self.overrides_received += 1
        if not self._is_allowed(pulses_us):
            self.overrides_refused += 1
            return
        self._command, self._command_ns = pulses_us, now_ns

    def _is_allowed(self, pulses_us: tuple[int, ...]) -> bool:
        curve, (lowest, highest) = self._vehicle.thruster.curve, self._vehicle.legs.ankle_us
        thrusters, ankles = pulses_us[:THRUSTERS], pulses_us[THRUSTERS:]
        return all(curve[0][0] <= pulse <= curve[-1][0] for pulse in thrusters) and all(
            lowest <= pulse <= highest or pulse == IGNORED for pulse in ankles
        )

    def _order(self, arm: bool, now_ns: int) -> int:
        """Arm or disarm; returns the MAV_RESULT."""
        if not arm:
            if self.armed:
                self._disarm(INFO, "disarmed")
            return mavlink.ACCEPTED
        if self.armed:
            return mavlink.ACCEPTED
        reason = self._why_not_arm(now_ns)
        if reason:
            self._outbox.append(self._link.text(WARNING, f"not armed: {reason}"))
            return mavlink.REJECTED
        self.armed = True
        self._outbox += [self._link.text(INFO, "armed"), self._heartbeat()]
        return mavlink.ACCEPTED

    def _why_not_arm(self, now_ns: int) -> str:
        if self._is_stale(now_ns):
            return "no override is arriving"
        if self._vehicle.thruster.force_n(np.array(self._command[:THRUSTERS])).any():
            return "thruster pulses are not neutral"
        if self._battery.charge >= Charge.NO_ARM:
            return "battery low"
        return ""

    def _disarm(self, severity: int, reason: str) -> None:
        self.armed = False
        self._outbox += [self._link.text(severity, reason), self._heartbeat()]

    def _heartbeat(self) -> bytes:
        return self._link.heartbeat(self.armed, healthy=self._battery.charge < Charge.NO_ARM)

    def _move(self, elapsed_s: float) -> None:
        """Neutral at once when disarmed; otherwise towards the command, thrusters no faster than the slew rate."""
        if not self.armed:
            self._thrusters_us = [float(self._vehicle.thruster.neutral_us)] * THRUSTERS
            return
        reach = self._rules.slew_us_per_s * elapsed_s
        wanted, ankles = self._command[:THRUSTERS], self._command[THRUSTERS:]
        pairs = zip(self._thrusters_us, wanted, strict=True)
        self._thrusters_us = [now + min(max(goal - now, -reach), reach) for now, goal in pairs]
        held = zip(self._ankles_us, ankles, strict=True)
        self._ankles_us = [now if goal == IGNORED else goal for now, goal in held]

    def _burst(self, now_ns: int, reading: Reading, voltage: float) -> None:
        """All that the board measures, ATTITUDE last: whoever has that has the whole burst."""
        link = self._link
        self.burst_ms = now_ns // MS_NS % 2**32
        self._outbox += [
            link.imu(self.burst_ms, reading.acceleration_mps2, reading.yaw_rate_radps),
            link.pressure(self.burst_ms, reading.depth_m),
            link.servo_output(now_ns // 1000, self.pulses),
        ]
        if _crosses(STATUS_NS, self._last_burst_ns, now_ns):
            sensors = GYRO | ACCELEROMETER | PRESSURE | MOTORS | BATTERY
            healthy = sensors if self._battery.charge is Charge.GOOD else sensors & ~BATTERY
            self._outbox.append(link.status(voltage, sensors, healthy, self.overrides_refused + link.refused_frames))
        if _crosses(HEARTBEAT_NS, self._last_burst_ns, now_ns):
            self._outbox.append(self._heartbeat())
        self._outbox.append(link.attitude(self.burst_ms, reading.heading_rad, reading.yaw_rate_radps))

    def _load(self) -> float:
        """Thrust asked of the battery, as a fraction of all thrusters at full."""
        thruster = self._vehicle.thruster
        force_n = np.abs(thruster.force_n(np.array(self._thrusters_us)))
        return float(force_n.sum()) / (THRUSTERS * thruster.max_thrust_n)

    def _watch(self, voltage: float, elapsed_s: float) -> None:
        before = self._battery.charge
        charge = self._battery.update(voltage, elapsed_s)
        if charge is before:
            return
        severity = CRITICAL if charge is Charge.NEUTRAL else WARNING if charge > before else INFO
        self._outbox.append(self._link.text(severity, f"battery {charge.name}: {voltage:.1f} V"))
        if charge is Charge.NEUTRAL and self.armed:
            self._disarm(CRITICAL, "disarmed: battery empty")


def _crosses(period_ns: int, since_ns: int | None, now_ns: int) -> bool:
    """Whether a multiple of the period lies in (since, now]."""
    return since_ns is None or now_ns // period_ns > since_ns // period_ns


def _seconds(since_ns: int | None, now_ns: int) -> float:
    return 0.0 if since_ns is None else max(now_ns - since_ns, 0) / S_NS

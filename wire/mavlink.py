"""The thruster link, sans-IO: MAVLink 2 (common dialect) between a robot's computer and its thruster board, both ends.

Bytes in, bytes out; sockets, serial ports and clocks belong to the callers. The robot's id is the MAVLink system id of both
ends. What a firmware must do beyond the encoding is in docs/board.md; how frames are found in the stream, in
wire/mavlink_frames.py.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from pymavlink.dialects.v20 import common as dialect

from wire.mavlink_frames import LOSS_WINDOW_NS, MARKER, Receiver, Sender

BOARD_COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1
AGENT_COMPONENT = 191  # MAV_COMP_ID_ONBOARD_COMPUTER

CHANNELS = 8  # 4 thrusters, 4 ankles
IGNORED = 65535  # RC_CHANNELS_OVERRIDE: leave this channel as it is
PULSE_RANGE_US = (500, 2500)  # what a servo or a speed controller can take at all; the board knows the vehicle's own limits

WATER_DENSITY_KGPM3 = 998.0  # fresh water at 20 degrees
GRAVITY_MPS2 = 9.81
SURFACE_HPA = 1013.25
STANDARD_GRAVITY_MPS2 = 9.80665  # defines the mG of SCALED_IMU

PROTOCOL_VERSION = 3  # what a HEARTBEAT says for MAVLink 2
TEXT_LENGTH = 50  # of a STATUSTEXT
TEXTS_KEPT = 16

ACCEPTED, REJECTED, UNSUPPORTED = 0, 1, 3  # MAV_RESULT; rejected: for now


def depth_to_hpa(depth_m: float) -> float:
    """Absolute pressure in hPa at a depth in fresh water."""
    return SURFACE_HPA + WATER_DENSITY_KGPM3 * GRAVITY_MPS2 * depth_m / 100.0


def hpa_to_depth(pressure_hpa: float) -> float:
    """Depth in m in fresh water for an absolute pressure."""
    return (pressure_hpa - SURFACE_HPA) * 100.0 / (WATER_DENSITY_KGPM3 * GRAVITY_MPS2)


def is_override(datagram: bytes) -> bool:
    """Whether a datagram of an agent, one frame each, sets pulses; nothing else about it is checked."""
    kind = int.from_bytes(datagram[7:10], "little")
    return datagram[:1] == bytes([MARKER]) and kind == dialect.MAVLINK_MSG_ID_RC_CHANNELS_OVERRIDE


@dataclass(frozen=True)
class Telemetry:
    """What the board last said, complete as of the burst of `board_ms`. Values are finite and within a sensor's range."""

    board_ms: int = -1  # the board's time of the last burst; -1: none yet
    arrival_ns: int = 0  # when that burst arrived, on the receiver's clock
    heading_rad: float = 0.0
    yaw_rate_radps: float = 0.0
    acceleration_mps2: tuple[float, float, float] = (0.0, 0.0, 0.0)  # specific force, body frame
    depth_m: float = 0.0
    battery_v: float = 0.0  # 0: not heard yet
    armed: bool = False
    echo_us: tuple[int, ...] = ()  # what the board put out: 4 thrusters, 4 ankles
    acknowledged: tuple[int, int] | None = None  # last COMMAND_ACK: command, MAV_RESULT
    acknowledgements: int = 0
    texts: tuple[tuple[int, str], ...] = ()  # the last few STATUSTEXT: severity (0 worst, 7 debug), text
    texts_received: int = 0
    clock_offset_ns: int = 0  # board's clock minus ours, from the last TIMESYNC
    round_trip_ns: int = 0
    loss: float = 0.0  # fraction of the board's frames lost over 5 s
    bad_frames: int = 0
    foreign_frames: int = 0
    stale_frames: int = 0
    refused_frames: int = 0  # intact, but with a value that cannot be true


class _Refused(Exception):
    """A frame is intact, but its content is not acceptable."""


def _within(value: float, low: float, high: float) -> float:
    if not low <= value <= high:  # false for NaN too
        raise _Refused
    return value


def _pulses(message: Any, field: str, ignorable: bool) -> tuple[int, ...]:
    """The 8 pulses of a message whose fields are named like `field`, e.g. servo{}_raw."""
    pulses = tuple(getattr(message, field.format(i + 1)) for i in range(CHANNELS))
    low, high = PULSE_RANGE_US
    if not all(low <= pulse <= high or (ignorable and pulse == IGNORED) for pulse in pulses):
        raise _Refused
    return pulses


class AgentLink:
    """The robot's computer: packs commands, keeps the telemetry."""

    def __init__(self, robot_id: int) -> None:
        self._robot_id = robot_id
        self._sender = Sender(robot_id, AGENT_COMPONENT)
        self._receiver = Receiver(robot_id, BOARD_COMPONENT)
        self._refused = 0
        self.telemetry = Telemetry()

    def pulses(self, pulses_us: Sequence[int]) -> bytes:
        """Command the 8 outputs in us: 4 thrusters, 4 ankles. Raises ValueError for a pulse that no servo can take."""
        low, high = PULSE_RANGE_US
        if len(pulses_us) != CHANNELS or not all(low <= p <= high or p == IGNORED for p in pulses_us):
            raise ValueError(f"pulses_us = {tuple(pulses_us)}: must be {CHANNELS} values of {low} to {high} (or {IGNORED})")
        # Channels 9 to 18 stay 0, which for them (unlike 1 to 8) means "ignore" and is trimmed from the frame.
        message = dialect.MAVLink_rc_channels_override_message(self._robot_id, BOARD_COMPONENT, *map(int, pulses_us))
        return self._sender.pack(message)

    def arm(self, arm: bool) -> bytes:
        """Ask the board to arm or to disarm; the answer is `Telemetry.acknowledged`."""
        return self._sender.pack(
            dialect.MAVLink_command_long_message(
                self._robot_id, BOARD_COMPONENT, dialect.MAV_CMD_COMPONENT_ARM_DISARM, 0, float(arm), 0, 0, 0, 0, 0, 0
            )
        )

    def heartbeat(self) -> bytes:
        """This end is alive. The board does not move for it: only pulses keep thrusters running."""
        return self._sender.pack(
            dialect.MAVLink_heartbeat_message(
                dialect.MAV_TYPE_ONBOARD_CONTROLLER,
                dialect.MAV_AUTOPILOT_INVALID,
                0,
                0,
                dialect.MAV_STATE_ACTIVE,
                PROTOCOL_VERSION,
            )
        )

    def timesync(self, now_ns: int) -> bytes:
        """Ask for the board's time."""
        return self._sender.pack(dialect.MAVLink_timesync_message(0, now_ns))

    def receive(self, data: bytes, now_ns: int) -> None:
        """Take in bytes that arrived at `now_ns`. Never raises, whatever they are."""
        changes: dict[str, Any] = {}
        for message in self._receiver.receive(data, now_ns):
            try:
                changes |= self._read(message, changes, now_ns)
            except _Refused:
                self._refused += 1
        receiver = self._receiver
        self.telemetry = replace(
            self.telemetry,
            **changes,
            loss=receiver.loss,
            bad_frames=receiver.bad_frames,
            foreign_frames=receiver.foreign_frames,
            stale_frames=receiver.stale_frames,
            refused_frames=self._refused,
        )

    def _read(self, message: Any, changes: dict[str, Any], now_ns: int) -> dict[str, Any]:
        """What a message changes in the telemetry, on top of `changes` from the same bytes."""
        kind = message.get_type()
        if kind == "ATTITUDE":  # the last of a burst: its time is the burst's
            return {
                "heading_rad": _within(message.yaw, -math.tau, math.tau),
                "yaw_rate_radps": _within(message.yawspeed, -50.0, 50.0),
                "board_ms": message.time_boot_ms,
                "arrival_ns": now_ns,
            }
        if kind == "SCALED_IMU":
            unit = STANDARD_GRAVITY_MPS2 / 1000.0
            return {"acceleration_mps2": (message.xacc * unit, message.yacc * unit, message.zacc * unit)}
        if kind == "SCALED_PRESSURE2":
            return {"depth_m": hpa_to_depth(_within(message.press_abs, 500.0, 20_000.0))}
        if kind == "SERVO_OUTPUT_RAW":
            return {"echo_us": _pulses(message, "servo{}_raw", ignorable=False)}
        if kind == "SYS_STATUS":
            return {"battery_v": _within(message.voltage_battery, 0, IGNORED - 1) / 1000.0}
        if kind == "HEARTBEAT":
            return {"armed": bool(message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)}
        return self._read_answer(kind, message, changes, now_ns)

    def _read_answer(self, kind: str, message: Any, changes: dict[str, Any], now_ns: int) -> dict[str, Any]:
        if kind == "COMMAND_ACK":
            count = changes.get("acknowledgements", self.telemetry.acknowledgements)
            return {"acknowledged": (message.command, message.result), "acknowledgements": count + 1}
        if kind == "STATUSTEXT":
            texts = changes.get("texts", self.telemetry.texts)
            count = changes.get("texts_received", self.telemetry.texts_received)
            return {"texts": (*texts, (message.severity, message.text))[-TEXTS_KEPT:], "texts_received": count + 1}
        if kind == "TIMESYNC" and message.tc1 != 0:
            round_trip_ns = int(_within(now_ns - message.ts1, 0, LOSS_WINDOW_NS))
            return {"clock_offset_ns": message.tc1 - message.ts1 - round_trip_ns // 2, "round_trip_ns": round_trip_ns}
        return {}


@dataclass(frozen=True)
class Override:
    """Pulses for the 8 outputs, in us; `IGNORED` leaves an output as it is."""

    pulses_us: tuple[int, ...]


@dataclass(frozen=True)
class Arm:
    """Arm or disarm."""

    arm: bool


@dataclass(frozen=True)
class Heartbeat:
    """The robot's computer is alive."""


@dataclass(frozen=True)
class Timesync:
    """The computer asks for the board's time and gives its own, `sent_ns`."""

    sent_ns: int


@dataclass(frozen=True)
class Unsupported:
    """A command that this board does not have, or with parameters that it does not accept."""

    command: int


Event = Override | Arm | Heartbeat | Timesync | Unsupported


class BoardLink:
    """The thruster board: events in, packed answers and sensor messages out."""

    def __init__(self, robot_id: int) -> None:
        self._robot_id = robot_id
        self._sender = Sender(robot_id, BOARD_COMPONENT)
        self._receiver = Receiver(robot_id, AGENT_COMPONENT)
        self.refused_frames = 0

    @property
    def bad_frames(self) -> int:
        """Start bytes that led to no intact frame."""
        return self._receiver.bad_frames

    @property
    def stale_frames(self) -> int:
        """Intact frames that were old or repeated, and not looked at."""
        return self._receiver.stale_frames

    def receive(self, data: bytes, now_ns: int) -> list[Event]:
        """What the computer asks for with these bytes. Never raises, whatever they are."""
        events: list[Event] = []
        for message in self._receiver.receive(data, now_ns):
            try:
                event = self._read(message)
            except _Refused:
                self.refused_frames += 1
                continue
            if event is not None:
                events.append(event)
        return events

    def _read(self, message: Any) -> Event | None:
        kind = message.get_type()
        if kind == "HEARTBEAT":
            return Heartbeat()
        if kind == "TIMESYNC" and message.tc1 == 0:
            return Timesync(message.ts1)
        if kind not in ("RC_CHANNELS_OVERRIDE", "COMMAND_LONG"):
            return None
        if (message.target_system, message.target_component) != (self._robot_id, BOARD_COMPONENT):
            raise _Refused
        if kind == "RC_CHANNELS_OVERRIDE":
            return Override(_pulses(message, "chan{}_raw", ignorable=True))
        if message.command == dialect.MAV_CMD_COMPONENT_ARM_DISARM and message.param1 in (0.0, 1.0) and message.param2 == 0.0:
            return Arm(message.param1 == 1.0)
        return Unsupported(message.command)

    def heartbeat(self, armed: bool, healthy: bool) -> bytes:
        """Armed or not, and whether anything keeps it from working."""
        mode = dialect.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED | (dialect.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0)
        working = dialect.MAV_STATE_ACTIVE if armed else dialect.MAV_STATE_STANDBY
        state = working if healthy else dialect.MAV_STATE_CRITICAL
        return self._sender.pack(
            dialect.MAVLink_heartbeat_message(
                dialect.MAV_TYPE_SUBMARINE, dialect.MAV_AUTOPILOT_GENERIC, mode, 0, state, PROTOCOL_VERSION
            )
        )

    def attitude(self, board_ms: int, heading_rad: float, yaw_rate_radps: float) -> bytes:
        """Heading and yaw rate; ends a burst."""
        return self._sender.pack(dialect.MAVLink_attitude_message(board_ms, 0, 0, heading_rad, 0, 0, yaw_rate_radps))

    def imu(self, board_ms: int, acceleration_mps2: Sequence[float], yaw_rate_radps: float) -> bytes:
        """Specific force in the body frame (at rest: -1 g down) and the gyro about the vertical axis."""
        unit = STANDARD_GRAVITY_MPS2 / 1000.0
        force_mg = [_int16(value / unit) for value in acceleration_mps2]
        gyro_mradps = _int16(yaw_rate_radps * 1000.0)
        return self._sender.pack(dialect.MAVLink_scaled_imu_message(board_ms, *force_mg, 0, 0, gyro_mradps, 0, 0, 0))

    def pressure(self, board_ms: int, depth_m: float) -> bytes:
        """Water pressure."""
        hpa = depth_to_hpa(depth_m)
        return self._sender.pack(dialect.MAVLink_scaled_pressure2_message(board_ms, hpa, hpa - SURFACE_HPA, 2000))

    def servo_output(self, board_us: int, pulses_us: Sequence[int]) -> bytes:
        """Echo of what the outputs really are."""
        return self._sender.pack(dialect.MAVLink_servo_output_raw_message(board_us % 2**32, 0, *pulses_us))

    def status(self, battery_v: float, sensors: int, healthy: int, refused: int) -> bytes:
        """Battery voltage, sensors present and healthy (MAV_SYS_STATUS_SENSOR bits), and overrides refused so far."""
        errors = min(self.bad_frames, IGNORED), min(refused, IGNORED)
        millivolt = min(max(round(battery_v * 1000.0), 0), IGNORED - 1)
        return self._sender.pack(
            dialect.MAVLink_sys_status_message(sensors, sensors, healthy, 0, millivolt, -1, -1, 0, *errors, 0, 0, 0)
        )

    def timesync(self, board_ns: int, sent_ns: int) -> bytes:
        """The board's time, with the time that the question carried."""
        return self._sender.pack(dialect.MAVLink_timesync_message(board_ns, sent_ns))

    def text(self, severity: int, text: str) -> bytes:
        """A line for people; severity 0 emergency to 7 debug."""
        return self._sender.pack(dialect.MAVLink_statustext_message(severity, text.encode("ascii", "replace")[:TEXT_LENGTH]))

    def acknowledge(self, command: int, result: int) -> bytes:
        """Answer to a command: MAV_RESULT."""
        return self._sender.pack(dialect.MAVLink_command_ack_message(command, result))


def _int16(value: float) -> int:
    return round(min(max(value, -32768.0), 32767.0))

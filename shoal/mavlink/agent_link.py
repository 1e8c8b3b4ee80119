"""The thruster link, sans-IO: MAVLink 2 (common dialect) between a robot's computer and its thruster board.

This is the computer's end; the board's is thruster_board/board_link.py. Bytes in, bytes out; sockets, serial ports and
clocks belong to the callers. The robot's id is the MAVLink system id of both ends. What a firmware must do beyond the encoding
is in docs/board.md; how frames are found in the stream, in framing.py.
"""

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common as dialect

from shoal.mavlink.frame_codec import MARKER, Peer
from shoal.mavlink.framing import LOSS_WINDOW_NS, Receiver, Sender
from shoal.mavlink.parameter_list import ParameterList
from shoal.mavlink.power_on_depth import PowerOnDepth
from shoal.mavlink.signing import Key, SignatureVerdict, SignatureVerifier
from shoal.messages.messages import BoardReading

BOARD_COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1
AGENT_COMPONENT = 191  # MAV_COMP_ID_ONBOARD_COMPUTER
SIMULATOR_COMPONENT = 200  # MAV_COMP_ID_IMU: sends simulated measurements to a board in HIL mode

CHANNELS = 8  # 4 thrusters, 4 ankles
SERVOS = attrgetter(*(f"servo{i + 1}_raw" for i in range(CHANNELS)))
OVERRIDES = attrgetter(*(f"chan{i + 1}_raw" for i in range(CHANNELS)))
IGNORED = 65535  # RC_CHANNELS_OVERRIDE: leave this channel as it is
PULSE_RANGE_US = (500, 2500)  # what a servo or a speed controller can take at all; the board knows the vehicle's own limits

WATER_DENSITY_KGPM3 = 998.0  # fresh water at 20 degrees
GRAVITY_MPS2 = 9.81
SURFACE_HPA = 1013.25
STANDARD_GRAVITY_MPS2 = 9.80665  # defines the mG of SCALED_IMU

PROTOCOL_VERSION = 3  # what a HEARTBEAT says for MAVLink 2
FASTEST_TURN_RADPS = 50.0  # of any axis; more is no measurement
STEEPEST_RAD = 1.5  # pitch; at a right angle roll and yaw are one, and d/dt of roll is infinite
TEXT_LENGTH = 50  # of a STATUSTEXT
TEXTS_KEPT = 16
CLOCKS_KEPT = 16  # of these the quickest round trip tells the clock: what is slow was held up one way and not the other
CLOCK_TRIP_NS = 20_000_000  # a slower answer may be wrong by more than what a burst that is read waited for
CLOCK_STEP_NS = 5_000_000  # two answers that differ by this more than their round trips explain: the board's clock was set
BOARD_MS_WRAPS = 2**32  # `time_boot_ms` begins at 0 again after 49.7 days
OTHER_BOARD_NS = 1_000_000_000  # of silence, in which another board may have been plugged in, or its parameters set
CHARGE_STATES = range(8)  # MAV_BATTERY_CHARGE_STATE
NO_AUTOPILOT = frozenset({dialect.MAV_AUTOPILOT_GENERIC, dialect.MAV_AUTOPILOT_INVALID})  # MAV_AUTOPILOT of a thruster board

POWER_ON, RESTARTED, ZERO_IN_QUESTION = 0x1, 0x100, 0x200  # in HEARTBEAT's custom_mode: docs/board.md, "After a reset"
RESET_CAUSES = {0x1: "power-on", 0x2: "reset pin", 0x4: "brown-out", 0x8: "watchdog", 0x10: "JTAG"}
CALIBRATE: int = dialect.MAV_CMD_PREFLIGHT_CALIBRATION
ARM_DISARM: int = dialect.MAV_CMD_COMPONENT_ARM_DISARM
ACCEPTED, REJECTED, UNSUPPORTED = 0, 1, 3  # MAV_RESULT; rejected: for now


def depth_to_hpa(depth_m: float) -> float:
    """Absolute pressure in hPa at a depth in fresh water."""
    return SURFACE_HPA + WATER_DENSITY_KGPM3 * GRAVITY_MPS2 * depth_m / 100.0


def hpa_to_depth(pressure_hpa: float) -> float:
    """Depth in m in fresh water for an absolute pressure."""
    return (pressure_hpa - SURFACE_HPA) * 100.0 / (WATER_DENSITY_KGPM3 * GRAVITY_MPS2)


def is_override(datagram: bytes) -> bool:
    """True if a datagram of an agent, which holds one frame, sets pulses. Nothing else about it is checked."""
    kind = int.from_bytes(datagram[7:10], "little")
    return datagram[:1] == bytes([MARKER]) and kind == dialect.MAVLINK_MSG_ID_RC_CHANNELS_OVERRIDE


def autopilot_name(autopilot: int) -> str:
    """Name of a MAV_AUTOPILOT; empty for that of a thruster board."""
    if autopilot in NO_AUTOPILOT:
        return ""
    entry = dialect.enums["MAV_AUTOPILOT"].get(autopilot)
    return f"autopilot {autopilot}" + (f" ({entry.name.removeprefix('MAV_AUTOPILOT_')})" if entry else "")


@dataclass(frozen=True, eq=False)
class Telemetry(BoardReading):
    """The board's last telemetry, complete as of the burst of `board_ms`, and the state of the link."""

    hil: bool = False  # the board is in HIL mode: measurements and water are simulated
    reset_causes: tuple[str, ...] = ()  # of the board's last reset; empty: not known
    restarted: bool = False  # the board's life did not begin with a power-on in air: its zeros are those kept from before
    acknowledged: tuple[int, int] | None = None  # last COMMAND_ACK: command, MAV_RESULT
    acknowledgements: int = 0
    arm_open: bool = False  # an answer to a request to arm may still come: one that comes now is not about disarming
    texts: tuple[tuple[int, str], ...] = ()  # the last few STATUSTEXT: severity (0 worst, 7 debug), text
    texts_received: int = 0
    clock_offset_ns: int = 0  # board's clock minus ours, by the quickest of the last TIMESYNCs
    round_trip_ns: int = 0  # of the last TIMESYNC
    round_trips: int = 0
    bad_frames: int = 0
    foreign_frames: int = 0
    foreign_peer: Peer | None = None  # system and component of the last intact frame of another sender
    stale_frames: int = 0
    refused_frames: int = 0  # intact, but with a value that cannot be true
    unsigned_frames: int = 0
    forged_frames: int = 0  # signed with another key, or where no key is expected
    replayed_frames: int = 0

    @property
    def autopilot_name(self) -> str:
        """Name of the autopilot at the other end; empty for a thruster board, and before the first HEARTBEAT."""
        return autopilot_name(self.autopilot)

    @property
    def reports_start(self) -> bool:
        """True if the board reports how its present life began."""
        return bool(self.reset_causes) or self.restarted or self.zero_in_question

    @property
    def is_thruster_board(self) -> bool:
        """True if the other end has reported that it is no autopilot: one would take pulses for a pilot's sticks."""
        return self.heartbeats > 0 and self.autopilot in NO_AUTOPILOT


class Refused(Exception):
    """A frame is intact, but its content is not acceptable."""


def within(value: float, low: float, high: float) -> float:
    """The value, if it lies in its range. Raises Refused."""
    if not low <= value <= high:  # false for NaN too
        raise Refused
    return value


def _tilt_of(message: Any) -> tuple[float, ...]:
    """Roll, pitch and d/dt of them of an ATTITUDE; empty if they are all 0, or cannot be true: then they are not measured."""
    roll, pitch, about_x, about_y = motion = (message.roll, message.pitch, message.rollspeed, message.pitchspeed)
    possible = abs(roll) <= math.pi and abs(pitch) <= STEEPEST_RAD and max(abs(about_x), abs(about_y)) <= FASTEST_TURN_RADPS
    if not (any(motion) and possible):  # impossible is NaN too
        return ()
    aside, down = math.sin(roll), math.cos(roll)
    roll_rate = about_x + (about_y * aside + message.yawspeed * down) * math.tan(pitch)
    return roll, pitch, roll_rate, about_y * down - message.yawspeed * aside


def _yaw_rate_of(message: Any, tilt: tuple[float, ...]) -> float:
    """d/dt of the heading of an ATTITUDE, whose rates are about the body's axes; without a tilt the rate about its third."""
    if not tilt:
        return float(message.yawspeed)
    roll, pitch = tilt[:2]
    return float((message.pitchspeed * math.sin(roll) + message.yawspeed * math.cos(roll)) / math.cos(pitch))


def pulses_of(message: Any, fields: Callable[[Any], tuple[int, ...]], ignorable: bool) -> tuple[int, ...]:
    """The 8 pulses of a message, in these `fields`. Raises Refused."""
    pulses = fields(message)
    low, high = PULSE_RANGE_US
    if not all(low <= pulse <= high or (ignorable and pulse == IGNORED) for pulse in pulses):
        raise Refused
    return pulses


class AgentLink:
    """The robot's computer: packs commands, keeps the telemetry."""

    def __init__(self, robot_id: int, key: Key | None = None, now: Callable[[], int] = lambda: 0) -> None:
        """With a `key`, sign; `now()` is the time in ticks, later than in any earlier life of this computer.

        The board signs with times later than all it has heard, so what it says to this life is later than this life's start:
        older telemetry is a recording.
        """
        self._robot_id, self._board, self._me = robot_id, (robot_id, BOARD_COMPONENT), (robot_id, AGENT_COMPONENT)
        verifier = SignatureVerifier(key, floor=now())
        self._sender = Sender(self._me, key, lambda: max(now(), verifier.newest + 1))
        self._receiver = Receiver(lambda peer: peer == self._board, verifier)
        self._refused = 0
        self._has_depth = False  # this burst, so far
        self._burst_ms = -1  # the board's time of the last burst,
        self._burst_ns = 0  # and when it came
        self._asked_ns: int | None = None
        self._clocks: deque[tuple[int, int]] = deque(maxlen=CLOCKS_KEPT)  # round trip, the board's clock minus ours
        self._doubted_clock: tuple[int, int] | None = None  # the last answer, if it contradicts those before it
        self._power_on = PowerOnDepth()
        self._arm_answered = False  # an answer has come since the board was asked to arm
        self._reported: dict[str, int] = {}  # the last value of each field that the next report has to confirm
        self.telemetry = Telemetry()
        self.parameters = ParameterList()  # of the board's present life, since the last silence

    @property
    def stamp(self) -> int:
        """The latest timestamp of a signature that this end has sent; 0 without a key."""
        return self._sender.signer.last if self._sender.signer is not None else 0

    def pack(self, message: Any) -> bytes:
        """Any message, numbered and signed as this end's."""
        return self._sender.pack(message)

    def pulses(self, pulses_us: Sequence[int]) -> bytes:
        """Command the 8 outputs in us: 4 thrusters, 4 ankles. Raises ValueError for a pulse that no servo can take."""
        low, high = PULSE_RANGE_US
        if len(pulses_us) != CHANNELS or not all(low <= p <= high or p == IGNORED for p in pulses_us):
            raise ValueError(f"pulses_us = {tuple(pulses_us)}: must be {CHANNELS} values of {low} to {high} (or {IGNORED})")
        # Channels 9 to 18 stay 0, which for them (unlike 1 to 8) means "ignore" and is trimmed from the frame.
        message = dialect.MAVLink_rc_channels_override_message(self._robot_id, BOARD_COMPONENT, *map(int, pulses_us))
        return self._sender.pack(message)

    def arm(self, arm: bool) -> bytes:
        """Ask the board to arm or to disarm; the answer is `Telemetry.acknowledged`, which does not say to which of the two.
        After a request to arm it counts once a heartbeat has shown what became of that one: `Telemetry.arm_open`."""
        if arm:
            self._arm_answered = False
            self.telemetry = replace(self.telemetry, arm_open=True)
        return self._sender.pack(
            dialect.MAVLink_command_long_message(
                self._robot_id, BOARD_COMPONENT, dialect.MAV_CMD_COMPONENT_ARM_DISARM, 0, float(arm), 0, 0, 0, 0, 0, 0
            )
        )

    def calibrate(self, pressure: bool = False, gyro: bool = False) -> bytes:
        """For a person: the board's zeros are right, or it takes them anew: `pressure` in air, `gyro` at rest."""
        values = float(gyro), 0, float(pressure), 0, 0, 0, 0
        return self._sender.pack(dialect.MAVLink_command_long_message(self._robot_id, BOARD_COMPONENT, CALIBRATE, 0, *values))

    def heartbeat(self) -> bytes:
        """Frame that says that this end is alive. It moves nothing: only pulses keep thrusters running."""
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
        self._asked_ns = now_ns
        return self._sender.pack(dialect.MAVLink_timesync_message(0, now_ns))

    def ask_parameters(self) -> bytes:
        """Ask for the board's parameters, or for those that are still missing."""
        return b"".join(map(self._sender.pack, self.parameters.requests(self._robot_id, BOARD_COMPONENT)))

    def set_zero(self, depth_m: float) -> None:
        """Take the board's depth zero to be at this depth, whatever was seen of its restarts."""
        self._power_on.set_depth(depth_m)
        self.telemetry = replace(self.telemetry, power_on_depth_m=depth_m)

    def receive(self, data: bytes, now_ns: int) -> None:
        """Take in bytes that arrived at `now_ns`. Never raises, whatever they are."""
        if not (data or self._receiver.is_waiting):
            return
        changes: dict[str, Any] = {}
        for message in self._receiver.receive(data, now_ns):
            try:
                changes |= self._read(message, changes, now_ns)
            except Refused:
                self._refused += 1
        receiver = self._receiver
        changes |= {
            "loss": receiver.loss(self._board),
            "bad_frames": receiver.bad_frames,
            "foreign_frames": receiver.foreign_frames,
            "foreign_peer": receiver.foreign_peer,
            "stale_frames": receiver.stale_frames,
            "refused_frames": self._refused,
            "unsigned_frames": receiver.refused[SignatureVerdict.UNSIGNED],
            "forged_frames": receiver.refused[SignatureVerdict.FORGED],
            "replayed_frames": receiver.refused[SignatureVerdict.REPLAYED],
        }
        latest = object.__new__(Telemetry)  # what dataclasses.replace does, which sets 37 frozen fields one after the other
        latest.__dict__.update(self.telemetry.__dict__ | changes)
        self.telemetry = latest

    def _read(self, message: Any, changes: dict[str, Any], now_ns: int) -> dict[str, Any]:
        """The changes that a message makes to the telemetry, on top of `changes` from the same bytes."""
        kind = message.get_type()
        if kind == "ATTITUDE":  # the last of a burst: its time is the burst's
            complete, self._has_depth = self._has_depth, False
            is_repeated = message.time_boot_ms == self._burst_ms  # of a board whose measuring has stopped: as old as it was
            if not complete or is_repeated or math.isnan(message.yaw) or math.isnan(message.yawspeed):
                return {}  # a sensor does not measure, or a frame is lost: the last burst must not look live
            tilt = _tilt_of(message)
            burst = {
                "heading_rad": within(message.yaw, -math.tau, math.tau),
                "yaw_rate_radps": within(_yaw_rate_of(message, tilt), -FASTEST_TURN_RADPS, FASTEST_TURN_RADPS),
                "tilt": np.array(tilt),
                "board_ms": message.time_boot_ms,
                "arrival_ns": self._measured_ns(message.time_boot_ms, now_ns),
            }
            self._power_on.note_burst(message.time_boot_ms, changes.get("depth_m", self.telemetry.depth_m))
            return burst | {"power_on_depth_m": self._power_on.depth_m}
        if kind == "SCALED_IMU":
            unit = STANDARD_GRAVITY_MPS2 / 1000.0
            return {"acceleration_mps2": np.array([message.xacc * unit, message.yacc * unit, message.zacc * unit])}
        if kind == "SCALED_PRESSURE2":
            if math.isnan(message.press_abs):  # not measured, as by a sensor that starts
                return {}
            depth_m = hpa_to_depth(within(message.press_abs, 500.0, 20_000.0))
            self._has_depth = True
            return {"depth_m": depth_m}
        if kind == "SERVO_OUTPUT_RAW":
            return {"echo_us": pulses_of(message, SERVOS, ignorable=False)}
        if kind == "SYS_STATUS":
            count = changes.get("battery_reports", self.telemetry.battery_reports)
            return {"battery_v": within(message.voltage_battery, 0, IGNORED - 1) / 1000.0, "battery_reports": count + 1}
        if kind == "BATTERY_STATUS":
            within(message.charge_state, CHARGE_STATES.start, CHARGE_STATES[-1])
            return self._confirmed("charge", message.charge_state) if message.id == 0 else {}
        if kind == "HEARTBEAT":
            count = changes.get("heartbeats", self.telemetry.heartbeats)
            armed, hil = dialect.MAV_MODE_FLAG_SAFETY_ARMED, dialect.MAV_MODE_FLAG_HIL_ENABLED
            mode = message.base_mode
            own = {"armed": bool(mode & armed), "hil": bool(mode & hil), "heartbeats": count + 1}
            if own["armed"] or self._arm_answered:
                own["arm_open"] = False
            status, causes = message.custom_mode, RESET_CAUSES.items()
            if message.autopilot in NO_AUTOPILOT:  # an autopilot's own modes are something else
                if status:
                    self._power_on.note_start_report()
                own |= {
                    "reset_causes": tuple(name for bit, name in causes if status & bit),
                    "restarted": bool(status & RESTARTED),
                    "zero_in_question": bool(status & ZERO_IN_QUESTION),
                    "power_on_depth_m": self._power_on.depth_m,
                }
            return own | self._confirmed("autopilot", message.autopilot)
        return self._read_answer(kind, message, changes, now_ns)

    def _read_answer(self, kind: str, message: Any, changes: dict[str, Any], now_ns: int) -> dict[str, Any]:
        """Fields of the telemetry that an answer of the board changes."""
        if kind == "COMMAND_ACK":
            if message.target_system and (message.target_system, message.target_component) != self._me:
                return {}  # the answer to another sender's request
            self._arm_answered = self._arm_answered or message.command == ARM_DISARM
            count = changes.get("acknowledgements", self.telemetry.acknowledgements)
            return {"acknowledged": (message.command, message.result), "acknowledgements": count + 1}
        if kind == "PARAM_VALUE":
            self.parameters.note_value(message)
        if kind == "STATUSTEXT":
            texts = changes.get("texts", self.telemetry.texts)
            count = changes.get("texts_received", self.telemetry.texts_received)
            return {"texts": (*texts, (message.severity, message.text))[-TEXTS_KEPT:], "texts_received": count + 1}
        if kind == "TIMESYNC" and message.tc1 != 0 and message.ts1 == self._asked_ns:
            round_trip_ns = int(within(now_ns - message.ts1, 0, LOSS_WINDOW_NS))
            self._asked_ns = None
            self._note_clock(round_trip_ns, message.tc1 - message.ts1 - round_trip_ns // 2)
            answers = changes.get("round_trips", self.telemetry.round_trips) + 1
            return {"clock_offset_ns": min(self._clocks)[1], "round_trip_ns": round_trip_ns, "round_trips": answers}
        return {}

    def _confirmed(self, field: str, value: int) -> dict[str, Any]:
        """The change that a reported value makes: none before the next report confirms it. The first one counts at once."""
        before = self._reported.get(field, value)
        self._reported[field] = value
        return {field: value} if value == before else {}

    def _note_clock(self, round_trip_ns: int, offset_ns: int) -> None:
        """Take in how far the board's clock is from ours; an answer is wrong by half its round trip at most. Two answers in a
        row that agree with each other and contradict those before: the board's clock was set."""
        answer = round_trip_ns, offset_ns
        if self._clocks and _contradict(answer, min(self._clocks)):
            doubted, self._doubted_clock = self._doubted_clock, answer
            if doubted is None or _contradict(answer, doubted):
                return
            self._clocks.clear()
        self._doubted_clock = None
        self._clocks.append(answer)

    def _measured_ns(self, board_ms: int, now_ns: int) -> int:
        """The instant of a burst on the robot's clock: not later than now, and now while the board's clock is unknown. A board
        that was restarted has another clock, and one that was silent may be another board. While one answer contradicts those
        before it, that clock counts by which the burst is younger: by the wrong one it is old, or of the future."""
        if board_ms < self._burst_ms:
            self._clocks.clear()
            self._doubted_clock = None
        if board_ms < self._burst_ms or now_ns - self._burst_ns > OTHER_BOARD_NS:
            self.parameters = ParameterList()
        self._burst_ms, self._burst_ns = board_ms, now_ns
        clocks = (min(self._clocks, default=None), self._doubted_clock)
        offsets_ns = [clock[1] for clock in clocks if clock is not None and clock[0] <= CLOCK_TRIP_NS]
        ages_ns = [(now_ns + offset_ns - board_ms * 1_000_000) % (BOARD_MS_WRAPS * 1_000_000) for offset_ns in offsets_ns]
        age_ns = min(ages_ns, default=0)
        return now_ns - age_ns if age_ns < BOARD_MS_WRAPS * 500_000 else now_ns


def _contradict(a: tuple[int, int], b: tuple[int, int]) -> bool:
    """True if two answers, round trip and offset in ns, differ by more than their round trips explain."""
    return abs(a[1] - b[1]) > (a[0] + b[0]) // 2 + CLOCK_STEP_NS

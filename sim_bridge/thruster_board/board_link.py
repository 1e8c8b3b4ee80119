"""The thruster board's end of the link, sans-IO: what it is asked, and the packing of its answers and measurements.

What a board does with a question is sim_bridge/thruster_board/state_machine.py; the other end is shoal/mavlink/agent_link.py.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import common as dialect

from shoal.mavlink.agent_link import (
    BOARD_COMPONENT,
    IGNORED,
    OVERRIDES,
    POWER_ON,
    PROTOCOL_VERSION,
    SIMULATOR_COMPONENT,
    STANDARD_GRAVITY_MPS2,
    SURFACE_HPA,
    TEXT_LENGTH,
    Refused,
    depth_to_hpa,
    hpa_to_depth,
    pulses_of,
    within,
)
from shoal.mavlink.frame_codec import Peer
from shoal.mavlink.framing import Receiver, Sender
from shoal.mavlink.signing import LATEST, Key, SignatureVerifier

ALL_COMPONENTS = 0  # some ground stations ask everybody of a system
NOT_MEASURED = -1  # current, remaining charge
HIL_FIELDS = 0x2E7  # HIL_SENSOR_UPDATED_FLAGS of force, zgyro, xmag, ymag and abs_pressure
MOST_MILLIVOLTS = 60_000  # of a simulated battery; beyond is what MAVLink has for "not measured"
CAPABILITIES = (
    dialect.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | dialect.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
    | dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
)


@dataclass(frozen=True)
class Override:
    """Pulses for the 8 outputs, in us; `IGNORED` leaves an output as it is."""

    pulses_us: tuple[int, ...]


@dataclass(frozen=True)
class Arm:
    arm: bool


@dataclass(frozen=True)
class Calibrate:
    """Take the zeros of pressure sensor and gyro anew, or, with neither, confirm those that are."""

    pressure: bool
    gyro: bool


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


@dataclass(frozen=True)
class TellVersion:
    """A request for this board's version."""


@dataclass(frozen=True)
class ListParameters:
    """A request for all parameters."""


@dataclass(frozen=True)
class ReadParameter:
    """A request for one parameter, by its index or, with -1, by its name."""

    name: str
    index: int


@dataclass(frozen=True)
class SetParameter:
    """A request to give a parameter another value; `real` if it came as a REAL32."""

    name: str
    value: float
    real: bool


@dataclass(frozen=True)
class SetKey:
    """A request to sign the link with this key from now on, and to refuse what is not later than `newest`."""

    key: Key
    newest: int


@dataclass(frozen=True)
class SimulatedMotion:
    """Simulated measurements of a board in HIL mode, in place of its own."""

    heading_rad: float
    yaw_rate_radps: float
    acceleration_mps2: tuple[float, float, float]  # specific force, body frame
    depth_m: float


@dataclass(frozen=True)
class SimulatedBattery:
    """Simulated voltage of the battery, in place of the measured one."""

    voltage_v: float


Event = (
    Override | Arm | Calibrate | Heartbeat | Timesync | Unsupported | TellVersion | ListParameters | ReadParameter
    | SetParameter | SetKey | SimulatedMotion | SimulatedBattery
)  # fmt: skip


class BoardLink:
    """The thruster board: events in, packed answers and sensor messages out."""

    def __init__(
        self, robot_id: int, verifier: SignatureVerifier | None = None, key: Key | None = None, sent: int = 0
    ) -> None:
        """Accept frames that pass the `verifier`. With a `key`, sign its own frames, with timestamps later than `sent` and
        than those of all frames accepted."""
        self._robot_id = robot_id
        verifier = verifier or SignatureVerifier(key)
        self._sender = Sender((robot_id, BOARD_COMPONENT), key, lambda: max(verifier.newest, sent) + 1)
        self._receiver = Receiver(lambda peer: peer != (robot_id, BOARD_COMPONENT), verifier)
        self.hil = False  # simulated measurements are taken
        self.refused_frames = 0
        self.taken_frames = 0  # intact ones that passed the verifier, whatever they asked for
        self.read: list[
            tuple[bytes, Event | None]
        ] = []  # frames of the last `receive` but refused ones, and what they ask for

    @property
    def bad_frames(self) -> int:
        """Start bytes that led to no intact frame."""
        return self._receiver.bad_frames

    @property
    def is_waiting(self) -> bool:
        """True if a frame has begun and not ended: it may be overdue at the next look."""
        return self._receiver.is_waiting

    @property
    def stale_frames(self) -> int:
        """Intact frames that were old or repeated, and not looked at."""
        return self._receiver.stale_frames

    @property
    def unauthentic_frames(self) -> int:
        """Intact frames that were dropped for their signature: none, wrong, or replayed."""
        return sum(self._receiver.refused.values())

    @property
    def stamp(self) -> int:
        """The latest timestamp of a signature that this end has sent; 0 without a key."""
        return self._sender.signer.last if self._sender.signer is not None else 0

    def receive(self, data: bytes, now_ns: int) -> list[tuple[Peer, Event]]:
        """The requests in these bytes, with their senders. Never raises, whatever the bytes."""
        return list(self.receive_each(data, now_ns))

    def receive_each(self, data: bytes, now_ns: int) -> Iterator[tuple[Peer, Event]]:
        """The requests in these bytes one by one: what is done with one may change how the next is read."""
        self.read = []
        for message, frame in self._receiver.receive_each(data, now_ns):
            self.taken_frames += 1
            try:
                event = self._read(message)
            except Refused:
                self.refused_frames += 1
                continue
            self.read.append((frame, event))
            if event is not None:
                yield (message.get_srcSystem(), message.get_srcComponent()), event

    def _read(self, message: Any) -> Event | None:
        """The event that a MAVLink message stands for; None for one that is not for this board."""
        kind = message.get_type()
        if kind == "HEARTBEAT":
            return Heartbeat()
        if kind == "TIMESYNC":
            return Timesync(message.ts1) if message.tc1 == 0 else None
        if kind in _SIMULATED:
            sender = (message.get_srcSystem(), message.get_srcComponent())
            return _SIMULATED[kind](message) if self.hil and sender == (self._robot_id, SIMULATOR_COMPONENT) else None
        reader = _READERS.get(kind)
        if reader is None:
            return None
        components = (BOARD_COMPONENT,) if kind == "RC_CHANNELS_OVERRIDE" else (BOARD_COMPONENT, ALL_COMPONENTS)
        if message.target_system != self._robot_id or message.target_component not in components:
            raise Refused
        return reader(message)

    def heartbeat(self, armed: bool, healthy: bool, hil: bool = False, status: int = POWER_ON) -> bytes:
        """Armed or not, in HIL mode or not, whether anything keeps it from working, and in `status` how this life of the board
        began (docs/board.md)."""
        mode = dialect.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED | (dialect.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0)
        mode |= dialect.MAV_MODE_FLAG_HIL_ENABLED if hil else 0
        working = dialect.MAV_STATE_ACTIVE if armed else dialect.MAV_STATE_STANDBY
        state = working if healthy else dialect.MAV_STATE_CRITICAL
        return self._sender.pack(
            dialect.MAVLink_heartbeat_message(
                dialect.MAV_TYPE_SUBMARINE, dialect.MAV_AUTOPILOT_GENERIC, mode, status, state, PROTOCOL_VERSION
            )
        )

    def attitude(
        self, board_ms: int, heading_rad: float, yaw_rate_radps: float, tilt: Sequence[float] = (0.0, 0.0, 0.0, 0.0)
    ) -> bytes:
        """Heading and yaw rate; ends a burst. `tilt` is roll, pitch and the body's rates about its first two axes; four zeros
        say that they are not measured."""
        roll, pitch, roll_rate, pitch_rate = tilt
        return self._sender.pack(
            dialect.MAVLink_attitude_message(board_ms, roll, pitch, heading_rad, roll_rate, pitch_rate, yaw_rate_radps)
        )

    def imu(self, board_ms: int, acceleration_mps2: Sequence[float], yaw_rate_radps: float) -> bytes:
        """Specific force in the body frame (at rest: -1 g down) and the gyro about the vertical axis."""
        unit = STANDARD_GRAVITY_MPS2 / 1000.0
        force_mg = [_int16(value / unit) for value in acceleration_mps2]
        gyro_mradps = _int16(yaw_rate_radps * 1000.0)
        return self._sender.pack(dialect.MAVLink_scaled_imu_message(board_ms, *force_mg, 0, 0, gyro_mradps, 0, 0, 0))

    def pressure(self, board_ms: int, depth_m: float) -> bytes:
        hpa = depth_to_hpa(depth_m)
        return self._sender.pack(dialect.MAVLink_scaled_pressure2_message(board_ms, hpa, hpa - SURFACE_HPA, 2000))

    def servo_output(self, board_us: int, pulses_us: Sequence[int]) -> bytes:
        """Echo of what the outputs really are."""
        return self._sender.pack(dialect.MAVLink_servo_output_raw_message(board_us % 2**32, 0, *pulses_us))

    def status(self, battery_v: float, sensors: int, healthy: int, refused: int) -> bytes:
        """Battery voltage, sensors present and healthy (MAV_SYS_STATUS_SENSOR bits), and overrides refused so far.
        With them go the counts of frames that were damaged, and of those dropped for their signature."""
        errors = [min(count, IGNORED) for count in (self.bad_frames, refused, self.unauthentic_frames)]
        millivolt = min(max(round(battery_v * 1000.0), 0), IGNORED - 1)
        return self._sender.pack(
            dialect.MAVLink_sys_status_message(sensors, sensors, healthy, 0, millivolt, -1, -1, 0, *errors, 0, 0)
        )

    def battery(self, battery_v: float, charge: int) -> bytes:
        """The battery as a whole: voltage, and how low it is (MAV_BATTERY_CHARGE_STATE)."""
        cells = [min(max(round(battery_v * 1000.0), 0), IGNORED - 1), *[IGNORED] * 9]
        unknown_temperature, whole = 32767, (0, dialect.MAV_BATTERY_FUNCTION_ALL, dialect.MAV_BATTERY_TYPE_LIPO)
        measured = (unknown_temperature, cells, NOT_MEASURED, NOT_MEASURED, NOT_MEASURED, NOT_MEASURED)
        return self._sender.pack(dialect.MAVLink_battery_status_message(*whole, *measured, 0, charge))

    def parameter(self, name: str, value: float, count: int, index: int) -> bytes:
        real = dialect.MAV_PARAM_TYPE_REAL32
        return self._sender.pack(dialect.MAVLink_param_value_message(name.encode("ascii"), value, real, count, index))

    def parameter_error(self, asker: Peer, name: str, index: int, code: int) -> bytes:
        """The reason why a request for a parameter failed (MAV_PARAM_ERROR)."""
        text = name.encode("ascii", "replace")
        return self._sender.pack(dialect.MAVLink_param_error_message(*asker, text, index, code))

    def version(self) -> bytes:
        """The identity and the capabilities of this board."""
        nothing = [0] * 8
        message = dialect.MAVLink_autopilot_version_message(
            CAPABILITIES, 0, 0, 0, 0, nothing, nothing, nothing, 0, 0, self._robot_id
        )
        return self._sender.pack(message)

    def timesync(self, board_ns: int, sent_ns: int) -> bytes:
        """The board's time, with the time that the question carried."""
        return self._sender.pack(dialect.MAVLink_timesync_message(board_ns, sent_ns))

    def text(self, severity: int, text: str) -> bytes:
        """A line for people; severity 0 emergency to 7 debug."""
        return self._sender.pack(dialect.MAVLink_statustext_message(severity, text.encode("ascii", "replace")[:TEXT_LENGTH]))

    def acknowledge(self, asker: Peer, command: int, result: int) -> bytes:
        """Answer to a command: MAV_RESULT."""
        return self._sender.pack(dialect.MAVLink_command_ack_message(command, result, 0, 0, *asker))


def _given(value: float) -> float:
    """A parameter of a command, in which NaN is "not given"."""
    return 0.0 if math.isnan(value) else value


def _command(message: Any) -> Event:
    """The event of a MAVLink command; Unsupported for one that this board does not have."""
    force = _given(message.param2)
    if message.command == dialect.MAV_CMD_COMPONENT_ARM_DISARM and message.param1 in (0.0, 1.0) and force == 0.0:
        return Arm(message.param1 == 1.0)
    gyro, pressure = _given(message.param1), _given(message.param3)
    others = (message.param2, message.param4, message.param5, message.param6, message.param7)
    nothing = all(_given(value) == 0.0 for value in others)
    if message.command == dialect.MAV_CMD_PREFLIGHT_CALIBRATION and nothing and {gyro, pressure} <= {0.0, 1.0}:
        return Calibrate(pressure == 1.0, gyro == 1.0)
    version = float(dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
    if message.command == dialect.MAV_CMD_REQUEST_MESSAGE and message.param1 == version:
        return TellVersion()
    return Unsupported(message.command)


def _text(field: Any) -> str:
    """The name in a message: up to the first zero, as pymavlink leaves it."""
    return (field if isinstance(field, str) else field.decode("ascii", "replace")).partition("\0")[0]


def _set(message: Any) -> Event:
    return SetParameter(_text(message.param_id), message.param_value, message.param_type == dialect.MAV_PARAM_TYPE_REAL32)


def _key(message: Any) -> Event:
    """The key of a SETUP_SIGNING message. Raises Refused for one of zeros."""
    secret = bytes(message.secret_key)
    if not any(secret):  # would leave the link unsigned: that is done at the board, not over the link
        raise Refused
    return SetKey(Key(secret), min(message.initial_timestamp, LATEST))


_READERS: dict[str, Callable[[Any], Event]] = {
    "RC_CHANNELS_OVERRIDE": lambda message: Override(pulses_of(message, OVERRIDES, ignorable=True)),
    "COMMAND_LONG": _command,
    "PARAM_REQUEST_LIST": lambda _: ListParameters(),
    "PARAM_REQUEST_READ": lambda message: ReadParameter(_text(message.param_id), message.param_index),
    "PARAM_SET": _set,
    "SETUP_SIGNING": _key,
}


def _motion(message: Any) -> SimulatedMotion:
    """The motion that a simulator sends in HIL_SENSOR. Raises Refused for values that cannot be."""
    if message.fields_updated & HIL_FIELDS != HIL_FIELDS:
        raise Refused
    x, y, z = (within(value, -300.0, 300.0) for value in (message.xacc, message.yacc, message.zacc))
    ahead, side = within(message.xmag, -10.0, 10.0), within(message.ymag, -10.0, 10.0)
    if ahead == side == 0.0:
        raise Refused
    depth_m = hpa_to_depth(within(message.abs_pressure, 500.0, 20_000.0))
    return SimulatedMotion(math.atan2(-side, ahead), within(message.zgyro, -50.0, 50.0), (x, y, z), depth_m)


def _battery(message: Any) -> SimulatedBattery | None:
    if message.id != 0:
        return None
    return SimulatedBattery(within(message.voltages[0], 0, MOST_MILLIVOLTS) / 1000.0)


_SIMULATED: dict[str, Callable[[Any], Event | None]] = {"HIL_SENSOR": _motion, "BATTERY_STATUS": _battery}


def _int16(value: float) -> int:
    return round(min(max(value, -32768.0), 32767.0))

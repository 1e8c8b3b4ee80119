"""The examiner's end of a thruster board's link: the robot's computer, a ground station and a stranger on one wire. Pure.

It uses only messages of the board, and not its clock: instants are those of the wire.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Protocol

from pymavlink.dialects.v20 import common as dialect

from shoal.mavlink.agent_link import BOARD_COMPONENT, IGNORED, AgentLink
from shoal.mavlink.framing import Sender
from shoal.mavlink.parameters import ParameterClient
from shoal.mavlink.signing import Key
from sim_bridge.thruster_board.simulator_link import LINK_ID, SimulatorLink

MS, S = 1_000_000, 1_000_000_000
PERIOD_NS = 50 * MS  # ns between overrides, as in flight
STALL_NS = 15 * MS  # ns; if this machine wakes later than that, measurements meanwhile say nothing about the board
HEADING_RAD, TURN_RADPS, FORCE_MPS2, DEPTH_M = 2.0, -0.5, (1.0, -2.0, -9.0), 3.0  # of simulated measurements
NUDGE_US = 60.0  # us from neutral, with which a thruster turns slowly
ASKS = 4  # for another value of a parameter: of frames on a bad wire one in ten is lost, either way


class BoardWire(Protocol):
    """Bytes and time of a link."""

    def now_ns(self) -> int: ...
    def send(self, data: bytes) -> None: ...
    def receive(self, until_ns: int) -> bytes:
        """Bytes that arrive next; none if nothing came until then."""

    def strangers(self) -> "tuple[Callable[[], None], Callable[[], int]] | None":
        """Peers at addresses of their own that have no key: a call that has each of them send a byte, and a call that
        returns the number of them that heard anything. None for a wire with one other end."""


@dataclass(frozen=True)
class Sample:
    """The board's echo and armed flag, and the instant at which they were heard."""

    at_ns: int
    echo_us: tuple[int, ...]
    armed: bool


class BoardProbe:
    """One board under examination."""

    def __init__(self, wire: BoardWire, robot_id: int, key: Key | None = None, now: Callable[[], int] = lambda: 0) -> None:
        self.wire, self.robot_id, self.key = wire, robot_id, key
        self.computer = AgentLink(robot_id, key, now)
        self.station = ParameterClient(robot_id, None if key is None else Key(key.secret, 1), now)
        simulator_key = None if key is None else Key(key.secret, LINK_ID)
        self.simulator = SimulatorLink(robot_id, simulator_key, now)
        self.other_simulator = SimulatorLink(robot_id % 250 + 1, simulator_key, now)
        self._other = Sender((254, 190), None if key is None else Key(key.secret, 2), now)
        self.samples: list[Sample] = []
        self.bytes_heard = 0
        self.stalls = 0  # number of times that this machine was held up
        self._before: dict[str, float] = {}  # values of the parameters that were asked to change, until they are put back
        self._heartbeat_ns = -S

    # --- time goes on

    def listen(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Receive for so long or until `until()`; returns True if `until()` came first."""
        end_ns = self.wire.now_ns() + round(seconds * S)
        while not until():
            if self.wire.now_ns() >= end_ns:
                return False
            if self.wire.now_ns() - self._heartbeat_ns >= S:
                self._heartbeat_ns = self.wire.now_ns()
                self.wire.send(self.computer.heartbeat())
            until_ns = min(end_ns, self.wire.now_ns() + 5 * MS)
            data = self.wire.receive(until_ns)
            now_ns = self.wire.now_ns()
            self.stalls += now_ns - until_ns > STALL_NS
            self.bytes_heard += len(data)
            self.computer.receive(data, now_ns)
            self.station.receive(data, now_ns)
            if data:
                telemetry = self.computer.telemetry
                self.samples.append(Sample(now_ns, telemetry.echo_us, telemetry.armed))
        return True

    def stay_silent(self, seconds: float) -> None:
        """Send nothing at all for less than a second."""
        self._heartbeat_ns = self.wire.now_ns()
        self.listen(seconds)

    def later(self) -> int:
        """A time for signatures that is later than all that were made."""
        return self.computer.stamp + 1_000_000

    def stream(self, frame: Callable[[], bytes], seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Send a frame at the control rate for so long or until `until()`; returns True if `until()` came first."""
        end_ns = self.wire.now_ns() + round(seconds * S)
        while self.wire.now_ns() < end_ns:
            self.wire.send(frame())
            if self.listen(min(PERIOD_NS, end_ns - self.wire.now_ns()) / S, until):
                return True
        return until()

    # --- what is sent

    @property
    def neutral_us(self) -> int:
        """A thruster's neutral pulse, by the board's own parameter."""
        return round(self.station.values.get("THR_NEUTRAL_US", 1500.0))

    def pulses(self, *thrusters_off_us: float, ankle: int = IGNORED) -> bytes:
        """An override: thrusters so far from neutral (those not named: not at all), the last ankle as given."""
        off = (*thrusters_off_us, *(0.0,) * (4 - len(thrusters_off_us)))
        return self.computer.pulses([*(round(self.neutral_us + value) for value in off), IGNORED, IGNORED, IGNORED, ankle])

    def nudge(self) -> bytes:
        """An override that turns the first thruster slowly."""
        return self.pulses(NUDGE_US)

    def forbidden(self) -> bytes:
        """An override that the board must refuse, because one ankle is out of range by one; it would turn no thruster."""
        return self.pulses(ankle=round(self.station.values.get("ANK_MAX_US", 2000.0)) + 1)

    def of_a_stranger(self) -> bytes:
        """An override from a system that is not the robot's computer."""
        message = dialect.MAVLink_rc_channels_override_message(
            self.robot_id, BOARD_COMPONENT, *[self.neutral_us] * 4, *[IGNORED] * 4
        )
        return self._other.pack(message)

    def for_another(self) -> bytes:
        """An override for another robot's board."""
        other = self.robot_id % 250 + 1
        message = dialect.MAVLink_rc_channels_override_message(other, BOARD_COMPONENT, *[self.neutral_us] * 4, *[IGNORED] * 4)
        return self.computer.pack(message)

    def forced_arming(self) -> bytes:
        """MAVLink's arming by force, which a board must not have."""
        message = dialect.MAVLink_command_long_message(self.robot_id, BOARD_COMPONENT, 400, 0, 1, 21196, 0, 0, 0, 0, 0)
        return self.computer.pack(message)

    def station_arms(self, arm: bool) -> bytes:
        """A ground station's request to arm or disarm."""
        message = dialect.MAVLink_command_long_message(self.robot_id, BOARD_COMPONENT, 400, 0, float(arm), 0, 0, 0, 0, 0, 0)
        return self._other.pack(message)

    def motion(self, simulator: SimulatorLink | None = None) -> bytes:
        """Simulated measurements that no board on a bench has: HEADING_RAD and so on."""
        return (simulator or self.simulator).motion(self.wire.now_ns() // 1000, HEADING_RAD, TURN_RADPS, FORCE_MPS2, DEPTH_M)

    # --- what is asked

    @property
    def armed(self) -> bool:
        """The armed flag of the board's last heartbeat."""
        return self.computer.telemetry.armed

    @property
    def still(self) -> bool:
        """True if all thrusters' echoes are neutral."""
        return self.computer.telemetry.echo_us[:4] == (self.neutral_us,) * 4

    def ask_arm(self, arm: bool = True, frame: Callable[[], bytes] | None = None) -> int | None:
        """Ask to arm or disarm; the MAV_RESULT, or None if no answer came in half a second."""
        before = self.computer.telemetry.acknowledgements
        self.wire.send(self.computer.arm(arm))

        def answered() -> bool:
            return self.computer.telemetry.acknowledgements > before

        came = self.stream(frame, 0.5, answered) if frame is not None else self.listen(0.5, answered)
        acknowledged = self.computer.telemetry.acknowledged
        return acknowledged[1] if came and acknowledged is not None else None

    def arm(self) -> bool:
        """Arm as specified. Returns True if the board says that it is armed."""
        self.stream(self.pulses, 0.15)
        self.ask_arm(frame=self.pulses)
        return self.stream(self.pulses, 0.5, lambda: self.armed)

    def rest(self) -> bool:
        """Disarm from any state. Returns True if it worked."""
        self.ask_arm(False)
        self.listen(0.6)  # and let everything get old
        return not self.armed

    def stops_after(self, frame: Callable[[], bytes] | None) -> float:
        """Seconds from the last good override to disarmed and neutral, while only `frame` is sent to an armed board;
        infinite if it does not stop."""
        self.wire.send(self.pulses())
        last_ns = self.wire.now_ns()

        def stopped() -> bool:
            return not self.armed and self.still

        came = self.stream(frame, 1.0, stopped) if frame is not None else self.listen(1.0, stopped)
        return (self.wire.now_ns() - last_ns) / S if came else math.inf

    def answers(self, question: bytes, within_s: float = 0.2) -> float:
        """Seconds until a TIMESYNC is answered; infinite if it is not. The question must be the computer's last."""
        before, asked_ns = self.computer.telemetry.round_trips, self.wire.now_ns()
        self.wire.send(question)
        came = self.listen(within_s, lambda: self.computer.telemetry.round_trips > before)
        return (self.wire.now_ns() - asked_ns) / S if came else math.inf

    def setting(self, name: str, value: float) -> bytes:
        """Ask for another value of a parameter, which `put_back` takes back."""
        if name in self.station.values:
            self._before.setdefault(name, self.station.values[name])
        return self.station.set(name, value)

    def set(self, name: str, value: float) -> bool:
        """Set a parameter, and again where no answer comes. Returns True if the board says that it has that value."""
        for _ in range(ASKS):
            count = self.station.value_count
            self.wire.send(self.setting(name, value))
            if self.listen(0.5, partial(self._answered_by, name, value, count)):
                return self.station.error is None
        return False

    def _answered_by(self, name: str, value: float, count: int) -> bool:
        """True if the board has refused, or has told more than `count` values and this one for the parameter."""
        reported_value = self.station.values.get(name, math.nan)
        is_told = self.station.value_count > count and math.isclose(reported_value, value, rel_tol=1e-6, abs_tol=1e-6)
        return is_told or self.station.error is not None

    def put_back(self) -> list[str]:
        """Give all parameters the values that they had, the last changed first. Returns those that the board does not take."""
        remaining = {name: value for name, value in reversed(self._before.items()) if not self.set(name, value)}
        self._before = dict(reversed(remaining.items()))
        return [f"{name} = {value:g}" for name, value in remaining.items()]

"""The simulated thruster board: the rules of state_machine.py, with a link, sensors and a memory around them.

Bytes and the time come in, bytes and pulses go out. All times are ns of the board's own clock.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from sim_bridge.plant.sensors import BoardSensors, Reading
from sim_bridge.thruster_board.parameters import Parameters, Refusal
from sim_bridge.thruster_board.state_machine import INFO, S_NS, THRUSTERS, WARNING, Charge, Rules
from wire.config.experiment import Experiment
from wire.frames import Array
from wire.mavlink import agent_link
from wire.mavlink.board_link import (
    Arm,
    BoardLink,
    Heartbeat,
    ListParameters,
    Override,
    ReadParameter,
    SetKey,
    SetParameter,
    TellVersion,
    Timesync,
    Unsupported,
)
from wire.mavlink.framing import Peer
from wire.mavlink.signing import Key

MS_NS = 1_000_000
STATUS_NS, HEARTBEAT_NS, KEEP_NS = S_NS // 2, S_NS, S_NS
SENT_BETWEEN = 10_000  # more timestamps than a board uses between two writes of its memory

COMPONENT_ARM_DISARM, REQUEST_MESSAGE = 400, 512  # MAV_CMD
GYRO, ACCELEROMETER, PRESSURE, MOTORS, BATTERY = 0x1, 0x2, 0x8, 0x8000, 0x2000000  # MAV_SYS_STATUS_SENSOR
CHARGE_STATES = {Charge.GOOD: 1, Charge.WARN: 2, Charge.NO_ARM: 3, Charge.NEUTRAL: 4}  # OK, LOW, CRITICAL, EMERGENCY


@dataclass(frozen=True)
class Kept:
    """What a board keeps without power."""

    parameters: Mapping[str, float] = field(default_factory=dict)
    heard: int = 0  # no signed frame up to this timestamp counts again
    sent: int = 0  # up to which timestamp frames were signed
    key: Key | None = None  # of the link, as it was given over the link


class Board:
    """One robot's thruster board."""

    def __init__(
        self,
        experiment: Experiment,
        robot_id: int,
        seed: int,
        key: Key | None = None,
        kept: Kept | None = None,
        keep: Callable[[Kept], None] = lambda kept: None,
    ) -> None:
        """Switch the board on, with what it `kept`; `keep` is called with what must survive the next loss of power."""
        vehicle, sensors, kept = experiment.vehicle, experiment.sim.sensors, kept or Kept()
        self._key, self._robot_id = key, robot_id
        self._vehicle, self._supply_v, self._keep = vehicle, sensors.battery_v, keep
        computer = (robot_id, agent_link.AGENT_COMPONENT)
        self.rules = Rules(Parameters.of(experiment).restored(kept.parameters), computer, key, kept.heard)
        self._link = BoardLink(robot_id, self.rules.gate, key, kept.sent + SENT_BETWEEN)
        self.sensors = BoardSensors(sensors, robot_id, seed)
        self._burst_ns = round(S_NS / sensors.rate_hz)
        self._outbox: list[bytes] = []
        self._told_armed = False
        self._kept_heard = kept.heard
        self._last_step_ns: int | None = None
        self._last_burst_ns: int | None = None
        self._to_list = len(self.rules.parameters.table)  # parameters that are still to be told, from this one on
        self.burst_ms = -1  # board time of the last burst sent, as ATTITUDE carries it

    @property
    def pulses(self) -> tuple[int, ...]:
        """What is on the outputs, in us: 4 thrusters, 4 ankles."""
        return self.rules.outputs_us

    @property
    def armed(self) -> bool:
        """Whether thrusters follow overrides."""
        return self.rules.armed

    @property
    def neutral(self) -> bool:
        """Whether all thrusters stand still."""
        return all(pulse == self.rules.parameters.neutral_us for pulse in self.rules.echo_us[:THRUSTERS])

    @property
    def signed(self) -> bool:
        """Whether the link is."""
        return self._key is not None

    @property
    def unauthentic_frames(self) -> int:
        """Frames that were dropped for their signature."""
        return self._link.unauthentic_frames

    def receive(self, data: bytes, now_ns: int) -> bool:
        """Bytes from the robot's computer, or from somebody else on the link. Returns whether a frame in them was taken: one
        that is intact, and on a signed link well signed. Never raises, whatever they are."""
        link = self._link
        before = link.taken_frames
        self._obey(data, now_ns)
        return link.taken_frames > before

    def _obey(self, data: bytes, now_ns: int) -> None:
        for asker, event in self._link.receive(data, now_ns):
            match event:
                case Override(pulses_us):
                    self.rules.override(asker, pulses_us, now_ns)
                case Arm(arm):
                    self._remember()
                    result = self.rules.arm(arm, now_ns)
                    self._tell()
                    self._outbox.append(self._link.acknowledge(asker, COMPONENT_ARM_DISARM, result))
                case Timesync(sent_ns):
                    self._outbox.append(self._link.timesync(max(now_ns, 1), sent_ns))
                case TellVersion():
                    self._outbox += [self._link.acknowledge(asker, REQUEST_MESSAGE, agent_link.ACCEPTED), self._link.version()]
                case Unsupported(command):
                    self._outbox.append(self._link.acknowledge(asker, command, agent_link.UNSUPPORTED))
                case ListParameters():
                    self._to_list = 0
                case ReadParameter(name, index):
                    table = self.rules.parameters.table
                    self._answer(asker, table[index].name if 0 <= index < len(table) else "" if index >= 0 else name, None)
                case SetParameter(name, value, real):
                    self._remember()
                    self._answer(asker, name, self.rules.change(name, value) if real else Refusal.TYPE)
                    self._remember()
                case SetKey(key, newest):
                    self._take_key(key, newest)
                    return  # what came with it was judged by the old key
                case Heartbeat():
                    pass

    def _take_key(self, key: Key, newest: int) -> None:
        """Sign from now on. A board that has a key hears of another only from who has the one that it has."""
        refusal = self.rules.set_key(key, newest)
        if refusal:
            self._outbox.append(self._link.text(WARNING, f"no new key: {refusal}"))
            return
        self._key = key
        self._link = BoardLink(self._robot_id, self.rules.gate, key, self._link.stamp + SENT_BETWEEN)
        self._outbox.append(self._link.text(INFO, "signed from now on"))
        self._remember()

    def _answer(self, asker: Peer, name: str, refusal: Refusal | None) -> None:
        """Tell a parameter's value as it is now, and why somebody did not get what they wanted."""
        index = self.rules.parameters.index.get(name, -1)
        refusal = refusal if index >= 0 else Refusal.UNKNOWN
        if index >= 0:
            self._outbox.append(self._value(index))
        if refusal is not None:
            self._outbox.append(self._link.parameter_error(asker, name, index, refusal.code))
            bounds = f" ({self.rules.parameters.table[index].bounds})" if refusal is Refusal.RANGE else ""
            self._outbox.append(self._link.text(WARNING, f"{name}: {refusal.words}{bounds}"))

    def _value(self, index: int) -> bytes:
        parameters = self.rules.parameters
        return self._link.parameter(parameters.table[index].name, parameters.values[index], len(parameters.table), index)

    def _remember(self) -> None:
        """Put down what must not be forgotten: before an order is carried out, so that it cannot count again."""
        parameters, self._kept_heard = self.rules.parameters, self.rules.gate.newest
        values = dict(zip(parameters.index, parameters.values, strict=True))
        self._keep(Kept(values, self._kept_heard, self._link.stamp, self._key))

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
        self._obey(b"", now_ns)  # what has begun and not ended may be overdue
        voltage = None
        if self.measures(now_ns):
            voltage = self.sensors.battery_v(self._supply_v if supply_v is None else supply_v, self._load())
            self.rules.battery(voltage, _seconds(self._last_burst_ns, now_ns))
        self.rules.step(now_ns)
        self._tell()
        if voltage is not None:
            self._burst(now_ns, self.sensors.read(eta, nu, acceleration, tilt), voltage)
            self._last_burst_ns = now_ns
        self._last_step_ns = now_ns
        data = b"".join(self._outbox)
        self._outbox.clear()
        return data

    def _tell(self) -> None:
        """Say what has changed."""
        self._outbox += [self._link.text(said.severity, said.text) for said in self.rules.said]
        self.rules.said.clear()
        if self.rules.armed is not self._told_armed:
            self._told_armed = self.rules.armed
            self._outbox.append(self._heartbeat())

    def _heartbeat(self) -> bytes:
        return self._link.heartbeat(self.rules.armed, healthy=self.rules.charge < Charge.NO_ARM)

    def _burst(self, now_ns: int, reading: Reading, voltage: float) -> None:
        """All that the board measures, ATTITUDE last: whoever has that has the whole burst."""
        link, rules = self._link, self.rules
        self.burst_ms = now_ns // MS_NS % 2**32
        self._outbox += [
            link.imu(self.burst_ms, reading.acceleration_mps2, reading.yaw_rate_radps),
            link.pressure(self.burst_ms, reading.depth_m),
            link.servo_output(now_ns // 1000, rules.echo_us),
        ]
        if _crosses(STATUS_NS, self._last_burst_ns, now_ns):
            sensors = GYRO | ACCELEROMETER | PRESSURE | MOTORS | BATTERY
            healthy = sensors if rules.charge is Charge.GOOD else sensors & ~BATTERY
            self._outbox.append(link.status(voltage, sensors, healthy, rules.overrides_refused + link.refused_frames))
            self._outbox.append(link.battery(voltage, CHARGE_STATES[rules.charge]))
        if _crosses(HEARTBEAT_NS, self._last_burst_ns, now_ns):
            self._outbox.append(self._heartbeat())
        if self._to_list < len(rules.parameters.table):
            self._outbox.append(self._value(self._to_list))
            self._to_list += 1
        self._outbox.append(link.attitude(self.burst_ms, reading.heading_rad, reading.yaw_rate_radps))
        if _crosses(KEEP_NS, self._last_burst_ns, now_ns) and self.rules.gate.newest > self._kept_heard:
            self._remember()

    def _load(self) -> float:
        """Thrust asked of the battery, as a fraction of all thrusters at full."""
        thruster = self._vehicle.thruster
        force_n = np.abs(thruster.force_n(np.array(self.pulses[:THRUSTERS], dtype=np.float64)))
        return float(force_n.sum()) / (THRUSTERS * thruster.max_thrust_n)


def _crosses(period_ns: int, since_ns: int | None, now_ns: int) -> bool:
    """Whether a multiple of the period lies in (since, now]."""
    return since_ns is None or now_ns // period_ns > since_ns // period_ns


def _seconds(since_ns: int | None, now_ns: int) -> float:
    return 0.0 if since_ns is None else max(now_ns - since_ns, 0) / S_NS

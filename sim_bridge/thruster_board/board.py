"""The simulated thruster board: state_machine.py with a link, sensors and a nonvolatile memory around it.

Bytes and the time come in, bytes and pulses go out. All times are ns of the board's own clock.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from shoal.config.experiment import Experiment
from shoal.config.vehicle import Thruster
from shoal.frames import Array
from shoal.mavlink import agent_link
from shoal.mavlink.agent_link import GRAVITY_MPS2, WATER_DENSITY_KGPM3
from shoal.mavlink.frame_codec import Peer
from shoal.mavlink.signing import Key
from sim_bridge.plant.sensors import LEVEL, BoardSensors, Reading
from sim_bridge.thruster_board.board_link import (
    Arm,
    BoardLink,
    Calibrate,
    Heartbeat,
    ListParameters,
    Override,
    ReadParameter,
    SetKey,
    SetParameter,
    SimulatedBattery,
    SimulatedMotion,
    TellVersion,
    Timesync,
    Unsupported,
)
from sim_bridge.thruster_board.parameters import Parameters, Refusal
from sim_bridge.thruster_board.sensor_zero import ZERO_IN_QUESTION, SensorZero, ZeroEvent, Zeros
from sim_bridge.thruster_board.state_machine import (
    INFO,
    S_NS,
    WARNING,
    BoardStateMachine,
    Charge,
    StatusText,
)

MS_NS = 1_000_000
HPA_PER_M = WATER_DENSITY_KGPM3 * GRAVITY_MPS2 / 100.0
STATUS_NS, HEARTBEAT_NS, KEEP_NS = S_NS // 2, S_NS, S_NS
MOTION_AGE_NS, BATTERY_AGE_NS = 100 * MS_NS, 2 * S_NS  # of simulated measurements, until they count as gone
SENT_BETWEEN = 10_000  # more timestamps than a board uses between two writes of its memory

CALIBRATE, COMPONENT_ARM_DISARM, REQUEST_MESSAGE = 241, 400, 512  # MAV_CMD
GYRO, ACCELEROMETER, PRESSURE, MOTORS, BATTERY = 0x1, 0x2, 0x8, 0x8000, 0x2000000  # MAV_SYS_STATUS_SENSOR
SENSORS = GYRO | ACCELEROMETER | PRESSURE | MOTORS | BATTERY
CHARGE_STATES = {Charge.GOOD: 1, Charge.WARN: 2, Charge.NO_ARM: 3, Charge.NEUTRAL: 4}  # OK, LOW, CRITICAL, EMERGENCY


@dataclass(frozen=True)
class NonvolatileState:
    """State that a board keeps without power."""

    parameters: Mapping[str, float] = field(default_factory=dict)
    heard: int = 0  # newest timestamp of a signed frame that was taken; frames up to it are refused
    sent: int = 0  # newest timestamp that was used for signing
    key: Key | None = None  # the link's key, if it was set over the link
    zeros: Zeros | None = None  # of the sensors, if they were taken


class SimulatedSensors:
    """The latest simulated measurements of a board in HIL mode."""

    def __init__(self, now_ns: int) -> None:
        """HIL mode begins."""
        self._motion: SimulatedMotion | None = None
        self._voltage_v: float | None = None
        self._motion_ns = self._battery_ns = now_ns

    def move(self, motion: SimulatedMotion, now_ns: int) -> None:
        """Take measurements of the motion."""
        self._motion, self._motion_ns = motion, now_ns

    def charge(self, voltage_v: float, now_ns: int) -> None:
        """Take a measurement of the battery."""
        self._voltage_v, self._battery_ns = voltage_v, now_ns

    def motion(self, now_ns: int) -> SimulatedMotion | None:
        """The measurements of the motion; None while they are too old, or there are none."""
        return self._motion if now_ns - self._motion_ns <= MOTION_AGE_NS else None

    def battery_v(self, now_ns: int) -> float | None:
        """The battery's voltage; None before the first, 0 V after too long without one."""
        return self._voltage_v if now_ns - self._battery_ns <= BATTERY_AGE_NS else 0.0


class DemandedLoad:
    """Thrust demanded from the battery by the outputs, as a fraction of all thrusters at full."""

    def __init__(self, thruster: Thruster, thrusters: int) -> None:
        """`thrusters` is how many of the outputs, from the first on, are thrusters'."""
        self._thruster, self._count, self._full_n = thruster, thrusters, thrusters * thruster.max_thrust_n
        self._force_n: dict[int, float] = {}  # by pulse, either way: there are some hundreds, and each comes again and again

    def of(self, pulses_us: Sequence[int]) -> float:
        """The load of these pulses."""
        total_n = 0.0
        for pulse in pulses_us[: self._count]:
            force_n = self._force_n.get(pulse)
            if force_n is None:
                force_n = self._force_n[pulse] = abs(float(self._thruster.force_n(np.array(pulse, dtype=np.float64))))
            total_n += force_n
        return total_n / self._full_n


class ThrusterBoard:
    """One robot's thruster board."""

    obeys_ns: int | None = None  # its outputs are known at once

    def __init__(
        self,
        experiment: Experiment,
        robot_id: int,
        seed: int,
        key: Key | None = None,
        stored: NonvolatileState | None = None,
        store: Callable[[NonvolatileState], None] = lambda stored: None,
        zero: SensorZero | None = None,
    ) -> None:
        """Switch the board on, with what it `stored` before; `store` is called with what must survive the next loss of power.
        With a `key` it signs its frames, and takes signed ones alone. `zero` is how this life begins; without it the board was
        switched on in air some time ago."""
        sensors, stored = experiment.sim.sensors, stored or NonvolatileState()
        self._key, self._robot_id = key, robot_id
        self._load = DemandedLoad(experiment.vehicle.thruster, experiment.vehicle.thruster_count)
        self._supply_v = sensors.battery_v
        self._store_callback = store
        computer = (robot_id, agent_link.AGENT_COMPONENT)
        self.rules = BoardStateMachine(Parameters.of(experiment).restored(stored.parameters), computer, key, stored.heard)
        self.link = BoardLink(robot_id, self.rules.gate, key, stored.sent + SENT_BETWEEN)
        self.sensors = BoardSensors(experiment, robot_id, seed)
        self._burst_ns = round(S_NS / sensors.rate_hz)
        self._outbox: list[bytes] = []
        self._simulated: SimulatedSensors | None = None  # in HIL mode
        self.zero = zero or SensorZero.settled()
        if not self.zero.start.is_power_on:
            self.rules.texts.append(StatusText(WARNING, f"restarted: {self.zero.start.cause_name}"))
        self._sent_state = (False, False, self._status())  # armed, in HIL mode, the zero
        self._stored_heard = stored.heard
        self._last_step_ns: int | None = None
        self._last_burst_ns: int | None = None
        self._to_list = len(self.rules.parameters.table)  # parameters that are still to be told, from this one on
        self.burst_ms = -1  # board time of the last burst sent, as ATTITUDE carries it

    @property
    def pulses(self) -> tuple[int, ...]:
        """Pulses on the outputs, us: 4 thrusters, 4 ankles; or 8 thrusters."""
        return self.rules.outputs_us

    @property
    def armed(self) -> bool:
        """True if thrusters follow overrides."""
        return self.rules.armed

    @property
    def neutral(self) -> bool:
        """True if all thrusters stand still."""
        parameters = self.rules.parameters
        return all(pulse == parameters.neutral_us for pulse in self.rules.echo_us[: parameters.thrusters])

    @property
    def signed(self) -> bool:
        """True if the link is signed."""
        return self._key is not None

    @property
    def unauthentic_frames(self) -> int:
        """Number of frames that were dropped for their signature."""
        return self.link.unauthentic_frames

    def receive(self, data: bytes, now_ns: int) -> bool:
        """Take bytes from the robot's computer or another peer. Returns True if a frame in them was taken: intact, and on
        a signed link well signed. Never raises, for any bytes."""
        link = self.link
        before = link.taken_frames
        self._handle(data, now_ns)
        return link.taken_frames > before

    def _handle(self, data: bytes, now_ns: int) -> None:
        """Act on received bytes, frame by frame."""
        for asker, event in self.link.receive_each(data, now_ns):
            match event:
                case Override(pulses_us):
                    self.rules.override(asker, pulses_us, now_ns)
                case Arm(arm):
                    self._store()
                    result = self.rules.arm(arm, now_ns)
                    if self.rules.armed:
                        self.zero.leave_bias()
                    self._report_status()
                    self._outbox.append(self.link.acknowledge(asker, COMPONENT_ARM_DISARM, result))
                case Calibrate(pressure, gyro):
                    self._store()
                    result = self._calibrate(pressure, gyro)
                    self._report_status()
                    self._outbox.append(self.link.acknowledge(asker, CALIBRATE, result))
                case Timesync(sent_ns):
                    self._outbox.append(self.link.timesync(max(now_ns, 1), sent_ns))
                case TellVersion():
                    self._outbox += [self.link.acknowledge(asker, REQUEST_MESSAGE, agent_link.ACCEPTED), self.link.version()]
                case Unsupported(command):
                    self._outbox.append(self.link.acknowledge(asker, command, agent_link.UNSUPPORTED))
                case ListParameters():
                    self._to_list = 0
                case ReadParameter(name, index):
                    table = self.rules.parameters.table
                    self._answer_parameter(
                        asker, table[index].name if 0 <= index < len(table) else "" if index >= 0 else name, None
                    )
                case SetParameter(name, value, real):
                    self._store()
                    self._answer_parameter(asker, name, self.rules.change(name, value) if real else Refusal.TYPE)
                    self._enter_or_leave_hil(now_ns)
                    self._store()
                case SetKey(key, newest):
                    self._take_key(key, newest)
                    return  # what came with it was judged by the old key
                case SimulatedMotion():
                    if self._simulated is not None:
                        self._simulated.move(event, now_ns)
                case SimulatedBattery(voltage_v):
                    if self._simulated is not None:
                        self._simulated.charge(voltage_v, now_ns)
                case Heartbeat():
                    pass

    def _status(self) -> int:
        """HEARTBEAT's custom_mode. Simulated measurements have no zero."""
        return self.zero.status & ~ZERO_IN_QUESTION if self.rules.parameters.hil else self.zero.status

    def _calibrate(self, pressure: bool, gyro: bool) -> int:
        """Have the zeros confirmed or taken anew, for a person; returns the MAV_RESULT."""
        texts = self.rules.texts
        if self.rules.armed:
            texts.append(StatusText(WARNING, "not calibrated: armed"))
            return agent_link.REJECTED
        takes = pressure or gyro
        if self.rules.parameters.hil:
            texts.append(StatusText(WARNING, "not calibrated: in HIL mode"))
            return agent_link.REJECTED
        if not self.zero.calibrate(pressure, gyro):
            why = "depth zero not taken: no pressure" if takes else "no depth zero is kept: take it in air"
            texts.append(StatusText(WARNING, why))
            return agent_link.REJECTED
        if not takes:
            texts.append(StatusText(INFO, "depth zero confirmed"))
        return agent_link.ACCEPTED

    def _zeroed(self, reading: Reading) -> Reading:
        """A measurement less the zeros of the sensors. The first measurements after a start may set these zeros."""
        zero, texts = self.zero, self.rules.texts
        event = zero.take_pressure(reading.depth_m * HPA_PER_M)
        if event is ZeroEvent.TAKEN:
            texts.append(StatusText(INFO, "depth zero taken"))
        if event is ZeroEvent.MISSED:
            texts.append(StatusText(WARNING, "depth zero not taken: no pressure"))
        if event is ZeroEvent.QUESTIONED:
            texts.append(StatusText(WARNING, "depth zero in question: confirm it"))
        if zero.take_rate(reading.yaw_rate_radps) is ZeroEvent.BIAS_TAKEN or event is ZeroEvent.TAKEN:
            self._store()
        zero_m = math.nan if zero.surface_hpa is None else zero.surface_hpa / HPA_PER_M
        if (zero_m, zero.gyro_bias_radps) == (0.0, 0.0):
            return reading
        return replace(reading, depth_m=reading.depth_m - zero_m, yaw_rate_radps=reading.yaw_rate_radps - zero.gyro_bias_radps)

    def _enter_or_leave_hil(self, now_ns: int) -> None:
        """Follow a change of HIL_MODE, if there was one."""
        if self.rules.parameters.hil is not self.link.hil:
            self.link.hil = self.rules.parameters.hil
            self._simulated = SimulatedSensors(now_ns) if self.link.hil else None

    def _take_key(self, key: Key, newest: int) -> None:
        """Sign with this key from now on. A board with a key accepts another only from the owner of its own."""
        refusal = self.rules.set_key(key, newest)
        if refusal:
            self._outbox.append(self.link.text(WARNING, f"no new key: {refusal}"))
            return
        self._key = key
        self.link = BoardLink(self._robot_id, self.rules.gate, key, self.link.stamp + SENT_BETWEEN)
        self.link.hil = self.rules.parameters.hil
        self._outbox.append(self.link.text(INFO, "signed from now on"))
        self._store()

    def _answer_parameter(self, asker: Peer, name: str, refusal: Refusal | None) -> None:
        """Send a parameter's present value, and the reason for a refusal."""
        index = self.rules.parameters.index.get(name, -1)
        refusal = refusal if index >= 0 else Refusal.UNKNOWN
        if index >= 0:
            self._outbox.append(self._value(index))
        if refusal is not None:
            self._outbox.append(self.link.parameter_error(asker, name, index, refusal.code))
            bounds = f" ({self.rules.parameters.table[index].bounds})" if refusal is Refusal.RANGE else ""
            self._outbox.append(self.link.text(WARNING, f"{name}: {refusal.words}{bounds}"))

    def _value(self, index: int) -> bytes:
        parameters = self.rules.parameters
        return self.link.parameter(parameters.table[index].name, parameters.values[index], len(parameters.table), index)

    def _store(self) -> None:
        """Write the nonvolatile state, before a command is carried out, so that its frame cannot count again."""
        parameters, self._stored_heard = self.rules.parameters, self.rules.gate.newest
        values = dict(zip(parameters.index, parameters.values, strict=True))
        self._store_callback(NonvolatileState(values, self._stored_heard, self.link.stamp, self._key, self.zero.kept))

    @property
    def next_event_ns(self) -> int:
        """Earliest instant at which a step does anything, unless bytes arrive before. Steps until then may be left out."""
        if self._last_step_ns is None or self._outbox or self.link.is_waiting:
            return 0
        burst_ns = (self._last_step_ns // self._burst_ns + 1) * self._burst_ns
        return min(burst_ns, self.rules.next_event_ns)

    def measures(self, now_ns: int) -> bool:
        """True if the step to this instant reads the sensors."""
        return crosses(self._burst_ns, self._last_step_ns, now_ns)

    def step(
        self,
        now_ns: int,
        eta: Array,
        nu: Array,
        acceleration: Array,
        supply_v: float | None = None,
        tilt: Array | Sequence[float] = LEVEL,
    ) -> bytes:
        """Run the state machine, move the outputs, measure. Returns the bytes to send, which are none between bursts.

        `eta`, `nu` and `acceleration` (d nu / dt), each (4,), are the robot's true motion; they count only in a step that
        `measures`, and not in HIL mode. `supply_v` is the battery's voltage without load (default: the experiment's),
        `tilt` is roll, pitch, and d/dt of them.
        """
        self._handle(b"", now_ns)  # what has begun and not ended may be overdue
        measures, voltage = self.measures(now_ns), None
        if measures:
            if self._simulated is not None:
                voltage = self._simulated.battery_v(now_ns)
            else:
                supply_v = self._supply_v if supply_v is None else supply_v
                voltage = self.sensors.battery_v(supply_v, self._load.of(self.pulses))
            if voltage is not None:
                self.rules.battery(voltage, _seconds(self._last_burst_ns, now_ns))
        self.rules.step(now_ns)
        self._report_status()
        if measures:
            reading: Reading | SimulatedMotion | None
            if self._simulated is not None:
                reading = self._simulated.motion(now_ns)
            else:
                reading = self._zeroed(self.sensors.read(eta, nu, acceleration, tilt, now_ns / S_NS))
            self._report_status()
            self._burst(now_ns, reading, voltage)
            self._last_burst_ns = now_ns
        self._last_step_ns = now_ns
        data = b"".join(self._outbox)
        self._outbox.clear()
        return data

    def _report_status(self) -> None:
        """Send the texts and the changes of arming, of HIL mode and of the zero that are due."""
        self._outbox += [self.link.text(text.severity, text.text) for text in self.rules.texts]
        self.rules.texts.clear()
        if (now := (self.rules.armed, self.link.hil, self._status())) != self._sent_state:
            self._sent_state = now
            self._outbox.append(self._heartbeat())

    def _heartbeat(self) -> bytes:
        return self.link.heartbeat(self.rules.armed, self.rules.charge < Charge.NO_ARM, self.link.hil, self._status())

    def _burst(self, now_ns: int, reading: Reading | SimulatedMotion | None, voltage: float | None) -> None:
        """Send all measurements that there are, ATTITUDE last: it completes a burst."""
        link, rules = self.link, self.rules
        self.burst_ms = now_ns // MS_NS % 2**32
        if reading is not None and _has_force(reading):
            self._outbox.append(link.imu(self.burst_ms, reading.acceleration_mps2, reading.yaw_rate_radps))
        if reading is not None:
            self._outbox.append(link.pressure(self.burst_ms, reading.depth_m))
        self._outbox.append(link.servo_output(now_ns // 1000, rules.echo_us))
        if voltage is not None and crosses(STATUS_NS, self._last_burst_ns, now_ns):
            healthy = _healthy(reading) | (BATTERY if rules.charge is Charge.GOOD else 0)
            self._outbox.append(link.status(voltage, SENSORS, healthy, rules.overrides_refused + link.refused_frames))
            self._outbox.append(link.battery(voltage, CHARGE_STATES[rules.charge]))
        if crosses(HEARTBEAT_NS, self._last_burst_ns, now_ns):
            self._outbox.append(self._heartbeat())
        if self._to_list < len(rules.parameters.table):
            self._outbox.append(self._value(self._to_list))
            self._to_list += 1
        if reading is not None:
            tilt = reading.tilt_sensed if isinstance(reading, Reading) else LEVEL  # HIL_SENSOR tells none
            self._outbox.append(link.attitude(self.burst_ms, reading.heading_rad, reading.yaw_rate_radps, tilt))
        if crosses(KEEP_NS, self._last_burst_ns, now_ns) and self.rules.gate.newest > self._stored_heard:
            self._store()


def _has_force(reading: Reading | SimulatedMotion) -> bool:
    """True if SCALED_IMU, whose whole numbers have no NaN, can tell a measurement."""
    return math.isfinite(sum(reading.acceleration_mps2) + reading.yaw_rate_radps)


def _healthy(reading: Reading | SimulatedMotion | None) -> int:
    """The bits of the sensors that measure, and of the motors."""
    if reading is None:
        return MOTORS
    gyro = GYRO if math.isfinite(reading.yaw_rate_radps) else 0
    depth = PRESSURE if math.isfinite(reading.depth_m) else 0
    return MOTORS | gyro | depth | (ACCELEROMETER if _has_force(reading) else 0)


def crosses(period_ns: int, since_ns: int | None, now_ns: int) -> bool:
    """True if a multiple of the period lies in (since, now]."""
    return since_ns is None or now_ns // period_ns > since_ns // period_ns


def _seconds(since_ns: int | None, now_ns: int) -> float:
    return 0.0 if since_ns is None else max(now_ns - since_ns, 0) / S_NS

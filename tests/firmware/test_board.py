"""The C board beside the Python reference, byte for byte, and the conformance run on it in simulated time."""

import ctypes
import math
import random
from collections.abc import Callable

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as dialect

from shoal.mavlink.agent_link import ACCEPTED, CALIBRATE, IGNORED, REJECTED, STANDARD_GRAVITY_MPS2, AgentLink
from shoal.mavlink.framing import Sender
from shoal.mavlink.parameters import ParameterClient
from shoal.mavlink.signing import Key
from sim_bridge.board_conformance.runner import RuleVerdict
from sim_bridge.plant.sensors import Reading
from sim_bridge.thruster_board.board import NonvolatileState, ThrusterBoard
from sim_bridge.thruster_board.sensor_zero import BoardStart, SensorZero, Zeros
from tests.firmware.bench import results
from tests.firmware.library import POOL, FirmwareBoard, core

pytestmark = pytest.mark.long

KEY, OTHER = Key(bytes(range(1, 33))), Key(bytes(range(2, 34)))
STILL = np.zeros(4)
COMPUTER, SIMULATOR = 0, 5  # of the senders
SIMULATED = (dialect.MAVLINK_MSG_ID_HIL_SENSOR, dialect.MAVLINK_MSG_ID_BATTERY_STATUS)
STEPS = 60
HPA_PER_M = 998.0 * 9.81 / 100.0


@pytest.fixture(scope="module")
def library() -> ctypes.CDLL:
    return core()


class GivenSensors:
    """Sensors that measure what a test gives; all values are exact in single precision."""

    def __init__(self) -> None:
        self.reading, self.voltage_v = Reading(0.0, 0.0, (0.0, 0.0, -STANDARD_GRAVITY_MPS2), 0.0), 12.0

    def draw(self, draw: random.Random) -> None:
        mg = STANDARD_GRAVITY_MPS2 / 1000.0
        acceleration = (draw.randint(-900, 900) * mg, draw.randint(-40_000, 40_000) * mg, -1000 * mg)
        depth_m = draw.randint(-64, 6400) / 64.0 / HPA_PER_M if draw.random() < 0.97 else math.nan
        self.reading = Reading(draw.randint(-400, 400) / 128.0, draw.randint(-64, 64) / 32.0, acceleration, depth_m)
        self.voltage_v = 12.0 if draw.random() < 0.9 else draw.randint(0, 100) / 8.0 + 0.015625

    def read(self, *_: object) -> Reading:
        return self.reading

    def battery_v(self, *_: object) -> float:
        return self.voltage_v


class Speaker:
    """The computer, a ground station and a stranger, who say right and wrong things."""

    def __init__(self, draw: random.Random, key: Key | None) -> None:
        self._draw, self._stamp = draw, 5000
        keys = [key, OTHER if key else key, key and Key(key.secret, 3), None, OTHER, key and Key(key.secret, 4)]
        peers = [(1, 191), (1, 191), (255, 190), (1, 191), (2, 191), (1, 200)]
        self._senders = [Sender(peer, each, lambda: self._stamp) for peer, each in zip(peers, keys, strict=True)]
        self._frames: list[bytes] = [b""]

    def frame(self) -> bytes:
        """One frame, or something like one."""
        draw = self._draw
        kind = draw.random()
        if kind < 0.05:
            return draw.choice(self._frames)  # again
        if kind < 0.1:
            return bytes(draw.choice([0xFD, 0, 1, 9, draw.randrange(256)]) for _ in range(draw.randrange(40)))
        message = self._message()
        usual = self._senders[SIMULATOR if message.get_msgId() in SIMULATED else COMPUTER]
        sender = usual if draw.random() < 0.8 else draw.choice(self._senders)
        self._stamp += draw.choice([0, 1, 1, 100, 10_000])
        data = sender.pack(message)
        self._frames.append(data)
        if kind < 0.16:
            broken = bytearray(data)
            broken[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
            return bytes(broken)
        if kind < 0.2:
            return data[: draw.randrange(len(data))]
        return data

    def _message(self) -> dialect.MAVLink_message:
        draw = self._draw
        system, component = draw.choices([1, 2, 0], [30, 1, 1])[0], draw.choices([1, 0, 7], [30, 2, 1])[0]
        name = draw.choice(["CMD_AGE_MS", "SLEW_US_S", "ANK4_TRIM_US", "CRV12_US", "NO_SUCH", "sixteen_letters_", "\xff\xe9"])
        to = (system, component)
        us = [draw.choice([1500, 1500, 1500, 1560, 1477]) for _ in range(4)]
        odd = draw.choice([*[IGNORED] * 6, 1000, 2000, 2001, 499, 0])
        value = draw.choice([200.0, 0.0, -1.0, 8000.0, 1900.0, float("nan"), float("inf"), 120.5])
        wanted, force = draw.choice([1, 1, 1, 0, 2, float("nan")]), draw.choice([0, 0, 0, float("nan"), 21196])
        arm = (*to, 400, 0, wanted, force, 0, 0, 0, 0, 0)
        gyro, pressure = draw.choices([0, 0, 1, float("nan"), 2], k=2)
        calibrate = (*to, 241, 0, gyro, draw.choice([0, 0, 0, 1]), pressure, 0, 0, 0, draw.choice([0, 0, float("nan"), 1]))
        secret = draw.choice([[0] * 32, list(KEY.secret)])
        makers: list[Callable[[], dialect.MAVLink_message]] = [
            lambda: dialect.MAVLink_rc_channels_override_message(*to, *us, IGNORED, 1500, 1600, odd),
            lambda: dialect.MAVLink_rc_channels_override_message(1, 1, 1500, 1500, 1500, 1500, *[IGNORED] * 4),
            lambda: dialect.MAVLink_command_long_message(*arm),
            lambda: dialect.MAVLink_command_long_message(*to, 512, 0, draw.choice([148, 0]), 0, 0, 0, 0, 0, 0),
            lambda: dialect.MAVLink_command_long_message(*to, draw.choice([76, 511]), 0, 0, 0, 0, 0, 0, 0, 0),
            lambda: dialect.MAVLink_timesync_message(draw.choice([0, 0, 5]), draw.randrange(-(2**63), 2**63)),
            lambda: dialect.MAVLink_param_request_list_message(*to),
            lambda: dialect.MAVLink_param_request_read_message(*to, name.encode("latin-1"), draw.randint(-2, 45)),
            lambda: dialect.MAVLink_param_set_message(*to, name.encode("latin-1"), value, draw.choice([9, 9, 9, 6])),
            lambda: dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3),
            lambda: dialect.MAVLink_statustext_message(6, b"hello"),
            lambda: dialect.MAVLink_setup_signing_message(*to, secret, draw.randrange(2**15)),
            lambda: dialect.MAVLink_param_set_message(1, 1, b"HIL_MODE", draw.choice([1, 1, 1, 0, 2]), 9),
            lambda: dialect.MAVLink_param_set_message(1, 1, b"HIL_OUTPUTS", draw.choice([1, 1, 0]), 9),
            self._motion,
            self._battery,
            lambda: dialect.MAVLink_command_long_message(*calibrate),
        ]
        return draw.choices(makers, [8, 12, 6, 1, 1, 2, 0.2, 2, 3, 2, 1, 0.2, 2, 1, 4, 2, 2])[0]()

    def _motion(self) -> dialect.MAVLink_message:
        """Simulated measurements: exact in single precision, or beyond one of the bounds."""
        draw, mg = self._draw, STANDARD_GRAVITY_MPS2 / 1000.0
        field = draw.choice([(0.0, 0.0), (10.0, -10.0), *[(draw.randint(-8, 8) / 8.0, draw.randint(-8, 8) / 8.0)] * 8])
        values = [*(draw.randint(-30_000, 30_000) * mg for _ in range(3)), draw.randint(-1600, 1600) / 32.0, *field]
        values.append(draw.randint(500 * 64, 20_000 * 64) / 64.0)
        if draw.random() < 0.2:
            odd = draw.choice([math.nan, math.inf, -300.5, 300.5, 50.5, 10.5, 499.0, 20_001.0])
            values[draw.randrange(len(values))] = odd
        x, y, z, turn, ahead, side, pressure = values
        updated = 0x2E7 ^ (1 << draw.randrange(10) if draw.random() < 0.1 else 0) | draw.choice([0, 2**31])
        return dialect.MAVLink_hil_sensor_message(
            0, x, y, z, math.nan, 0, turn, ahead, side, 0, pressure, 0, 0, 0, updated, draw.randrange(2)
        )

    def _battery(self) -> dialect.MAVLink_message:
        """A simulated battery: its voltage away from those where single precision rounds to the other side."""
        draw = self._draw
        volts = draw.choice([0, 60_000, 60_001, IGNORED, *[draw.randint(80, 130) * 100 + 30] * 12])
        cells = [volts, *[IGNORED] * 9]
        return dialect.MAVLink_battery_status_message(draw.choice([*[0] * 9, 1]), 0, 0, 0, cells, 0, 0, 0, 0)


def unsigned(data: bytes) -> list[bytes]:
    """The frames without their signatures."""
    frames = []
    while data:
        size = 12 + data[1]
        frames.append(data[:size])
        data = data[size + (13 if data[2] else 0) :]
    return frames


def start_of(draw: random.Random) -> BoardStart:
    """A begin of a life; values are exact in single precision."""
    zeros = draw.choice([None, Zeros(draw.randint(-640, 640) / 64.0, draw.randint(-16, 16) / 64.0)])
    return BoardStart(draw.randrange(16), draw.random() < 0.5, zeros)


def compare(library: ctypes.CDLL, seed: int) -> tuple[bool, bool]:
    """The same frames and readings for both boards: the same bytes and pulses. Returns true if they were armed, and if they
    flew in HIL mode."""
    draw = random.Random(seed)
    key = draw.choice([None, KEY])
    start = draw.choice([None, start_of(draw)])
    zero = None if start is None else SensorZero(start)
    reference = ThrusterBoard(POOL, 1, 1, key, NonvolatileState(heard=4000, sent=20), zero=zero)
    sensors = reference.sensors = GivenSensors()  # type: ignore[assignment]
    board, speaker = FirmwareBoard(library, key, 4000, 20), Speaker(draw, key)
    if start is not None:
        board.start(start)
    now_ns, armed, hil = 0, False, False
    together = False  # frames came at once: the answer to the first may be signed after the second was heard
    for count in range(STEPS):
        for _ in range(draw.choice([0, 1, 1, 2, 4])):
            data = speaker.frame()
            now_ns += 1000 * draw.randint(1, 3000)
            taken = reference.link.taken_frames
            assert board.receive(data, now_ns) is reference.receive(data, now_ns), (seed, count, data.hex())
            together |= reference.link.taken_frames > taken + 1
        now_ns += 1000 * draw.choice([1, 100, 5000, 5000, 60_000, 300_000])
        sensors.draw(draw)
        taken, answer = reference.link.taken_frames, reference.step(now_ns, STILL, STILL, STILL)
        firmware_answer = board.step(now_ns, sensors.reading, sensors.voltage_v)
        together |= reference.link.taken_frames > taken + 1
        assert firmware_answer == answer or (together and unsigned(firmware_answer) == unsigned(answer)), (seed, count)
        assert board.pulses == reference.pulses, (seed, count)
        armed |= board.armed
        hil |= reference.armed and reference.link.hil
    return armed, hil


def test_random_frames_have_the_bytes_of_the_reference(library: ctypes.CDLL) -> None:
    armed, hil = zip(*(compare(library, seed) for seed in range(40)), strict=True)
    assert sum(armed) > 4 and sum(hil) > 0


@pytest.mark.slow
def test_many_random_frames_have_the_bytes_of_the_reference(library: ctypes.CDLL) -> None:
    for seed in range(10_000):
        compare(library, seed)


class BothBoards:
    """The C board and the reference, switched on in air, which measure and hear the same and answer with the same bytes."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self.link, self.reference, self.firmware = AgentLink(1), ThrusterBoard(POOL, 1, 1), FirmwareBoard(library)
        self._sensors = self.reference.sensors = GivenSensors()  # type: ignore[assignment]
        self._now_ns = 0
        self.measure(0.0)

    def say(self, data: bytes) -> None:
        for board in (self.reference, self.firmware):
            board.receive(data, self._now_ns)
        self._step()

    def measure(self, depth_m: float, steps: int = 100) -> None:
        """Have both boards measure this depth, NaN for none, for so many steps."""
        reading = self._sensors.reading
        self._sensors.reading = Reading(reading.heading_rad, reading.yaw_rate_radps, reading.acceleration_mps2, depth_m)
        for _ in range(steps):
            self._step()

    @property
    def last_text(self) -> str:
        return self.link.telemetry.texts[-1][1]

    def _step(self) -> None:
        self._now_ns += 5_000_000
        answer = self.reference.step(self._now_ns, STILL, STILL, STILL)
        assert self.firmware.step(self._now_ns, self._sensors.reading, self._sensors.voltage_v) == answer
        self.link.receive(answer, self._now_ns)


def test_a_depth_zero_is_taken_of_the_pressure_that_is_measured_when_a_person_asks_for_it_or_not_at_all(
    library: ctypes.CDLL,
) -> None:
    boards, deep_m = BothBoards(library), 256.0 / HPA_PER_M
    for before_m in (math.nan, 0.0):  # the sensor measures nothing; it stops while the zero is being taken
        boards.measure(before_m)
        boards.say(boards.link.calibrate(pressure=True))
        assert boards.link.telemetry.acknowledged == (CALIBRATE, REJECTED if math.isnan(before_m) else ACCEPTED)
        boards.measure(math.nan)
        assert boards.last_text == "depth zero not taken: no pressure"
        boards.measure(deep_m)  # it measures again, and the robot is in the water by now
        assert boards.link.telemetry.depth_m == pytest.approx(deep_m, abs=0.01)
    boards.say(boards.link.calibrate(pressure=True))
    boards.measure(deep_m)
    assert boards.link.telemetry.depth_m == pytest.approx(0.0, abs=0.01)
    assert boards.last_text == "depth zero taken"


def test_no_zero_is_taken_or_confirmed_in_hil_mode_nor_after_it(library: ctypes.CDLL) -> None:
    """The depth by which a person would judge it is that of the simulated water."""
    boards, client = BothBoards(library), ParameterClient(1)
    boards.say(client.set("HIL_MODE", 1.0))
    for answers, order in enumerate((boards.link.calibrate(pressure=True), boards.link.calibrate()), start=1):
        boards.say(order)
        assert boards.link.telemetry.acknowledged == (CALIBRATE, REJECTED)
        assert boards.link.telemetry.acknowledgements == answers
        assert boards.last_text == "not calibrated: in HIL mode"
    boards.say(client.set("HIL_MODE", 0.0))
    boards.measure(256.0 / HPA_PER_M)
    assert boards.link.telemetry.depth_m == pytest.approx(256.0 / HPA_PER_M, abs=0.01)


@pytest.mark.parametrize("key", [None, KEY], ids=["unsigned", "signed"])
def test_the_board_passes_the_conformance_run(library: ctypes.CDLL, key: Key | None) -> None:
    board = FirmwareBoard(library, key)
    verdicts = {result.rule: result.verdict for result in results(board, key)}
    assert [rule for rule, verdict in verdicts.items() if verdict is RuleVerdict.FAILED] == []
    skipped = [rule for rule, verdict in verdicts.items() if verdict is RuleVerdict.SKIPPED]
    assert skipped == ([] if key else ["unsigned", "forged", "replayed", "strangers"])
    assert board.state()[3] == 0  # nothing was lost for want of room

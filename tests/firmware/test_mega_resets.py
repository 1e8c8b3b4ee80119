"""Resets of the Arduino Mega in simavr, in air and under water: thrust ends within 0.3 s, zeros survive, orders count once."""

import random
from collections.abc import Callable, Iterator

import pytest

from shoal.mavlink.agent_link import CALIBRATE, REJECTED, AgentLink, Telemetry
from shoal.mavlink.parameters import ParameterClient
from shoal.mavlink.signing import Key
from tests.firmware.mega import CYCLES_PER_US, Mega, Reset
from tests.firmware.pilot import STEP_NS, Pilot

pytestmark = pytest.mark.long

NEUTRAL_US, THRUST_S = 1500.0, 0.3  # of thrust that nobody asked for, at the most
DEPTH_M, BIAS_RADPS = 1.0, 0.05
FIRST_WORD_S = 1.5  # of a board with the stock bootloader, if nothing is sent to it
KEY, NEW_KEY = Key(bytes(range(1, 33))), Key(bytes(range(33, 65)))
AT_REST = 0.6  # of the processor's time, at the most
WRITTEN, BYTE_S = 60, 0.0034  # bytes of a record of settings, each of which takes so long
OLD, NEW = 4000.0, 4321.0  # of the parameter that is set
CUTS, MANY_CUTS, LONGEST_S = 6, 1000, 1.2  # power cuts, and when after an order: a record of settings takes 0.9 s
BROWN_OUTS = 0.3  # of the cuts: the RAM and a byte that is being written outlive them


@pytest.fixture
def mega() -> Iterator[Mega]:
    board = Mega()
    yield board
    board.close()


def settle(mega: Mega, depth_m: float = DEPTH_M) -> Pilot:
    """A board that was switched on in air, at rest with a bias, and is under water and armed by now."""
    pilot = Pilot(mega)
    mega.measure(0.0, BIAS_RADPS)
    pilot.run(2.2)  # 64 rates, and their way into the memory
    mega.measure(depth_m, BIAS_RADPS)
    pilot.run(0.3)
    assert abs(pilot.link.telemetry.depth_m - depth_m) < 0.02 and abs(pilot.link.telemetry.yaw_rate_radps) < 0.01
    return pilot


def restart(mega: Mega, cause: str) -> None:
    """A reset, with what it costs."""
    if cause == "power":
        mega.lose_power()
    elif cause == "watchdog":
        mega.hang(True)
    else:
        mega.reset({"pin": Reset.PIN, "brown-out": Reset.BROWN_OUT}[cause])


def after(mega: Mega) -> Telemetry:
    """Telemetry of the board's new life, as a program that begins to listen sees it."""
    listener = Pilot(mega)
    listener.now_ns = round(mega.now_us * 1000.0)
    listener.run(1.5)
    return listener.link.telemetry


@pytest.mark.parametrize(
    ("cause", "cause_text"),
    [
        ("pin", "reset pin"),
        ("brown-out", "brown-out"),
        ("watchdog", "watchdog"),
        ("power", "power-on"),
    ],
)
def test_a_reset_under_water_stops_the_thrust_keeps_the_zeros_and_is_reported(mega: Mega, cause: str, cause_text: str) -> None:
    pilot = settle(mega)
    pilot.arm()
    pilot.run(0.2, *[1560] * 4)
    mega.pulses()
    begun_us = mega.now_us
    restart(mega, cause)
    pilot.run(0.16, *[1560] * 4)  # the computer goes on as before
    mega.hang(False)
    pilot.run(0.6, *[1560] * 4)
    turning = [pulse for pulses in mega.pulses()[:4] for pulse in pulses if abs(pulse.width_us - NEUTRAL_US) > 1.0]
    assert max((pulse.begin_us + pulse.width_us - begun_us for pulse in turning), default=0.0) < THRUST_S * 1e6
    telemetry = after(mega)
    assert not telemetry.armed and cause_text in telemetry.reset_causes and telemetry.restarted
    assert abs(telemetry.depth_m - DEPTH_M) < 0.02 and abs(telemetry.yaw_rate_radps) < 0.01
    assert telemetry.zero_in_question  # no pressure near that of the surface has come


RESETS = ("pin", "brown-out", "watchdog", "power")
FEW, MANY = 6, 200


@pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.slow)])
def test_thrust_that_nobody_asked_for_ends_in_time_at_a_reset_at_any_instant(mega: Mega, count: int) -> None:
    """Also where the computer goes on asking for thrust: a board that has restarted is disarmed."""
    pilot, draw, longest_us = settle(mega), random.Random(5), 0.0
    for at in range(count):
        pilot.arm()
        pilot.run(draw.uniform(0.1, 0.2), *[draw.choice([1440, 1560])] * 4)
        mega.pulses()
        begun_us, cause = mega.now_us, RESETS[at % len(RESETS)]
        restart(mega, cause)
        pilot.run(0.16, *[1560] * 4)
        mega.hang(False)
        pilot.run(0.5, *[1560] * 4)
        turning = [pulse for pulses in mega.pulses()[:4] for pulse in pulses if abs(pulse.width_us - NEUTRAL_US) > 1.0]
        ends_us = max((pulse.begin_us + pulse.width_us - begun_us for pulse in turning), default=0.0)
        assert ends_us < THRUST_S * 1e6, (at, cause)
        longest_us = max(longest_us, ends_us)
        telemetry = after(mega)
        assert telemetry.restarted and not telemetry.armed, (at, cause)
        pilot = Pilot(mega)
        pilot.now_ns = round(mega.now_us * 1000.0)
    print(f"{count} resets while thrusters turn: thrust ends after {longest_us / 1000.0:.0f} ms at most")


def test_a_power_on_in_air_takes_the_zeros_anew(mega: Mega) -> None:
    settle(mega)
    mega.measure(0.0, 2 * BIAS_RADPS, air_hpa=-8.0)
    mega.lose_power()
    telemetry = after(mega)
    assert not telemetry.restarted and not telemetry.zero_in_question
    assert abs(telemetry.depth_m) < 0.01
    assert abs(after(mega).yaw_rate_radps) < 0.01


def test_a_reset_in_air_is_not_in_question(mega: Mega) -> None:
    settle(mega)
    mega.measure(0.0)
    mega.reset(Reset.PIN)
    telemetry = after(mega)
    assert telemetry.restarted and not telemetry.zero_in_question


def test_a_person_confirms_a_zero_or_has_it_taken_anew(mega: Mega) -> None:
    settle(mega)
    for in_air, depth_m in ((False, DEPTH_M), (True, 0.0)):
        mega.reset(Reset.PIN)
        pilot = Pilot(mega)
        pilot.now_ns = round(mega.now_us * 1000.0)
        pilot.run(1.0)
        assert pilot.link.telemetry.zero_in_question
        pilot.send(pilot.link.calibrate(pressure=in_air))
        pilot.run(1.0)
        assert not pilot.link.telemetry.zero_in_question and pilot.link.telemetry.restarted
        assert abs(pilot.link.telemetry.depth_m - depth_m) < 0.02


def test_a_person_has_the_gyros_bias_taken_anew_at_rest_while_disarmed(mega: Mega) -> None:
    pilot = settle(mega)
    pilot.arm()
    pilot.send(pilot.link.calibrate(gyro=True))
    pilot.run(0.1, *[1500] * 4)
    assert pilot.link.telemetry.acknowledged == (CALIBRATE, REJECTED)
    pilot.run(0.4)  # silent: disarmed
    mega.measure(DEPTH_M, 3 * BIAS_RADPS)
    pilot.send(pilot.link.calibrate(gyro=True))
    pilot.run(0.6)
    mega.measure(DEPTH_M, 5 * BIAS_RADPS)  # it was moved: the mean begins anew
    pilot.run(1.5)
    assert abs(pilot.link.telemetry.yaw_rate_radps) < 0.01
    pilot.run(0.3)
    mega.reset(Reset.PIN)
    assert abs(after(mega).yaw_rate_radps) < 0.01


def test_a_board_switched_on_under_water_for_the_first_time_reports_no_depth(mega: Mega) -> None:
    mega.measure(DEPTH_M)
    pilot = Pilot(mega)
    pilot.run(1.5)
    telemetry = pilot.link.telemetry
    assert telemetry.board_ms == -1 and telemetry.heartbeats  # no burst is complete without a depth
    assert telemetry.zero_in_question and telemetry.restarted
    pilot.send(pilot.link.calibrate())
    pilot.run(0.2)
    assert pilot.link.telemetry.acknowledged == (CALIBRATE, REJECTED)  # there is none to confirm


def test_a_board_whose_settings_cannot_be_read_takes_no_frame(mega: Mega) -> None:
    memory = bytearray(mega.eeprom)
    memory[10] = memory[300] = 0x12  # in two of the places of settings
    mega.eeprom = bytes(memory)
    mega.lose_power()
    pilot = Pilot(mega)
    pilot.now_ns = round(mega.now_us * 1000.0)
    pilot.run(0.5, *[1500] * 4)
    pilot.send(pilot.link.arm(True))
    pilot.run(0.3, *[1500] * 4)
    telemetry = pilot.link.telemetry
    assert telemetry.acknowledgements == 0 and not telemetry.armed
    assert "settings cannot be read: takes nothing" in [text for _, text in telemetry.texts]


def test_the_stock_bootloader_starts_the_firmware_only_while_nothing_is_sent(mega: Mega) -> None:
    """After a reset by DTR, too. A computer that goes on sending holds the bootloader: so it must not (board_port.py)."""
    settle(mega)
    mega.load_bootloader()
    mega.reset(Reset.PIN)
    other = Pilot(mega)
    other.now_ns = round(mega.now_us * 1000.0)
    other.run(FIRST_WORD_S)
    assert other.link.telemetry.heartbeats and other.link.telemetry.reset_causes == ()  # the bootloader has cleared MCUSR
    assert other.link.telemetry.restarted and abs(other.link.telemetry.depth_m - DEPTH_M) < 0.02
    mega.reset(Reset.PIN)
    sending = Pilot(mega)
    sending.now_ns = round(mega.now_us * 1000.0)
    sending.run(3.0, *[1500] * 4)
    assert mega.is_in_bootloader and not sending.link.telemetry.heartbeats


def test_bytes_of_a_record_follow_one_another_as_fast_as_the_memory_takes_them(mega: Mega) -> None:
    """Not with each step: an order waits for them. A board that writes nothing sleeps."""
    pilot = settle(mega)
    mega.loop_cycles()
    pilot.run(0.5)
    assert mega.loop_cycles()[1] < AT_REST * 0.5e6 * CYCLES_PER_US
    before = mega.eeprom_counts()[0]
    pilot.send(ParameterClient(1).set("SLEW_US_S", NEW))
    pilot.run(WRITTEN * BYTE_S * 1.2)
    assert mega.eeprom_counts()[0] - before >= WRITTEN


class CutBoard:
    """A signed board whose power fails at any instant, and its computer, which remembers what it has sent."""

    def __init__(self) -> None:
        self.mega = Mega()
        pilot = Pilot(self.mega)
        pilot.run(1.0)
        pilot.send(ParameterClient(1).set("SLEW_US_S", OLD))
        pilot.run(2.5)
        pilot.send(ParameterClient(1).give(KEY, 500))
        pilot.run(2.5)
        self._keyed = self.mega.eeprom
        self.phases_us: set[int] = set()  # of the cuts, in a step of the computer's

    def cut(self, draw: random.Random) -> tuple[bool, bool, float, list[Key]]:
        """Orders, a loss of power at a random instant, and all that was sent once more. Returns whether the board was armed
        before, and after, the parameter's value, and the keys with which the board answers."""
        mega, stamp = self.mega, 100_000
        mega.lose_power()
        mega.eeprom = self._keyed
        mega.reset(Reset.POWER_ON)
        begun_us = mega.now_us
        pilot, client = Pilot(mega, KEY), ParameterClient(1, KEY, lambda: stamp)
        pilot.now_ns = round(mega.now_us * 1000.0)
        pilot.run(0.4)
        sent: list[bytes] = []

        def say(frame: bytes) -> None:
            sent.append(frame)
            pilot.send(frame)

        orders: list[Callable[[], bytes]] = [
            lambda: client.set("SLEW_US_S", NEW),
            lambda: pilot.link.arm(True),
            pilot.link.calibrate,
            lambda: client.give(NEW_KEY, stamp),
        ]
        order = draw.choice(orders)
        cut_s = draw.uniform(0.0, LONGEST_S)
        for count in range(round(cut_s * 1e9) // STEP_NS + 1):
            if count % 10 == 0:
                say(pilot.link.pulses([1500] * 8))
            if count == 5:
                say(order())
            pilot.step()
        pilot.run(draw.uniform(0.0, STEP_NS * 1e-9))
        self.phases_us.add(round(mega.now_us - begun_us) % (STEP_NS // 1000))
        armed = pilot.link.telemetry.armed
        if draw.random() < BROWN_OUTS:
            mega.reset(Reset.BROWN_OUT)
        else:
            mega.lose_power(torn=draw.choice([0xFF, 0x00, draw.randrange(256)]))
        listener = AgentLink(1, KEY, lambda: 1)
        for frame in sent:  # somebody who has recorded it
            mega.receive(frame, 0)
            for _ in range(5):
                pilot.now_ns += STEP_NS
                listener.receive(mega.step(pilot.now_ns), pilot.now_ns)
        armed_again = listener.telemetry.armed
        return armed, armed_again, *self._kept(pilot)

    def _kept(self, pilot: Pilot) -> tuple[float, list[Key]]:
        """The parameter's value, and the keys with which the board answers."""
        values = dict[Key, float]()
        for key in (KEY, NEW_KEY):
            client = ParameterClient(1, key, lambda: 10_000_000)
            for _ in range(40):
                self.mega.receive(client.ask("SLEW_US_S"), 0)
                for _ in range(4):
                    pilot.now_ns += STEP_NS
                    client.receive(self.mega.step(pilot.now_ns), pilot.now_ns)
                if "SLEW_US_S" in client.values:
                    values[key] = client.values["SLEW_US_S"]
                    break
                if values:
                    break
        return next(iter(values.values())), list(values)


def cut_often(count: int) -> None:
    board, draw, armed, changed_keys = CutBoard(), random.Random(4), 0, 0
    for at in range(count):
        before, again, value, keys = board.cut(draw)
        assert not (before and again), at
        assert value in (OLD, NEW), at
        assert len(keys) == 1, at
        armed, changed_keys = armed + before, changed_keys + (keys == [NEW_KEY])
    assert armed > count // 20  # some orders had come through
    assert count <= CUTS or changed_keys > count // 100  # another key takes most of the time to the last cuts
    assert len(board.phases_us) > count // 2
    assert board.mega.eeprom_counts()[1] == 0  # none of its bytes was touched while one was being written
    board.mega.close()


def test_no_order_counts_twice_and_no_setting_is_torn_wherever_the_power_fails() -> None:
    cut_often(CUTS)


@pytest.mark.slow
def test_no_order_counts_twice_at_a_thousand_power_cuts() -> None:
    cut_often(MANY_CUTS)

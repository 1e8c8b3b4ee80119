"""The Mega sends nothing untrue and keeps its rules while sensors in simavr are absent, asleep, stuck, late or wrong.

Also while they lose their supply or hold the bus; and a sensor that is whole again measures again.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import pytest
from pymavlink.dialects.v20 import common as dialect

from shoal.mavlink.agent_link import hpa_to_depth
from tests.firmware.mega import CYCLES_PER_US, IMU, PRESSURE, ChipFault, Mega, Reset
from tests.firmware.pilot import Pilot

pytestmark = pytest.mark.long
SLOW = pytest.mark.slow

STEP_US, STOPS_US, NEUTRAL_US = 5000.0, 260_000.0, 1500.0
BROKEN_S, RETRY_S = 1.0, 1.3  # a sensor that is not live is looked at once a second
BURSTS_HZ = 50
DEPTH_M, RATE_RADPS, FORCE_MG = 1.0, 0.5, 5.0
STUCK_S = 0.55  # 25 samples of the same value, and the way of a burst


@dataclass(frozen=True)
class SensorTrouble:
    """Something that happens to a chip, the end of it, and how the board names it."""

    chip: int
    begin: Callable[[Mega], None]
    end: Callable[[Mega], None]
    text: str  # empty: it is over before the board has to say anything
    noticed_s: float = 0.1  # the latest at which nothing is sent any longer


def fault(chip: int, which: ChipFault, text: str, noticed_s: float = 0.1) -> SensorTrouble:
    return SensorTrouble(chip, lambda m: m.fault(chip, which), lambda m: m.fault(chip, which, False), text, noticed_s)


def supply(chip: int) -> SensorTrouble:
    """A supply that fails, and comes back later."""

    def back(mega: Mega) -> None:
        mega.power_chip(chip)
        mega.fault(chip, ChipFault.ABSENT, False)

    return SensorTrouble(chip, lambda m: m.fault(chip, ChipFault.ABSENT), back, "absent")


def rebooted(chip: int) -> SensorTrouble:
    """Another part in its place: looked at when the supply has failed for a moment."""

    def begin(mega: Mega) -> None:
        mega.fault(chip, ChipFault.WRONG)
        mega.power_chip(chip)

    return SensorTrouble(chip, begin, lambda m: m.fault(chip, ChipFault.WRONG, False), "absent")


TROUBLES = {
    "IMU absent": fault(IMU, ChipFault.ABSENT, "absent"),
    "IMU asleep": fault(IMU, ChipFault.ASLEEP, "asleep"),
    "IMU stuck": fault(IMU, ChipFault.FROZEN, "stuck", STUCK_S),
    "IMU of another kind": rebooted(IMU),
    "IMU late": fault(IMU, ChipFault.LATE, "absent"),
    "IMU without supply": supply(IMU),
    "pressure absent": fault(PRESSURE, ChipFault.ABSENT, "absent"),
    "pressure asleep": fault(PRESSURE, ChipFault.ASLEEP, "reset"),
    "pressure stuck": fault(PRESSURE, ChipFault.FROZEN, "stuck", STUCK_S),
    "pressure with a damaged PROM": rebooted(PRESSURE),
    "pressure late": fault(PRESSURE, ChipFault.LATE, "reset"),
    "pressure without supply": supply(PRESSURE),
}
QUICK = ("IMU asleep", "IMU stuck", "pressure late", "pressure with a damaged PROM")  # the others are slow tests
ALL = [pytest.param(name, marks=() if name in QUICK else SLOW) for name in TROUBLES]
CHIP_NAMES = {IMU: "IMU", PRESSURE: "pressure"}


@pytest.fixture
def mega() -> Iterator[Mega]:
    board = Mega()
    board.measure()
    yield board
    board.close()


class Listener(Pilot):
    """A computer at a board that remembers when each sensor was last measured, and what was measured that is not true."""

    def __init__(self, mega: Mega) -> None:
        super().__init__(mega)
        self.now_ns = round(mega.now_us * 1000.0)
        self.heard_s = {IMU: -math.inf, PRESSURE: -math.inf}
        self.unmeasured = {IMU: 0, PRESSURE: 0}  # bursts that say so: by NaN
        self.untrue: list[dialect.MAVLink_message] = []
        self._parser = dialect.MAVLink(None)
        self._parser.robust_parsing = True  # a reset cuts off a frame

    @property
    def now_s(self) -> float:
        return self.now_ns * 1e-9

    def take(self, data: bytes) -> None:
        super().take(data)
        for message in self._parser.parse_buffer(data) or []:
            kind = message.get_type()
            if kind == "SCALED_PRESSURE2" and math.isfinite(message.press_abs):
                self.note(PRESSURE, abs(hpa_to_depth(message.press_abs) - DEPTH_M) < 0.02, message)
            elif kind == "SCALED_IMU":
                level = math.dist((message.xacc, message.yacc, message.zacc), (0.0, 0.0, -1000.0)) < FORCE_MG
                self.note(IMU, level and abs(message.zgyro * 1e-3 - RATE_RADPS) < 0.02, message)
            elif kind == "ATTITUDE" and not math.isnan(message.yaw + message.yawspeed):
                self.note(IMU, abs(message.yawspeed - RATE_RADPS) < 0.02, message)
            elif kind in ("ATTITUDE", "SCALED_PRESSURE2"):
                self.unmeasured[IMU if kind == "ATTITUDE" else PRESSURE] += 1

    def note(self, chip: int, is_true: bool, message: dialect.MAVLink_message) -> None:
        self.heard_s[chip] = self.now_s
        if not is_true:
            self.untrue.append(message)


def under_way(mega: Mega) -> Listener:
    """A board that was switched on in air, is under water, armed, and has thrust."""
    pilot = Listener(mega)
    pilot.run(0.5)
    mega.measure(DEPTH_M, RATE_RADPS)
    pilot.arm()
    pilot.run(0.2, *[1560] * 4)
    pilot.untrue.clear()  # on the way there
    return pilot


def require_bounds(pilot: Listener, mega: Mega) -> None:
    """Silence ends the thrust in time, and no loop is longer than a step."""
    mega.pulses()
    pilot.send(pilot.link.pulses([1560] * 8))
    last_us = mega.now_us + 1500.0
    pilot.run(0.4)
    turning = [pulse for pulses in mega.pulses()[:4] for pulse in pulses if abs(pulse.width_us - NEUTRAL_US) > 1.0]
    assert max(pulse.begin_us + pulse.width_us for pulse in turning) - last_us < STOPS_US
    assert not pilot.link.telemetry.armed
    assert mega.loop_cycles()[0] / CYCLES_PER_US <= STEP_US


@pytest.mark.parametrize("name", ALL)
def test_a_sensor_in_trouble_is_silent_and_named_while_the_rules_hold_and_measures_again_when_whole(
    mega: Mega, name: str
) -> None:
    trouble = TROUBLES[name]
    pilot, other = under_way(mega), PRESSURE if trouble.chip == IMU else IMU
    begun_s = pilot.now_s
    pilot.unmeasured = {IMU: 0, PRESSURE: 0}
    trouble.begin(mega)
    mega.loop_cycles()
    pilot.run(BROKEN_S, *[1560] * 4)
    texts = [text for _, text in pilot.link.telemetry.texts]
    assert f"{CHIP_NAMES[trouble.chip]}: {trouble.text}" in texts
    assert len(texts) < 8  # a state that lasts is not said again and again
    assert pilot.heard_s[trouble.chip] - begun_s < trouble.noticed_s
    assert pilot.unmeasured[trouble.chip] >= BURSTS_HZ * (BROKEN_S - trouble.noticed_s) - 2 and pilot.unmeasured[other] == 0
    assert pilot.link.telemetry.armed and pilot.link.telemetry.echo_us[:4] == (1560,) * 4  # the board needs no sensor
    assert not any(CHIP_NAMES[other] in text for text in texts) and pilot.now_s - pilot.heard_s[other] < 0.1
    require_bounds(pilot, mega)
    trouble.end(mega)
    pilot.run(RETRY_S)
    assert pilot.now_s - min(pilot.heard_s.values()) < 0.1
    assert f"{CHIP_NAMES[trouble.chip]}: live" in [text for _, text in pilot.link.telemetry.texts]
    assert pilot.untrue == []


@pytest.mark.parametrize("depth_m", [-9.0, 400.0])
def test_a_pressure_that_the_sensor_cannot_measure_is_nan(mega: Mega, depth_m: float) -> None:
    """Less than its 300 hPa, more than its 30 bar."""
    pilot = under_way(mega)
    mega.measure(depth_m, RATE_RADPS)
    pilot.run(0.1)
    pilot.unmeasured = {IMU: 0, PRESSURE: 0}
    pilot.run(BROKEN_S)
    assert pilot.unmeasured[PRESSURE] >= BURSTS_HZ * BROKEN_S - 2 and pilot.unmeasured[IMU] == 0 and pilot.untrue == []
    mega.measure(DEPTH_M, RATE_RADPS)
    pilot.run(RETRY_S)
    assert pilot.now_s - pilot.heard_s[PRESSURE] < 0.1 and pilot.untrue == []


def test_a_read_that_fails_once_is_made_again_at_once(mega: Mega) -> None:
    pilot = under_way(mega)
    texts, pilot.unmeasured = len(pilot.link.telemetry.texts), {IMU: 0, PRESSURE: 0}
    for _ in range(10):
        mega.hold_bus(after_bytes=3, clocks=5)
        pilot.run(0.05, *[1560] * 4)
    assert pilot.unmeasured == {IMU: 0, PRESSURE: 0} and pilot.untrue == []
    assert len(pilot.link.telemetry.texts) == texts


HELD = {"a moment": (5, ()), "until a reset": (5, (Reset.WATCHDOG,)), "beyond nine clocks": (40, ())}


@pytest.mark.parametrize("how", [pytest.param(name, marks=() if name == "until a reset" else SLOW) for name in HELD])
def test_a_chip_that_holds_the_bus_is_clocked_until_it_lets_go(mega: Mega, how: str) -> None:
    """A read that is cut off leaves the chip in the middle of a byte: it pulls SDA low until it has seen the other clocks."""
    clocks, resets = HELD[how]
    pilot = under_way(mega)
    mega.hold_bus(after_bytes=3, clocks=clocks)
    for causes in resets:
        pilot.run(0.02)
        mega.reset(causes)
    mega.loop_cycles()
    pilot.run(0.4, *[1500] * 4)
    assert mega.loop_cycles()[0] / CYCLES_PER_US <= STEP_US
    pilot.run(1.2)
    assert pilot.now_s - min(pilot.heard_s.values()) < 0.1 and pilot.untrue == []


@SLOW
def test_a_bus_that_is_held_for_ever_costs_no_rule_its_bounds(mega: Mega) -> None:
    pilot = under_way(mega)
    mega.hold_bus(after_bytes=3, clocks=1 << 30)
    mega.loop_cycles()
    pilot.run(1.2, *[1560] * 4)
    assert pilot.now_s - max(pilot.heard_s.values()) > 1.0 and pilot.link.telemetry.armed
    assert {text for _, text in pilot.link.telemetry.texts} >= {"IMU: absent", "pressure: absent"}
    require_bounds(pilot, mega)
    mega.free_bus()
    pilot.run(RETRY_S)
    assert pilot.now_s - min(pilot.heard_s.values()) < 0.1 and pilot.untrue == []


@pytest.mark.parametrize("chip", [IMU, pytest.param(PRESSURE, marks=SLOW)], ids=["IMU", "pressure"])
def test_a_supply_that_fails_for_a_moment_is_seen_and_nothing_untrue_is_sent(mega: Mega, chip: int) -> None:
    """The chip answers, asleep or without its settings: at each phase of a sample."""
    pilot = under_way(mega)
    for phase in range(8):
        pilot.run(0.3, *[1560] * 4)
        pilot.now_ns += phase * 2_500_000  # of the 20 ms between two samples
        pilot.step()
        mega.power_chip(chip)
        pilot.run(0.3, *[1560] * 4)
        assert pilot.now_s - pilot.heard_s[chip] < 0.1 and pilot.untrue == [], phase
    assert f"{CHIP_NAMES[chip]}: live" in [text for _, text in pilot.link.telemetry.texts]


@SLOW
def test_no_part_of_a_sample_of_the_imu_is_from_after_a_failure_of_its_supply(mega: Mega) -> None:
    """At 400 instants of the 20 ms between two samples, the reading of one among them."""
    pilot = under_way(mega)
    for instant_us in range(0, 20_000, 50):
        pilot.run(0.25)
        pilot.step(5_000_000 + instant_us * 1000)
        mega.power_chip(IMU)
        pilot.run(0.3)
        assert pilot.untrue == [], instant_us


@SLOW
@pytest.mark.parametrize("register", [0x6B, 0x1B, 0x1C], ids=["power", "gyro's range", "accelerometer's range"])
def test_a_setting_of_the_imu_that_changes_by_itself_is_written_again(mega: Mega, register: int) -> None:
    pilot = under_way(mega)
    mega.glitch(register, 0x40 if register == 0x6B else 0)
    pilot.run(2.0)
    assert pilot.now_s - pilot.heard_s[IMU] < 0.1
    pilot.untrue.clear()  # a range is looked at once a second
    pilot.run(1.0)
    assert pilot.untrue == []


@SLOW
@pytest.mark.parametrize("chip", [IMU, PRESSURE], ids=["IMU", "pressure"])
def test_a_chip_that_is_not_there_at_power_on_measures_once_it_is(mega: Mega, chip: int) -> None:
    mega.fault(chip, ChipFault.ABSENT)
    mega.lose_power()
    pilot = Listener(mega)
    pilot.run(2.0)
    assert pilot.heard_s[chip] == -math.inf
    mega.power_chip(chip)
    mega.fault(chip, ChipFault.ABSENT, False)
    pilot.run(RETRY_S)
    assert pilot.now_s - pilot.heard_s[chip] < 0.1

"""The Arduino Mega's firmware in simavr: its pins, its memory, its cycles. Times are the processor's own."""

from collections.abc import Iterator
from itertools import pairwise

import pytest

from shoal.mavlink.agent_link import IGNORED, AgentLink
from shoal.mavlink.parameters import ParameterClient
from shoal.mavlink.signing import Key
from sim_bridge.thruster_board.simulator_link import SimulatorLink
from tests.firmware.bench import first_failure
from tests.firmware.mega import CYCLES_PER_US, Mega, Pulse
from tests.firmware.pilot import STEP_NS, Pilot

pytestmark = [pytest.mark.slow, pytest.mark.long]

NEUTRAL_US, AGE_US, STEP_US, PERIOD_US = 1500.0, 250_000.0, 5000.0, 20_000.0
PHASES, BYTE_US, STOPS_US = 200, 40.0, 260_000.0  # a byte at 250,000 baud
KEY, OTHER = Key(bytes(range(1, 33))), Key(bytes(range(2, 34)))
WAITING = 9  # frames in the ring and the inbox, before an override
FLOOD_PHASES, BATTERY_S, LOOKS_US, EMPTY = 12, 1.2, 28_000.0, 4  # looks: each 20 ms, known to a step and a loop
FIRST_KEPT_S = 2.5  # a board's first settings are written twice, 256 bytes of 3.4 ms each
RAM_BYTES, STATIC_AND_STACK, WORST_LOOP = 8192, 0.6, 0.5
BURSTS, BURSTS_SIGNED_IN_HIL = 98, 75  # of 100 in 2 s; a signed link in HIL mode is more than the processor can hash


@pytest.fixture
def mega() -> Iterator[Mega]:
    board = Mega()
    yield board
    board.close()


@pytest.fixture
def signed(mega: Mega) -> Iterator[Mega]:
    """A board that was given a key, after a loss of power."""
    pilot = Pilot(mega)
    pilot.run(0.3)
    pilot.send(ParameterClient(1).give(KEY, 500))
    pilot.run(FIRST_KEPT_S)
    board = Mega(mega.eeprom)
    yield board
    board.close()


def steady(pulses: list[Pulse], width_us: float) -> None:
    """Width within 1 us, period and jitter of both edges."""
    assert len(pulses) > 3
    for before, after in pairwise(pulses):
        assert abs(after.begin_us - before.begin_us - PERIOD_US) < 1.0
        assert abs(after.begin_us + after.width_us - before.begin_us - before.width_us - PERIOD_US) < 1.0
    assert max(abs(pulse.width_us - width_us) for pulse in pulses) < 1.0


def test_pulses_at_the_pins_are_those_of_the_override(mega: Mega) -> None:
    pilot, thrusters = Pilot(mega), (1440, 1501, 1560, 1900)
    pilot.run(0.3)
    pilot.arm()
    pilot.run(0.3, *thrusters, ankle_us=1777)
    mega.pulses()  # on the way there
    pilot.run(0.2, *thrusters, ankle_us=1777)
    for pulses, width_us in zip(mega.pulses(), (*thrusters, *[1777] * 4), strict=True):
        steady(pulses, width_us)
    assert pilot.link.telemetry.bad_frames == 0


def delay(phase: int) -> tuple[float, bytes]:
    """Seconds and bytes before one of PHASES, evenly over a period of the pulses. No byte is a start byte."""
    steps, rest_us = divmod(phase * PERIOD_US / PHASES, STEP_US)
    return steps * STEP_US * 1e-6, bytes(int(rest_us / BYTE_US))


def test_a_new_pulse_begins_within_a_step_and_a_period_of_the_override_at_any_phase(mega: Mega) -> None:
    pilot, delays_us = Pilot(mega), []
    pilot.run(0.3)
    pilot.arm()
    for phase in range(PHASES):
        ankle_us = 1300 + phase
        wait_s, before = delay(phase)
        pilot.run(0.1 + wait_s, *[1500] * 4)
        mega.pulses()
        pilot.send(data := before + pilot.link.pulses([1500] * 4 + [ankle_us] * 4))
        last_us = mega.now_us + len(data) * BYTE_US
        pilot.run(0.06)
        new = [pulse for pulse in mega.pulses()[4] if abs(pulse.width_us - ankle_us) < 0.5]
        delays_us.append(new[0].begin_us - last_us)
    print(f"override to pulse, {PHASES}: {min(delays_us) * CYCLES_PER_US:.0f} to {max(delays_us) * CYCLES_PER_US:.0f} cycles")
    assert min(delays_us) > 0.0 and max(delays_us) <= STEP_US + PERIOD_US


def test_pins_rest_in_hil_mode_while_the_echo_follows(mega: Mega) -> None:
    pilot, client, simulator = Pilot(mega), ParameterClient(1), SimulatorLink(1)
    pilot.run(0.3)
    pilot.send(client.set("HIL_MODE", 1.0))
    pilot.run(0.1)
    pilot.arm()
    mega.loop_cycles()
    mega.pulses()
    for _ in range(10):
        pilot.send(simulator.motion(0, 2.0, -0.5, (1.0, -2.0, -9.0), 3.0))
        pilot.run(0.02, *[1560] * 4, ankle_us=1777)
    for pulses in mega.pulses():
        steady(pulses, NEUTRAL_US)
    telemetry = pilot.link.telemetry
    assert telemetry.hil and telemetry.armed and telemetry.echo_us == (*[1560] * 4, *[1777] * 4)
    assert abs(telemetry.heading_rad - 2.0) < 1e-3 and abs(telemetry.depth_m - 3.0) < 0.01
    assert mega.loop_cycles()[0] / CYCLES_PER_US <= STEP_US


def test_pins_are_neutral_after_silence_at_any_phase(mega: Mega) -> None:
    pilot, stops_us = Pilot(mega), []
    pilot.run(0.3)
    for phase in range(PHASES):
        pilot.arm()
        wait_s, before = delay(phase)
        pilot.run(0.1 + wait_s, 1560, 1560, 1560, 1560)
        mega.pulses()
        pilot.send(data := before + pilot.link.pulses([1560] * 4 + [IGNORED] * 4))
        last_us = mega.now_us + len(data) * BYTE_US
        pilot.run(0.35)
        turning = [pulse for pulses in mega.pulses()[:4] for pulse in pulses if abs(pulse.width_us - NEUTRAL_US) > 1.0]
        stops_us.append(max(pulse.begin_us + pulse.width_us for pulse in turning) - last_us)
        assert max(pulse.begin_us for pulse in turning) <= last_us + AGE_US + STEP_US
        assert not pilot.link.telemetry.armed
    print(
        f"override to the end of the last pulse that is not neutral, {PHASES}: {min(stops_us):.0f} to {max(stops_us):.0f} us"
    )
    assert min(stops_us) > AGE_US - PERIOD_US and max(stops_us) <= STOPS_US


@pytest.mark.parametrize("by_watchdog", [False, True], ids=["brown-out", "hang"])
def test_a_reset_while_thrusters_turn_leaves_neutral_and_disarmed(mega: Mega, by_watchdog: bool) -> None:
    pilot = Pilot(mega)
    pilot.run(0.3)
    pilot.arm()
    pilot.run(0.2, 1560, 1560, 1560, 1560)
    mega.pulses()
    begun_us = mega.now_us
    if by_watchdog:
        mega.hang(True)
        pilot.run(0.16)  # the watchdog bites after 0.12 s; until then the timers go on with the last pulses
        mega.hang(False)
        pilot.run(0.4, 1560, 1560, 1560, 1560)
        begun_us += 160_000.0
    else:
        mega.reset()
        pilot.run(0.5, 1560, 1560, 1560, 1560)
    after = [pulse for pulses in mega.pulses()[:4] for pulse in pulses if pulse.begin_us > begun_us]
    assert len(after) > 20 and all(abs(pulse.width_us - NEUTRAL_US) < 1.0 for pulse in after)
    assert not pilot.link.telemetry.armed


def test_parameters_and_key_survive_a_loss_of_power(mega: Mega) -> None:
    client, pilot = ParameterClient(1), Pilot(mega)
    pilot.run(0.3)
    pilot.send(client.set("SLEW_US_S", 4321.0))
    pilot.run(FIRST_KEPT_S)
    pilot.send(client.give(KEY, 50_000))
    pilot.run(FIRST_KEPT_S)
    again = Mega(mega.eeprom)
    owner, signed = ParameterClient(1, KEY, lambda: 100_000), Pilot(again, KEY)
    signed.run(0.3)
    signed.send(client.set("SLEW_US_S", 1.0))  # not signed: not heard
    signed.send(owner.ask("SLEW_US_S"))
    for _ in range(60):
        now_ns = round(again.now_us * 1000.0) + STEP_NS
        owner.receive(again.step(now_ns), now_ns)
    again.close()
    assert owner.values["SLEW_US_S"] == 4321.0


def fly(pilot: Pilot, simulator: SimulatorLink | None, question: bytes = b"") -> tuple[float, float]:
    """Fly for 2 s, in HIL mode with measurements of a simulator. `question` is sent first. Returns the worst loop, us,
    and the load."""
    pilot.mega.loop_cycles()
    pilot.send(question)
    for count in range(400):
        if count % 10 == 0:
            pilot.send(pilot.link.pulses([1560, 1560, 1500, 1500, *[IGNORED] * 4]))
        if count % 200 == 7:
            pilot.send(pilot.link.timesync(count * STEP_NS) + pilot.link.heartbeat())
        if simulator is not None and count % 4 == 1:
            pilot.send(simulator.motion(0, 2.0, -0.5, (1.0, -2.0, -9.0), 3.0))
        if simulator is not None and count % 100 == 3:
            pilot.send(simulator.battery(12.0))
        pilot.step()
    worst, total = pilot.mega.loop_cycles()
    return worst / CYCLES_PER_US, total / (2e6 * CYCLES_PER_US)


@pytest.mark.parametrize("hil", [False, True], ids=["", "HIL mode"])
@pytest.mark.parametrize("key", [None, KEY], ids=["unsigned", "signed"])
def test_stack_and_loop_are_within_their_budgets(request: pytest.FixtureRequest, key: Key | None, hil: bool) -> None:
    mega: Mega = request.getfixturevalue("mega" if key is None else "signed")
    pilot, client = Pilot(mega, key), ParameterClient(1, key, lambda: 100_000)
    pilot.run(0.5)
    if hil:
        pilot.send(client.set("HIL_MODE", 1.0))
        pilot.run(0.5)
    pilot.arm()
    simulator = SimulatorLink(1, key, lambda: 100_000) if hil else None
    worst_us, _ = fly(pilot, simulator, client.ask_all())
    pilot.bursts.clear()
    _, load = fly(pilot, simulator)
    print(f"worst loop {worst_us:.0f} us, load {load:.2f}, {len(pilot.bursts)} bursts in 2 s")
    print(f"static {mega.static_bytes} bytes, stack {mega.stack_bytes} bytes")
    assert pilot.link.telemetry.armed and pilot.link.telemetry.hil is hil
    assert mega.static_bytes + mega.stack_bytes <= STATIC_AND_STACK * RAM_BYTES
    assert worst_us <= WORST_LOOP * STEP_US
    assert len(pilot.bursts) >= (BURSTS_SIGNED_IN_HIL if key and hil else BURSTS), "of 100"


@pytest.mark.parametrize("key", [None, KEY], ids=["unsigned", "signed"])
def test_the_mega_passes_the_conformance_run(request: pytest.FixtureRequest, key: Key | None) -> None:
    assert first_failure(request.getfixturevalue("mega" if key is None else "signed"), key) is None


def flood(key: Key | None) -> bytes:
    """Frames of a stranger, on a signed link by another key, that fill the line for half a second."""
    if key is None:
        stranger = ParameterClient(1)
        frames = [stranger.ask("SLEW_US_S") + stranger.heartbeat() for _ in range(300)]
    else:
        other = AgentLink(1, OTHER, lambda: 200_000)
        frames = [other.pulses([1560] * 8) for _ in range(300)]
    return b"".join(frames)[: round(0.5e6 / BYTE_US)]


@pytest.mark.parametrize("key", [None, KEY], ids=["unsigned", "signed"])
def test_pins_are_neutral_after_silence_behind_a_flood_at_line_rate(request: pytest.FixtureRequest, key: Key | None) -> None:
    mega: Mega = request.getfixturevalue("mega" if key is None else "signed")
    pilot, stops_us = Pilot(mega, key), []
    pilot.run(0.6)
    for phase in range(FLOOD_PHASES):
        pilot.arm()
        wait_s, before = delay(phase * PHASES // FLOOD_PHASES)
        pilot.run(0.1 + wait_s, 1560, 1560, 1560, 1560)
        mega.pulses()
        pilot.send(data := before + pilot.link.pulses([1560] * 4 + [IGNORED] * 4))
        last_us = mega.now_us + len(data) * BYTE_US
        pilot.send(flood(key))
        pilot.run(0.6)
        turning = [pulse for pulses in mega.pulses()[:4] for pulse in pulses if abs(pulse.width_us - NEUTRAL_US) > 1.0]
        stops_us.append(max(pulse.begin_us + pulse.width_us for pulse in turning) - last_us)
        pilot.run(0.6)  # PEER_SILENCE_US, and what is queued
        assert not pilot.link.telemetry.armed
        assert all(1499.0 < pulse.width_us < 1561.0 for pulse in turning), phase
    print(
        f"last override to the end of the last pulse, flooded, {FLOOD_PHASES}: {min(stops_us):.0f} to {max(stops_us):.0f} us"
    )
    assert max(stops_us) <= STOPS_US


def test_an_override_behind_frames_that_are_being_verified_counts_from_its_arrival(signed: Mega) -> None:
    """Each of these takes the processor 3 ms, and the line 2 ms."""
    pilot, client, stops_us = Pilot(signed, KEY), ParameterClient(1, KEY, lambda: 100_000), []
    pilot.run(0.6)
    for phase in range(FLOOD_PHASES):
        pilot.arm()
        pilot.run(0.1 + delay(phase * PHASES // FLOOD_PHASES)[0], *[1560] * 4)
        signed.pulses()
        pilot.send(data := b"".join(client.ask("SLEW_US_S") for _ in range(WAITING)) + pilot.link.pulses([1560] * 8))
        last_us = signed.now_us + len(data) * BYTE_US
        pilot.run(0.6)
        turning = [pulse for pulses in signed.pulses()[:4] for pulse in pulses if abs(pulse.width_us - NEUTRAL_US) > 1.0]
        stops_us.append(max(pulse.begin_us + pulse.width_us for pulse in turning) - last_us)
        assert min(stops_us) > AGE_US - 2 * PERIOD_US, "it was taken"
    print(f"override behind {WAITING} frames to the end of the last pulse: {min(stops_us):.0f} to {max(stops_us):.0f} us")
    assert max(stops_us) <= AGE_US + 2 * STEP_US + 1560.0  # known to a step, looked at in each, and a pulse that has begun


@pytest.mark.parametrize("key", [None, KEY], ids=["unsigned", "signed"])
def test_the_battery_is_looked_after_every_20_ms_under_a_flood_at_line_rate(
    request: pytest.FixtureRequest, key: Key | None
) -> None:
    """An empty one disarms. Of a signed flood the board verifies only a part: then silence may be quicker."""
    mega: Mega = request.getfixturevalue("mega" if key is None else "signed")
    pilot, empty_v = Pilot(mega, key), 7.5
    pilot.run(0.6)
    pilot.arm()
    mega.charge(empty_v)
    mega.watch("rules_battery")
    begun_us, frames = mega.now_us, flood(key)
    while mega.now_us - begun_us < BATTERY_S * 1e6:
        at = round(mega.now_us - begun_us) // 40_000 % 10 * 1000
        pilot.send(pilot.link.pulses([1560] * 4 + [IGNORED] * 4) + frames[at : at + 960])  # 40 ms of the line
        for _ in range(8):
            pilot.step()
    calls, longest_us = mega.calls()
    pilot.run(1.2)  # of a signed link's queue, and the way of a report
    texts = [text for _, text in pilot.link.telemetry.texts]
    print(f"battery rule under a flood: {calls} calls in {BATTERY_S} s, at most {longest_us:.0f} us apart; {texts[-3:]}")
    assert calls >= BATTERY_S / 0.02 - 2 and longest_us <= LOOKS_US
    assert not pilot.link.telemetry.armed and pilot.link.telemetry.charge == EMPTY
    assert key is not None or "disarmed: battery empty" in texts

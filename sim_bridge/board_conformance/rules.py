"""The rules of docs/board.md, in the order in which they are tried, and the check of each. Pure.

A check takes a board at rest. It returns True if the board did as required, and the measured figures as text.
"""

import math
from collections.abc import Callable

from shoal.mavlink.agent_link import ACCEPTED, AgentLink
from shoal.mavlink.signing import Key
from sim_bridge.board_conformance.probe import (
    DEPTH_M,
    FORCE_MPS2,
    HEADING_RAD,
    MS,
    NUDGE_US,
    PERIOD_NS,
    TURN_RADPS,
    BoardProbe,
)
from sim_bridge.board_conformance.runner import Measured, Rule

STOPS_WITHIN_S = 0.3
TURNS = 5  # repetitions of a check of which the worst case counts


def ms(seconds: float) -> str:
    return f"{seconds * 1e3:.0f} ms" if math.isfinite(seconds) else "not at all"


# --- age


def stops(frame: Callable[[BoardProbe], Callable[[], bytes] | None]) -> Callable[[BoardProbe], Measured]:
    """A check that an armed board becomes disarmed and neutral while only this frame is sent: the worst of TURNS trials."""

    def check(probe: BoardProbe) -> Measured:
        worst = 0.0
        for _ in range(TURNS):
            if not probe.arm():
                return False, "does not arm"
            worst = max(worst, probe.stops_after(frame(probe)))
            if worst > STOPS_WITHIN_S:
                break
        return worst <= STOPS_WITHIN_S, ms(worst)

    return check


def repeated(probe: BoardProbe) -> Callable[[], bytes]:
    """Frames of a sender that repeats one valid override."""
    frame = probe.pulses()
    probe.wire.send(frame)
    return lambda: frame


def damaged(probe: BoardProbe) -> Callable[[], bytes]:
    """Frames of overrides with a bit of their payload flipped, another one each time."""
    count = iter(range(10**9))

    def frame() -> bytes:
        damaged = bytearray(probe.pulses())
        damaged[10 + next(count) % 10] ^= 0x10  # in the payload
        return bytes(damaged)

    return frame


def alive(probe: BoardProbe) -> Callable[[], bytes]:
    """Frames that show a living computer, without an override."""
    return lambda: probe.computer.heartbeat() + probe.computer.timesync(probe.wire.now_ns())


def holds(probe: BoardProbe) -> Measured:
    """Stay armed when three overrides in four are lost."""
    if not probe.arm():
        return False, "does not arm"
    for _ in range(8):
        probe.wire.send(probe.pulses())
        probe.listen(4 * PERIOD_NS * 1e-9, lambda: not probe.armed)
    return probe.armed, "armed" if probe.armed else "disarmed"


def revival(probe: BoardProbe) -> Measured:
    """Send overrides again after a silence: the board must stay disarmed."""
    if not probe.arm():
        return False, "does not arm"
    probe.listen(0.6)
    probe.stream(probe.pulses, 0.6)
    return not probe.armed, "armed" if probe.armed else "disarmed"


# --- outputs


def disarmed_neutral(probe: BoardProbe) -> Measured:
    """Command thrust without arming: every echo must stay neutral."""
    first = len(probe.samples)
    probe.stream(probe.nudge, 0.6)
    moved = [s.echo_us for s in probe.samples[first:] if s.echo_us[:4] != (probe.neutral_us,) * 4]
    return not moved, f"echo {moved[0]}" if moved else "neutral"


def follows(probe: BoardProbe) -> Measured:
    """Command another pulse of each thruster: the echo must reach all of them."""
    if not probe.arm():
        return False, "does not arm"
    offs = (NUDGE_US, -NUDGE_US, NUDGE_US / 2 + 10, -NUDGE_US / 2 - 10)
    target = tuple(round(probe.neutral_us + off) for off in offs)
    begun_ns = probe.wire.now_ns()
    has_followed = probe.stream(lambda: probe.pulses(*offs), 0.6, lambda: probe.computer.telemetry.echo_us[:4] == target)
    took = ms((probe.wire.now_ns() - begun_ns) * 1e-9)
    return has_followed, took if has_followed else f"told {target}, puts out {probe.computer.telemetry.echo_us[:4]}"


def at_once(probe: BoardProbe) -> Measured:
    """Disarm while a thruster turns and its pulses go on coming: the board must be neutral within 100 ms."""
    if not probe.arm():
        return False, "does not arm"
    probe.stream(probe.nudge, 0.6)
    if probe.still:
        return False, "does not turn"
    probe.wire.send(probe.computer.arm(False))
    begun_ns = probe.wire.now_ns()
    has_stopped = probe.stream(probe.nudge, 0.5, lambda: not probe.armed and probe.still)
    took_s = (probe.wire.now_ns() - begun_ns) * 1e-9
    return has_stopped and took_s <= 0.1, ms(took_s if has_stopped else math.inf)


def stops_from_thrust(probe: BoardProbe) -> Measured:
    """Fall silent while a thruster turns: the worst time of TURNS trials until the board is disarmed and neutral."""
    worst = 0.0
    for _ in range(TURNS):
        if not probe.arm():
            return False, "does not arm"
        probe.stream(probe.nudge, 0.3)
        if probe.still:
            return False, "does not turn"
        probe.wire.send(probe.nudge())
        last_ns = probe.wire.now_ns()
        has_stopped = probe.listen(1.0, lambda: not probe.armed and probe.still)
        worst = max(worst, (probe.wire.now_ns() - last_ns) * 1e-9 if has_stopped else math.inf)
    return worst <= STOPS_WITHIN_S, ms(worst)


def with_limits(probe: BoardProbe, changes: dict[str, float], check: Callable[[], Measured]) -> Measured:
    """Run a check with other parameters, of those that the board has."""
    _ = [probe.station.values[name] for name in changes]
    if not all(probe.set(name, value) for name, value in changes.items()):
        return False, f"{', '.join(changes)} cannot be set"
    return check()


def slew(probe: BoardProbe) -> Measured:
    """Measure the slew rate slowly, so that many echoes show it."""
    rate = 600.0

    def check() -> Measured:
        if not probe.arm():
            return False, "does not arm"
        first, begun_ns = len(probe.samples), probe.wire.now_ns()
        reached = probe.stream(probe.nudge, 1.0, lambda: probe.computer.telemetry.echo_us[0] == probe.neutral_us + NUDGE_US)
        took_s = (probe.wire.now_ns() - begun_ns) * 1e-9
        moving = {s.echo_us[0] for s in probe.samples[first:]}
        fastest = NUDGE_US / max(took_s, 1e-3)
        good = reached and len(moving) > 2 and fastest <= 1.1 * rate
        return good, f"{fastest:.0f} us/s at a limit of {rate:.0f}"

    return with_limits(probe, {"SLEW_US_S": rate}, check)


def out_of_range(probe: BoardProbe) -> Measured:
    """Send overrides out of range, with narrow limits, so that a board that clips turns slowly."""

    def check() -> Measured:
        if not probe.arm():
            return False, "does not arm"
        for channel in range(4):
            for off in (NUDGE_US + 1, -NUDGE_US - 1):
                offs = [NUDGE_US / 2] * 4
                offs[channel] = off
                for frame in (probe.pulses(*offs), probe.pulses()):  # every other one is good, so that it stays armed
                    probe.wire.send(frame)
                    moved = probe.listen(PERIOD_NS * 1e-9, lambda: not probe.still)
                    if moved:
                        return False, f"channel {channel + 1} out of range by 1: {probe.computer.telemetry.echo_us}"
        return probe.armed, "refused as a whole, on each thruster" if probe.armed else "disarmed"

    limits = {"THR_MAX_US": probe.neutral_us + NUDGE_US, "THR_MIN_US": probe.neutral_us - NUDGE_US}
    return with_limits(probe, limits, check)


def ankles(probe: BoardProbe) -> Measured:
    """Send overrides with an ankle out of range between good ones: no ankle may move, and the board stays armed."""
    probe.listen(0.1)
    before = probe.computer.telemetry.echo_us[4:]
    if not probe.arm():
        return False, "does not arm"
    probe.stream(probe.pulses, 0.2)
    for _ in range(4):
        for frame in (probe.forbidden(), probe.pulses()):
            probe.wire.send(frame)
            probe.listen(PERIOD_NS * 1e-9)
    after = probe.computer.telemetry.echo_us[4:]
    return after == before and probe.armed, f"from {before} to {after}"


RESYNC_WITHIN_S = 0.25
BURST_HZ = 45.0


# --- what it tells


def _parameters(probe: BoardProbe) -> Measured:
    """Ask for all parameters, again where answers are lost: the list must become complete."""
    for _ in range(12):
        probe.wire.send(probe.station.ask_all())
        if probe.listen(1.5, lambda: probe.station.complete):
            break
    return probe.station.complete and "THR_NEUTRAL_US" in probe.station.values, f"{len(probe.station.values)} parameters"


def _bad_frames(probe: BoardProbe) -> int:
    """Number of the board's frames that could not be used."""
    return probe.computer.telemetry.bad_frames + probe.computer.telemetry.refused_frames


def _telemetry(probe: BoardProbe) -> Measured:
    """Count bursts of telemetry for two seconds, and bad frames among them."""
    probe.listen(0.2)
    times_ms: set[int] = set()
    # A link that was opened in the middle of a frame began with a bad one.
    probe.bytes_heard, bad_before = 0, _bad_frames(probe)
    for _ in range(400):
        probe.listen(0.005)
        times_ms.add(probe.computer.telemetry.board_ms)
    telemetry, rate = probe.computer.telemetry, len(times_ms) / 2.0
    complete = len(telemetry.echo_us) == 8 and telemetry.battery_v > 0.0 and math.hypot(*telemetry.acceleration_mps2) > 1.0
    bad = _bad_frames(probe) - bad_before
    good = rate >= BURST_HZ and complete and bad == 0
    return good, f"{rate:.0f} Hz, {probe.bytes_heard / 2:.0f} bytes/s, {bad} bad frames{'' if complete else ', incomplete'}"


def _power_on(probe: BoardProbe) -> Measured:
    """Ask for nothing: the board must be disarmed and neutral."""
    probe.listen(1.2)
    return not probe.armed and probe.still, f"{'armed' if probe.armed else 'disarmed'}, {probe.computer.telemetry.echo_us}"


def _clock(probe: BoardProbe) -> Measured:
    """Measure the slowest of TURNS answers to TIMESYNC."""
    worst = max(probe.answers(probe.computer.timesync(probe.wire.now_ns())) for _ in range(TURNS))
    return worst <= 0.05, ms(worst)


# --- arming


def _refused(probe: BoardProbe, result: int | None) -> Measured:
    """Judge the reply to a request to arm: it must be a refusal, and the board disarmed."""
    probe.listen(0.2)
    good = result not in (None, ACCEPTED) and not probe.armed
    return good, f"result {result}, {'armed' if probe.armed else 'disarmed'}"


def _arming_without(probe: BoardProbe) -> Measured:
    """Ask for arming when no pulses have come: it must be refused."""
    probe.listen(0.6)
    return _refused(probe, probe.ask_arm())


def _arming_late(probe: BoardProbe) -> Measured:
    """Ask for arming 0.4 s after the last pulses: it must be refused."""
    probe.stream(probe.pulses, 0.3)
    probe.listen(0.4)
    return _refused(probe, probe.ask_arm())


def _arming_forced(probe: BoardProbe) -> Measured:
    """Ask for arming by force while pulses come: the board must stay disarmed."""
    probe.stream(probe.pulses, 0.2)
    probe.wire.send(probe.forced_arming())
    probe.stream(probe.pulses, 0.4)
    return not probe.armed, "armed" if probe.armed else "disarmed"


def _arming_thrust(probe: BoardProbe) -> Measured:
    """Ask for arming while a thruster is commanded: it must be refused."""
    probe.stream(probe.nudge, 0.3)
    return _refused(probe, probe.ask_arm(frame=probe.nudge))


def _arming_strange(probe: BoardProbe) -> Measured:
    """Ask for arming while only a stranger's overrides come: the board must stay disarmed."""
    probe.listen(0.6)
    probe.stream(probe.of_a_stranger, 0.3)
    probe.wire.send(probe.station_arms(True))
    probe.stream(probe.of_a_stranger, 0.4)
    return not probe.armed, "armed" if probe.armed else "disarmed"


def _arming(probe: BoardProbe) -> Measured:
    """Ask for arming on young neutral overrides: it must be accepted, with no thruster turning."""
    probe.stream(probe.pulses, 0.3)
    result = probe.ask_arm(frame=probe.pulses)
    armed = probe.stream(probe.pulses, 0.5, lambda: probe.armed)
    return result == ACCEPTED and armed and probe.still, f"result {result}, {'armed' if armed else 'disarmed'}"


def _disarming(probe: BoardProbe) -> Measured:
    """Disarm an armed board from a ground station."""
    if not probe.arm():
        return False, "does not arm"
    probe.wire.send(probe.station_arms(False))
    by_station = probe.stream(probe.pulses, 0.3, lambda: not probe.armed)
    return by_station, "disarmed" if by_station else "armed"


def _empty_battery(probe: BoardProbe) -> Measured:
    """Move the thresholds above the battery's voltage."""
    volts = probe.computer.telemetry.battery_v

    def check() -> Measured:
        probe.stream(probe.pulses, 0.5)
        return _refused(probe, probe.ask_arm(frame=probe.pulses))

    return with_limits(probe, {"BAT_WARN_V": volts + 2.0, "BAT_NOARM_V": volts + 1.0}, check)


# --- the link


def _resync(probe: BoardProbe) -> Measured:
    """Send noise of several kinds, then a question in each control period until one is answered."""
    mavlink_1, mavlink_2 = 0xFE, 0xFD  # a frame's first byte
    longest_head = bytes([mavlink_2, 255, 0, 0, 0, probe.robot_id, 191]) + (131).to_bytes(3, "little")  # and no payload
    noises = (
        longest_head,
        bytes([mavlink_2]) * 40,
        bytes(range(256)),
        bytes([mavlink_1, 255]) * 9,
        probe.pulses()[:-3],  # a frame that is cut off
        longest_head * 3,
    )
    worst_s = 0.0
    for noise in noises:
        probe.wire.send(noise)
        begun_ns, is_answered = probe.wire.now_ns(), False
        while not is_answered and probe.wire.now_ns() - begun_ns < 1000 * MS:
            answered_in_s = probe.answers(probe.computer.timesync(probe.wire.now_ns()), PERIOD_NS * 1e-9)
            is_answered = answered_in_s < math.inf
        resynchronised_s = (probe.wire.now_ns() - begun_ns) * 1e-9 if is_answered else math.inf
        worst_s = max(worst_s, resynchronised_s)
    return worst_s <= RESYNC_WITHIN_S, ms(worst_s)


def _twice(probe: BoardProbe) -> Measured:
    """Send a frame twice at once."""
    question = probe.computer.arm(False)
    before = probe.computer.telemetry.acknowledgements
    probe.wire.send(question + question)
    probe.listen(0.3)
    answers = probe.computer.telemetry.acknowledgements - before
    return answers == 1, f"{answers} answers"


# --- parameters


def _set(probe: BoardProbe) -> Measured:
    before = probe.station.values["SLEW_US_S"]
    answers = [probe.set("SLEW_US_S", value) for value in (before / 2, before)]
    return all(answers), "set, and set back" if all(answers) else "not set"


def _bounds(probe: BoardProbe) -> Measured:
    """Set parameters out of their range: each must stay as it was."""
    accepted = []
    for name, value in (("CMD_AGE_MS", 5000.0), ("CMD_AGE_MS", math.nan), ("SLEW_US_S", -1.0), ("THR_MAX_US", math.inf)):
        before = probe.station.values[name]
        probe.set(name, value)
        probe.wire.send(probe.station.ask(name))
        probe.listen(0.2)
        if probe.station.values[name] != before:
            accepted.append(f"{name} = {value:g}")
    return not accepted, f"taken: {', '.join(accepted)}" if accepted else "refused"


def _set_armed(probe: BoardProbe) -> Measured:
    """Set a parameter while armed: it must stay as it was."""
    before = probe.station.values["SLEW_US_S"]
    if not probe.arm():
        return False, "does not arm"
    probe.wire.send(probe.setting("SLEW_US_S", before / 2))
    probe.stream(probe.pulses, 0.4)
    probe.rest()
    probe.wire.send(probe.station.ask("SLEW_US_S"))
    probe.listen(0.3)
    kept = probe.station.values["SLEW_US_S"] == before
    return kept, "refused" if kept else "taken"


def _unknown(probe: BoardProbe) -> Measured:
    """Set a parameter that does not exist: the board must answer PARAM_ERROR."""
    before = len(probe.station.values)
    probe.wire.send(probe.station.set("NO_SUCH_THING", 1.0))
    probe.listen(0.3)
    error = probe.station.error
    return len(probe.station.values) == before and error is not None, f"error {error[1]}" if error else "no PARAM_ERROR"


# --- hardware in the loop


def in_hil(check: Callable[[BoardProbe], Measured]) -> Callable[[BoardProbe], Measured]:
    """A check of a board in HIL mode."""

    def checked(probe: BoardProbe) -> Measured:
        if not probe.set("HIL_MODE", 1.0):
            return False, "HIL_MODE cannot be set"
        return check(probe)

    return checked


def _simulated(probe: BoardProbe) -> bool:
    """True if the board's last telemetry is what `BoardProbe.motion` says, and not its own."""
    telemetry = probe.computer.telemetry
    near = math.dist(telemetry.acceleration_mps2, FORCE_MPS2) < 0.05 and abs(telemetry.yaw_rate_radps - TURN_RADPS) < 0.01
    return near and abs(telemetry.heading_rad - HEADING_RAD) < 0.01 and abs(telemetry.depth_m - DEPTH_M) < 0.01


def _hil(probe: BoardProbe) -> Measured:
    """Check that in HIL mode measurements are the simulator's, and HEARTBEAT says so; and afterwards the board's own again."""
    says_hil = probe.listen(0.3, lambda: probe.computer.telemetry.hil)
    measures_simulated = probe.stream(probe.motion, 0.5, lambda: _simulated(probe))
    probe.set("HIL_MODE", 0.0)
    has_left = probe.stream(probe.motion, 0.5, lambda: not (probe.computer.telemetry.hil or _simulated(probe)))
    failures = []
    if not says_hil:
        failures.append("not said")
    if not measures_simulated:
        failures.append("own measurements")
    if not has_left:
        failures.append("not left")
    return not failures, ", ".join(failures) or "entered, and left"


def _hil_silence(probe: BoardProbe) -> Measured:
    """Check that without HIL_SENSOR the board reports no measurements, but still its outputs."""
    if not probe.stream(probe.motion, 0.5, lambda: _simulated(probe)):
        return False, "own measurements"
    probe.listen(0.2)
    measured, echoes = probe.computer.telemetry.board_ms, len(probe.samples)
    probe.listen(0.4)
    good = probe.computer.telemetry.board_ms == measured and len(probe.samples) > echoes
    return good, "outputs alone" if good else "measurements go on" if len(probe.samples) > echoes else "silent"


def _hil_stranger(probe: BoardProbe) -> Measured:
    """Check that the board ignores simulated measurements of another system: no burst with them comes. The last burst may
    still hold those that a rule before has sent."""
    before_ms = probe.computer.telemetry.board_ms
    probe.stream(lambda: probe.motion(probe.other_simulator), 0.4)
    is_accepted = probe.computer.telemetry.board_ms != before_ms and _simulated(probe)
    return not is_accepted, "taken" if is_accepted else "ignored"


def _hil_battery(probe: BoardProbe) -> Measured:
    """Simulate an empty battery: the board reports it, and does not arm."""
    empty_v = 0.9 * probe.station.values["BAT_NEUTRAL_V"]
    probe.stream(lambda: probe.simulator.battery(empty_v), 0.7)
    told_v = probe.computer.telemetry.battery_v
    good, measured = _refused(probe, probe.ask_arm(frame=probe.pulses))
    return good and abs(told_v - empty_v) < 0.05, f"{told_v:.1f} V of {empty_v:.1f} V, {measured}"


def _hil_outputs(probe: BoardProbe) -> Measured:
    """Check that outside HIL mode HIL_OUTPUTS cannot be set."""
    is_accepted = probe.set("HIL_OUTPUTS", 1.0)
    return not is_accepted, "taken" if is_accepted else "refused"


def _hil_armed(probe: BoardProbe) -> Measured:
    """Check that an armed board does not enter HIL mode."""
    if not probe.arm():
        return False, "does not arm"
    probe.wire.send(probe.setting("HIL_MODE", 1.0))
    probe.stream(probe.pulses, 0.4)
    entered = probe.computer.telemetry.hil
    return not entered, "entered" if entered else "refused"


# --- signing


def _dropped(probe: BoardProbe, frame: bytes) -> Measured:
    """Check that the board ignores a disarm, which any board obeys and answers at once. It comes after a silence, so that
    any sequence number is good."""
    probe.stay_silent(0.7)
    before = probe.computer.telemetry.acknowledgements
    probe.wire.send(frame)
    obeyed = probe.listen(0.3, lambda: probe.computer.telemetry.acknowledgements > before)
    return not obeyed, "obeyed" if obeyed else "dropped"


def _unsigned(probe: BoardProbe) -> Measured:
    return _dropped(probe, AgentLink(probe.robot_id).arm(False))


def _forged(probe: BoardProbe) -> Measured:
    return _dropped(probe, AgentLink(probe.robot_id, Key(bytes(32)), probe.later).arm(False))


def _replayed(probe: BoardProbe) -> Measured:
    """Check that the board ignores a signed frame that it has had before."""
    recorded = probe.computer.arm(False)
    probe.wire.send(recorded)
    probe.listen(0.3)
    return _dropped(probe, recorded)


def _strangers(probe: BoardProbe) -> Measured:
    """Check that peers without a key are told nothing, and that the computer is still told."""
    others = probe.wire.strangers()
    if others is None:
        return True, "the board has one other end"
    send_bytes, count_answered = others
    for _ in range(3):
        send_bytes()
        probe.listen(0.2)
    before = probe.bytes_heard
    probe.listen(0.2)
    answered = count_answered()
    return answered == 0 and probe.bytes_heard > before, f"{answered} of them were told something"


AGE = f"disarmed and neutral within {STOPS_WITHIN_S * 1e3:.0f} ms of the last override"

RULES = (
    Rule("parameters", "a list of PARAM_VALUE, complete", _parameters),
    Rule("telemetry", f"complete bursts at {BURST_HZ:.0f} Hz or more, no bad frame", _telemetry),
    Rule("power-on", "disarmed and neutral when nobody has asked for anything", _power_on),
    Rule("clock", "TIMESYNC answered within 50 ms", _clock),
    Rule("arming-without", "does not arm when no override arrives", _arming_without),
    Rule("arming-late", "does not arm 400 ms after the last override", _arming_late),
    Rule("arming-forced", "does not arm by force (parameter 2)", _arming_forced),
    Rule("arming-thrust", "does not arm while a thruster is commanded", _arming_thrust, spins=True),
    Rule("arming-strange", "does not arm on overrides of somebody else", _arming_strange),
    Rule("arming", "arms on young neutral overrides, and says so", _arming),
    Rule("arming-battery", "does not arm with the battery below BAT_NOARM_V", _empty_battery),
    Rule("disarming", "disarms for anybody", _disarming),
    Rule("age", AGE, stops(lambda _: None)),
    Rule("age-heartbeat", f"{AGE}: heartbeats and TIMESYNC keep nothing alive", stops(alive)),
    Rule("age-refused", f"{AGE}: nor do overrides out of range", stops(lambda probe: probe.forbidden)),
    Rule("age-repeated", f"{AGE}: nor does one that is repeated", stops(repeated)),
    Rule("age-damaged", f"{AGE}: nor do damaged ones", stops(damaged)),
    Rule("age-stranger", f"{AGE}: nor do somebody else's", stops(lambda probe: probe.of_a_stranger)),
    Rule("age-target", f"{AGE}: nor do those for another board", stops(lambda probe: probe.for_another)),
    Rule("gap", "stays armed when overrides come 200 ms apart", holds),
    Rule("revival", "stays disarmed when overrides come back after a silence", revival),
    Rule("disarmed-neutral", "follows nothing while disarmed", disarmed_neutral, spins=True),
    Rule("follows", "puts out what it is told, on each thruster, and says so", follows, spins=True),
    Rule("at-once", "neutral within 100 ms of a disarm, not slewed", at_once, spins=True),
    Rule("age-thrust", f"{AGE}, from thrust", stops_from_thrust, spins=True),
    Rule("slew", "a thruster's pulse moves no faster than SLEW_US_S", slew, spins=True),
    Rule("range", "refuses a whole override for one thruster out of range by 1 us", out_of_range, spins=True),
    Rule("ankles", "refuses an ankle out of range; leaves alone one that is ignored", ankles),
    Rule("resync", f"understands again within {RESYNC_WITHIN_S * 1e3:.0f} ms of garbage", _resync),
    Rule("repeated", "a frame that comes twice counts once", _twice),
    Rule("parameter-set", "sets a parameter and says so", _set),
    Rule("parameter-bounds", "refuses values out of range, NaN and infinity", _bounds),
    Rule("parameter-armed", "refuses parameters while armed", _set_armed),
    Rule("parameter-unknown", "answers an unknown name with PARAM_ERROR", _unknown),
    Rule("hil", "in HIL mode measurements are the simulator's, and it says so", in_hil(_hil)),
    Rule("hil-silence", "without HIL_SENSOR it tells its outputs and no measurements", in_hil(_hil_silence)),
    Rule("hil-stranger", "takes measurements from its own simulator only", in_hil(_hil_stranger)),
    Rule("hil-battery", "in HIL mode the battery is the simulator's", in_hil(_hil_battery)),
    Rule("hil-follows", "in HIL mode SERVO_OUTPUT_RAW follows as without it", in_hil(follows), spins=True),
    Rule("hil-outputs", "refuses HIL_OUTPUTS outside HIL mode", _hil_outputs),
    Rule("hil-armed", "refuses HIL_MODE while armed", _hil_armed),
    Rule("unsigned", "drops what is not signed", _unsigned, signed=True),
    Rule("forged", "drops what is signed with another key", _forged, signed=True),
    Rule("replayed", "drops a recording", _replayed, signed=True),
    Rule("strangers", "tells nothing to who has no key, and goes on telling who has it", _strangers, signed=True),
)

"""How the rules about age and about outputs are tried on a board: everything that has to do with thrust. Pure.

A check takes a board that is at rest, and says whether it did as required and what was seen.
"""

import math
from collections.abc import Callable

from sim_bridge.board_conformance.probe import NUDGE_US, PERIOD_NS, Probe
from sim_bridge.board_conformance.runner import Measured

STOPS_WITHIN_S = 0.3
TURNS = 5  # how often a thing is tried whose worst case counts


def ms(seconds: float) -> str:
    return f"{seconds * 1e3:.0f} ms" if math.isfinite(seconds) else "not at all"


# --- age


def stops(frame: Callable[[Probe], Callable[[], bytes] | None]) -> Callable[[Probe], Measured]:
    """From armed, with nothing but this on the wire, to disarmed and neutral: the worst of some."""

    def check(probe: Probe) -> Measured:
        worst = 0.0
        for _ in range(TURNS):
            if not probe.arm():
                return False, "does not arm"
            worst = max(worst, probe.stops_after(frame(probe)))
            if worst > STOPS_WITHIN_S:
                break
        return worst <= STOPS_WITHIN_S, ms(worst)

    return check


def repeated(probe: Probe) -> Callable[[], bytes]:
    frame = probe.pulses()
    probe.wire.send(frame)
    return lambda: frame


def damaged(probe: Probe) -> Callable[[], bytes]:
    count = iter(range(10**9))

    def frame() -> bytes:
        damaged = bytearray(probe.pulses())
        damaged[10 + next(count) % 10] ^= 0x10  # in the payload
        return bytes(damaged)

    return frame


def alive(probe: Probe) -> Callable[[], bytes]:
    return lambda: probe.computer.heartbeat() + probe.computer.timesync(probe.wire.now_ns())


def holds(probe: Probe) -> Measured:
    """The other side of the age: three overrides in four may be lost."""
    if not probe.arm():
        return False, "does not arm"
    for _ in range(8):
        probe.wire.send(probe.pulses())
        probe.listen(4 * PERIOD_NS * 1e-9, lambda: not probe.armed)
    return probe.armed, "armed" if probe.armed else "disarmed"


def revival(probe: Probe) -> Measured:
    if not probe.arm():
        return False, "does not arm"
    probe.listen(0.6)
    probe.stream(probe.pulses, 0.6)
    return not probe.armed, "armed" if probe.armed else "disarmed"


# --- outputs


def disarmed_neutral(probe: Probe) -> Measured:
    first = len(probe.samples)
    probe.stream(probe.nudge, 0.6)
    moved = [s.echo_us for s in probe.samples[first:] if s.echo_us[:4] != (probe.neutral_us,) * 4]
    return not moved, f"echo {moved[0]}" if moved else "neutral"


def follows(probe: Probe) -> Measured:
    if not probe.arm():
        return False, "does not arm"
    offs = (NUDGE_US, -NUDGE_US, NUDGE_US / 2 + 10, -NUDGE_US / 2 - 10)
    wanted = tuple(round(probe.neutral_us + off) for off in offs)
    begun_ns = probe.wire.now_ns()
    done = probe.stream(lambda: probe.pulses(*offs), 0.6, lambda: probe.computer.telemetry.echo_us[:4] == wanted)
    took = ms((probe.wire.now_ns() - begun_ns) * 1e-9)
    return done, took if done else f"told {wanted}, puts out {probe.computer.telemetry.echo_us[:4]}"


def at_once(probe: Probe) -> Measured:
    if not (probe.arm() and probe.stream(probe.nudge, 0.5)):
        probe.stream(probe.nudge, 0.1)
    probe.wire.send(probe.computer.arm(False))
    begun_ns = probe.wire.now_ns()
    done = probe.stream(probe.nudge, 0.5, lambda: not probe.armed and probe.still)
    took_s = (probe.wire.now_ns() - begun_ns) * 1e-9
    return done and took_s <= 0.1, ms(took_s if done else math.inf)


def stops_from_thrust(probe: Probe) -> Measured:
    worst = 0.0
    for _ in range(TURNS):
        if not probe.arm():
            return False, "does not arm"
        probe.stream(probe.nudge, 0.3)
        probe.wire.send(probe.nudge())
        last_ns = probe.wire.now_ns()
        done = probe.listen(1.0, lambda: not probe.armed and probe.still)
        worst = max(worst, (probe.wire.now_ns() - last_ns) * 1e-9 if done else math.inf)
    return worst <= STOPS_WITHIN_S, ms(worst)


def with_limits(probe: Probe, changes: dict[str, float], check: Callable[[], Measured]) -> Measured:
    """Try something with other parameters, and put them back."""
    before = {name: probe.station.values[name] for name in changes}
    try:
        if not all(probe.set(name, value) for name, value in changes.items()):
            return False, f"{', '.join(changes)} cannot be set"
        return check()
    finally:
        probe.rest()
        for name, value in before.items():
            probe.set(name, value)


def slew(probe: Probe) -> Measured:
    """Slowly, so that many echoes see it."""
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


def out_of_range(probe: Probe) -> Measured:
    """With narrow limits, so that a board that clips turns slowly."""

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


def ankles(probe: Probe) -> Measured:
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

"""The rules of a thruster board as one pure state machine, in the order of docs/board.md: the specification of a lab's
firmware.

No clock, no link, no sensors: sim_bridge/thruster_board/board.py has those. Times are ns of the board's own clock. For any
order of calls, the thrusters of a board that is stepped stand still unless it is armed and a valid override is young.
"""

import math
from dataclasses import dataclass
from enum import IntEnum

from shoal.mavlink.agent_link import ACCEPTED, CHANNELS, IGNORED, REJECTED
from shoal.mavlink.frame_codec import Peer
from shoal.mavlink.signing import Key, SignatureVerifier
from sim_bridge.thruster_board.parameters import Parameters, Refusal

S_NS = 1_000_000_000
NEVER_NS, EVER_NS = -(2**62), 2**62  # before and after all times
BATTERY_FILTER_S = 1.0  # s, time constant of the voltage filter: thrust lowers the voltage for moments
CRITICAL, WARNING, INFO = 2, 4, 6  # MAV_SEVERITY


class Charge(IntEnum):
    """Battery level, and the actions that it forbids."""

    GOOD = 0
    WARN = 1
    NO_ARM = 2
    NEUTRAL = 3


@dataclass(frozen=True)
class StatusText:
    severity: int
    text: str


class BoardStateMachine:
    def __init__(self, parameters: Parameters, computer: Peer, key: Key | None = None, floor: int = 0) -> None:
        """Overrides count from `computer` only. With a `key`, frames must be signed, later than `floor`."""
        self.parameters = parameters
        self.gate = SignatureVerifier(key, floor)
        self.armed = False
        self.charge = Charge.GOOD
        self.texts: list[StatusText] = []  # texts to send; the sender removes them
        self.overrides_received = 0  # all that were for this board, refused ones too
        self.overrides_refused = 0
        self._computer = computer
        self._command = (IGNORED,) * CHANNELS
        self._command_ns = NEVER_NS
        self._voltage: float | None = None
        self._stepped_ns: int | None = None
        self._echo_us = self._rest_us()  # pulses on the outputs without trims, not rounded

    @property
    def echo_us(self) -> tuple[int, ...]:
        """Pulses on the outputs without trims: thrusters, then ankles. In HIL mode what they would be."""
        return tuple(map(round, self._echo_us))

    @property
    def outputs_us(self) -> tuple[int, ...]:
        """Pulses on the pins, trims included, within the limits."""
        pulses = tuple(map(round, self._rest_us())) if self.parameters.pins_held else self.echo_us
        thrusters, parameters = self.parameters.thrusters, self.parameters
        limits = [parameters.thruster_us] * thrusters + [parameters.ankle_us] * (CHANNELS - thrusters)
        rows = zip(pulses, parameters.trims_us, limits, strict=True)
        return tuple(int(min(max(pulse + trim, low), high)) for pulse, trim, (low, high) in rows)

    def _rest_us(self) -> list[float]:
        """Pulses of thrusters and ankles at power-on, and on the pins in HIL mode."""
        thrusters = self.parameters.thrusters
        return [self.parameters.neutral_us] * thrusters + [sum(self.parameters.ankle_us) // 2] * (CHANNELS - thrusters)

    # --- what arrives

    def override(self, sender: Peer, pulses_us: tuple[int, ...], now_ns: int) -> None:
        """Take a command for all outputs, or refuse all of it. Nothing is clipped."""
        self.overrides_received += 1
        if sender != self._computer or not self._is_allowed(pulses_us):
            self.overrides_refused += 1
            return
        self._command, self._command_ns = pulses_us, now_ns

    def _is_allowed(self, pulses_us: tuple[int, ...]) -> bool:
        """True for an override of which every pulse is within its limits."""
        (slowest, fastest), (lowest, highest) = self.parameters.thruster_us, self.parameters.ankle_us
        thrusters = self.parameters.thrusters
        return (
            len(pulses_us) == CHANNELS
            and all(slowest <= pulse <= fastest for pulse in pulses_us[:thrusters])
            and all(lowest <= pulse <= highest or pulse == IGNORED for pulse in pulses_us[thrusters:])
        )

    def arm(self, is_arming: bool, now_ns: int) -> int:
        """Arm or disarm for any peer; returns the MAV_RESULT. Disarming always works."""
        if not is_arming:
            if self.armed:
                self._disarm(INFO, "disarmed")
            return ACCEPTED
        if self.armed:
            return ACCEPTED
        reason = self._arming_refusal(now_ns)
        if reason:
            self.texts.append(StatusText(WARNING, f"not armed: {reason}"))
            return REJECTED
        self.armed = True
        self.texts.append(StatusText(INFO, "armed"))
        return ACCEPTED

    def _arming_refusal(self, now_ns: int) -> str:
        """The reason why the board cannot be armed, or ""."""
        still_low, still_high = self.parameters.dead_zone_us
        if self._is_stale(now_ns):
            return "no override is arriving"
        if not all(still_low <= pulse <= still_high for pulse in self._command[: self.parameters.thrusters]):
            return "thruster pulses are not neutral"
        if self.charge >= Charge.NO_ARM:
            return "battery low"
        return ""

    def change(self, name: str, value: float) -> Refusal | None:
        """Change a parameter; returns the refusal, if any. The last override is dropped, as it was checked against the old
        values. What was measured before a change of HIL_MODE is not of the same battery."""
        changed = self.parameters.changed(name, value)
        if changed is not Refusal.UNKNOWN and self.armed:
            changed = Refusal.ARMED
        if isinstance(changed, Refusal):
            return changed
        if changed.hil is not self.parameters.hil:
            self._voltage, self.charge = None, Charge.GOOD
        self.parameters, self._command_ns = changed, NEVER_NS
        return None

    def set_key(self, key: Key, newest: int) -> str:
        """Require frames signed with this key, later than `newest` and than all taken so far. Returns the reason for a
        refusal, else ""."""
        if self.armed:
            return "armed"
        self.gate, self._command_ns = SignatureVerifier(key, max(newest, self.gate.newest)), NEVER_NS
        return ""

    def battery(self, voltage: float, elapsed_s: float) -> None:
        """Take in a voltage, `elapsed_s` after the one before, through a low-pass filter. A level is entered below its
        threshold, and left well above it."""
        voltage = voltage if math.isfinite(voltage) else 0.0
        before = voltage if self._voltage is None else self._voltage
        smooth = self._voltage = before + (voltage - before) * -math.expm1(-elapsed_s / BATTERY_FILTER_S)
        thresholds, hysteresis = self.parameters.thresholds_v, self.parameters["BAT_HYST_V"]
        entered = sum(smooth < threshold for threshold in thresholds)
        not_left = sum(smooth < threshold + hysteresis for threshold in thresholds)
        charge_before = self.charge
        self.charge = Charge(min(max(self.charge, entered), not_left))
        if self.charge is charge_before:
            return
        severity = CRITICAL if self.charge is Charge.NEUTRAL else WARNING if self.charge > charge_before else INFO
        self.texts.append(StatusText(severity, f"battery {self.charge.name}: {voltage:.1f} V"))
        if self.charge is Charge.NEUTRAL and self.armed:
            self._disarm(CRITICAL, "disarmed: battery empty")

    # --- time goes on

    def step(self, now_ns: int) -> None:
        """Check the age of the last override and move the outputs."""
        if self.armed and self._is_stale(now_ns):
            self._disarm(WARNING, f"disarmed: no override for {self.parameters.age_ns // 1_000_000} ms")
        elapsed_s = 0.0 if self._stepped_ns is None else max((now_ns - self._stepped_ns) / S_NS, 0.0)
        self._stepped_ns = now_ns
        if self.armed:
            self._move(self.parameters["SLEW_US_S"] * elapsed_s)
        else:
            thrusters = self.parameters.thrusters
            self._echo_us[:thrusters] = [self.parameters.neutral_us] * thrusters

    @property
    def next_event_ns(self) -> int:
        """Earliest instant at which a step changes anything, unless a call of another method does before."""
        if not self.armed:
            still = all(pulse == self.parameters.neutral_us for pulse in self._echo_us[: self.parameters.thrusters])
            return EVER_NS if still and not self.texts else NEVER_NS
        if any(goal not in (now, IGNORED) for goal, now in zip(self._command, self._echo_us, strict=True)):
            return NEVER_NS
        return self._command_ns + self.parameters.age_ns + 1

    def _is_stale(self, now_ns: int) -> bool:
        return now_ns - self._command_ns > self.parameters.age_ns

    def _move(self, reach_us: float) -> None:
        """Move towards the command, thrusters no faster than the slew rate."""
        for i, pulse in enumerate(self._command):
            if i < self.parameters.thrusters:
                self._echo_us[i] += min(max(pulse - self._echo_us[i], -reach_us), reach_us)
            elif pulse != IGNORED:
                self._echo_us[i] = pulse

    def _disarm(self, severity: int, reason: str) -> None:
        self.armed = False
        self.texts.append(StatusText(severity, reason))

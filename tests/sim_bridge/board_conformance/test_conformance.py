"""The conformance run: the reference board passes it, and no rule can be broken without it noticing.

Here board and clock are simulated, so a minute's run takes seconds; tests/sim_bridge/node/test_bench.py has real wires.
"""

import hashlib
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from shoal.config.experiment import load_experiment
from shoal.mavlink import framing
from shoal.mavlink.agent_link import ACCEPTED, IGNORED
from shoal.mavlink.frame_codec import Peer
from shoal.mavlink.framing import Sequence8
from shoal.mavlink.parameters import ParameterClient
from shoal.mavlink.signing import Key, SignatureVerifier
from sim_bridge.board_conformance.cli import _in_hil  # the command opens real links
from sim_bridge.board_conformance.probe import BoardProbe
from sim_bridge.board_conformance.rules import RULES
from sim_bridge.board_conformance.runner import RuleResult, RuleVerdict, examine
from sim_bridge.thruster_board.board import SimulatedSensors, ThrusterBoard
from sim_bridge.thruster_board.board_link import BoardLink
from sim_bridge.thruster_board.parameters import Parameters, Refusal
from sim_bridge.thruster_board.state_machine import BoardStateMachine

pytestmark = pytest.mark.long

POOL = load_experiment("pool")
KEY = Key(hashlib.sha256(b"a link of tests").digest())
STILL = np.zeros(4)
STEP_NS = 5_000_000
PARAM_SET = 23  # a message's number


class SteppedWire:
    """A wire to a board that is stepped as time is asked for."""

    def __init__(self, key: Key | None = None) -> None:
        self.board, self._now_ns = ThrusterBoard(POOL, 1, 1, key), 0
        self.worst_us = 0.0  # thruster output furthest from neutral

    def now_ns(self) -> int:
        return self._now_ns

    def send(self, data: bytes) -> None:
        self.board.receive(data, self._now_ns)

    def receive(self, until_ns: int) -> bytes:
        while True:
            self._now_ns += STEP_NS
            data = self.board.step(self._now_ns, STILL, STILL, STILL)
            self.worst_us = max(self.worst_us, *(abs(pulse - 1500) for pulse in self.board.pulses[:4]))
            if data or self._now_ns >= until_ns:
                return data

    def strangers(self) -> None:
        return None


def run(key: Key | None = None, dry: bool = False) -> tuple[dict[str, RuleResult], SteppedWire]:
    bench = SteppedWire(key)
    outcomes = {outcome.rule: outcome for outcome in examine(BoardProbe(bench, 1, key, lambda: 1000), dry, RULES)}
    return outcomes, bench


def failures(outcomes: dict[str, RuleResult]) -> set[str]:
    return {name for name, outcome in outcomes.items() if outcome.verdict is RuleVerdict.FAILED}


def tried(*names: str) -> set[str]:
    """Which of these rules fail on an unsigned board."""
    rules = [rule for rule in RULES if rule.name in {"parameters", *names}]
    return failures({outcome.rule: outcome for outcome in examine(BoardProbe(SteppedWire(), 1), False, rules)})


def test_the_reference_board_passes() -> None:
    before = ThrusterBoard(POOL, 1, 1).rules.parameters
    outcomes, bench = run(KEY)
    assert [o.rule for o in outcomes.values()] == [rule.name for rule in RULES]
    assert [o for o in outcomes.values() if o.verdict is not RuleVerdict.PASSED] == []
    assert bench.board.rules.parameters == before  # everything was put back
    assert not bench.board.armed
    assert bench.worst_us == 60  # and nothing ever turned faster than slowly


def test_a_dry_run_turns_nothing_and_says_what_it_left_out() -> None:
    outcomes, bench = run(dry=True)
    assert failures(outcomes) == set()
    assert bench.worst_us == 0
    skipped = {name for name, outcome in outcomes.items() if outcome.verdict is RuleVerdict.SKIPPED}
    assert skipped == {rule.name for rule in RULES if rule.spins or rule.signed}


class DeafWire(SteppedWire):
    """A wire that loses the next frame to the board while `loses`."""

    loses = False

    def send(self, data: bytes) -> None:
        if not self.loses:
            super().send(data)
        self.loses = False


@pytest.mark.parametrize("hil", [False, True])
def test_a_board_in_hil_mode_is_told_though_a_question_is_lost(hil: bool) -> None:
    wire, client = DeafWire(), ParameterClient(1)
    wire.send(client.set("HIL_MODE", float(hil)))
    while wire.now_ns() < 1_000_000_000:
        wire.receive(1_000_000_000)
    wire.loses = True
    assert _in_hil(wire, client) == hil
    assert client.values["HIL_MODE"] == hil and wire.now_ns() < 3_000_000_000


class HalfFrameWire(SteppedWire):
    """A wire that is opened in the middle of a frame, which a start byte is in."""

    def __init__(self) -> None:
        super().__init__()
        self._before = bytes([0xFD, 20, 0xFF])

    def receive(self, until_ns: int) -> bytes:
        before, self._before = self._before, b""
        return before + super().receive(until_ns)


def test_a_link_that_is_opened_in_the_middle_of_a_frame_passes() -> None:
    probe = BoardProbe(HalfFrameWire(), 1)
    rules = [rule for rule in RULES if rule.name in {"parameters", "telemetry"}]
    assert failures({o.rule: o for o in examine(probe, False, rules)}) == set()
    assert probe.computer.telemetry.bad_frames == 1


class LossyWire(SteppedWire):
    """A wire that loses the n-th PARAM_SET, for each n of `lost`."""

    def __init__(self, lost: range) -> None:
        super().__init__()
        self._lost, self._sets = lost, 0

    def send(self, data: bytes) -> None:
        is_set = int.from_bytes(data[7:10], "little") == PARAM_SET
        self._sets += is_set
        if not (is_set and self._sets in self._lost):
            super().send(data)


@pytest.mark.parametrize("rule", ["slew", "arming-battery"])
@pytest.mark.parametrize("lost", [range(1, 2), range(2, 3), range(3, 4)], ids=["first", "second", "third"])
def test_a_lost_frame_leaves_no_parameter_changed(rule: str, lost: range) -> None:
    bench = LossyWire(lost)
    before = bench.board.rules.parameters
    rules = [each for each in RULES if each.name in ("parameters", rule)]
    assert failures({o.rule: o for o in examine(BoardProbe(bench, 1), False, rules)}) == set()
    assert bench.board.rules.parameters == before


def test_a_parameter_that_cannot_be_put_back_is_a_failure_that_names_it() -> None:
    bench = LossyWire(range(2, 100))  # the first one changes it
    rules = [each for each in RULES if each.name in ("parameters", "slew")]
    *_, slew = examine(BoardProbe(bench, 1), False, rules)
    assert slew.verdict is RuleVerdict.FAILED
    assert slew.measured.endswith("; SLEW_US_S = 8000 has to be put back by hand")
    assert bench.board.rules.parameters["SLEW_US_S"] == 600.0


def test_an_examiner_that_is_ended_puts_everything_back() -> None:
    bench = LossyWire(range(0))
    ended: list[bool] = []

    def end() -> None:
        if bench.board.armed and not ended:
            ended.append(True)
            raise SystemExit(143)

    class EndedProbe(BoardProbe):
        def pulses(self, *thrusters_off_us: float, ankle: int = IGNORED) -> bytes:
            end()
            return super().pulses(*thrusters_off_us, ankle=ankle)

    before = bench.board.rules.parameters
    rules = [each for each in RULES if each.name in ("parameters", "range")]
    with pytest.raises(SystemExit):
        list(examine(EndedProbe(bench, 1), False, rules))
    assert ended
    assert not bench.board.armed
    assert bench.board.rules.parameters == before


# --- boards that break one rule each, and by which the run finds them

Broken = dict[str, Callable[..., Any]]


def _override_without_range(self: BoardStateMachine, sender: Peer, pulses_us: tuple[int, ...], now_ns: int) -> None:
    self.overrides_received += 1
    if sender == self._computer:
        self._command, self._command_ns = pulses_us, now_ns


def _override_clipped(self: BoardStateMachine, sender: Peer, pulses_us: tuple[int, ...], now_ns: int) -> None:
    (low, high), ankles = self.parameters.thruster_us, self.parameters.ankle_us
    clipped = [round(min(max(pulse, low), high)) for pulse in pulses_us[:4]]
    clipped += [pulse if pulse == IGNORED else round(min(max(pulse, ankles[0]), ankles[1])) for pulse in pulses_us[4:]]
    Rules_override(self, sender, tuple(clipped), now_ns)


def _override_of_anybody(self: BoardStateMachine, sender: Peer, pulses_us: tuple[int, ...], now_ns: int) -> None:
    Rules_override(self, self._computer, pulses_us, now_ns)


def _override_refused_but_counted(self: BoardStateMachine, sender: Peer, pulses_us: tuple[int, ...], now_ns: int) -> None:
    Rules_override(self, sender, pulses_us, now_ns)
    self._command_ns = now_ns


def _arm_always(self: BoardStateMachine, wanted: bool, now_ns: int) -> int:
    self.armed = wanted
    return ACCEPTED


def _arm_at_any_pulse(self: BoardStateMachine, now_ns: int) -> str:
    return "old" if self._is_stale(now_ns) else ""


def _arm_on_any_age(self: BoardStateMachine, now_ns: int) -> str:
    return Rules_why(self, self._command_ns)


def _arm_on_any_battery(self: BoardStateMachine, now_ns: int) -> str:
    reason = Rules_why(self, now_ns)
    return "" if reason == "battery low" else reason


def _never_disarm(self: BoardStateMachine, wanted: bool, now_ns: int) -> int:
    return Rules_arm(self, True, now_ns) if wanted else ACCEPTED


def _keep_thrust(self: BoardStateMachine, now_ns: int) -> None:
    held = self._echo_us[:4]
    Rules_step(self, now_ns)
    if not self.armed:
        self._echo_us[:4] = held


def _slewed_to_neutral(self: BoardStateMachine, now_ns: int) -> None:
    held = self._echo_us[:4]
    Rules_step(self, now_ns)
    if not self.armed:
        self._echo_us[:4] = [pulse + min(max(1500 - pulse, -1.0), 1.0) for pulse in held]


def _follow_while_disarmed(self: BoardStateMachine, now_ns: int) -> None:
    was, self.armed = self.armed, True
    stale = self._is_stale(now_ns)
    Rules_step(self, now_ns)
    self.armed = was and not stale


def _jump(self: BoardStateMachine, reach_us: float) -> None:
    Rules_move(self, 1e6)


def _ankle_to_zero(self: BoardStateMachine, reach_us: float) -> None:
    Rules_move(self, reach_us)
    self._echo_us[4:] = [1500 if goal != IGNORED else 1000 for goal in self._command[4:]]


def _swap(self: BoardStateMachine, reach_us: float) -> None:
    Rules_move(self, reach_us)
    self._echo_us[:2] = self._echo_us[1::-1]


def _slow_age(self: BoardStateMachine, now_ns: int) -> bool:
    return now_ns - self._command_ns > 400_000_000


def _hasty_age(self: BoardStateMachine, now_ns: int) -> bool:
    return now_ns - self._command_ns > 120_000_000


def _wake_up(self: BoardStateMachine, sender: Peer, pulses_us: tuple[int, ...], now_ns: int) -> None:
    was_silent = self._is_stale(now_ns) and self._command_ns > 0
    Rules_override(self, sender, pulses_us, now_ns)
    self.armed = self.armed or was_silent


def _change_while_armed(self: BoardStateMachine, name: str, value: float) -> Refusal | None:
    was, self.armed = self.armed, False
    answer = Rules_change(self, name, value)
    self.armed = was
    return answer


def _change_unchecked(self: Parameters, name: str, value: float) -> Parameters | Refusal:
    if name not in self.index or not math.isfinite(value):
        return Refusal.UNKNOWN
    index = self.index[name]
    return Parameters(self.table, (*self.values[:index], value, *self.values[index + 1 :]), self.built)


def _change_nothing(self: BoardStateMachine, name: str, value: float) -> Refusal | None:
    return None if name in self.parameters.index else Refusal.UNKNOWN


def _any_frame(self: SignatureVerifier, frame: bytes, system: int, component: int) -> Any:
    return accept_verified(SignatureVerifier(None), bytes([*frame[:2], 0]), system, component)


def _no_time(self: SignatureVerifier, frame: bytes, system: int, component: int) -> Any:
    self._streams.clear()
    return accept_verified(self, frame, system, component)


def _any_signature(self: SignatureVerifier, frame: bytes, system: int, component: int) -> Any:
    unsigned = not frame[2] & 1
    return accept_verified(
        self if unsigned else SignatureVerifier(None), frame if unsigned else bytes([*frame[:2], 0]), system, component
    )


def _hil_ignored(self: ThrusterBoard, now_ns: int) -> None:
    return None


def _hil_untold(self: BoardLink, armed: bool, healthy: bool, hil: bool, status: int) -> bytes:
    return Link_heartbeat(self, armed, healthy, False, status)


def _hil_always_told(self: BoardLink, armed: bool, healthy: bool, hil: bool, status: int) -> bytes:
    return Link_heartbeat(self, armed, healthy, True, status)


def _motion_of_any_age(self: SimulatedSensors, now_ns: int) -> Any:
    return self._motion


def _motion_of_anybody(self: BoardLink, message: Any) -> Any:
    message.get_header().srcSystem = 1
    return Link_read(self, message)


def _own_battery(self: SimulatedSensors, now_ns: int) -> float:
    return 12.4


def _never_arm(self: BoardStateMachine, now_ns: int) -> str:
    return "broken"


def _never_thrust(self: BoardStateMachine, now_ns: int) -> None:
    Rules_step(self, now_ns)
    self._echo_us[:4] = [self.parameters.neutral_us] * 4


def _still_in_hil(self: BoardStateMachine, now_ns: int) -> None:
    Rules_step(self, now_ns)
    if self.parameters.hil:
        self._echo_us[:4] = [self.parameters.neutral_us] * 4


# the wrong boards change one rule each and call the right one for the rest
Link_heartbeat, Link_read = BoardLink.heartbeat, BoardLink._read
# the wrong boards change one rule each and call the right one for the rest
Rules_override, Rules_arm, Rules_why = BoardStateMachine.override, BoardStateMachine.arm, BoardStateMachine._arming_refusal
# the wrong boards change one rule each and call the right one for the rest
Rules_step, Rules_move, Rules_change = BoardStateMachine.step, BoardStateMachine._move, BoardStateMachine.change
accept_verified = SignatureVerifier.verify
AGE = {"age", "age-heartbeat", "age-refused", "age-repeated", "age-damaged", "age-stranger", "age-target", "age-thrust"}

WRONG: list[tuple[type, str, Any, set[str], bool]] = [
    (BoardStateMachine, "override", _override_without_range, {"age-refused", "range", "ankles"}, False),
    (BoardStateMachine, "override", _override_clipped, {"age-refused", "range", "ankles"}, False),
    (BoardStateMachine, "override", _override_of_anybody, {"arming-strange", "age-stranger"}, False),
    (BoardStateMachine, "override", _override_refused_but_counted, {"age-refused"}, False),
    (BoardStateMachine, "override", _wake_up, {"revival"}, False),
    (BoardStateMachine, "arm", _arm_always, {"arming-without", "arming-late", "arming-thrust"}, False),
    (BoardStateMachine, "arm", _never_disarm, {"disarming"}, False),
    (BoardStateMachine, "_arming_refusal", _arm_at_any_pulse, {"arming-thrust"}, False),
    (BoardStateMachine, "_arming_refusal", _arm_on_any_age, {"arming-late"}, False),
    (BoardStateMachine, "_arming_refusal", _arm_on_any_battery, {"arming-battery"}, False),
    (BoardStateMachine, "_arming_refusal", _never_arm, {"at-once", "revival", "parameter-armed", "hil-armed"}, False),
    (BoardStateMachine, "step", _never_thrust, {"at-once", "age-thrust", "follows"}, False),
    (BoardStateMachine, "step", _keep_thrust, {"at-once", "age-thrust"}, False),
    (BoardStateMachine, "step", _slewed_to_neutral, {"at-once", "age-thrust"}, False),
    (BoardStateMachine, "step", _follow_while_disarmed, {"disarmed-neutral"}, False),
    (BoardStateMachine, "_move", _jump, {"slew"}, False),
    (BoardStateMachine, "_move", _ankle_to_zero, {"ankles"}, False),
    (BoardStateMachine, "_move", _swap, {"follows"}, False),
    (BoardStateMachine, "_is_stale", _slow_age, AGE, False),
    (BoardStateMachine, "_is_stale", _hasty_age, {"gap"}, False),
    (BoardStateMachine, "change", _change_while_armed, {"parameter-armed", "hil-armed"}, False),
    (BoardStateMachine, "change", _change_nothing, {"parameter-set"}, False),
    (Parameters, "changed", _change_unchecked, {"parameter-bounds", "hil-outputs"}, False),
    (ThrusterBoard, "_enter_or_leave_hil", _hil_ignored, {"hil", "hil-silence", "hil-battery"}, False),
    (BoardLink, "heartbeat", _hil_untold, {"hil"}, False),
    (BoardLink, "heartbeat", _hil_always_told, {"hil"}, False),
    (BoardLink, "_read", _motion_of_anybody, {"hil-stranger"}, False),
    (SimulatedSensors, "motion", _motion_of_any_age, {"hil-silence"}, False),
    (SimulatedSensors, "battery_v", _own_battery, {"hil-battery"}, False),
    (BoardStateMachine, "step", _still_in_hil, {"hil-follows"}, False),
    (Sequence8, "accept", lambda self, sequence, now_ns: True, {"age-repeated", "repeated"}, False),
    (SignatureVerifier, "verify", _any_frame, {"unsigned", "forged"}, True),
    (SignatureVerifier, "verify", _any_signature, {"forged"}, True),
    (SignatureVerifier, "verify", _no_time, {"replayed"}, True),
]


def speaking(board: ThrusterBoard, flag: list[bool]) -> None:
    """Raise the flag while the board runs: the examiner shares code with it, and only the board's is to be wrong."""
    for method in ("receive", "step"):
        original = getattr(board, method)

        def spoken(*arguments: Any, original: Any = original) -> Any:
            before, flag[0] = flag[0], True  # stepping receives
            try:
                return original(*arguments)
            finally:
                flag[0] = before

        vars(board)[method] = spoken


@pytest.mark.parametrize(("owner", "name", "wrong", "broken_rules", "signed"), WRONG, ids=lambda v: getattr(v, "__name__", ""))
def test_a_board_that_breaks_a_rule_is_found(
    monkeypatch: pytest.MonkeyPatch, owner: type, name: str, wrong: Any, broken_rules: set[str], signed: bool
) -> None:
    right, flag = getattr(owner, name), [False]
    monkeypatch.setattr(owner, name, lambda self, *arguments: (wrong if flag[0] else right)(self, *arguments))
    for broken in broken_rules:
        bench = SteppedWire(KEY if signed else None)
        speaking(bench.board, flag)
        rules = [rule for rule in RULES if rule.name in ("parameters", broken)]
        outcomes = {o.rule: o for o in examine(BoardProbe(bench, 1, KEY if signed else None, lambda: 1000), False, rules)}
        assert failures(outcomes) == {broken}, outcomes[broken].measured


def test_a_board_that_gives_a_false_start_byte_half_a_second_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(framing, "FRAME_TIMEOUT_NS", 500_000_000)
    assert tried("resync") == {"resync"}


def test_a_board_that_forces_arming_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    from sim_bridge.thruster_board import board_link

    # a board that reads a message wrongly: the readers are the decoder's own table
    monkeypatch.setitem(board_link._READERS, "COMMAND_LONG", lambda message: board_link.Arm(message.param1 == 1.0))
    assert tried("arming-forced") == {"arming-forced"}


def test_a_board_that_obeys_what_is_for_another_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    from sim_bridge.thruster_board import board_link

    def read(self: board_link.BoardLink, message: Any) -> Any:
        if hasattr(message, "target_system"):
            message.target_system = 1
        return original(self, message)

    # a board that does not look at the target: the check is in the decoder
    original = board_link.BoardLink._read
    monkeypatch.setattr(board_link.BoardLink, "_read", read)
    assert tried("age-target") == {"age-target"}


def test_a_board_that_sleeps_is_found() -> None:
    class Asleep(SteppedWire):
        def receive(self, until_ns: int) -> bytes:
            super().receive(until_ns)
            return b""

    names = {"parameters", "telemetry", "power-on", "clock", "arming", "arming-battery", "resync"}
    rules = [rule for rule in RULES if rule.name in names]
    assert failures({o.rule: o for o in examine(BoardProbe(Asleep(), 1), True, rules)}) == names

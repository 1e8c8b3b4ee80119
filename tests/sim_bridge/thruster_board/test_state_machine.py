"""The board's rules, one by one and then all together. `make mutants` asks which change would not be noticed."""

import math

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from shoal.config.experiment import load_experiment
from shoal.mavlink.agent_link import ACCEPTED, IGNORED, REJECTED
from shoal.mavlink.signing import Key, SignatureVerdict, Signer
from sim_bridge.thruster_board.parameters import Parameter, Parameters, Refusal
from sim_bridge.thruster_board.state_machine import BoardStateMachine, Charge, StatusText

PARAMETERS = Parameters.of(load_experiment("pool"))
COMPUTER, STRANGER = (3, 191), (255, 190)
MS = 1_000_000
LEVEL = (1500,) * 4
NEUTRAL = LEVEL * 2
AHEAD = (1700, 1650, 1400, 1600, 1500, 1200, 1800, 1500)


def fresh(**changes: float) -> BoardStateMachine:
    parameters = PARAMETERS
    for name, value in changes.items():
        changed = parameters.changed(name, value)
        assert isinstance(changed, Parameters)
        parameters = changed
    return BoardStateMachine(parameters, COMPUTER)


def armed(**changes: float) -> BoardStateMachine:
    """Armed at 0 with a neutral override of that instant."""
    rules = fresh(**changes)
    rules.step(0)
    rules.override(COMPUTER, NEUTRAL, 0)
    assert rules.arm(True, 0) == ACCEPTED
    rules.texts.clear()
    return rules


def flying(pulses: tuple[int, ...] = AHEAD) -> BoardStateMachine:
    """Armed, and with its outputs where the pulses are, commanded at 200 ms."""
    rules = armed()
    rules.override(COMPUTER, pulses, 200 * MS)
    rules.step(200 * MS)
    assert rules.echo_us == pulses
    return rules


def test_a_board_of_eight_thrusters_stops_all_of_them() -> None:
    """Outputs 5 to 8 are no ankles: they have the thrusters' range and slew, none may be left alone, all end at neutral."""
    rules, ahead = armed(THR_COUNT=8), (1700,) * 8
    for refused in ((*LEVEL, 1901, *LEVEL[:3]), (*LEVEL, *LEVEL[:3], IGNORED)):
        rules.override(COMPUTER, refused, 0)
    assert rules.overrides_refused == 2
    rules.override(COMPUTER, ahead, 10 * MS)
    rules.step(10 * MS)
    assert rules.echo_us == (1580,) * 8  # 8000 us/s for 10 ms
    rules.step(200 * MS)
    assert rules.echo_us == ahead
    rules.arm(False, 200 * MS)
    rules.step(201 * MS)
    assert rules.echo_us == rules.outputs_us == NEUTRAL
    rules = fresh(THR_COUNT=8)
    rules.override(COMPUTER, (*LEVEL, *LEVEL[:3], 1600), 0)
    assert rules.arm(True, 0) == REJECTED  # the eighth would turn at once


# --- arming


def test_outputs_are_neutral_at_power_on() -> None:
    rules = fresh()
    assert (rules.armed, rules.echo_us, rules.outputs_us, rules.charge) == (False, NEUTRAL, NEUTRAL, Charge.GOOD)
    assert (rules.overrides_received, rules.overrides_refused, rules.texts) == (0, 0, [])


def test_power_on_stands_in_the_middle_of_the_ankles() -> None:
    assert fresh(ANK_MIN_US=1203).echo_us == (*LEVEL, *(1601,) * 4)


def test_arming_says_so() -> None:
    rules = fresh()
    rules.override(COMPUTER, NEUTRAL, 7)
    assert rules.arm(True, 7) == ACCEPTED
    assert rules.armed
    assert rules.texts == [StatusText(6, "armed")]
    assert rules.arm(True, 8) == ACCEPTED
    assert rules.texts == [StatusText(6, "armed")]


def test_no_arming_at_power_on() -> None:
    rules = fresh()
    assert rules.arm(True, 0) == REJECTED
    assert not rules.armed
    assert rules.texts == [StatusText(4, "not armed: no override is arriving")]


@pytest.mark.parametrize(("age_ns", "result"), [(250 * MS, ACCEPTED), (250 * MS + 1, REJECTED)])
def test_arming_needs_a_young_override(age_ns: int, result: int) -> None:
    rules = fresh()
    rules.override(COMPUTER, NEUTRAL, 1000)
    assert rules.arm(True, 1000 + age_ns) == result


@pytest.mark.parametrize("thruster", range(4))
@pytest.mark.parametrize(("pulse", "result"), [(1476, REJECTED), (1477, ACCEPTED), (1523, ACCEPTED), (1524, REJECTED)])
def test_arming_needs_pulses_in_the_dead_zone(thruster: int, pulse: int, result: int) -> None:
    rules = fresh()
    rules.override(COMPUTER, (*LEVEL[:thruster], pulse, *LEVEL[thruster + 1 :], 1000, 2000, 1400, IGNORED), 0)
    assert rules.arm(True, 0) == result
    assert rules.armed == (result == ACCEPTED)
    if result == REJECTED:
        assert rules.texts == [StatusText(4, "not armed: thruster pulses are not neutral")]


def test_an_override_of_a_stranger_is_none() -> None:
    rules = fresh()
    rules.override(STRANGER, NEUTRAL, 0)
    assert rules.arm(True, 0) == REJECTED
    assert (rules.overrides_received, rules.overrides_refused) == (1, 1)


def test_disarming_works_from_every_state() -> None:
    rules = fresh()
    assert rules.arm(False, 0) == ACCEPTED
    assert rules.texts == []
    rules = flying()
    assert rules.arm(False, 201 * MS) == ACCEPTED
    assert not rules.armed
    assert rules.texts == [StatusText(6, "disarmed")]
    rules.step(205 * MS)
    assert rules.echo_us == (*LEVEL, *AHEAD[4:])  # at once, not slewed; ankles hold


def test_disarmed_follows_nothing() -> None:
    rules = fresh()
    for i in range(20):
        rules.override(COMPUTER, AHEAD, i * 5 * MS)
        rules.step(i * 5 * MS)
    assert rules.echo_us == NEUTRAL
    assert rules.texts == []


# --- age


def test_silence_disarms_after_the_age_and_not_before() -> None:
    rules = flying()
    rules.step(450 * MS)
    assert (rules.armed, rules.echo_us) == (True, AHEAD)
    rules.step(450 * MS + 1)
    assert (rules.armed, rules.echo_us) == (False, (*LEVEL, *AHEAD[4:]))
    assert rules.texts == [StatusText(4, "disarmed: no override for 250 ms")]


def test_the_age_is_a_parameter() -> None:
    rules = armed(CMD_AGE_MS=100)
    rules.step(100 * MS)
    assert rules.armed
    rules.step(100 * MS + 1)
    assert rules.texts == [StatusText(4, "disarmed: no override for 100 ms")]


def test_refused_overrides_keep_nothing_alive_and_overrides_do() -> None:
    rules = flying()
    rules.override(COMPUTER, (1099, *AHEAD[1:]), 400 * MS)
    rules.override(STRANGER, AHEAD, 400 * MS)
    assert rules.overrides_refused == 2
    rules.step(451 * MS)
    assert not rules.armed
    rules = flying()
    rules.override(COMPUTER, AHEAD, 400 * MS)
    rules.step(451 * MS)
    assert rules.armed


def test_nothing_starts_by_itself_after_a_silence() -> None:
    rules = flying()
    rules.step(500 * MS)
    rules.override(COMPUTER, AHEAD, 500 * MS)
    rules.step(505 * MS)
    assert (rules.armed, rules.echo_us[:4]) == (False, LEVEL)
    assert rules.arm(True, 505 * MS) == REJECTED  # not with those pulses


# --- limits


@pytest.mark.parametrize("channel", range(8))
@pytest.mark.parametrize("outside", [False, True])
@pytest.mark.parametrize("end", [0, 1])
def test_one_pulse_out_of_range_and_the_whole_override_is_refused(channel: int, outside: bool, end: int) -> None:
    limits = (1100, 1900) if channel < 4 else (1000, 2000)
    pulse = limits[end] + (outside and (-1, 1)[end])
    wanted = (*NEUTRAL[:channel], pulse, *NEUTRAL[channel + 1 :])
    rules = armed()
    rules.override(COMPUTER, wanted, 200 * MS)
    rules.step(200 * MS)
    assert rules.echo_us == (NEUTRAL if outside else wanted)
    assert (rules.overrides_received, rules.overrides_refused) == (2, int(outside))


@pytest.mark.parametrize("channel", range(4))
def test_a_thruster_cannot_be_ignored(channel: int) -> None:
    rules = armed()
    rules.override(COMPUTER, (*NEUTRAL[:channel], IGNORED, *NEUTRAL[channel + 1 :]), 10 * MS)
    assert rules.overrides_refused == 1


def test_an_ignored_ankle_stays() -> None:
    rules = flying()
    rules.override(COMPUTER, (*AHEAD[:4], IGNORED, 1700, IGNORED, IGNORED), 201 * MS)
    rules.step(202 * MS)
    assert rules.echo_us == (*AHEAD[:4], AHEAD[4], 1700, AHEAD[6], AHEAD[7])


@pytest.mark.parametrize("pulses", [(), NEUTRAL[:7], (*NEUTRAL, 1500)])
def test_an_override_has_eight_pulses(pulses: tuple[int, ...]) -> None:
    rules = fresh()
    rules.override(COMPUTER, pulses, 0)
    assert rules.overrides_refused == 1


def test_slew_both_ways_and_for_each_thruster() -> None:
    """8000 us/s: 40 us in 5 ms."""
    rules = armed()
    rules.override(COMPUTER, (1900, 1100, 1530, 1480, *LEVEL), 0)
    rules.step(5 * MS)
    assert rules.echo_us[:4] == (1540, 1460, 1530, 1480)
    rules.step(7 * MS)
    assert rules.echo_us[:4] == (1556, 1444, 1530, 1480)
    rules.step(100 * MS)
    assert rules.echo_us[:4] == (1900, 1100, 1530, 1480)
    rules.override(COMPUTER, (1100, 1900, 1530, 1480, *LEVEL), 100 * MS)
    rules.step(105 * MS)
    assert rules.echo_us[:2] == (1860, 1140)


def test_the_slew_rate_is_a_parameter() -> None:
    rules = armed(SLEW_US_S=1000)
    rules.override(COMPUTER, (1900, *NEUTRAL[1:]), 0)
    rules.step(10 * MS)
    assert rules.echo_us[0] == 1510


def test_a_clock_that_goes_back_moves_nothing() -> None:
    rules = armed()
    rules.override(COMPUTER, AHEAD, 10 * MS)
    rules.step(10 * MS)
    before = rules.echo_us[:4]
    rules.step(5 * MS)
    assert rules.echo_us[:4] == before
    rules.step(10 * MS)
    assert rules.echo_us[0] == before[0] + 40


def test_the_first_step_of_all_moves_nothing() -> None:
    rules = fresh()
    rules.override(COMPUTER, NEUTRAL, 0)
    rules.arm(True, 0)
    rules.override(COMPUTER, AHEAD, 0)
    rules.step(100 * MS)
    assert rules.echo_us[:4] == LEVEL


def test_trims_are_added_to_the_outputs_and_not_to_the_echo() -> None:
    trims = {"THR1_TRIM_US": -7, "THR2_TRIM_US": 1, "THR3_TRIM_US": 2, "THR4_TRIM_US": 3}
    trims |= {"ANK1_TRIM_US": 4, "ANK2_TRIM_US": 5, "ANK3_TRIM_US": 6, "ANK4_TRIM_US": 100}
    rules = fresh(**trims)
    assert rules.outputs_us == (1493, 1501, 1502, 1503, 1504, 1505, 1506, 1600)
    assert rules.echo_us == NEUTRAL
    assert all(type(pulse) is int for pulse in (*rules.outputs_us, *rules.echo_us))


# --- battery


def test_battery_levels_and_what_they_say() -> None:
    """Entered below 10.8, 10.5, 9.9 V; left 0.3 V above. A minute lets the filter settle."""
    rules = fresh()
    steps = [
        (10.81, Charge.GOOD, None),
        (10.79, Charge.WARN, StatusText(4, "battery WARN: 10.8 V")),
        (11.09, Charge.WARN, None),
        (11.11, Charge.GOOD, StatusText(6, "battery GOOD: 11.1 V")),
        (10.49, Charge.NO_ARM, StatusText(4, "battery NO_ARM: 10.5 V")),
        (10.79, Charge.NO_ARM, None),
        (10.81, Charge.WARN, StatusText(6, "battery WARN: 10.8 V")),
        (9.89, Charge.NEUTRAL, StatusText(2, "battery NEUTRAL: 9.9 V")),
        (10.19, Charge.NEUTRAL, None),
        (10.21, Charge.NO_ARM, StatusText(6, "battery NO_ARM: 10.2 V")),
    ]
    for volts, charge, text in steps:
        rules.texts.clear()
        rules.battery(volts, 60.0)
        assert rules.charge is charge, volts
        assert rules.texts == ([text] if text else []), volts


def test_the_first_measurement_counts_in_full() -> None:
    rules = fresh()
    rules.battery(9.0, 0.0)
    assert rules.charge is Charge.NEUTRAL


def test_the_filter_takes_a_second() -> None:
    """From 11 V to 10 V: 10.8 V is passed after ln(1/0.8) = 0.223 s."""
    for elapsed_s, charge in ((0.2231, Charge.GOOD), (0.2232, Charge.WARN)):
        rules = fresh()
        rules.battery(11.0, 0.0)
        rules.battery(10.0, elapsed_s)
        assert rules.charge is charge, elapsed_s


def test_a_voltage_on_the_threshold_is_above_it() -> None:
    rules = fresh(BAT_WARN_V=11.0, BAT_HYST_V=0.5)
    rules.battery(11.0, 1.0)
    assert rules.charge is Charge.GOOD
    rules = fresh(BAT_WARN_V=11.0, BAT_HYST_V=0.5)
    rules.battery(10.75, 1.0)
    for _ in range(2000):
        rules.battery(11.5, 60.0)
    assert rules.charge is Charge.GOOD


@pytest.mark.parametrize("volts", [math.nan, math.inf, -math.inf])
def test_a_measurement_that_is_no_number_counts_as_none(volts: float) -> None:
    rules = fresh()
    rules.battery(12.0, 1.0)
    rules.battery(volts, 0.01)
    assert rules.texts == []  # one alone is smoothed away
    rules.battery(volts, 1.0)
    assert rules.charge is Charge.NEUTRAL
    assert rules.texts == [StatusText(2, "battery NEUTRAL: 0.0 V")]


def test_battery_levels_forbid_arming_and_thrust() -> None:
    rules = armed()
    rules.battery(10.6, 1.0)
    assert rules.armed
    rules.battery(10.4, 60.0)
    assert (rules.charge, rules.armed) == (Charge.NO_ARM, True)
    rules.texts.clear()
    rules.arm(False, 0)
    assert rules.arm(True, 0) == REJECTED
    assert rules.texts[-1] == StatusText(4, "not armed: battery low")
    rules.battery(10.6, 60.0)
    assert rules.arm(True, 0) == REJECTED  # hysteresis
    rules.battery(10.85, 60.0)
    assert (rules.charge, rules.arm(True, 0)) == (Charge.WARN, ACCEPTED)


def test_an_empty_battery_disarms() -> None:
    rules = armed()
    rules.battery(9.0, 1.0)
    assert not rules.armed
    assert rules.texts == [StatusText(2, "battery NEUTRAL: 9.0 V"), StatusText(2, "disarmed: battery empty")]
    rules.texts.clear()
    rules.battery(12.0, 60.0)
    assert (rules.charge, rules.armed, rules.arm(True, 0)) == (Charge.GOOD, False, ACCEPTED)


# --- parameters


def test_a_parameter_is_changed_and_counts_at_once() -> None:
    rules = fresh()
    assert rules.change("THR_MAX_US", 1700) is None
    assert rules.parameters["THR_MAX_US"] == 1700
    rules.override(COMPUTER, (1701, *NEUTRAL[1:]), 0)
    assert rules.overrides_refused == 1


def test_no_parameter_is_changed_while_armed() -> None:
    rules = armed()
    assert rules.change("THR1_TRIM_US", 5) is Refusal.ARMED
    assert rules.parameters is PARAMETERS
    assert rules.change("NONSENSE", 5) is Refusal.UNKNOWN
    rules.arm(False, 0)
    assert rules.change("THR1_TRIM_US", 5) is None


def test_a_change_forgets_the_override_that_was_checked_before_it() -> None:
    rules = fresh()
    rules.override(COMPUTER, (*LEVEL, 2000, 2000, 2000, 2000), 0)
    assert rules.change("ANK_MAX_US", 1800) is None
    assert rules.arm(True, 0) == REJECTED
    rules.override(COMPUTER, NEUTRAL, 0)
    assert rules.arm(True, 0) == ACCEPTED


def test_a_change_of_hil_mode_forgets_the_battery_and_no_other_change_does() -> None:
    rules = fresh()
    rules.battery(10.0, 1.0)
    levels = []
    for name, value in (("SLEW_US_S", 500.0), ("HIL_MODE", 1.0)):
        assert rules.change(name, value) is None
        levels.append(rules.charge)
    rules.battery(10.7, 0.0)  # counts in full, as the first of another battery
    levels.append(rules.charge)
    for name, value in (("HIL_OUTPUTS", 1.0), ("HIL_OUTPUTS", 0.0), ("HIL_MODE", 0.0)):
        assert rules.change(name, value) is None
        levels.append(rules.charge)
    assert levels == [Charge.NO_ARM, Charge.GOOD, Charge.WARN, Charge.WARN, Charge.WARN, Charge.GOOD]


def test_a_refused_change_forgets_nothing() -> None:
    rules = fresh()
    rules.override(COMPUTER, NEUTRAL, 0)
    assert rules.change("THR_MAX_US", math.nan) is Refusal.RANGE
    assert rules.arm(True, 0) == ACCEPTED


# --- signing


def test_the_gate_is_shut_to_all_without_the_key_and_to_the_past() -> None:
    key, frame = Key(bytes(range(32))), bytes([0xFD, 0, 1])
    rules = BoardStateMachine(PARAMETERS, COMPUTER, key, floor=1000)
    assert rules.gate.verify(bytes([0xFD, 0, 0]), *COMPUTER) is SignatureVerdict.UNSIGNED
    assert rules.gate.verify(Signer(Key(bytes(32)), lambda: 2000).sign(frame), *COMPUTER) is SignatureVerdict.FORGED
    assert rules.gate.verify(Signer(key, lambda: 1000).sign(frame), *COMPUTER) is SignatureVerdict.REPLAYED
    assert rules.gate.verify(Signer(key, lambda: 1001).sign(frame), *COMPUTER) is SignatureVerdict.GOOD
    assert BoardStateMachine(PARAMETERS, COMPUTER).gate.verify(bytes([0xFD, 0, 0]), *STRANGER) is SignatureVerdict.GOOD
    assert (
        BoardStateMachine(PARAMETERS, COMPUTER, key).gate.verify(Signer(key, lambda: 1).sign(frame), *COMPUTER)
        is SignatureVerdict.GOOD
    )


def test_a_key_over_the_link_shuts_the_gate_and_forgets_the_last_override() -> None:
    rules, key, frame = fresh(), Key(bytes(range(32))), bytes([0xFD, 0, 1])
    rules.override(COMPUTER, NEUTRAL, 0)
    assert rules.set_key(key, 1000) == ""
    assert rules.arm(True, 0) == REJECTED
    assert rules.gate.verify(bytes([0xFD, 0, 0]), *COMPUTER) is SignatureVerdict.UNSIGNED
    assert rules.gate.verify(Signer(key, lambda: 1000).sign(frame), *COMPUTER) is SignatureVerdict.REPLAYED
    assert rules.gate.verify(Signer(key, lambda: 1001).sign(frame), *COMPUTER) is SignatureVerdict.GOOD


def test_another_key_forgets_no_time_that_was_used() -> None:
    rules, second = BoardStateMachine(PARAMETERS, COMPUTER, Key(bytes(range(32))), 500), Key(bytes(range(1, 33)))
    assert rules.set_key(second, 3) == ""
    assert rules.gate.verify(Signer(second, lambda: 500).sign(bytes([0xFD, 0, 1])), *COMPUTER) is SignatureVerdict.REPLAYED


def test_an_armed_board_takes_no_key() -> None:
    rules = armed()
    gate = rules.gate
    assert rules.set_key(Key(bytes(range(32))), 0) == "armed"
    assert rules.gate is gate and rules.armed


# --- anything at all

PULSE = st.integers(1095, 1905) | st.integers(0, 65535) | st.just(1500) | st.just(IGNORED)


class AnyOrder(RuleBasedStateMachine):
    """Calls in any order, against a second account of the rules that is as blunt as can be."""

    @initialize()
    def switch_on(self) -> None:
        self.board = fresh()
        self.now = self.last_step = 0
        self.valid: tuple[int, tuple[int, ...]] | None = None  # when, what
        self.before = self.board.echo_us
        self.may_be_armed = False

    @rule(pulses=st.lists(PULSE, min_size=8, max_size=8).map(tuple), own=st.booleans())
    def override(self, pulses: tuple[int, ...], own: bool) -> None:
        self.board.override(COMPUTER if own else STRANGER, pulses, self.now)
        good = all(1100 <= p <= 1900 for p in pulses[:4]) and all(1000 <= p <= 2000 or p == IGNORED for p in pulses[4:])
        if own and good:
            self.valid = (self.now, pulses)

    @rule()
    def neutral(self) -> None:
        self.override(pulses=NEUTRAL, own=True)

    @rule()
    def ahead(self) -> None:
        self.override(pulses=AHEAD, own=True)

    @rule(wanted=st.booleans())
    def arm(self, wanted: bool) -> None:
        was = self.board.armed
        result = self.board.arm(wanted, self.now)
        assert self.board.armed == (wanted and result == ACCEPTED)
        if self.board.armed and not was:
            assert self.valid is not None
            assert self.now - self.valid[0] <= 250 * MS
            assert all(1477 <= pulse <= 1523 for pulse in self.valid[1][:4])
            assert self.board.charge < Charge.NO_ARM
            self.may_be_armed = True
        self.may_be_armed = self.may_be_armed and wanted

    @rule(volts=st.floats(8.0, 13.0) | st.just(math.nan), elapsed_s=st.floats(0.0, 2.0))
    def battery(self, volts: float, elapsed_s: float) -> None:
        self.board.battery(volts, elapsed_s)
        assert not (self.board.armed and self.board.charge is Charge.NEUTRAL)

    @rule(row=st.sampled_from(PARAMETERS.table), value=st.floats() | st.integers(-100, 3000).map(float))
    @precondition(lambda self: self.board.armed)
    def change(self, row: Parameter, value: float) -> None:
        assert self.board.change(row.name, value) is Refusal.ARMED

    @rule(ms=st.sampled_from([0, 1, 5, 20, 100, 300]))
    def step(self, ms: int) -> None:
        self.now += ms * MS
        self.board.step(self.now)
        now, elapsed = self.board.echo_us, self.now - self.last_step
        self.last_step = self.now
        if now[:4] != LEVEL:
            assert self.board.armed and self.may_be_armed
            assert self.valid is not None and self.now - self.valid[0] <= 250 * MS
            steps = [abs(a - b) for a, b in zip(now[:4], self.before[:4], strict=True)]
            assert max(steps) <= 8000 * elapsed / 1e9 + 1  # both ends are rounded
        self.before = now

    @invariant()
    def outputs_are_within_limits(self) -> None:
        assert all(1100 <= pulse <= 1900 for pulse in self.board.echo_us[:4])
        assert all(1000 <= pulse <= 2000 for pulse in self.board.echo_us[4:])


TestAnyOrder = AnyOrder.TestCase
TestAnyOrder.settings = settings(
    max_examples=60, stateful_step_count=40, deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=True
)


# --- neutral is neutral


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("THR1_TRIM_US", 24),
        ("THR4_TRIM_US", -24),
        ("THR_NEUTRAL_US", 1890),
        ("THR_COUNT", 8),
    ],
)
def test_no_parameter_has_a_disarmed_board_push(name: str, value: float) -> None:
    rules = fresh()
    rules.change(name, value)
    rules.step(0)
    assert all(1477 <= pulse <= 1523 for pulse in rules.outputs_us[:4])


def test_a_curve_without_thrust_is_refused_and_makes_no_other_neutral() -> None:
    """Each point is set to 0 N, as far as that is taken; then what is no neutral pulse of the vehicle is not neutral."""
    rules = fresh()
    for i in range(12, 6, -1):
        rules.change(f"CRV{i:02}_N", 0.0)
    for i in range(1, 7):
        rules.change(f"CRV{i:02}_N", 0.0)
    assert rules.change("THR_NEUTRAL_US", 1600) is Refusal.INCONSISTENT
    rules.override(COMPUTER, (1900,) * 4 + (IGNORED,) * 4, 0)
    assert rules.arm(True, 0) == REJECTED


def test_fewer_thrusters_than_the_vehicle_has_are_refused() -> None:
    """An output that were an ankle's would hold its thrust while disarmed."""
    rules = BoardStateMachine(Parameters.of(load_experiment("pool", ["vehicle=vectored"])), COMPUTER)
    assert rules.parameters["THR_COUNT"] == 8.0 and rules.change("THR_COUNT", 4) is Refusal.RANGE


def test_trims_move_no_output_beyond_its_limits() -> None:
    rules = armed(THR_MAX_US=1560, THR1_TRIM_US=20, ANK1_TRIM_US=100)
    rules.override(COMPUTER, (*[1560] * 4, *[2000] * 4), 0)
    rules.step(50 * MS)
    assert rules.outputs_us == (*[1560] * 4, *[2000] * 4)

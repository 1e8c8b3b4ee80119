"""The board's parameters: bounds, what must hold between them, and the page that lists them."""

import math
import re
from collections.abc import Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shoal.config.experiment import load_experiment
from sim_bridge.thruster_board.parameters import FIXED, Parameter, Parameters, Refusal, single

POOL = Parameters.of(load_experiment("pool"))


def changed(name: str, value: float) -> Parameters:
    new = POOL.changed(name, value)
    assert isinstance(new, Parameters), f"{name} = {value}: {new}"
    return new


def test_parameters_begin_with_the_values_of_vehicle_and_board() -> None:
    experiment = load_experiment("pool")
    assert Parameters.of(experiment) == POOL  # which was made when this file was read: before `make mutants` changes anything
    assert POOL.curve == tuple((us, single(force)) for us, force in experiment.vehicle.thruster.curve)
    assert (POOL.neutral_us, POOL.thruster_us, POOL.ankle_us) == (1500, (1100, 1900), (1000, 2000))
    assert (POOL.age_ns, POOL["SLEW_US_S"], POOL.trims_us) == (250_000_000, 8000, (0,) * 8)
    assert POOL.thresholds_v == (single(10.8), single(10.5), single(9.9))
    assert POOL["BAT_HYST_V"] == single(0.3)
    assert POOL.dead_zone_us == (1477, 1523)
    assert POOL.is_consistent()


def test_the_age_is_whole_milliseconds() -> None:
    assert Parameters.of(load_experiment("pool", ["sim.board.neutral_after_s=0.2004"]))["CMD_AGE_MS"] == 200


def test_every_value_lies_in_its_range_and_every_name_fits_the_wire() -> None:
    assert len(POOL.table) == len(POOL.values) == len(FIXED) + 2 * 12
    for row, value in zip(POOL.table, POOL.values, strict=True):
        assert row.low <= value <= row.high
        assert re.fullmatch(r"[A-Z][A-Z0-9_]{2,15}", row.name)
        assert row.meaning
    assert len(POOL.index) == len(POOL.table)


def test_a_curve_has_a_pulse_and_a_thrust_for_each_point() -> None:
    rows = Parameters.of(load_experiment("pool")).table[len(FIXED) :]
    assert rows[:2] == (
        Parameter("CRV01_US", 500, 2500, True, "thrust curve, point 1: pulse"),
        Parameter("CRV01_N", -1000, 1000, False, "thrust curve, point 1: thrust, N"),
    )
    assert [row.name for row in rows[-2:]] == ["CRV12_US", "CRV12_N"]


def test_one_change_changes_one_value() -> None:
    for row in POOL.table:
        new = POOL.changed(row.name, POOL[row.name] + 1) if not row.name.startswith("CRV") else POOL
        if isinstance(new, Parameters):
            others = [name for name in POOL.index if name != row.name and new[name] != POOL[name]]
            assert others == [], row.name


@pytest.mark.parametrize(("value", "ok"), [(49, False), (50, True), (300, True), (301, False), (200.5, False)])
def test_range_and_whole_numbers(value: float, ok: bool) -> None:
    new = POOL.changed("CMD_AGE_MS", value)
    assert new is Refusal.RANGE if not ok else isinstance(new, Parameters) and new.age_ns == value * 1_000_000


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_no_parameter_takes_what_is_no_number(value: float) -> None:
    assert {POOL.changed(row.name, value) for row in POOL.table} == {Refusal.RANGE}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("THR_NEUTRAL_US", 1476),  # outside the dead zone
        ("THR_NEUTRAL_US", 1524),
        ("THR_MIN_US", 1099),  # outside the curve
        ("THR_MAX_US", 1901),
        ("THR_MIN_US", 1500),  # no room for reverse
        ("THR_MAX_US", 1500),
        ("ANK_MIN_US", 2000),
        ("ANK_MAX_US", 1000),
        ("BAT_WARN_V", 10.5),
        ("BAT_NOARM_V", 10.8),
        ("BAT_NOARM_V", 9.9),
        ("BAT_NEUTRAL_V", 10.5),
        ("CRV02_US", 1100),  # not rising
        ("CRV01_N", -1.9),
        ("CRV06_N", -0.01),  # the dead zone would be the one point 1523, which is not neutral
        ("CRV07_N", 0.01),
    ],
)
def test_inconsistent_value_is_refused(name: str, value: float) -> None:
    assert POOL.changed(name, value) is Refusal.INCONSISTENT


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("THR_NEUTRAL_US", 1477),
        ("THR_NEUTRAL_US", 1523),
        ("THR_MIN_US", 1499),
        ("THR_MAX_US", 1501),
        ("ANK_MIN_US", 1999),
        ("ANK_MAX_US", 1001),
        ("BAT_WARN_V", 10.51),
        ("CRV02_US", 1101),
        ("CRV01_N", -1.975),  # level is not falling
        ("CRV12_N", 2.9),
        ("SLEW_US_S", 100),
        ("SLEW_US_S", 100_000),
        ("THR1_TRIM_US", -23),  # the dead zone's end
        ("THR4_TRIM_US", 23),
        ("THR_COUNT", 8),
        ("ANK4_TRIM_US", 100),
        ("BAT_HYST_V", 0),
        ("BAT_HYST_V", 5),
    ],
)
def test_consistent_value_is_accepted(name: str, value: float) -> None:
    assert changed(name, value)[name] == single(value)


def with_thrusts(thrusts_n: Sequence[float]) -> Parameters:
    """Parameters with the thrusts of another curve, whether they fit or not."""
    forces = iter(thrusts_n)
    values = tuple(
        next(forces) if row.name.startswith("CRV") and row.name.endswith("_N") else value
        for row, value in zip(POOL.table, POOL.values, strict=True)
    )
    return Parameters(POOL.table, values, POOL.built)


@pytest.mark.parametrize(
    ("thrusts_n", "ok"),
    [
        ((-1.0, *[0.0] * 10, 0.5), True),
        ((0.0, *[0.0] * 10, 0.5), False),  # it does not push back,
        ((-1.0, *[0.0] * 10, 0.0), False),  # or not ahead
        ((*[-0.5] * 6, *[0.5] * 6), False),  # it is nowhere zero
    ],
)
def test_a_curve_pushes_both_ways_and_has_a_dead_zone(thrusts_n: tuple[float, ...], ok: bool) -> None:
    assert with_thrusts(thrusts_n).is_consistent() is ok


def test_neutral_with_a_trim_stays_in_the_dead_zone() -> None:
    beside = changed("THR_NEUTRAL_US", 1510)
    assert beside.changed("THR1_TRIM_US", 14) is beside.changed("THR1_TRIM_US", -34) is Refusal.INCONSISTENT
    assert isinstance(beside.changed("THR1_TRIM_US", 13), Parameters)
    assert isinstance(beside.changed("THR1_TRIM_US", -33), Parameters)


def test_unknown_parameter_name_is_refused() -> None:
    assert POOL.changed("SLEW", 1) is POOL.changed("", 1) is Refusal.UNKNOWN


def test_stored_values_come_back_after_a_restart() -> None:
    stored = dict(zip(POOL.index, changed("THR2_TRIM_US", -20).values, strict=True))
    assert POOL.restored(stored)["THR2_TRIM_US"] == -20
    assert POOL.restored({}) == POOL
    assert POOL.restored({"SLEW_US_S": 500.0, "GONE_SINCE": 1.0})["SLEW_US_S"] == 500


@pytest.mark.parametrize(
    ("name", "ends"), [("CMD_AGE_MS", (50, 300)), ("SLEW_US_S", (100, 100_000)), ("ANK4_TRIM_US", (-100, 100))]
)
def test_stored_values_at_the_ends_of_their_range_come_back(name: str, ends: tuple[float, float]) -> None:
    assert [POOL.restored({name: value})[name] for value in ends] == list(ends)


@pytest.mark.parametrize(
    "broken", [{"CMD_AGE_MS": 1e9}, {"CMD_AGE_MS": math.nan}, {"CMD_AGE_MS": 60.5}, {"THR_MIN_US": 1600.0}]
)
def test_damaged_stored_values_are_replaced_by_defaults(broken: dict[str, float]) -> None:
    assert POOL.restored({"THR2_TRIM_US": 5.0, **broken}) == POOL


@pytest.mark.long
@settings(max_examples=300)
@given(st.lists(st.tuples(st.sampled_from(POOL.table), st.floats() | st.integers(-200, 3000).map(float)), max_size=30))
def test_any_sequence_of_writes_leaves_consistent_parameters(writes: list[tuple[Parameter, float]]) -> None:
    parameters = POOL
    for row, value in writes:
        new = parameters.changed(row.name, value)
        parameters = new if isinstance(new, Parameters) else parameters
        assert parameters.is_consistent()
        assert all(r.low <= v <= r.high for r, v in zip(parameters.table, parameters.values, strict=True))


@given(st.floats())
def test_value_is_kept_in_single_precision(value: float) -> None:
    rounded = single(value)
    assert math.isnan(rounded) if math.isnan(value) else single(rounded) == rounded
    if abs(value) < 1e38 and abs(value) > 1e-37:
        assert rounded == pytest.approx(value, rel=1e-6)


def test_too_large_for_single_precision() -> None:
    assert (single(1e300), single(-1e300)) == (math.inf, -math.inf)


def test_a_refusal_fits_into_a_message_of_the_board() -> None:
    for row in FIXED:
        assert len(f"{row.name}: {Refusal.RANGE.words} ({row.bounds})") <= 50  # what a STATUSTEXT holds

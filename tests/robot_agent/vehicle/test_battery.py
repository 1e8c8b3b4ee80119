"""State of the battery: after one bad measurement, without any, and by the board's charge state."""

import pytest

from robot_agent.vehicle.battery import BatteryMonitor
from shoal.config.experiment import load_experiment
from shoal.messages.messages import BoardReading

BATTERY = load_experiment("pool").vehicle.battery  # no arming below 10.5 V, neutral below 9.9 V, 0.3 V hysteresis
MS = 1_000_000


def told(
    *voltages_v: float, charge: int = 1, battery: BatteryMonitor | None = None, from_ms: int = 0
) -> tuple[BatteryMonitor, int]:
    """A battery after such reports, two a second, looked at 20 times a second. Returns the time as well, in ns."""
    battery, now_ns = battery or BatteryMonitor(BATTERY), from_ms * MS
    for k, voltage_v in enumerate(voltages_v):
        for _ in range(10):
            reports = from_ms + k + 1
            battery.note_board(BoardReading(battery_v=voltage_v, battery_reports=reports, charge=charge), now_ns)
            now_ns += 50 * MS
    return battery, now_ns


def test_a_voltage_that_was_never_told_is_not_a_full_battery() -> None:
    battery = BatteryMonitor(BATTERY)
    battery.note_board(BoardReading(), MS)
    assert not battery.empty
    assert battery.arming_refusal(MS) == "the battery's voltage has not been told by the thruster board yet"


def test_a_voltage_that_is_told_no_more_is_not_known() -> None:
    battery, now_ns = told(12.4)
    assert battery.arming_refusal(now_ns) == ""
    battery.note_board(BoardReading(battery_v=12.4, battery_reports=1), now_ns + 5000 * MS)
    assert battery.arming_refusal(now_ns + 5000 * MS) == "the battery's voltage was last told 5.5 s ago"


def test_one_raw_voltage_under_load_is_no_empty_battery_and_one_that_stays_is() -> None:
    battery, now_ns = told(11.8, 11.8, 9.0, 11.8)
    assert not battery.empty and battery.arming_refusal(now_ns) == ""
    battery, _ = told(9.0, 9.0, 9.0, 9.0, battery=battery, from_ms=2000)
    assert battery.empty


def test_a_board_that_measures_nothing_any_more_tells_0_V_and_that_is_empty() -> None:
    battery, _ = told(12.4, 12.4)
    battery, now_ns = told(0.0, 0.0, 0.0, battery=battery, from_ms=1000)
    assert battery.empty and "the battery has" in battery.arming_refusal(now_ns)


def test_battery_too_low_to_arm_stays_so_until_well_above() -> None:
    battery, now_ns = told(10.4)
    assert battery.arming_refusal(now_ns) == "the battery has 10.4 V, needs 10.8 V since it was below 10.5 V"
    battery, now_ns = told(*[10.7] * 20, battery=battery, from_ms=500)
    assert battery.arming_refusal(now_ns) == "the battery has 10.7 V, needs 10.8 V since it was below 10.5 V"
    battery, now_ns = told(*[10.9] * 20, battery=battery, from_ms=10_500)
    assert battery.arming_refusal(now_ns) == ""


@pytest.mark.parametrize(
    ("charge", "arms", "empty"),
    [(0, True, False), (1, True, False), (2, True, False), (3, False, False), (4, False, True), (5, False, True),
     (6, False, True), (7, False, False)],
)  # fmt: skip
def test_battery_level_of_the_board_counts_whatever_the_voltage(charge: int, arms: bool, empty: bool) -> None:
    battery, now_ns = told(12.4, charge=charge)
    assert (battery.arming_refusal(now_ns) == "", battery.empty) == (arms, empty)
    assert arms or f"charge state {charge}" in battery.arming_refusal(now_ns)


def test_a_log_that_counts_no_reports_has_voltages_all_the_same() -> None:
    battery = BatteryMonitor(BATTERY)
    for k in range(200):
        battery.note_board(BoardReading(battery_v=12.0), k * 50 * MS)
    assert battery.arming_refusal(200 * 50 * MS) == ""

"""Batteries: what they give, and how long."""

import numpy as np
import pytest

from shoal.config.experiment import load_experiment
from shoal.frames import Array
from sim_bridge.plant.battery import BatteryModel, charge_after, thrust_factor
from sim_bridge.plant.fleet import Plant

REST = np.zeros((2, 4))
NO_SAG = np.zeros(2)


def supply(*settings: str) -> BatteryModel:
    return BatteryModel(load_experiment("pool", settings))


def drained(supply: BatteryModel, charge: Array, force_n: Array, seconds: float) -> Array:
    battery = supply.constants
    return np.array([charge_after(i, battery, float(left), force_n, seconds) for i, left in enumerate(charge)])


def factors(supply: BatteryModel, charge: Array, force_n: Array, lost_v: Array) -> Array:
    battery = supply.constants
    return np.array([thrust_factor(i, battery, float(charge[i]), force_n, float(lost_v[i])) for i in range(len(charge))])


def test_battery_starts_at_the_experiments_voltage() -> None:
    for volts in (11.0, 12.4, 12.6, 13.5):
        battery = supply(f"sim.sensors.battery_v={volts}")
        assert battery.rest_v(battery.start(2)) == pytest.approx([volts, volts])


def test_full_thrust_lasts_as_long_as_its_energy() -> None:
    """10 W of electronics and four thrusters of 25 W from 55 Wh: half an hour."""
    battery = supply("sim.sensors.battery_v=12.6")
    charge, full = battery.start(2), np.array([[3.0] * 4, [0.0] * 4])
    seconds = 55.0 * 3600.0 / 110.0
    for _ in range(100):
        charge = drained(battery, charge, full, seconds / 100)
    assert charge == pytest.approx([0.0, 1.0 - 10.0 / 110.0], abs=1e-9)
    assert drained(battery, charge, full, 60.0)[0] == 0.0


def test_a_quarter_of_the_thrust_takes_an_eighth_of_the_power() -> None:
    """Momentum theory: a propeller's power goes with its thrust to the power of 1.5."""
    supply_model = supply("sim.sensors.battery_v=12.6", "sim.plant.battery.electronics_w=0")
    left = drained(supply_model, supply_model.start(2), np.array([[3.0] * 4, [-0.75] * 4]), 100.0)
    assert (1.0 - left) == pytest.approx([10_000.0 / (55.0 * 3600.0), 10_000.0 / 8.0 / (55.0 * 3600.0)])


def test_voltage_falls_with_charge() -> None:
    battery = supply("sim.sensors.battery_v=12.6")
    volts = battery.rest_v(np.linspace(1.0, 0.0, 50))
    assert (np.diff(volts) < 0).all() and volts[0] == 12.6 and volts[-1] == pytest.approx(9.0)


def test_thrust_follows_voltage_and_load() -> None:
    battery = supply("sim.sensors.battery_v=12.0")
    charge = battery.start(2)
    assert factors(battery, charge, REST, NO_SAG) == pytest.approx([1.0, 1.0])
    loaded = factors(battery, charge, np.array([[3.0, -3.0, 3.0, -3.0], [0.0] * 4]), np.array([0.0, 2.0]))
    assert loaded == pytest.approx([(11.5 / 12) ** 1.2, (10.0 / 12) ** 1.2])


def test_a_robot_with_a_weak_battery_is_slower() -> None:
    speeds = []
    for volts in (12.0, 10.0):
        settings = (
            "pool.walls=false",
            "sim.plant.thruster_spread=0",
            f"sim.sensors.battery_v={volts}",
            "sim.sensors.battery_sag_v=0",
        )
        fleet = Plant(load_experiment("pool", settings), 1)
        state = fleet.start(np.array([[-9.0, 0.0, 5.0, 0.0], [9.0, 0.0, 5.0, 0.0]]))
        for _ in range(2000):
            state = fleet.step(state, np.tile([1700.0] * 4 + [1500.0] * 4, (2, 1)))
        speeds.append(state.nu[0, 0])
    thrusts = 3.0 * np.array(speeds) + 20.0 * np.array(speeds) ** 2
    assert thrusts[1] / thrusts[0] == pytest.approx((10 / 12) ** 1.2, rel=0.01)
    assert state.charge[0] < 0.999 * fleet.start(state.eta).charge[0]


def test_an_ideal_supply_changes_nothing() -> None:
    battery = supply("sim.plant.battery.capacity_wh=0")
    charge = battery.start(2)
    assert (factors(battery, charge, np.full((2, 4), 3.0), NO_SAG) == 1.0).all()
    assert (drained(battery, charge, np.full((2, 4), 3.0), 1e6) == charge).all()
    assert (battery.rest_v(charge) == 12.4).all()

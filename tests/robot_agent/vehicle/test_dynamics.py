"""The model against an integrator that shares no code with it."""

import itertools

import numpy as np
import pytest

from robot_agent.vehicle.dynamics import Model, State, lag
from shoal.config.vehicle import Vehicle, load_vehicle
from shoal.frames import Array
from tests.robot_agent.water import integrate

PERIOD_S = 0.05


def uneven_vehicle() -> Vehicle:
    """A vehicle whose surge and sway differ in drag, so that mixing them up shows. The article's law knows no Munk moment."""
    vehicle = load_vehicle("spherical")
    table = vehicle.model_dump()
    table["mass"].update(surge_kg=12.0, sway_kg=12.0)
    table["drag"].update(linear=(3.0, 5.0, 4.0, 0.08), quadratic=(20.0, 28.0, 30.0, 0.10))
    return Vehicle.model_validate(table)


def some_state(random: np.random.Generator) -> Array:
    return random.normal(size=11) * [1, 1, 0.3, 2, 0.15, 0.05, 0.05, 0.4, 0.8, 0.5, 0.04]


@pytest.mark.parametrize("vehicle", [uneven_vehicle(), load_vehicle("vectored")], ids=lambda vehicle: vehicle.name)
@pytest.mark.parametrize("seed", range(8))
def test_one_step_agrees_with_a_fine_integrator(seed: int, vehicle: Vehicle) -> None:
    random, axes = np.random.default_rng(seed), len(vehicle.limits.wrench)
    state, gamma = some_state(random), random.normal(size=4) * [0.02, 0.02, 0.02, 0.1]
    wrench, acts = (random.normal(size=4)[:axes] * [1.0, 0.5, 0.05, 1.0][:axes] for _ in range(2))
    state = np.append(state[:8], state[8:] if axes == 3 else acts)
    ours = Model(vehicle).advance(tuple(state), tuple(gamma), tuple(wrench), PERIOD_S)
    true = integrate(vehicle, state, lambda t: wrench, PERIOD_S, gamma)
    scale = np.array([1e-4, 1e-4, 1e-4, 1e-3, 1e-3, 1e-3, 1e-3, 5e-3, 1e-9, 1e-9, 1e-9, 1e-9])
    assert np.all(np.abs(np.array(ours) - true) < scale[: len(state)])


def test_error_falls_with_the_step() -> None:
    """Half the step, at most 0.6 of the error over a second: a wrong coefficient would leave a floor."""
    vehicle, random = uneven_vehicle(), np.random.default_rng(5)
    start, wrench = some_state(random), (2.0, 0.5, 0.05)
    true = integrate(vehicle, start, lambda t: wrench, 1.0)
    model, errors = Model(vehicle), []
    for count in (20, 40, 80, 160):
        state: State = tuple(start)
        for _ in range(count):
            state = model.advance(state, (0.0,) * 4, wrench, 1.0 / count)
        errors.append(np.abs(np.array(state) - true).max())
    assert all(later < 0.6 * earlier for earlier, later in itertools.pairwise(errors))
    assert errors[-1] < 2e-3


def test_top_speed_is_where_drag_balances_thrust() -> None:
    vehicle = load_vehicle("spherical")
    state: State = (0.0,) * 11
    for _ in range(600):
        state = Model(vehicle).advance(state, (0.0,) * 4, (6.0, 3.0, 0.0), PERIOD_S)
    assert state[4] == pytest.approx(vehicle.limits.speed_mps, abs=0.01)
    assert state[6] == pytest.approx(vehicle.limits.heave_mps, abs=0.01)


def test_without_sway_nothing_moves_sideways() -> None:
    state: State = (0.0,) * 11
    for _ in range(100):
        state = Model(load_vehicle("spherical"), sway=False).advance(state, (0.0, 1.0, 0.0, 0.0), (3.0, 0.0, 0.2), PERIOD_S)
    assert state[5] == 0.0 and state[4] > 0.1 and state[7] > 0.5


def test_a_long_step_stays_finite_and_bounded() -> None:
    state: State = (0.0, 0.0, 0.0, 0.0, 0.5, 0.3, 0.3, 2.0, 0.0, 0.0, 0.0)
    for _ in range(50):
        state = Model(load_vehicle("spherical")).advance(state, (0.0,) * 4, (0.0, 0.0, 0.0), 0.5)
    assert np.abs(state[4:8]).max() < 1e-3


def test_no_lag_means_thrust_at_once() -> None:
    vehicle = load_vehicle("spherical")
    assert lag(Model(vehicle, lag=False).lag_s, PERIOD_S) == (0.0, 0.0)
    left, mean = lag(Model(vehicle).lag_s, PERIOD_S)
    assert left == pytest.approx(np.exp(-0.5)) and mean == pytest.approx(2 * (1 - np.exp(-0.5)))

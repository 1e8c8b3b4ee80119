"""Model and prediction against an integrator that shares no code with them."""

import itertools
from collections.abc import Callable

import numpy as np
import pytest

from robot_agent.control.linearisation import Prediction
from robot_agent.vehicle.dynamics import Model, State
from shoal.config.vehicle import Vehicle, load_vehicle
from shoal.frames import Array
from tests.robot_agent.control.numpy_prediction import follow_without_moving_on, linearise
from tests.robot_agent.water import integrate

PERIOD_S = 0.05
BLOCKS = (1, 1, 2, 3, 4, 4)
HORIZON = 50


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


def wrench_at(t: float, before: Array, changes: Array) -> Array:
    """The blocked input: changes (3, blocks) on top of `before`, the last one lasting."""
    ends = PERIOD_S * np.cumsum(BLOCKS)
    return before + changes[:, min(int(np.searchsorted(ends, t, side="right")), len(BLOCKS) - 1)]


def constant(wrench: Array) -> Callable[[float], Array]:
    return lambda t: wrench


def fly(vehicle: Vehicle, start: Array, before: Array, changes: Array, gamma: Array, lag: bool) -> Array:
    """Poses (HORIZON, 4) at the nodes, by the independent integrator."""
    state, poses = start, []
    for k in range(HORIZON):
        held = wrench_at(k * PERIOD_S + 1e-6, before, changes)
        state = integrate(vehicle, state, constant(held), PERIOD_S, gamma, lag, 200)
        poses.append(state[:4])
    return np.array(poses)


def predicted(prediction: Prediction, channel: int, block: int) -> Array:
    """Response of the poses (HORIZON, 4) to one block of one channel, or (block = -1) the free response."""
    out = np.zeros((HORIZON, 4))
    row = {0: block, 1: block, 2: len(BLOCKS) + block}[channel]
    if channel == 1:
        out[:, 2] = prediction.z[1:, block]
        return out
    out[:, 0], out[:, 1] = prediction.x[1:, row], prediction.y[1:, row]
    if channel == 2:
        out[:, 3] = prediction.yaw[1:, block]
    return out


def settled(vehicle: Vehicle, start: Array, before: Array, gamma: Array, lag: bool = True) -> Prediction:
    """A prediction linearised along its own free response."""
    prediction = Prediction(Model(vehicle, lag=lag), PERIOD_S, HORIZON, BLOCKS)
    prediction.restart(tuple(start))
    for _ in range(8):
        linearise(prediction, start, before, gamma)
        follow_without_moving_on(prediction, np.zeros(3 * len(BLOCKS)))
    return prediction


@pytest.mark.parametrize(("seed", "lag"), [(0, True), (1, True), (2, False), (3, True)])
def test_free_response_converges_to_the_nonlinear_motion(seed: int, lag: bool) -> None:
    random, vehicle = np.random.default_rng(seed), uneven_vehicle()
    start, before = some_state(random), random.normal(size=3) * [1.0, 0.5, 0.03]
    gamma = random.normal(size=4) * [0.02, 0.02, 0.02, 0.1]
    prediction = settled(vehicle, start, before, gamma, lag)
    true = fly(vehicle, start, before, np.zeros((3, len(BLOCKS))), gamma, lag)
    free = np.stack([columns[1:, -1] for columns in (prediction.x, prediction.y, prediction.z, prediction.yaw)], axis=1)
    assert np.abs(free - true)[:, :3].max() < 0.01
    assert np.abs(free - true)[:, 3].max() < 0.03


def test_water_that_streams_carries_the_prediction_along() -> None:
    """Responses are the same, the free response drifts."""
    random, vehicle = np.random.default_rng(2), uneven_vehicle()
    start = tuple(some_state(random))
    still, carried = (Prediction(Model(vehicle), PERIOD_S, HORIZON, BLOCKS) for _ in range(2))
    for prediction, current in ((still, 0j), (carried, 0.05 - 0.02j)):
        prediction.restart(start)
        linearise(prediction, start, np.zeros(3), np.zeros(4), current)
    seconds = PERIOD_S * np.arange(HORIZON + 1)
    for moved, there, speed in ((carried.x, still.x, 0.05), (carried.y, still.y, -0.02)):
        assert np.array_equal(moved[:, :-1], there[:, :-1])
        assert moved[:, -1] - there[:, -1] == pytest.approx(speed * seconds, abs=1e-12)


@pytest.mark.parametrize("channel", [0, 1, 2])
@pytest.mark.parametrize("block", [0, 2, 5])
def test_sensitivities_are_finite_differences_of_the_nonlinear_motion(channel: int, block: int) -> None:
    random, vehicle = np.random.default_rng(11), uneven_vehicle()
    start, before, gamma = some_state(random), np.array([1.5, 0.3, 0.02]), np.array([0.01, -0.02, 0.01, 0.05])
    prediction = settled(vehicle, start, before, gamma)
    nudge = np.zeros((3, len(BLOCKS)))
    nudge[channel, block] = (0.02, 0.02, 0.001)[channel]
    up, down = (fly(vehicle, start, before, sign * nudge, gamma, True) for sign in (1, -1))
    true = (up - down) / (2 * nudge[channel, block])
    ours = predicted(prediction, channel, block)
    assert np.abs(ours - true).max() < 0.03 * np.abs(true).max()
    for axis in range(4):
        assert np.abs(ours - true)[:, axis].max() < 0.08 * max(np.abs(true[:, axis]).max(), 1e-4)


def test_the_turn_of_the_plan_starts_from_the_heading_there_is() -> None:
    """A nominal trajectory that is off in heading is turned, not believed."""
    vehicle = load_vehicle("spherical")
    start = np.array([0, 0, 0, 1.0, 0.2, 0, 0, 0, 0, 0, 0])
    prediction = Prediction(Model(vehicle), PERIOD_S, HORIZON, BLOCKS)
    prediction.restart(tuple(start))
    turned = start.copy()
    turned[3] = 2.5
    linearise(prediction, turned, np.zeros(3), np.zeros(4))
    assert np.arctan2(prediction.y[-1, -1], prediction.x[-1, -1]) == pytest.approx(2.5, abs=1e-6)


def test_no_lag_means_thrust_at_once() -> None:
    vehicle = load_vehicle("spherical")
    assert Model(vehicle, lag=False).lag(PERIOD_S) == (0.0, 0.0)
    left, mean = Model(vehicle).lag(PERIOD_S)
    assert left == pytest.approx(np.exp(-0.5)) and mean == pytest.approx(2 * (1 - np.exp(-0.5)))

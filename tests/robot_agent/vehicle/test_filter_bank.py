"""The bank's equations against others: differences for F, a dense filter in Joseph's form, moments of a mixture."""

import math
from typing import Any

import numpy as np
import pytest

from robot_agent.vehicle import filter_bank
from robot_agent.vehicle.dynamics import Model, MotionModel, advance
from robot_agent.vehicle.filter_bank import DRAG, ERRORS, GYRO, SIDE, TURN_DRAG, Bank, MeasuredNumber, R, Restless, X, Y
from robot_agent.vehicle.kalman import vehicle_noise
from shoal.config.vehicle import Vehicle, load_vehicle
from shoal.frames import Array

pytestmark = pytest.mark.long

VEHICLES = tuple(map(load_vehicle, ("spherical", "vectored")))


def random_bank(seed: int, filters: int = 3) -> Bank:
    random = np.random.default_rng(seed)
    root = random.standard_normal((filters, ERRORS, ERRORS)) * 0.1
    bank = Bank(
        by_time_m2ps3=np.array([5e-8, 1e-5, 2e-5])[:filters],
        by_place_mps2=np.array([5e-7, 0.0, 4e-4])[:filters],
        force_m2ps5=np.array([0.0, 0.0, 3e-3])[:filters],
        moment_rad2ps5=np.array([0.0, 0.0, 7e-3])[:filters],
        weight=random.dirichlet(np.ones(filters)),
        mean=random.standard_normal((filters, ERRORS)) * 0.01,
        covariance=root @ root.swapaxes(1, 2),
        mixed=np.zeros((ERRORS, ERRORS)),
        work=np.empty((4, ERRORS, ERRORS)),
    )
    bank.mean[:] -= bank.weight @ bank.mean
    return bank


def moved(vehicle: Vehicle, numbers: Array, dt: float, thrust: tuple[float, ...]) -> Array:
    """One step of the model: x, y, yaw, u, v, r after it, for the ERRORS' own values `numbers`."""
    model = Model(vehicle)
    x, y, yaw, u, v, r, b_u, b_v, b_r, c_x, c_y, _, d, t, n, a = numbers.tolist()
    m = model.nominal.copy()
    m[0, :2] /= math.exp(t)
    m[1:, :2] *= math.exp(d - t)
    m[:, 3] /= math.exp(n)
    m[1:, 3] *= math.exp(a)
    state: Any = (x, y, 0.3, yaw, u, v, 0.0, r, *thrust)
    push: Any = thrust
    after = advance(MotionModel(m, 1.0, model.lag_s), state, (b_u, b_v, 0.0, b_r), push, dt)
    return np.array([after[0] + c_x * dt, after[1] + c_y * dt, after[3], after[4], after[5], after[7]])


@pytest.mark.parametrize("vehicle", VEHICLES, ids=lambda vehicle: vehicle.name)
def test_f_is_the_derivative_of_the_step(vehicle: Vehicle) -> None:
    random, dt, h = np.random.default_rng(1), 1e-4, 1e-5
    for _ in range(20):
        numbers = random.uniform(-1.0, 1.0, ERRORS) * [1, 1, 3, 0.4, 0.3, 1, 0.05, 0.05, 0.2, 0.2, 0.2, 0.01, *4 * [0.5]]
        limits = (*vehicle.limits.wrench, 0.0)[:4]  # surge, heave, yaw, sway
        thrust = tuple(random.uniform(-1.0, 1.0, 4) * limits)
        belief, model, f = np.zeros(filter_bank.NUMBERS), Model(vehicle), np.empty((ERRORS, ERRORS))
        belief[[0, 1, 3, 4, 5, 7]], belief[8:11], belief[SIDE] = numbers[:6], thrust[:3], thrust[3]
        d, t, n, _ = np.exp(numbers[DRAG:])
        model.coefficients[0, :2] /= t
        model.coefficients[1:, :2] *= d / t
        model.coefficients[:, 3] /= n
        model.coefficients[1:, 3] *= math.exp(numbers[TURN_DRAG])
        filter_bank.linearise(model.coefficients, 1.0, belief, dt, vehicle_noise(vehicle), f)
        differences = np.empty((6, ERRORS))
        for j in range(ERRORS):
            change = np.zeros(ERRORS)
            change[j] = h
            differences[:, j] = (
                moved(vehicle, numbers + change, dt, thrust) - moved(vehicle, numbers - change, dt, thrust)
            ) / (2.0 * h)
        rate, expected = (f[:6] - np.eye(6, ERRORS)) / dt, (differences - np.eye(6, ERRORS)) / dt
        assert rate == pytest.approx(expected, abs=2e-3 * (1.0 + np.abs(expected).max()))


@pytest.mark.parametrize(("learns", "restless"), [(True, Restless(1.0, 1.0)), (False, Restless(1e-3, 1e-5))])
def test_a_filter_of_the_bank_is_the_dense_one(learns: bool, restless: Restless) -> None:
    """Prediction, and a pose with a yaw rate, against Joseph's form, which holds for any gain; drag's row of it is zero where
    drag is only considered, and forces are no more restless than is allowed."""
    random, bank, dt, yaw = np.random.default_rng(2), random_bank(2), 0.05, 0.7
    f = np.eye(ERRORS) + 0.05 * random.standard_normal((ERRORS, ERRORS)) * (random.random((ERRORS, ERRORS)) < 0.2)
    q = random.uniform(0.0, 1e-3, ERRORS)
    p, mean = bank.covariance[2].copy(), bank.mean[2].copy()
    cos, sin = math.cos(yaw), math.sin(yaw)
    belief = np.zeros(filter_bank.NUMBERS)
    belief[[3, 4, 5]], belief[[15, 16]] = (yaw, 0.3, -0.1), (0.2, 0.05)  # over ground: |(0.3 - 0.1i) e^(0.7i) + 0.2 + 0.05i|
    filter_bank.predict(bank, 1.0, belief, dt, f, q, restless)
    # water of another place: the current has grown by dc, u and v have lost it. Of a later time: they have not
    way_m = dt * abs((0.3 - 0.1j) * complex(cos, sin) + 0.2 + 0.05j)
    g, by_time, force = np.zeros((ERRORS, 2)), np.zeros(ERRORS), np.zeros(ERRORS)
    g[9], g[10], g[3], g[4] = (1.0, 0.0), (0.0, 1.0), (-cos, -sin), (sin, -cos)
    by_time[9:11], force[6:9] = (
        min(2e-5, restless[1]) * dt,
        np.minimum([3e-3, 3e-3, 7e-3], [restless[0], restless[0], 1.0]) * dt,
    )
    p, mean = f @ p @ f.T + np.diag(q + by_time + force) + min(4e-4 * way_m, restless[1] * dt) * g @ g.T, f @ mean
    assert bank.covariance[2] == pytest.approx(p, abs=1e-12)
    likelihood = 0.0
    for measured in (
        MeasuredNumber(X, -1, 0.02, 1e-4),
        MeasuredNumber(Y, -1, -0.01, 1e-4),
        MeasuredNumber(R, GYRO, 0.03, 1e-5),
    ):
        h = np.zeros(ERRORS)
        h[measured.row] = 1.0
        if measured.other >= 0:
            h[measured.other] = 1.0
        s, news = h @ p @ h + measured.variance, measured.error - h @ mean
        likelihood -= 0.5 * (news**2 / s + math.log(s))
        k = p @ h / s
        k[DRAG] *= learns
        mean, left = mean + k * news, np.eye(ERRORS) - np.outer(k, h)
        p = left @ p @ left.T + measured.variance * np.outer(k, k)
    likelihood_sum = sum(
        filter_bank.correct(bank.covariance[2], bank.mean[2], m, learns, np.empty(ERRORS))
        for m in (MeasuredNumber(X, -1, 0.02, 1e-4), MeasuredNumber(Y, -1, -0.01, 1e-4), MeasuredNumber(R, GYRO, 0.03, 1e-5))
    )
    assert bank.covariance[2] == pytest.approx(p, abs=1e-11) and bank.mean[2] == pytest.approx(mean, abs=1e-11)
    assert likelihood_sum == pytest.approx(likelihood)


def moments(bank: Bank) -> tuple[Array, Array]:
    mean = bank.weight @ bank.mean
    away = bank.mean - mean
    return mean, np.einsum("j,jab->ab", bank.weight, bank.covariance + away[:, :, None] * away[:, None, :])


def test_mixing_keeps_mean_and_covariance_of_the_whole() -> None:
    bank, change = random_bank(3), np.empty(ERRORS)
    bank.mean[:] += 0.05
    mean, covariance = moments(bank)
    filter_bank.merge(bank, change)
    assert change == pytest.approx(mean) and bank.mixed == pytest.approx(covariance, abs=1e-14)
    weight = bank.weight.copy()
    filter_bank.interact(bank, 0.3)
    mean, mixed = moments(bank)
    assert mean == pytest.approx(0.0, abs=1e-14) and mixed == pytest.approx(covariance, abs=1e-14)
    assert bank.weight == pytest.approx(0.7 * weight + 0.1)


def test_weights_follow_the_likelihood_and_none_dies() -> None:
    bank = random_bank(4)
    expected = bank.weight * np.exp([0.0, -2.0, 1.0])
    filter_bank.weigh_filters(bank, np.array([-700.0, -702.0, -699.0]))
    assert bank.weight == pytest.approx(expected / expected.sum())
    filter_bank.weigh_filters(bank, np.array([0.0, -1e4, 0.0]))
    assert bank.weight[1] >= 0.9 * filter_bank.LEAST_WEIGHT and bank.weight.sum() == pytest.approx(1.0)

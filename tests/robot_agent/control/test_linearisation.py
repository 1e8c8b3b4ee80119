"""Kernels of the linearised prediction against NumPy and LAPACK, at states and plans of all kinds."""

import numpy as np
import pytest

from robot_agent.control.linearisation import Prediction
from robot_agent.guidance.formation import HalfSpaces
from robot_agent.vehicle.dynamics import Model
from shoal.config.vehicle import load_vehicle
from tests.robot_agent.control.numpy_prediction import NumpyPrediction, linearise, numpy_cost

PERIOD_S, HORIZON, BLOCKS = 0.05, 30, (1, 1, 2, 3, 4)
N = len(BLOCKS)


def both(seed: int, sway: bool = True) -> tuple[Prediction, NumpyPrediction]:
    """The same prediction twice, along a nominal trajectory that is nobody's."""
    random, model = np.random.default_rng(seed), Model(load_vehicle("spherical"), sway=sway)
    ours, oracle = Prediction(model, PERIOD_S, HORIZON, BLOCKS), NumpyPrediction(model, PERIOD_S, HORIZON, BLOCKS)
    state = tuple((0.3 * random.normal(size=11)).tolist())
    lacking, gamma = random.normal(size=3), 0.05 * random.normal(size=4)
    ours.eta[:], ours.nu[:] = 0.05 * random.normal(size=(2, HORIZON + 1, 4)).cumsum(axis=1)
    if seed == 0:  # at rest: drag has no direction
        ours.nu[:] = 0.0
    for k in (0, 1):
        oracle.eta[k], oracle.nu[k] = ours.eta[:, 2 * k : 2 * k + 2], ours.nu[:, 2 * k : 2 * k + 2]
    linearise(ours, state, lacking, gamma, 0.03 + 0.02j)
    oracle.linearise(state, lacking, gamma, 0.03 + 0.02j)
    return ours, oracle


@pytest.mark.parametrize("sway", [True, False])
@pytest.mark.parametrize("seed", range(6))
def test_responses_are_those_of_the_banded_solve(seed: int, sway: bool) -> None:
    ours, oracle = both(seed, sway)
    for columns, rows in (
        (ours.x, oracle.position.real), (ours.y, oracle.position.imag), (ours.z, oracle.heave), (ours.yaw, oracle.yaw)
    ):  # fmt: skip
        assert columns == pytest.approx(rows.T, abs=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_the_plan_is_the_sum_of_the_responses(seed: int) -> None:
    ours, oracle = both(seed)
    blocks = np.random.default_rng(seed).normal(size=3 * N)
    eta = ours.follow_plan(blocks)
    oracle.set_nominal(blocks[: 2 * N], blocks[2 * N :])
    assert eta == pytest.approx(oracle.poses(), abs=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_the_cost_is_that_of_gram_matrices(seed: int) -> None:
    random, model = np.random.default_rng(seed), Model(load_vehicle("spherical"))
    ours, oracle = Prediction(model, PERIOD_S, HORIZON, BLOCKS), NumpyPrediction(model, PERIOD_S, HORIZON, BLOCKS)
    state, asked, delivered, gamma = (0.3 * random.normal(size=size) for size in (11, 3, 3, 4))
    reference, weight, r = random.normal(size=(HORIZON + 1, 4)), random.uniform(size=4), random.uniform(size=3)
    p, q, smooth = np.zeros((3 * N, 3 * N)), np.zeros(3 * N), np.eye(3 * N)
    ours.restart(state)
    oracle.restart(tuple(state))
    ours.linearise_and_condense(state, asked, delivered, gamma, 0.03j, reference, weight, smooth, r, p, q)
    oracle.linearise(tuple(state), delivered - asked, gamma, 0.03j)
    expected_p, expected_q = numpy_cost(oracle, reference, weight)
    expected_q[[0, 2 * N, N]] -= r * asked  # the first change counts from what was asked for
    assert p - smooth == pytest.approx(expected_p, abs=1e-9) and q == pytest.approx(expected_q, abs=1e-9)


def test_half_space_rows_say_the_same_of_a_plan_as_its_places() -> None:
    ours, _ = both(3)
    blocks, node = np.random.default_rng(3).normal(size=3 * N), np.array([5, 17, 30])
    normal, offset, give = np.exp(1j * np.array([0.3, 2.0, -1.0])), np.array([0.1, -0.4, 2.0]), np.array([1.0, 0.5, 0.1])
    a, lower = np.ones((5, 3 * N + 1)), np.zeros(5)
    ours.half_space_rows(HalfSpaces(node, normal, offset, give), a, lower)
    assert not a[3:, :-1].any() and np.all(np.isneginf(lower[3:]))  # rows that are left
    assert not a[:, 2 * N : -1].any() and np.array_equal(a[:3, -1], give)  # heave, and the slack
    eta = ours.follow_plan(blocks)
    places = eta[node, 0] * normal.real + eta[node, 1] * normal.imag
    assert a[:3, :-1] @ blocks - lower[:3] == pytest.approx(places - offset, abs=1e-9)

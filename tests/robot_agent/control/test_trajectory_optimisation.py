"""The optimal-control problem against an independent solver, the model it is about, and the conditions of a least."""

import math

import numpy as np
import pytest
from scipy.optimize import minimize

from robot_agent.control.trajectory_optimisation import (
    advance_node,
    fly,
    guess,
    least_in_box,
    motion,
    optimise,
    slopes,
)
from robot_agent.vehicle.dynamics import Model, State
from wire.config.vehicle import load_vehicle
from wire.frames import Array

MODEL = Model(load_vehicle("spherical"), lag=False)
WATER, GAMMA = 0.01 - 0.02j, np.array([0.0, 0.02, 0.0, 0.0])
LIMIT = np.array([[6.0, 0.5], [6.0, 2.0]])
WEIGHT = np.array([1.0, 1.0, 3e-4, 3e-4, 2e-5, 3.2e-3, 1.0, 0.02, 1.0, 0.02, 1e-3])
NODES, H = 24, 0.1
OFF = np.array([0.12, -0.08, 1.2, 0.05, -0.02, 0.3, 0.4, -0.1])  # a start: 0.14 m off, turned, and under way


class Problem:
    """A robot off a straight path at 3 cm/s, with its workspaces."""

    def __init__(self, start: Array = OFF, limit: Array = LIMIT, nodes: int = NODES) -> None:
        self.nodes, self.limit = nodes, limit
        time_s = H * np.arange(nodes + 1)
        zero = np.zeros(nodes + 1)
        self.goals = np.column_stack([0.03 * time_s, zero, zero + 0.2, zero + 0.03, zero])
        self.planned = 0.5 * np.sin(time_s[:-1])
        self.states, self.inputs = np.zeros((nodes + 1, 8)), np.zeros((nodes, 2))
        self.states[0] = start
        self.new = np.zeros((nodes + 1, 8)), np.zeros((nodes, 2))
        self.gains, self.change = np.zeros((nodes, 2, 8)), np.zeros((nodes, 2))

    def cost(self, inputs: Array) -> float:
        """Cost of given inputs, as they are within the bounds."""
        self.gains[:] = 0.0
        return fly(
            MODEL.coefficients, 1.0, WATER, GAMMA, H, self.goals, self.planned, WEIGHT, self.limit, self.states,
            inputs.reshape(-1, 2).copy(), self.gains, self.change, 0.0, *self.new,
        )  # fmt: skip

    def solve(self, ahead: float = 1.0, iterations: int = 100) -> float:
        """The cost of the flight found, which is left in `states` and `inputs`."""
        guess(MODEL.coefficients, 1.0, WATER, GAMMA, H, self.goals, self.limit, ahead, self.states, self.inputs)
        return optimise(
            MODEL.coefficients, 1.0, WATER, GAMMA, H, self.goals, self.planned, WEIGHT, self.limit, iterations, self.states,
            self.inputs, np.array([10.0]), np.empty((3, 8, 8)), self.gains, self.change, *self.new,
        )  # fmt: skip


def test_a_node_is_the_vehicles_model_in_fine_steps() -> None:
    out = np.empty(8)
    advance_node(MODEL.coefficients, 1.0, WATER, GAMMA, H, OFF, 2.0, -0.5, out)
    state: State = (OFF[0], OFF[1], 0.0, OFF[2], OFF[3], OFF[4], 0.0, OFF[5], 0.0, 0.0, 0.0)
    fine = 1000
    for k in range(fine):
        passed_s = (k + 0.5) * H / fine
        state = MODEL.advance(state, GAMMA.tolist(), (OFF[6] + 2.0 * passed_s, 0.0, OFF[7] - 0.5 * passed_s), H / fine)
    x, y, _, yaw, u, v, _, r, *_ = state
    there = np.array([x + WATER.real * H, y + WATER.imag * H, yaw, u, v, r, OFF[6] + 0.2, OFF[7] - 0.05])
    assert out == pytest.approx(there, abs=6e-4)


def test_slopes_are_those_of_finite_differences() -> None:
    random = np.random.default_rng(3)
    for point in random.normal(size=(10, 6)):
        found, differences = np.empty((6, 6)), np.empty((6, 6))
        slopes(MODEL.coefficients, 1.0, point[0], point[1], point[2], point[3], found)
        for j, step in enumerate(1e-6 * np.eye(6)):
            after, before = (
                np.array(motion(MODEL.coefficients, 1.0, WATER, GAMMA, *(point + way * step).tolist())) for way in (1, -1)
            )
            differences[:, j] = (after - before) / 2e-6
        assert found == pytest.approx(differences, abs=1e-7)


def test_the_least_in_a_box_is_below_every_other_point_of_it() -> None:
    random = np.random.default_rng(5)
    for _ in range(50):
        root = random.normal(size=(2, 2))
        q, g = root @ root.T + 0.1 * np.eye(2), 2.0 * random.normal(size=2)
        low, high = -random.uniform(0, 1, 2), random.uniform(0, 1, 2)
        box = low[0], high[0], low[1], high[1]
        d = np.array(least_in_box(q[0, 0], q[0, 1], q[1, 1], g[0], g[1], *box))
        assert np.all(d >= low) and np.all(d <= high)
        others = low + (high - low) * np.stack(np.meshgrid(*2 * [np.linspace(0, 1, 30)]), axis=-1).reshape(-1, 2)
        values = 0.5 * np.einsum("ki,ij,kj->k", others, q, others) + others @ g
        assert 0.5 * d @ q @ d + g @ d <= values.min() + 1e-12


@pytest.mark.parametrize("ahead", [1.0, -1.0])
def test_the_flight_found_costs_what_an_independent_solver_finds_from_the_same_guess(ahead: float) -> None:
    """SciPy's L-BFGS-B with slopes by finite differences; the problem has other least ones, too."""
    problem = Problem()
    guessed = problem.solve(ahead, iterations=0)
    rates = np.tile(LIMIT[1], NODES)
    bounds = list(zip(-rates, rates, strict=True))
    other = minimize(problem.cost, problem.inputs.ravel(), method="L-BFGS-B", bounds=bounds)
    found = problem.solve(ahead)
    assert found < 0.9 * guessed
    assert found == pytest.approx(other.fun, rel=1e-3)


def test_slopes_vanish_where_no_bound_holds_and_push_against_those_that_do() -> None:
    tight = np.array([[6.0, 0.5], [1.0, 0.3]])
    problem = Problem(limit=tight)
    problem.solve()
    best = problem.inputs.copy()
    slope = np.empty_like(best)
    for k in range(NODES):
        for c in range(2):
            step = np.zeros_like(best)
            step[k, c] = 1e-4
            inwards = best - np.sign(best) * step, best - 2.0 * np.sign(best) * step  # the bounds would hold the other side
            here = problem.cost(best)
            slope[k, c] = (
                -np.sign(best[k, c]) * (4.0 * problem.cost(inwards[0]) - problem.cost(inwards[1]) - 3.0 * here) / 2e-4
            )
    held = np.abs(best) > tight[1] - 1e-9
    assert held.sum() > 5
    scale = np.abs(slope[held]).max()
    assert np.all(slope[held] * np.sign(best[held]) < 1e-2 * scale)
    assert np.all(np.abs(slope[~held]) < 1e-2 * scale)


def test_thrusts_and_their_rates_keep_to_their_limits() -> None:
    weak = np.array([[0.8, 0.1], [6.0, 2.0]])
    problem = Problem(limit=weak, start=np.array([0.3, 0.3, -2.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    problem.solve()
    assert np.abs(problem.states[:, 6:]).max(axis=0) == pytest.approx(weak[0])  # both are used up
    assert np.all(np.abs(problem.inputs) <= weak[1] + 1e-9)


def test_iterations_never_cost_more_and_a_cost_that_is_no_number_is_told() -> None:
    costs = [Problem().solve(iterations=n) for n in (0, 1, 2, 4, 8, 16)]
    assert costs == sorted(costs, reverse=True)
    problem = Problem()
    problem.goals[5, 0] = math.nan
    assert not math.isfinite(problem.solve())

"""The article's linear prediction: its responses, cost and plan against a plain simulation of the linearised equations."""

import math

import numpy as np
import pytest

from robot_agent.control.linearisation import (
    ControlTask,
    Cost,
    LinearModel,
    Responses,
    block_of,
    follow_plan,
    linearise_and_condense,
    make_linear_model,
    make_responses,
)
from robot_agent.vehicle.dynamics import Model
from shoal.config.vehicle import load_vehicle
from shoal.frames import Array

PERIOD_S, HORIZON, BLOCKS = 0.05, 30, (1, 1, 2, 3, 4)
N = len(BLOCKS)
MODEL = Model(load_vehicle("spherical"), sway=False, lag=False)


def task(seed: int) -> ControlTask:
    """A state, and numbers of all kinds. With seed 0 the robot is at rest."""
    random = np.random.default_rng(seed)
    state = 0.3 * random.normal(size=12) * [1, 1, 1, 5, seed > 0, 0, seed > 0, seed > 0, 0, 0, 0, 0]
    asked, delivered, gamma = (0.3 * random.normal(size=size) for size in (3, 3, 4))
    return ControlTask(state, asked, delivered, gamma, random.normal(size=(HORIZON + 1, 4)), random.uniform(size=4))


def linearised(now: ControlTask, r: Array | None = None) -> tuple[LinearModel, Responses, Cost]:
    model, responses = make_linear_model(MODEL, PERIOD_S, HORIZON, BLOCKS), make_responses(HORIZON + 1, N)
    smooth = np.eye(3 * N + 1)
    cost = Cost(smooth, np.zeros(3) if r is None else r, np.zeros((3 * N + 1, 3 * N + 1)), np.zeros(3 * N + 1))
    linearise_and_condense(model, now, responses, cost)
    return model, responses, cost


def simulated(now: ControlTask, blocks: Array) -> Array:
    """Poses (nodes, 4) under blocks of surge, yaw and heave, by steps of the equations linearised around the state."""
    x, y, z, yaw0, *_ = now.state.tolist()
    velocity = now.state[[4, 6, 7]].copy()
    u0, w0, r0 = velocity.tolist()
    lacking, yaw, poses = now.delivered - now.asked, yaw0, [now.state[:4].copy()]
    for block in block_of(BLOCKS, HORIZON):
        wrench = blocks[[block, 2 * N + block, N + block]] + lacking
        before, before_yaw = velocity.copy(), yaw
        for i, (axis, speed) in enumerate(((0, u0), (2, w0), (3, r0))):
            mass, linear, quadratic = MODEL.nominal[:, axis]
            slope = (linear + 2.0 * quadratic * abs(speed)) / mass
            push = (wrench[i] + quadratic * abs(speed) * speed) / mass + now.gamma[axis]  # what drag's tangent lacks
            velocity[i] = velocity[i] * math.exp(-slope * PERIOD_S) - math.expm1(-slope * PERIOD_S) / slope * push
        z += 0.5 * PERIOD_S * (before[1] + velocity[1])
        yaw += 0.5 * PERIOD_S * (before[2] + velocity[2])
        for u, heading in ((before[0], before_yaw), (velocity[0], yaw)):
            rate = complex(math.cos(yaw0), math.sin(yaw0)) * (u + 1j * u0 * (heading - yaw0))
            x, y = x + 0.5 * PERIOD_S * rate.real, y + 0.5 * PERIOD_S * rate.imag
        poses.append(np.array((x, y, z, yaw)))
    return np.array(poses)


@pytest.mark.parametrize("seed", range(6))
def test_the_plan_is_that_of_the_linearised_equations(seed: int) -> None:
    now, blocks, eta = task(seed), np.random.default_rng(seed + 100).normal(size=3 * N), np.empty((HORIZON + 1, 4))
    _, responses, _ = linearised(now)
    follow_plan(blocks, responses, eta)
    assert eta == pytest.approx(simulated(now, blocks), abs=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_the_cost_is_the_sum_of_squares(seed: int) -> None:
    """1/2 b'Pb + q'b, but for a constant, for blocks drawn at random."""
    now, random = task(seed), np.random.default_rng(seed + 100)
    r = random.uniform(size=3)
    _, _, cost = linearised(now, r)
    assert np.array_equal(cost.p, cost.p.T) and cost.p[-1, -1] == 1.0 and not cost.p[-1, :-1].any() and cost.q[-1] == 0.0

    def squares(b: Array) -> float:
        error = simulated(now, b)[1:] - now.reference[1:]
        first = b[[0, 2 * N, N]]  # the first change counts from what was asked for
        return float(0.5 * (now.weight * error**2).sum() + 0.5 * (b**2).sum() - (r * now.asked * first).sum())

    nothing = squares(np.zeros(3 * N))
    for _ in range(4):
        b = random.normal(size=3 * N)
        ours = 0.5 * b @ cost.p[:-1, :-1] @ b + cost.q[:-1] @ b
        assert ours == pytest.approx(squares(b) - nothing, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("channel", range(3))
def test_sensitivities_are_those_of_the_nonlinear_model_at_first(channel: int) -> None:
    """Over a quarter of a second; later the motion is no longer that around which it is linearised."""
    now = task(3)
    _, responses, _ = linearised(now)
    steps, nudge = 5, (0.02, 0.001, 0.02)[channel]  # surge, yaw, heave
    poses = []
    for sign in (1.0, -1.0):
        wrench = [0.0, 0.0, 0.0]
        wrench[(0, 2, 1)[channel]] = sign * nudge
        state = tuple(now.state.tolist())
        for _ in range(steps):
            state = MODEL.advance(state, tuple(now.gamma.tolist()), tuple(wrench + now.delivered - now.asked), PERIOD_S)
        poses.append(np.array(state[:4]))
    true, eta = (poses[0] - poses[1]) / (2.0 * nudge), []
    acting = block_of(BLOCKS, steps)
    for sign in (1.0, 0.0):
        b = np.zeros(3 * N)
        b[channel * N + np.unique(acting)] = sign
        rows = np.empty((HORIZON + 1, 4))
        follow_plan(b, responses, rows)
        eta.append(rows[steps])
    assert eta[0] - eta[1] == pytest.approx(true, abs=0.1 * np.abs(true).max())

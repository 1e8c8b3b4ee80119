"""The terminal cost against an independent Riccati solver and the quadratic form that it stands for; the error that fades."""

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are

from robot_agent.control.short_horizon import (
    FADING_M,
    STEP_S,
    STEPS,
    TURN_IN_M,
    add_axis,
    cost_to_go,
    let_error_fade,
    shortness,
)
from tests.robot_agent.paths import ROWS
from wire.config.controller import MpcConfig
from wire.config.vehicle import load_vehicle
from wire.frames import Array

VEHICLE = load_vehicle("spherical")
TRIANGLE = np.triu_indices(3)
NODES = STEP_S / 0.05


def riccati(mass: float, drag: float, q: float, r: float) -> Array:
    """Cost (3, 3) of ever more steps, from SciPy: after the change, the errors at the end of each step."""
    motion = expm(STEP_S * np.array([[0.0, 1.0, 0.0], [0.0, -drag / mass, 1.0 / mass], [0.0, 0.0, 0.0]]))
    weight = np.diag([q, 0.0, 0.0])
    return np.asarray(solve_discrete_are(motion, motion[:, 2:], weight, np.array([[r]]))) - weight


@pytest.mark.parametrize(("axis", "r"), [(0, 0.05), (2, 0.05), (3, 8.0)])
def test_the_cost_to_go_is_that_of_the_riccati_equation(axis: int, r: float) -> None:
    """STEPS steps are as good as all. Places advance by the trapezoidal rule here, exactly there: 3 %."""
    mass, drag = float(VEHICLE.inertia[axis]), VEHICLE.drag.linear[axis]
    for q in (NODES * MpcConfig().q[axis], 3.0 * NODES):
        found = np.array(cost_to_go(mass, drag, q, r, STEP_S, STEPS))
        exact = riccati(mass, drag, q, r)
        assert found == pytest.approx(exact[TRIANGLE], rel=0.03)
        assert found == pytest.approx(cost_to_go(mass, drag, q, r, STEP_S, 20 * STEPS), rel=0.01)


def test_the_quadratic_form_of_the_errors_is_added() -> None:
    """For any blocks: half of share s' P s, but for the constant; blocks of other axes are left alone."""
    random, first, share = np.random.default_rng(0), 3, 0.6
    place, velocity = random.normal(size=(2, 7))  # six blocks, as surge has: its own three and those of yaw
    goals: tuple[float, float, float] = tuple(random.normal(size=3).tolist())
    p, q = np.zeros((9, 9)), np.zeros(9)
    add_axis(12.0, 3.0, 4.0, 0.05, share, place, velocity, *goals, first, p, q)
    cost = np.zeros((3, 3))
    cost[TRIANGLE] = cost_to_go(12.0, 3.0, 4.0, 0.05, STEP_S, STEPS)
    cost += np.triu(cost, 1).T

    def form(blocks: Array) -> float:
        own = blocks[first:]
        error = np.array([place[:6] @ own + place[6], velocity[:6] @ own + velocity[6], own[2]]) - np.array(goals)
        return share * float(error @ cost @ error)

    for blocks in random.normal(size=(5, 9)):
        assert 0.5 * blocks @ p @ blocks + q @ blocks == pytest.approx(0.5 * (form(blocks) - form(np.zeros(9))))
    assert p == pytest.approx(p.T)
    assert not p[:first].any() and not q[:first].any()


def test_only_short_horizons_have_it() -> None:
    assert [shortness(horizon_s) for horizon_s in (0.5, 2.0, 2.25, 2.5, 5.0)] == [1.0, 1.0, 0.5, 0.0, 0.0]


@pytest.mark.parametrize("heading", [0.3, 1.3, -2.0])
def test_an_error_across_the_path_fades_from_the_plan_along_the_paths_normals(heading: float) -> None:
    """The same with complex numbers. On the path, or with the heading along it, nothing moves."""
    random, rate, period_s, speed = np.random.default_rng(4), 0.3, 0.05, 0.1
    path = 0.1 * random.normal(size=(ROWS, 4))
    velocity = np.tile([speed, 0.0, 0.0, 0.0], (ROWS, 1))
    command = path.copy()
    command[:, 3] = heading
    place, tangent, normal = path @ (1.0, 1j, 0.0, 0.0), np.exp(1j * path[0, 3]), 1j * np.exp(1j * path[:, 3])

    def faded(off: complex, share: float, start: Array) -> Array:
        at, moved = place[0] + off * tangent, start.copy()
        let_error_fade(path, velocity, np.array([at.real, at.imag, 0.0, 0.0]), rate, period_s, share, moved)
        return moved

    found = faded(0.04 + 0.11j, 0.7, command)
    left = (
        0.7 * np.imag(np.exp(1j * heading) / tangent) ** 2 * np.exp(-(rate + speed / TURN_IN_M) * period_s * np.arange(ROWS))
    )
    assert found[1:] @ (1.0, 1j, 0.0, 0.0) == pytest.approx((place + 0.11 * left * normal)[1:], abs=1e-12)
    assert np.array_equal(found[0], command[0]) and np.array_equal(found[:, 2:], command[:, 2:])
    far = faded(5.0j, 0.7, command)
    assert far[1:] @ (1.0, 1j, 0.0, 0.0) == pytest.approx((place + FADING_M * left * normal)[1:], abs=1e-12)
    assert np.array_equal(faded(0.11j, 0.7, path), path)  # the heading is the tangent

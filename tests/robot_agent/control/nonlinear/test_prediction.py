"""The motion over the horizon against an integrator of the equations, and its slopes against finite differences."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from robot_agent.control.nonlinear.prediction import Dynamics, Start, Surroundings, fly, make_flight, make_grid, move_on
from shoal.frames import Array
from tests.robot_agent.control.nonlinear.plants import ALL_AXES, DYNAMICS, HULL, WATER, grid_of

SCALE = np.array([2.0, 1.0, 0.2])


def drawn(seed: int, axes: tuple[int, ...]) -> tuple[Start, Array]:
    """A random start, and random commands at the nodes."""
    random = np.random.default_rng(seed)
    state = np.array([0.3, 0.3, 2.0, 0.2, 0.1, 0.5, 1.0, 1.0, 0.1]) * random.normal(size=9)
    if 1 not in axes:
        state[7] = 0.0
    if 2 not in axes:
        state[8] = 0.0
    scale = SCALE[list(axes)]
    return Start(state, scale * random.normal(size=len(axes))), scale * random.normal(size=(20, len(axes)))


def exact(dynamics: Dynamics, start: Start, commands: Array, time_s: Array, axes: tuple[int, ...]) -> Array:
    """States at the nodes by the equations of the module's docstring."""
    h, w = dynamics
    table = np.vstack([start.command, commands])

    def rates(t: float, s: Array) -> list[float]:
        _, _, yaw, u, v, r, x_n, y_n, n_nm = s
        command = np.zeros(3)
        for i, axis in enumerate(axes):
            command[axis] = np.interp(t, time_s, table[:, i])
        rotation = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        over_ground = rotation @ [u, v] + [w.current_x_mps, w.current_y_mps]
        speed = math.hypot(u, v)
        u_dot = (x_n - (h.linear_u + h.quadratic_u * speed) * u + h.mass_v * v * r) / h.mass_u
        v_dot = (y_n - (h.linear_v + h.quadratic_v * speed) * v - h.mass_u * u * r) / h.mass_v
        r_dot = (n_nm - (h.linear_r + h.quadratic_r * abs(r)) * r + (h.mass_u - h.mass_v) * u * v) / h.inertia
        lagging = (command - [x_n, y_n, n_nm]) / h.lag_s
        return [*over_ground, r, u_dot + w.own_u, h.sway * (v_dot + w.own_v), r_dot + w.own_r, *lagging]

    solution = solve_ivp(rates, (0.0, time_s[-1]), start.state, t_eval=time_s[1:], rtol=1e-9, atol=1e-10, max_step=0.05)
    return np.asarray(solution.y.T)


@pytest.mark.parametrize("axes", ALL_AXES)
def test_prediction_agrees_with_another_integrator(axes: tuple[int, ...]) -> None:
    """Second order: four times nearer with half the step, and within millimetres at the step that is flown."""
    grid, errors = grid_of(axes), []
    start, commands = drawn(1, axes)
    truth = exact(DYNAMICS, start, commands, grid.time_s, axes)
    for step_s in (0.1, 0.05, 0.025):
        flight = make_flight(len(axes))
        flight.command[:] = commands
        fly(Dynamics(HULL._replace(step_s=step_s), WATER), grid, start, flight)
        errors.append(float(np.abs(flight.state - truth).max()))
    assert errors[0] < 0.02
    assert errors[2] < errors[0] / 10.0


@pytest.mark.parametrize("axes", ALL_AXES)
def test_slopes_agree_with_finite_differences(axes: tuple[int, ...]) -> None:
    grid, (start, commands) = grid_of(axes), drawn(2, axes)
    flight, moved = make_flight(len(axes)), make_flight(len(axes))
    flight.command[:] = commands
    fly(DYNAMICS, grid, start, flight)
    for node in range(0, 20, 3):
        for axis in range(len(axes)):
            ends = []
            for change in (1e-6, -1e-6):
                moved.command[:] = commands
                moved.command[node, axis] += change
                fly(DYNAMICS, grid, start, moved)
                ends.append(moved.state[:, :6].copy())
            slope = (ends[0] - ends[1]) / 2e-6
            assert np.abs(flight.slope[:, :, len(axes) * node + axis] - slope).max() < 1e-6 * (1.0 + np.abs(slope).max())


def test_grid_reaches_the_horizon_and_does_not_depend_on_the_rate() -> None:
    for horizon_s in (6.0, 7.3, 12.0):
        time_s = make_grid(horizon_s, (0, 2)).time_s
        assert time_s[1] == pytest.approx(0.1) and time_s[-1] == pytest.approx(horizon_s)
        assert np.all(np.diff(time_s, 2) > 0.0)


def test_plan_moved_on_is_the_same_plan_later() -> None:
    grid, (_, commands) = grid_of((0, 2)), drawn(3, (0, 2))
    for by_s in (0.02, 0.1, 0.125):
        flight = make_flight(2)
        flight.command[:] = commands
        move_on(grid, by_s, flight)
        for i in range(2):
            wanted = np.interp(grid.time_s[1:] + by_s, grid.time_s[1:], commands[:, i])
            assert np.allclose(flight.command[:, i], wanted, atol=1e-12)


def test_a_robot_without_sway_never_slides() -> None:
    grid, (start, commands) = grid_of((0, 2)), drawn(4, (0, 2))
    start.state[4] = 0.0
    flight = make_flight(2)
    flight.command[:] = commands
    water = Surroundings(0.0, 0.0, 0.0, 0.5, 0.0)
    fly(Dynamics(HULL._replace(sway=0.0), water), grid, start, flight)
    assert np.all(flight.state[:, 4] == 0.0)

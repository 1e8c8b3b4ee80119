"""Inputs of a controller, drawn by Hypothesis, and the check that every control law passes."""

import dataclasses
import math

import numpy as np
from hypothesis import strategies as st

from robot_agent.control.controller import ControlOutput
from robot_agent.guidance.formation import Neighbour
from robot_agent.guidance.reference import Follow
from robot_agent.vehicle.estimate import PoseMeasurement, StateMeasurement
from shoal.config.experiment import load_experiment
from shoal.config.vehicle import Vehicle
from shoal.messages.messages import Plan, Solve, Trajectory, required
from tests.robot_agent.paths import circle

POOL = load_experiment("pool")
ARTICLE = load_experiment("pool", ["controller.law=eso-mpc-article"])
VEHICLE = POOL.vehicle
STEP_NS = 50_000_000


def check(output: ControlOutput, vehicle: Vehicle = VEHICLE) -> None:
    """Assert the properties of every output, for any input."""
    limits = vehicle.limits
    assert np.isfinite(output.plan_eta).all() and np.isfinite(output.plan_reference).all() and output.is_finite
    if output.control is not None:
        assert np.all(np.abs(output.control.wrench) <= np.array(limits.wrench) + 1e-9)
    assert len(output.pulse_us) == 8
    if vehicle.legs is not None:
        assert all(1100 <= p <= 1900 for p in output.pulse_us[:4]) and all(1000 <= p <= 2000 for p in output.pulse_us[4:])
    else:
        assert all(1112 <= p <= 1888 for p in output.pulse_us)
    if output.solve in (Solve.NONE, Solve.FAILED):
        assert output.pulse_us == (1500,) * 8
    else:
        assert np.all(np.abs(required(output.control).wrench_step) <= np.array(limits.wrench_step(0.05)) + 1e-9)


def pool_circle(x: float) -> Trajectory:
    """The pool scene's path for a node at (x, 0)."""
    path = circle(0.225, 100.0)
    return dataclasses.replace(path, eta=path.eta + np.array([x, 0.0, 0.0, 0.0]))


def at(k: int, x: float = 0.625, y: float = 0.0, yaw: float = math.pi / 2) -> StateMeasurement:
    return StateMeasurement(PoseMeasurement(k * STEP_NS - 40_000_000, x, y, yaw), 0.3, 0.0)


GOAL = Follow(pool_circle(0.4), 0.0)
numbers = st.floats(allow_nan=True, allow_infinity=True) | st.floats(-3, 3)
sightings = st.builds(PoseMeasurement, st.integers(-(10**9), 3 * 10**9), numbers, numbers, numbers)
measurements = st.builds(
    StateMeasurement,
    st.none() | sightings,
    st.none() | numbers,
    st.none() | numbers,
    st.none() | st.integers(-(10**9), 3 * 10**9),
)


def some_plan(values: list[float], period_s: float) -> Plan:
    rows = np.array(values[: len(values) // 4 * 4]).reshape(-1, 4)
    return Plan(period_s, rows, rows * 0.9, values[0], False)


plans = st.builds(some_plan, st.lists(numbers, min_size=4, max_size=40), st.floats(-1, 1))
neighbours = st.lists(st.builds(Neighbour, st.just(2), st.integers(-(10**9), 10**10), plans, st.booleans()), max_size=3)
goals = st.none() | st.just(GOAL) | st.builds(Follow, st.just(GOAL.trajectory), st.floats(-100, 1000))

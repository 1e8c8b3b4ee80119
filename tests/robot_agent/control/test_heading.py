"""The linear laws' reference heading: along the force that the reference needs, ahead or astern, and no faster than it may."""

import math

import numpy as np
import pytest

from robot_agent.control.heading import DAMPING, HOLD_RADPS, PATH_RADPS, HeadingReference
from robot_agent.guidance.reference import Follow, Hold, Reference, ReferenceSampler
from robot_agent.vehicle.dynamics import Model
from robot_agent.vehicle.estimate import Observation
from shoal.config.vehicle import load_vehicle
from shoal.frames import Array, wrap
from shoal.messages.messages import Estimate
from tests.robot_agent.paths import PERIOD_S, circle

VEHICLE = load_vehicle("spherical")
OFFSETS = 0.05 + PERIOD_S * np.arange(51, dtype=np.float64)
REST, GAIN = np.zeros(4), 0.1


def heading() -> HeadingReference:
    return HeadingReference(Model(VEHICLE), PERIOD_S, GAIN)


def estimate(eta: Array, nu: Array = REST, gamma: Array = REST, current: complex = 0j) -> Observation:
    return Observation(Estimate(eta, nu, gamma), gamma, current, np.zeros(12), 0.0, 0.0)


def line(speed_mps: float, yaw_rad: float = 0.0) -> Reference:
    """A path's first row, along a heading."""
    direction = np.array([math.cos(yaw_rad), math.sin(yaw_rad), 0.0, 0.0])
    return Reference(np.array([[0.0, 0.0, 0.0, yaw_rad]]), speed_mps * direction[None], np.zeros((1, 4)))


def settled(path: Reference, now: Observation, is_resting: bool = False, steps: int = 2000) -> float:
    """The heading after a long time, rad."""
    one = heading()
    for _ in range(steps):
        one.turn(path, now, is_resting)
    return float(path.eta[0, 3] + one.off_rad)


@pytest.mark.parametrize("current", [0.05j, -0.03 + 0.06j, 0.08 - 0.02j])
def test_in_a_current_it_points_where_thrust_alone_keeps_the_robot_on_its_line(current: complex) -> None:
    """Through the water the robot runs straight: its heading is that of its velocity through the water."""
    yaw_rad = settled(line(0.2), estimate(REST, np.array([0.2, 0.0, 0.0, 0.0]), current=current))
    assert yaw_rad == pytest.approx(np.angle(0.2 - current), abs=1e-3)


@pytest.mark.parametrize("yaw", [0.0, 0.7, 3.0])
def test_on_a_straight_path_it_is_the_tangent(yaw: float) -> None:
    now = estimate(np.array([0.0, 0.0, 0.0, yaw]), np.array([0.2, 0.0, 0.0, 0.0]))
    assert settled(line(0.2, yaw), now) == pytest.approx(yaw, abs=1e-9)


def test_on_a_circle_it_holds_the_crab_angle_of_the_plant() -> None:
    """Steady turn: m u r = d(V) v, so tan b = m r / d(V) with the nose turned inwards. At 0.014 m/s that is 0.25 rad."""
    speed, rate = 0.225 * 0.02 * np.pi, 0.02 * np.pi
    path = ReferenceSampler(OFFSETS).sample(Follow(circle(0.225, 100.0), 10.0))
    crab = np.arctan(12.0 * rate / (3.0 + 20.0 * speed))
    eta = np.array([*path.eta[0, :3], path.eta[0, 3] + crab])
    nu = np.array([speed * np.cos(crab), -speed * np.sin(crab), 0.0, rate])
    assert settled(path, estimate(eta, nu)) - path.eta[0, 3] == pytest.approx(crab, abs=1e-3)
    assert 0.2 < crab < 0.25


@pytest.mark.parametrize(("x_m", "y_m"), [(0.0, 0.05), (0.0, -0.05), (0.3, 0.05), (-0.2, 0.1)])
def test_off_the_path_it_is_the_line_of_the_needed_force(x_m: float, y_m: float) -> None:
    """Ahead or astern, whichever is nearer. The gain is that of a robot at rest, and 2.6 times as large at 3 N of drag."""
    speed_mps, mass = 0.1, VEHICLE.mass.surge_kg
    now = estimate(np.array([x_m, y_m, 0.0, 0.0]), np.array([speed_mps - 0.01, 0.0, 0.0, 0.0]))
    drag = VEHICLE.drag.linear[1] + VEHICLE.drag.quadratic[1] * speed_mps
    damp = 2.0 * DAMPING * math.sqrt(GAIN)
    needed_n = drag * speed_mps
    pace = 1.0 + 0.6 * needed_n**2 / (needed_n**2 + 0.2**2)
    force = needed_n + mass * (-GAIN * pace**2 * (x_m + 1j * y_m) + pace * damp * 0.01)
    yaw = settled(line(speed_mps), now)
    assert wrap(2.0 * (yaw - float(np.angle(force)))) == pytest.approx(0.0, abs=1e-3) and abs(yaw) <= 0.5 * np.pi + 1e-6


def test_a_side_force_is_leant_into_and_a_surge_force_turns_nothing() -> None:
    """Thrust's side part balances Gamma: F sin b = m gamma with F cos b = drag. Resting, all of it counts."""
    moving = np.array([0.05, 0.0, 0.0, 0.0])
    drag = (3.0 + 20.0 * 0.05) * 0.05
    aside, ahead = (np.array([u, v, 0.0, 0.0]) for u, v in ((0.0, 0.002), (0.02, 0.0)))
    assert settled(line(0.05), estimate(REST, moving, aside)) == pytest.approx(-np.arctan(12 * 0.002 / drag), abs=1e-3)
    assert settled(line(0.05), estimate(REST, moving, ahead)) == pytest.approx(0.0, abs=1e-9)


def test_holding_station_in_a_current_it_turns_into_it_and_slowly() -> None:
    one, before = heading(), 0.0
    path = ReferenceSampler(OFFSETS).sample(Hold(REST))
    for _ in range(600):
        one.turn(path, estimate(REST, current=0.05j), True)
        assert abs(one.off_rad - before) <= HOLD_RADPS * PERIOD_S + 1e-12
        before = one.off_rad
    assert abs(np.sin(before)) == pytest.approx(1.0, abs=0.01)  # ahead or astern


@pytest.mark.parametrize("is_resting", [True, False])
def test_noise_on_a_robot_at_rest_turns_it_little(is_resting: bool) -> None:
    random, one, turns_rad = np.random.default_rng(1), heading(), []
    for _ in range(400):
        eta, nu = np.array([*random.normal(0, 0.001, 2), 0, 0.4]), np.array([*random.normal(0, 0.002, 2), 0, 0])
        turns_rad.append(one.turn(line(0.0, 0.4), estimate(eta, nu), is_resting))
    assert np.abs(turns_rad).max() < 0.4 and np.std(turns_rad) < 0.2


def test_the_heading_never_jumps() -> None:
    """A robot carried around its reference in every direction, thrust reversals included."""
    one, before = heading(), 0.0
    for k in range(3000):
        eta = np.array([0.2 * np.cos(0.004 * k), 0.2 * np.sin(0.004 * k), 0.0, 0.0])
        yaw_rad = one.turn(line(0.014), estimate(eta, np.array([0.014, 0.0, 0.0, 0.0])), False)
        assert abs(yaw_rad - before) <= PATH_RADPS * PERIOD_S + 1e-12
        before = yaw_rad

"""Allocation to thrusters that do not turn: against bounded least squares, against a linear program, and against the plant."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog, lsq_linear

from robot_agent.vehicle.fixed_thrusters import make_allocator
from shoal.config.experiment import load_experiment
from shoal.config.vehicle import Vehicle, load_vehicle
from shoal.frames import Array
from sim_bridge.plant.fleet import Plant

VEHICLE = load_vehicle("vectored")
ALLOCATOR = make_allocator(VEHICLE)
MOST_N = 20.0  # of a thruster, both ways
LIMITS = np.array(VEHICLE.limits.wrench)


def wrench_of(vehicle: Vehicle, force: Array) -> Array:
    """Surge, heave, yaw, sway of forces by output: sums of F, and of the third component of r x F."""
    total = np.zeros(4)
    for thruster in vehicle.thrusters:
        way = np.array(thruster.direction) / np.linalg.norm(thruster.direction)
        x, y, z = force[thruster.channel - 1] * way
        turning = np.cross(thruster.position_m, [x, y, z])[2]
        total += [x, z, turning, y]
    return total


MATRIX = np.column_stack([wrench_of(VEHICLE, np.eye(8)[i]) for i in range(8)])
shares = st.tuples(*[st.floats(-3.0, 3.0)] * 4).map(lambda values: np.array(values) * LIMITS)


@settings(max_examples=200, deadline=None)
@given(shares)
def test_a_wrench_that_fits_is_given_whole_by_the_least_forces(wrench: Array) -> None:
    """The same as least squares with bounds, where that reaches the wrench with forces of least norm."""
    least = np.linalg.lstsq(MATRIX, wrench, rcond=None)[0]
    assume(np.abs(least).max() < MOST_N)
    bounded = lsq_linear(MATRIX, wrench, (-MOST_N, MOST_N))
    force, _ = ALLOCATOR.forces(wrench)
    assert bounded.cost < 1e-9 and wrench_of(VEHICLE, force) == pytest.approx(wrench, abs=1e-9)
    assert force == pytest.approx(least, abs=1e-9)


@settings(max_examples=200, deadline=None)
@given(shares)
def test_a_wrench_that_does_not_fit_keeps_its_direction(wrench: Array) -> None:
    """At least 0.6 of the largest share that any forces within the limits give of this wrench, a linear program says."""
    assume(np.linalg.norm(wrench / LIMITS) > 0.1)
    force, _ = ALLOCATOR.forces(wrench)
    got = wrench_of(VEHICLE, force)
    share = float(got @ wrench / (wrench @ wrench))
    assert np.abs(force).max() <= MOST_N + 1e-9 and got == pytest.approx(share * wrench, abs=1e-9)
    result = linprog(
        [0.0] * 8 + [-1.0],
        A_eq=np.column_stack([MATRIX, -wrench]),
        b_eq=np.zeros(4),
        bounds=[(-MOST_N, MOST_N)] * 8 + [(0.0, 1.0)],
    ).x
    assert result is not None
    best = result[-1]
    assert 0.6 * best - 1e-9 <= share <= best + 1e-9


def test_the_claimed_limits_fit_all_at_once() -> None:
    for signs in np.ndindex(2, 2, 2, 2):
        wrench = LIMITS * (2.0 * np.array(signs) - 1.0)
        assert wrench_of(VEHICLE, ALLOCATOR.forces(wrench)[0]) == pytest.approx(wrench, rel=1e-9)


@pytest.mark.parametrize("share", [(1, 0, 0, 0), (0, -1, 0, 0), (0, 0, 0.5, 0), (0, 0, 0, -1), (0.4, 0.3, -0.5, 0.6)])
def test_the_plant_is_pushed_as_the_pulses_say(share: tuple[float, ...]) -> None:
    """The simulator adds up its own thrusters: the same wrench, and what the dead zone and whole microseconds take from it."""
    settings = ["vehicle=vectored", "controller.law=nmpc", "sim.plant.thruster_spread=0", "pool.walls=false"]
    experiment = load_experiment("straight", [*settings, "sim.plant.tilt.enabled=false", "sim.plant.battery.capacity_wh=0"])
    plant = Plant(experiment, seed=1)
    state = plant.start(np.array([[3.0 * i, 0.0, 1.0, 0.4] for i in range(len(experiment.robot_ids))]))
    wrench = np.array(share) * LIMITS
    pulses, delivered = ALLOCATOR.allocate(wrench)
    assert delivered == pytest.approx(wrench, abs=0.25)
    for _ in range(4):
        state = plant.step(state, np.array([pulses] * len(state.eta), dtype=np.float64), steps=round(0.5 / 0.005))
    assert plant.truth(state).wrench[0] == pytest.approx(delivered, abs=1e-6)


def test_a_wrench_that_is_no_number_gives_neutral() -> None:
    wrench = np.array([0.0, np.nan, 0.0, 0.0])
    assert ALLOCATOR.allocate(wrench)[0] == (1500,) * 8 and not ALLOCATOR.allocate(wrench)[1].any()

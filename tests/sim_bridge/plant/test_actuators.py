"""Thrusters against closed forms: dead time to the step, exponential lag, servo ramps, the legs' geometry."""

from dataclasses import replace

import numpy as np
import pytest

from shoal.config.experiment import Experiment, load_experiment
from shoal.frames import Array
from shoal.messages.messages import required
from sim_bridge.plant.actuators import ActuatorModel, ActuatorState, Motors, lapse_of, thrusters_wrench
from sim_bridge.plant.fleet import Plant

STEP_S = 0.005
IDEAL = ("sim.plant.battery.capacity_wh=0",)
EXACT = (*IDEAL, "sim.plant.thruster_spread=0")
STARTS = np.array([[-0.6, 0.0, 0.5, 0.0], [0.6, 0.0, 0.5, 0.0]])


def pool(*settings: str) -> Experiment:
    return load_experiment("pool", settings)


def pulses(thrusters: float, ankles: float) -> Array:
    return np.tile([*[thrusters] * 4, *[ankles] * 4], (2, 1)).astype(float)


def run(fleet: Plant, motors: ActuatorState | None, command_us: Array, steps: int) -> list[ActuatorState]:
    """States of the actuators before and after each step; None: from rest. The robots may go where they like."""
    state = fleet.start(STARTS)
    state = state if motors is None else replace(state, motors=motors)
    states = [state.motors]
    for _ in range(steps):
        state = fleet.step(state, command_us)
        states.append(state.motors)
    return states


def legs_wrench(force: Array, ankle: Array) -> Array:
    """Forces and moments on two hulls (2, 6) at thruster forces and ankle angles (2, 4)."""
    actuators, motors = ActuatorModel(pool(), seed=0).constants, Motors(force, ankle, force, ankle)
    return np.array([np.ravel(thrusters_wrench(i, motors, actuators, lapse_of(actuators, 0.0))) for i in range(2)])


def test_dead_time_then_exponential() -> None:
    """3 N is the curve's end; 0.05 s dead time, 0.10 s lag (vehicle file)."""
    states = run(Plant(pool(*EXACT), seed=0), None, pulses(1900, 1500), 60)
    force = np.array([state.force_n[1, 2] for state in states])
    time_s = np.arange(61) * STEP_S
    assert (force[:11] == 0.0).all()
    assert force == pytest.approx(3.0 * (1.0 - np.exp(-np.maximum(time_s - 0.05, 0.0) / 0.10)), abs=1e-12)


def test_inside_a_step_the_lag_is_exact_too() -> None:
    actuators, level = ActuatorModel(pool(*EXACT), seed=0).constants, np.zeros((1, 4))
    motors = Motors(np.zeros((1, 4)), level, np.full((1, 4), 3.0), level)
    thrust = thrusters_wrench(0, motors, actuators, lapse_of(actuators, 0.0025))
    assert thrust.linear.x == pytest.approx(4 * 3.0 * (1.0 - np.exp(-0.025)))


def test_no_lag_and_no_dead_time() -> None:
    fleet = Plant(pool(*EXACT, "vehicle.thruster.dead_time_s=0", "sim.plant.thruster_lag_s=0"), seed=0)
    assert run(fleet, None, pulses(1700, 1500), 1)[-1].force_n == pytest.approx(1.22)


def test_each_pulse_acts_once_and_in_order() -> None:
    fleet, forces_n = Plant(pool(*EXACT, "sim.plant.thruster_lag_s=0"), seed=0), []
    motors = None
    sent = [1500, 1550, 1600, 1700, 1800, 1900] + [1500] * 12
    for value in sent:
        motors = run(fleet, motors, pulses(value, 1500), 1)[-1]
        forces_n.append(float(motors.force_n[0, 0]))
    assert forces_n == pytest.approx([0.0] * 10 + [0.0, 0.207, 0.478, 1.22, 2.014, 3.0, 0.0, 0.0])


@pytest.mark.parametrize("pulse", [1477, 1490, 1500, 1523])
def test_pulse_inside_the_dead_zone_gives_no_thrust(pulse: float) -> None:
    assert (run(Plant(pool(), seed=0), None, pulses(pulse, 1500), 100)[-1].force_n == 0.0).all()


def test_ankles_wait_and_ramp() -> None:
    """0.02 s dead time, then 5.236 rad/s until +90 degrees."""
    fleet = Plant(pool(), seed=0)
    states = run(fleet, None, pulses(1500, 2000), 80)
    angle = np.array([state.ankle_rad[0, 3] for state in states])
    ramp = np.clip(5.236 * (np.arange(81) * STEP_S - 0.02), 0.0, 1.5707963)
    assert angle == pytest.approx(ramp, abs=1e-9)
    back = run(fleet, states[-1], pulses(1500, 1250), 200)[-1]
    assert back.ankle_rad == pytest.approx(-np.pi / 4)


@pytest.mark.long
def test_spread_is_within_its_bounds_and_belongs_to_the_seed() -> None:
    gains = [ActuatorModel(pool(), seed).gain for seed in range(200)]
    assert np.min(gains) >= 0.9
    assert np.max(gains) <= 1.1
    assert np.std(gains) == pytest.approx(0.2 / np.sqrt(12), rel=0.05)
    assert (ActuatorModel(pool(), 3).gain == gains[3]).all()
    assert not (gains[3] == gains[4]).any()


def test_a_gain_scales_its_own_thruster() -> None:
    force = run(Plant(pool(*IDEAL), seed=5), None, pulses(1800, 1500), 2000)[-1].force_n
    assert force == pytest.approx(2.014 * ActuatorModel(pool(), seed=5).gain)


@pytest.mark.parametrize(
    ("force", "ankle", "wrench"),
    [
        ([3, 3, 3, 3], [0, 0, 0, 0], [12, 0, 0]),
        ([1, 0, 1, 0], [0, 0, 0, 0], [2, 0, 2 * 0.0833]),  # port side ahead: turns to starboard, heading grows
        ([0, 1, 0, 1], [0, 0, 0, 0], [2, 0, -2 * 0.0833]),
        ([1, 1, 1, 1], [np.pi / 2] * 4, [0, 4, 0]),  # straight down, depth grows
        ([-1, 1, 0, 0], [np.pi / 6] * 2 + [0, 0], [0, 0, -2 * 0.0833 * np.cos(np.pi / 6)]),
    ],
)
def test_wrench_of_the_legs(force: list[float], ankle: list[float], wrench: list[float]) -> None:
    wrenches = legs_wrench(np.array([force, [0.0] * 4], float), np.array([ankle, ankle], float))[:, [0, 2, 5]]
    assert wrenches[0] == pytest.approx(wrench, abs=1e-12)
    assert (wrenches[1] == 0.0).all()


def test_wrench_is_the_sum_of_moments() -> None:
    """Against r x F in three dimensions."""
    random = np.random.default_rng(1)
    force, ankle = random.uniform(-3, 3, (2, 4)), random.uniform(-1.5, 1.5, (2, 4))
    wrenches = legs_wrench(force, ankle)
    for robot in range(2):
        vectors = np.array([[f * np.cos(a), 0.0, f * np.sin(a)] for f, a in zip(force[robot], ankle[robot], strict=True)])
        arms = np.column_stack(
            [np.array(required(pool().vehicle.legs).position_m), np.full(4, pool().sim.plant.tilt.legs_below_m)]
        )
        assert wrenches[robot] == pytest.approx([*vectors.sum(axis=0), *np.cross(arms, vectors).sum(axis=0)])


@pytest.mark.parametrize("bad", [np.full((2, 8), np.nan), np.full((2, 4), 1500.0), np.full((1, 8), 1500.0)])
def test_pulses_of_a_wrong_shape_are_a_bug(bad: Array) -> None:
    legs = ActuatorModel(pool(), seed=0)
    with pytest.raises(ValueError, match="pulses_us"):
        legs.command_history(legs.start(), bad)

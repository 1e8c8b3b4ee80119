"""The compiled plant against the one in NumPy, step by step and in one call, and without compilation."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from shoal.config.experiment import Experiment, load_experiment
from shoal.config.scene import RobotConfig
from shoal.frames import Array
from sim_bridge.fault_schedule import ActuatorFaults
from sim_bridge.plant import kernels
from sim_bridge.plant.fleet import Plant, PlantState
from tests.sim_bridge.plant.numpy_plant import NumpyPlant

pytestmark = pytest.mark.long

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"
ROBOTS = 5
DISTURBED = (
    "sim.plant.current_mps=[0.05,-0.08,0.01]",
    "sim.plant.current_shear_per_s=[-0.02,0.01]",
    "sim.plant.gust_mps=0.05",
    "sim.plant.waves.height_m=0.05",
    "sim.plant.waves.direction_rad=0.6",
    "sim.plant.disturbance_wrench=[3,1.5,0.25]",
    "sim.plant.disturbance_hz=0.3",
)
LOPSIDED = ("vehicle.mass.surge_kg=11", "vehicle.mass.sway_kg=17", "sim.plant.mass_error=0.2", "sim.plant.drag_error=-0.3")
LEVEL = ("sim.plant.tilt.enabled=false",)
ARTICLE = ("sim.plant.sway=false",)
IDEAL = ("sim.plant.battery.capacity_wh=0", "sim.plant.thruster_lag_s=0")
ISLANDS = ("islands=[{position_m=[0.4,-0.8],radius_m=0.1}]",)
SETTINGS = [(), DISTURBED, LOPSIDED, LEVEL, ARTICLE, IDEAL, ISLANDS, (*DISTURBED, *ARTICLE), (*DISTURBED, *LOPSIDED, *LEVEL)]


def fleet(*settings: str) -> Experiment:
    experiment = load_experiment("pool", settings)
    return experiment.model_copy(
        update={"robots": tuple(RobotConfig(id=i + 1, node_m=(0.0, 0.0, 0.0)) for i in range(ROBOTS))}
    )


def crowded(plant: Plant, level: bool) -> PlantState:
    """Robots that move towards one another, the walls and the surface."""
    random = np.random.default_rng(4)
    eta = np.array(
        [[-0.9, 0.2, 0.2, 0.3], [-0.5, 0.1, 0.3, 2.0], [0.9, 0.5, 0.1, 1.0], [1.5, 0.0, 0.6, -2.0], [0, -1, 0.8, 9.0]]
    )
    tilt = np.zeros((ROBOTS, 4)) if level else random.uniform(-0.3, 0.3, (ROBOTS, 4))
    return replace(plant.start(eta), nu=random.uniform(-0.3, 0.3, (ROBOTS, 4)), tilt=tilt)


def commands(step: int) -> Array:
    random = np.random.default_rng(step // 10)
    return random.uniform([1400.0] * 4 + [1100.0] * 4, [1900.0] * 4 + [1900.0] * 4, (ROBOTS, 8))


def test_sine_and_cosine_are_those_of_the_library() -> None:
    """To one unit in the last place of 1, many turns away too, and where the series changes over."""
    random = np.random.default_rng(1)
    angles = [*random.uniform(-10.0, 10.0, 2000), *random.uniform(-1e5, 1e5, 1000), *(np.pi / 4 * np.arange(-20, 21))]
    found = np.array([kernels.sine_cosine(float(angle)) for angle in angles])
    assert found == pytest.approx(np.column_stack([np.sin(angles), np.cos(angles)]), abs=2.3e-16)


@pytest.mark.parametrize("settings", SETTINGS)
def test_the_compiled_plant_is_the_one_in_numpy(settings: tuple[str, ...]) -> None:
    experiment = fleet(*settings)
    ours, oracle = Plant(experiment, 1), NumpyPlant(experiment, 1)
    state = crowded(ours, level={*LEVEL, *ARTICLE} & {*settings} != set())
    faults = ActuatorFaults(np.where(np.arange(4 * ROBOTS).reshape(ROBOTS, 4) == 3, -0.5, 1.0), np.full(ROBOTS, 0.4))
    for step in range(40 if INTERPRETED else 400):
        found = ours.step(state, commands(step), faults)
        expected = oracle.step(state, commands(step), faults)
        for name in ("eta", "nu", "tilt", "charge"):
            assert getattr(found, name) == pytest.approx(getattr(expected, name), abs=1e-9), (name, step)
        assert found.motors.force_n == pytest.approx(expected.motors.force_n, abs=1e-9)
        assert found.motors.ankle_rad == pytest.approx(expected.motors.ankle_rad, abs=1e-9)
        assert np.array_equal(found.motors.pulses_us, expected.motors.pulses_us)
        assert ours.acceleration(found) == pytest.approx(oracle.acceleration(found), abs=1e-7)
        state = found
    assert state.steps == (40 if INTERPRETED else 400)


def test_many_steps_in_one_call_are_the_steps_one_by_one() -> None:
    plant = Plant(fleet(*DISTURBED), 1)
    together = apart = crowded(plant, level=False)
    for block in range(12):
        for _ in range(block):
            apart = plant.step(apart, commands(10 * block))
        together = plant.step(together, commands(10 * block), steps=block) if block else together
        for name in ("eta", "nu", "tilt", "charge"):
            assert np.array_equal(getattr(together, name), getattr(apart, name)), (name, block)
        assert np.array_equal(together.motors.pulses_us, apart.motors.pulses_us)
        assert together.steps == apart.steps


@pytest.mark.skipif(INTERPRETED, reason="runs within itself")
def test_the_kernels_are_plain_python_too() -> None:
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        __file__,
        "-k",
        "settings1 or settings3 or one_call",
    ]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout

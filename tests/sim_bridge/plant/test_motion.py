"""Many steps of the plant in one call are the steps one by one, compiled or not, with all that the water can do."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from shoal.config.experiment import load_experiment
from shoal.config.scene import RobotConfig
from sim_bridge.plant.fleet import Plant

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
    "islands=[{position_m=[0.4,-0.8],radius_m=0.1}]",
)


def test_many_steps_in_one_call_are_the_steps_one_by_one() -> None:
    """Of robots that move towards one another, the walls, an island and the surface."""
    random = np.random.default_rng(4)
    experiment = load_experiment("pool", DISTURBED)
    robots = tuple(RobotConfig(id=i + 1, node_m=(0.0, 0.0, 0.0)) for i in range(ROBOTS))
    plant = Plant(experiment.model_copy(update={"robots": robots}), 1)
    eta = np.array(
        [[-0.9, 0.2, 0.2, 0.3], [-0.5, 0.1, 0.3, 2.0], [0.9, 0.5, 0.1, 1.0], [1.5, 0.0, 0.6, -2.0], [0, -1, 0.8, 9.0]]
    )
    nu, tilt = random.uniform(-0.3, 0.3, (2, ROBOTS, 4))
    together = apart = replace(plant.start(eta), nu=nu, tilt=tilt)
    for block in range(12):
        pulses = random.uniform([1400.0] * 4 + [1100.0] * 4, [1900.0] * 4 + [1900.0] * 4, (ROBOTS, 8))
        for _ in range(block):
            apart = plant.step(apart, pulses)
        together = plant.step(together, pulses, steps=block) if block else together
        for name in ("eta", "nu", "tilt", "charge"):
            assert np.array_equal(getattr(together, name), getattr(apart, name)), (name, block)
        assert np.array_equal(together.motors.pulses_us, apart.motors.pulses_us)
        assert together.steps == apart.steps


@pytest.mark.skipif(INTERPRETED, reason="runs within itself")
def test_the_kernels_are_plain_python_too() -> None:
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", __file__]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout

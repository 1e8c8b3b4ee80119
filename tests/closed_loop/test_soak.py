"""Flights in which anything may break at any time: nothing crashes, and no number is ever not finite."""

import numpy as np
import pytest

from benchmarks.flights import prepared
from sim_bridge.measures import measures
from sim_bridge.numeric import fly
from wire.experiment import load_experiment
from wire.messages import Event


def random_faults(random: np.random.Generator, robots: tuple[int, ...], duration_s: float) -> list[str]:
    """Half a dozen lines for `--fault`."""
    effects = ("thruster {r}/{t} dead", "thruster {r}/{t} stuck", "thruster {r}/{t} reversed", "thruster {r}/{t} weak {f}",
               "imu {r} heading {f}", "imu {r} gyro {f}", "battery {r} sag {f}")  # fmt: skip
    lines = []
    for _ in range(6):
        what = effects[int(random.integers(len(effects)))].format(
            r=int(random.choice(robots)), t=int(random.integers(1, 5)), f=round(float(random.uniform(0.05, 1.0)), 2)
        )
        lines.append(f"t={random.uniform(0, duration_s):.1f} for={random.uniform(0.5, 8):.1f} {what}")
    return lines


def soak(name: str, seed: int, duration_s: float) -> None:
    random = np.random.default_rng(seed)
    settings = [
        f"seed={seed}",
        f"duration_s={duration_s}",
        f"sim.plant.mass_error={random.uniform(-0.3, 0.3):.2f}",
        f"sim.plant.gust_mps={random.uniform(0, 0.03):.3f}",
        f"sim.plant.waves.height_m={random.uniform(0, 0.05):.3f}",
        f"sim.sensors.battery_v={random.uniform(11.0, 12.6):.1f}",
    ]
    robots = load_experiment(name).robot_ids
    experiment = load_experiment(name, settings, random_faults(random, robots, duration_s))
    fleet, water = prepared(experiment)
    fleet.start()
    said = [message.message for _, _, message, _ in fly(fleet, water) if isinstance(message, Event)]
    assert sum(text.startswith("fault: ") for text in said) == 6
    assert np.isfinite(fleet.truth).all() and np.abs(np.array(fleet.truth)[..., :3]).max() < 50.0
    assert all(value is None or np.isfinite(value) for value in measures(fleet).values())
    for robot in fleet.robots:
        for state in robot.states:
            numbers = (state.eta, state.nu, state.disturbance, state.wrench, state.wrench_delivered, state.pulse_us)
            assert all(np.isfinite(n).all() for n in numbers)
            assert all(500 <= pulse <= 2500 for pulse in state.pulse_us)


def test_a_short_flight_with_everything_breaking() -> None:
    soak("pool", 1, 12.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pool", "figure-eight", "open-water"])
@pytest.mark.parametrize("seed", range(20))
def test_many_long_ones(name: str, seed: int) -> None:
    soak(name, seed, 55.0)

"""The simulated body is the vehicle's: another vehicle flies in the simulator from its file alone."""

import math
from pathlib import Path

import pytest

from shoal.config.experiment import dump_experiment, load_experiment
from tests.flights import scene_flights


def test_the_simulated_body_has_the_vehicles_cells_and_righting_moment() -> None:
    vectored = load_experiment("straight", ["vehicle=vectored"])
    righting, plant = vectored.vehicle.righting, vectored.sim.plant
    assert righting is not None and plant.tilt.righting_nm == righting.moment_nm
    swing_s = math.tau * math.sqrt(plant.tilt.inertia_kg_m2 / plant.tilt.righting_nm)
    assert swing_s == pytest.approx(righting.swing_s, rel=0.05)
    assert vectored.vehicle.battery.no_arm_v < vectored.sim.sensors.battery_v < vectored.vehicle.battery.full_v
    assert plant.battery.curve_v == pytest.approx(16.0)


def test_keys_of_the_simulated_body_in_an_experiment_stand() -> None:
    settings = ["vehicle=vectored", "sim.sensors.battery_v=15", "sim.plant.battery.curve_v=14", "sim.plant.tilt.righting_nm=5"]
    sim = load_experiment("straight", settings).sim
    assert (sim.sensors.battery_v, sim.plant.battery.curve_v, sim.plant.tilt.righting_nm) == (15.0, 14.0, 5.0)


def test_an_experiment_that_is_written_out_is_the_same_experiment(tmp_path: Path) -> None:
    vectored = load_experiment("straight", ["vehicle=vectored"])
    path = tmp_path / "written.toml"
    path.write_text(dump_experiment(vectored))
    assert load_experiment(str(path)).hash == vectored.hash


@pytest.mark.long
def test_another_vehicle_flies_from_its_file_alone() -> None:
    flight = scene_flights.flown(load_experiment("pool", ["vehicle=vectored", "duration_s=30"]))
    assert flight.settled_rms()[0] < 0.03

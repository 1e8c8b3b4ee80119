"""Robots whose paths run through one another, in the real plant: they leave their paths, pass, arrive."""

import pytest

from benchmarks.encounters import SCENES, meet
from wire.experiment import load_experiment


@pytest.mark.parametrize("name", SCENES)
def test_everyone_arrives_and_nobody_comes_near(name: str) -> None:
    experiment = load_experiment(name)
    flight = meet(experiment, 1)
    assert not flight.deadlock
    assert flight.nearest_m > 2.0 * experiment.safety.radius_m - 0.005
    assert flight.clear_m > experiment.vehicle.radius_m + 0.05

"""The article's Gazebo scenes and the big fleet, flown without camera and network."""

import numpy as np
import pytest

from benchmarks.flights import flown
from groundstation.planning import planner
from wire.config.experiment import Experiment, load_experiment
from wire.frames import Array

pytestmark = pytest.mark.long


def clearance_m(experiment: Experiment, place_m: Array) -> float:
    """Least distance of any island from any centre (..., 2): R of equation (36) is meant from there."""
    gaps = [np.linalg.norm(place_m - island.position_m, axis=-1).min() - island.radius_m for island in experiment.islands]
    return float(min(gaps))


def test_open_water_is_within_three_centimetres_after_20_s() -> None:
    """In a current with gusts and a swell."""
    place_m, _ = flown(load_experiment("open-water", ["duration_s=32"])).settled_rms()
    assert place_m < 0.03


def test_a_line_forms_and_keeps_clear_of_the_islands() -> None:
    experiment = load_experiment("islands", ["duration_s=50"])
    flight = flown(experiment)
    assert flight.settled_rms()[0] < 0.05
    assert clearance_m(experiment, flight.truth[..., :2]) > experiment.safety.radius_m
    formed = flight.error[400:, :, :2] - flight.error[400:, :1, :2]
    assert np.abs(formed).max() < 0.15  # 20 s after starts 3 m off


def test_the_whole_path_between_the_islands_is_clear() -> None:
    experiment = load_experiment("islands")
    for trajectory in planner.plan(experiment).values():
        assert clearance_m(experiment, trajectory.eta[:, :2]) > experiment.safety.radius_m
    straight = np.linspace([-5.7, -7.4], [5.7, 7.4], 200)
    assert clearance_m(experiment, straight) < 0.0  # the islands are in the way


@pytest.mark.slow
@pytest.mark.parametrize("name", ["open-water", "islands", "fleet-20"])
def test_the_whole_scene_keeps_its_limits(name: str) -> None:
    experiment = load_experiment(name)
    flight = flown(experiment)
    truth = flight.truth
    assert flight.settled_rms()[0] < (experiment.limits.rms_after_20s_m or 0.0)
    apart = np.linalg.norm(truth[:, :, None, :2] - truth[:, None, :, :2], axis=-1)
    assert (apart + 9.0 * np.eye(truth.shape[1])).min() > 2 * experiment.safety.radius_m
    if experiment.islands:
        assert clearance_m(experiment, truth[..., :2]) > experiment.safety.radius_m

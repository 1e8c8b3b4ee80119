"""The article's Gazebo scenes and the big fleet, flown without camera and network."""

import numpy as np
import pytest

from groundstation import planner
from sim_bridge.numeric import fly
from tests.closed_loop.test_numeric import prepared
from wire.experiment import Experiment, load_experiment
from wire.frames import Array, pose_error


def flown(name: str, *settings: str) -> tuple[Experiment, Array, Array]:
    """Experiment, and poses and their errors (steps, n, 4) since the trajectories began."""
    experiment = load_experiment(name, settings)
    fleet, water = prepared(experiment)
    fleet.start()
    held = len(fleet.truth) - 1
    for _ in fly(fleet, water):
        pass
    truth = np.array(fleet.truth[held:])
    reference = np.array([t.eta[: len(truth)] for t in fleet.trajectories.values()]).transpose(1, 0, 2)
    return experiment, truth, pose_error(truth, reference)


def settled_rms(experiment: Experiment, error: Array) -> float:
    """Largest RMS per axis after 20 s of any robot or pair, in m."""
    late = error[round(20.0 / experiment.controller.period_s) :, :, :3]
    pairs = late[:, :, None] - late[:, None]
    return float(np.sqrt(np.mean(np.concatenate([late[:, None], pairs], axis=1) ** 2, axis=0)).max())


def clearance_m(experiment: Experiment, place_m: Array) -> float:
    """Least distance of any island from any centre (..., 2): R of equation (36) is meant from there."""
    gaps = [np.linalg.norm(place_m - island.position_m, axis=-1).min() - island.radius_m for island in experiment.islands]
    return float(min(gaps))


def test_open_water_is_within_three_centimetres_after_20_s() -> None:
    """In a current with gusts and a swell."""
    experiment, _, error = flown("open-water", "duration_s=32")
    assert settled_rms(experiment, error) < 0.03


def test_a_line_forms_and_keeps_clear_of_the_islands() -> None:
    experiment, truth, error = flown("islands", "duration_s=50")
    assert settled_rms(experiment, error) < 0.05
    assert clearance_m(experiment, truth[..., :2]) > experiment.safety.radius_m
    formed = error[400:, :, :2] - error[400:, :1, :2]
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
    experiment, truth, error = flown(name)
    assert settled_rms(experiment, error) < (experiment.limits.rms_after_20s_m or 0.0)
    apart = np.linalg.norm(truth[:, :, None, :2] - truth[:, None, :, :2], axis=-1)
    assert (apart + 9.0 * np.eye(truth.shape[1])).min() > 2 * experiment.safety.radius_m
    if experiment.islands:
        assert clearance_m(experiment, truth[..., :2]) > experiment.safety.radius_m

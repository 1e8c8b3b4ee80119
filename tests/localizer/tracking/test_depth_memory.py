"""Depths of robots that report now and then, or never: in the class, and in poses."""

import numpy as np
import pytest

from localizer.tracking.depth_memory import ASSUMED_SIGMA_M, DepthMemory
from localizer.tracking.fleet_localizer import FleetLocalizer
from shoal.config.experiment import load_experiment
from tests.localizer.scene import Scene

EXPERIMENT = load_experiment("pool")
SECOND_NS = 1_000_000_000


def test_the_last_depth_counts_and_is_less_certain_with_each_second() -> None:
    memory, own_m = DepthMemory(EXPERIMENT, [0.3, 0.3]), EXPERIMENT.localizer.depth_sigma_m
    first = memory.update({1: 0.6}, 0)
    assert (first[1].centre_m, first[1].sigma_m) == (0.6, own_m) and (first[2].centre_m, first[2].sigma_m) == (
        0.3,
        ASSUMED_SIGMA_M,
    )
    sigmas_m = []
    for second in range(1, 60):
        reading = memory.update({}, second * SECOND_NS)[1]
        assert reading.centre_m == 0.6
        sigmas_m.append(reading.sigma_m)
    assert sigmas_m[0] == pytest.approx(np.hypot(own_m, 0.05)) and sigmas_m[-1] == 0.3
    assert np.all(np.diff(sigmas_m) >= 0.0)


@pytest.mark.parametrize("depth_m", [float("nan"), float("inf"), -0.5, 30.0])
def test_a_depth_that_cannot_be_is_none(depth_m: float) -> None:
    memory = DepthMemory(EXPERIMENT, [0.3, 0.3])
    memory.update({1: 0.6}, 0)
    assert memory.update({1: depth_m}, SECOND_NS)[1].centre_m == 0.6


@pytest.mark.long
@pytest.mark.parametrize("every", [4, 100])
def test_a_robot_that_reports_now_and_then_stays_where_it_is(every: int) -> None:
    """At 0.6 m, where its start was 0.3 m: in frames without a report it leapt by 90 mm, and claimed 14."""
    eta, scene, locator = np.array([1.1, 0.7, 0.6, 0.4]), Scene(EXPERIMENT, seed=3), FleetLocalizer(EXPERIMENT)
    for k in range(16):
        located = locator.step(scene.frame({1: eta}), k * SECOND_NS // 20, {1: 0.6} if k % every == 0 else {})
        if k > 1:
            pose = dict(located.poses)[1]
            away = np.array([pose.x_m, pose.y_m]) - eta[:2]
            assert np.linalg.norm(away) < 0.004 and pose.depth_m == 0.6
            assert away @ np.linalg.solve(pose.covariance[:2, :2], away) < 9.0

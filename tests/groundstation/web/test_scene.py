"""The scene that a page gets once: long paths are thinned, and keep their pace and ends; and when a state counts as old."""

import numpy as np
import pytest

from groundstation.planning import planner
from groundstation.web.scene import MOST_POINTS, paths, scene
from shoal.config.experiment import load_experiment
from shoal.messages import topics
from shoal.messages.messages import Trajectory


@pytest.mark.parametrize("flown", [1, 2, MOST_POINTS - 1, MOST_POINTS, MOST_POINTS + 1, 5 * MOST_POINTS + 3])
def test_a_path_has_points_enough_and_never_too_many(flown: int) -> None:
    eta = np.arange(4.0 * (flown + 7)).reshape(-1, 4)
    (path,) = paths({3: Trajectory("way", 0.02, eta, np.zeros_like(eta), np.zeros_like(eta))}, flown)
    points = np.frombuffer(path["eta"], "<f4").reshape(-1, 4)
    apart = round(path["every_s"] / 0.02)
    assert min(flown, MOST_POINTS // 2) <= len(points) <= MOST_POINTS
    np.testing.assert_array_equal(points, eta[:flown:apart].astype(np.float32))


def test_only_where_the_simulator_owns_time_may_a_state_be_old_before_the_page_says_so() -> None:
    """There the page hears as fast as it is computed. In real time three steps without a state are worth a word."""
    experiment = load_experiment("pool")
    trajectories = planner.plan(experiment)
    live, simulated = (scene(experiment, trajectories, mode) for mode in ("real-time", "lockstep"))
    assert live["stale_s"] == pytest.approx(3.0 * experiment.controller.period_s)
    assert live["picture_stale_s"] == topics.PREVIEW.max_age_s
    assert simulated["stale_s"] > 2.0 * live["stale_s"] and simulated["picture_stale_s"] > live["picture_stale_s"]

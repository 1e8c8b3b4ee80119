"""Markers where no robot can be: on the deck, in a mask; and a robot that is predicted out of the pool."""

from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from localizer.detection.obstacles import ObstacleDetector
from localizer.tracking.fleet_localizer import FleetLocalizer, LocalizationResult
from shoal.config.experiment import Experiment, load_experiment
from shoal.frames import Array
from shoal.messages.messages import Track
from sim_bridge.camera.renderer import Renderer
from tests.localizer.scene import Scene

pytestmark = pytest.mark.long

SMALL = "pool.size_m=[1.6, 1.2, 1.0]"  # the picture shows 1.8 m to each side of its middle
MASK = "camera.masks_px=[[[900.0, 400.0], [1200.0, 400.0], [1200.0, 560.0], [900.0, 560.0]]]"
INSIDE, OUTSIDE = np.array([-0.4, 0.0, 0.3, 0.5]), np.array([1.15, 0.0, 0.3, 2.0])
SCENE = Scene(load_experiment("pool"))
STEP_NS = 50_000_000


def _seen(experiment: Experiment, robots: Sequence[Mapping[int, Array]]) -> list[LocalizationResult]:
    localizer = FleetLocalizer(experiment)
    return [localizer.step(SCENE.frame(eta), k * STEP_NS, {1: 0.3, 2: 0.3}) for k, eta in enumerate(robots)]


@pytest.mark.parametrize(
    ("settings", "is_used"), [((SMALL,), False), ((SMALL, "localizer.basin_margin_m=0.4"), True), ((MASK,), False)]
)
def test_a_marker_where_no_robot_can_be_gives_no_pose_and_is_named(settings: tuple[str, ...], is_used: bool) -> None:
    results = _seen(load_experiment("pool", settings), [{1: INSIDE, 2: OUTSIDE}] * 10)
    poses = dict(results[-1].poses)
    assert poses[1].track is Track.MARKER
    assert (2 in poses) is is_used
    assert ("seen outside the pool or in a mask: robot 2" in results[-1].status.message) is not is_used


def test_a_followed_robot_that_is_carried_out_of_the_pool_is_lost_at_once() -> None:
    carried = [{1: INSIDE, 2: np.array([0.5 + 0.04 * k, 0.0, 0.3, 0.0])} for k in range(16)]  # 0.8 m/s; outside from 13 on
    tracks = [dict(result.poses).get(2) for result in _seen(load_experiment("pool", [SMALL]), carried)]
    assert tracks[11] is not None and tracks[11].track is Track.MARKER
    assert tracks[15] is not None and tracks[15].track is Track.LOST


def test_april_tags_are_read_when_the_experiment_says_so() -> None:
    tags = load_experiment("pool", ["localizer.marker_family=apriltag_36h11"])
    eta = np.array([[0.4, 0.1, 0.3, 0.3], [-0.4, -0.1, 0.3, -2.0]])
    renderer = Renderer(tags, 1)
    frames = [renderer.render(eta, np.zeros((2, 4)), 0.05 * k, k) for k in range(4)]

    def poses(experiment: Experiment) -> dict[int, list[float]]:
        localizer = FleetLocalizer(experiment)
        results = [localizer.step(frame, k * STEP_NS, {1: 0.3, 2: 0.3}) for k, frame in enumerate(frames)]
        return {robot: [pose.x_m, pose.y_m, pose.yaw_rad] for robot, pose in results[-1].poses}

    assert poses(tags) == {robot: pytest.approx(truth[[0, 1, 3]], abs=0.01) for robot, truth in zip((1, 2), eta, strict=True)}
    assert poses(load_experiment("pool")) == {}


def test_nothing_is_watched_for_in_a_mask() -> None:
    whole, masked = (ObstacleDetector(load_experiment("pool", settings)) for settings in ((), (MASK,)))
    hidden = np.argwhere(whole._in_pool & ~masked._in_pool) * 8 + 4  # private: no message tells which cells are watched
    assert len(hidden) > 500
    assert np.all((hidden >= [392, 892]) & (hidden <= [568, 1208]))

"""Robots 18 px across in a 16 x 16 m hall, no markers: their look alone, in rendered frames."""

import numpy as np
import pytest

from localizer.tracking.fleet_localizer import FleetLocalizer
from shoal.config.experiment import load_experiment
from shoal.frames import Array, wrap
from shoal.messages.messages import Track
from sim_bridge.camera.renderer import Renderer

PERIOD_S = 0.05


def _eta(t_s: float) -> Array:
    """Half a turn in 6 s, at 0.25 m/s, through all phases of a pixel."""
    yaw = np.array([0.5, -1.5]) + 0.5 * t_s
    return np.array([[2.0 + 0.2 * t_s, 1.0 - 0.15 * t_s, 0.3, yaw[0]], [-3.0, -2.0 + 0.25 * t_s, 0.3, yaw[1]]])


@pytest.mark.long
def test_small_robots_are_followed_by_their_look() -> None:
    hall = ("pool.size_m=[16, 16, 1]", "camera.position_m=[0, 0, -16.75]", "camera.distortion=[0, 0, 0, 0, 0]")
    starts = [f"robots.{i}.start={eta}" for i, eta in enumerate(_eta(0.0).tolist())]
    experiment = load_experiment("pool", [*hall, "localizer.markers=false", *starts])
    renderer, locator, errors = Renderer(experiment, 1), FleetLocalizer(experiment), []
    for k in range(120):
        eta = _eta(k * PERIOD_S)
        frame = renderer.render(eta, np.zeros((2, 4)), k * PERIOD_S, k)
        located = locator.step(frame, round(k * PERIOD_S * 1e9), {1: 0.303, 2: 0.298})
        for i, (_, pose) in enumerate(located.poses):
            assert k == 0 or pose.track is Track.KCF
            errors.append([pose.x_m - eta[i, 0], pose.y_m - eta[i, 1], wrap(pose.yaw_rad - float(eta[i, 3]))])
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert np.hypot(*rms[:2]) < 7e-3 and rms[2] < np.deg2rad(3.0)

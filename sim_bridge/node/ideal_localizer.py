"""A stand-in for camera and localizer: true poses with noise. Pure and seeded."""

from collections.abc import Sequence

import numpy as np

from shoal.config.experiment import Experiment
from shoal.config.simulation import Drifter
from shoal.frames import Array
from shoal.messages.messages import Obstacles, Pose, Track
from sim_bridge.plant.random_streams import Stream, generator

_ANGLES = 2.0 * np.pi * np.arange(12) / 12
RING = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)]) / np.cos(np.pi / 12)  # circumscribed polygon of the unit circle


class IdealLocalizer:
    """A localizer that reads every marker in every picture, with the noise of sim.numeric."""

    def __init__(self, experiment: Experiment, seed: int) -> None:
        numeric = experiment.sim.numeric
        self._noise = np.array([numeric.pose_noise_m, numeric.pose_noise_m, 0.0, numeric.yaw_noise_rad])
        self._covariance = np.diag(self._noise[[0, 1, 3]] ** 2)
        self._random = generator(seed, Stream.POSES)
        self._drifters, self._depth_m = experiment.sim.drifters, experiment.path.depth_m
        self._watches = experiment.watches_obstacles
        self._obstacle_noise = np.repeat([numeric.obstacle_noise_m, numeric.obstacle_noise_mps], 2)
        self._obstacle_random = generator(seed, Stream.OBSTACLES)

    def poses(self, eta: Array) -> list[Pose]:
        """Measured poses of robots at eta (n, 4), in their order."""
        measured_eta = eta + self._random.standard_normal(eta.shape) * self._noise
        return [Pose(x, y, yaw, self._covariance, Track.MARKER, True, 1.0, z) for x, y, z, yaw in measured_eta.tolist()]

    def obstacles(self, time_s: float, dropped: Sequence[Drifter] = ()) -> Obstacles | None:
        """The drifting balls as the localizer reports obstacles; None if the experiment has none and asks for no detection,
        until the first is `dropped`. From then on there is a list, if an empty one: robots remember what a list held last."""
        self._watches = self._watches or bool(dropped)
        if not (self._drifters or self._watches):
            return None
        balls = (*self._drifters, *dropped)
        noise = self._obstacle_random.standard_normal((len(balls), 4)) * self._obstacle_noise
        ids, outlines, velocities = [], [], []
        for k, (ball, error) in enumerate(zip(balls, noise, strict=True), start=1):
            place_m = ball.place_m(time_s)
            if place_m is not None:
                ids.append(k)
                outlines.append(place_m[:2] + error[:2] + ball.radius_m * RING)
                velocities.append(np.array(ball.velocity_mps[:2]) + error[2:])
        outline, velocity = np.array(outlines).reshape(-1, len(RING), 2), np.array(velocities).reshape(-1, 2)
        return Obstacles(tuple(ids), outline, velocity, self._depth_m, watched=1.0, unseen_s=np.zeros(len(ids)))

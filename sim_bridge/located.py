"""What stands for camera and localizer where there is none: the true poses, with noise. Pure and seeded."""

import numpy as np

from wire.experiment import Experiment
from wire.frames import Array
from wire.messages import Pose, Track

POSE_STREAM = 3  # keeps this use of the seed apart from the others


class Located:
    """A localizer that reads every marker in every picture, as well as sim.numeric says."""

    def __init__(self, experiment: Experiment, seed: int) -> None:
        numeric = experiment.sim.numeric
        self._noise = np.array([numeric.pose_noise_m, numeric.pose_noise_m, 0.0, numeric.yaw_noise_rad])
        self._covariance = np.diag(self._noise[[0, 1, 3]] ** 2)
        self._random = np.random.default_rng([seed, POSE_STREAM])

    def poses(self, eta: Array) -> list[Pose]:
        """Of robots at eta (n, 4), in their order."""
        seen = eta + self._random.standard_normal(eta.shape) * self._noise
        return [Pose(x, y, yaw, self._covariance, Track.MARKER, True, 1.0, z) for x, y, z, yaw in seen.tolist()]

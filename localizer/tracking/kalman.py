"""Constant-velocity Kalman filter of one robot in the pool frame: predicts the next view and its size, gates measurements.

It predicts, gates and bridges gaps. It does not smooth the published poses: the agent runs an observer with a model of the
robot and its inputs, and a second filter before it would only add lag and coloured noise.
"""

from dataclasses import dataclass

import numpy as np

from localizer import kernels
from shoal.frames import Array

# Standard deviations of acceleration: about twice the thrusters' maximum (6 N on 12 kg, 0.5 N m on 0.12 kg m^2), so that a
# push by hand or by a neighbour stays inside the gates.
_ACCELERATION_MPS2 = 1.0
_YAW_ACCELERATION_RADPS2 = 6.0
_START_SPEED_MPS = 0.3
_START_YAW_RATE_RADPS = 1.0
GATE = 25.0  # squared Mahalanobis distance of x, y, yaw: 1.5e-5 of good measurements fall outside (chi-square, 3)


@dataclass(frozen=True)
class KalmanState:
    """Mean (6,) = [x, y, yaw, and their rates in the pool frame] and covariance (6, 6)."""

    mean: Array
    covariance: Array

    @property
    def position_m(self) -> Array:
        """Position (2,)."""
        return self.mean[:2]

    @property
    def yaw_rad(self) -> float:
        """Heading, wrapped."""
        return float(self.mean[2])

    @property
    def position_sigma_m(self) -> float:
        """Upper bound of the standard deviation along the worse axis."""
        return float(np.sqrt(self.covariance[0, 0] + self.covariance[1, 1]))


def initial_state(pose: Array, covariance: Array) -> KalmanState:
    """State from a first measured pose [x, y, yaw] and its covariance (3, 3); the velocity is unknown."""
    start = np.zeros((6, 6))
    start[:3, :3] = covariance
    start[[3, 4, 5], [3, 4, 5]] = np.array([_START_SPEED_MPS, _START_SPEED_MPS, _START_YAW_RATE_RADPS]) ** 2
    return KalmanState(np.concatenate([pose, np.zeros(3)]), start)


def predict(motion: KalmanState, step_s: float) -> KalmanState:
    """Predict the state by `step_s`, with a random acceleration that is constant over the step and independent of the last
    one."""
    predicted = KalmanState(np.empty(6), np.empty((6, 6)))
    kernels.kalman_predict(
        motion.mean,
        motion.covariance,
        step_s,
        _ACCELERATION_MPS2,
        _YAW_ACCELERATION_RADPS2,
        predicted.mean,
        predicted.covariance,
    )
    return predicted


def update(motion: KalmanState, pose: Array, covariance: Array) -> tuple[KalmanState, float]:
    """Update with a measured pose [x, y, yaw] of covariance (3, 3). Also the squared Mahalanobis distance of the pose from the
    prediction, to be compared with GATE."""
    updated = KalmanState(np.empty(6), np.empty((6, 6)))
    squared = kernels.kalman_update(motion.mean, motion.covariance, pose, covariance, updated.mean, updated.covariance)
    return updated, squared


def stopped(motion: KalmanState) -> KalmanState:
    """The same position at rest, with unknown velocity: the state of a robot that was lost."""
    return initial_state(motion.mean[:3].copy(), motion.covariance[:3, :3])

"""A check that a plan's derivatives belong together."""

import numpy as np

from shoal.messages.messages import Trajectory

PERIOD_S = 0.05


def check_smooth(trajectory: Trajectory, from_row: int = 0, to_row: int | None = None) -> None:
    """Derivatives that belong together, by differences, and no jump in the second."""
    rows = slice(from_row, to_row)
    p, v, a = trajectory.eta[rows], trajectory.velocity[rows], trajectory.acceleration[rows, :3]
    drift = np.abs(np.diff(p, axis=0) / PERIOD_S - 0.5 * (v[1:] + v[:-1]))
    assert drift[:, :3].max() < 2e-3
    assert drift[:, 3].max() < 0.02  # at a cubic spline's knots the yaw rate of a node that swings outside is not smooth
    assert np.abs(np.diff(v[:, :3], axis=0) / PERIOD_S - 0.5 * (a[1:] + a[:-1])).max() < 5e-3
    assert np.abs(np.diff(a, axis=0)).max() < 0.03

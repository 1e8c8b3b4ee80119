"""What the robot should do next: goals, sampled over the horizon."""

from dataclasses import dataclass

import numpy as np

from wire.frames import Array
from wire.messages import Trajectory


@dataclass(frozen=True, eq=False)
class Follow:
    """Fly a trajectory; `time_s` is the time along it now (negative: not started, wait at its first pose)."""

    trajectory: Trajectory
    time_s: float


@dataclass(frozen=True, eq=False)
class Hold:
    """Keep station near a pose, shape (4,). Keep the same object as long as the hold lasts."""

    eta: Array


Goal = Follow | Hold


@dataclass(frozen=True, eq=False)
class Path:
    """The goal at now and at the horizon's nodes: rows 0 (now), 1.. (nodes 0..horizon)."""

    eta: Array  # (horizon + 2, 4)
    velocity: Array  # (horizon + 2, 4)
    acceleration: Array  # (horizon + 2, 4)


class Sampler:
    """Samples goals at now and at `offsets_s` (nodes) later."""

    def __init__(self, offsets_s: Array) -> None:
        self._offsets_s = np.concatenate([[0.0], offsets_s])
        self._known: Trajectory | None = None
        self._table = np.zeros((0, 12))

    def path(self, goal: Goal) -> Path:
        """The goal over the horizon."""
        if isinstance(goal, Hold):
            count = len(self._offsets_s)
            return Path(np.tile(goal.eta, (count, 1)), np.zeros((count, 4)), np.zeros((count, 4)))
        rows = self._sample(goal.trajectory, goal.time_s + self._offsets_s)
        return Path(rows[:, :4], rows[:, 4:8], rows[:, 8:])

    def _sample(self, trajectory: Trajectory, time_s: Array) -> Array:
        """Linear interpolation; before the start and after the end the first and last pose, at rest."""
        if trajectory is not self._known:
            self._table = np.hstack([trajectory.eta, trajectory.velocity, trajectory.acceleration])
            self._known = trajectory
        place = time_s / trajectory.period_s
        rows = interpolate(self._table, place)
        last = len(self._table) - 1
        if place[0] < 0.0 or place[-1] > last:
            rows[:, 4:] *= ((place >= 0.0) & (place <= last))[:, None]
        return rows


def interpolate(table: Array, place: Array) -> Array:
    """Rows of a table (rows, columns) at fractional row numbers (n,), held beyond its ends."""
    low = np.floor(place).astype(np.intp)
    share = (place - low)[:, None]
    first = table.take(low, axis=0, mode="clip")
    return first + share * (table.take(low + 1, axis=0, mode="clip") - first)

"""What the robot should do next: the goal's path over the horizon, and the heading that makes it possible."""

from dataclasses import dataclass

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

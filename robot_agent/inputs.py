"""Inputs of one control step: the newest message of each kind, with its instant on our clock."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from shoal.messages.messages import BoardReading, Obstacles, Plan, Pose, Track


@dataclass(frozen=True, eq=False)
class StampedPose:
    """A pose and the instant of its exposure on our clock."""

    pose: Pose
    instant_ns: int

    @property
    def is_seen(self) -> bool:
        """True if the localizer saw the robot, and did not only predict where it is. Nor is it seen by a pose with a variance
        below 0, which a message may hold."""
        return self.pose.track >= Track.KCF and bool((self.pose.covariance.diagonal() >= 0.0).all())

    @property
    def variance_m2(self) -> float:
        """Variance of the place, the mean of both directions."""
        return 0.5 * float(self.pose.covariance[:2, :2].trace())


@dataclass(frozen=True, eq=False)
class StampedPlan:
    """A neighbour's plan and the instant of its node 0 on our clock."""

    plan: Plan
    instant_ns: int


@dataclass(frozen=True, eq=False)
class StampedObstacles:
    """The localizer's obstacles and the instant of their exposure on our clock."""

    obstacles: Obstacles
    instant_ns: int


@dataclass(frozen=True)
class StationView:
    """The station as last heard: its session, its clock now, the age of its heartbeat, and from that heartbeat the formation's
    lag and slowing, and the robots that are out of the water (shoal.messages.messages.StationHeartbeat)."""

    session: int = 0
    clock_ns: int = 0
    age_s: float = float("inf")
    lag_s: float = 0.0
    slowing: float = 0.0
    out: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class Inputs:
    """Inputs of one control step."""

    pose: StampedPose | None = None
    board: BoardReading = field(default_factory=BoardReading)
    station: StationView = field(default_factory=StationView)
    emergency_stop: bool = False
    plans: Mapping[int, StampedPlan] = field(default_factory=dict)
    obstacles: StampedObstacles | None = None
    late_steps: int = 0  # by how much late steps outnumber timely ones of late (step_clock.py)

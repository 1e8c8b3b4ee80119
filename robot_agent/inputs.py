"""What a robot goes by at one control step: the newest of everything that it hears."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from wire.mavlink.agent_link import Telemetry
from wire.messages.messages import Obstacles, Plan, Pose


@dataclass(frozen=True, eq=False)
class StampedPose:
    """A pose and the instant on our clock at which it was true."""

    pose: Pose
    instant_ns: int


@dataclass(frozen=True, eq=False)
class StampedPlan:
    """A neighbour's plan and the instant on our clock of its first node."""

    plan: Plan
    instant_ns: int


@dataclass(frozen=True, eq=False)
class StampedObstacles:
    """What the localizer sees in the pool that is no robot, and the instant on our clock at which it was so."""

    obstacles: Obstacles
    instant_ns: int


@dataclass(frozen=True)
class StationView:
    """The station as last heard: its session, what its clock says now, how long ago it was heard, and the formation's pace as
    it was then (wire.messages.messages.StationHeartbeat)."""

    session: int = 0
    clock_ns: int = 0
    age_s: float = float("inf")
    lag_s: float = 0.0
    slowing: float = 0.0


@dataclass(frozen=True, eq=False)
class Inputs:
    """The newest of everything at one control step."""

    pose: StampedPose | None = None
    telemetry: Telemetry = field(default_factory=Telemetry)
    station: StationView = field(default_factory=StationView)
    emergency_stop: bool = False
    plans: Mapping[int, StampedPlan] = field(default_factory=dict)
    obstacles: StampedObstacles | None = None
    late_steps: int = 0  # by how much late steps outnumber timely ones of late (step_clock.py)

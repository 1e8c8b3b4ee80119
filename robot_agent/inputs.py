"""What a robot goes by at one control step: the newest of everything that it hears."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from robot_agent.command_check import StationView
from wire.mavlink.agent_link import Telemetry
from wire.messages.messages import Obstacles, Plan, Pose


@dataclass(frozen=True, eq=False)
class Seen:
    """A pose and the instant on our clock at which it was true."""

    pose: Pose
    instant_ns: int


@dataclass(frozen=True, eq=False)
class Heard:
    """A neighbour's plan and the instant on our clock of its first node."""

    plan: Plan
    instant_ns: int


@dataclass(frozen=True, eq=False)
class Watched:
    """What the localizer sees in the pool that is no robot, and the instant on our clock at which it was so."""

    obstacles: Obstacles
    instant_ns: int


@dataclass(frozen=True, eq=False)
class Inputs:
    """The newest of everything at one control step."""

    pose: Seen | None = None
    telemetry: Telemetry = field(default_factory=Telemetry)
    station: StationView = field(default_factory=StationView)
    emergency_stop: bool = False
    plans: Mapping[int, Heard] = field(default_factory=dict)
    watched: Watched | None = None
    late_steps: int = 0  # by how much late steps outnumber timely ones of late (step_clock.py)

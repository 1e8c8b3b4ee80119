"""The other robots in the cost and in the constraints: formation terms (35) and collision half-spaces (36)."""

from dataclasses import dataclass

from wire.messages import Plan


@dataclass(frozen=True, eq=False)
class Neighbour:
    """Another robot's last plan. Fresh plans count for the formation; stale ones only keep a growing distance."""

    robot: int
    stamp_ns: int  # instant of the plan's node 0, on our clock
    plan: Plan
    fresh: bool
    formation: bool = True  # False: only stay clear of it

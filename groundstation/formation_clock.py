"""Rule by which a robot's clock counts for the formation: the trajectory that it is on. Pure; for mission, laps and reports.

A robot has one clock, along whatever trajectory it flies (RobotState.trajectory_s). It is the formation's progress only while
the trajectory is one of the formation's. A trajectory that a robot flies on its own, to a place that a person gave, has an id
that says so, and its clock begins anew.
"""

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

from shoal.messages.messages import ALONE, Mode, RobotState, Trajectory


def named_alone(trajectory: Trajectory) -> Trajectory:
    """The trajectory under an id that tells that it is not the formation's."""
    return replace(trajectory, id=ALONE + trajectory.id)


class ClockReading(NamedTuple):
    """The part of a robot's state that says where it is on which trajectory; a log has millions of states."""

    mode: Mode
    trajectory_s: float
    trajectory_id: str


def clock_reading(state: RobotState) -> ClockReading:
    """The clock of a state."""
    return ClockReading(state.mode, state.trajectory_s, state.trajectory_id)


@dataclass(frozen=True)
class FormationPlans:
    """Ids of the formation's trajectories of one robot. None: they are not known, and all count that are not flown alone."""

    ids: Collection[str] | None = None

    def include(self, trajectory_id: str) -> bool:
        """True if a trajectory is one of the formation's."""
        return not trajectory_id.startswith(ALONE) and (self.ids is None or trajectory_id in self.ids)

    def clock_s(self, state: RobotState | ClockReading | None) -> float | None:
        """Progress along the formation's trajectory in s; None for a robot that is on another, or not heard yet."""
        return state.trajectory_s if state is not None and self.include(state.trajectory_id) else None

    def under_way(self, state: RobotState | ClockReading | None) -> bool:
        """True for a robot that flies with the formation, its clock running."""
        return state is not None and state.mode is Mode.TRACKING and (self.clock_s(state) or 0.0) > 0.0

    def with_formation(self, states: Iterable[RobotState | ClockReading]) -> Iterator[bool]:
        """For each state of one robot in turn: True while it is with the formation, False while it is led elsewhere. A robot
        that was driven, or flew alone, comes back when it flies the formation's trajectory again."""
        led_away = False
        for state in states:
            if state.mode is Mode.DRIVEN or not self.include(state.trajectory_id):
                led_away = True
            elif state.mode is Mode.TRACKING:
                led_away = False
            yield not led_away

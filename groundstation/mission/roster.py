"""Robots that take part in a mission: the slot of each, the trajectory it flies, and who leads it. Pure."""

from collections.abc import Iterable, Mapping
from enum import Enum

from groundstation.formation_clock import FormationPlans
from groundstation.planning.rest_to_rest import assign_slots
from groundstation.planning.segment import PlanSegment, concatenate
from groundstation.telemetry import Fleet
from shoal.frames import Array
from shoal.messages.messages import Trajectory


class Leader(Enum):
    """Sender of a robot's commands."""

    MISSION = "the mission"
    PERSON = "a person"


TAKEN_OUT, PUT_BACK, LED = "out of the water", "was out of the water", "led by a person"
BY_PEOPLE = frozenset({TAKEN_OUT, PUT_BACK, LED})  # why the formation flies without a robot, and nothing is wrong


class Roster:
    """Robots of an experiment with their slots. A slot is a node of the formation; a robot has its own until gaps close.

    A robot that is out of the water stays lost, also to later runs, until it is back in."""

    def __init__(self, robot_ids: tuple[int, ...], segment: PlanSegment, out: Iterable[int] = ()) -> None:
        self.all_robots = robot_ids
        self.out = frozenset(out)
        self.led_by = dict.fromkeys(robot_ids, Leader.MISSION)
        self.reset(segment)

    def reset(self, segment: PlanSegment) -> None:
        """Take all robots in the water in, each in its own slot, to fly `segment` from its beginning."""
        self.lost = dict.fromkeys(sorted(self.out), TAKEN_OUT)  # robots that the run goes on without, and the reason
        self.slots = {robot: robot for robot in self.all_robots}
        self.closed = False  # the robots have closed up where one was lost
        self.history: dict[int, Trajectory] = dict(segment.trajectories)  # by robot, from the beginning of the run

    @property
    def active(self) -> tuple[int, ...]:
        """Robots that take part."""
        return tuple(robot for robot in self.all_robots if robot not in self.lost)

    def adopt(self, segment: PlanSegment) -> None:
        """Fly `segment` from now on."""
        if segment.is_return:
            self.slots = {robot: robot for robot in self.all_robots}
        for robot in self.active:
            trajectory = self.trajectory(segment, robot)
            if trajectory is not None:
                self.history[robot] = concatenate(self.history[robot], trajectory)

    def reassign_slots(self, segment: PlanSegment, progress_s: float, fleet: Fleet) -> None:
        """Give the active robots the slots of the experiment's first robots, by the shortest ways."""
        slots, self.closed = self.all_robots[: len(self.active)], True
        self.slots = self.slots | assign_slots(segment, progress_s, {r: fleet[r].eta for r in self.active}, slots)

    def mark_lost(self, robot: int, why: str) -> None:
        """Go on without a robot."""
        self.lost[robot] = why

    def take_out(self, robot: int) -> None:
        """Go on without a robot that is out of the water."""
        self.out |= {robot}
        self.mark_lost(robot, TAKEN_OUT)

    def put_back(self, robot: int, at_rest: bool) -> None:
        """Count on a robot that is in the water again: at once while all are at rest; else it may rejoin."""
        self.out -= {robot}
        self.lost[robot] = PUT_BACK
        if at_rest:
            del self.lost[robot]

    def reinstate(self, robots: Iterable[int]) -> None:
        """Take lost robots in again, in free slots."""
        slots_in_use = self.slots_in_use().values()
        free = (slot for slot in self.all_robots if slot not in slots_in_use)
        for robot in robots:
            del self.lost[robot]
            self.slots[robot] = next(free)
        self.closed = self.closed and bool(self.lost)

    @property
    def trouble(self) -> bool:
        """True if a robot is lost for another reason than a person's request."""
        return any(why not in BY_PEOPLE for why in self.lost.values())

    @property
    def has_gap(self) -> bool:
        """True if the active robots' slots are not those of the experiment's first robots."""
        return set(self.slots_in_use().values()) != set(self.all_robots[: len(self.active)])

    @property
    def led_by_people(self) -> frozenset[int]:
        """Robots that a person leads now."""
        return frozenset(robot for robot, leader in self.led_by.items() if leader is Leader.PERSON)

    def take_back(self) -> None:
        """Let the mission lead every robot."""
        self.led_by = dict.fromkeys(self.all_robots, Leader.MISSION)

    def slots_in_use(self) -> dict[int, int]:
        """Slot of each active robot."""
        return {robot: self.slots[robot] for robot in self.active}

    def trajectory(self, segment: PlanSegment | None, robot: int) -> Trajectory | None:
        """Trajectory of a robot on a segment; None if it has no part in it."""
        return segment.trajectories.get(self.slots[robot]) if segment is not None else None

    def plans(self, robot: int, *segments: PlanSegment | None) -> FormationPlans:
        """The formation's trajectories of a robot on these segments."""
        planned = (self.trajectory(segment, robot) for segment in segments)
        return FormationPlans(tuple(trajectory.id for trajectory in planned if trajectory is not None))

    def has_segment(self, segment: PlanSegment, fleet: Fleet, robot: int) -> bool:
        """True if a robot's state names its trajectory of the segment."""
        return self.plans(robot, segment).clock_s(fleet[robot].state) is not None

    def has_loaded(self, segment: PlanSegment, fleet: Fleet, robot: int) -> bool:
        """True if a robot has its trajectory of the segment, and its clock stands at the beginning. After an earlier flight of
        the same trajectory the clock stands where that flight ended."""
        clock_s = self.plans(robot, segment).clock_s(fleet[robot].state)
        return clock_s is not None and clock_s == segment.centre.begin_s

    def trajectories(self, segment: PlanSegment) -> Mapping[int, Trajectory]:
        """Trajectory of each active robot on a segment."""
        slots = self.slots_in_use().items()
        return {robot: segment.trajectories[slot] for robot, slot in slots if slot in segment.trajectories}

    def rest_poses(self, fleet: Fleet) -> dict[int, Array]:
        """Poses (4,) in which the active robots rest."""
        return {robot: fleet[robot].rest for robot in self.active}

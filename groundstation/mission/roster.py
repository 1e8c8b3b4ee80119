"""Who takes part in a mission, in whose place, and what each flies. Pure."""

from collections.abc import Mapping

from groundstation.planning.rest_to_rest import assigned
from groundstation.planning.segment import Leg, continued
from groundstation.telemetry import Fleet
from wire.frames import Array
from wire.messages.messages import Trajectory


class Crew:
    """The robots of an experiment. Each has a slot of the leg that is flown: its own, until gaps close."""

    def __init__(self, robot_ids: tuple[int, ...], leg: Leg) -> None:
        self.everybody = robot_ids
        self.begin(leg)

    def begin(self, leg: Leg) -> None:
        """All take part, each in its own slot."""
        self.out: dict[int, str] = {}  # robots that fell out of a run that goes on, and why
        self.slots = {robot: robot for robot in self.everybody}
        self.paths: dict[int, Trajectory] = dict(leg.trajectories)  # of each robot, from the run's beginning on

    @property
    def active(self) -> tuple[int, ...]:
        """Robots that take part."""
        return tuple(robot for robot in self.everybody if robot not in self.out)

    def adopt(self, leg: Leg) -> None:
        """This is flown from now on."""
        if leg.home:
            self.slots = {robot: robot for robot in self.everybody}
        for robot in self.active:
            trajectory = self.trajectory(leg, robot)
            if trajectory is not None:
                self.paths[robot] = continued(self.paths[robot], trajectory)

    def close_up(self, leg: Leg, reached_s: float, fleet: Fleet) -> None:
        """Those who are left take the slots of the file's first robots, by the shortest ways."""
        slots = self.everybody[: len(self.active)]
        self.slots |= assigned(leg, reached_s, {r: fleet[r].eta for r in self.active}, slots)

    def lose(self, robot: int, why: str) -> None:
        """The others go on without it."""
        self.out[robot] = why

    def take_back(self) -> None:
        """Those who are out take part again, in the slots that are free."""
        taken = self.active_slots().values()
        free = [slot for slot in self.everybody if slot not in taken]
        self.slots |= dict(zip(self.out, free, strict=True))
        self.out = {}

    def active_slots(self) -> dict[int, int]:
        """Slot of each robot that takes part."""
        return {robot: self.slots[robot] for robot in self.active}

    def trajectory(self, leg: Leg | None, robot: int) -> Trajectory | None:
        """What a robot flies on a leg; None if it has no part in it."""
        return leg.trajectories.get(self.slots[robot]) if leg is not None else None

    def is_on(self, leg: Leg, fleet: Fleet, robot: int) -> bool:
        """Whether a robot says that it has its trajectory of a leg."""
        state, trajectory = fleet[robot].state, self.trajectory(leg, robot)
        return state is not None and trajectory is not None and state.trajectory_id == trajectory.id

    def flown(self, leg: Leg) -> Mapping[int, Trajectory]:
        """What each robot that takes part flies on a leg."""
        slots = self.active_slots().items()
        return {robot: leg.trajectories[slot] for robot, slot in slots if slot in leg.trajectories}

    def rests(self, fleet: Fleet) -> dict[int, Array]:
        """The poses (4,) in which those who take part rest."""
        return {robot: fleet[robot].rest for robot in self.active}

"""What the formation flies, what it flies next, and the plan that is waited for. Pure; groundstation/mission/mission.py says
when.

A plan made under way (groundstation/planning/replanning.py) becomes `next`, and is flown once all robots have it; one for
robots that hold (groundstation/planning/rest_to_rest.py) is taken over at once. Plans take time: `wanted` is the one that
somebody is to make.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from groundstation.mission.obstacle_monitor import Lookout
from groundstation.mission.roster import Crew
from groundstation.planning.replanning import detour
from groundstation.planning.rest_to_rest import gathered, homeward
from groundstation.planning.segment import Leg, on_grid
from groundstation.telemetry import Fleet, RobotView
from wire.config.experiment import Experiment
from wire.frames import Array
from wire.messages.messages import Order, Trajectory

AHEAD_S = 2.0  # from asking for another path to where it begins: planning, and telling everybody
LAST_CALL_S = 0.3  # before that, everybody must have it


@dataclass(frozen=True)
class Wanted:
    """A plan that the mission waits for. Whoever computes it calls `plan` and gives the mission what comes of it."""

    what: str
    plan: Callable[[], Leg]


class Itinerary:
    """Legs and plans of one mission. Times are on the clock that runs along the trajectories."""

    def __init__(self, experiment: Experiment, first: Leg, starts: Mapping[int, Array], crew: Crew) -> None:
        """`starts`: poses (4,) in which the robots began."""
        self.leg = first
        self.next: Leg | None = None  # flown from its beginning on, once all have it
        self.wanted: Wanted | None = None
        self.reached_s = 0.0  # along the trajectories; common to all, so that a resumed formation is still in step
        self.deadline_s = 0.0  # for everybody to have the next leg
        self.by_person = False  # the other path was asked for by one
        self.lookout = Lookout(experiment)
        self._experiment, self._first, self._starts, self._crew = experiment, first, dict(starts), crew
        self._purpose: Callable[[Fleet, float], Callable[[], Leg]] | None = None  # of coming to rest

    def begin_anew(self) -> None:
        """From the first leg's beginning, with everybody."""
        self.leg, self.reached_s = self._first, 0.0
        self._crew.begin(self._first)

    def adopt(self, leg: Leg) -> None:
        """This is flown from now on."""
        self.leg, self.next = leg, None
        self._crew.adopt(leg)

    def about(self, order: Order, robot: int) -> Trajectory | None:
        """The trajectory that an order to a robot is about; None if it has no part in it."""
        leg = self.next if self.next is not None and order in (Order.LOAD, Order.SWITCH) else self.leg
        return self._crew.trajectory(leg, robot)

    # --- plans

    def head_home(self) -> None:
        """Once all rest, the way leads back to the starts."""
        self._purpose = self._homeward

    def take_places(self) -> None:
        """Once all rest, the way leads into the places of the leg, and on along it."""
        self._purpose = self._into_place

    def plan_anew(self) -> None:
        """Once all rest, the way leads to where the leg does."""
        self._purpose = self._homeward if self.leg.home else self._into_place

    @property
    def heads_home(self) -> bool:
        """Whether robots that come to rest do so for the way back."""
        return self._purpose == self._homeward

    def _homeward(self, fleet: Fleet, begin_s: float) -> Callable[[], Leg]:
        experiment, starts = self._experiment, self._starts
        rests, things = self._crew.rests(fleet), self.in_the_way(fleet)
        return lambda: homeward(experiment, begin_s, rests, starts, things)

    def _into_place(self, fleet: Fleet, begin_s: float) -> Callable[[], Leg]:
        experiment, leg, reached_s = self._experiment, self.leg, self.reached_s
        rests, slots, things = self._crew.rests(fleet), self._crew.active_slots(), self.in_the_way(fleet)
        return lambda: gathered(experiment, leg, begin_s, reached_s, rests, slots, things)

    def want_way(self, fleet: Fleet) -> None:
        """Now that all rest: a plan for what they came to rest for, made of what is known now. It is computed in another
        thread, while the mission goes on."""
        if self.wanted is None and self._purpose is not None:
            period_s = self._experiment.controller.period_s
            begin_s = on_grid(self.reached_s + period_s, period_s)
            self.wanted = Wanted("a way for everybody from rest", self._purpose(fleet, begin_s))

    def want_detour(self, fleet: Fleet, now_ns: int, via: tuple[tuple[float, float], ...] = ()) -> None:
        """Round what lies there, or by way of a person's places."""
        begin_s = on_grid(self.reached_s + AHEAD_S, self._experiment.controller.period_s)
        experiment, leg, things = self._experiment, self.leg, self.in_the_way(fleet, now_ns)
        self.deadline_s, self.by_person = begin_s - LAST_CALL_S, bool(via)
        self.wanted = Wanted("another path", lambda: detour(experiment, leg, begin_s, things, via))

    # --- what lies there

    def in_the_way(self, fleet: Fleet, now_ns: int | None = None) -> Array:
        """Things and robots that are out, (k, 3: x, y, radius), as the lookout knows them."""
        return self.lookout.in_the_way(self._lost(fleet), now_ns)

    def blocked(self, fleet: Fleet, now_ns: int | None = None) -> str:
        """Where the robots would touch something; empty if nowhere."""
        leg = replace(self.leg, trajectories=self._crew.flown(self.leg))
        return self.lookout.contact(leg, self.reached_s, self._lost(fleet), now_ns)

    def _lost(self, fleet: Fleet) -> list[RobotView]:
        return [fleet[r] for r in self._crew.out]

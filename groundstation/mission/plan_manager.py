"""Present and next plan segment, and the plan that is waited for. Pure; groundstation/mission/mission.py decides when to plan.

A plan made in flight (groundstation/planning/replanning.py) becomes `next`, and is flown once all robots have it. A plan for
robots that hold (groundstation/planning/rest_to_rest.py) is adopted at once, one for robots at rest before a start is what
that start flies. Planning takes time: `request` is the plan to be computed.
"""

from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, replace

from groundstation.mission.lap_statistics import FlownLaps
from groundstation.mission.obstacle_monitor import ObstacleMonitor, located
from groundstation.mission.roster import Roster
from groundstation.mission.state_machine import AT_REST, MissionState
from groundstation.planning.feasibility import OutOfTime, PlanError, never
from groundstation.planning.replanning import replan
from groundstation.planning.rest_to_rest import plan_regroup, plan_return
from groundstation.planning.segment import PlanSegment, ceil_to_period, first_contact, first_segment
from groundstation.planning.shift import in_form, reshape
from groundstation.planning.transfer import RAMP_S
from groundstation.telemetry import Fleet, RobotView
from shoal.config.experiment import Experiment
from shoal.config.scene import Circle, read_form
from shoal.frames import Array
from shoal.messages.messages import CommandKind, Trajectory

AHEAD_S = 2.0  # from the request to the beginning of another path: covers planning, and loading it into all robots
LAST_CALL_S = 0.3  # before the beginning: all robots must have the next segment by then


PlanMaker = Callable[[OutOfTime], PlanSegment]


@dataclass(eq=False)
class FlownPath:
    """A path with its formation, as an experiment gives it."""

    experiment: Experiment
    segment: PlanSegment | None = None  # from the path's beginning, without the ways into the places; None: not planned yet

    def plan(self, out_of_time: OutOfTime = never) -> PlanSegment:
        """Segment from the path's beginning. Raises PlanError."""
        self.segment = first_segment(self.experiment, out_of_time) if self.segment is None else self.segment
        return self.segment


@dataclass(frozen=True)
class PlanRequest:
    """A plan that the mission waits for. The station calls `plan` and gives the mission its outcome."""

    name: str
    make: PlanMaker
    flight: FlownPath | None = None  # another one that the plan begins

    def plan(self, out_of_time: OutOfTime = never) -> PlanSegment:
        """Compute the plan. Raises PlanError, also when `out_of_time`."""
        return self.make(out_of_time)


class PlanManager:
    """Plan segments of one mission. Times are on the clock that runs along the trajectories."""

    def __init__(self, experiment: Experiment, first: PlanSegment, starts: Mapping[int, Array], roster: Roster) -> None:
        """`starts`: poses (4,) in which the robots begin."""
        self.flown = experiment  # with the path of the session, or the one that a person has loaded
        self.starts = dict(starts)
        self.failure = ""  # of the last plan for robots at rest
        self.segment = first
        self.next: PlanSegment | None = None  # flown from its beginning on, once all have it
        self.request: PlanRequest | None = None
        self.progress_s = 0.0  # along the trajectories; common to all, so that a resumed formation is still in step
        self.deadline_s = 0.0  # for all robots to have the next segment
        self.by_operator = False  # the other path was requested by the operator
        self.monitor = ObstacleMonitor(experiment)
        self._first, self._roster = first, roster
        self._flight, self._flights = FlownPath(experiment, first), 0
        self._purpose: Callable[[Fleet, float], PlanMaker] | None = None  # of coming to rest
        self._coming: FlownPath | None = None  # that begins then

    def of_roster(self, roster: Roster) -> "PlanManager":
        """The same plans for other robots, or other slots of theirs: to try what a request would do."""
        other = copy(self)
        other._roster = roster
        return other

    def reset(self) -> None:
        """Start again at the beginning of the first segment, with all robots."""
        self.segment, self.progress_s = self._first, 0.0
        self._flights += 1
        self._roster.reset(self._first)

    def adopt(self, segment: PlanSegment, flight: FlownPath | None = None) -> None:
        """Fly `segment` from now on; with another `flight` it is also what the next start flies."""
        self.segment, self.next = segment, None
        if flight is not None:
            first = flight.plan()
            self._take(flight, first, {r: first.trajectories[r].eta[0] for r in self._roster.all_robots})
        self._roster.adopt(segment)

    def adopt_at_rest(self, segment: PlanSegment, flight: FlownPath) -> None:
        """Fly `segment` with the next start, from where the robots are."""
        self._take(flight, segment, {r: segment.trajectories[r].eta[0] for r in self._roster.all_robots})
        self.reset()

    def _take(self, flight: FlownPath, first: PlanSegment, starts: Mapping[int, Array]) -> None:
        self._flight, self._first, self.starts = flight, first, dict(starts)
        self._flights += 1
        self.flown = self.monitor.flown = flight.experiment

    @property
    def laps(self) -> FlownLaps:
        """Laps of the path that is flown; the way home has none."""
        path, segment = self.flown.path, self.segment
        lap_s = path.lap_s if isinstance(path, Circle) and not segment.is_return else None
        goes_on_s = segment.transfer_end_s + 0.5 * RAMP_S if segment.transfer_end_s else 0.0  # where the slow start is made up
        return FlownLaps(lap_s, segment.path_s, segment.end_s, self._flights, goes_on_s)

    def trajectory_for(self, order: CommandKind, robot: int) -> Trajectory | None:
        """Trajectory that a command to a robot is about; None if it has no part in the segment."""
        loads_next = self.next is not None and order in (CommandKind.LOAD, CommandKind.SWITCH)
        return self._roster.trajectory(self.next if loads_next else self.segment, robot)

    # --- plans

    def target_return(self) -> None:
        """Plan the next rest's segment back to the starts."""
        self._purpose, self._coming = self._plan_return, None

    def target_slots(self) -> None:
        """Plan the next rest's segment into the slots of the present one, and on along it."""
        self._purpose, self._coming = self._plan_regroup, None

    def target_current(self) -> None:
        """Plan the next rest's segment to where the present one leads."""
        self._purpose, self._coming = self._plan_return if self.segment.is_return else self._plan_regroup, None

    @property
    def targets_return(self) -> bool:
        """True if the plan from rest leads back to the starts."""
        return self._purpose == self._plan_return

    @property
    def targets_flight(self) -> bool:
        """True if the plan from rest leads to another path."""
        return self._coming is not None

    @property
    def formation(self) -> tuple[PlanSegment, float]:
        """Segment, and progress along it in s, at which the formation has its places: on the way home the path's beginning, on
        separate transfers their end."""
        if self.segment.is_return:
            return self._first, self._first.centre.begin_s
        return self.segment, max(self.progress_s, self.segment.transfer_end_s)

    def _plan_return(self, fleet: Fleet, begin_s: float) -> PlanMaker:
        """Purpose of a plan from rest: back to the starts."""
        experiment, starts = self.flown, self.starts
        rests, obstacles = self._roster.rest_poses(fleet), self.discs_to_avoid(fleet)
        lying = self.monitor.discs_to_avoid(self._lost(fleet).values(), room_m=0.0)
        return lambda out_of_time: plan_return(experiment, begin_s, rests, starts, obstacles, out_of_time, lying)

    def _plan_regroup(self, fleet: Fleet, begin_s: float) -> PlanMaker:
        """Purpose of a plan from rest: into the present slots, and on along the present path."""
        experiment, segment, progress_s = self.flown, self.segment, self.progress_s
        rests, slots = self._roster.rest_poses(fleet), self._roster.slots_in_use()
        obstacles = self.discs_to_avoid(fleet)
        return lambda out_of_time: plan_regroup(experiment, segment, begin_s, progress_s, rests, slots, obstacles, out_of_time)

    def request_plan_from_rest(self, fleet: Fleet) -> None:
        """Request the targeted plan, now that all robots rest. It uses the fleet as known now: it is computed in another
        thread while the mission goes on."""
        if self.request is None and self._purpose is not None:
            self.request = PlanRequest("from rest", self._purpose(fleet, self._begin_s()), self._coming)

    def _begin_s(self) -> float:
        """First instant of a plan from rest."""
        period_s = self.flown.controller.period_s
        return ceil_to_period(self.progress_s + period_s, period_s)

    def request_replan(self, fleet: Fleet, now_ns: int, via: tuple[tuple[float, float], ...] = ()) -> None:
        """Request a path around obstacles, or through the operator's places `via` (x, y) in m."""
        begin_s = self._ahead_s()
        experiment, segment, obstacles = self.flown, self.segment, self.discs_to_avoid(fleet, now_ns)
        self.deadline_s, self.by_operator = begin_s - LAST_CALL_S, bool(via)
        self.request = PlanRequest(
            "another path", lambda out_of_time: replan(experiment, segment, begin_s, obstacles, via, out_of_time)
        )

    def request_form(self, form: str, fleet: Fleet, now_ns: int) -> None:
        """Request another form from an instant ahead."""
        begin_s = self._ahead_s()
        self.deadline_s, self.by_operator = begin_s - LAST_CALL_S, True
        make = self.form_plan(form, begin_s, fleet, now_ns)
        self.request = PlanRequest("another form", lambda _: make())

    def draft(self, text: str, other: Experiment | None, fleet: Fleet, now_ns: int, state: MissionState) -> PlanMaker:
        """Function that plans another form, or the path of an `other` experiment, without asking for it, in a state that
        allows it: with the ways into place, where robots rest or hold."""
        if state in AT_REST:
            return self._from_rest(fleet, other, text)[0]
        if state is not MissionState.PAUSED:
            make = self.form_plan(text, self._ahead_s(), fleet, now_ns)
            return lambda _: make()
        purpose = self._into_form(text) if other is None else self._into_flight(FlownPath(other))
        return purpose(fleet, self._begin_s())

    def form_plan(self, form: str, begin_s: float, fleet: Fleet, now_ns: int) -> Callable[[], PlanSegment]:
        """Function that plans another form from `begin_s` on. It raises PlanError."""
        experiment, segment, obstacles = self.flown, self.segment, self.discs_to_avoid(fleet, now_ns)
        lost = located(self._lost(fleet))

        def make() -> PlanSegment:
            reshaped = reshape(experiment, segment, begin_s, read_form(form, begin_s))
            contact = first_contact(experiment, reshaped, begin_s, reshaped.end_s, obstacles, lost)
            if contact:
                raise PlanError(contact)
            return reshaped

        return make

    def _ahead_s(self) -> float:
        """Time along the trajectories at which another path may begin."""
        return ceil_to_period(self.progress_s + AHEAD_S, self.flown.controller.period_s)

    def target_form(self, form: str) -> None:
        """Plan the next rest's segment into the slots of another form, and on along the present path."""
        self._purpose, self._coming = self._into_form(form), None

    def _into_form(self, form: str) -> Callable[[Fleet, float], PlanMaker]:
        """Purpose of a plan from rest: into the slots of another form, and on along the present path."""
        experiment, (segment, progress_s) = self.flown, self.formation

        def plan(fleet: Fleet, begin_s: float) -> PlanMaker:
            rests, slots, obstacles = self._roster.rest_poses(fleet), self._roster.slots_in_use(), self.discs_to_avoid(fleet)

            def make(out_of_time: OutOfTime) -> PlanSegment:
                """In the planner's thread: from the rest poses into the slots of the new form."""
                held = in_form(experiment, segment, progress_s, read_form(form, 0.0)[0])
                return plan_regroup(experiment, held, begin_s, progress_s, rests, slots, obstacles, out_of_time)

            return make

        return plan

    def target_flight(self, flown: Experiment) -> None:
        """Plan the next rest's segment to the beginning of another path, and on along it."""
        flight = FlownPath(flown)
        self._purpose, self._coming = self._into_flight(flight), flight

    def _into_flight(self, flight: FlownPath) -> Callable[[Fleet, float], PlanMaker]:
        def plan(fleet: Fleet, begin_s: float) -> PlanMaker:
            rests, slots, obstacles = self._roster.rest_poses(fleet), self._roster.slots_in_use(), self.discs_to_avoid(fleet)
            flown = flight.experiment
            return lambda late: plan_regroup(flown, flight.plan(late), begin_s, 0.0, rests, slots, obstacles, late)

        return plan

    def request_at_rest(self, fleet: Fleet, flown: Experiment | None, form: str) -> None:
        """Request what the next start flies, from where the robots rest: another experiment's path, or the present one in
        another form."""
        make, flight = self._from_rest(fleet, flown, form)
        self.failure, self.request = "", PlanRequest("at rest", make, flight)

    def _from_rest(self, fleet: Fleet, flown: Experiment | None, form: str) -> tuple[PlanMaker, FlownPath]:
        """Function that plans what the next start flies, and the path that it begins."""
        flight = FlownPath(self.flown) if flown is None else FlownPath(flown)
        rests, slots = self._roster.rest_poses(fleet), self._roster.slots_in_use()
        obstacles, present = self.discs_to_avoid(fleet), self._flight

        def make(out_of_time: OutOfTime) -> PlanSegment:
            if flown is None:
                flight.segment = in_form(flight.experiment, present.plan(out_of_time), 0.0, read_form(form, 0.0)[0])
            planned = flight.plan(out_of_time)
            return plan_regroup(flight.experiment, planned, 0.0, 0.0, rests, slots, obstacles, out_of_time)

        return make, flight

    # --- obstacles

    def discs_to_avoid(self, fleet: Fleet, now_ns: int | None = None) -> Array:
        """Obstacles and lost robots, (k, 3: x, y, radius) in m; see ObstacleMonitor."""
        return self.monitor.discs_to_avoid(self._lost(fleet).values(), now_ns)

    def first_contact(self, fleet: Fleet, now_ns: int | None = None) -> str:
        """Text with the place at which a robot would touch an obstacle; empty if nowhere."""
        segment = replace(self.segment, trajectories=self._roster.trajectories(self.segment))
        return self.monitor.first_contact(segment, self.progress_s, self._lost(fleet), now_ns)

    def _lost(self, fleet: Fleet) -> dict[int, RobotView]:
        return {r: fleet[r] for r in self._roster.lost if r not in self._roster.out}

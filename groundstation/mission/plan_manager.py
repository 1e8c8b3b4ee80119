"""Present and next plan segment, and the plan that is waited for. Pure; groundstation/mission/mission.py decides when to plan.

A plan made in flight (groundstation/planning/replanning.py) becomes `next`, and is flown once all robots have it. A plan for
robots that hold (groundstation/planning/rest_to_rest.py) is adopted at once. Planning takes time: `request` is the plan to be
computed.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from groundstation.mission.obstacle_monitor import ObstacleMonitor
from groundstation.mission.roster import Roster
from groundstation.planning.feasibility import PlanError
from groundstation.planning.prioritized_planning import OutOfTime, never
from groundstation.planning.replanning import replan
from groundstation.planning.rest_to_rest import plan_regroup, plan_return
from groundstation.planning.segment import PlanSegment, ceil_to_period, first_contact
from groundstation.planning.shift import in_form, reshape
from groundstation.telemetry import Fleet, RobotView
from shoal.config.experiment import Experiment
from shoal.config.scene import read_form
from shoal.frames import Array
from shoal.messages.messages import Order, Trajectory

AHEAD_S = 2.0  # from the request to the beginning of another path: covers planning, and loading it into all robots
LAST_CALL_S = 0.3  # before the beginning: all robots must have the next segment by then


@dataclass(frozen=True)
class PlanRequest:
    """A plan that the mission waits for. The station calls `plan` and gives the mission its outcome."""

    name: str
    make: Callable[[OutOfTime], PlanSegment]

    def plan(self, out_of_time: OutOfTime = never) -> PlanSegment:
        """Compute the plan. Raises PlanError, also when `out_of_time`."""
        return self.make(out_of_time)


class PlanManager:
    """Plan segments of one mission. Times are on the clock that runs along the trajectories."""

    def __init__(self, experiment: Experiment, first: PlanSegment, starts: Mapping[int, Array], roster: Roster) -> None:
        """`starts`: poses (4,) in which the robots began."""
        self.segment = first
        self.next: PlanSegment | None = None  # flown from its beginning on, once all have it
        self.request: PlanRequest | None = None
        self.progress_s = 0.0  # along the trajectories; common to all, so that a resumed formation is still in step
        self.deadline_s = 0.0  # for all robots to have the next segment
        self.by_operator = False  # the other path was requested by the operator
        self.monitor = ObstacleMonitor(experiment)
        self._experiment, self._first, self._starts, self._roster = experiment, first, dict(starts), roster
        self._purpose: Callable[[Fleet, float], Callable[[OutOfTime], PlanSegment]] | None = None  # of coming to rest

    def reset(self) -> None:
        """Start again at the beginning of the first segment, with all robots."""
        self.segment, self.progress_s = self._first, 0.0
        self._roster.reset(self._first)

    def adopt(self, segment: PlanSegment) -> None:
        """Fly `segment` from now on."""
        self.segment, self.next = segment, None
        self._roster.adopt(segment)

    def trajectory_for(self, order: Order, robot: int) -> Trajectory | None:
        """Trajectory that a command to a robot is about; None if it has no part in the segment."""
        loads_next = self.next is not None and order in (Order.LOAD, Order.SWITCH)
        return self._roster.trajectory(self.next if loads_next else self.segment, robot)

    # --- plans

    def target_return(self) -> None:
        """Plan the next rest's segment back to the starts."""
        self._purpose = self._plan_return

    def target_slots(self) -> None:
        """Plan the next rest's segment into the slots of the present one, and on along it."""
        self._purpose = self._plan_regroup

    def target_current(self) -> None:
        """Plan the next rest's segment to where the present one leads."""
        self._purpose = self._plan_return if self.segment.is_return else self._plan_regroup

    @property
    def targets_return(self) -> bool:
        """True if the plan from rest leads back to the starts."""
        return self._purpose == self._plan_return

    def _plan_return(self, fleet: Fleet, begin_s: float) -> Callable[[OutOfTime], PlanSegment]:
        experiment, starts = self._experiment, self._starts
        rests, obstacles = self._roster.rest_poses(fleet), self.discs_to_avoid(fleet)
        return lambda out_of_time: plan_return(experiment, begin_s, rests, starts, obstacles, out_of_time)

    def _plan_regroup(self, fleet: Fleet, begin_s: float) -> Callable[[OutOfTime], PlanSegment]:
        experiment, segment, progress_s = self._experiment, self.segment, self.progress_s
        rests, slots = self._roster.rest_poses(fleet), self._roster.slots_in_use()
        obstacles = self.discs_to_avoid(fleet)
        return lambda out_of_time: plan_regroup(experiment, segment, begin_s, progress_s, rests, slots, obstacles, out_of_time)

    def request_plan_from_rest(self, fleet: Fleet) -> None:
        """Request the targeted plan, now that all robots rest. It uses the fleet as known now: it is computed in another
        thread while the mission goes on."""
        if self.request is None and self._purpose is not None:
            period_s = self._experiment.controller.period_s
            begin_s = ceil_to_period(self.progress_s + period_s, period_s)
            self.request = PlanRequest("from rest", self._purpose(fleet, begin_s))

    def request_replan(self, fleet: Fleet, now_ns: int, via: tuple[tuple[float, float], ...] = ()) -> None:
        """Request a path around obstacles, or through the operator's places `via` (x, y) in m."""
        begin_s = self._ahead_s()
        experiment, segment, obstacles = self._experiment, self.segment, self.discs_to_avoid(fleet, now_ns)
        self.deadline_s, self.by_operator = begin_s - LAST_CALL_S, bool(via)
        self.request = PlanRequest("another path", lambda _: replan(experiment, segment, begin_s, obstacles, via))

    def request_form(self, form: str, fleet: Fleet, now_ns: int) -> None:
        """Request another form from an instant ahead."""
        begin_s = self._ahead_s()
        self.deadline_s, self.by_operator = begin_s - LAST_CALL_S, True
        make = self.form_plan(form, begin_s, fleet, now_ns)
        self.request = PlanRequest("another form", lambda _: make())

    def draft_form(self, form: str, fleet: Fleet, now_ns: int, holds: bool) -> Callable[[], PlanSegment]:
        """Function that plans another form without asking for it. `holds`: robots hold, and transfers lead them into it."""
        if not holds:
            return self.form_plan(form, self._ahead_s(), fleet, now_ns)
        experiment, segment, progress_s = self._experiment, self.segment, self.progress_s
        return lambda: in_form(experiment, segment, progress_s, read_form(form, 0.0)[0])

    def form_plan(self, form: str, begin_s: float, fleet: Fleet, now_ns: int) -> Callable[[], PlanSegment]:
        """Function that plans another form from `begin_s` on. It raises PlanError."""
        experiment, segment, obstacles = self._experiment, self.segment, self.discs_to_avoid(fleet, now_ns)

        def make() -> PlanSegment:
            reshaped = reshape(experiment, segment, begin_s, read_form(form, begin_s))
            contact = first_contact(experiment, reshaped, begin_s, reshaped.end_s, obstacles)
            if contact:
                raise PlanError(f"something lies {contact}")
            return reshaped

        return make

    def _ahead_s(self) -> float:
        """Time along the trajectories at which another path may begin."""
        return ceil_to_period(self.progress_s + AHEAD_S, self._experiment.controller.period_s)

    def target_form(self, form: str) -> None:
        """Plan the next rest's segment into the slots of another form, and on along the present path."""
        experiment, segment, progress_s = self._experiment, self.segment, self.progress_s

        def plan(fleet: Fleet, begin_s: float) -> Callable[[OutOfTime], PlanSegment]:
            rests, slots, obstacles = self._roster.rest_poses(fleet), self._roster.slots_in_use(), self.discs_to_avoid(fleet)

            def make(out_of_time: OutOfTime) -> PlanSegment:
                """In the planner's thread: from the rest poses into the slots of the new form."""
                held = in_form(experiment, segment, progress_s, read_form(form, 0.0)[0])
                return plan_regroup(experiment, held, begin_s, progress_s, rests, slots, obstacles, out_of_time)

            return make

        self._purpose = plan

    # --- obstacles

    def discs_to_avoid(self, fleet: Fleet, now_ns: int | None = None) -> Array:
        """Obstacles and lost robots, (k, 3: x, y, radius) in m; see ObstacleMonitor."""
        return self.monitor.discs_to_avoid(self._lost(fleet), now_ns)

    def first_contact(self, fleet: Fleet, now_ns: int | None = None) -> str:
        """Text with the place at which a robot would touch an obstacle; empty if nowhere."""
        segment = replace(self.segment, trajectories=self._roster.trajectories(self.segment))
        return self.monitor.first_contact(segment, self.progress_s, self._lost(fleet), now_ns)

    def _lost(self, fleet: Fleet) -> list[RobotView]:
        return [fleet[r] for r in self._roster.lost if r not in self._roster.out]

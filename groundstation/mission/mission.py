"""READ FIRST. The mission of one run: from robots at rest in the water to the end of the run.

Pure. `step(fleet, results, now_ns, obstacles)` returns the commands to send; groundstation/station/station.py sends them. The
mission moves along the table in groundstation/mission/state_machine.py and in no other way. A command that is refused or
not answered is sent again (command_dispatcher.py) until the robot has had PATIENCE_S. plan_manager.py holds the present and
the next plan segment, timetable.py the instant at which the flight began. Planning takes time: `plan_request` is the plan
that the mission waits for, `planned` takes its outcome.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np

from groundstation.mission.command_dispatcher import MOVING, CommandDispatcher, CommandResult, Departures
from groundstation.mission.objections import (
    ARMED,
    LIVE,
    RequestContext,
    fit_to_rejoin,
    mode_name,
    objection,
    standing_objection,
    unfit_to_return,
)
from groundstation.mission.obstacle_monitor import ObstacleSet
from groundstation.mission.plan_manager import PlanMaker, PlanManager, PlanRequest
from groundstation.mission.roster import LED, Leader, Roster
from groundstation.mission.state_machine import (
    AT_REST,
    COMMITTED,
    IN_FLIGHT,
    JOINING,
    NOMINAL,
    PLANNING,
    TERMINAL,
    UNDER_WAY,
    MissionEvent,
    MissionState,
    next_state,
    rejection_reason,
)
from groundstation.mission.timetable import START_IN_S, ProgressGovernor, Timetable, turn_s
from groundstation.planning.feasibility import OutOfTime, PlanError
from groundstation.planning.segment import PlanSegment, sample
from groundstation.telemetry import (
    OUT_OF_STEP_S,
    Fleet,
    RobotView,
    blind_robots,
    first_lost_robot,
    foreign_poses,
    preflight,
)
from shoal.config.experiment import Experiment
from shoal.frames import Array, wrap
from shoal.messages import topics
from shoal.messages.messages import Command, CommandKind, Mode, RobotState

PATIENCE_S = 10.0  # for a robot to do what it was commanded; then the mission aborts
JOIN_WITHIN_S = 3.5  # for a robot to begin to fly with the others, who fly already: as long as robots fly without a station
TEST_PATIENCE_S = 12.0  # for the thruster test of all robots
SETTLE_S = 1.0  # from all robots holding and fit, to an automatic mission going on
AT_REST_MPS = 0.03  # slower than this counts as at rest
REST_WITHIN_S = 8.0  # then a hold is done, and planning begins, all the same: robots in waves never quite rest
ON_PATH_M = 0.04  # of its path: a robot farther beside it is led back by a plan. Setting out, it comes a centimetre farther
OUT_FOR_S = 0.3  # out of step for this long before all hold: states count with their age, but arrive with jitter

ATTENDED = "a person attends, and has to start it"  # an automatic mission, once somebody has taken a hand in it

UNFIT = frozenset({Mode.FAULT, Mode.STOPPED})
# States before anybody flies, in which the loss of a robot that was armed ends what was asked for.
PRESTART = frozenset({MissionState.ARMING, MissionState.STARTING, MissionState.TEST_ARMING})
RUN = UNDER_WAY - AT_REST | {MissionState.ENDING, MissionState.ABORTING}  # from the first command to the last robot's rest
BEFORE_FLIGHT = frozenset({MissionState.ARMING, MissionState.REARMING})  # armed robots are sent off next, if they may fly then
OTHER_FLIGHTS = (CommandKind.FORMATION, CommandKind.PATH)
# Requests whose refusal people see before they ask. Not those that make robots safe: they are asked for at any time.
TOLD_BEFORE = (CommandKind.RESUME, CommandKind.RETURN, CommandKind.REJOIN, CommandKind.GO, *OTHER_FLIGHTS)
ASKS_TO_ARM = frozenset(
    {CommandKind.LOAD, CommandKind.ARM, CommandKind.START, CommandKind.TEST, CommandKind.RETURN, CommandKind.REJOIN}
)


@dataclass(frozen=True)
class CommandStage:
    """A state that sends every robot one command until all have confirmed it."""

    order: CommandKind
    confirmed: Callable[[Mode | None, bool], bool]  # (mode, None if not known; trajectory loaded) -> done


STAGES: dict[MissionState, CommandStage] = {
    MissionState.LOADING: CommandStage(CommandKind.LOAD, lambda mode, loaded: loaded),
    MissionState.ARMING: CommandStage(CommandKind.ARM, lambda mode, loaded: mode in ARMED),
    MissionState.STARTING: CommandStage(CommandKind.START, lambda mode, loaded: mode is Mode.TRACKING),
    MissionState.RESUMING: CommandStage(CommandKind.RESUME, lambda mode, loaded: mode is Mode.TRACKING),
    MissionState.RELOADING: CommandStage(CommandKind.LOAD, lambda mode, loaded: loaded),
    MissionState.REARMING: CommandStage(CommandKind.ARM, lambda mode, loaded: mode in ARMED),
    MissionState.RELEASING: CommandStage(CommandKind.START, lambda mode, loaded: mode is Mode.TRACKING),
    MissionState.ENDING: CommandStage(CommandKind.DISARM, lambda mode, loaded: mode is Mode.DISARMED),
    MissionState.CLEARING: CommandStage(
        CommandKind.CLEAR_STOP, lambda mode, loaded: mode is not None and mode not in LIVE | {Mode.STOPPED}
    ),
    MissionState.ABORTING: CommandStage(CommandKind.DISARM, lambda mode, loaded: mode is not None and mode not in LIVE),
    MissionState.TEST_ARMING: CommandStage(CommandKind.ARM, lambda mode, loaded: mode is Mode.ARMED),
    MissionState.TEST_ENDING: CommandStage(CommandKind.DISARM, lambda mode, loaded: mode is Mode.DISARMED),
}
# States in which the last refusal replaces the reason. Elsewhere the reason that led to the state stays.
SHOWS_REFUSALS = frozenset(STAGES) - {MissionState.ENDING, MissionState.ABORTING}


@dataclass
class _StateData:
    """Data of the present state; every transition makes it new."""

    since_ns: int = 0  # of the transition; in PAUSED: since all robots hold and are fit
    waiting_since_ns: dict[int, int] = field(default_factory=dict)  # by robot that has not confirmed the stage's command
    out_of_step_since_ns: int | None = None


@dataclass
class _RunData:
    """Data of one run; each run makes it new."""

    ended_by: MissionEvent = MissionEvent.ALL_CONFIRMED  # event of ENDING when every robot is disarmed: how the run ended
    homeward: bool = False  # it began with RETURN, from rest
    gap: bool = False  # robots are to close up where one was lost; it may have been taken out of the water since


class Mission:
    """One run of an experiment. `automatic` goes from WAITING to DONE by itself; otherwise START is requested."""

    def __init__(
        self,
        experiment: Experiment,
        segment: PlanSegment,
        starts: Mapping[int, Array],
        automatic: bool,
        give_up_s: float | None = None,
    ) -> None:
        """`starts`: poses (4,) in which the robots begin. An automatic mission that nobody attends fails after
        `give_up_s` without progress along the path; None: it waits for ever."""
        self.state = MissionState.WAITING
        self.reason = ""  # of waiting, or of a failure
        self.automatic = automatic
        self.governor = ProgressGovernor(experiment.mission)
        self.roster = Roster(experiment.robot_ids, segment)
        self.plans = PlanManager(experiment, segment, starts, self.roster)
        self.departures = Departures()
        self._dispatcher = CommandDispatcher(experiment.hash, self.departures)
        self._experiment = experiment
        self._data, self._run = _StateData(), _RunData()
        self.cycle_ns = 0  # instant of the last cycle; 0 before the first
        self._timetable: Timetable | None = None  # of the last start
        self._still_to_arm: frozenset[int] = frozenset()  # robots that may be disarmed until a new plan arms them
        self._asked_ns = 0  # instant of the last request for which robots may be armed
        self._powered_ns: dict[int, float] = {}  # by robot that was armed since then: the last instant at which it was
        self._last_state: MissionState | None = None  # of the last request: the mission goes no further than this
        self._give_up_s = give_up_s if automatic else None
        self._progress: tuple[float, int] | None = None  # along the path [s], and the instant of its last change
        self._awaits_operator = False  # a person took a hand in it, or only a person can tell how to go on
        self._form = ""  # that a FORMATION asked for, and that the present segment does not have yet
        self.began_ns = 0  # instant at which the flight began, or will begin: time 0 for people; 0: it has not been started
        # How the last flight ended that was asked for by START, by a PATH in place of the way home, or by nobody in an
        # automatic mission, and how the way to it if nobody flew. None while it is under way, or before the first
        self.verdict: MissionState | None = None

    @property
    def segment(self) -> PlanSegment:
        return self.plans.segment

    @property
    def _awaits_return(self) -> bool:
        """True while a run that began with RETURN has no plan yet: nobody has flown in it, and it leads nowhere but home."""
        return self._run.homeward and not self.segment.is_return

    @property
    def _goes_on_by_itself(self) -> bool:
        """True if no request is needed to begin or resume: in an automatic mission whose run is not over, also when a thruster
        test after it has led to WAITING, and that does not wait for the operator."""
        return self.automatic and self.verdict is None and not self._awaits_operator

    @property
    def plan_request(self) -> PlanRequest | None:
        return self.plans.request

    # --- requests of the operator

    def request(
        self, order: CommandKind, fleet: Fleet, now_ns: int, via: Sequence[tuple[float, float]] = (), text: str = ""
    ) -> str:
        """Take up a request; `via`: places of a GO, `text`: form of a FORMATION, experiment of a PATH. Returns the reason of a
        refusal; empty when it is under way."""
        context = self.request_context(order, fleet, via, text)
        reason = rejection_reason(order, self.state) or objection(order, context)
        if reason:
            return reason
        self._give_up_s = None  # a person attends
        before, why = self.state, self.reason
        if order in ASKS_TO_ARM:
            self._may_arm(now_ns)
        if order in (CommandKind.LOAD, CommandKind.ARM, CommandKind.START, CommandKind.TEST):
            self._begin_run()
        if order is CommandKind.START:
            self.verdict = None
        self._last_state = {CommandKind.LOAD: MissionState.LOADING, CommandKind.ARM: MissionState.ARMING}.get(order)
        at_rest = before in AT_REST and order in OTHER_FLIGHTS
        if order is not CommandKind.TEST:  # a test makes no robot fly: what waits for the operator goes on waiting
            self._awaits_operator = order in (CommandKind.HOLD, CommandKind.CLEAR_STOP) or at_rest
        self._prepare(order, context)
        self._go(order, now_ns)
        if at_rest:
            flown = context.other_flight if order is CommandKind.PATH else None
            self.plans.request_at_rest(fleet, flown, text)
        if order is CommandKind.DISARM and before in TERMINAL | {MissionState.ENDING}:
            self.reason = why
        elif order is CommandKind.DISARM:
            if self._run.ended_by is MissionEvent.ALL_CONFIRMED:
                self._run.ended_by = MissionEvent.DISARMED_CANCELLED
            self.reason = f"a person asked for disarm while {before.value}"
        if order is CommandKind.RESUME:
            self._replan_if_needed(fleet, now_ns)
        if order is CommandKind.GO:
            self.plans.request_replan(fleet, now_ns, tuple(via))
        if order is CommandKind.FORMATION:
            self._form = text
            if self.state is MissionState.SWITCHING:
                self.plans.request_form(text, fleet, now_ns)
        return ""

    def _prepare(self, order: CommandKind, context: RequestContext) -> None:
        """Set roster and plans for a request, before the state changes."""
        fleet = context.fleet
        if order is CommandKind.RETURN:
            self._prepare_return(fleet)
        if order is CommandKind.REJOIN:
            self.roster.reinstate(fit_to_rejoin(self._context(fleet)))
            self._run.gap = self.roster.trouble
            if self._awaits_return:
                self.plans.target_return()
            else:
                self.plans.target_slots()
        if order in OTHER_FLIGHTS and self.state is MissionState.PAUSED and self._would_have_gap:
            self._close_slots(fleet)
        if order in OTHER_FLIGHTS and self.state in AT_REST:
            self.plans.reset()  # it begins another run, with all robots
        elif order is CommandKind.FORMATION and self.state is MissionState.PAUSED:
            self.plans.target_form(context.text)
        elif order is CommandKind.PATH:
            self.plans.target_flight(context.other_flight)
            if self._run.homeward:  # a flight of its own, in place of the way home
                self._run.homeward, self.verdict = False, None
        if order in (CommandKind.RETURN, CommandKind.REJOIN, *OTHER_FLIGHTS):
            self._still_to_arm = frozenset(r for r in self.roster.active if fleet[r].mode is Mode.DISARMED)
        if order is CommandKind.HOLD:
            self.roster.take_back()
            if self.state in PLANNING:
                self._drop_disarmed(fleet)

    def draft(self, order: CommandKind, text: str, fleet: Fleet, now_ns: int) -> PlanMaker:
        """Function that plans what a FORMATION or a PATH would fly, without asking for it: by the robots that would fly it,
        each with its trajectory under its own number. Raises PlanError with the reason against the request."""
        context = self.request_context(order, fleet, text=text)
        reason = rejection_reason(order, self.state) or objection(order, context)
        if reason:
            raise PlanError(reason)
        roster = context.roster
        if self.state is MissionState.PAUSED and self._would_have_gap:
            roster = copy(roster)
            roster.reassign_slots(*self.plans.formation, fleet)
        other = context.other_flight if order is CommandKind.PATH else None
        make = self.plans.of_roster(roster).draft(text, other, fleet, now_ns, self.state)

        def by_robot(out_of_time: OutOfTime) -> PlanSegment:
            segment = make(out_of_time)
            return replace(segment, trajectories=roster.trajectories(segment))

        return by_robot

    def takes_out(self, order: CommandKind) -> bool:
        """True if such an order takes its robot out of the formation: in flight always, while all hold DISARM and OUT."""
        return self.state in NOMINAL or (self.state is MissionState.PAUSED and order in (CommandKind.DISARM, CommandKind.OUT))

    def lead(self, robot: int, order: CommandKind) -> None:
        """Let a person lead one robot."""
        self._give_up_s = None
        self._awaits_operator = True
        self.roster.led_by[robot] = Leader.PERSON
        if self.takes_out(order) and robot not in self.roster.lost:
            self.roster.mark_lost(robot, LED)

    def note_water(self, robot: int, is_out: bool) -> None:
        """Take note that a robot is out of the water, or back in it. Somebody's hands are in the water: an automatic mission
        waits for a person's START or RESUME."""
        self._give_up_s = None
        self._awaits_operator = True
        if is_out:
            self.roster.take_out(robot)
        else:
            self.roster.put_back(robot, self.state in AT_REST | {MissionState.STOPPED})

    def objection(self, order: CommandKind, fleet: Fleet, via: Sequence[tuple[float, float]] = (), text: str = "") -> str:
        """Reason against a request in a state that allows it; empty if there is none."""
        return objection(order, self.request_context(order, fleet, via, text))

    def refusals(self, fleet: Fleet) -> dict[CommandKind, str]:
        """Reasons for which requests would be refused now, whatever their details, by request that the state allows."""
        reasons = {
            order: standing_objection(order, self.request_context(order, fleet))
            for order in TOLD_BEFORE
            if not rejection_reason(order, self.state)
        }
        return {order: reason for order, reason in reasons.items() if reason}

    def request_context(
        self, order: CommandKind, fleet: Fleet, via: Sequence[tuple[float, float]] = (), text: str = ""
    ) -> RequestContext:
        """State of mission and fleet that a request is judged by. From rest, it takes in robots that the last run had lost."""
        from_rest = order in (CommandKind.RETURN, *OTHER_FLIGHTS) and self.state in AT_REST
        roster = Roster(self._experiment.robot_ids, self.segment, self.roster.out) if from_rest else self.roster
        transfer = self.segment.is_separate(self.plans.progress_s)
        return replace(self._context(fleet, roster, via), text=text, transfer=transfer, homeward=self._awaits_return)

    def _context(self, fleet: Fleet, roster: Roster | None = None, via: Sequence[tuple[float, float]] = ()) -> RequestContext:
        planning = self.state in AT_REST and self.plans.request is not None
        return RequestContext(
            self._experiment, self.plans.flown, self.state, roster or self.roster, self.segment, self.plans.starts, fleet, via,
            planning=planning,
        )  # fmt: skip

    def _may_arm(self, now_ns: int) -> None:
        """Note that robots may be armed from now on, each until it loses its power again."""
        self._asked_ns, self._powered_ns = now_ns, {}

    def _begin_run(self) -> None:
        self._run, self.began_ns = _RunData(), 0
        self.plans.reset()
        self.governor.start()

    def _prepare_return(self, fleet: Fleet) -> None:
        """Aim all robots that can fly at the places where they started. Those that cannot are lost."""
        if self.state in AT_REST:
            began_ns = self.began_ns
            self._begin_run()
            self._run.homeward, self.began_ns = True, began_ns  # the way home belongs to the flight before, as in the report
        self._run.gap = self._run.gap or self.roster.closed  # home they fly each to its own start, and may then fly on
        for robot in self.roster.active:
            why = unfit_to_return(self._context(fleet), robot)
            if why:
                self.roster.mark_lost(robot, why)
        self.plans.target_return()

    # --- the cycle

    def step(
        self, fleet: Fleet, results: Sequence[CommandResult], now_ns: int, obstacles: ObstacleSet | None = None
    ) -> tuple[Command, ...]:
        """Do one cycle; returns the commands to send now. `obstacles` None: as in the cycle before."""
        elapsed_s = (now_ns - self.cycle_ns) * 1e-9 if self.cycle_ns else 0.0
        self.cycle_ns = now_ns
        own_results = [result for result in results if result.command.robot in self.roster.all_robots]
        left_out = self.roster.all_robots if self.state in AT_REST else self.roster.lost  # silence of theirs stops nothing
        counted = [r for r in own_results if not (r.reply.silent and r.command.robot in left_out)]
        refused = self._dispatcher.on_results(counted, now_ns)
        self._note_power(fleet, own_results, now_ns)
        if refused and (not self.reason or self.state in SHOWS_REFUSALS):
            self.reason = refused
        self.plans.monitor.update(obstacles, now_ns)
        self.departures.note_fleet(fleet, now_ns)
        if self._give_up_s is not None and self.state in UNDER_WAY:
            self._check_progress(self._give_up_s, now_ns)
        if self.state is MissionState.WAITING:
            self._wait(fleet, now_ns)
        if self.state in COMMITTED:
            self._handle_losses(fleet, now_ns)
        if self.state in IN_FLIGHT | JOINING:
            self._check_in_step(fleet, now_ns)
        if self.state in IN_FLIGHT | JOINING and (foreign := foreign_poses(self._experiment, fleet, self.roster.active)):
            self._go(MissionEvent.FOREIGN_POSES, now_ns)
            self.reason = foreign
        holds_its_progress = self.state is MissionState.PAUSED and not self._awaits_return
        if (self.state in IN_FLIGHT or holds_its_progress) and self.roster.active:
            self._check_flight(fleet, now_ns)
        self._govern(fleet, elapsed_s, now_ns)
        return self._commands(fleet, now_ns) + self._command_others(fleet, now_ns)

    def _commands(self, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        """The commands of this cycle, by the mission's state."""
        if self.state in STAGES:
            return self._drive(STAGES[self.state], fleet, now_ns)
        if self.state is MissionState.SWITCHING:
            return self._switch(fleet, now_ns)
        if self.state is MissionState.HALTING:
            return self._halt(fleet, now_ns)
        if self.state is MissionState.TESTING:
            return self._test(fleet, now_ns)
        if self.state is MissionState.PAUSED:
            return self._pause(fleet, now_ns)
        if self.state is MissionState.STOPPED:
            return self._send(CommandKind.STOP, _not_in(Mode.STOPPED, fleet, self._experiment.robot_ids), now_ns)
        return ()

    def _command_others(self, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        """Commands for robots that have no part in what the mission does. One that moves, and is led by no person, is told to
        hold; one that is out of the water is disarmed, it may be in somebody's hands. A robot may receive though it is not
        heard, so its last known mode counts. The mission does not wait for it."""
        if self.state is MissionState.ENDING:  # lost robots that are heard are disarmed with the others
            silent = [r for r in self.roster.lost if not fleet[r].heard and fleet[r].mode in LIVE]
            return self._send(CommandKind.DISARM, silent, now_ns)
        if self.state is MissionState.STOPPED:  # every robot is sent STOP
            return ()
        disarm = self._send(CommandKind.DISARM, [r for r in sorted(self.roster.out) if fleet[r].mode in LIVE], now_ns)
        others: Iterable[int] = ()
        if self.state in AT_REST:
            others = self.roster.all_robots
        elif self.state in COMMITTED:
            others = self.roster.lost
        left_alone = self.roster.led_by_people | self.roster.out
        moving = [r for r in others if fleet[r].mode in MOVING and r not in left_alone]
        return disarm + self._send(CommandKind.HOLD, moving, now_ns)

    def _wait(self, fleet: Fleet, now_ns: int) -> None:
        """Wait for START. In automatic mode begin by itself once preflight passes and nothing moves."""
        moves = any(fleet[r].heard and fleet[r].mode in MOVING for r in self.roster.all_robots)
        reasons = preflight(self._experiment, fleet, self.plans.starts)
        self.reason = "; ".join(reasons) or (ATTENDED if self.automatic and not self._goes_on_by_itself else "")
        if self._goes_on_by_itself and not reasons and not moves:
            self._may_arm(now_ns)
            self._begin_run()
            self._go(MissionEvent.PREFLIGHT_PASSED, now_ns)

    def _check_progress(self, give_up_s: float, now_ns: int) -> None:
        """Fail a mission that has made no progress along its path for `give_up_s`."""
        if self._progress is None or self._progress[0] != self.plans.progress_s:
            self._progress = self.plans.progress_s, now_ns
        elif now_ns - self._progress[1] > give_up_s * 1e9:
            why = f"{self.state.value}{f': {self.reason}' if self.reason else ''}"
            self._fail(MissionEvent.NO_PROGRESS, f"no progress for {give_up_s:g} s, and nobody attends: {why}", now_ns)

    # --- checks in flight

    def behind_s(self, robot: int, view: RobotView, now_ns: int) -> float:
        """Lag of a robot behind the fleet's timetable, from its own state; negative: ahead. 0 without a timetable, and for a
        robot on another trajectory than the formation's."""
        flown = self._timetable if self.state in IN_FLIGHT | JOINING else None
        if flown is None or self._clock_s(robot, view) is None:
            return 0.0
        return flown.behind_s(view, self.governor, now_ns)

    def flying(self, fleet: Fleet) -> dict[int, RobotState]:
        """States of the robots that fly the formation's trajectories now."""
        plans = {r: self.roster.plans(r, self.segment, self.plans.next) for r in fleet}
        return {r: view.state for r, view in fleet.items() if view.state is not None and plans[r].under_way(view.state)}

    def _clock_s(self, robot: int, view: RobotView) -> float | None:
        """Progress of a robot along the formation's trajectories in s; None while it is on another."""
        return self.roster.plans(robot, self.segment, self.plans.next).clock_s(view.state)

    def _check_in_step(self, fleet: Fleet, now_ns: int) -> None:
        """Hold the fleet when, for OUT_FOR_S, a robot flies another plan or by another timetable than the others."""
        out = ""
        for robot in self.roster.active:
            behind_s = self.behind_s(robot, fleet[robot], now_ns)
            if abs(behind_s) > OUT_OF_STEP_S:
                out = f"robot {robot} is {abs(behind_s):.1f} s {'behind' if behind_s > 0.0 else 'ahead of'} the others"
                break
            tracks = fleet[robot].heard and fleet[robot].mode is Mode.TRACKING
            switching = self.state is MissionState.SWITCHING
            if tracks and not switching and not self.roster.has_segment(self.segment, fleet, robot):
                out = f"robot {robot} flies another plan than the others"
                break
        if not out:
            self._data.out_of_step_since_ns = None
        elif self._data.out_of_step_since_ns is None:
            self._data.out_of_step_since_ns = now_ns
        elif now_ns - self._data.out_of_step_since_ns >= OUT_FOR_S * 1e9:
            self._go(MissionEvent.OUT_OF_STEP, now_ns)
            self.reason = out

    def _check_flight(self, fleet: Fleet, now_ns: int) -> None:
        """Update the fleet's progress, and go where the first event in flight leads."""
        plans = self.plans
        in_step = [r for r in self.roster.active if abs(self.behind_s(r, fleet[r], now_ns)) <= OUT_OF_STEP_S]
        clocks_s = [clock_s for r in in_step if (clock_s := self._clock_s(r, fleet[r])) is not None]
        progress_s = min(*clocks_s, self.segment.end_s) if clocks_s else plans.progress_s  # no plan begins beyond the end
        if self.state is MissionState.PAUSED:  # all go on from the slowest robot's progress, except one that fell out of step
            plans.progress_s = max(plans.progress_s, progress_s)
            return
        plans.progress_s = progress_s
        event_and_reason = self._flight_event(fleet, now_ns)
        if event_and_reason is None:
            return
        event, reason = event_and_reason
        if event is MissionEvent.TRANSFER_BLOCKED:
            plans.target_current()
        self._go(event, now_ns)
        self.reason = reason
        if event is MissionEvent.OBSTACLE:
            plans.request_replan(fleet, now_ns)

    def _flight_event(self, fleet: Fleet, now_ns: int) -> tuple[MissionEvent, str] | None:
        """Detect events in flight, in order of urgency: end of path, hold, blindness, lost robot, obstacle, lag. Returns the
        event and the reason for people. Losses come before (`_handle_losses`)."""
        active, segment, progress_s = self.roster.active, self.segment, self.plans.progress_s
        if progress_s >= segment.end_s:
            return MissionEvent.ARRIVED, ""
        holding = [robot for robot in active if fleet[robot].mode is Mode.HOLDING]
        if (
            holding and now_ns - self._data.since_ns > topics.STATE.max_age_s * 1e9
        ):  # earlier, the mode may be of the state before
            state = fleet[holding[0]].state
            return MissionEvent.ROBOT_HOLDING, f"robot {holding[0]} holds: {state.fault if state else ''}"
        if blind := blind_robots(self._experiment, fleet, active):
            return MissionEvent.BLIND, blind
        if self.state is MissionState.RUNNING and segment.is_return:
            return MissionEvent.RETURN_STARTED, ""
        if self.state is MissionState.RUNNING and self.roster.lost:
            return MissionEvent.ROBOT_MISSING, "; ".join(f"robot {r}: {why}" for r, why in self.roster.lost.items())
        if self.state not in NOMINAL | {MissionState.RETURNING}:
            return None
        contact = self.plans.first_contact(fleet, now_ns)  # takes a millisecond: not before the other checks
        if contact:
            event = MissionEvent.TRANSFER_BLOCKED if segment.is_separate(progress_s) else MissionEvent.OBSTACLE
            return event, contact
        if self.state is MissionState.RETURNING:
            return None
        slowed = self.governor.slowed
        if slowed and self.state is not MissionState.SLOWED:
            worst = max(active, key=lambda robot: fleet[robot].error_m)
            return MissionEvent.LAGGING, f"robot {worst} is {fleet[worst].error_m:.2f} m from its place"
        return (MissionEvent.CAUGHT_UP, "") if self.state is MissionState.SLOWED and not slowed else None

    def _may_not_fly(self, fleet: Fleet) -> str:
        """Reason for which no robot may begin to fly now, whatever it is armed for; empty if there is none."""
        robots = self.roster.active
        return foreign_poses(self._experiment, fleet, robots) or blind_robots(self._experiment, fleet, robots)

    def _handle_losses(self, fleet: Fleet, now_ns: int) -> None:
        """Apply the experiment's policy (mission.lost) to a robot that is lost. A plan from rest that counts on it is made
        anew."""
        may_arm = self._still_to_arm if self.state in PLANNING else frozenset()
        still_to_arm = [r for r in may_arm if not self._lost_power(r, fleet[r], now_ns)]
        loss = first_lost_robot(self.roster.active, fleet, still_to_arm)
        if loss is None:
            return
        robot, why = loss
        policy = self._experiment.mission.lost
        returns = self.plans.targets_return if self.state in PLANNING else self.segment.is_return or self._awaits_return
        if policy == "abort" or len(self.roster.active) == 1:
            self._fail(MissionEvent.LOST, f"robot {robot}: {why}", now_ns)
            return
        self.roster.mark_lost(robot, why)
        self._run.gap = self._run.gap or policy == "close-up"
        if policy == "hold":
            if self.state in PLANNING:
                self._drop_disarmed(fleet)
            if not self.roster.active:
                self._fail(MissionEvent.LOST_ALL, f"robot {robot}: {why}", now_ns)
                return
            if self.state is not MissionState.PAUSED:
                self._go(MissionEvent.LOST_HOLD, now_ns)
            self._awaits_operator = True
        elif policy == "close-up" and not returns:
            held = self._awaits_operator or self._may_not_fly(fleet)
            if not (held and self.state is MissionState.PAUSED):  # else when they may go on
                self._close_up(fleet, now_ns)
        elif next_state(self.state, MissionEvent.LOST_REPLAN) is not None:
            self._go(MissionEvent.LOST_REPLAN, now_ns)
        self.reason = f"robot {robot}: {why}"

    def _drop_disarmed(self, fleet: Fleet) -> None:
        """Count disarmed robots as lost: they were to be armed for a plan that is now not flown, and cannot hold."""
        for robot in self.roster.active:
            if fleet[robot].mode is Mode.DISARMED:
                self.roster.mark_lost(robot, "disarmed")

    @property
    def _has_gap(self) -> bool:
        """True if robots are to close up where one was lost, whatever a person asks of those that hold. On the way home, where
        each flies to its own start, there is no formation."""
        return self._would_have_gap and not self.segment.is_return

    @property
    def _would_have_gap(self) -> bool:
        """True if the formation would have a gap, in the slots that its robots have now, that they are to close."""
        closes = self._experiment.mission.lost == "close-up"
        return closes and (self._run.gap or self.roster.trouble) and self.roster.has_gap

    def _close_slots(self, fleet: Fleet) -> None:
        self._run.gap = False
        self.roster.reassign_slots(*self.plans.formation, fleet)

    def _close_up(self, fleet: Fleet, now_ns: int) -> None:
        """Close the gap of a lost robot: assign slots anew, and plan the way into them."""
        self._close_slots(fleet)
        if self._form:  # the gap closes on the way into the form that was asked for
            self.plans.target_form(self._form)
        elif not (self.state in PLANNING and self.plans.targets_flight):  # or on the way to the path that was
            self.plans.target_slots()
        self._go(MissionEvent.LOST_CLOSE_UP, now_ns)

    def _govern(self, fleet: Fleet, elapsed_s: float, now_ns: int) -> None:
        flies = self.state in IN_FLIGHT and self._timetable is not None and now_ns >= self._timetable.start_ns
        worst_m = max((fleet[r].error_m for r in self.roster.active), default=0.0)
        self.governor.step(worst_m if flies else None, elapsed_s)

    # --- stages

    def _drive(self, stage: CommandStage, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        """Send a stage's command until all have confirmed it; then go on."""
        waiting = [r for r in self._addressed(fleet) if not self._has_confirmed(r, stage, fleet, now_ns)]
        if not waiting:
            if self.state is not self._last_state:
                if self.state in BEFORE_FLIGHT and (why := self._may_not_fly(fleet)):
                    self.reason = why
                else:
                    ending = self.state is MissionState.ENDING
                    self._go(self._run.ended_by if ending else MissionEvent.ALL_CONFIRMED, now_ns)
            self._data.waiting_since_ns.clear()
            return ()
        unfit = [r for r in waiting if fleet[r].mode in UNFIT or self._lost_power(r, fleet[r], now_ns)]
        lost = first_lost_robot(unfit, fleet)
        if lost is not None and self.state in PRESTART:  # it would accept no command but DISARM
            self._on_timeout(f"robot {lost[0]}: {lost[1]}", now_ns)
            return ()
        flying = [r for r in waiting if self._spoke(fleet[r], now_ns) and fleet[r].mode in LIVE]
        if flying and self.state is MissionState.CLEARING:  # the stop has not reached it: cleared, it would fly on
            self._on_timeout(f"robot {flying[0]} has not stopped: it is {mode_name(fleet[flying[0]])}", now_ns)
            return ()
        since_ns = self._data.waiting_since_ns
        self._data.waiting_since_ns = since_ns = {r: since_ns.get(r, now_ns) for r in waiting}
        patience_s = JOIN_WITHIN_S if self.state in JOINING else PATIENCE_S
        late = [r for r in waiting if now_ns - since_ns[r] > patience_s * 1e9]
        if late:
            robots = ", ".join(map(str, late))
            text = f"robot {robots} does not follow {stage.order.name}"  # also of a second stage with the same command
            self._on_timeout(self.reason if self.reason.startswith(text) else f"{text}: {self.reason or 'no answer'}", now_ns)
            return ()
        if stage.order is CommandKind.ARM:  # under power it refuses; restarted meanwhile, it would be armed by this
            waiting = [r for r in waiting if fleet[r].mode not in LIVE]
        moving = [r for r in waiting if self.state in PLANNING and fleet[r].mode in MOVING]  # a plan from rest is not for them
        others = [r for r in waiting if r not in moving]
        return self._send(CommandKind.HOLD, moving, now_ns) + self._send(stage.order, others, now_ns)

    def _note_power(self, fleet: Fleet, results: Sequence[CommandResult], now_ns: int) -> None:
        """Remember which robots were armed since the last request for which they may be, by their states and replies."""
        for robot, view in fleet.items():
            sent_ns = now_ns - view.state_age_s * 1e9
            if view.mode in LIVE and sent_ns >= self._asked_ns:
                self._powered_ns[robot] = max(sent_ns, self._powered_ns.get(robot, sent_ns))
        accepted = [r.command.robot for r in results if r.command.order is CommandKind.ARM and r.reply.accepted]
        self._powered_ns |= dict.fromkeys(accepted, now_ns)

    def _lost_power(self, robot: int, view: RobotView, now_ns: int) -> bool:
        """True for a robot that was armed since the last request, and is disarmed now, after a restart for example. It is not
        armed again without another request."""
        powered_ns = self._powered_ns.get(robot)
        return view.mode is Mode.DISARMED and powered_ns is not None and view.state_age_s * 1e9 < now_ns - powered_ns

    def _has_confirmed(self, robot: int, stage: CommandStage, fleet: Fleet, now_ns: int) -> bool:
        """True if a fresh state shows that the robot has done the stage's command. For DISARM and CLEAR_STOP only a state
        that was sent since the stage began counts: an ARM or a STOP may have been on its way. It may still be: so a DISARM is
        sent in any case, and comes behind the ARM."""
        if stage.order is CommandKind.DISARM and not self._dispatcher.has_sent(robot):
            return False
        view = fleet[robot]
        needs_newer_state = stage.order in (CommandKind.DISARM, CommandKind.CLEAR_STOP)
        is_fresh = self._spoke(view, now_ns) or (view.heard and not needs_newer_state)
        return is_fresh and stage.confirmed(view.mode, self.roster.has_loaded(self.segment, fleet, robot))

    def _spoke(self, view: RobotView, now_ns: int) -> bool:
        """True if a robot's newest state was sent since the mission's state began, however late it came."""
        return view.state_age_s * 1e9 <= now_ns - self._data.since_ns

    def _addressed(self, fleet: Fleet) -> Sequence[int]:
        """Robots that get a stage's command. DISARM also goes to lost robots that are heard, or were heard until just now."""
        all_robots = self.roster.all_robots
        if self.state in (MissionState.ABORTING, MissionState.CLEARING):
            return [r for r in all_robots if r not in self.roster.out or fleet[r].heard]
        if self.state is MissionState.ENDING:
            lost = self.roster.lost
            return [r for r in all_robots if r not in lost or (fleet[r].mode is not Mode.STOPPED and may_move(fleet[r]))]
        return self.roster.active

    def _pause(self, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        """Hold all robots. An automatic mission goes on by itself when all hold and are fit for SETTLE_S."""
        moving = _not_in(Mode.HOLDING, fleet, self.roster.active)
        unfit = preflight(self._experiment, {r: fleet[r] for r in self.roster.active})
        if moving or unfit or (not self._may_replan and self.plans.first_contact(fleet)):
            self._data.since_ns = now_ns
        elif self._goes_on_by_itself and now_ns - self._data.since_ns > SETTLE_S * 1e9:
            self._go(MissionEvent.RECOVERED, now_ns)
            self._replan_if_needed(fleet, now_ns)
            return ()
        receivers = [r for r in moving + self._may_set_off(fleet) if r not in self.roster.led_by_people]
        return self._send(CommandKind.HOLD, receivers, now_ns)

    def _may_set_off(self, fleet: Fleet) -> list[int]:
        """Robots that say that they hold, and may set off all the same."""
        return [r for r in self.roster.active if fleet[r].mode is Mode.HOLDING and self.departures.may_come(r)]

    @property
    def _may_replan(self) -> bool:
        """True if robots leave a blocked path for a new plan from rest; False if they wait until it is free."""
        return bool(self.roster.lost) or self.segment.is_separate(self.plans.progress_s)

    def _replan_if_needed(self, fleet: Fleet, now_ns: int) -> None:
        """After RESUMING began: plan from rest where robots cannot simply go on.

        The reasons: robots are to return, and have no plan yet; a gap is to be closed; they are on different plans; one rests
        beside its path; an obstacle, a lost robot for example, lies on the path.
        """
        if self._awaits_return:
            self.plans.target_return()
            self._go(MissionEvent.OFF_PLAN, now_ns)
            return
        if self._has_gap:
            self._close_up(fleet, now_ns)
            return
        off_plan = [
            f"robot {r} has another plan" for r in self.roster.active if not self.roster.has_segment(self.segment, fleet, r)
        ]
        blocked = not off_plan and self._may_replan and self.plans.first_contact(fleet)
        if not off_plan and not blocked:
            away_m, robot = self._go_on_from_rest(fleet, now_ns)
            # a lost robot may bar every plan from rest: the others then go on from farther beside their paths
            most_m = self._experiment.safety.join_within_m if self.roster.lost else ON_PATH_M
            off_plan = [f"robot {robot} is {away_m:.2f} m from its place"] if away_m > most_m else []
        if off_plan:
            self.plans.target_current()
            self._go(MissionEvent.OFF_PLAN, now_ns)
            self.reason = "; ".join(off_plan)
        elif blocked:
            self.plans.target_current()
            self._go(MissionEvent.LOST_NEARBY if self.roster.lost else MissionEvent.TRANSFER_BLOCKED, now_ns)

    def _go_on_from_rest(self, fleet: Fleet, now_ns: int) -> tuple[float, int]:
        """Set progress and timetable of RESUMING: robots go on where their trajectories come nearest to where they rest,
        beyond the progress, and when all have had the time to turn there: in HOLD the heading is free. Returns the largest
        distance in m from there of a robot, as it is and as it will rest, and the robot."""
        plans, vehicle, period_s = self.plans, self._experiment.vehicle, self._experiment.controller.period_s
        left_s = min(self.segment.end_s - plans.progress_s, REST_WITHIN_S)  # by then they had come to rest
        ahead_s = plans.progress_s + period_s * np.arange(max(round(left_s / period_s), 1), dtype=np.float64)
        poses_ahead = {r: sample(t, ahead_s).eta for r, t in self.roster.trajectories(self.segment).items()}
        if not poses_ahead:
            return 0.0, 0
        distances_m = np.array([np.linalg.norm(eta[:, :3] - _rest_m(fleet[r]), axis=1) for r, eta in poses_ahead.items()])
        farthest_m = distances_m.max(axis=0)  # of any robot from its trajectory, at each instant
        still_falls = np.append(np.diff(farthest_m) < 0.0, False)
        nearest = int(np.argmin(still_falls))  # the first instant at which it falls no more
        turns_rad = [wrap(eta.item(nearest, 3) - fleet[r].eta.item(3)) for r, eta in poses_ahead.items()]
        starts_in_s = START_IN_S + max(turn_s(vehicle, turn_rad) for turn_rad in turns_rad)
        plans.progress_s = float(ahead_s[nearest])
        self._timetable = Timetable(now_ns + round(starts_in_s * 1e9), plans.progress_s + self.governor.lag_s)
        now_m = [np.linalg.norm(eta[nearest, :3] - fleet[r].eta[:3]) for r, eta in poses_ahead.items()]
        away_m = np.maximum(distances_m[:, nearest], now_m)
        return float(away_m.max()), list(poses_ahead)[int(away_m.argmax())]

    def _halt(self, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        """Bring all moving robots to rest, then request the plan."""
        flying = [r for r in self.roster.active if fleet[r].mode in MOVING]
        waited_s = (now_ns - self._data.since_ns) * 1e-9
        if flying:
            if waited_s > PATIENCE_S:
                self._on_timeout(f"robot {', '.join(map(str, flying))} does not follow HOLD", now_ns)
                return ()
            return self._send(CommandKind.HOLD, flying + self._may_set_off(fleet), now_ns)
        fast = any(fleet[r].speed_mps > AT_REST_MPS for r in self.roster.active if fleet[r].mode is Mode.HOLDING)
        if not fast or waited_s > REST_WITHIN_S:
            self.plans.request_plan_from_rest(fleet)
        return self._send(CommandKind.HOLD, self._may_set_off(fleet), now_ns)

    def _test(self, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        """Have each robot test its thrusters, until all have a result."""
        results = {r: self._test_result(r, fleet[r], now_ns) for r in self.roster.active}
        if all(result not in ("", "running") for result in results.values()):
            self._go(MissionEvent.ALL_CONFIRMED, now_ns)
            failed = [f"robot {r}: {result}" for r, result in results.items() if result != "passed"]
            self.reason = "; ".join(failed) or "all thrusters as asked"
            return ()
        if now_ns - self._data.since_ns > TEST_PATIENCE_S * 1e9:
            self._on_timeout(f"the thruster test does not end: {results}", now_ns)
            return ()
        return self._send(CommandKind.TEST, [r for r in self.roster.active if r not in self._dispatcher.tested], now_ns)

    def _test_result(self, robot: int, view: RobotView, now_ns: int) -> str:
        """Result from a state sent since the robot accepted TEST; an earlier state is about an earlier test."""
        taken_ns = self._dispatcher.tested.get(robot)
        if view.state is None or taken_ns is None or view.state_age_s * 1e9 > now_ns - taken_ns:
            return ""
        return view.state.thruster_test

    # --- plans

    def planned(self, outcome: PlanSegment | PlanError, fleet: Fleet, now_ns: int) -> None:
        """Take the outcome of the requested plan."""
        request, self.plans.request = self.plans.request, None
        if self.state in AT_REST and request is not None and request.flight is not None:
            if isinstance(outcome, PlanSegment):
                self.plans.adopt_at_rest(outcome, request.flight)
            else:
                self.plans.failure = str(outcome)
        elif self.state is MissionState.HALTING:
            if isinstance(outcome, PlanSegment):
                self.plans.adopt(outcome, request.flight if request is not None else None)
                self._form = ""  # taken once more, a turn would be twice as far
                self._go(MissionEvent.PLANNED, now_ns)
            else:
                self._drop_disarmed(fleet)
                why = f"no way from here: {outcome}"
                if not self.roster.active:
                    self._fail(MissionEvent.LOST_ALL, why, now_ns)
                    return
                self._go(MissionEvent.NO_PLAN, now_ns)
                self._awaits_operator = True
                self.reason = why
        elif self.state is MissionState.SWITCHING:
            if isinstance(outcome, PlanSegment):
                self.plans.next = outcome
                self._dispatcher.loaded.clear()
                return
            before, by_operator = self.reason, self.plans.by_operator
            self._go(MissionEvent.NO_PLAN if by_operator else MissionEvent.BLOCKED, now_ns)
            self.reason = f"no way there: {outcome}" if by_operator else f"{before}; no way round: {outcome}"

    def _switch(self, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        """Load the next segment into all robots; when all have it, let them go over to it at its beginning."""
        plans = self.plans
        if plans.next is None:
            if plans.progress_s > plans.deadline_s:
                self._on_timeout("no plan in time", now_ns)
            return ()
        going = [r for r in self.roster.active if not self.roster.has_segment(plans.next, fleet, r)]
        if not going:
            plans.adopt(plans.next)
            self._go(MissionEvent.ALL_CONFIRMED, now_ns)
            return ()
        if plans.progress_s > plans.deadline_s:
            self._on_timeout(f"robot {', '.join(map(str, going))} has not gone over in time: {self.reason}", now_ns)
            return ()
        trajectories = {r: self.roster.trajectory(plans.next, r) for r in going}
        missing = [r for r, t in trajectories.items() if t is None or (r, t.id) not in self._dispatcher.loaded]
        return self._send(CommandKind.LOAD, missing, now_ns) if missing else self._send(CommandKind.SWITCH, going, now_ns)

    # --- commands and transitions

    def _send(self, order: CommandKind, robots: Sequence[int], now_ns: int) -> tuple[Command, ...]:
        begins = order in (CommandKind.START, CommandKind.RESUME)
        trajectories = {robot: self.plans.trajectory_for(order, robot) for robot in robots}
        return self._dispatcher.commands(order, trajectories, now_ns, self._timetable if begins else None)

    def _fail(self, event: MissionEvent, reason: str, now_ns: int) -> None:
        self._run.ended_by = MissionEvent.DISARMED_FAILED
        self._go(event, now_ns)
        self.reason = reason

    def _on_timeout(self, reason: str, now_ns: int) -> None:
        if self.state is MissionState.SWITCHING:  # leads to PAUSED: the run goes on
            self._go(MissionEvent.TIMEOUT, now_ns)
            self.reason = reason
        else:
            self._fail(MissionEvent.TIMEOUT, reason, now_ns)

    def _go(self, cause: CommandKind | MissionEvent, now_ns: int) -> None:
        """Follow the table. Raises RuntimeError where it has no row: a bug."""
        state = next_state(self.state, cause)
        if state is None:
            raise RuntimeError(f"{cause.name} leads nowhere from {self.state.name}")
        if state not in TERMINAL | {MissionState.ABORTING}:
            self.reason = ""
        ends = state in TERMINAL or (state is MissionState.STOPPED and self.state in RUN)
        if ends and self.verdict is None:  # else a test, a cleared stop, a DISARM or a way home after that
            self.verdict = state
        elif state is MissionState.STARTING:
            self.verdict = None
        if state is MissionState.HALTING and self.state not in PLANNING and isinstance(cause, MissionEvent):
            self._still_to_arm = frozenset()  # robots flew just now: one that is disarmed is lost
        if state in JOINING:  # one instant for all, the same in every command: late robots join where the others are
            resumes = state is MissionState.RESUMING
            from_s = self.plans.progress_s if resumes else self.segment.centre.begin_s
            if state is MissionState.STARTING or not self.began_ns:
                self.began_ns = now_ns + round(START_IN_S * 1e9)
            self._timetable = Timetable(now_ns + round(START_IN_S * 1e9), from_s + self.governor.lag_s)
        if state is not MissionState.SWITCHING:
            self.plans.next = None
        if state not in PLANNING | {MissionState.RELEASING, MissionState.SWITCHING}:
            self._form = ""
        self.plans.request = None  # an outcome that belongs to the state before must not be taken for the next one
        if state is MissionState.TEST_ARMING:
            self._dispatcher.tested.clear()
        self.state, self._data = state, _StateData(now_ns)
        self._dispatcher.reset()


def _rest_m(view: RobotView) -> Array:
    """Place (3,) at which a robot that holds rests, or comes to rest: told to go on at once, it still coasts there."""
    control = view.state.control if view.state is not None and view.mode is Mode.HOLDING else None
    return np.asarray(view.eta[:3] if control is None else control.eta_reference[:3])


def may_move(view: RobotView) -> bool:
    """True for a robot that is heard, or that had power and may have it still: without a station it is neutral after a while,
    and a short gap of its radio must not end a run beside it."""
    return view.heard or (view.mode in LIVE and view.state_age_s < JOIN_WITHIN_S)


def may_have_power(view: RobotView) -> bool:
    """True for a robot that may put out thrust."""
    return view.mode in LIVE and may_move(view)


def _not_in(mode: Mode, fleet: Fleet, robots: Sequence[int]) -> list[int]:
    return [r for r in robots if fleet[r].mode is not mode]

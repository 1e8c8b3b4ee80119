"""Progress of the operator's requests, robot by robot, until each is done or has failed. Pure.

A request is done when the mission is in a state that it leads to (GOALS) and every robot concerned has confirmed. It has
failed when the mission went elsewhere, or when another request took its place before that. The page and the terminal's
commands show the same outcomes.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from groundstation.mission.command_dispatcher import MOVING, CommandResult
from groundstation.mission.gain_update import TUNING, GainStage, GainStatus, takes_gains
from groundstation.mission.mission import (
    AT_REST_MPS,
    OTHER_FLIGHTS,
    REST_WITHIN_S,
    Mission,
    may_have_power,
    may_move,
)
from groundstation.mission.objections import ARMED, LIVE
from groundstation.mission.single_robot import RobotTask
from groundstation.mission.state_machine import AT_REST, IN_FLIGHT, NOMINAL, MissionState, command_name
from groundstation.planning.segment import PlanSegment
from groundstation.telemetry import Fleet, RobotView
from shoal.messages.messages import WHOLE_FLEET, CommandKind, Mode, Outcome, Progress

# Outcomes of requests that are over, besides one of each robot: a STOP ends the requests of all robots at once. A terminal
# queries several times a second until its own is over.
KEPT = 16

_FROM_REST = frozenset({MissionState.HALTING, MissionState.RELOADING, MissionState.REARMING, MissionState.RELEASING})
UNARMED = AT_REST | {MissionState.STOPPED}  # the mission arms no robot
IN_PLACE_M = 0.05  # from the place that a robot holds

Confirms = Callable[[Mission, RobotView, int], bool]


def _in(*modes: Mode) -> Confirms:
    wanted = frozenset(modes)
    return lambda mission, view, robot: view.mode in wanted


def _not_in(modes: frozenset[Mode]) -> Confirms:
    return lambda mission, view, robot: view.mode not in modes


def _loaded(mission: Mission, view: RobotView, robot: int) -> bool:
    return mission.roster.has_loaded(mission.segment, {robot: view}, robot)


def _tested(mission: Mission, view: RobotView, robot: int) -> bool:
    return view.state is not None and view.state.thruster_test == "passed"


def _back(mission: Mission, view: RobotView, robot: int) -> bool:
    return robot not in mission.roster.lost and view.mode is Mode.DISARMED


@dataclass(frozen=True)
class RequestGoal:
    """Goal of a request: mission states on the way and at the end, and the check that a robot has confirmed.

    `repeats`: in the end state the command is sent again and again, so a robot may still confirm. `all_robots`: lost robots
    count too; `moving`: lost robots count that move or hold; `begun`: robots count that have been lost since the request.
    `new_segment`: another segment is flown then.
    """

    through: frozenset[MissionState]
    to: frozenset[MissionState]
    confirmed: Confirms
    repeats: bool = False
    all_robots: bool = False
    moving: bool = False
    begun: bool = False
    new_segment: bool = False


GOALS: dict[CommandKind, RequestGoal] = {
    CommandKind.LOAD: RequestGoal(frozenset(), frozenset({MissionState.LOADING}), _loaded, repeats=True),
    CommandKind.ARM: RequestGoal(
        frozenset({MissionState.LOADING}), frozenset({MissionState.ARMING}), _in(*ARMED), repeats=True
    ),
    CommandKind.START: RequestGoal(
        frozenset({MissionState.LOADING, MissionState.ARMING, MissionState.STARTING}), IN_FLIGHT, _in(Mode.TRACKING)
    ),
    CommandKind.HOLD: RequestGoal(frozenset(), frozenset({MissionState.PAUSED}), _in(Mode.HOLDING), repeats=True, moving=True),
    CommandKind.RESUME: RequestGoal(_FROM_REST | {MissionState.RESUMING}, IN_FLIGHT, _in(Mode.TRACKING)),
    CommandKind.GO: RequestGoal(frozenset({MissionState.SWITCHING}), NOMINAL, _in(Mode.TRACKING), new_segment=True),
    CommandKind.FORMATION: RequestGoal(_FROM_REST | {MissionState.SWITCHING}, NOMINAL, _in(Mode.TRACKING), new_segment=True),
    CommandKind.PATH: RequestGoal(_FROM_REST, NOMINAL, _in(Mode.TRACKING), new_segment=True),
    CommandKind.RETURN: RequestGoal(
        _FROM_REST | IN_FLIGHT | {MissionState.ENDING},
        frozenset({MissionState.DONE}),
        _back,
        all_robots=True,
        new_segment=True,
    ),
    CommandKind.REJOIN: RequestGoal(_FROM_REST, NOMINAL, _in(Mode.TRACKING), begun=True, new_segment=True),
    CommandKind.DISARM: RequestGoal(
        frozenset({MissionState.ENDING, MissionState.ABORTING}),
        AT_REST,
        _in(Mode.DISARMED),
        all_robots=True,
    ),
    CommandKind.STOP: RequestGoal(
        frozenset(), frozenset({MissionState.STOPPED}), _in(Mode.STOPPED), repeats=True, all_robots=True
    ),
    CommandKind.CLEAR_STOP: RequestGoal(
        frozenset({MissionState.CLEARING}), frozenset({MissionState.WAITING}), _not_in(LIVE | {Mode.STOPPED}), all_robots=True
    ),
    CommandKind.TEST: RequestGoal(
        frozenset({MissionState.TEST_ARMING, MissionState.TESTING, MissionState.TEST_ENDING}),
        frozenset({MissionState.WAITING}),
        _tested,
    ),
    CommandKind.END: RequestGoal(
        frozenset({MissionState.ENDING, MissionState.ABORTING}), UNARMED, _not_in(LIVE), repeats=True, all_robots=True
    ),
}

# of another path or form for robots at rest, which the next start flies: none of them has to do anything
PLANNED_AT_REST = RequestGoal(frozenset(), frozenset({MissionState.WAITING}), lambda *_: True, new_segment=True)


@dataclass(eq=False)
class _Request:
    """A request that is not over."""

    number: int
    order: CommandKind
    segment: PlanSegment
    active: tuple[int, ...]  # robots that took part when it began
    tuning_id: str = ""  # TUNE: the requested set
    only: int = WHOLE_FLEET  # or the one robot that it is about,
    task: RobotTask | None = None  # and its task
    at_rest: bool = False  # robots were at rest, and only a plan is made
    refusals: dict[int, str] = field(default_factory=dict)  # by robot, the last one
    begun_ns: int = 0  # by the mission's cycle


class RequestTracker:
    """Outcomes of all requests. One request at a time leads the mission, one changes the gains, and one leads each robot
    alone."""

    def __init__(self, robot_ids: tuple[int, ...]) -> None:
        self._robots = robot_ids
        self._count = 0
        self._open: list[_Request] = []
        self._outcomes: list[Outcome] = []
        self._ended: list[int] = []  # numbers of requests that have ended since `follow` returned them
        self.recent: tuple[Outcome, ...] = ()  # oldest first; replaced, never changed: other threads read it

    def begin(self, order: CommandKind, mission: Mission, tuning_id: str = "") -> int:
        """Count a request of the whole fleet that was taken up. Returns its number. A repetition while it is under way is the
        same request; another one takes its place."""
        gains = order in TUNING
        for request in [r for r in self._open if r.task is None and (r.order in TUNING) is gains]:
            if request.order is order and order not in (CommandKind.GO, *OTHER_FLIGHTS, CommandKind.TUNE):
                return request.number
            self._close(request)
            self._record(request, mission, Progress.FAILED, f"{command_name(order)} was asked for instead")
        return self._open_one(order, mission, tuning_id=tuning_id)

    def note_done(self, order: CommandKind, mission: Mission) -> int:
        """Count a request that was done at once, and that nothing else follows. Returns its number."""
        self._count += 1
        self._record(_Request(self._count, order, mission.segment, mission.roster.active), mission, Progress.DONE)
        return self._count

    def begin_task(self, robot: int, task: RobotTask, mission: Mission) -> int:
        """Count a request of one robot. Returns its number: the same for the same task. The task knows its own end."""
        number = next((request.number for request in self._open if request.task is task), 0)
        return number or self._open_one(task.order, mission, only=robot, task=task)

    def _open_one(
        self, order: CommandKind, mission: Mission, tuning_id: str = "", only: int = WHOLE_FLEET, task: RobotTask | None = None
    ) -> int:
        """Open a request at its first step. Returns its number."""
        self._count += 1
        at_rest = order in OTHER_FLIGHTS and mission.state is MissionState.WAITING
        request = _Request(
            self._count,
            order,
            mission.segment,
            mission.roster.active,
            tuning_id,
            only,
            task,
            at_rest,
            begun_ns=mission.cycle_ns,
        )
        self._open.append(request)
        self._record(request, mission)
        return request.number

    @property
    def ending(self) -> bool:
        """True if the run ends as soon as all robots are at rest."""
        return any(request.order is CommandKind.END for request in self._open)

    def outcome(self, number: int) -> Outcome | None:
        """Outcome of a request; None if the number is not known, or no longer."""
        return next((outcome for outcome in self.recent if outcome.request == number), None)

    def follow(
        self, mission: Mission, fleet: Fleet, tuning: GainStatus, results: Sequence[CommandResult]
    ) -> tuple[Outcome, ...]:
        """Update all outcomes; called once a cycle, after the mission's step. Returns those that have ended since the last
        call."""
        for request in tuple(self._open):
            _take_refusals(request, results)
            progress, reason, waiting = self._progress(request, mission, fleet, tuning)
            if progress is not Progress.UNDER_WAY:
                self._close(request)
            why = {robot: _reason(request, fleet[robot], robot) for robot in waiting}
            self._record(request, mission, progress, reason, why, self._concerned(request, mission, fleet))
        ended, self._ended = self._ended, []
        return tuple(outcome for outcome in self.recent if outcome.request in ended)

    def settle(self, mission: Mission, fleet: Fleet, tuning: GainStatus) -> None:
        """Record the requests whose aim is reached as done, before another one takes their place. The aim of END is not: the
        next cycle would end the run, and another request goes on with it."""
        for request in [r for r in self._open if r.order is not CommandKind.END]:
            if self._progress(request, mission, fleet, tuning)[0] is Progress.DONE:
                self._close(request)
                self._record(request, mission, Progress.DONE, concerned=self._concerned(request, mission, fleet))

    def _close(self, request: _Request) -> None:
        self._open.remove(request)
        self._ended.append(request.number)

    def _progress(
        self, request: _Request, mission: Mission, fleet: Fleet, tuning: GainStatus
    ) -> tuple[Progress, str, list[int]]:
        """Progress of a request, its reason, and the robots that it waits for."""
        if request.task is not None:
            task = request.task
            if task.progress is Progress.DONE:
                return Progress.DONE, "", []
            return task.progress, task.reason, [request.only]
        if request.order in TUNING:
            return self._gain_progress(request, mission, fleet, tuning)
        return self._mission_progress(request, mission, fleet)

    def _concerned(self, request: _Request, mission: Mission, fleet: Fleet) -> tuple[int, ...]:
        """The robots that have to confirm a request."""
        if request.only:
            return (request.only,)
        if request.order in TUNING:
            return mission.roster.active
        if request.at_rest:
            return ()
        goal = GOALS[request.order]
        if goal.all_robots:
            return tuple(r for r in self._robots if r not in mission.roster.out or may_have_power(fleet[r]))
        concerned = set(mission.roster.active)
        if goal.moving:
            concerned |= {r for r in mission.roster.lost if _moves_or_holds(fleet[r])}
        if goal.begun:
            concerned |= set(request.active)
        return tuple(r for r in self._robots if r in concerned)

    def _mission_progress(self, request: _Request, mission: Mission, fleet: Fleet) -> tuple[Progress, str, list[int]]:
        """Progress of a request for the whole fleet, its reason, and the robots that it waits for."""
        goal = PLANNED_AT_REST if request.at_rest else GOALS[request.order]
        robots = self._concerned(request, mission, fleet)
        waiting = [r for r in robots if not (_counts(request, mission, fleet[r]) and goal.confirmed(mission, fleet[r], r))]
        if request.order is CommandKind.HOLD and mission.cycle_ns - request.begun_ns < REST_WITHIN_S * 1e9:
            waiting = [robot for robot in robots if robot in waiting or not _rests(fleet[robot])]
        planning = request.at_rest and mission.plan_request is not None
        if mission.state in goal.through or (planning and mission.state in goal.to):
            return Progress.UNDER_WAY, "", waiting
        stands = f"{mission.state.value}{f': {mission.reason}' if mission.reason else ''}"
        if mission.state not in goal.to or (goal.new_segment and mission.segment is request.segment):
            return Progress.FAILED, (request.at_rest and mission.plans.failure) or stands, waiting
        if request.order is CommandKind.END:  # a robot that is not heard cannot be waited for: it comes to rest by itself
            flying = [robot for robot in waiting if may_move(fleet[robot])]
            return (Progress.UNDER_WAY if flying else Progress.DONE), "", waiting
        lost = mission.roster.lost
        left = "; ".join(
            f"robot {r} is left out: {lost[r]}" if r in lost else f"robot {r}: {_reason(request, fleet[r], r)}"
            for r in waiting
        )
        if not waiting:
            return Progress.DONE, "", []
        return (Progress.UNDER_WAY, "", waiting) if goal.repeats else (Progress.FAILED, left, waiting)

    def _gain_progress(
        self, request: _Request, mission: Mission, fleet: Fleet, tuning: GainStatus
    ) -> tuple[Progress, str, list[int]]:
        """Progress of a change of gains, the reason if it failed, and the robots that have other gains still."""
        states = {robot: fleet[robot].state for robot in self._concerned(request, mission, fleet)}
        waiting = [robot for robot, state in states.items() if state is None or state.tuning_id != request.tuning_id]
        if tuning.stage is not GainStage.IDLE:
            return Progress.UNDER_WAY, "", waiting
        if tuning.flown.id == request.tuning_id:  # one that came back meanwhile is given them within seconds
            coming = [robot for robot in waiting if takes_gains(fleet[robot])]
            if coming and tuning.reason:  # it was given them in vain
                return Progress.FAILED, tuning.reason, waiting
            return (Progress.UNDER_WAY if coming else Progress.DONE), "", waiting
        return Progress.FAILED, tuning.reason, waiting

    def _record(
        self,
        request: _Request,
        mission: Mission,
        progress: Progress = Progress.UNDER_WAY,
        reason: str = "",
        waiting: dict[int, str] | None = None,
        concerned: Sequence[int] = (),
    ) -> None:
        """Keep the outcome of a request, in place of an earlier one of the same number. `waiting`: the robots of those
        `concerned` that have not confirmed it, with their reasons. Of the requests that are over, the oldest are forgotten."""
        waiting = waiting or {}
        outcome = Outcome(
            request=request.number,
            order=request.order,
            progress=progress,
            reason=reason,
            mission=mission.state.name,
            confirmed=tuple(robot for robot in concerned if robot not in waiting),
            waiting=tuple(waiting),
            why=tuple(waiting.values()),
        )
        outcomes = [*(earlier for earlier in self._outcomes if earlier.request != request.number), outcome]
        over = [kept.request for kept in outcomes if kept.progress is not Progress.UNDER_WAY]
        forgotten = frozenset(over[: -(KEPT + len(self._robots))])
        self._outcomes = [kept for kept in outcomes if kept.request not in forgotten]
        self.recent = tuple(sorted(self._outcomes, key=lambda kept: kept.request))


def _counts(request: _Request, mission: Mission, view: RobotView) -> bool:
    """True for a state that says how a robot is now, or was since the request: over a slow radio each state is old."""
    return view.heard or view.state_age_s * 1e9 <= mission.cycle_ns - request.begun_ns


def _rests(view: RobotView) -> bool:
    """True for a robot that is at rest in the place that it holds."""
    away_m = view.state.error_m if view.state is not None else None
    return view.speed_mps < AT_REST_MPS and (away_m is None or away_m < IN_PLACE_M)


def _moves_or_holds(view: RobotView) -> bool:
    return may_move(view) and view.mode in MOVING | {Mode.HOLDING}


def _take_refusals(request: _Request, results: Sequence[CommandResult]) -> None:
    for result in results:
        if (result.command.order in TUNING) is (request.order in TUNING) and request.only in (
            WHOLE_FLEET,
            result.command.robot,
        ):
            request.refusals[result.command.robot] = "" if result.reply.accepted else result.reply.reason


def _reason(request: _Request, view: RobotView, robot: int) -> str:
    """Short reason for which a robot has not confirmed a request."""
    if not view.heard or view.mode is None:
        return "not heard" if view.state is None else f"not heard for {view.state_age_s:.1f} s"
    if reason := request.refusals.get(robot, ""):
        return reason
    tested = view.state.thruster_test if view.state is not None and request.order is CommandKind.TEST else ""
    moving = ", not yet at rest" if view.mode is Mode.HOLDING and not _rests(view) else ""
    return f"is {view.mode.name.lower()}{moving}{f', thruster test {tested}' if tested else ''}"

"""What becomes of a person's requests: robot by robot, until each is done or has failed. Pure.

A request is done when the mission stands where it leads (GOALS) and every robot that it concerns is as it wants them; it has
failed when the mission went elsewhere, or when another request took its place. The page and the commands of a terminal show
the same account.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from groundstation.mission.command_dispatcher import Answer
from groundstation.mission.gain_update import TUNING, Stage, TuningStatus
from groundstation.mission.mission import Mission
from groundstation.mission.stages import ARMED, LIVE
from groundstation.mission.state_machine import FLYING, ON_COURSE, OVER, Phase
from groundstation.planning.segment import Leg
from groundstation.telemetry import Fleet, RobotView
from wire.messages.messages import Mode, Order, Outcome, Progress

KEPT = 16  # outcomes that can be asked for; a terminal asks several times a second until its request is over

_FROM_REST = frozenset({Phase.HALTING, Phase.RELOADING, Phase.REARMING, Phase.RELEASING})
AT_REST = OVER | {Phase.WAITING, Phase.STOPPED}  # the mission asks nobody to arm

Obeys = Callable[[Mission, RobotView, int], bool]


def _in(*modes: Mode) -> Obeys:
    wanted = frozenset(modes)
    return lambda mission, seen, robot: seen.heard and seen.mode in wanted


def _not_in(modes: frozenset[Mode]) -> Obeys:
    return lambda mission, seen, robot: seen.heard and seen.mode not in modes


def _loaded(mission: Mission, seen: RobotView, robot: int) -> bool:
    return seen.heard and mission.crew.is_on(mission.leg, {robot: seen}, robot)


def _tested(mission: Mission, seen: RobotView, robot: int) -> bool:
    return seen.heard and seen.state is not None and seen.state.thruster_test == "passed"


def _back(mission: Mission, seen: RobotView, robot: int) -> bool:
    return robot not in mission.crew.out and seen.heard and seen.mode is Mode.DISARMED


@dataclass(frozen=True)
class Goal:
    """Where a request leads, through which phases, and how a robot is then. `asks`: in that phase robots are asked again and
    again, so who has not obeyed yet may. `everybody`: robots that are out of the mission count too. `new_leg`: another leg is
    flown then."""

    through: frozenset[Phase]
    to: frozenset[Phase]
    obeyed: Obeys
    asks: bool = False
    everybody: bool = False
    new_leg: bool = False


GOALS: dict[Order, Goal] = {
    Order.LOAD: Goal(frozenset(), frozenset({Phase.LOADING}), _loaded, asks=True),
    Order.ARM: Goal(frozenset({Phase.LOADING}), frozenset({Phase.ARMING}), _in(*ARMED), asks=True),
    Order.START: Goal(frozenset({Phase.LOADING, Phase.ARMING, Phase.STARTING}), FLYING, _in(Mode.TRACKING)),
    Order.HOLD: Goal(frozenset(), frozenset({Phase.PAUSED}), _in(Mode.HOLDING), asks=True),
    Order.RESUME: Goal(_FROM_REST | {Phase.RESUMING}, FLYING, _in(Mode.TRACKING)),
    Order.GO: Goal(frozenset({Phase.SWITCHING}), ON_COURSE, _in(Mode.TRACKING), new_leg=True),
    Order.RETURN: Goal(
        _FROM_REST | FLYING | {Phase.ENDING}, frozenset({Phase.DONE}), _back, everybody=True, new_leg=True
    ),
    Order.REJOIN: Goal(_FROM_REST, ON_COURSE, _in(Mode.TRACKING), new_leg=True),
    Order.DISARM: Goal(
        frozenset({Phase.ENDING, Phase.ABORTING}), OVER | {Phase.WAITING}, _in(Mode.DISARMED), everybody=True
    ),
    Order.STOP: Goal(frozenset(), frozenset({Phase.STOPPED}), _in(Mode.STOPPED), asks=True, everybody=True),
    Order.CLEAR_STOP: Goal(
        frozenset({Phase.CLEARING}), frozenset({Phase.WAITING}), _not_in(LIVE | {Mode.STOPPED}), everybody=True
    ),
    Order.TEST: Goal(
        frozenset({Phase.TEST_ARMING, Phase.TESTING, Phase.TEST_ENDING}), frozenset({Phase.WAITING}), _tested
    ),
    Order.END: Goal(frozenset({Phase.ENDING, Phase.ABORTING}), AT_REST, _not_in(LIVE), asks=True, everybody=True),
}  # fmt: skip


@dataclass(eq=False)
class _Request:
    """One that is not over."""

    number: int
    order: Order
    leg: Leg
    tuning_id: str = ""  # TUNE: the set that is wanted
    refusals: dict[int, str] = field(default_factory=dict)  # by robot, the last one


class Requests:
    """The account of all requests. One at a time leads the mission, and one changes the gains."""

    def __init__(self, robot_ids: tuple[int, ...]) -> None:
        self._robots = robot_ids
        self._count = 0
        self._open: list[_Request] = []
        self._told: deque[Outcome] = deque(maxlen=KEPT)
        self.recent: tuple[Outcome, ...] = ()  # oldest first; replaced, never changed: other threads read it

    def begin(self, order: Order, mission: Mission, tuning_id: str = "") -> int:
        """A request has been taken up. Returns its number. The same once more while it is under way is one request."""
        gains = order in TUNING
        for request in [request for request in self._open if (request.order in TUNING) is gains]:
            if request.order is order and order not in (Order.GO, Order.TUNE):
                return request.number
            self._open.remove(request)
            self._tell(request, mission, Progress.FAILED, f"{order.name} was asked for instead")
        self._count += 1
        request = _Request(self._count, order, mission.leg, tuning_id)
        self._open.append(request)
        self._tell(request, mission)
        return request.number

    @property
    def ending(self) -> bool:
        """Whether the run is to end as soon as everybody is at rest."""
        return any(request.order is Order.END for request in self._open)

    def outcome(self, number: int) -> Outcome | None:
        """Of one request; None if it is not known, or no longer."""
        return next((outcome for outcome in self.recent if outcome.request == number), None)

    def follow(self, mission: Mission, fleet: Fleet, tuning: TuningStatus, answers: Sequence[Answer]) -> None:
        """Once a cycle, after the mission's step."""
        for request in tuple(self._open):
            _note(request, answers)
            progress, reason, waiting = (
                self._gains(request, fleet, tuning) if request.order in TUNING else self._led(request, mission, fleet)
            )
            if progress is not Progress.UNDER_WAY:
                self._open.remove(request)
            why = {robot: _why(fleet[robot], request.refusals.get(robot, "")) for robot in waiting}
            self._tell(request, mission, progress, reason, why, self._concerned(request, mission))

    def _concerned(self, request: _Request, mission: Mission) -> tuple[int, ...]:
        everybody = request.order in TUNING or GOALS[request.order].everybody
        return self._robots if everybody else mission.crew.active

    def _led(self, request: _Request, mission: Mission, fleet: Fleet) -> tuple[Progress, str, list[int]]:
        goal = GOALS[request.order]
        robots = self._concerned(request, mission)
        waiting = [robot for robot in robots if not goal.obeyed(mission, fleet[robot], robot)]
        if mission.phase in goal.through:
            return Progress.UNDER_WAY, "", waiting
        stands = f"{mission.phase.value}{f': {mission.reason}' if mission.reason else ''}"
        if mission.phase not in goal.to or (goal.new_leg and mission.leg is request.leg):
            return Progress.FAILED, stands, waiting
        if request.order is Order.END:  # a robot that is not heard cannot be waited for: it comes to rest by itself
            flying = [robot for robot in waiting if fleet[robot].heard]
            return (Progress.UNDER_WAY if flying else Progress.DONE), "", waiting
        if not waiting:
            return Progress.DONE, "", []
        left = "; ".join(f"robot {r} is left out: {why}" for r, why in mission.crew.out.items() if r in waiting)
        return (Progress.UNDER_WAY, "", waiting) if goal.asks else (Progress.FAILED, left, waiting)

    def _gains(self, request: _Request, fleet: Fleet, tuning: TuningStatus) -> tuple[Progress, str, list[int]]:
        states = {robot: fleet[robot].state for robot in self._robots}
        waiting = [robot for robot, state in states.items() if state is None or state.tuning_id != request.tuning_id]
        if tuning.stage is not Stage.IDLE:
            return Progress.UNDER_WAY, "", waiting
        return (Progress.DONE, "", []) if tuning.flown.id == request.tuning_id else (Progress.FAILED, tuning.reason, waiting)

    def _tell(
        self,
        request: _Request,
        mission: Mission,
        progress: Progress = Progress.UNDER_WAY,
        reason: str = "",
        why: dict[int, str] | None = None,
        concerned: Sequence[int] = (),
    ) -> None:
        late = why or {}
        confirmed = tuple(robot for robot in concerned if robot not in late)
        told = Outcome(
            request.number, request.order, progress, reason, mission.phase.name, confirmed, tuple(late), tuple(late.values())
        )
        kept = [outcome for outcome in self._told if outcome.request != request.number]
        self._told = deque([*kept, told], KEPT)
        self.recent = tuple(sorted(self._told, key=lambda outcome: outcome.request))


def _note(request: _Request, answers: Sequence[Answer]) -> None:
    for answer in answers:
        if (answer.command.order in TUNING) is (request.order in TUNING):
            request.refusals[answer.command.robot] = "" if answer.reply.accepted else answer.reply.reason


def _why(seen: RobotView, refusal: str) -> str:
    """Why a robot is not where a request wants it, in a few words."""
    if not seen.heard or seen.mode is None:
        return "not heard" if seen.state is None else f"not heard for {seen.state_age_s:.1f} s"
    tested = seen.state.thruster_test if seen.state is not None else ""
    told = f"is {seen.mode.name.lower()}{f', thruster test {tested}' if tested else ''}"
    return refusal or told

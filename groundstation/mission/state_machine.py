"""The mission's states and transitions: ONE table. Pure.

`groundstation mission states` prints it; docs/reference/mission-states.md holds it, and a test compares the two.
groundstation/mission/mission.py follows this table and changes state in no other way.
"""

from dataclasses import dataclass
from enum import Enum

from shoal.messages.messages import WHOLE_FLEET, Command, CommandKind, Outcome, Progress

READY = "fleet ready"  # WAITING, with nothing left to wait for


class MissionState(Enum):
    """State of the mission. Names go into heartbeat and log; values are for people."""

    WAITING = "waiting for the fleet"
    LOADING = "loading trajectories"
    ARMING = "arming"
    STARTING = "starting"
    RUNNING = "running"
    SLOWED = "running, slowed down for a robot that lags"
    DEGRADED = "running without a robot"
    SWITCHING = "going over to another path"
    RETURNING = "returning to the start"
    PAUSED = "holding"
    RESUMING = "resuming"
    HALTING = "coming to rest for a new plan"
    RELOADING = "loading a new plan"
    REARMING = "arming for a new plan"
    RELEASING = "starting on a new plan"
    ENDING = "disarming"
    DONE = "done"
    CANCELLED = "ended by a person"
    ABORTING = "aborting"
    FAILED = "failed"
    STOPPED = "emergency stop"
    CLEARING = "clearing the emergency stop"
    TEST_ARMING = "arming for a thruster test"
    TESTING = "testing thrusters"
    TEST_ENDING = "disarming after a thruster test"


class MissionEvent(Enum):
    """Event that moves the mission without a request; values are for people."""

    PREFLIGHT_PASSED = "every robot is fit (automatic missions)"
    ALL_CONFIRMED = "every robot has done as told"
    DISARMED_FAILED = "every robot is disarmed, of a run that had failed"
    DISARMED_CANCELLED = "every robot is disarmed, of a run that a person ended"
    TIMEOUT = "a robot has not done as told in time"
    RETURN_STARTED = "the plan leads back to the start"
    ROBOT_MISSING = "a robot is out, the others go on"
    LAGGING = "a robot lags behind"
    CAUGHT_UP = "no robot lags any more"
    ROBOT_HOLDING = "a robot holds by itself"
    OUT_OF_STEP = "a robot is out of step with the others"
    BLIND = "obstacles cannot be seen: policy hold"
    FOREIGN_POSES = "a robot's poses are by another experiment, or by two programs"
    OBSTACLE = "something lies on the path"
    BLOCKED = "there is no way round it"
    LOST = "a robot is lost: policy abort"
    LOST_HOLD = "a robot is lost: policy hold"
    LOST_CLOSE_UP = "a robot is lost: policy close-up"
    LOST_REPLAN = "a robot is lost that the plan counts on: policy go-on"
    LOST_ALL = "no robot is left that could hold"
    PLANNED = "all are at rest, and there is a new plan"
    NO_PLAN = "there is no plan to be found"
    RECOVERED = "everybody holds and is well again (automatic missions)"
    LOST_NEARBY = "a robot's place is beside one that is out"
    OFF_PLAN = "a robot has another plan, or is far from its place"
    TRANSFER_BLOCKED = "something lies on a robot's own way"
    NO_PROGRESS = "nothing goes on for long, and nobody attends (automatic missions)"
    ARRIVED = "the end of the trajectories is reached"


NOMINAL = frozenset({MissionState.RUNNING, MissionState.SLOWED, MissionState.DEGRADED})
IN_FLIGHT = NOMINAL | {MissionState.SWITCHING, MissionState.RETURNING}
TERMINAL = frozenset({MissionState.DONE, MissionState.CANCELLED, MissionState.FAILED})
AT_REST = TERMINAL | {MissionState.WAITING}  # no run is under way: one may begin
# robots begin to fly, all at one instant
JOINING = frozenset({MissionState.STARTING, MissionState.RESUMING, MissionState.RELEASING})
PLANNING = frozenset(
    {MissionState.HALTING, MissionState.RELOADING, MissionState.REARMING}
)  # on the way to a new plan from rest
COMMITTED = (
    IN_FLIGHT | PLANNING | {MissionState.PAUSED, MissionState.RESUMING, MissionState.RELEASING}
)  # a robot that falls out is lost to the others
ANY = frozenset(MissionState)
GROUPS = {"in flight": IN_FLIGHT, "nominal": NOMINAL, "at rest": AT_REST, "joining": JOINING, "planning": PLANNING}
FEW = 4  # missing states: so few are named rather than those that are there
# states that an automatic mission passes on its way to the end
UNDER_WAY = COMMITTED | JOINING | {MissionState.WAITING, MissionState.LOADING, MissionState.ARMING}


@dataclass(frozen=True)
class MissionTransition:
    """A row of the table: from any of `states`, `cause` leads to state `to`. Rows do not overlap."""

    states: frozenset[MissionState]
    cause: CommandKind | MissionEvent
    to: MissionState


def _row(
    states: MissionState | frozenset[MissionState], cause: CommandKind | MissionEvent, to: MissionState
) -> MissionTransition:
    return MissionTransition(states if isinstance(states, frozenset) else frozenset({states}), cause, to)


_STAGES = frozenset(
    {
        MissionState.LOADING,
        MissionState.ARMING,
        MissionState.STARTING,
        MissionState.RESUMING,
        MissionState.RELOADING,
        MissionState.REARMING,
        MissionState.RELEASING,
    }
)
_TEST = frozenset({MissionState.TEST_ARMING, MissionState.TESTING, MissionState.TEST_ENDING})

TRANSITIONS: tuple[MissionTransition, ...] = (
    # requests of the operator
    _row(AT_REST, CommandKind.LOAD, MissionState.LOADING),
    _row(AT_REST | {MissionState.LOADING}, CommandKind.ARM, MissionState.LOADING),
    _row(AT_REST | {MissionState.LOADING, MissionState.ARMING}, CommandKind.START, MissionState.LOADING),
    _row(AT_REST, CommandKind.TEST, MissionState.TEST_ARMING),
    _row(IN_FLIGHT | JOINING | PLANNING | {MissionState.PAUSED}, CommandKind.HOLD, MissionState.PAUSED),
    _row(MissionState.PAUSED, CommandKind.RESUME, MissionState.RESUMING),
    _row(NOMINAL, CommandKind.GO, MissionState.SWITCHING),
    _row(NOMINAL, CommandKind.FORMATION, MissionState.SWITCHING),
    _row(MissionState.PAUSED, CommandKind.FORMATION, MissionState.HALTING),
    _row(MissionState.PAUSED, CommandKind.PATH, MissionState.HALTING),
    # at rest: the next start flies it
    _row(AT_REST, CommandKind.FORMATION, MissionState.WAITING),
    _row(AT_REST, CommandKind.PATH, MissionState.WAITING),
    _row(
        NOMINAL | AT_REST | {MissionState.SWITCHING, MissionState.PAUSED},
        CommandKind.RETURN,
        MissionState.HALTING,
    ),
    _row(NOMINAL | {MissionState.PAUSED}, CommandKind.REJOIN, MissionState.HALTING),
    _row(ANY - {MissionState.STOPPED}, CommandKind.DISARM, MissionState.ENDING),
    _row(ANY, CommandKind.STOP, MissionState.STOPPED),
    # at rest: a robot was out of reach when the stop was cleared, or was stopped in an earlier station's life
    _row(AT_REST | {MissionState.STOPPED}, CommandKind.CLEAR_STOP, MissionState.CLEARING),
    # from the water to the end
    _row(MissionState.WAITING, MissionEvent.PREFLIGHT_PASSED, MissionState.LOADING),
    _row(MissionState.LOADING, MissionEvent.ALL_CONFIRMED, MissionState.ARMING),
    _row(MissionState.ARMING, MissionEvent.ALL_CONFIRMED, MissionState.STARTING),
    _row(MissionState.STARTING, MissionEvent.ALL_CONFIRMED, MissionState.RUNNING),
    _row(IN_FLIGHT, MissionEvent.ARRIVED, MissionState.ENDING),
    _row(MissionState.ENDING, MissionEvent.ALL_CONFIRMED, MissionState.DONE),
    _row(MissionState.ENDING, MissionEvent.DISARMED_FAILED, MissionState.FAILED),
    _row(MissionState.ENDING, MissionEvent.DISARMED_CANCELLED, MissionState.CANCELLED),
    # under way
    _row(frozenset({MissionState.RUNNING, MissionState.DEGRADED}), MissionEvent.LAGGING, MissionState.SLOWED),
    _row(MissionState.SLOWED, MissionEvent.CAUGHT_UP, MissionState.RUNNING),
    _row(MissionState.RUNNING, MissionEvent.ROBOT_MISSING, MissionState.DEGRADED),
    _row(MissionState.RUNNING, MissionEvent.RETURN_STARTED, MissionState.RETURNING),
    _row(NOMINAL, MissionEvent.OBSTACLE, MissionState.SWITCHING),
    _row(MissionState.SWITCHING, MissionEvent.ALL_CONFIRMED, MissionState.RUNNING),
    _row(MissionState.SWITCHING, MissionEvent.NO_PLAN, MissionState.RUNNING),
    _row(MissionState.SWITCHING, MissionEvent.TIMEOUT, MissionState.PAUSED),
    _row(MissionState.SWITCHING, MissionEvent.BLOCKED, MissionState.PAUSED),
    _row(IN_FLIGHT, MissionEvent.ROBOT_HOLDING, MissionState.PAUSED),
    _row(IN_FLIGHT | JOINING, MissionEvent.OUT_OF_STEP, MissionState.PAUSED),
    _row(IN_FLIGHT, MissionEvent.BLIND, MissionState.PAUSED),
    _row(IN_FLIGHT | JOINING, MissionEvent.FOREIGN_POSES, MissionState.PAUSED),
    _row(MissionState.PAUSED, MissionEvent.RECOVERED, MissionState.RESUMING),
    _row(MissionState.RESUMING, MissionEvent.ALL_CONFIRMED, MissionState.RUNNING),
    _row(MissionState.RESUMING, MissionEvent.LOST_NEARBY, MissionState.HALTING),
    _row(MissionState.RESUMING, MissionEvent.OFF_PLAN, MissionState.HALTING),
    # a new plan from rest: home, into place again, or closing up
    _row(COMMITTED, MissionEvent.LOST_CLOSE_UP, MissionState.HALTING),
    _row(COMMITTED - {MissionState.PAUSED}, MissionEvent.LOST_HOLD, MissionState.PAUSED),
    _row(PLANNING | {MissionState.RELEASING}, MissionEvent.LOST_REPLAN, MissionState.HALTING),
    _row(COMMITTED, MissionEvent.LOST, MissionState.ABORTING),
    _row(PLANNING, MissionEvent.LOST_ALL, MissionState.ABORTING),
    _row(NOMINAL | {MissionState.RETURNING, MissionState.RESUMING}, MissionEvent.TRANSFER_BLOCKED, MissionState.HALTING),
    _row(MissionState.HALTING, MissionEvent.PLANNED, MissionState.RELOADING),
    _row(MissionState.HALTING, MissionEvent.NO_PLAN, MissionState.PAUSED),
    _row(MissionState.RELOADING, MissionEvent.ALL_CONFIRMED, MissionState.REARMING),
    _row(MissionState.REARMING, MissionEvent.ALL_CONFIRMED, MissionState.RELEASING),
    _row(MissionState.RELEASING, MissionEvent.ALL_CONFIRMED, MissionState.RUNNING),
    # failures
    _row(
        _STAGES | {MissionState.HALTING, MissionState.ENDING, MissionState.CLEARING} | _TEST,
        MissionEvent.TIMEOUT,
        MissionState.ABORTING,
    ),
    _row(UNDER_WAY, MissionEvent.NO_PROGRESS, MissionState.ABORTING),
    _row(MissionState.ABORTING, MissionEvent.ALL_CONFIRMED, MissionState.FAILED),
    _row(MissionState.ABORTING, MissionEvent.TIMEOUT, MissionState.FAILED),
    _row(MissionState.CLEARING, MissionEvent.ALL_CONFIRMED, MissionState.WAITING),
    # thruster test
    _row(MissionState.TEST_ARMING, MissionEvent.ALL_CONFIRMED, MissionState.TESTING),
    _row(MissionState.TESTING, MissionEvent.ALL_CONFIRMED, MissionState.TEST_ENDING),
    _row(MissionState.TEST_ENDING, MissionEvent.ALL_CONFIRMED, MissionState.WAITING),
)


def next_state(state: MissionState, cause: CommandKind | MissionEvent) -> MissionState | None:
    """State after a cause; None if the table has no transition."""
    return next((row.to for row in TRANSITIONS if row.cause is cause and state in row.states), None)


def states_allowing(order: CommandKind) -> frozenset[MissionState]:
    """States in which an operator's request is allowed."""
    return frozenset().union(*(row.states for row in TRANSITIONS if row.cause is order))


def order_name(order: CommandKind) -> str:
    """Name of a request in commands and on the page: CLEAR_STOP is clear-stop."""
    return order.name.lower().replace("_", "-")


def command_name(order: CommandKind) -> str:
    """Name of a request as a person gives it: the word of its command."""
    return {CommandKind.PATH: "load", CommandKind.TUNE: "gains"}.get(order, order_name(order))


def order_named(name: str) -> CommandKind:
    """Request with a name as `order_name` gives it. Raises KeyError."""
    return CommandKind[name.upper().replace("-", "_")]


def request_named(name: str, robot: int = WHOLE_FLEET) -> Command:
    """Request without arguments, of the whole fleet or of one robot. Raises KeyError."""
    return Command(order_named(name), robot)


def in_words(outcome: Outcome) -> str:
    """The end of a request: the robots that have confirmed it, or the reason of its failure."""
    if outcome.progress is Progress.FAILED:
        return f"failed{f': {outcome.reason}' if outcome.reason else ''}"
    by = f"confirmed by {', '.join(map(str, outcome.confirmed))}" if outcome.confirmed else "done"
    return f"{by}: {outcome.reason}" if outcome.reason else by


def rejection_reason(order: CommandKind, state: MissionState) -> str:
    """Reason for which a request is not allowed in a state; empty if it is."""
    requests = [row.cause for row in TRANSITIONS if isinstance(row.cause, CommandKind)]
    if order not in requests:
        allowed = ", ".join(dict.fromkeys(map(command_name, requests)))
        return f"{command_name(order)} is not for a whole mission (allowed: {allowed})"
    if state in states_allowing(order):
        return ""
    names = ", ".join(p.name for p in MissionState if p in states_allowing(order))
    return f"{command_name(order)} is not possible when {state.name} (only when {names})"


WATER = (CommandKind.OUT, CommandKind.BACK_IN)  # requests that are always for one robot
ONE_ROBOT = (
    CommandKind.ARM,
    CommandKind.HOLD,
    CommandKind.DISARM,
    CommandKind.GO,
    *WATER,
)  # requests that may be for one robot alone
WITH_DETAILS = (CommandKind.GO, CommandKind.FORMATION, CommandKind.PATH)  # requests with places, a form, or an experiment
# requests without arguments; END is the station's own
FLEET_REQUESTS = tuple(
    order_name(order)
    for order in CommandKind
    if order is CommandKind.END or (order not in WITH_DETAILS and states_allowing(order))
)


def markdown() -> str:
    """Tables of states, requests and events in Markdown, for docs/reference/mission-states.md."""
    lines = [f"* {state.name}: {state.value}" for state in MissionState if state.name.lower() not in state.value]
    lines += ["", "Groups of states in the tables:", ""]
    lines += [f"* *{name}*: {_states_in_words(states, name)}" for name, states in GROUPS.items()]
    lines += ["", "| A person requests | in the states | leads to |", "| --- | --- | --- |"]
    lines += [f"| {row.cause.name} | {_states_in_words(row.states)} | {row.to.name} |" for row in _of(CommandKind)]
    lines += ["", "| By itself | changes |", "| --- | --- |"]
    events = _of(MissionEvent)
    for event in dict.fromkeys(row.cause for row in events):
        changes = "; ".join(f"{_states_in_words(row.states)} → {row.to.name}" for row in events if row.cause is event)
        lines.append(f"| {event.value} | {changes} |")
    return "\n".join(lines) + "\n"


def _of(kind: type[CommandKind] | type[MissionEvent]) -> list[MissionTransition]:
    return [row for row in TRANSITIONS if isinstance(row.cause, kind)]


def _states_in_words(states: frozenset[MissionState], but: str = "") -> str:
    """States in few words: groups of GROUPS first, the largest before the others, then single names. `but` is the group that
    the words explain."""
    if len(missing := ANY - states) < FEW:
        return f"any but {_states_in_words(missing)}" if missing else "any"
    left, words = set(states), []
    for name, group in sorted(GROUPS.items(), key=lambda item: -len(item[1])):
        if name != but and group <= left:
            words.append(f"*{name}*")
            left -= group
    return ", ".join([*words, *(state.name for state in MissionState if state in left)])

"""The mission's states and everything that leads from one to another: ONE table. Pure.

`groundstation phases` prints it; docs/missions.md holds it and a test compares the two. groundstation/mission/mission.py moves
through this table and in no other way.
"""

from dataclasses import dataclass
from enum import Enum

from wire.messages.messages import Order


class Phase(Enum):
    """Where the mission stands; the value is what people read."""

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


class Event(Enum):
    """What happens without a person; the value is what people read."""

    FIT = "every robot is fit (automatic missions)"
    OBEYED = "every robot has done as told"
    DISARMED_FAILED = "every robot is disarmed, of a run that had failed"
    DISARMED_CANCELLED = "every robot is disarmed, of a run that a person ended"
    UNHEEDED = "a robot has not done as told in time"
    HOMEWARD = "the plan leads back to the start"
    MISSING = "a robot is out, the others go on"
    LAGGING = "a robot lags behind"
    CAUGHT_UP = "nobody lags any more"
    HELD = "a robot holds by itself"
    OUT_OF_STEP = "a robot is out of step with the others"
    BLIND = "nobody can tell what lies in the pool: policy hold"
    OBSTACLE = "something lies on the path"
    BLOCKED = "there is no way round it"
    LOST = "a robot is lost: policy abort"
    LOST_HOLD = "a robot is lost: policy hold"
    LOST_CLOSE_UP = "a robot is lost: policy close-up"
    LOST_ANEW = "a robot is lost that the plan counts on: policy go-on"
    LOST_ALL = "nobody is left who could hold"
    PLANNED = "all are at rest, and there is a new plan"
    NO_PLAN = "there is no plan to be found"
    WELL = "everybody holds and is well again (automatic missions)"
    BESIDE_LOST = "somebody's place is beside a robot that is out"
    ASTRAY = "a robot has another plan, or is far from its place"
    IN_OWN_WAY = "something lies on a robot's own way"
    ARRIVED = "the end of the trajectories is reached"


ON_COURSE = frozenset({Phase.RUNNING, Phase.SLOWED, Phase.DEGRADED})
FLYING = ON_COURSE | {Phase.SWITCHING, Phase.RETURNING}
OVER = frozenset({Phase.DONE, Phase.CANCELLED, Phase.FAILED})
JOINING = frozenset({Phase.STARTING, Phase.RESUMING, Phase.RELEASING})  # robots begin to fly, all at one instant
PLANNING = frozenset({Phase.HALTING, Phase.RELOADING, Phase.REARMING})  # on the way to a new plan from rest
UNDER_WAY = FLYING | PLANNING | {Phase.PAUSED, Phase.RESUMING, Phase.RELEASING}  # whoever falls out is lost to the others
ANY = frozenset(Phase)


@dataclass(frozen=True)
class Row:
    """In any of these phases, this leads there. Rows do not overlap."""

    phases: frozenset[Phase]
    cause: Order | Event
    to: Phase


def _row(phases: Phase | frozenset[Phase], cause: Order | Event, to: Phase) -> Row:
    return Row(phases if isinstance(phases, frozenset) else frozenset({phases}), cause, to)


_STAGES = frozenset(
    {Phase.LOADING, Phase.ARMING, Phase.STARTING, Phase.RESUMING, Phase.RELOADING, Phase.REARMING, Phase.RELEASING}
)
_TEST = frozenset({Phase.TEST_ARMING, Phase.TESTING, Phase.TEST_ENDING})

TABLE: tuple[Row, ...] = (
    # what a person asks for
    _row(frozenset({Phase.WAITING}) | OVER, Order.LOAD, Phase.LOADING),
    _row(frozenset({Phase.WAITING, Phase.LOADING}), Order.ARM, Phase.LOADING),
    _row(frozenset({Phase.WAITING, Phase.LOADING, Phase.ARMING}), Order.START, Phase.LOADING),
    _row(frozenset({Phase.WAITING}) | OVER, Order.TEST, Phase.TEST_ARMING),
    _row(FLYING | JOINING | PLANNING | {Phase.PAUSED}, Order.HOLD, Phase.PAUSED),
    _row(Phase.PAUSED, Order.RESUME, Phase.RESUMING),
    _row(ON_COURSE, Order.GO, Phase.SWITCHING),
    _row(ON_COURSE | {Phase.SWITCHING, Phase.PAUSED, Phase.WAITING} | OVER, Order.RETURN, Phase.HALTING),
    _row(ON_COURSE | {Phase.PAUSED}, Order.REJOIN, Phase.HALTING),
    _row(ANY - {Phase.STOPPED}, Order.DISARM, Phase.ENDING),
    _row(ANY, Order.STOP, Phase.STOPPED),
    _row(frozenset({Phase.STOPPED, Phase.WAITING}), Order.CLEAR_STOP, Phase.CLEARING),  # WAITING: of an earlier station's life
    # from the water to the end
    _row(Phase.WAITING, Event.FIT, Phase.LOADING),
    _row(Phase.LOADING, Event.OBEYED, Phase.ARMING),
    _row(Phase.ARMING, Event.OBEYED, Phase.STARTING),
    _row(Phase.STARTING, Event.OBEYED, Phase.RUNNING),
    _row(FLYING, Event.ARRIVED, Phase.ENDING),
    _row(Phase.ENDING, Event.OBEYED, Phase.DONE),
    _row(Phase.ENDING, Event.DISARMED_FAILED, Phase.FAILED),
    _row(Phase.ENDING, Event.DISARMED_CANCELLED, Phase.CANCELLED),
    # under way
    _row(frozenset({Phase.RUNNING, Phase.DEGRADED}), Event.LAGGING, Phase.SLOWED),
    _row(Phase.SLOWED, Event.CAUGHT_UP, Phase.RUNNING),
    _row(Phase.RUNNING, Event.MISSING, Phase.DEGRADED),
    _row(Phase.RUNNING, Event.HOMEWARD, Phase.RETURNING),
    _row(ON_COURSE, Event.OBSTACLE, Phase.SWITCHING),
    _row(Phase.SWITCHING, Event.OBEYED, Phase.RUNNING),
    _row(Phase.SWITCHING, Event.NO_PLAN, Phase.RUNNING),
    _row(Phase.SWITCHING, Event.UNHEEDED, Phase.PAUSED),
    _row(Phase.SWITCHING, Event.BLOCKED, Phase.PAUSED),
    _row(FLYING, Event.HELD, Phase.PAUSED),
    _row(FLYING | JOINING, Event.OUT_OF_STEP, Phase.PAUSED),
    _row(FLYING, Event.BLIND, Phase.PAUSED),
    _row(Phase.PAUSED, Event.WELL, Phase.RESUMING),
    _row(Phase.RESUMING, Event.OBEYED, Phase.RUNNING),
    _row(Phase.RESUMING, Event.BESIDE_LOST, Phase.HALTING),
    _row(Phase.RESUMING, Event.ASTRAY, Phase.HALTING),
    # a new plan from rest: home, into place again, or closing up
    _row(UNDER_WAY, Event.LOST_CLOSE_UP, Phase.HALTING),
    _row(UNDER_WAY - {Phase.PAUSED}, Event.LOST_HOLD, Phase.PAUSED),
    _row(PLANNING | {Phase.RELEASING}, Event.LOST_ANEW, Phase.HALTING),
    _row(UNDER_WAY, Event.LOST, Phase.ABORTING),
    _row(PLANNING, Event.LOST_ALL, Phase.ABORTING),
    _row(ON_COURSE | {Phase.RETURNING, Phase.RESUMING}, Event.IN_OWN_WAY, Phase.HALTING),
    _row(Phase.HALTING, Event.PLANNED, Phase.RELOADING),
    _row(Phase.HALTING, Event.NO_PLAN, Phase.PAUSED),
    _row(Phase.RELOADING, Event.OBEYED, Phase.REARMING),
    _row(Phase.REARMING, Event.OBEYED, Phase.RELEASING),
    _row(Phase.RELEASING, Event.OBEYED, Phase.RUNNING),
    # what goes wrong
    _row(_STAGES | {Phase.HALTING, Phase.ENDING, Phase.CLEARING} | _TEST, Event.UNHEEDED, Phase.ABORTING),
    _row(Phase.ABORTING, Event.OBEYED, Phase.FAILED),
    _row(Phase.ABORTING, Event.UNHEEDED, Phase.FAILED),
    _row(Phase.CLEARING, Event.OBEYED, Phase.WAITING),
    # thruster test
    _row(Phase.TEST_ARMING, Event.OBEYED, Phase.TESTING),
    _row(Phase.TESTING, Event.OBEYED, Phase.TEST_ENDING),
    _row(Phase.TEST_ENDING, Event.OBEYED, Phase.WAITING),
)


def after(phase: Phase, cause: Order | Event) -> Phase | None:
    """Where that leads from here; None if nowhere."""
    return next((row.to for row in TABLE if row.cause is cause and phase in row.phases), None)


def allowed(order: Order) -> frozenset[Phase]:
    """In which phases a person's order counts."""
    return frozenset().union(*(row.phases for row in TABLE if row.cause is order))


def refusal(order: Order, phase: Phase) -> str:
    """Why a person's order does not count now; empty if it does."""
    wishes = [row.cause for row in TABLE if isinstance(row.cause, Order)]
    if order not in wishes:
        return f"{order.name} is not for a whole mission (allowed: {', '.join(o.name for o in wishes)})"
    if phase in allowed(order):
        return ""
    names = ", ".join(p.name for p in Phase if p in allowed(order))
    return f"{order.name} is not possible when {phase.name} (only when {names})"


def markdown() -> str:
    """Both halves of the table, for docs/missions.md."""
    lines = ["| State | |", "| --- | --- |", *(f"| {phase.name} | {phase.value} |" for phase in Phase), ""]
    lines += ["| A person's order | counts when | leads to |", "| --- | --- | --- |"]
    lines += [_line(row.cause.name, row) for row in TABLE if isinstance(row.cause, Order)]
    lines += ["", "| By itself | when | leads to |", "| --- | --- | --- |"]
    lines += [_line(row.cause.value, row) for row in TABLE if isinstance(row.cause, Event)]
    return "\n".join(lines) + "\n"


def _line(cause: str, row: Row) -> str:
    missing = [phase.name for phase in Phase if phase not in row.phases]
    names = ", ".join(phase.name for phase in Phase if phase in row.phases)
    when = "always" if not missing else f"always but {', '.join(missing)}" if len(missing) < 4 else names
    return f"| {cause} | {when} | {row.to.name} |"

"""Reasons to refuse an operator's request in a state that allows it: a table by order. Pure."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from groundstation.mission.command_dispatcher import MOVING
from groundstation.mission.roster import TAKEN_OUT, Roster
from groundstation.mission.state_machine import AT_REST, MissionState
from groundstation.planning.replanning import can_replan
from groundstation.planning.segment import PlanSegment
from groundstation.planning.shift import common_path
from groundstation.telemetry import (
    Fleet,
    RobotView,
    blind_robots,
    blocking_findings,
    first_lost_robot,
    foreign_poses,
    preflight,
)
from shoal.config.experiment import Experiment, with_flight
from shoal.config.scene import Circle, read_form
from shoal.errors import ConfigError
from shoal.frames import Array
from shoal.messages.messages import CommandKind, Mode

ARMED = frozenset({Mode.ARMED, Mode.HOLDING})
LIVE = ARMED | MOVING


@dataclass(frozen=True, eq=False)
class RequestContext:
    """State of mission and fleet that a request is judged by."""

    experiment: Experiment  # of the session; what is flown may be another path (`flown`)
    flown: Experiment
    state: MissionState
    roster: Roster
    segment: PlanSegment
    starts: Mapping[int, Array]
    fleet: Fleet
    via: Sequence[tuple[float, float]] = ()  # places of a GO, x and y in m
    text: str = ""  # of a FORMATION the form, of a PATH the experiment
    planning: bool = False  # a plan for robots at rest is being made
    transfer: bool = False  # robots fly separate transfers now
    homeward: bool = False  # they are to return to the start, and have no plan for it yet

    @cached_property
    def other_flight(self) -> Experiment:
        """The session's experiment with the flight that a PATH asks for; read once. Raises ConfigError."""
        return with_flight(self.experiment, self.text)


def objection(order: CommandKind, context: RequestContext) -> str:
    """Reason against a request in a state that allows it; empty if there is none."""
    return _first(OBJECTIONS.get(order, ()), context)


def standing_objection(order: CommandKind, context: RequestContext) -> str:
    """Reason against a request whatever its places, form or experiment; empty if there is none."""
    return _first((check for check in OBJECTIONS.get(order, ()) if check not in OF_DETAILS), context)


def _first(checks: "Iterable[Check]", context: RequestContext) -> str:
    """The reason of the first check that has one, or ""."""
    return next((reason for check in checks if (reason := check(context))), "")


def mode_name(robot: RobotView) -> str:
    """Name of a robot's mode for people."""
    return robot.mode.name if robot.mode is not None else "never heard"


def unfit_to_return(context: RequestContext, robot: int) -> str:
    """Reason for which a robot cannot take part in a return; empty if it can. A disarmed robot has to be armed for it: all
    that blocks arming counts, except its distance from the start."""
    fleet = context.fleet
    lost = first_lost_robot((robot,), fleet, (robot,))
    if lost is not None:
        return lost[1]
    disarmed = fleet[robot].mode is Mode.DISARMED
    blocks = blocking_findings(context.experiment, {robot: fleet[robot]}) if disarmed else ()
    return "; ".join(finding.message for finding in blocks)


def fit_to_rejoin(context: RequestContext) -> tuple[int, ...]:
    """Robots that are out of the formation and could take part again."""
    return tuple(r for r in context.roster.lost if not _unfit_to_rejoin(context, r))


def _unfit_to_rejoin(context: RequestContext, robot: int) -> str:
    if robot in context.roster.out:
        return f"robot {robot} is {TAKEN_OUT} (groundstation mission back-in --robot {robot})"
    return "; ".join(preflight(context.experiment, {robot: context.fleet[robot]}, exclude=("thrusters",)))


def _moves(context: RequestContext) -> str:
    moving = [r for r, view in context.fleet.items() if view.heard and view.mode in MOVING]
    if not moving or context.state not in AT_REST:
        return ""
    led = moving[0] in context.roster.led_by_people
    return f"robot {moving[0]} {'is led by a person' if led else 'still moves'}: let it hold first"


def _unfit_to_start(context: RequestContext) -> str:
    return "; ".join(preflight(context.experiment, context.fleet, context.starts))


def _unfit_to_test(context: RequestContext) -> str:
    return "; ".join(preflight(context.experiment, context.fleet, exclude=("thrusters",)))


def _holds(context: RequestContext) -> str:
    """A thruster test arms robots: one that holds refuses that."""
    holding = [r for r in context.roster.active if (view := context.fleet[r]).heard and view.mode is Mode.HOLDING]
    return "; ".join(f"robot {r} holds: disarm it first" for r in holding)


def _not_holding(context: RequestContext) -> str:
    fleet = context.fleet
    others = [r for r in context.roster.active if fleet[r].mode is not Mode.HOLDING]
    return "; ".join(f"robot {r} does not hold yet ({mode_name(fleet[r])})" for r in others)


def _not_stopped(context: RequestContext) -> str:
    fleet = context.fleet
    live = [r for r in context.roster.all_robots if fleet[r].heard and fleet[r].mode in LIVE]
    why = "is armed: disarm it first" if context.state in AT_REST else "has not stopped yet"
    return "; ".join(f"robot {r} {why} ({mode_name(fleet[r])})" for r in live)


def _none_armed(context: RequestContext) -> str:
    disarmed = all(context.fleet[r].mode is Mode.DISARMED for r in context.roster.active)
    return "no robot is armed" if disarmed else ""


def _foreign_poses(context: RequestContext) -> str:
    return foreign_poses(context.experiment, context.fleet, context.roster.active)


def _blind(context: RequestContext) -> str:
    """Robots that hold would be sent off for a moment, and hold again. At rest the preflight looks."""
    return "" if context.state in AT_REST else blind_robots(context.experiment, context.fleet, context.roster.active)


def _returns(context: RequestContext) -> str:
    returns = (context.segment.is_return or context.homeward) and context.state not in AT_REST
    return "the robots are on their way back to the start, each on its own" if returns else ""


def _no_places(context: RequestContext) -> str:
    return "" if context.via else "where to? (places for the formation's centre, x and y in m)"


def _unchangeable(context: RequestContext) -> str:
    """The reason why the path cannot be left for other places under way, or ""."""
    experiment = context.flown
    if can_replan(experiment):
        return ""
    if any(robot.path is not None for robot in experiment.robots):
        what = "robots have paths of their own"
    else:
        what = "the path is a circle" if isinstance(experiment.path, Circle) else "the path dives"
    return f"{what}: it cannot be left for other places under way"


def _no_form(context: RequestContext) -> str:
    """The reason why the formation cannot take the form that is asked for, or ""."""
    try:
        changes = read_form(context.text, 0.0)
    except ValueError as error:
        return str(error)
    ids = context.experiment.robot_ids
    if changes[0].order and sorted(changes[0].order) != sorted(ids):
        return f"order {','.join(map(str, changes[0].order))}: must name each robot once ({', '.join(map(str, ids))})"
    return "" if common_path(context.flown) else "robots have paths of their own: there is no formation to change"


def _no_flight(context: RequestContext) -> str:
    try:
        context.other_flight  # noqa: B018  # reads the text
    except ConfigError as error:
        return str(error)
    return ""


def _not_placed(context: RequestContext) -> str:
    """Robots at rest must be heard, and be where they will start: the plan begins there."""
    return _moves(context) or (_unfit_to_test(context) if context.state in AT_REST else "")


def _being_planned(context: RequestContext) -> str:
    return "the other path or form is still being planned: wait for it" if context.planning else ""


def _on_transfers(context: RequestContext) -> str:
    moves = context.state not in AT_REST | {MissionState.PAUSED} and context.transfer
    return "the robots are still on their way to their places: wait until they are there" if moves else ""


def _outside(context: RequestContext) -> str:
    length, width, _ = context.experiment.pool.size_m  # robots accept no path beyond it, in open water neither
    outside = [(x, y) for x, y in context.via if not (abs(x) <= length / 2.0 and abs(y) <= width / 2.0)]
    return "; ".join(f"({x:g}, {y:g}) m is outside the pool" for x, y in outside)


def _none_lost(context: RequestContext) -> str:
    return "" if context.roster.lost else "no robot is out"


def _no_place_left(context: RequestContext) -> str:
    reason = "the others are on their way back to the start, where no place is left to take"
    return reason if context.segment.is_return else ""


def _none_can_rejoin(context: RequestContext) -> str:
    if fit_to_rejoin(context):
        return ""
    return "; ".join(_unfit_to_rejoin(context, robot) for robot in context.roster.lost)


def _none_can_return(context: RequestContext) -> str:
    active = context.roster.active
    stay = [f"robot {r}: {why}" for r in active if (why := unfit_to_return(context, r))]
    return "" if len(stay) < len(active) else "; ".join(["no robot is fit to move", *stay])


Check = Callable[[RequestContext], str]

OF_DETAILS: tuple[Check, ...] = (_no_places, _outside, _no_form, _no_flight)

OBJECTIONS: Mapping[CommandKind, tuple[Check, ...]] = {
    CommandKind.LOAD: (_moves, _being_planned),
    CommandKind.ARM: (_moves, _being_planned, _unfit_to_start),
    CommandKind.START: (_moves, _being_planned, _unfit_to_start),
    CommandKind.TEST: (_moves, _holds, _unfit_to_test),
    CommandKind.RESUME: (_not_holding, _foreign_poses, _blind),
    CommandKind.CLEAR_STOP: (_not_stopped,),
    CommandKind.HOLD: (_none_armed,),
    CommandKind.GO: (_foreign_poses, _returns, _on_transfers, _no_places, _unchangeable, _outside),
    CommandKind.FORMATION: (_foreign_poses, _blind, _returns, _no_form, _on_transfers, _not_placed),
    CommandKind.PATH: (_foreign_poses, _blind, _no_flight, _not_placed),
    CommandKind.REJOIN: (_foreign_poses, _blind, _none_lost, _no_place_left, _none_can_rejoin),
    CommandKind.RETURN: (_foreign_poses, _blind, _none_can_return),
}

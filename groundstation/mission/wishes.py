"""What keeps the station from doing what a person asks for, in a phase in which it counts. Pure."""

from collections.abc import Mapping, Sequence

from groundstation.mission.roster import Crew
from groundstation.mission.stages import LIVE
from groundstation.planning.replanning import can_detour
from groundstation.planning.segment import Leg
from groundstation.telemetry import Fleet, RobotView, barred, casualty, preflight
from wire.config.experiment import Experiment
from wire.frames import Array
from wire.messages.messages import Mode, Order

UNFIT = frozenset({Mode.FAULT, Mode.STOPPED})


def objection(
    order: Order,
    experiment: Experiment,
    fleet: Fleet,
    crew: Crew,
    leg: Leg,
    starts: Mapping[int, Array],
    via: Sequence[tuple[float, float]],
) -> str:
    """Why not; empty if it can be done."""
    if order in (Order.ARM, Order.START):
        return "; ".join(preflight(experiment, fleet, starts))
    if order is Order.TEST:
        return "; ".join(preflight(experiment, fleet, but=("thrusters",)))
    if order is Order.RESUME:
        moving = [
            f"robot {r} does not hold yet ({mode_name(fleet[r])})" for r in crew.active if fleet[r].mode is not Mode.HOLDING
        ]
        return "; ".join(moving)
    if order is Order.CLEAR_STOP:
        flying = [r for r in crew.everybody if fleet[r].heard and fleet[r].mode in LIVE]
        return "; ".join(f"robot {r} has not stopped yet ({mode_name(fleet[r])})" for r in flying)
    if order is Order.HOLD and all(fleet[r].mode is Mode.DISARMED for r in crew.active):
        return "no robot is armed"
    if order is Order.GO and leg.home:
        return "the robots are on their way back to the start, each on its own"
    if order is Order.GO and not via:
        return "where to? (places for the formation's centre, x and y in m)"
    if order is Order.GO and not can_detour(experiment):
        return "the path is a circle, dives, or is not common to all robots: it cannot be changed under way"
    if order is Order.GO:
        return "; ".join(f"({x:g}, {y:g}) m is outside the pool" for x, y in via if not _inside(experiment, x, y))
    if order is Order.REJOIN and not crew.out:
        return "nobody is out"
    if order is Order.REJOIN and leg.home:
        return "the others are on their way back to the start, where nobody has a place to take"
    if order is Order.REJOIN:
        return "; ".join(preflight(experiment, {r: fleet[r] for r in crew.out}, but=("thrusters",)))
    if order is Order.RETURN:
        stay = [f"robot {r}: {why}" for r in crew.active if (why := stays(experiment, fleet, r))]
        return "" if len(stay) < len(crew.active) else "; ".join(["no robot is fit to move", *stay])
    return ""


def _inside(experiment: Experiment, x: float, y: float) -> bool:
    """Where a robot accepts a path to: also in open water, which has no walls."""
    length, width, _ = experiment.pool.size_m
    return abs(x) <= length / 2.0 and abs(y) <= width / 2.0


def mode_name(robot: RobotView) -> str:
    """A robot's mode as people read it."""
    return robot.mode.name if robot.mode is not None else "never heard"


def stays(experiment: Experiment, fleet: Fleet, robot: int) -> str:
    """Why a robot can have no part in a way home; empty if it can. One that lies disarmed has to be armed for it: whatever
    keeps it from that counts, but for where it lies."""
    lost = casualty((robot,), fleet, (robot,))
    if lost is not None:
        return lost[1]
    bars = barred(experiment, {robot: fleet[robot]}) if fleet[robot].mode is Mode.DISARMED else ()
    return "; ".join(finding.told for finding in bars)

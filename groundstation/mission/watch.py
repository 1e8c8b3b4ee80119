"""What a flight's next event is, of those that nobody asks for: its end, robots that hold or lag, things in the way. Pure.
Robots that are lost come before (groundstation/mission/mission.py)."""

from collections.abc import Callable
from dataclasses import dataclass

from groundstation.mission.roster import Crew
from groundstation.mission.state_machine import ON_COURSE, Event, Phase
from groundstation.planning.segment import Leg
from groundstation.telemetry import Fleet
from wire.messages.messages import Mode


@dataclass(frozen=True)
class Notice:
    """An event, and what people are told of it."""

    cause: Event
    reason: str = ""


def noticed(
    phase: Phase,
    fleet: Fleet,
    crew: Crew,
    leg: Leg,
    reached_s: float,
    fresh: bool,
    slowed: bool,
    contact: Callable[[], str],
    blind_holds: bool,
) -> Notice | None:
    """In a phase in which robots fly, with the slowest `reached_s` along the leg. `fresh`: what the fleet tells may be from
    before this phase. `slowed`: the formation waits for somebody. `contact` says where it would touch something (it takes a
    millisecond, and not every event asks). `blind_holds`: nobody flies on who cannot tell what lies in the pool."""
    if reached_s >= leg.end_s:
        return Notice(Event.ARRIVED)
    holding = [robot for robot in crew.active if fleet[robot].mode is Mode.HOLDING]
    if holding and not fresh:
        state = fleet[holding[0]].state
        return Notice(Event.HELD, f"robot {holding[0]} holds: {state.fault if state else ''}")
    blind = _blind(crew, fleet) if blind_holds else ""
    if blind:
        return Notice(Event.BLIND, blind)
    if phase is Phase.RUNNING and leg.home:
        return Notice(Event.HOMEWARD)
    if phase is Phase.RUNNING and crew.out:
        return Notice(Event.MISSING, "; ".join(f"robot {robot}: {why}" for robot, why in crew.out.items()))
    if phase not in ON_COURSE | {Phase.RETURNING}:
        return None
    touched = contact()
    if touched:
        return Notice(Event.IN_OWN_WAY if leg.apart(reached_s) else Event.OBSTACLE, f"something lies {touched}")
    if phase is Phase.RETURNING:
        return None
    if slowed and phase is not Phase.SLOWED:
        worst = max(crew.active, key=lambda robot: fleet[robot].error_m)
        return Notice(Event.LAGGING, f"robot {worst} is {fleet[worst].error_m:.2f} m from its place")
    return Notice(Event.CAUGHT_UP) if phase is Phase.SLOWED and not slowed else None


def _blind(crew: Crew, fleet: Fleet) -> str:
    """Which robots do not know of obstacles though somebody should watch for them, and why; empty if none."""
    found = {r: state.blind for r in crew.active if (state := fleet[r].state) is not None and state.blind}
    robots = f"robot{'s' if len(found) > 1 else ''} {', '.join(map(str, found))}"
    return f"{robots} blind: {next(iter(found.values()))}" if found else ""

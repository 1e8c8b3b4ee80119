"""Guidance states: what decides a robot's motion while it has power. A table of transitions, and one of bounds.

In each state exactly one thing is flown (STATES.flown). TRANSITIONS lists the changes, first match first. STATES has the
bounds too: the longest stay, and what happens after it. path_watch.py holds the robot to them. `robot-agent modes` prints both
tables for docs/reference/modes.md.

Each change is a line of the log and a change of the page, so states along the path are steady. What is in a robot's way may
come and go at every step. The robot counts as giving way until nothing has been in its way for half a horizon: the time in
which it can turn round and stop. And a state along the path lasts STEADY_S, unless its path leaps. The bounds do not wait for
that: whether a robot is excused by what it avoids is decided at each step.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from robot_agent.safety.modes import DRIVE_LASTS_S, POWERED
from shoal.messages.messages import Guidance, Mode

STEADY_S = 1.0  # a change a second is what a person can follow
LONGEST_AWAY_S = 120.0  # eight robots through one point were back after 76 s; two that wait for one another never are

ANY = frozenset(Guidance)
ALONG_PATH = frozenset({Guidance.JOINING, Guidance.ON_PATH, Guidance.GIVING_WAY, Guidance.RETURNING})
AWAY = frozenset({Guidance.GIVING_WAY, Guidance.RETURNING})  # their stays count as one


class GuidanceFacts(NamedTuple):
    """Facts that the transitions are decided by."""

    mode: Mode
    avoids: bool  # its plan leads around a robot or an obstacle, or did within half a horizon
    is_on_path: bool  # it is near its path and as fast, and has been since: the path has not leapt
    is_steady: bool  # its state has lasted STEADY_S


@dataclass(frozen=True)
class GuidanceTransition:
    """Change from one of `states` to `to` if `when` holds; `condition` says it in words."""

    states: frozenset[Guidance]
    to: Guidance
    condition: str
    when: Callable[[GuidanceFacts], bool]


TRANSITIONS: tuple[GuidanceTransition, ...] = (
    GuidanceTransition(ANY, Guidance.NONE, "the mode puts out no thrust", lambda f: f.mode not in POWERED),
    GuidanceTransition(ANY, Guidance.HOLDING, "mode HOLDING", lambda f: f.mode is Mode.HOLDING),
    GuidanceTransition(ANY, Guidance.DRIVEN, "mode DRIVEN", lambda f: f.mode is Mode.DRIVEN),
    GuidanceTransition(
        ANY, Guidance.GIVING_WAY, "it avoids a robot or an obstacle, or did within half a horizon", lambda f: f.avoids
    ),
    GuidanceTransition(ANY, Guidance.ON_PATH, "near its path, and as fast", lambda f: f.is_on_path),
    GuidanceTransition(AWAY, Guidance.RETURNING, "nothing has been in its way for half a horizon", lambda f: True),
    GuidanceTransition(ANY, Guidance.JOINING, "mode TRACKING; or the path's velocity leaps", lambda f: True),
)


def next_state(state: Guidance, facts: GuidanceFacts) -> Guidance:
    """The state after a step: that of the first transition that applies. Changes between states along the path wait until the
    state has lasted STEADY_S, except for JOINING, when the path has leapt."""
    new_state = next(t.to for t in TRANSITIONS if state in t.states and t.when(facts))
    may_wait = {state, new_state} <= ALONG_PATH and new_state is not Guidance.JOINING
    return state if may_wait and not facts.is_steady else new_state


class StayLimits(NamedTuple):
    """Longest stays that depend on the flight, s."""

    join_s: float  # twice the time that the way to the path takes, and two horizons (path_watch.py)
    path_s: float = float("inf")  # what is left of the path


@dataclass(frozen=True)
class GuidanceState:
    """A state: its flight, the function that decides it, its longest stay, and what happens then."""

    flown: str
    decided_by: str
    bounds: str
    longest: str
    longest_s: Callable[[StayLimits], float]
    then: str


FORESEEN = "the plan's prediction"

STATES: dict[Guidance, GuidanceState] = {
    Guidance.NONE: GuidanceState(
        "nothing: neutral", "Agent._goal", "none: it has no thrust", "until a command", lambda s: float("inf"), "-"
    ),
    Guidance.JOINING: GuidanceState(
        "the path", "TrajectoryClock.goal", f"{FORESEEN}; the error it began with and `safety.off_path_m`",
        "twice the time of the way to the path, and two horizons; longer while it comes nearer", lambda s: s.join_s,
        "FAULT: not in time on its path",
    ),
    Guidance.ON_PATH: GuidanceState(
        "the path", "TrajectoryClock.goal", f"{FORESEEN}; `safety.off_path_m`", "to the path's end", lambda s: s.path_s,
        "the path's last pose is held",
    ),
    Guidance.GIVING_WAY: GuidanceState(
        "a way around what is in the way, chosen by the rule for right of way", "GiveWay",
        f"{FORESEEN}; while nothing is in its way as RETURNING",
        f"{LONGEST_AWAY_S:g} s, RETURNING included", lambda s: LONGEST_AWAY_S, "HOLDING: gives way for too long",
    ),
    Guidance.RETURNING: GuidanceState(
        "the way back to the path", "GiveWay", f"{FORESEEN}; the error it began with and `safety.off_path_m`",
        f"{LONGEST_AWAY_S:g} s, GIVING_WAY included", lambda s: LONGEST_AWAY_S, "HOLDING: gives way for too long",
    ),
    Guidance.HOLDING: GuidanceState(
        "the place where it can stop", "Agent._goal", f"{FORESEEN}; `safety.off_path_m` from the place, once it was there",
        "until a command; without a station `safety.station_neutral_s`", lambda s: float("inf"), "FAULT: station silent",
    ),
    Guidance.DRIVEN: GuidanceState(
        "the arc of the last DRIVE; its reference leads by 0.5 m at most", "Driver.goal", FORESEEN,
        f"{DRIVE_LASTS_S:g} s after the last DRIVE", lambda s: DRIVE_LASTS_S, "HOLDING: no drive command",
    ),
}  # fmt: skip


def table() -> str:
    """Both tables as Markdown, for docs/reference/modes.md."""
    lines = ["| Guidance state | what is flown | decided by | bounds | longest stay | then |", f"|{' --- |' * 6}"]
    lines += [
        f"| {name.name} | {s.flown} | `{s.decided_by}` | {s.bounds} | {s.longest} | {s.then} |" for name, s in STATES.items()
    ]
    lines += ["", "| From, first match first | when | to |", "| --- | --- | --- |"]
    for t in TRANSITIONS:
        states = "any" if t.states == ANY else ", ".join(s.name for s in Guidance if s in t.states)
        lines.append(f"| {states} | {t.condition} | {t.to.name} |")
    lines += ["", f"A state along the path lasts {STEADY_S:g} s at least, unless the path's velocity leaps."]
    return "\n".join(lines) + "\n"

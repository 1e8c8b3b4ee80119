"""Modes of a robot: two tables and the function that reads them.

ORDERS lists the modes in which each command is accepted. REACTIONS lists the robot's own transitions, first match first; none
of them leads back to thrust. `robot-agent modes` prints both for docs/reference/modes.md.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from shoal.config.controller import Safety
from shoal.messages.messages import CommandKind, Mode

BOARD_LOST_S = 0.3  # six bursts at 20 Hz; the board itself goes to neutral 0.25 s after the last pulses it got
BOARD_DISOBEYS_S = 0.2  # of the last second: an echo or two may be lost; a thruster that runs by itself should not for long
BOARD_ARMS_WITHIN_S = 1.5  # its heartbeat, which says so, comes once a second
LATE_S = 0.15  # so much more of the time steps are late than in time: three steps at 20 Hz, as many as a plan may bridge
DRIVE_LASTS_S = 0.5  # a DRIVE counts for this long; the station sends one every control period
# A marker is unread for a frame or two now and then; robots that may be mixed up hold within 0.3 s. Where older poses are good
# enough (safety.pose_hold_s), so are older readings of a marker.
DOUBT_S = 0.25

UNDER_WAY = frozenset({Mode.TRACKING, Mode.DRIVEN})  # modes that a robot leaves for HOLDING when it should not go on
POWERED = UNDER_WAY | {Mode.HOLDING}  # modes that put out thrust
LIVE = POWERED | {Mode.ARMED}
ANY = frozenset(Mode)


@dataclass(frozen=True)
class ModeTransition:
    """Modes in which a command is accepted, and the mode that it leads to; None keeps the mode."""

    accepted_in: frozenset[Mode]
    to: Mode | None


ORDERS: dict[CommandKind, ModeTransition] = {
    CommandKind.LOAD: ModeTransition(
        frozenset({Mode.DISARMED, Mode.ARMED, Mode.TRACKING, Mode.HOLDING}), None
    ),  # TRACKING: for later
    CommandKind.SWITCH: ModeTransition(frozenset({Mode.TRACKING}), None),
    CommandKind.TEST: ModeTransition(frozenset({Mode.ARMED}), None),
    CommandKind.ARM: ModeTransition(frozenset({Mode.DISARMED}), Mode.ARMED),
    CommandKind.START: ModeTransition(frozenset({Mode.ARMED, Mode.HOLDING}), Mode.TRACKING),
    CommandKind.HOLD: ModeTransition(LIVE, Mode.HOLDING),
    CommandKind.RESUME: ModeTransition(frozenset({Mode.HOLDING}), Mode.TRACKING),
    CommandKind.DRIVE: ModeTransition(frozenset({Mode.HOLDING, Mode.DRIVEN}), Mode.DRIVEN),
    CommandKind.DISARM: ModeTransition(ANY - {Mode.STOPPED}, Mode.DISARMED),
    CommandKind.STOP: ModeTransition(ANY, Mode.STOPPED),
    CommandKind.CLEAR_STOP: ModeTransition(frozenset({Mode.STOPPED}), Mode.DISARMED),
    CommandKind.TUNE: ModeTransition(ANY - {Mode.STOPPED}, None),
    CommandKind.ADOPT: ModeTransition(ANY - {Mode.STOPPED}, None),
}


class Health(NamedTuple):
    """Values that the reactions are decided by. An age is in seconds by the receiver's clock; infinity is "never heard"."""

    pose_age_s: float  # of the last pose that was seen, not only predicted
    identity_age_s: float  # of the last pose that was surely this robot's
    station_age_s: float
    board_age_s: float
    board_disarmed_s: float  # for how long the board has been disarmed though it should not be
    battery_empty: bool
    emergency_stop: bool
    solver_failed: bool
    late_s: float = 0.0  # by how much the time of late steps outweighs that of timely ones
    echo_wrong_s: float = 0.0  # for how much of the last second the board has put out other pulses than it was told
    thrusters_broken: bool = False  # they do not turn and push the robot as they should
    off_path: bool = False  # farther than it may be, and for no reason
    likely_cause: str = ""  # of either
    watch_reason: str = ""  # what else the path watch found, a reason of REACTIONS,
    watch_detail: str = ""  # and what there is to say besides
    estimate_ended: bool = False  # while it had power: where it is was not known at a step since
    off_depth: bool = False  # the same for its depth
    depth_age_s: float = 0.0  # of the last depth that did not contradict the estimate
    depth_leap: str = ""  # the depth that is told and the one that was believed, when one had to give way
    leap: str = ""  # the same for the place
    place_age_s: float = 0.0  # of the last pose that did not contradict the estimate
    drive_age_s: float = 0.0  # of the last DRIVE, on the station's clock
    autopilot: str = ""  # the name of the autopilot that answers in place of a thruster board
    gyroscope: str = ""  # the reason to doubt the gyroscope,
    accelerometer: str = ""  # and the accelerometer
    depth_same_s: float = 0.0  # for how long the depth has been exactly the same, once that is too long


@dataclass(frozen=True)
class Reaction:
    """ModeTransition from one of `modes` to `to`, with `reason`, if `when` holds."""

    reason: str
    modes: frozenset[Mode]
    when: Callable[[Health, Safety], bool]
    to: Mode
    detail: Callable[[Health], str] = lambda h: ""  # that belongs to the reason, if there is more to say


def _watched(reason: str, modes: frozenset[Mode], to: Mode) -> Reaction:
    """Reaction to a finding of the path watch (path_watch.py)."""
    return Reaction(reason, modes, lambda h, s: h.watch_reason == reason, to, lambda h: h.watch_detail)


REACTIONS: tuple[Reaction, ...] = (
    Reaction("emergency stop", ANY - {Mode.STOPPED}, lambda h, s: h.emergency_stop, Mode.STOPPED),
    Reaction("thruster board silent", LIVE, lambda h, s: h.board_age_s > BOARD_LOST_S, Mode.FAULT),
    Reaction("no thruster board", LIVE, lambda h, s: h.autopilot != "", Mode.FAULT, lambda h: f"{h.autopilot} is on the link"),
    Reaction("thruster board disarmed", LIVE, lambda h, s: h.board_disarmed_s > BOARD_ARMS_WITHIN_S, Mode.FAULT),
    Reaction("thruster board disobeys", LIVE, lambda h, s: h.echo_wrong_s > BOARD_DISOBEYS_S, Mode.FAULT),
    _watched("held fast", POWERED, Mode.FAULT),
    _watched("marker turned", POWERED, Mode.FAULT),
    _watched("current too strong", POWERED, Mode.FAULT),
    Reaction(
        "thrusters do not do as told", POWERED, lambda h, s: h.thrusters_broken and s.watch_thrusters, Mode.FAULT,
        lambda h: h.likely_cause or "one is broken, something holds the robot fast, or the gyroscope is wrong",
    ),
    Reaction("off its path", POWERED, lambda h, s: h.off_path, Mode.FAULT, lambda h: h.likely_cause),
    _watched("not in time on its path", POWERED, Mode.FAULT),
    _watched("does not follow its plan", POWERED, Mode.FAULT),
    Reaction("off its depth", POWERED, lambda h, s: h.off_depth, Mode.FAULT),
    Reaction("depth in doubt", POWERED, lambda h, s: h.depth_leap != "", Mode.FAULT, lambda h: h.depth_leap),
    Reaction(
        "depth sensor stuck", POWERED, lambda h, s: h.depth_same_s > 0.0, Mode.FAULT,
        lambda h: f"exactly the same for {h.depth_same_s:.1f} s",
    ),
    Reaction("gyroscope in doubt", POWERED, lambda h, s: h.gyroscope != "", Mode.FAULT, lambda h: h.gyroscope),
    Reaction("accelerometer in doubt", POWERED, lambda h, s: h.accelerometer != "", Mode.FAULT, lambda h: h.accelerometer),
    Reaction(
        "no depth", POWERED, lambda h, s: h.depth_age_s > s.pose_neutral_s, Mode.FAULT,
        lambda h: f"none that can be true for {h.depth_age_s:.2f} s",
    ),
    Reaction("battery empty", LIVE, lambda h, s: h.battery_empty, Mode.FAULT),
    Reaction("no pose", POWERED, lambda h, s: h.pose_age_s > s.pose_neutral_s, Mode.FAULT),
    Reaction(
        "no pose that can be true", POWERED, lambda h, s: h.place_age_s > s.pose_neutral_s, Mode.FAULT,
        lambda h: f"for {h.place_age_s:.2f} s all that came contradict the estimate",
    ),
    Reaction("no control solution", POWERED, lambda h, s: h.solver_failed, Mode.FAULT),
    Reaction("estimate ended", POWERED, lambda h, s: h.estimate_ended, Mode.FAULT),
    Reaction("control too slow", POWERED, lambda h, s: h.late_s >= LATE_S, Mode.FAULT),
    Reaction("station lost", LIVE | {Mode.FAULT}, lambda h, s: h.station_age_s > s.station_disarm_s, Mode.DISARMED),
    Reaction("station silent", LIVE, lambda h, s: h.station_age_s > s.station_neutral_s, Mode.FAULT),
    Reaction("station late", UNDER_WAY, lambda h, s: h.station_age_s > s.station_hold_s, Mode.HOLDING),
    Reaction("pose late", UNDER_WAY, lambda h, s: h.pose_age_s > s.pose_hold_s, Mode.HOLDING),
    Reaction("identity in doubt", UNDER_WAY, lambda h, s: h.identity_age_s > max(DOUBT_S, s.pose_hold_s), Mode.HOLDING),
    Reaction("position leapt", UNDER_WAY, lambda h, s: h.leap != "", Mode.HOLDING, lambda h: h.leap),
    _watched("gives way for too long", frozenset({Mode.TRACKING}), Mode.HOLDING),
    Reaction("no drive command", frozenset({Mode.DRIVEN}), lambda h, s: h.drive_age_s > DRIVE_LASTS_S, Mode.HOLDING),
)  # fmt: skip

REACTIONS_IN = {mode: tuple(reaction for reaction in REACTIONS if mode in reaction.modes) for mode in Mode}


def react(mode: Mode, health: Health, safety: Safety) -> tuple[Mode, str]:
    """Return the mode after this step's reactions, and the reason if it changed (empty otherwise)."""
    for reaction in REACTIONS_IN[mode]:
        if reaction.when(health, safety):
            detail = reaction.detail(health)
            return reaction.to, f"{reaction.reason}: {detail}" if detail else reaction.reason
    return mode, ""


def refusal(order: CommandKind, mode: Mode) -> str:
    """Return the reason to refuse `order` in `mode`, with the modes in which it is accepted; empty if it is accepted."""
    if order not in ORDERS:
        return f"{order.name} is no order (allowed: {', '.join(o.name for o in ORDERS)})"
    if mode in ORDERS[order].accepted_in:
        return ""
    allowed = ", ".join(m.name for m in Mode if m in ORDERS[order].accepted_in)
    return f"{order.name} is not accepted when {mode.name} (only when {allowed})"


def table() -> str:
    """Both tables as Markdown with a Mermaid diagram, for docs/reference/modes.md."""
    lines = ["```mermaid", "stateDiagram-v2", "    [*] --> DISARMED"]
    for order, transition in ORDERS.items():
        for mode in Mode:
            if mode in transition.accepted_in and transition.to not in (None, mode) and order is not CommandKind.STOP:
                assert transition.to is not None
                lines.append(f"    {mode.name} --> {transition.to.name}: {order.name}")
    lines += ["```", "", "| Command | accepted when | leads to |", "| --- | --- | --- |"]
    for order, transition in ORDERS.items():
        accepted = _names(transition.accepted_in)
        lines.append(f"| {order.name} | {accepted} | {transition.to.name if transition.to is not None else 'same mode'} |")
    lines += ["", f"*With thrust*: {', '.join(m.name for m in Mode if m in POWERED)}. *Live*: these and ARMED.", ""]
    lines += ["| By itself, first match first | when | leads to |", "| --- | --- | --- |"]
    for (modes, to), reactions in itertools.groupby(REACTIONS, key=lambda r: (r.modes, r.to)):
        lines.append(f"| {'; '.join(r.reason for r in reactions)} | {_names(modes)} | {to.name} |")
    return "\n".join(lines) + "\n"


def _names(modes: frozenset[Mode]) -> str:
    groups = {ANY: "any", ANY - {Mode.STOPPED}: "any but STOPPED", LIVE: "live", POWERED: "with thrust"}
    return groups.get(modes) or ", ".join(m.name for m in Mode if m in modes)

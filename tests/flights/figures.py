"""Figures of a flight, all from the plant's truth. Of several robots the worst counts. NaN: the flight does not have it;
infinity: it never came."""

import math
import re
from dataclasses import dataclass, field

import numpy as np

from shoal.frames import Array
from shoal.messages.messages import Control, Mode, required
from tests.flights.claims import GROUPS
from tests.flights.grid_flights import STOPPED, FlightLog

SETTLED_M = 0.05  # this near a robot counts as on its path, or in its place
STEADY_S = 20.0  # RMS are from here on, as in all other tables of this project
HOLD_FROM_S = 10.0  # after HOLD
LAST_S = 10.0  # at the end of path and HOLD: a robot that is away most of this time never settled
LEFT_M = 0.10  # an encounter leads a robot off its path by more
CAUSES = {  # words of a reason that name the cause
    "held at the start": r"held|stuck|fast|caught|net\b",
    "held": r"held|stuck|fast|caught|net\b",
    "held in an encounter": r"held|stuck|fast|caught|net\b",
    "turned marker": r"marker|heading",
    "swept": r"current",
}


@dataclass(frozen=True)
class FlightFigures:
    """Figures of one flight: distances in m, times in s."""

    cell: str
    number: int
    scene: str
    rate_hz: int
    robots: int
    refused: str = ""  # reason of a planner or robot that did not begin
    left: str = ""  # mode and reason when a robot left TRACKING without an order, and when; empty if none did
    is_stop: bool = False  # it stopped: not only HOLD; not of a robot without thrust in an encounter, which should
    holds: bool = False  # HOLD was ordered
    settled_s: float = math.nan  # from when on it was within 5 cm for good, on its path
    never_settled: bool = False  # it was away for most of the last 10 s of path or HOLD
    rms_m: float = math.nan  # after 20 s, three axes together
    max_m: float = math.nan  # after 20 s, horizontally
    overshoot_m: float = math.nan  # largest distance from the place to hold in the first 10 s of HOLD
    hold_m: float = math.nan  # the same after that
    hold_rms_m: float = math.nan
    stop_s: float = math.nan  # from the beginning of the trouble until it stops
    is_named: bool = False  # the reason names the cause
    nearest_m: float = math.nan  # centres of any two robots
    back_s: float = math.nan  # from leaving the path for another robot until it is back for good
    nees: dict[str, float] = field(default_factory=dict)  # mean per degree of freedom of each group of states
    duty: float = math.nan  # mean of |wrench| over its limit, worst axis
    steps: float = math.nan  # after 20 s on the path: RMS of the input's change per step over its limit, worst axis


def figures(log: FlightLog) -> FlightFigures:
    """The figures of a flight."""
    plan, nan, cell = log.plan, math.nan, log.plan.of
    head = (plan.cell, plan.number, plan.scene, plan.rate_hz, max(len(log.states), 1))
    if log.refused:
        by_robot = cell.is_trap and " refuses " in log.refused  # before it moved
        named = by_robot and _names(cell.trouble, log.refused)
        return FlightFigures(*head, refused=log.refused, stop_s=0.0 if by_robot else nan, is_named=named)
    end = len(log.truth) if log.hold_row is None else log.hold_row
    error = log.truth - log.path
    off_m = np.hypot(error[..., 0], error[..., 1])  # (steps, n)
    steady = slice(round(STEADY_S / log.period_s), end)
    left, is_stop = _left(log)
    place = _hold(log)
    last = slice(max(end - round(LAST_S / log.period_s), 0), end)
    ends = (off_m[last][:, _flying(log)], place[-_rows(log, LAST_S) :])
    away_m = [float(np.median(values, axis=0).max()) for values in ends if len(values)]
    fell = is_stop and log.hold_row is None  # on its path
    stop_s, reason = _stop(log)
    inputs = next((np.zeros_like(s.control.wrench) for states in log.states for s in states if s.control), np.zeros(3))
    still = Control(wrench=inputs, wrench_step=inputs)  # of a robot that has stopped
    controls = [[s.control or still for s in states] for states in log.states]
    wrench, step = (np.array([[getattr(c, key) for c in each] for each in controls]) for key in ("wrench", "wrench_step"))
    meets = len(log.states) > 1
    return FlightFigures(
        *head,
        left=left,
        is_stop=is_stop,
        holds=log.hold_row is not None,
        settled_s=nan if meets or plan.scene == "square" else math.inf if fell else _for_good(off_m[:end, 0], log.period_s),
        never_settled=max(away_m) > SETTLED_M and not is_stop,
        rms_m=nan if fell else _rms(np.linalg.norm(error[steady, :, :3], axis=2)),
        max_m=float(off_m[steady].max(initial=0.0)) if end > steady.start and not fell else nan,
        overshoot_m=_largest(place[: _rows(log, HOLD_FROM_S)]),
        hold_m=_largest(place[_rows(log, HOLD_FROM_S) :]),
        hold_rms_m=_rms(place[_rows(log, HOLD_FROM_S) :]),
        stop_s=stop_s,
        is_named=_names(cell.trouble, reason),
        nearest_m=_nearest(log.truth) if meets else nan,
        back_s=max((_back(off_m[:, i], log.period_s) for i in _flying(log)), default=nan) if meets else nan,
        nees={
            group: float(np.mean(group_nees))
            for group in GROUPS
            if (group_nees := [c[group] for c in log.claims if group in c])
        },
        duty=float((np.abs(wrench).mean(axis=1) / log.wrench_limit).max()),
        steps=float((np.sqrt((step[:, steady] ** 2).mean(axis=1)) / log.step_limit).max()) if end > steady.start else nan,
    )


def _rows(log: FlightLog, time_s: float) -> int:
    return round(time_s / log.period_s)


def _rms(values: Array) -> float:
    """Worst robot's RMS of values (steps, n)."""
    return float(np.sqrt((values**2).mean(axis=0)).max()) if len(values) else math.nan


def _largest(values: Array) -> float:
    return float(values.max()) if len(values) else math.nan


def _left(log: FlightLog) -> tuple[str, bool]:
    """The first mode that no one ordered, with time and reason, a stop before a HOLD; and whether a robot stopped, of an
    encounter one that has its thrust."""
    changes = [
        (state.mode not in STOPPED, k, i, state)
        for i, states in enumerate(log.states)
        for k, state in enumerate(states)
        if state.mode in STOPPED or (state.mode is Mode.HOLDING and state.fault)
    ]
    if not changes:
        return "", False
    _, k, i, state = min(changes, key=lambda change: change[:3])
    who = f"robot {i + 1}: " if len(log.states) > 1 else ""
    judged = range(len(log.states)) if log.plan.of.is_trap else _flying(log)
    is_stop = any(i in judged and not holds for holds, _, i, _ in changes)
    return f"{who}{state.mode.name} after {(k + 1) * log.period_s:.2f} s: {state.fault}", is_stop


def _hold(log: FlightLog) -> Array:
    """Distances (steps, n) from each robot's place to hold: the one it has 10 s after HOLD, so that it may choose where it can
    stop, but not wander. None of a robot that does not hold."""
    if log.hold_row is None:
        return np.zeros((0, 1))
    holds = [i for i, states in enumerate(log.states) if states[log.hold_row].mode is Mode.HOLDING]
    choice = min(log.hold_row + _rows(log, HOLD_FROM_S), len(log.truth)) - 1
    away = [
        np.hypot(*(log.truth[log.hold_row :, i, :2] - required(log.states[i][choice].control).eta_reference[:2]).T)
        for i in holds
        if log.states[i][-1].mode is Mode.HOLDING
    ]
    return np.stack(away, axis=1) if away else np.zeros((0, 1))


def _for_good(off_m: Array, period_s: float) -> float:
    """Time from which on a robot is within SETTLED_M; infinity if it ends outside."""
    outside = np.flatnonzero(off_m > SETTLED_M)
    if not len(outside):
        return 0.0
    return math.inf if outside[-1] == len(off_m) - 1 else float(outside[-1] + 2) * period_s


def _flying(log: FlightLog) -> list[int]:
    """Robots that the encounter's trouble leaves their thrust, to the end."""
    spared = 1 if log.plan.of.trouble in ("thrustless", "held in an encounter") else 0
    return list(range(spared, len(log.states)))


def _back(off_m: Array, period_s: float) -> float:
    """Time from leaving the path, once it was reached, until it is kept for good; 0 if it was never left."""
    begins = np.flatnonzero(off_m < SETTLED_M)
    if not len(begins):
        return math.inf
    outside = begins[0] + np.flatnonzero(off_m[begins[0] :] > LEFT_M)
    if not len(outside):
        return 0.0
    return _for_good(off_m[outside[0] :], period_s)


def _nearest(truth: Array) -> float:
    """Smallest distance of any two centres (steps, n, 4)."""
    apart = np.linalg.norm(truth[:, :, None, :3] - truth[:, None, :, :3], axis=3)
    apart[:, range(truth.shape[1]), range(truth.shape[1])] = np.inf
    return float(apart.min())


def _stop(log: FlightLog) -> tuple[float, str]:
    """Time from the trouble's beginning until the troubled robot stops, and its reason. NaN where it need not."""
    if not log.plan.of.is_trap or log.trouble_row is None:
        return math.nan, ""
    for k, state in enumerate(log.states[0][log.trouble_row :]):
        if state.mode in STOPPED:
            return (k + 1) * log.period_s, state.fault
    return math.inf, ""


def _names(trouble: str, reason: str) -> bool:
    """True if a reason names the cause."""
    return trouble in CAUSES and re.search(CAUSES[trouble], reason) is not None

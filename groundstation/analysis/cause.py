"""The cause of a run that did not pass, and the verdict. Pure.

The cause is what a person would name first: what they did themselves to end it, unless a fault lasted by then; else the first
fault that did not heal by itself, the station's reason for the end, the requirement that was missed by most.
"""

import math
import re
from collections.abc import Sequence

import numpy as np

from groundstation.analysis.acceptance import went_all_the_way
from groundstation.analysis.numbers import with_unit
from groundstation.analysis.results import Cause, Check, Result
from groundstation.analysis.series import Series, TimelineEvent
from groundstation.analysis.timeline import ENDED, INJECTED, STOOD_STILL, faults, is_injection
from shoal.messages.messages import Mode

PASSED, FAILED, NOT_JUDGED = "passed", "failed", "not judged"
PERSON = "a person"
FAULTS = "faults"  # name of the check by which a run has none
SENT_HOME = "RETURN asked for"
ACTS = {  # the station's lines for what a person does to end a flight (groundstation/station/), and the same in words
    "STOP asked for": "pressed the emergency stop",
    "DISARM asked for": "disarmed the robots",
    "END asked for": "ended the run",
    SENT_HOME: "sent the fleet back to the start",
    "interrupted: Ctrl-C in the terminal": "interrupted the program (Ctrl-C)",
}
GOES_ON = re.compile(r"(RESUME|PATH .*|FORMATION .*) asked for")  # the station's lines for a person who has a fleet fly on
LED = re.compile(r"mission: .*\b(robot \d+): led by a person")  # the station's line for a robot that leaves the formation
DONE = "mission: done"
OVER = ("mission: aborting", "mission: failed")  # the station's lines for the end of a mission that failed
TERMINATED = "interrupted: by another program, or its terminal was closed"  # the station's line when it is told to end
FLIES_ON = "mission: running"  # begins the station's lines for a flight that goes on: nothing has ended with such a reason
STANDING = frozenset(mode.name.lower() for mode in Mode if mode is not Mode.TRACKING)  # modes in which a robot does not go on
BEFORE_S = 0.2  # a fault may be noticed in the cycle before its injection is told
WAKES_S = 1.0  # a process that has stood still notices so long after what happened meanwhile
TITLES = {
    "rms_m": "RMS error, whole run",
    "rms_after_20s_m": "RMS error after 20 s",
    "max_after_20s_m": "largest error after 20 s",
    "rms_yaw_after_20s_rad": "RMS yaw error after 20 s",
}


def title(check: Check) -> str:
    """A requirement in words."""
    return TITLES.get(check.name, check.name)


def missed(check: Check) -> str:
    """A requirement that is not met, in one line."""
    where = f" ({check.where})" if check.where else ""
    limit = "at least" if check.at_least else "at most"
    value, allowed = with_unit(check.value, check.unit), with_unit(check.limit, check.unit)
    if check.failed and value == allowed and check.value is not None:
        value += f" ({with_unit(abs(check.value - check.limit), check.unit)} beyond)"
    return f"{title(check)}{where}: {value}, {limit} {allowed}"


def cause(result: Result, series: Series) -> Cause | None:
    """The cause of a run that did not pass; None if it passed."""
    if result.passed:
        return None
    noticed = result.faults or (() if series.started else faults(series.timeline_events))
    act = _persons_act(series)
    if act is None:
        lasting = [fault for fault in noticed if not _healed(fault, series)]
    else:
        lasting = [fault for fault in noticed if _lasted_until(fault, act, series)]
    if lasting:
        return _fault_as_cause(lasting[0], result, series)
    if act is not None:
        led = LED.match(act.text)
        return _event_cause(act, PERSON, f"led {led[1]} alone" if led else ACTS[act.text], result, series)
    ended = _stations_reason(series)
    if ended is not None:
        return _event_cause(ended, ended.source, ended.text.removeprefix("mission: "), result, series)
    if result.log_trouble:
        return _whole_run_cause(result.log_trouble, result, series)
    if not series.started:
        return _whole_run_cause("no robot was ever under way", result, series)
    unmet = [check for check in result.checks if check.failed and check.name != FAULTS]
    if not unmet:  # nothing but holds that healed
        first = noticed[0]
        return _event_cause(first, first.source, first.text, result, series, _injected_before(first, series))
    return _whole_run_cause(missed(max(unmet, key=_excess)), result, series, "; ".join(_injected(series)))


def verdict(result: Result, series: Series) -> str:
    """PASSED; FAILED; or NOT_JUDGED for a flight that a person ended before its end, and for none."""
    if result.passed:
        return PASSED
    by_person = result.cause is not None and result.cause.noticed_by == PERSON
    nothing = not series.started and not result.faults and not result.log_trouble
    return NOT_JUDGED if by_person or nothing else FAILED


def _event_cause(
    event: TimelineEvent, noticed_by: str, text: str, result: Result, series: Series, injected: str = ""
) -> Cause:
    """An event as the cause, with its time and place."""
    place = _place_text(event, series)
    where = f", {place}" if place else ""
    sentence = (
        f"A person {text} {_when(event, series)}{where}."
        if noticed_by == PERSON
        else f"{noticed_by} {_when(event, series)}{where}: {text}"
    )
    outcome = _flown(series) if noticed_by == PERSON else _outcome(result, series)  # what is not judged, misses nothing
    return Cause(text, event.time_s, noticed_by, injected, outcome, place, sentence)


def _when(event: TimelineEvent, series: Series) -> str:
    """The time of an event: of the flight, or where nothing flew and there is no time 0, since the log began."""
    return f"at {event.time_s:.1f} s" if series.started else f"{event.time_s:.1f} s after the log began"


def _fault_as_cause(fault: TimelineEvent, result: Result, series: Series) -> Cause:
    """A fault as the cause. Where processes had stood still, they are the cause, and the fault is what the others noticed."""
    injected, standstills = _injected_before(fault, series), _standstills_before(fault, series)
    if not standstills:
        return _event_cause(fault, fault.source, fault.text, result, series, injected)
    sources = ", ".join(event.source for event in standstills)
    text = f"{standstills[0].text} ({fault.source}: {fault.text})"
    return _event_cause(standstills[0], sources, text, result, series, injected)


def _whole_run_cause(text: str, result: Result, series: Series, injected: str = "") -> Cause:
    """A cause that only the whole run shows."""
    return Cause(text, None, "the report", injected, _outcome(result, series), "", f"the report: {text}")


def _place_text(event: TimelineEvent, series: Series) -> str:
    """Place of the robot that an event is about; of another event the middle of the fleet. Empty where none is known."""
    own = {f"robot {number}": robot for number, robot in series.robots.items()}
    robots = [own[event.source]] if event.source in own else list(own.values())
    rows = series.time_s <= event.time_s
    places = [robot.truth[rows & np.isfinite(robot.truth[:, :2]).all(axis=1), :2][-1:] for robot in robots]
    last_places = [place[0] for place in places if len(place)]
    if not last_places:
        return ""
    x_m, y_m = np.mean(last_places, axis=0)
    whose = "" if len(robots) == 1 else "the fleet's middle "
    return f"{whose}at x {x_m:.2f}, y {y_m:.2f} m"


def _persons_act(series: Series) -> TimelineEvent | None:
    """The first request by which a person ended the flight. Of a flight that came to its end, the first request by which a
    robot left it; None for a flight that went all its way."""
    if series.started and went_all_the_way(series):
        return None
    begin_s, until_s = (0.0, series.ended_s) if series.started else (-math.inf, math.inf)
    reports = [e for e in series.timeline_events if e.source == "groundstation" and begin_s <= e.time_s <= until_s]
    done_s = next((e.time_s for e in reports if e.text == DONE), math.inf) if series.started else math.inf
    leads = (e for e in reports if LED.match(e.text)) if done_s < math.inf else ()
    acts = (e for e in reports if e.text in ACTS and e.time_s < done_s and not _was_called_off(e, reports, series))
    return next(acts, None) or next(iter(leads), None)


def _was_called_off(act: TimelineEvent, reports: Sequence[TimelineEvent], series: Series) -> bool:
    """True for a return that was not flown to its end, and after which somebody had the fleet fly on."""
    returns = act.text == SENT_HOME and series.sent_home_s is None
    return returns and any(e.last_s > act.time_s and GOES_ON.fullmatch(e.text) for e in reports)


def _lasted_until(fault: TimelineEvent, act: TimelineEvent, series: Series) -> bool:
    """True for a fault that lasted when a person ended the flight: of a robot's mode, or the end of the mission."""
    over = fault.source == "groundstation" and fault.text.startswith(OVER)
    return (over or _is_about_mode(fault)) and fault.time_s < act.time_s and not _healed(fault, series, act.time_s)


def _standstills_before(fault: TimelineEvent, series: Series) -> list[TimelineEvent]:
    """Processes that stood still when a fault began, or until shortly before: all that others noticed of it is their silence,
    and what they noticed themselves they noticed when they woke."""
    still = (event for event in series.timeline_events if event.text.startswith(STOOD_STILL))
    return [event for event in still if event.time_s - BEFORE_S <= fault.time_s <= event.last_s + WAKES_S]


def _is_about_mode(fault: TimelineEvent) -> bool:
    """True for a fault by which a robot left the mode in which it flies."""
    return fault.source.startswith("robot ") and fault.text.partition(": ")[0] in STANDING


def _healed(fault: TimelineEvent, series: Series, until_s: float = math.inf) -> bool:
    """True if the robot stood with a fault for a while, and had gone on without one by `until_s`."""
    robot = {f"robot {number}": robot for number, robot in series.robots.items()}.get(fault.source)
    if robot is None or not _is_about_mode(fault):
        return False
    states = robot.states
    since = (states.time_s > fault.time_s) & (states.time_s <= min(until_s, series.ended_s))
    faulty_s = states.time_s[since & states.faulty]
    well_s = states.time_s[since & ~states.faulty & (states.mode == Mode.TRACKING)]
    return bool(len(well_s) and well_s[-1] > max(faulty_s, default=fault.time_s))


def _injected_before(fault: TimelineEvent, series: Series) -> str:
    """The latest injection before a fault, with its time."""
    before = _injected(series, fault.time_s + BEFORE_S)
    return before[-1] if before else ""


def _injected(series: Series, until_s: float = math.inf) -> list[str]:
    """Injections of the simulator up to a time, or the flight's end, each with its own time; without those that were over
    before the flight."""
    until_s = min(until_s, series.ended_s) if series.started else until_s
    events = [e for e in series.timeline_events if is_injection(e) and e.time_s <= until_s]

    def was_over(event: TimelineEvent) -> bool:
        over = ENDED + event.text.removeprefix(INJECTED)
        return series.started and any(e.text == over and event.time_s <= e.time_s < 0.0 for e in events)

    injections = [e for e in events if e.text.startswith(INJECTED) and not was_over(e)]
    return [f"{e.text.removeprefix(INJECTED)} {_when(e, series)}" for e in injections]


def _outcome(result: Result, series: Series) -> str:
    """The time flown, and the number of requirements that were not met, in words."""
    unmet = sum(check.failed for check in result.checks)
    return f"{_flown(series)}, {unmet} of {len(result.checks)} requirements not met" if series.started else _flown(series)


def _flown(series: Series) -> str:
    if not series.started:
        return "nothing was flown"
    return f"{min(series.flown_s, series.asked_s):.1f} s of {series.asked_s:g} s flown"  # the last step may lie behind the end


def _stations_reason(series: Series) -> TimelineEvent | None:
    """The station's line that gives a reason for the end of a flight that did not go all the way: that another program ended
    the station, or the first reason since the flight last went on. None without a reason."""
    if not series.started or went_all_the_way(series):
        return None
    reports = [e for e in series.timeline_events if e.source == "groundstation" and 0.0 < e.time_s <= series.ended_s]
    termination = next((e for e in reports if e.text == TERMINATED), None)
    flew = [k for k, e in enumerate(reports) if e.text.startswith(FLIES_ON)]
    since = reports[flew[-1] + 1 :] if flew else reports
    reasons = (e for e in since if e.text.startswith("mission: ") and ": " in e.text.removeprefix("mission: "))
    return termination or next(reasons, None)


def _excess(check: Check) -> float:
    """Ratio by which a requirement is missed (1: just met); infinite where the figure is missing."""
    if check.value is None:
        return math.inf
    larger, smaller = (check.limit, check.value) if check.at_least else (check.value, check.limit)
    return larger / smaller if smaller > 0.0 else math.inf

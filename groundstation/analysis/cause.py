"""The cause of a run that failed: the first fault, else the order that ended it, else the requirement missed by most. Pure."""

import math

from groundstation.analysis.acceptance import went_all_the_way
from groundstation.analysis.numbers import with_unit
from groundstation.analysis.results import Cause, Check, Result
from groundstation.analysis.series import Series, TimelineEvent
from groundstation.analysis.timeline import INJECTED, faults, is_injection

BEFORE_S = 0.2  # a fault may be noticed in the cycle before its injection is told
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
    return f"{title(check)}{where}: {with_unit(check.value, check.unit)}, {limit} {with_unit(check.limit, check.unit)}"


def cause(result: Result, series: Series) -> Cause | None:
    """The cause of a failure; None if the run passed."""
    if result.passed:
        return None
    noticed = result.faults or (() if series.started else faults(series.timeline_events))
    if noticed:
        first = noticed[0]
        return Cause(first.text, first.time_s, first.source, _injected_before(first, series), _outcome(result, series))
    ended = _ended_by(series)
    if ended is not None:
        return Cause(ended.text.removeprefix("mission: "), ended.time_s, ended.source, "", _outcome(result, series))
    if result.log_trouble:
        return Cause(result.log_trouble, None, "the report", "", _outcome(result, series))
    if not series.started:
        return Cause("no robot was ever under way", None, "the report", "", _outcome(result, series))
    worst = max((check for check in result.checks if not check.passed), key=_excess)
    return Cause(missed(worst), None, "the report", "; ".join(_injected(series)), _outcome(result, series))


def _injected_before(fault: TimelineEvent, series: Series) -> str:
    """The latest injection before a fault, with its time."""
    before = _injected(series, fault.time_s + BEFORE_S)
    return before[-1] if before else ""


def _injected(series: Series, until_s: float = math.inf) -> list[str]:
    """Injections of the simulator up to a time, each with its own time."""
    made = [e for e in series.timeline_events if is_injection(e) and e.text.startswith(INJECTED) and e.time_s <= until_s]
    return [f"{e.text.removeprefix(INJECTED)} at {e.time_s:.1f} s" for e in made]


def _outcome(result: Result, series: Series) -> str:
    if not series.started:
        return "nothing was flown"
    flown_s = series.flown_s
    unmet = sum(not check.passed for check in result.checks)
    return f"{flown_s:.1f} s of {series.asked_s:g} s flown, {unmet} of {len(result.checks)} requirements not met"


def _ended_by(series: Series) -> TimelineEvent | None:
    """The station's word for the end of a flight that did not go all the way, if it gave a reason."""
    if not series.started or went_all_the_way(series):
        return None
    given = (e for e in series.timeline_events if e.source == "groundstation" and e.text.startswith("mission: "))
    return next((e for e in given if e.time_s > 0.0 and ": " in e.text.removeprefix("mission: ")), None)


def _excess(check: Check) -> float:
    """Ratio by which a requirement is missed; infinite where the figure is missing."""
    if check.value is None:
        return math.inf
    one, other = (check.limit, check.value) if check.at_least else (check.value, check.limit)
    return one / other if other > 0.0 else math.inf

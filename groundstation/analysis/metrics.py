"""From aligned arrays to the figures of a run; acceptance.py says whether they are good enough. Pure."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from groundstation.analysis.acceptance import checks, went_all_the_way
from groundstation.analysis.cause import cause, verdict
from groundstation.analysis.results import (
    Errors,
    FlightPart,
    PairResult,
    Quantiles,
    Result,
    RobotEnd,
    RobotResult,
    Spread,
    Three,
)
from groundstation.analysis.series import (
    CHANNELS,
    HOPS,
    SETTLED_S,
    Flight,
    Mask,
    RobotSeries,
    Series,
    States,
    TimelineEvent,
    active_limits,
)
from groundstation.analysis.timeline import faults, tags
from groundstation.logs.reader import RunLog
from shoal.config.experiment import ArticleRow
from shoal.frames import Array, pose_error, wrap_angle
from shoal.messages import topics
from shoal.messages.messages import LocalizerStatus, Mode, RobotState, StationHeartbeat, Truth

STARTED = "START asked for"  # the station's line (groundstation/station/station.py)
ENDS = tuple(
    f"mission: {words}" for words in ("aborting", "failed", "disarming: a person", "ended by a person", "emergency stop")
)
UNARMED = frozenset({Mode.DISARMED, Mode.STOPPED, Mode.FAULT})


def evaluate(series: Series, log: RunLog) -> Result:
    """The figures of a run. Works for any part of one; what is missing is None and said in `notes`."""
    experiment, each = series.experiment, series.robots.values()
    robots = {
        str(robot): dataclasses.replace(_robot(series, robot), end=_last_state(log, robot)) for robot in experiment.robot_ids
    }
    pairs = {f"{a}-{b}": _pair(series, a, b) for a, b in combinations(experiment.robot_ids, 2)}
    flying = [r.states.tracking & _within(r.states.time_s, series) for r in each]

    def in_flight(values_of: Callable[[States], Array]) -> Array:
        """A value of the steps in which a robot flies, of all robots one after the other."""
        return np.concatenate([values_of(r.states)[rows] for r, rows in zip(each, flying, strict=True)])

    step_us = in_flight(lambda states: states.timing(lambda t: t.step_us))
    latency_ms = in_flight(lambda states: states.timing(lambda t: t.exposure_to_pwm_ms))
    slack_m = in_flight(lambda states: states.control(lambda c: c.slack_m))
    board_loss = in_flight(lambda states: states.board(lambda b: b.loss))
    located = np.concatenate([r.pose_error[_within(r.pose_time_s, series)] for r in each])
    steps = sum(r.control_steps for r in robots.values())
    missed = sum(r.missed_deadlines for r in robots.values())
    wear = [r.dtau_rms for r in robots.values() if r.dtau_rms is not None]
    settled_wear = [r.dtau_rms_after_20s for r in robots.values() if r.dtau_rms_after_20s is not None]
    result = Result(
        scene=experiment.name,
        seed=experiment.seed,
        mode=log.metadata.get("mode", "unknown"),
        passed=False,
        duration_s=round(series.end_s, 6),
        planned_duration_s=series.planned_s,
        real_time_factor=_real_time_factor(series, log),
        errors_against=series.errors_against,
        robots=robots,
        pairs=pairs,
        min_separation_m=_least(p.min_separation_m for p in pairs.values()),
        control_step_us=_quantiles(step_us[step_us > 0.0]),
        pose_error_m=_spread(np.hypot(located[:, 0], located[:, 1])),
        pose_error_rad=_spread(np.abs(located[:, 2])),
        exposure_to_pwm_ms=_quantiles(latency_ms[np.isfinite(latency_ms)]),
        dtau_rms=tuple(np.max(wear, axis=0).tolist()) if wear else None,
        dtau_rms_after_20s=tuple(np.max(settled_wear, axis=0).tolist()) if settled_wear else None,
        pulse_step_rms_us=max((r.pulse_step_rms_us or 0.0 for r in robots.values()), default=None) if wear else None,
        missed_deadlines=missed,
        missed_deadlines_fraction=missed / steps if steps else None,
        log_complete=log.complete,
        log_dropped=log.dropped,
        experiment_hash=experiment.hash,
        notes=tuple(_notes(series, log)),
        checks=(),
        latency_hops_ms=_hops(each, flying),
        at_limit=_shares_at_limits(series, flying),
        slack_m=_most(slack_m),
        board_loss=_most(board_loss),
        messages_lost={kind: sum(r.lost.get(kind, 0) for r in each) for kind in next(iter(each)).lost},
        cameras_out=_cameras_out(series, log),
        faults=faults([h for h in series.timeline_events if _in_flight(h, series)]),
        asked_s=round(series.asked_s, 6),
        log_trouble=log.trouble,
        version=log.metadata.get("version", "unknown"),
        commit=log.metadata.get("commit", "unknown"),
        tags=tags(series.timeline_events),
        flight=series.flight,
        flights=tuple(_part(flight, series.start_ns) for flight in series.flights),
    )
    judged = tuple(checks(result, series))
    result = dataclasses.replace(result, checks=judged, passed=not any(check.failed for check in judged))
    result = dataclasses.replace(result, cause=cause(result, series))
    return dataclasses.replace(result, verdict=verdict(result, series))


def _in_flight(happening: TimelineEvent, series: Series) -> bool:
    """True if an event belongs to the evaluated flight. What ended a flight early comes after its last step under way;
    what comes after a flight that went to its end is none of its faults."""
    return not series.started or 0.0 <= happening.time_s <= judged_until_s(series)


def judged_until_s(series: Series) -> float:
    """Time up to which faults count: the end of the evaluation, or of the flight if it did not go all the way."""
    return series.end_s if went_all_the_way(series) else series.ended_s


def _part(flight: Flight, start_ns: int) -> FlightPart:
    begin_s, over_s = ((ns - start_ns) * 1e-9 for ns in (flight.begin_ns, flight.over_ns))
    return FlightPart(round(begin_s, 6), round(over_s, 6), round(flight.flown_s, 6), flight.home)


# --- errors


def _cameras_out(series: Series, log: RunLog) -> dict[str, float]:
    """Share of the fused pictures in which each of several cameras gave no poses; empty for a single camera."""
    statuses, end_ns = log.of(topics.LOCALIZER, LocalizerStatus), series.start_ns + series.end_s * 1e9
    messages = [e.message for e in statuses if series.start_ns <= e.stamp_ns <= end_ns]
    return {name: sum(name in m.out for m in messages) / len(messages) for name in series.experiment.camera_names if messages}


def _robot(series: Series, robot: int) -> RobotResult:
    """Errors of one robot in the judged part of the flight; RMS after 20 s are of its settled part."""
    mine = series.robots[robot]
    states = mine.states
    window = _within(states.time_s, series)
    command_rad = states.control(lambda c: c.eta_command)[:, 3]
    tracking = window & states.tracking & np.isfinite(command_rad)
    settled = states.time_s[tracking] >= SETTLED_S
    yaw_error_rad = wrap_angle(mine.truth_at_states[tracking, 3] - command_rad[tracking])
    disturbance_error = states.estimate(lambda e: e.disturbance)[tracking] - mine.disturbance_at_states[tracking]
    wrench_steps = states.control(lambda c: c.wrench_step)[tracking]
    pulses_us = states.of(lambda s: s.pulse_us, CHANNELS)[tracking]
    thruster_pulses_us = pulses_us[:, : series.experiment.vehicle.thruster_count]
    missed = np.diff(states.timing(lambda t: t.missed_deadlines)[window])
    return RobotResult(
        **_fields(_errors(mine.error, series.time_s)),
        rms_yaw_command_rad=_rms(yaw_error_rad),
        rms_yaw_command_after_20s_rad=_rms(yaw_error_rad[settled]),
        dtau_rms=_column_rms(wrench_steps),
        dtau_rms_after_20s=_column_rms(wrench_steps[settled]),
        pulse_step_rms_us=_rms(np.diff(thruster_pulses_us, axis=0)),
        disturbance_error_rms=_column_rms(disturbance_error),
        control_steps=int(window.sum()),
        missed_deadlines=int(missed[missed > 0.0].sum()),  # falls only when a restarted process counts anew
        baseline=_still(mine, mine.reference, series.time_s),
        article=_article(series, str(robot)),
    )


def _last_state(log: RunLog, robot: int) -> RobotEnd:
    """State of a robot at the last message of the log. A robot that is not heard then may have come to rest since, or not."""
    states = log.of(topics.STATE, RobotState, robot)
    truths, beats = log.of(topics.TRUTH, Truth), log.of(topics.HEARTBEAT, StationHeartbeat)
    last_state = states[-1].message if states else None
    last_truth = truths[-1].message if truths else None
    is_out = bool(beats) and robot in beats[-1].message.out
    place = None
    if last_truth is not None and robot in last_truth.robots:
        place = last_truth.eta[last_truth.robots.index(robot)]
    elif last_state is not None and last_state.estimate is not None:
        place = last_state.estimate.eta
    place_m = _three(place) if place is not None else None
    if last_state is None:
        return RobotEnd(place_m=place_m, out_of_water=is_out)
    log_end_ns = max(entries[-1].arrived_ns for entries in (states, truths, beats) if entries)
    heard_s = (log_end_ns - states[-1].arrived_ns) * 1e-9
    is_fresh = heard_s <= topics.STATE.max_age_s
    return RobotEnd(
        mode=last_state.mode.name,
        heard_s=round(heard_s, 6),
        armed=last_state.mode not in UNARMED if is_fresh else None,
        place_m=place_m,
        out_of_water=is_out,
    )


def _pair(series: Series, a: int, b: int) -> PairResult:
    """Errors of a pair of robots against their formation, and their least separation."""
    one, other = series.robots[a], series.robots[b]
    apart = series.separation_m(a, b)
    baseline = None
    if one.still is not None and other.still is not None:
        still = np.tile(one.still - other.still, (len(series.time_s), 1))
        baseline = _without_yaw(_errors(pose_error(still, one.reference - other.reference), series.time_s))
    return PairResult(
        **_fields(_errors(series.pair_error(a, b), series.time_s)),
        min_separation_m=float(np.nanmin(apart)) if np.isfinite(apart).any() else None,
        baseline=baseline,
        article=_article(series, f"{a}-{b}"),
    )


def _still(robot: RobotSeries, reference: Array, time_s: Array) -> Errors | None:
    if robot.still is None or len(time_s) == 0:
        return None
    return _without_yaw(_errors(pose_error(np.tile(robot.still, (len(time_s), 1)), reference), time_s))


def _without_yaw(errors: Errors) -> Errors:
    """A robot that does not move has no heading to speak of."""
    return dataclasses.replace(errors, rms_yaw_rad=None, rms_yaw_after_20s_rad=None)


def _errors(error: Array, time_s: Array) -> Errors:
    """Statistics of an error (n, 4) at n instants; rows with NaN do not count."""
    is_known = np.isfinite(error).all(axis=1)
    whole, settled = error[is_known], error[is_known & (time_s >= SETTLED_S)]
    return Errors(
        rms_m=_axes(whole, _root_mean_square),
        rms_yaw_rad=_rms(whole[:, 3]),
        rms_after_20s_m=_axes(settled, _root_mean_square),
        rms_yaw_after_20s_rad=_rms(settled[:, 3]),
        max_m=_axes(whole, _largest),
        max_after_20s_m=_axes(settled, _largest),
    )


# --- the controller's limits, and its links


def _hops(robots: Iterable[RobotSeries], flying: Sequence[Mask]) -> dict[str, Quantiles | None]:
    """Quantiles of the delay of each hop from picture to pulses, over all robots' steps whose hops are all known."""
    hops = np.concatenate([r.states.hops_ms[rows] for r, rows in zip(robots, flying, strict=True)])
    complete = hops[np.isfinite(hops).all(axis=1)]
    return {name: _quantiles(complete[:, k]) for k, name in enumerate(HOPS)} if len(complete) else {}


def _shares_at_limits(series: Series, flying: Sequence[Mask]) -> dict[str, float]:
    """For each limit of the controller the share of steps at it, of the robot with the largest share."""
    largest: dict[str, float] = {}
    for robot, rows in zip(series.robots.values(), flying, strict=True):
        if not rows.any():
            continue
        for name, is_active in active_limits(series, robot).items():
            share = float(is_active[rows].mean())
            largest[name] = max(share, largest.get(name, 0.0))
    return largest


def _most(values: Array) -> float | None:
    known_values = values[np.isfinite(values)]
    return float(known_values.max()) if known_values.size else None


# --- statistics; None for no values


def _within(time_s: Array, series: Series) -> Mask:
    return np.asarray((time_s >= 0.0) & (time_s <= series.end_s))


def _root_mean_square(values: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def _largest(values: Array) -> Array:
    return np.asarray(np.max(np.abs(values), axis=0))


def _axes(error: Array, measure: Callable[[Array], Array]) -> Three | None:
    return _three(measure(error[:, :3])) if len(error) else None


def _three(values: Array) -> Three:
    return float(values[0]), float(values[1]), float(values[2])


def _rms(values: Array) -> float | None:
    numbers = values[np.isfinite(values)]
    return float(_root_mean_square(numbers)) if numbers.size else None


def _column_rms(values: Array) -> tuple[float, ...] | None:
    rows = values[np.isfinite(values).all(axis=1)]
    return tuple(float(v) for v in _root_mean_square(rows)) if len(rows) else None


def _quantiles(values: Array) -> Quantiles | None:
    if values.size == 0:
        return None
    p50, p99 = np.percentile(values, [50.0, 99.0])
    return Quantiles(float(p50), float(p99), float(values.max()), values.size)


def _spread(values: Array) -> Spread | None:
    numbers = values[np.isfinite(values)]
    return Spread(float(_root_mean_square(numbers)), float(numbers.max())) if numbers.size else None


def _fields(errors: Errors) -> dict[str, Any]:
    return {field.name: getattr(errors, field.name) for field in dataclasses.fields(Errors)}


def _article(series: Series, subject: str) -> ArticleRow | None:
    """The article's errors of a robot or a pair; None for a flight on another path, or in another form, than the article's."""
    rows = () if series.other_path else series.experiment.article
    return next((row for row in rows if row.subject == subject), None)


def _real_time_factor(series: Series, log: RunLog) -> float | None:
    """Run time over wall-clock time, between the flushes of the log that lie in the run."""
    first_ns, last_ns = series.start_ns, series.start_ns + series.end_s * 1e9
    inside = [(stamp_ns, wall_ns) for stamp_ns, wall_ns in log.pace if first_ns <= stamp_ns <= last_ns]
    if len(inside) < 2 or inside[-1][1] <= inside[0][1]:
        return None
    return (inside[-1][0] - inside[0][0]) / (inside[-1][1] - inside[0][1])


# --- words


def _notes(series: Series, log: RunLog) -> Iterator[str]:
    """Notes to read before the figures; trouble with the log comes first."""
    if log.trouble:
        yield log.trouble
    yield from _flight_notes(series)
    if series.started and series.errors_against is None:
        yield "Neither truth nor poses were recorded: there are no errors."
    if series.errors_against == "localizer":
        yield "No truth was recorded: errors are against the localizer's poses, and cannot show the localizer's own."
    absent = [str(robot) for robot, r in series.robots.items() if not r.states.tracking.any()]
    if series.started and absent:
        yield f"Never under way: robot {', '.join(absent)}."
    if series.cut_short:
        yield f"Only {series.end_s:.0f} s are evaluated: by its stamps the flight lasts longer than it can; a clock leaps."
    if log.undecodable:
        yield f"{log.undecodable} recorded messages could not be decoded: they are damaged, or of another version."


def _flight_notes(series: Series) -> Iterator[str]:
    """Sentences about a flight that is incomplete, or not the only one of its log."""
    planned_s = series.planned_s
    if len(series.flights) > 1:
        yield (
            f"The log holds {len(series.flights)} flights. This is a report of number {series.flight} alone; "
            "`groundstation log report RUN --flight N` makes one of another."
        )
    if in_vain := _failed_start_note(series):
        yield in_vain
    if not series.started:
        yield "No robot was ever under way on its trajectory: there is nothing to evaluate."
    elif series.sent_home_s is not None and not went_all_the_way(series):
        yield f"The run is not complete: the fleet was sent home after {series.sent_home_s:.1f} s of {planned_s:g} s."
    elif not went_all_the_way(series):
        yield f"The run is not complete: {series.flown_s:.1f} s of {series.asked_s:g} s were flown by the slowest robot."
    elif series.asked_s < planned_s - series.experiment.controller.period_s:
        yield f"The path was over after {series.asked_s:.1f} s, before the {planned_s:g} s of the experiment."


def _failed_start_note(series: Series) -> str:
    """Sentence about a request to start after the last flight that started no flight; empty if there was none."""
    over_s = max(((flight.over_ns - series.start_ns) * 1e-9 for flight in series.flights), default=math.inf)
    reports = [e for e in series.timeline_events if e.source == "groundstation" and e.last_s > over_s]
    at_s = max((e.last_s for e in reports if e.text == STARTED), default=None)
    if at_s is None:
        return ""
    ends = [e for e in reports if e.last_s >= at_s and e.text.startswith(ENDS)]  # one that repeats began before, perhaps
    why = min(ends, key=lambda e: e.last_s).text.removeprefix("mission: ") if ends else ""
    return f"At {at_s:.1f} s, after this, another start was asked for, and nobody flew{f': {why}' if why else ''}."


def _least(values: Iterable[float | None]) -> float | None:
    return min((value for value in values if value is not None), default=None)

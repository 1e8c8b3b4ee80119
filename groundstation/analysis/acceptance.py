"""Acceptance of a run: its figures against the limits of every run and of its experiment. Pure."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations

import numpy as np

from groundstation.analysis.comparison import settled
from groundstation.analysis.results import WHOLE_RUN, Check, Errors, Result
from groundstation.analysis.series import Series
from shoal.config.vehicle import AXES as WRENCH_AXES

MISSED_FRACTION = 0.001  # of all control steps; more is a run that did not keep time
KNOWN_SHARE = 0.9  # of the flight in which distances and errors must be known: what nobody saw has not been good
AXES = ("x", "y", "z")
CLEARANCE = "clearance of hulls"  # name of a check


def went_all_the_way(series: Series) -> bool:
    """True if the slowest robot reached the end of the planned flight, to within two control periods, and the evaluation with
    it. A fleet that turned home before has not."""
    spare_s = 2.0 * series.experiment.controller.period_s
    turned = series.sent_home_s is not None and series.sent_home_s < series.planned_s - spare_s
    return series.started and not turned and series.flown_s >= series.asked_s - spare_s


def checks(result: Result, series: Series) -> Iterator[Check]:
    """Requirements of every run, and the experiment's limits."""
    errors: dict[str, Errors] = {**{f"robot {k}": r for k, r in result.robots.items()}, **result.pairs}
    yield from _run_checks(result, series)
    yield from _error_checks(errors, series)
    yield from _end_check(series)
    yield from _mean_checks(result, series)


def _run_checks(result: Result, series: Series) -> Iterator[Check]:
    """Checks that every run has to pass: a whole log, a whole flight, no faults, timely steps, distance, no contact."""
    experiment = series.experiment
    missing = float(result.log_dropped) if result.log_complete else None
    yield Check("messages missing from the log", result.log_trouble.partition(":")[0], missing, 0.0, not result.log_trouble)
    whole = went_all_the_way(series)
    out = ", ".join(map(str, sorted(series.out_of_water)))
    slowest = f"robot {out} out of the water" if out else "slowest robot"
    yield Check(WHOLE_RUN, slowest, series.flown_s, series.asked_s, whole, "s", at_least=True)
    yield Check("faults", "", float(len(result.faults)), 0.0, not result.faults)
    fraction = result.missed_deadlines_fraction
    yield _at_most("missed deadlines", "all robots", fraction, MISSED_FRACTION, "fraction")
    closest, allowed = result.min_separation_m, 2.0 * experiment.safety.radius_m
    if result.pairs:
        closest_pair = next(pair for pair, figures in result.pairs.items() if figures.min_separation_m == closest)
        pairs = combinations(series.robots, 2)
        blind = _unknown({f"pair {a}-{b}": series.known_share(series.separation_m(a, b)) for a, b in pairs})
        passed = closest is not None and closest >= allowed and not blind
        yield Check("separation", blind or f"pair {closest_pair}", closest, allowed, passed, "m", at_least=True)
    yield from _contact_check(series)


def _contact_check(series: Series) -> Iterator[Check]:
    """Check that no hull touched a wall, the floor or an island. Against the truth alone: a localizer's poses are some
    centimetres off, and a robot in a real pool may lie at its wall."""
    if series.errors_against != "truth":
        return
    clear_m = {r: series.experiment.clearance_m(track.truth[:, :3]) for r, track in series.robots.items()}
    least_m = {r: float(np.nanmin(m)) for r, m in clear_m.items() if np.isfinite(m).any()}
    if least_m:
        robot = min(least_m, key=lambda r: least_m[r])
        yield Check(CLEARANCE, f"robot {robot}", least_m[robot], 0.0, least_m[robot] >= 0.0, "m", at_least=True)


def _error_checks(errors: dict[str, Errors], series: Series) -> Iterator[Check]:
    """Checks of the worst robot's or pair's errors against the experiment's limits."""
    limits, settles = series.experiment.limits, settled(series.asked_s)
    blind = _unknown({f"robot {robot}": series.known_share(r.error, ~r.led_away) for robot, r in series.robots.items()})
    for name in ("rms_m", "rms_after_20s_m", "max_after_20s_m"):
        limit = getattr(limits, name)
        if limit is not None and not settles and name != "rms_m":
            yield _too_short(name, limit, "m")
        elif limit is not None:
            where, value = _worst_cell(errors, name)
            yield _at_most(name, blind or where, value, limit, "m", not blind)
    if limits.rms_yaw_after_20s_rad is not None and not settles:
        yield _too_short("rms_yaw_after_20s_rad", limits.rms_yaw_after_20s_rad, "rad")
    elif limits.rms_yaw_after_20s_rad is not None:
        turned = {subject: figures.rms_yaw_after_20s_rad for subject, figures in errors.items()}
        by_subject = {subject: value for subject, value in turned.items() if value is not None}
        where = max(by_subject, key=lambda subject: by_subject[subject]) if len(by_subject) == len(turned) else ""
        yield _at_most(
            "rms_yaw_after_20s_rad", blind or where, by_subject.get(where), limits.rms_yaw_after_20s_rad, "rad", not blind
        )


def _end_check(series: Series) -> Iterator[Check]:
    """The check of the distance from each robot's place at the end of its trajectory, if the experiment limits it."""
    limits, name = series.experiment.limits, "from its place at the end"
    if limits.arrived_m is None:
        return
    last_errors = {robot: r.error[-1, :2] for robot, r in series.robots.items() if went_all_the_way(series)}
    away_m = {robot: float(np.hypot(*error)) for robot, error in last_errors.items()}
    if not away_m or not np.isfinite(list(away_m.values())).all():
        yield _at_most(name, "the end was not reached", None, limits.arrived_m, "m")
        return
    farthest = max(away_m, key=lambda robot: away_m[robot])
    yield _at_most(name, f"robot {farthest}", away_m[farthest], limits.arrived_m, "m")


def _mean_checks(result: Result, series: Series) -> Iterator[Check]:
    """Checks of mean figures: pose errors, thruster wear, latency of the pulses."""
    experiment, limits = series.experiment, series.experiment.limits
    if limits.pose_rms_m is not None:
        rms = result.pose_error_m.rms if result.pose_error_m else None
        yield _at_most("pose error, RMS", "all robots", rms, limits.pose_rms_m, "m")
    if limits.wrench_step_rms is not None and not settled(series.asked_s):
        yield _too_short("input steps after 20 s, RMS of the bound", limits.wrench_step_rms, "fraction")
    elif limits.wrench_step_rms is not None:
        share = _shares(result.dtau_rms_after_20s, experiment.wrench_step)
        where = WRENCH_AXES[int(np.argmax(share))] if share else ""
        most = max(share, default=None)
        yield _at_most("input steps after 20 s, RMS of the bound", where, most, limits.wrench_step_rms, "fraction")
    if limits.exposure_to_pwm_p99_ms is not None and result.mode != "numeric":  # where nothing is exposed, nor sent
        late = result.exposure_to_pwm_ms.p99 if result.exposure_to_pwm_ms else None
        yield _at_most("exposure to PWM, p99", "all robots", late, limits.exposure_to_pwm_p99_ms, "ms")


def _at_most(name: str, where: str, value: float | None, limit: float, unit: str, is_whole: bool = True) -> Check:
    """A figure that is missing, or not that of the whole flight (`is_whole`), has not been shown to be good."""
    return Check(name, where, value, limit, value is not None and value <= limit and is_whole, unit)


def _unknown(shares: Mapping[str, float]) -> str:
    """The subject that is known for the least share of the flight, if that is too little; else empty."""
    least = min(shares, key=lambda subject: shares[subject], default="")
    return f"{least}: known for {shares[least]:.0%} of the flight" if least and shares[least] < KNOWN_SHARE else ""


def _too_short(name: str, limit: float, unit: str) -> Check:
    """A limit for a part that the flight was not asked to have."""
    return Check(name, "the flight is too short", None, limit, None, unit)


def _worst_cell(errors: dict[str, Errors], name: str) -> tuple[str, float | None]:
    """The largest value of a figure over subjects and axes, and where it is; None if a subject has no such figure."""
    cells = {
        f"{subject}, {axis}": value
        for subject, figures in errors.items()
        for axis, value in zip(AXES, getattr(figures, name) or (), strict=False)
    }
    if not cells or any(getattr(figures, name) is None for figures in errors.values()):
        return "", None
    worst = max(cells, key=lambda cell: cells[cell])
    return worst, cells[worst]


def _shares(values: Sequence[float] | None, bounds: Sequence[float]) -> list[float]:
    return [value / bound for value, bound in zip(values or (), bounds, strict=False)]

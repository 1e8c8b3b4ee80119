"""Runs side by side: their figures, their errors over time, and in what their experiments differ. Pure.

runs = [ComparedRun(name, series, result, experiment), ...]
metric_rows(runs), differences(runs), plots(runs)
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from groundstation.analysis.numbers import SHOWN_AS
from groundstation.analysis.results import Errors, Result
from groundstation.analysis.series import SETTLED_S, Series
from groundstation.analysis.statistics import three
from groundstation.palette import colour
from groundstation.report.drawing import Curve, Panel, TimePlot
from shoal.config.experiment import Experiment

FLOWN_BY = ("(mode)", "(version)", "(commit)")  # no keys of an experiment, which have no brackets


@dataclass(frozen=True, eq=False)
class ComparedRun:
    name: str
    series: Series
    result: Result

    @property
    def experiment(self) -> Experiment:
        return self.series.experiment


@dataclass(frozen=True)
class MetricRow:
    """A figure of all runs; None where a run has none."""

    name: str
    unit: str
    values: tuple[float | None, ...]

    @property
    def cells(self) -> list[str]:
        """The values as text; numbers of things as they are."""
        return [three(value) if self.unit or value is None else f"{value:g}" for value in self.values]


def metric_rows(runs: Sequence[ComparedRun]) -> list[MetricRow]:
    """Figures by which runs are compared. An error is that of the worst robot or pair, on its worst axis."""
    rows: list[tuple[str, str, Callable[[Result], float | None]]] = [
        ("tracking, RMS after 20 s", "m", lambda r: _worst(r.robots.values(), "rms_after_20s_m")),
        ("tracking, RMS of the whole run", "m", lambda r: _worst(r.robots.values(), "rms_m")),
        ("tracking, largest after 20 s", "m", lambda r: _worst(r.robots.values(), "max_after_20s_m")),
        ("formation, RMS after 20 s", "m", lambda r: _worst(r.pairs.values(), "rms_after_20s_m")),
        ("formation, RMS of the whole run", "m", lambda r: _worst(r.pairs.values(), "rms_m")),
        ("least separation of centres", "m", lambda r: r.min_separation_m),
        ("surge change per step, RMS after 20 s", "N", lambda r: r.dtau_rms_after_20s[0] if r.dtau_rms_after_20s else None),
        ("yaw change per step, RMS after 20 s", "N m", lambda r: r.dtau_rms_after_20s[2] if r.dtau_rms_after_20s else None),
        ("localizer, RMS", "m", lambda r: r.pose_error_m.rms if r.pose_error_m else None),
        ("control step, median", "µs", lambda r: r.control_step_us.p50 if r.control_step_us else None),
        ("control step, 99 %", "µs", lambda r: r.control_step_us.p99 if r.control_step_us else None),
        ("exposure to PWM, 99 %", "ms", lambda r: r.exposure_to_pwm_ms.p99 if r.exposure_to_pwm_ms else None),
        ("missed deadlines", "", lambda r: float(r.missed_deadlines)),
        ("faults", "", lambda r: float(len(r.faults))),
    ]
    metrics = []
    for name, unit, figure in rows:
        shown_unit, factor = SHOWN_AS.get(unit, (unit, 1.0))
        values = [figure(run.result) for run in runs]
        metrics.append(MetricRow(name, shown_unit, tuple(None if value is None else factor * value for value in values)))
    return metrics


def _worst(errors: Sequence[Errors] | Any, key: str) -> float | None:
    """The worst figure, None where one of them has none: a robot that never flew is not better than the others."""
    worst_values = [max(values) for error in errors if (values := getattr(error, key)) is not None]
    return max(worst_values) if worst_values and len(worst_values) == len(errors) else None


def differences(runs: Sequence[ComparedRun]) -> list[tuple[str, tuple[str, ...]]]:
    """Keys of the experiments whose values are not the same in all runs, and the values as text; before them how the runs were
    flown, and by which code."""
    tables = [_flown_by(run) | _flat(run.experiment.model_dump(mode="json", exclude_none=True)) for run in runs]
    keys = [*FLOWN_BY, *sorted(set().union(*tables) - set(FLOWN_BY))]
    return [(key, values) for key in keys if len(set(values := tuple(str(table.get(key, "–")) for table in tables))) > 1]


def _flown_by(run: ComparedRun) -> dict[str, str]:
    return dict(zip(FLOWN_BY, (run.result.mode_text, run.result.version, run.result.commit), strict=True))


def _flat(value: Any, prefix: str = "") -> dict[str, Any]:
    """A nested table as `a.b.0.c` to value; lists of plain values stay whole."""
    if isinstance(value, list) and any(isinstance(entry, dict) for entry in value):
        value = {str(i): entry for i, entry in enumerate(value)}
    if not isinstance(value, dict):
        return {prefix: value}
    parts = (_flat(entry, f"{prefix}.{name}" if prefix else name) for name, entry in value.items())
    return {key: nested for part in parts for key, nested in part.items()}


def plots(runs: Sequence[ComparedRun]) -> list[tuple[str, str, TimePlot]]:
    """Title, caption and plot: errors over time, run over run, of robots and pairs that several runs have."""
    robots = _shared([set(run.series.robots) for run in runs])
    pairs = _shared([set(combinations(run.series.robots, 2)) for run in runs])
    tracking = [Panel(f"robot {r}, error [mm]", _lines(runs, (r,)), least=5.0) for r in robots]
    formation = [Panel(f"{a}–{b}, error [mm]", _lines(runs, (a, b)), least=5.0) for a, b in pairs]
    thrust = [_surge(runs, robot) for robot in robots]
    groups = [
        ("Tracking error", "Distance of each robot from its reference.", tracking),
        ("Formation error", "Length of a pair's distance vector less that of its references.", formation),
        ("Thrust", "Surge asked for.", thrust),
    ]
    entries = [(title, caption, TimePlot(panels, mark_s=SETTLED_S)) for title, caption, panels in groups]
    return [entry for entry in entries if not entry[2].is_empty]


def _shared(name_sets: Sequence[set[Any]]) -> list[Any]:
    """Names that at least two of them have."""
    every = sorted(set().union(*name_sets))
    return [entry for entry in every if sum(entry in one for one in name_sets) > 1]


def _lines(runs: Sequence[ComparedRun], whose: tuple[int, ...]) -> list[Curve]:
    """The tracking error of a robot or the formation error of a pair, its length over time, in each run that has it."""
    lines = []
    for i, run in enumerate(runs):
        if set(whose) <= set(run.series.robots):
            error = run.series.robots[whose[0]].error if len(whose) == 1 else run.series.pair_error(whose[0], whose[1])
            lines.append(Curve(run.name, run.series.time_s, 1e3 * np.linalg.norm(error[:, :3], axis=1), colour(i)))
    return lines


def _surge(runs: Sequence[ComparedRun], robot: int) -> Panel:
    """The surge force of one robot over time, a curve for each run that has the robot."""
    states_of_runs = [(i, run, run.series.robots[robot].states) for i, run in enumerate(runs) if robot in run.series.robots]
    surge_of_runs = [(i, run, states, states.control(lambda c: c.wrench)[:, 0]) for i, run, states in states_of_runs]
    lines = [Curve(run.name, states.time_s, surge, colour(i)) for i, run, states, surge in surge_of_runs]
    return Panel(f"robot {robot}, surge [N]", lines, least=0.1)

"""Measures of a flight that a campaign keeps, one number each, read off the judged run. Pure."""

from collections.abc import Callable
from typing import Any

import numpy as np

from groundstation.analysis.acceptance import CLEARANCE, went_all_the_way
from groundstation.analysis.metrics import judged_until_s
from groundstation.analysis.results import Result
from groundstation.analysis.series import Series
from groundstation.logs.reader import RunLog
from shoal.messages import topics
from shoal.messages.messages import Mode, RobotState, Solve

# Meaning of each measure, in the order of the report.
MEASURES = {
    "rms_m": "RMS error, worst axis of any robot or pair, whole run [m]",
    "rms_after_20s_m": "the same after 20 s [m]",
    "max_after_20s_m": "largest error after 20 s, any axis of any robot or pair [m]",
    "rms_yaw_after_20s_rad": "RMS heading error to the path's tangent after 20 s, worst robot or pair [rad]",
    "arrived_m": "farthest robot from its reference at the end, horizontally [m]",
    "min_separation_m": "least distance between two centres [m]",
    "min_clearance_m": "least distance of a hull from a wall, the floor or an island; below 0 it touched [m]",
    "wrench_step_rms": "RMS of input changes after 20 s, of the largest allowed, worst axis of any robot",
    "at_fault": "share of control steps in which a robot reported a fault: why it held, stopped or gave up",
    "off_track": "share of control steps in which a robot was not tracking",
    "unsolved": "share of control steps without a fresh solution",
    "step_p50_us": "time of a control step, median of all robots [µs]",
    "step_p99_us": "time of a control step, 99 % of all take less [µs]",
}
TIMINGS = ("step_p50_us", "step_p99_us")  # the machine's: two flights with the same seed have others

# Names of axes and columns.
LABELS = {
    "rms_m": "RMS error",
    "rms_after_20s_m": "RMS error after 20 s",
    "max_after_20s_m": "Largest error after 20 s",
    "rms_yaw_after_20s_rad": "RMS heading error after 20 s",
    "arrived_m": "Distance at the end",
    "min_separation_m": "Least distance of two centres",
    "min_clearance_m": "Least distance of a hull",
    "wrench_step_rms": "RMS input change, of the limit",
    "step_p50_us": "Control step, median",
    "step_p99_us": "Control step, 99 %",
    "at_fault": "Control steps at fault",
    "off_track": "Control steps not tracking",
    "unsolved": "Control steps not solved",
}


def measures(series: Series, log: RunLog, result: Result) -> dict[str, float | None]:
    """Measures of a judged flight; None for those that a short, broken off or single-robot flight cannot give."""
    begin_ns, until_ns = (series.start_ns + round(1e9 * time_s) for time_s in (0.0, judged_until_s(series)))
    states = [
        e.message
        for robot in series.robots
        for e in log.of(topics.STATE, RobotState, robot)
        if series.started and begin_ns <= e.stamp_ns <= until_ns
    ]
    ends = [float(np.hypot(*robot.error[-1, :2])) for robot in series.robots.values() if series.started]
    bound, changes = series.experiment.wrench_step, result.dtau_rms_after_20s
    return {
        "rms_m": _worst(result, "rms_m"),
        "rms_after_20s_m": _worst(result, "rms_after_20s_m"),
        "max_after_20s_m": _worst(result, "max_after_20s_m"),
        "rms_yaw_after_20s_rad": _worst(result, "rms_yaw_after_20s_rad"),
        "arrived_m": max(ends) if went_all_the_way(series) and np.isfinite(ends).all() else None,
        "min_separation_m": result.min_separation_m,
        "min_clearance_m": next((check.value for check in result.checks if check.name == CLEARANCE), None),
        "wrench_step_rms": max(c / b for c, b in zip(changes, bound, strict=False)) if changes else None,
        "at_fault": _share(states, lambda state: bool(state.fault)),
        "off_track": _share(states, lambda state: state.mode is not Mode.TRACKING),
        "unsolved": _share(states, lambda state: state.control is None or state.control.solve is not Solve.SOLVED),
        "step_p50_us": result.control_step_us.p50 if result.control_step_us else None,
        "step_p99_us": result.control_step_us.p99 if result.control_step_us else None,
    }


def reasons(result: Result) -> str:
    """The requirements that a run does not meet, and its faults, each once."""
    return "; ".join(dict.fromkeys([check.name for check in result.checks if check.failed] + [f.text for f in result.faults]))


def _worst(result: Result, name: str) -> float | None:
    """The largest value of an error over all robots, pairs and axes; None if one of them has none."""
    values: list[Any] = [getattr(row, name) for row in result.rows.values()]
    return None if any(value is None for value in values) else float(np.max(values))


def _share(states: list[RobotState], holds: Callable[[RobotState], bool]) -> float | None:
    return sum(map(holds, states)) / len(states) if states else None

"""Metrics of a flight: those that a campaign keeps, with the limits, and those of a comparison. Pure."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from groundstation.analysis.comparison import SETTLED_S, FlightMetrics, Traces, settled
from shoal.config.experiment import Experiment
from shoal.frames import Array, pose_error
from shoal.messages.messages import Mode, RobotState, Solve
from sim_bridge.in_process.fleet import AgentFleet

ERROR_STRIDE = 10  # of control steps, in what is kept to look at

SHOWN_S = 20.0  # of the inputs

# Meaning of each metric, in the order of the report.
MEASURES = {
    "rms_m": "RMS error, worst axis of any robot or pair, whole run [m]",
    "rms_after_20s_m": "the same after 20 s [m]",
    "max_after_20s_m": "largest error after 20 s, any axis of any robot or pair [m]",
    "rms_yaw_after_20s_rad": "RMS heading error to the path's tangent after 20 s, worst robot or pair [rad]",
    "arrived_m": "farthest robot from its reference at the end, horizontally [m]",
    "min_separation_m": "least distance between two centres [m]",
    "wrench_step_rms": "RMS of input changes after 20 s, of the largest allowed, worst axis of any robot",
    "at_fault": "share of control steps in which a robot told of a fault: why it held, stopped or gave up",
    "off_track": "share of control steps in which a robot was not tracking",
    "unsolved": "share of control steps without a fresh solution",
}


def measures(fleet: AgentFleet) -> dict[str, float | None]:
    """Metrics of a fleet that has flown numerically."""
    error = fleet.errors()
    place = np.array(fleet.truth[-len(error) :])[..., :3]
    return figures(fleet.experiment, error, place, [robot.states[-len(error) :] for robot in fleet.robots])


def figures(
    experiment: Experiment, error: Array, place: Array, states: Sequence[Sequence[RobotState]]
) -> dict[str, float | None]:
    """Metrics of a flight against the plant's truth; None for those that a short or single-robot flight cannot give.

    One row per control step: `error` (steps, n, 4), `place` (steps, n, 3); `states` per robot and step.
    """
    n = len(states)
    subjects = [error[:, i] for i in range(n)] + [pose_error(error[:, i], error[:, j]) for i, j in combinations(range(n), 2)]
    late = [e[round(SETTLED_S / experiment.controller.period_s) :] for e in subjects]
    has_late = len(late[0]) > 1
    apart = [np.linalg.norm(place[:, i] - place[:, j], axis=1).min() for i, j in combinations(range(n), 2)]
    change = (
        np.array([[s.wrench_step for s in robot[-len(late[0]) :]] for robot in states]) if has_late else np.zeros((n, 1, 3))
    )
    smooth = np.sqrt(np.mean(change**2, axis=1)) / experiment.wrench_step
    flat = [s for robot in states for s in robot]
    found = {
        "rms_m": _rms(subjects)[:, :3].max(),
        "rms_after_20s_m": _rms(late)[:, :3].max() if has_late else None,
        "max_after_20s_m": max(np.abs(e[:, :3]).max() for e in late) if has_late else None,
        "rms_yaw_after_20s_rad": _rms(late)[:, 3].max() if has_late else None,
        "arrived_m": np.hypot(error[-1, :, 0], error[-1, :, 1]).max(),
        "min_separation_m": min(apart) if apart else None,
        "wrench_step_rms": smooth.max() if has_late else None,
        "at_fault": np.mean([bool(s.fault) for s in flat]),
        "off_track": np.mean([s.mode is not Mode.TRACKING for s in flat]),
        "unsolved": np.mean([s.solve is not Solve.SOLVED for s in flat]),
    }
    return {key: None if value is None else float(value) for key, value in found.items()}


def broken_limits(experiment: Experiment, found: dict[str, float | None]) -> list[str]:
    """Names of the limits that do not hold: the experiment's, and those of every run, that centres stay twice
    safety.radius_m apart and that no robot reports a fault. Limits after 20 s do not apply to a shorter flight. A
    figure that is None or NaN breaks its limit."""
    later = ("rms_after_20s_m", "rms_yaw_after_20s_rad", "max_after_20s_m", "wrench_step_rms")
    broken = []
    for name in ("rms_m", "arrived_m", *(later if settled(experiment.duration_s) else ())):
        limit, value = getattr(experiment.limits, name), found[name]
        if limit is not None and (value is None or not value <= limit):
            broken.append(name)
    apart_m, at_fault = found.get("min_separation_m"), found.get("at_fault")
    if apart_m is not None and not apart_m >= 2.0 * experiment.safety.radius_m:
        broken.append("min_separation_m")
    if at_fault is not None and not at_fault <= 0.0:
        broken.append("at_fault")
    return broken


def _rms(errors: list[Array]) -> Array:
    """RMS (subjects, 4) of errors (steps, 4)."""
    return np.array([np.sqrt(np.mean(e**2, axis=0)) for e in errors])


def flight_figures(experiment: Experiment, states: list[list[RobotState]], truth: Array, error: Array) -> FlightMetrics:
    """A comparison's figures of a flight. `truth` and `error` (steps, n, 4); `states` per robot and step."""
    limits, settled = experiment.vehicle.limits, round(SETTLED_S / experiment.controller.period_s)
    distance = np.linalg.norm(error[:, :, :3], axis=2)
    formation, separation = _pairs(truth, error)
    wanted = _rows(states, "wrench_wanted") / np.array(limits.wrench)
    quick = np.diff(wanted, axis=1) * np.array(limits.wrench) / experiment.wrench_step
    large = (np.abs(wanted) > 1.0 + 1e-9).any(axis=2)[:, 1:]
    fast = (np.abs(quick) > 1.0 + 1e-9).any(axis=2)
    steps = _rows(states, "wrench_step") / experiment.wrench_step
    return FlightMetrics(
        rms_m=_rms_all(distance),
        rms_after_20s_m=_rms_all(distance[settled:]),
        max_after_20s_m=float(distance[settled:].max()),
        rms_yaw_rad=_rms_all(error[:, :, 3]),
        rms_yaw_after_20s_rad=_rms_all(error[settled:, :, 3]),
        formation_rms_m=_rms_all(formation),
        formation_after_20s_m=_rms_all(formation[settled:]),
        min_separation_m=separation,
        input_step_rms=float(np.sqrt(np.mean(steps**2, axis=1)).max()),
        wanted_too_large=float(large.mean()),
        wanted_too_fast=float(fast.mean()),
        wanted_beyond=float((large | fast).mean()),
        wanted_most=float(np.abs(wanted).max()),
        under_way=float(np.mean([[state.mode is Mode.TRACKING for state in each] for each in states])),
    )


def _pairs(truth: Array, error: Array) -> tuple[Array, float | None]:
    """Formation errors (steps, pairs) in m, and the least distance of two robots."""
    pairs = list(combinations(range(error.shape[1]), 2))
    if not pairs:
        return np.zeros((len(error), 1)), None
    apart = [np.linalg.norm(pose_error(error[:, a], error[:, b])[:, :3], axis=1) for a, b in pairs]
    return np.array(apart).T, min(float(np.linalg.norm((truth[:, a] - truth[:, b])[:, :3], axis=1).min()) for a, b in pairs)


def flight_traces(period_s: float, states: list[list[RobotState]], error: Array) -> Traces:
    """Error and inputs over time, for a comparison's plots."""
    shown = round(SHOWN_S / period_s)
    root = np.sqrt(np.mean(np.sum(error[::ERROR_STRIDE, :, :3] ** 2, axis=2), axis=1))
    return Traces(
        error_period_s=round(ERROR_STRIDE * period_s, 9),
        error_m=[round(value, 6) for value in root.tolist()],
        input_period_s=round(period_s, 9),
        wanted_n=np.round(_rows(states, "wrench_wanted")[:, :shown, 0], 4).tolist(),
        applied_n=np.round(_rows(states, "wrench")[:, :shown, 0], 4).tolist(),
    )


def _rows(states: list[list[RobotState]], key: str) -> Array:
    """A field of all states, (n, steps, 3)."""
    return np.array([[getattr(state, key) for state in each] for each in states])


def _rms_all(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))

"""What a campaign keeps of a numeric flight: a handful of numbers, and whether the limits held. Pure."""

from itertools import combinations

import numpy as np

from sim_bridge.in_process.fleet import AgentFleet
from wire.config.controller_benchmark import SETTLED_S, settled
from wire.config.experiment import Experiment
from wire.frames import Array, pose_error
from wire.messages.messages import Mode, Solve

# What each number is, in the order in which it is reported.
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
    """Of a fleet that has flown, against the plant's truth; None for what so short or lonely a flight cannot tell."""
    error = fleet.errors()
    states = [robot.states[-len(error) :] for robot in fleet.robots]
    n = len(states)
    subjects = [error[:, i] for i in range(n)] + [pose_error(error[:, i], error[:, j]) for i, j in combinations(range(n), 2)]
    late = [e[round(SETTLED_S / fleet.experiment.controller.period_s) :] for e in subjects]
    has_late = len(late[0]) > 1
    place = np.array(fleet.truth[-len(error) :])[..., :3]
    apart = [np.linalg.norm(place[:, i] - place[:, j], axis=1).min() for i, j in combinations(range(n), 2)]
    change = (
        np.array([[s.wrench_step for s in robot[-len(late[0]) :]] for robot in states]) if has_late else np.zeros((n, 1, 3))
    )
    smooth = np.sqrt(np.mean(change**2, axis=1)) / fleet.experiment.wrench_step
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
    """Names of the limits that do not hold: the experiment's, and as in a run's report those of every run, that centres stay
    twice safety.radius_m apart and that no robot tells of a fault. What comes after 20 s is not asked of a shorter flight. A
    figure that is no number has not been shown to be good."""
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
    """(subjects, 4) of errors (steps, 4)."""
    return np.array([np.sqrt(np.mean(e**2, axis=0)) for e in errors])

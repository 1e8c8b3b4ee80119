"""SHELL: one flight of a campaign with the camera in the loop: a lockstep run in one process, judged by the station's report.

The log is in a temporary folder, without previews and video; it is read by the report's own evaluation, so that a row says
what the report of the same flight says. This module is the only one of the studies that may import the station's code.
"""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from groundstation.report.report import evaluated
from shoal.bus.memory_transport import MemoryHub
from shoal.config.experiment import Experiment
from shoal.messages import topics
from shoal.messages.messages import RobotState
from sim_bridge.in_process.executor import Executor
from sim_bridge.studies.metrics import MEASURES, figures


def fly_with_camera(experiment: Experiment) -> dict[str, Any]:
    """Fly an experiment. Returns its metrics, whether it passed, and why not. Raises ConfigError if the station refuses it,
    Failed if a part of the run has ended."""
    quiet = experiment.model_copy(
        update={
            "localizer": experiment.localizer.model_copy(update={"preview_rate_hz": 0.0}),
            "recording": experiment.recording.model_copy(update={"video": "none"}),
        }
    )
    with tempfile.TemporaryDirectory(prefix="shoal-flight-") as folder:
        Executor(quiet, Path(folder), MemoryHub()).fly()
        series, recorded, result = evaluated(Path(folder))
    broken = [check.name for check in result.checks if check.failed] + [fault.text for fault in result.faults]
    verdict = {"passed": result.passed, "reason": ", ".join(dict.fromkeys(broken))}
    if not series.started:
        return {**dict.fromkeys(MEASURES), **verdict, "reason": verdict["reason"] or "no robot has started"}
    error = np.stack([robot.error for robot in series.robots.values()], axis=1)
    known = np.isfinite(error).all(axis=(1, 2))
    place = np.stack([robot.truth[:, :3] for robot in series.robots.values()], axis=1)
    until_ns = series.start_ns + round(series.end_s * 1e9)
    states = [
        [s.message for s in recorded.of(topics.STATE, RobotState, robot) if series.start_ns <= s.stamp_ns <= until_ns]
        for robot in experiment.robot_ids
    ]
    steps = min(len(each) for each in states)
    return {**figures(experiment, error[known], place[known], [each[-steps:] for each in states]), **verdict}

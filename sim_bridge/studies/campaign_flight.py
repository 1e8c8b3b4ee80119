"""SHELL: one flight of a campaign, in any process on any machine: text in, plain numbers out. The station's judge judges it.

A module of its own, because worker processes import it and nothing of the campaign's reports.
"""

import json
import tempfile
import time
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from groundstation.analysis.alignment import align
from groundstation.analysis.measures import measures, reasons
from groundstation.analysis.metrics import evaluate
from groundstation.analysis.results import Result
from groundstation.analysis.series import Series
from groundstation.logs.reader import RunLog, log_in_memory
from shoal.config.experiment import Experiment
from shoal.config.loader import check
from shoal.errors import ConfigError
from shoal.messages.messages import Trajectory
from shoal.runtime.runtime import Failed
from sim_bridge.in_process.fleet import AgentFleet, DirectPlant, fly
from sim_bridge.in_process.run import plan

PLANS_KEPT = 8  # plans cached per worker, which flies the same few trajectories many times
UNPLANNED = ("sim", "limits", "article", "seed", "name", "title")  # sections that no plan depends on


def fly_one(experiment_json: str) -> dict[str, Any]:
    """Fly an experiment. Returns its row: status flown, refused or failed, the reason, the metrics."""
    begin_s = time.perf_counter()
    experiment = check(Experiment, json.loads(experiment_json), "campaign")
    row: dict[str, Any] = {"status": "flown", "reason": ""}
    try:
        row |= _flown_with_camera(experiment) if experiment.localizer.uses_camera else _flown(experiment)
    except ConfigError as error:  # the experiment's, unless it is the disk's, which may be another the next time
        row |= {"status": "failed" if isinstance(error.__context__, OSError) else "refused", "reason": str(error)}
    except Exception as error:  # one flight's bug must not end the campaign; the row says what it was
        row |= {"status": "failed", "reason": f"{type(error).__name__}: {error}"}
    return {**row, "wall_s": time.perf_counter() - begin_s}


def _flown(experiment: Experiment) -> dict[str, Any]:
    """Fly numerically. The messages are judged in memory."""
    trajectories, starts = _planned(planning_text(experiment))
    water = DirectPlant(experiment, experiment.seed, np.array([starts[robot] for robot in experiment.robot_ids]))
    fleet = AgentFleet(experiment, trajectories, water, experiment.seed, time.thread_time_ns)
    fleet.start()
    log = log_in_memory(fly(fleet, water), {"mode": "numeric"})
    series = align(experiment, log)
    return _row(series, log, evaluate(series, log))


def _flown_with_camera(experiment: Experiment) -> dict[str, Any]:
    """Fly in lockstep in this process, and judge the log as its report does. Raises ConfigError if the station refuses the
    experiment, Failed if a part of the run has ended, or the log has no room or does not hold all of it."""
    from groundstation.logs.recorder import check_room
    from groundstation.report.report import evaluated  # these load every program: not for numeric flights
    from shoal.bus.memory_transport import MemoryHub
    from sim_bridge.in_process.executor import Executor

    quiet = experiment.model_copy(
        update={
            "localizer": experiment.localizer.model_copy(update={"preview_rate_hz": 0.0}),
            "recording": experiment.recording.model_copy(update={"video": "none"}),
        }
    )
    with tempfile.TemporaryDirectory(prefix="shoal-flight-") as folder:
        try:
            check_room(Path(folder), quiet.recording.min_free_gb)
        except ConfigError as error:
            raise Failed(str(error)) from None
        Executor(quiet, Path(folder), MemoryHub()).fly()
        series, log, result = evaluated(Path(folder))
    if log.trouble:  # a full disk, as of several workers: figures of a part are none of a flight
        raise Failed(log.trouble)
    return _row(series, log, result)


def _row(series: Series, log: RunLog, result: Result) -> dict[str, Any]:
    return {**measures(series, log, result), "passed": result.passed, "reason": reasons(result)}


def planning_text(experiment: Experiment) -> str:
    """The experiment in JSON without the parts that no plan depends on: equal for flights that share a plan."""
    neutral = Experiment.model_fields
    changes = {key: neutral[key].default for key in UNPLANNED if key not in ("name",)}
    return experiment.model_copy(update={**changes, "name": "planned"}).model_dump_json()


@lru_cache(PLANS_KEPT)
def _planned(text: str) -> tuple[dict[int, Trajectory], dict[int, Any]]:
    return plan(check(Experiment, json.loads(text), "campaign"))

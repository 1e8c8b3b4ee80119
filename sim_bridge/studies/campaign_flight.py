"""SHELL: one flight of a campaign, in any process on any machine: text in, plain numbers out.

A module of its own, because worker processes import it and nothing of the campaign's reports.
"""

import json
import time
from functools import lru_cache
from typing import Any

import numpy as np

from shoal.config.experiment import Experiment
from shoal.config.loader import check
from shoal.errors import ConfigError
from shoal.messages.messages import Trajectory
from sim_bridge.in_process.fleet import AgentFleet, DirectPlant, fly
from sim_bridge.in_process.run import plan
from sim_bridge.studies.metrics import broken_limits, measures

PLANS_KEPT = 8  # plans cached per worker, which flies the same few trajectories many times
UNPLANNED = ("sim", "limits", "article", "seed", "name", "title")  # sections that no plan depends on


def fly_one(experiment_json: str) -> dict[str, Any]:
    """Fly an experiment. Returns its row: status flown, refused or failed, the reason, the metrics."""
    begin_s = time.perf_counter()
    experiment = check(Experiment, json.loads(experiment_json), "campaign")
    row: dict[str, Any] = {"status": "flown", "reason": ""}
    try:
        row |= _flown_with_camera(experiment) if experiment.localizer.uses_camera else _flown(experiment)
    except ConfigError as error:
        row |= {"status": "refused", "reason": str(error)}
    except Exception as error:  # one flight's bug must not end the campaign; the row says what it was
        row |= {"status": "failed", "reason": f"{type(error).__name__}: {error}"}
    return {**row, "wall_s": time.perf_counter() - begin_s}


def _flown_with_camera(experiment: Experiment) -> dict[str, Any]:
    from sim_bridge.studies.camera_flight import fly_with_camera  # loads every program: not for numeric flights

    return fly_with_camera(experiment)


def _flown(experiment: Experiment) -> dict[str, Any]:
    trajectories, starts = _planned(planning_text(experiment))
    water = DirectPlant(experiment, experiment.seed, np.array([starts[robot] for robot in experiment.robot_ids]))
    fleet = AgentFleet(experiment, trajectories, water, experiment.seed)
    fleet.start()
    for _ in fly(fleet, water):
        pass
    found = measures(fleet)
    broken = broken_limits(experiment, found)
    faults = dict.fromkeys(state.fault for robot in fleet.robots for state in robot.states if state.fault)
    return {**found, "passed": not broken, "reason": ", ".join([*broken, *faults])}


def planning_text(experiment: Experiment) -> str:
    """The experiment in JSON without the parts that no plan depends on: equal for flights that share a plan."""
    neutral = Experiment.model_fields
    changes = {key: neutral[key].default for key in UNPLANNED if key not in ("name",)}
    return experiment.model_copy(update={**changes, "name": "planned"}).model_dump_json()


@lru_cache(PLANS_KEPT)
def _planned(text: str) -> tuple[dict[int, Trajectory], dict[int, Any]]:
    return plan(check(Experiment, json.loads(text), "campaign"))

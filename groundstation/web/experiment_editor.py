"""SHELL: an operator's edit of path and formation: the real planner says whether it can be flown, and a file keeps it."""

from collections.abc import Mapping
from itertools import combinations
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from groundstation.planning import planner
from groundstation.web.protocol import Edit
from groundstation.web.scene import flown_samples, paths
from wire.config.experiment import Experiment, dump_experiment
from wire.messages.messages import Trajectory
from wire.toml_loader import ConfigError, check

EDITED = Path("experiments")  # below where the station was started
_PATH_KEYS = {
    "waypoints": ("points_m", "speed_mps", "depth_m"),
    "circle": ("diameter_m", "lap_s", "depth_m"),
    "route": ("speed_mps", "depth_m"),
}


def edited(experiment: Experiment, edit: Edit) -> Experiment:
    """The experiment with the edit in it. Raises ConfigError naming key, value and what is allowed."""
    table: dict[str, Any] = experiment.model_dump(mode="json", exclude_none=True)
    given = msgspec.to_builtins(edit)
    kind = table["path"]["kind"]
    foreign = [
        k for k in ("points_m", "speed_mps", "diameter_m", "lap_s") if given[k] is not None and k not in _PATH_KEYS[kind]
    ]
    if foreign:
        raise ConfigError(f"path.{foreign[0]}: a path of kind {kind} has none (allowed: {', '.join(_PATH_KEYS[kind])})")
    table["path"] |= {key: given[key] for key in _PATH_KEYS[kind] if given[key] is not None}
    table["formation"] |= {key: given[key] for key in ("mode", "scale") if given[key] is not None}
    if edit.duration_s is not None:
        table["duration_s"] = edit.duration_s
    known = {robot["id"]: robot for robot in table["robots"]}
    for robot, node_m in (edit.nodes_m or {}).items():
        if robot not in known:
            raise ConfigError(f"nodes_m: no robot {robot} (allowed: {', '.join(map(str, known))})")
        known[robot]["node_m"] = list(node_m)
    return check(Experiment, table, "this edit")


def attempt(experiment: Experiment, edit: Edit) -> dict[str, Any]:
    """Plan an edit: the paths that it would give with their clearances, as far as there are any, and every reason against
    it."""
    shown: dict[str, Any] = {}
    try:
        changed = edited(experiment, edit)
        drafted, problems = planner.draft(changed)
        shown = _shown(changed, drafted.trajectories)
        if not problems:
            planner.start_poses(changed, drafted.trajectories)
    except ConfigError as error:
        problems = str(error).splitlines()
    return {"ok": not problems, "problems": problems, **shown}


def _shown(experiment: Experiment, trajectories: Mapping[int, Trajectory]) -> dict[str, Any]:
    flown = flown_samples(experiment)
    return {
        "paths": paths(trajectories, flown),
        "duration_s": experiment.duration_s,
        "clearance_m": clearance_m(trajectories, flown),
        "needed_m": 2.0 * experiment.safety.radius_m,
        "fastest_mps": max(float(np.hypot(*t.velocity[:flown, :2].T).max()) for t in trajectories.values()),
    }


def clearance_m(trajectories: Mapping[int, Trajectory], flown: int) -> float:
    """The least distance between the centres of any two robots; a large one if there is one robot only."""
    pairs = combinations(trajectories.values(), 2)
    return min((float(np.linalg.norm(a.eta[:flown, :3] - b.eta[:flown, :3], axis=1).min()) for a, b in pairs), default=1e3)


def save(experiment: Experiment, edit: Edit, name: str) -> dict[str, Any]:
    """Write an edit that can be flown to experiments/NAME.toml. Never over a file that is there."""
    tried = attempt(experiment, edit)
    if not tried["ok"]:
        return {"ok": False, "problems": tried["problems"]}
    path = EDITED / f"{name}.toml"
    text = dump_experiment(edited(experiment, edit).model_copy(update={"name": name}))
    try:
        EDITED.mkdir(exist_ok=True)
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        return {"ok": False, "problems": [f"{path} is there already; choose another name"]}
    except OSError as error:
        return {"ok": False, "problems": [f"{path}: {error.strerror}"]}
    return {"ok": True, "problems": [], "path": str(path)}

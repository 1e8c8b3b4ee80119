"""SHELL: an operator's edit of pool, path, formation and robots: the real planner judges it, and a file keeps it."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec

from groundstation.planning import planner
from groundstation.planning.feasibility import OutOfTime, PlanFigure, figures
from groundstation.planning.planner import FleetPlan
from groundstation.planning.segment import PlanSegment
from groundstation.planning.straight_sides import make_path
from groundstation.web.commented_file import commented
from groundstation.web.protocol import Edit
from groundstation.web.scene import flown_samples, paths
from shoal.config.experiment import EXPERIMENTS, Experiment, dump_experiment, load_experiment, with_flight
from shoal.config.formation_shapes import shape_nodes
from shoal.config.loader import check, read_toml
from shoal.config.scene import Waypoints
from shoal.errors import ConfigError
from shoal.messages.messages import CommandKind
from shoal.runtime.output_files import replace_text

EDITED_TITLE = ", edited"  # ends the title of what is no longer the experiment that it names
EDITED = Path("experiments")  # below where the station was started
LIMIT_S = 10.0  # for an edit's plan, which takes the processor from the station's cycle; the page asks again at each change
# The path's keys by the edit's, for each kind of path
_PATH_KEYS = {
    "waypoints": {
        key: key for key in ("points_m", "start_index", "speed_mps", "depth_m", "laps", "corner", "corner_m", "stop")
    },
    "circle": {"diameter_m": "diameter_m", "lap_s": "lap_s", "depth_m": "depth_m"},
    "route": {"points_m": "via_m", "speed_mps": "speed_mps", "depth_m": "depth_m"},
}

_OF_PATHS = sorted({key for keys in _PATH_KEYS.values() for key in keys})


def edited(experiment: Experiment, edit: Edit) -> Experiment:
    """The experiment with the edit in it. Raises ConfigError naming key, value and what is allowed."""
    table: dict[str, Any] = experiment.model_dump(mode="json", exclude_none=True)
    values = {key: value for key, value in msgspec.to_builtins(edit).items() if value is not None}
    if "kind" in values and values["kind"] != table["path"]["kind"]:
        table["path"] = {"kind": values["kind"]}
    kind = table["path"]["kind"]
    foreign = [k for k in _OF_PATHS if k in values and k not in _PATH_KEYS[kind]]
    if foreign:
        raise ConfigError(f"path.{foreign[0]}: a path of kind {kind} has none (allowed: {', '.join(_PATH_KEYS[kind])})")
    table["path"] |= {key: values[name] for name, key in _PATH_KEYS[kind].items() if name in values}
    if kind == "waypoints" and table["path"].get("start_index", 0) >= len(table["path"].get("points_m", ())):
        table["path"]["start_index"] = 0  # the waypoint at which it began is gone
    table["formation"] |= {key: values[key] for key in ("mode", "scale", "shape", "spacing_m") if key in values}
    table["pool"] |= {"size_m": values["pool_m"]} if "pool_m" in values else {}
    if "islands_m" in values:
        table["islands"] = [{"position_m": [x, y], "radius_m": radius} for x, y, radius in values["islands_m"]]
    if edit.duration_s is not None:
        table["duration_s"] = edit.duration_s
    _choose_robots(table, edit)
    if table != experiment.model_dump(mode="json", exclude_none=True):
        table["title"] = f"{(experiment.title or experiment.name).removesuffix(EDITED_TITLE)}{EDITED_TITLE}"
        table["article"] = []  # a paper's figures are those of its own experiment
    return check(Experiment, table, "this edit")


def _choose_robots(table: dict[str, Any], edit: Edit) -> None:
    """Take robots in and out, and give each its node: of the shape, or its own. A new robot has its forerunner in the list as
    neighbour, and the other way round."""
    robots_by_id = {robot["id"]: robot for robot in table["robots"]}
    ids = edit.robots if edit.robots is not None else list(robots_by_id)
    for before, robot in zip([0, *ids], ids, strict=False):
        if robot not in robots_by_id:
            robots_by_id[robot] = {"id": robot, "neighbours": [before] if before else []}
            if before:
                robots_by_id[before]["neighbours"] = [*robots_by_id[before].get("neighbours", ()), robot]
    foreign = [robot for robot in edit.nodes_m or {} if robot not in ids]
    if foreign:
        raise ConfigError(f"nodes_m: no robot {foreign[0]} (allowed: {', '.join(map(str, ids))})")
    table["robots"] = [robots_by_id[robot] for robot in ids]
    for robot in table["robots"]:
        robot["neighbours"] = [other for other in robot.get("neighbours", ()) if other in ids]
    formation = table["formation"]
    if edit.shape is not None:
        nodes = shape_nodes(edit.shape, len(ids), formation["spacing_m"]).tolist()
        for robot, node_m in zip(table["robots"], nodes, strict=True):
            robot["node_m"] = node_m
    elif edit.nodes_m is not None:
        formation.pop("shape", None)
        for robot in table["robots"]:
            robot["node_m"] = list(edit.nodes_m.get(robot["id"], robot.get("node_m", (0.0, 0.0, 0.0))))


def attempt(experiment: Experiment, edit: Edit) -> dict[str, Any]:
    """Plan an edit: the paths that it would give with their clearances, as far as there are any, and every reason against
    it. One that is not planned within LIMIT_S is refused."""
    shown, until_s = dict[str, Any](), time.monotonic() + LIMIT_S

    def out_of_time() -> bool:
        return time.monotonic() > until_s

    try:
        changed = edited(experiment, edit)
        shown = {"nodes_m": [[robot.id, *robot.node_m] for robot in changed.robots]}  # also of what cannot be flown
        try:
            drafted, problems = planner.draft(changed, out_of_time)
        except ConfigError:
            shown |= _shown_as_far_as_planned(changed, out_of_time)
            raise
        shown |= _shown(changed, drafted)
        if not problems:
            planner.start_poses(changed, drafted.trajectories)
    except ConfigError as error:
        problems = str(error).splitlines()
    return {"ok": not problems, "problems": problems, **shown}


def loadable(robots: tuple[int, ...]) -> list[str]:
    """Experiments for just these robots: shipped ones by name, those of the editor as files."""
    return [
        name
        for name, ids in _experiments_with_robots()
        if len(ids) == len(robots)
        and all(robot in ids for robot in robots)  # not sorted: in a half-written file ids are anything
    ]


def _experiments_with_robots() -> Iterator[tuple[str, tuple[Any, ...]]]:
    """Shipped and edited experiments that can be loaded, with their robots."""
    files = {path.stem: path for path in sorted(EXPERIMENTS.glob("*.toml"))}
    files |= {str(path): path for path in sorted(EDITED.glob("*.toml"))}
    for name, path in files.items():
        with contextlib.suppress(ConfigError, OSError):
            yield name, _robots_of(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=256)
def _robots_of(path: Path, changed_ns: int) -> tuple[Any, ...]:
    """Ids of the robots in an experiment's file, which is read again when its time stamp `changed_ns` is another."""
    robots = read_toml(path).get("robots")
    return tuple(robot.get("id") for robot in robots if isinstance(robot, dict)) if isinstance(robots, list) else ()


def flight_text(experiment: Experiment, order: CommandKind, text: str, edit: Edit | None = None) -> str:
    """The text of a request as the station takes it: of a PATH the experiment, where a page gave an edit, or the name of one
    that is `loadable`. Raises ConfigError."""
    if order is CommandKind.PATH and edit is not None:
        return dump_experiment(edited(experiment, edit).model_copy(update={"name": "edited"}))
    if order is not CommandKind.PATH or "\n" in text or "=" in text:
        return text
    names = [name for name, _ in _experiments_with_robots()]
    if text not in names:
        raise ConfigError(f"experiment {text!r}: no such experiment (allowed: {', '.join(names)})")
    return dump_experiment(load_experiment(text))


def drafted(
    experiment: Experiment, order: CommandKind, text: str, plan: Callable[[CommandKind, str], PlanSegment]
) -> dict[str, Any]:
    """Another form or path of the formation as it would be flown: its paths and its least distance, or the reason against
    it."""
    try:
        text = flight_text(experiment, order, text)
        segment = plan(order, text)
        if order is CommandKind.PATH:
            experiment = with_flight(experiment, text)
    except ConfigError as error:
        return {"ok": False, "problems": str(error).splitlines()}
    ahead = round((segment.end_s - segment.centre.begin_s) / segment.centre.period_s)
    flown = min(max(ahead, 2), len(segment.centre.eta))
    return {
        "ok": True,
        "problems": [],
        "paths": paths(segment.trajectories, flown),
        "figures": _as_dicts(figures(experiment, segment.trajectories, flown)),
    }


def _shown(experiment: Experiment, planned: FleetPlan) -> dict[str, Any]:
    """A plan as the page gets it: paths, duration and figures."""
    flown = flown_samples(experiment)
    return {
        "paths": paths(planned.trajectories, flown),
        "duration_s": experiment.duration_s,
        "figures": _as_dicts(planner.plan_figures(experiment, planned, flown)),
    }


def _shown_as_far_as_planned(experiment: Experiment, out_of_time: OutOfTime) -> dict[str, Any]:
    """For an experiment that cannot be planned because its path ends before the run: the path to its end. Empty for others
    that cannot be planned."""
    with contextlib.suppress(ConfigError, ValueError):
        if isinstance(experiment.path, Waypoints):
            end_s = make_path(experiment.path).end_s
            period_s = experiment.controller.period_s
            ended = experiment.model_copy(update={"duration_s": min(experiment.duration_s, end_s // period_s * period_s)})
            return _shown(ended, planner.draft(ended, out_of_time)[0])
    return {}


def _as_dicts(listed: list[PlanFigure]) -> list[dict[str, Any]]:
    return [dataclasses.asdict(figure) for figure in listed]


def save(experiment: Experiment, edit: Edit, name: str) -> dict[str, Any]:
    """Write an edit that can be flown to experiments/NAME.toml. Never over a file that is there."""
    tried = attempt(experiment, edit)
    if not tried["ok"]:
        return {"ok": False, "problems": tried["problems"]}
    path = EDITED / f"{name}.toml"
    changed = edited(experiment, edit)
    text = commented(changed.model_copy(update={"name": name, "title": f"{name}, edited from {experiment.name}"}))
    try:
        EDITED.mkdir(exist_ok=True)
        replace_text(path, text, over=False)
    except FileExistsError:
        return {"ok": False, "problems": [f"{path} is there already; choose another name"]}
    except OSError as error:
        return {"ok": False, "problems": [f"{path}: {error.strerror}"]}
    return {"ok": True, "problems": [], "path": str(path)}

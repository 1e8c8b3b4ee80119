"""SHELL: the experiment file: what is flown, by whom, how, and what a good result is. One file that all processes share.

A run starts only if every process holds the same experiment, so `Experiment.hash` covers every key, defaults and vehicle
included. Lengths are metres, angles radians, times seconds; pool frame (see shoal/frames.py) unless the key says otherwise.
"""

import hashlib
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
import tomli_w
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from shoal.config.controller import ControllerConfig, Safety
from shoal.config.fault_injection import KINDS, fault_table, no_target, read_request
from shoal.config.formation_shapes import SHAPES, shape_nodes
from shoal.config.loader import Section, apply_setting, check, nearest, parse_toml, read_toml
from shoal.config.mission import MissionConfig
from shoal.config.perception import LANDMARKS_NEEDED, UNSEEING, Camera, CameraFile, Landmark, Localizer, NamedCamera
from shoal.config.recording import Recording
from shoal.config.scene import FormationConfig, Island, PathSpec, PoolConfig, RobotConfig
from shoal.config.simulation import Sim
from shoal.config.vehicle import Fraction, Positive, Vehicle, load_vehicle
from shoal.errors import ConfigError
from shoal.frames import Array

EXPERIMENTS = Path(__file__).parent / "experiments"
SHORT_PLAN_AGE_S = float(Safety.model_fields["plan_max_age_s"].default)  # in which no robot gets far, whatever plans reach
NO_CAMERA = "localizer.uses_camera=false"  # the setting of runs in which poses are the simulation's truth


Name = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]*$", max_length=64)]


class ArticleRow(Section):
    """A row of the article's result table: tracking of robot "1", or formation of the pair "1-2"."""

    subject: str
    """A robot (1) or a pair (1-2)."""
    rms_m: tuple[float, ...] = ()
    """RMS errors in x, y and, where printed, z."""
    rms_yaw_rad: float | None = None
    """RMS error in yaw."""
    max_m: tuple[float, ...] = ()
    """Largest errors in x, y and, where printed, z."""


class Limit(Section):
    """Largest values for a run that passes, against the plant's truth."""

    rms_m: Annotated[Positive | None, Field(examples=[0.1])] = None
    """RMS tracking error per axis, whole run."""
    rms_after_20s_m: Positive | None = None
    """RMS tracking error per axis after 20 s."""
    rms_yaw_after_20s_rad: Positive | None = None
    """RMS yaw error to the path's tangent after 20 s."""
    max_after_20s_m: Positive | None = None
    """Largest tracking error per axis after 20 s."""
    arrived_m: Positive | None = None
    """Horizontal distance from the last reference at the end."""
    pose_rms_m: Positive | None = None
    """RMS error of the localizer's poses."""
    wrench_step_rms: Fraction | None = None
    """RMS of the inputs' change per step after 20 s, over its bound."""
    exposure_to_pwm_p99_ms: Positive | None = None
    """99th percentile of the time from exposure to thruster pulses."""


class Experiment(Section):
    """The whole file."""

    name: Name
    """Name, also in those of its runs' folders."""
    title: str = ""
    """Title."""
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 1
    """Seed of everything random."""
    duration_s: Annotated[float, Field(gt=0, le=36000)]
    """Time to fly."""
    vehicle: Vehicle
    """A shipped vehicle, a file ending in .toml, or a table (vehicle.md)."""
    pool: PoolConfig
    """Pool."""
    path: PathSpec
    """Path."""
    formation: FormationConfig = FormationConfig()
    """Formation."""
    robots: Annotated[tuple[RobotConfig, ...], Field(min_length=1, max_length=49)]
    """Robots."""
    islands: tuple[Island, ...] = ()
    """Islands."""
    safety: Safety = Safety()
    """Safety."""
    mission: MissionConfig = MissionConfig()
    """Mission."""
    controller: ControllerConfig = ControllerConfig()
    """Control (controller.md)."""
    camera: Camera = UNSEEING
    """A table, or the path of a file of `localizer calibrate`. Not needed where localizer.uses_camera is false."""
    cameras: tuple[NamedCamera, ...] = ()
    """Several cameras over one pool, in place of [camera] (cameras.md). `like` names the file of a calibration."""
    landmarks: tuple[Landmark, ...] = ()
    """Markers at known places. With any, the camera is taken to move."""
    check_marks: tuple[Landmark, ...] = ()
    """Markers at known places, by which a fixed camera is checked: a bump, a lower water level. Four and more tell which."""
    localizer: Localizer = Localizer()
    """Localizer."""
    recording: Recording = Recording()
    """Recording."""
    sim: Sim = Sim()
    """Simulator (simulation.md)."""
    limits: Limit = Limit()
    """Limits of a good run."""
    article: tuple[ArticleRow, ...] = ()
    """The article's results."""

    @model_validator(mode="after")
    def _robots_fit_together(self) -> Self:
        ids = [robot.id for robot in self.robots]
        for values, what in ((ids, "id"), ([robot.marker for robot in self.robots], "marker_id")):
            doubled = sorted({v for v in values if values.count(v) > 1})
            if doubled:
                raise ValueError(f"robots: {what} {doubled[0]} is used twice; each robot needs its own")
        for robot in self.robots:
            for other in robot.neighbours:
                if other not in ids or other == robot.id or robot.neighbours.count(other) > 1:
                    allowed = ", ".join(str(i) for i in ids if i != robot.id) or "none"
                    raise ValueError(f"robots: neighbours of robot {robot.id}: {other} is not allowed (once each: {allowed})")
        if self.formation.leader is not None and self.formation.leader not in ids:
            allowed = ", ".join(map(str, ids))
            raise ValueError(f"formation.leader = {self.formation.leader}: no such robot (allowed: {allowed})")
        for change in self.formation.changes:
            if change.order and (sorted(change.order) != sorted(ids) or any(robot.path is not None for robot in self.robots)):
                allowed = f"each of {', '.join(map(str, sorted(ids)))} once, and no robot with a path of its own"
                raise ValueError(f"formation.changes: order = {list(change.order)}: (allowed: {allowed})")
        hz = self.sim.plant.disturbance_hz
        if isinstance(hz, tuple) and len(hz) != len(ids):
            raise ValueError(f"sim.plant.disturbance_hz: {len(hz)} values for {len(ids)} robots (allowed: one, or one each)")
        return self

    @model_validator(mode="after")
    def _camera_is_there(self) -> Self:
        if self.cameras and "camera" in self.model_fields_set:
            raise ValueError("camera: stands beside [[cameras]] (allowed: [camera] for one camera, [[cameras]] for several)")
        if self.localizer.uses_camera and "camera" not in self.model_fields_set and not self.cameras:
            raise ValueError(
                "camera: missing, and localizer.uses_camera = true (allowed: a [camera] table, the file of a calibration, or "
                "a run without one: `sim-bridge numeric`, `sim-bridge sil --poses`, or localizer.uses_camera = false)"
            )
        return self

    @model_validator(mode="after")
    def _cameras_go_together(self) -> Self:
        names, effects = self.camera_names, KINDS["camera"][1]
        for i, camera in enumerate(self.cameras):
            where = f"cameras.{i}"
            if names.index(camera.name) != i:
                raise ValueError(f"{where}.name = {camera.name!r}: is used twice; each camera needs its own")
            if camera.name in effects:
                raise ValueError(
                    f"{where}.name = {camera.name!r}: `camera {camera.name}` is a fault (not: {', '.join(effects)})"
                )
            if camera.rate_hz != self.cameras[0].rate_hz:
                rate_hz = self.cameras[0].rate_hz
                raise ValueError(f"{where}.rate_hz = {camera.rate_hz:g}: not that of {names[0]} (allowed: {rate_hz:g})")
        if self.cameras and self.landmarks:
            raise ValueError("landmarks: they place one moving camera, and [[cameras]] hang still (allowed: check_marks)")
        if self.cameras and not self.localizer.markers:
            raise ValueError(
                "localizer.markers = false: from camera to camera robots are known by their markers (allowed: true)"
            )
        return self

    @model_validator(mode="after")
    def _board_outlasts_a_lost_step(self) -> Self:
        neutral_s, period_s = self.sim.board.neutral_after_s, self.controller.period_s
        if period_s > neutral_s / 2.0:
            raise ValueError(
                f"controller.period_s = {period_s:g}: when one step fails to come the board of "
                f"sim.board.neutral_after_s = {neutral_s:g} s would disarm (allowed: up to {neutral_s / 2.0:g})"
            )
        return self

    @model_validator(mode="after")
    def _distances_hold_the_hulls(self) -> Self:
        radius_m, hull_m = self.safety.radius_m, self.vehicle.radius_m
        if radius_m < hull_m:
            raise ValueError(
                f"safety.radius_m = {radius_m:g}: centres may come within {2.0 * radius_m:g} m of each other, but hulls of "
                f"vehicle.radius_m = {hull_m:g} touch at {2.0 * hull_m:g} m (allowed: from {hull_m:g} on)"
            )
        return self

    @model_validator(mode="after")
    def _plans_count_no_longer_than_they_reach(self) -> Self:
        age_s, period_s = self.safety.plan_max_age_s, self.controller.period_s
        ahead_s = self.controller.mpc.horizon * period_s
        allowed_s = max(ahead_s, SHORT_PLAN_AGE_S)
        if age_s > allowed_s + 1e-9:
            raise ValueError(
                f"safety.plan_max_age_s = {age_s:g}: a plan reaches {ahead_s:g} s ahead, and when it is older it tells of "
                f"nothing that is to come (allowed: up to {allowed_s:g})"
            )
        return self

    @model_validator(mode="after")
    def _faults_meet_something(self) -> Self:
        localizers = ("localizer", *(f"localizer-{name}" for name in self.camera_names))
        processes = ("groundstation", "sim-bridge", *localizers, *(f"agent-{robot}" for robot in self.robot_ids))
        for i, fault in enumerate(self.sim.faults):
            broken = fault.broken
            if reason := no_target(broken, self.robot_ids, self.vehicle.thruster_channels, self.camera_names):
                raise ValueError(f"sim.faults.{i}.what = {fault.what!r}: {reason}")
            if broken.process and broken.process not in processes:
                raise ValueError(f"sim.faults.{i}.what = {fault.what!r}: no such process (allowed: {', '.join(processes)})")
        return self

    @model_validator(mode="after")
    def _law_knows_the_axes(self) -> Self:
        if self.vehicle.limits.has_sway and self.controller.law != "nmpc":
            raise ValueError(
                f"vehicle: {self.vehicle.name!r} has side thrust, which controller.law = {self.controller.law!r} does not "
                "know (allowed: law 'nmpc', or a vehicle whose limits.wrench has 3 numbers)"
            )
        return self

    @model_validator(mode="after")
    def _landmarks_can_be_told_apart(self) -> Self:
        if 0 < len(self.landmarks) < LANDMARKS_NEEDED:
            raise ValueError(
                f"landmarks: {len(self.landmarks)} cannot place a camera (allowed: none, or {LANDMARKS_NEEDED} and more)"
            )
        if self.landmarks and self.check_marks:
            raise ValueError("check_marks: they check a fixed camera, and with landmarks it moves (allowed: one of the two)")
        key = "landmarks" if self.landmarks else "check_marks"
        ids = [mark.id for mark in self.marks]
        for mark in self.marks:
            if ids.count(mark.id) > 1:
                raise ValueError(f"{key}: id {mark.id} is used twice; each needs its own")
            for robot in self.robots:
                if robot.marker == mark.id:
                    free = sorted(set(range(50)) - set(ids) - {r.marker for r in self.robots})
                    raise ValueError(
                        f"{key}: id {mark.id} is the marker of robot {robot.id} (free: {', '.join(map(str, free))})"
                    )
            depth, floor = mark.position_m[2], self.pool.size_m[2]
            if depth > floor:
                raise ValueError(f"{key}: id {mark.id} at z = {depth} lies below the floor (allowed: up to {floor})")
        return self

    @property
    def marks(self) -> tuple[Landmark, ...]:
        """All markers at known places: landmarks of a moving camera, or check marks of a fixed one."""
        return self.landmarks or self.check_marks

    @property
    def camera_names(self) -> tuple[str, ...]:
        """Names of several cameras, in the file's order; empty where there is one."""
        return tuple(camera.name for camera in self.cameras)

    @property
    def shown_camera(self) -> str:
        """The camera whose picture viewers show first: the first of several, "" for the only one."""
        return next(iter(self.camera_names), "")

    @property
    def all_cameras(self) -> tuple[Camera, ...]:
        """The several cameras, or the only one."""
        return self.cameras or (self.camera,)

    def of_camera(self, name: str) -> "Experiment":
        """The experiment as the localizer of one of several cameras has it: with that camera as the only one. The same for "",
        the only camera. Raises ConfigError naming the cameras there are."""
        if name == "" and not self.cameras:
            return self
        for camera in self.cameras:
            if camera.name == name:
                alone = Camera.model_validate(camera.model_dump(exclude={"name"}))
                return self.model_copy(update={"camera": alone, "cameras": ()})
        if not self.cameras:
            raise ConfigError(f"--camera {name}: experiment {self.name!r} has one camera (leave the option out)")
        what = f"--camera {name}: not in experiment {self.name!r}" if name else f"--camera: missing, {self.name!r} has several"
        raise ConfigError(f"{what} (allowed: {', '.join(self.camera_names)})")

    @property
    def plant_steps(self) -> int:
        """Steps of the simulated plant in a control period, where they keep step: in lockstep and numeric flights. Raises
        ConfigError where they do not: a control step would use measurements from after it."""
        step_ns, period_ns = round(self.sim.plant.step_s * 1e9), round(self.controller.period_s * 1e9)
        if period_ns % step_ns:
            raise ConfigError(
                f"sim.plant.step_s = {self.sim.plant.step_s:g}: must go into controller.period_s = "
                f"{self.controller.period_s:g} without a rest (allowed: {self.controller.period_s:g} over a whole number)"
            )
        return period_ns // step_ns

    @property
    def wrench_step(self) -> tuple[float, ...]:
        """The largest change of the wrench per control step: N, N, N m, and N of sway."""
        return self.vehicle.limits.wrench_step(self.controller.period_s)

    @property
    def robot_ids(self) -> tuple[int, ...]:
        """Ids of all robots, in the file's order."""
        return tuple(robot.id for robot in self.robots)

    def robot(self, robot_id: int) -> RobotConfig:
        """The robot of that id. Raises ConfigError naming the ids there are."""
        for robot in self.robots:
            if robot.id == robot_id:
                return robot
        allowed = ", ".join(str(i) for i in self.robot_ids)
        raise ConfigError(f"robot {robot_id}: not in experiment {self.name!r} (allowed: {allowed})")

    def fault_request(self, text: str) -> tuple[str, float]:
        """Read a person's request for a fault, which only what this experiment has can have: see `read_request`. Raises
        ValueError."""
        return read_request(
            text, self.robot_ids, self.vehicle.thruster_channels, self.camera_names, self.localizer.uses_camera
        )

    def leader_of(self, robot_id: int) -> int | None:
        """The robot that this one follows instead of its own node; None if it follows none."""
        leader = self.robot_ids[0] if self.formation.leader is None else self.formation.leader
        return leader if self.formation.kind == "leader-follower" and leader != robot_id else None

    def path_of(self, robot: RobotConfig) -> PathSpec:
        """The path whose node that robot is on."""
        return self.path if robot.path is None else robot.path

    def clearance_m(self, place_m: Array) -> Array:
        """Distances (n,) of hulls at (n, 3) from the nearest wall, floor or island, in m; below 0 they touch it, and they are
        infinite where there is none. A robot may float: the surface is no wall."""
        x, y, z = np.abs(place_m.T)
        length, width, depth = self.pool.size_m
        beside = [length / 2.0 - x, width / 2.0 - y, depth - z] if self.pool.walls else [np.full(len(place_m), np.inf)]
        shores = [np.hypot(*(place_m[:, :2] - island.position_m).T) - island.radius_m for island in self.islands]
        return np.asarray(np.min([*beside, *shores], axis=0) - self.vehicle.radius_m)

    @property
    def watches_obstacles(self) -> bool:
        """True if the localizer has to watch for obstacles: the camera does not move, and obstacle_min_m is not 0. If it is
        False, missing obstacle messages are no fault."""
        return self.localizer.uses_camera and self.localizer.obstacle_min_m > 0.0 and not self.landmarks

    def nodes_m(self) -> Array:
        """Formation nodes from the virtual centre, shape (robots, 3), scaled by L = l I (15)."""
        return self.formation.scale * np.array([robot.node_m for robot in self.robots])

    @model_serializer(mode="wrap")
    def _without_unused_camera(self, table_of: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """The table that gives this experiment again: `camera` is only a stand-in where there are several."""
        table: dict[str, Any] = table_of(self)
        if self.cameras:
            table.pop("camera", None)
        return table

    @cached_property
    def hash(self) -> str:
        """SHA-256 (hex) over every value of the experiment and its vehicle, defaults included."""
        text = json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()


def with_flight(experiment: Experiment, text: str) -> Experiment:
    """The experiment with the flight of another one, given as TOML: path, places in the formation, and duration. Robots, pool,
    vehicle, control and limits stay, for programs run that have them. Raises ConfigError."""
    given = parse_toml(text, "the other experiment")
    name, formation = given.get("name", experiment.name), given.get("formation", {})
    if "path" not in given:
        raise ConfigError(f"{name}: path: missing, and it has no default")
    table = experiment.model_dump(mode="json", exclude_none=True)
    if isinstance(formation, dict):
        own = experiment.formation.model_dump(mode="json", exclude_none=True)
        stays = {key: own.get(key) for key in ("kind", "leader")}
        other = [key for key, value in stays.items() if formation.get(key, value) != value]
        if other:
            raise ConfigError(
                f"{name}: formation.{other[0]} = {formation[other[0]]!r}: robots that run have {stays[other[0]]!r}"
            )
        formation = formation | {key: value for key, value in stays.items() if value is not None}
    if "robots" in given or (isinstance(formation, dict) and "shape" in formation):
        table["robots"] = _with_other_places(name, table["robots"], given.get("robots"))
    table |= {key: given[key] for key in ("name", "path", "duration_s") if key in given} | {"formation": formation}
    _insert_nodes(table)
    return check(Experiment, table, str(name))


def dump_flight(experiment: Experiment) -> str:
    """The flight of an experiment as TOML, as `with_flight` takes it: small enough for a message."""
    table = experiment.model_dump(
        mode="json", exclude_none=True, include={"name", "duration_s", "path", "formation", "robots"}
    )
    kept = ("id", "node_m", "path")
    table["robots"] = [{key: robot[key] for key in kept if key in robot} for robot in table["robots"]]
    return tomli_w.dumps(table)


def _with_other_places(name: Any, robots: list[dict[str, Any]], others: Any) -> list[dict[str, Any]]:
    """Robots with the places and own paths of the robots with the same ids in another experiment; without any if it names no
    robots."""
    own = [{key: value for key, value in robot.items() if key not in ("node_m", "path")} for robot in robots]
    if others is None:
        return own
    tables = [other for other in others if isinstance(other, dict)] if isinstance(others, list) else []
    by_id = {other["id"]: other for other in tables if isinstance(other.get("id"), int)}
    ids = [robot["id"] for robot in own]
    if sorted(by_id) != sorted(ids):
        there, here = (", ".join(map(str, each)) or "none" for each in (by_id, ids))
        raise ConfigError(f"{name}: it is for robots {there}; here are {here}")
    return [robot | {key: value for key, value in by_id[robot["id"]].items() if key in ("node_m", "path")} for robot in own]


def dump_experiment(experiment: Experiment) -> str:
    """The whole experiment as TOML, vehicle and defaults included: loading it gives the same hash."""
    return tomli_w.dumps(experiment.model_dump(mode="json", exclude_none=True))


def experiment_path(name_or_path: str) -> Path:
    """The file of an experiment: of a shipped name (`pool`), or a path ending in .toml. Raises ConfigError."""
    if name_or_path.endswith(".toml"):
        return Path(name_or_path)
    path = EXPERIMENTS / f"{name_or_path}.toml"
    if not path.is_file():
        names = sorted(p.stem for p in EXPERIMENTS.glob("*.toml"))
        own = f"{name_or_path}.toml"
        near = f"; did you mean {own}?" if Path(own).is_file() else nearest(name_or_path, names)
        allowed = f"{', '.join(names)}, or a path ending in .toml"
        raise ConfigError(f"experiment {name_or_path!r}: no such experiment{near} (allowed: {allowed})")
    return path


def load_experiment(name_or_path: str, settings: Sequence[str] = (), faults: Sequence[str] = ()) -> Experiment:
    """Load and check an experiment, with `--set key=value` settings laid over it and `--fault` lines added to its own. Raises
    ConfigError."""
    path = experiment_path(name_or_path)
    return checked_experiment(read_toml(path), path, settings, faults)


def checked_experiment(
    table: dict[str, Any], path: Path, settings: Sequence[str] = (), faults: Sequence[str] = ()
) -> Experiment:
    """The experiment of a parsed file; `table` is changed. Raises ConfigError."""
    options: dict[str, str] = {}  # of the command line, by what an error about them begins with
    try:
        _insert_files(table, path)
        for setting in settings:
            key = setting.partition("=")[0].strip()
            options |= {key: f"--set {setting}: ", setting: "--set ", repr(setting): "--set "}
            apply_setting(table, setting)
            _insert_files(table, path, typed=True)
        _insert_nodes(table)
        if faults:
            sim = table.setdefault("sim", {})
            listed = sim.setdefault("faults", []) if isinstance(sim, dict) else None
            if isinstance(listed, list):  # else `check` says what is wrong with it
                options |= {f"sim.faults.{k}": f"--fault {fault!r}: " for k, fault in enumerate(faults, len(listed))}
                listed += map(fault_table, faults)
        return _with_the_vehicles_body(check(Experiment, table, str(path)))
    except ConfigError as error:
        raise ConfigError("\n".join(_option_error(line, path, options) for line in str(error).splitlines())) from None


def _with_the_vehicles_body(experiment: Experiment) -> Experiment:
    """The experiment with a simulated body of its vehicle's righting moment and number of cells, where it says nothing else of
    them: a vehicle's file alone is enough to fly it in the simulator."""
    sim, plant, righting = experiment.sim, experiment.sim.plant, experiment.vehicle.righting
    packs = experiment.vehicle.battery.cells / 3  # defaults are those of three cells
    body = {}
    if righting is not None:
        inertia_kg_m2 = righting.moment_nm * (righting.swing_s / math.tau) ** 2
        body = {
            "righting_nm": righting.moment_nm,
            "inertia_kg_m2": float(f"{inertia_kg_m2:.2g}"),  # a period is measured no better
            "legs_below_m": righting.thrusters_below_m,
        }

    def derived(section: Any, values: Mapping[str, float]) -> Any:
        return section.model_copy(update={key: value for key, value in values.items() if key not in section.model_fields_set})

    battery = derived(plant.battery, {"curve_v": plant.battery.curve_v * packs})
    plant = plant.model_copy(update={"tilt": derived(plant.tilt, body), "battery": battery})
    sensors = derived(sim.sensors, {"battery_v": sim.sensors.battery_v * packs})
    return experiment.model_copy(update={"sim": sim.model_copy(update={"plant": plant, "sensors": sensors})})


def _option_error(line: str, path: Path, given: Mapping[str, str]) -> str:
    """An error's line, with the option of the command line in the file's place where it is about that option."""
    about = line.removeprefix(f"{path}: ")
    for subject, option in reversed(list(given.items())):
        if re.match(rf"{re.escape(subject)}[.: ]", about):
            return f"{option}{about}"
    return line


def _insert_files(table: dict[str, Any], experiment: Path, typed: bool = False) -> None:
    """Put vehicle and cameras in the place of their files' names, so that settings reach into them and the hash covers them. A
    name that a person has `typed` is looked for in the working folder first, any other beside the experiment's file.

    A table may name a file as `like` and say only what is different: `vehicle = { like = "spherical", radius_m = 0.2 }`.
    """
    cameras = table.get("cameras")
    several = range(len(cameras)) if isinstance(cameras, list) else ()
    places: list[tuple[Any, Any, Callable[[str, Path], Section]]] = [
        (table, "vehicle", load_vehicle), (table, "camera", load_camera), *((cameras, i, load_camera) for i in several)
    ]  # fmt: skip
    for holder, key, load in places:
        given = holder.get(key) if isinstance(holder, dict) else holder[key]
        name = given.get("like") if isinstance(given, dict) else given
        if not isinstance(name, str):
            continue
        beside = experiment.parent
        is_from_here = typed and (Path(name).is_file() or not (beside / name).is_file())
        try:
            holder[key] = load(name, Path() if is_from_here else beside).model_dump(mode="json")
        except ConfigError as error:
            raise ConfigError("\n".join(f"{experiment}: {line}" for line in str(error).splitlines())) from None
        if isinstance(given, dict):
            _merge_into(holder[key], {k: value for k, value in given.items() if k != "like"})


def _insert_nodes(table: dict[str, Any]) -> None:
    """Give the robots that have no node one of the formation's shape, in the file's order."""
    formation, robots = table.get("formation"), table.get("robots")
    if not (isinstance(formation, dict) and isinstance(robots, list)) or formation.get("shape") is None:
        return
    shape = formation["shape"] if formation["shape"] in SHAPES else SHAPES[0]  # one complaint, not one of each robot too
    spacing_m = formation.get("spacing_m", FormationConfig.model_fields["spacing_m"].default)
    if isinstance(spacing_m, int | float) and 0.0 < spacing_m < math.inf:
        for robot, node in zip(robots, shape_nodes(shape, len(robots), spacing_m).tolist(), strict=True):
            if isinstance(robot, dict):
                robot.setdefault("node_m", node)


def _merge_into(table: dict[str, Any], changes: dict[str, Any]) -> None:
    """Write `changes` into `table`, in place; tables within tables likewise."""
    for key, value in changes.items():
        if isinstance(value, dict) and isinstance(table.get(key), dict):
            _merge_into(table[key], value)
        else:
            table[key] = value


def load_camera(path: str, relative_to: Path | None = None) -> Camera:
    """The camera of a calibration's file. Raises ConfigError."""
    if not path.endswith(".toml"):
        raise ConfigError(f"camera = {path!r}: must be a table, or a path ending in .toml (as `localizer calibrate` writes)")
    place = (relative_to or Path()) / path
    return check(CameraFile, read_toml(place), str(place)).camera

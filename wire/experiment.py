"""SHELL: the experiment file: what is flown, by whom, how, and what a good result is. One file that all processes share.

A run starts only if every process holds the same experiment, so `Experiment.hash` covers every key, defaults and vehicle
included. Lengths are metres, angles radians, times seconds; pool frame (see wire/frames.py) unless the key says otherwise.
"""

import hashlib
import json
import math
from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import tomli_w
from pydantic import Field, model_validator

from wire.faults import Fault, fault_table
from wire.frames import Array
from wire.laws import AdaptiveNn, Backstepping, Fuzzy, LawName, Lqr, Pid, SlidingMode
from wire.shapes import SHAPES, Shape, shape_nodes
from wire.sim_plant import Plant
from wire.toml_file import ConfigError, Section, apply_setting, check, read_toml
from wire.vehicle import NotNegative, Positive, Vehicle, load_vehicle

EXPERIMENTS = Path(__file__).parents[1] / "groundstation" / "experiments"

Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]
Vec4 = tuple[float, float, float, float]
Weight3 = tuple[NotNegative, NotNegative, NotNegative]
Weight4 = tuple[NotNegative, NotNegative, NotNegative, NotNegative]
Fraction = Annotated[float, Field(ge=0, le=1)]


LANDMARKS_NEEDED = 4  # one could place a camera, but tilt and sway look alike across 0.2 m; four also show which one was moved


class Pool(Section):
    """The basin. Its walls stand at +-length/2 and +-width/2 around the origin."""

    size_m: tuple[Positive, Positive, Positive]


class Circle(Section):
    """A circle around the origin, flown clockwise seen from above (heading grows), starting at its largest x."""

    kind: Literal["circle"]
    diameter_m: Positive
    lap_s: Positive
    depth_m: NotNegative
    slow: bool = False  # as for waypoints


class Waypoints(Section):
    """A natural cubic spline through waypoints (equations 12, 13), flown at constant speed."""

    kind: Literal["waypoints"]
    points_m: Annotated[tuple[Vec2, ...], Field(min_length=2)]
    speed_mps: Positive
    start_index: Annotated[int, Field(ge=0)] = 0
    depth_m: NotNegative = 0.0
    dive_mps: float = 0.0
    slow: bool = False  # slow down where a robot would exceed its limits, instead of refusing the plan
    stop: bool = False  # at the last waypoint, and stay; otherwise the run must end before the path does

    @model_validator(mode="after")
    def _starts_on_the_path(self) -> Self:
        if self.start_index >= len(self.points_m):
            raise ValueError(f"start_index = {self.start_index}: no such waypoint (allowed: 0 to {len(self.points_m) - 1})")
        return self


class Route(Section):
    """The shortest way through places in order that the whole formation can take: around islands, within the walls."""

    kind: Literal["route"]
    via_m: Annotated[tuple[Vec2, ...], Field(min_length=2)]  # of the formation's centre: from the first, to the last
    speed_mps: Positive
    depth_m: NotNegative = 0.0
    clearance_m: NotNegative = 0.1  # between hulls and whatever stands there
    smooth_m: Positive = 0.5  # over how long bends are spread, also those at places on the way; less where there is no room
    slow: bool = True  # as for waypoints
    stop: bool = True  # as for waypoints


PathSpec = Annotated[Circle | Waypoints | Route, Field(discriminator="kind")]


class Change(Section):
    """Another form on the way, taken smoothly: a named shape, or the same one larger and turned."""

    at_s: NotNegative  # when it begins, in the run's time
    over_s: Positive = 10.0
    shape: Shape | None = None
    spacing_m: Positive = 0.8  # of the new shape's nearest nodes, before `scale`
    scale: Positive = 1.0
    turn_rad: float = 0.0


class Formation(Section):
    """Nodes around a virtual centre (14-16): `translate` keeps offsets constant in the pool frame, `rotate` turns them with
    the path's tangent (ambiguity A10).

    With `virtual-structure` every robot follows its own node, and the formation terms couple neighbours. With
    `leader-follower` only the leader follows its node; the others keep their offsets from wherever the leader is.
    """

    kind: Literal["virtual-structure", "leader-follower"] = "virtual-structure"
    leader: int | None = None  # its id; default: the first robot
    mode: Literal["translate", "rotate"] = "translate"
    scale: Positive = 1.0
    shape: Shape | None = None  # for robots without a node_m, in the file's order
    spacing_m: Positive = 0.8  # of the shape's nearest nodes, before `scale`
    changes: tuple[Change, ...] = ()

    @model_validator(mode="after")
    def _changes_one_after_the_other(self) -> Self:
        for before, after in pairwise(self.changes):
            if after.at_s < before.at_s + before.over_s:
                end_s = before.at_s + before.over_s
                raise ValueError(
                    f"changes: at_s = {after.at_s:g}: the one before ends at {end_s:g} s (allowed: that or later)"
                )
        return self


class Robot(Section):
    """One robot: its node in the formation, or a path of its own, and where it starts.

    `start_offset` is [x m, y m, z m, yaw rad] from the first reference; `start` is a pose in the pool frame instead. Robots
    on one path are planned to stay apart; on different paths they may be planned through one another, and give way there.
    """

    id: Annotated[int, Field(ge=1, le=49)]
    node_m: Vec3
    path: PathSpec | None = None  # default: the formation's
    start_offset: Vec4 = (0.0, 0.0, 0.0, 0.0)
    start: Vec4 | None = None
    neighbours: tuple[int, ...] = ()
    urgent: bool = False
    marker_id: Annotated[int, Field(ge=0, le=49)] | None = None  # DICT_4X4_50 has no more

    @property
    def marker(self) -> int:
        """ArUco id on the robot's back: its own number unless the file says otherwise."""
        return self.id if self.marker_id is None else self.marker_id


class Safety(Section):
    """Collision avoidance and freshness."""

    radius_m: Positive = 0.30
    margin_m: NotNegative = 0.05
    bubble_mps: NotNegative = 0.1  # how fast the space around a silent neighbour grows
    bubble_max_m: NotNegative = 0.5  # and how far: a robot that is gone must not push the others against the walls
    pose_hold_s: Positive = 0.2  # hold, then (pose_neutral_s) neutral, counted from the last pose
    pose_neutral_s: Positive = 0.45
    station_hold_s: Positive = 1.0
    station_neutral_s: Positive = 3.0
    station_disarm_s: Positive = 10.0
    plan_max_age_s: Positive = 0.5

    @model_validator(mode="after")
    def _worse_comes_later(self) -> Self:
        for earlier, later in (
            ("pose_hold_s", "pose_neutral_s"),
            ("station_hold_s", "station_neutral_s"),
            ("station_neutral_s", "station_disarm_s"),
        ):
            if not getattr(self, earlier) < getattr(self, later):
                raise ValueError(f"{later} = {getattr(self, later)} must be more than {earlier} = {getattr(self, earlier)}")
        return self


class Estimator(Section):
    """Extended state observer (31), bandwidth form b1 = 3w, b2 = 3w^2, b3 = w^3 (Gao 2003). The sensing delay is compensated,
    so noise sets the bandwidth, not delay: at 2 rad/s a pose noise of 1.5 mm makes 2 mm/s in velocity."""

    enabled: bool = True  # False: no disturbance estimate
    bandwidth_radps: Positive = 2.0
    yaw_bandwidth_radps: Positive = 4.0
    use_imu_yaw_rate: bool = True
    sway: bool = True  # False: the article's model, which cannot slide sideways
    current_rate_radps: NotNegative = 0.15  # how fast a side force that lasts is put down to a current; 0: never


class Guidance(Section):
    """Reference heading from the force the path asks for: without it a robot that cannot
    push sideways never corrects a lateral error at walking pace."""

    enabled: bool = True
    position_gain_per_s2: NotNegative = 0.08  # 0.28 rad/s: a third of what heading, filter and observer can follow
    velocity_gain_per_s: NotNegative = 0.5  # damping ratio 0.9
    max_correction_rad: Annotated[float, Field(gt=0, lt=np.pi / 2)] = 1.4
    turning_force_n: Positive = 0.02  # forces well below this are not worth a turn
    filter_s: Positive = 1.0  # time constant of the force that feeds back: 0.5 follows noise, 2.0 overshoots by 4 cm
    hold_radius_m: Positive = 0.06  # station keeping: nearer than this the heading stays as it is


class Mpc(Section):
    """Model predictive control (35-40). The article's own setting: horizon 25, blocks of fifteen ones, r = 0.01,
    `linearise = "point"`, no lag."""

    solver: Literal["osqp", "daqp"] = "osqp"
    horizon: Annotated[int, Field(ge=2, le=200)] = 50
    blocks: Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)] = (1, 1, 2, 3, 4, 4)
    linearise: Literal["trajectory", "point"] = "trajectory"
    q: Weight4 = (1.0, 1.0, 1.0, 1.0)
    q_formation: Weight4 = (0.15, 0.15, 0.15, 0.15)
    r: Weight3 = (0.05, 0.05, 8.0)  # per N^2 and (N m)^2: the same 0.01 for all lets yaw chatter at its rate limit
    slack: Positive = 1e4
    model_lag: bool = True

    @model_validator(mode="after")
    def _blocks_fit(self) -> Self:
        if sum(self.blocks) > self.horizon:
            raise ValueError(f"blocks sum to {sum(self.blocks)} steps, more than horizon = {self.horizon}")
        return self


class Controller(Section):
    """What runs on the robot, 1/period_s times a second. `law` is what computes the wrench, given estimate and reference."""

    period_s: Annotated[float, Field(ge=0.01, le=0.5)] = 0.05
    law: LawName = "eso-mpc"
    estimator: Estimator = Estimator()
    guidance: Guidance = Guidance()
    mpc: Mpc = Mpc()
    backstepping: Backstepping = Backstepping()
    pid: Pid = Pid()
    lqr: Lqr = Lqr()
    sliding_mode: SlidingMode = SlidingMode()
    fuzzy: Fuzzy = Fuzzy()
    adaptive_nn: AdaptiveNn = AdaptiveNn()


class Island(Section):
    """A round island: its foot stands on the floor, its head out of the water."""

    position_m: Vec2
    radius_m: Positive


class Camera(Section):
    """The overhead camera: OpenCV's pinhole model with distortion, in air above flat water. The image's x runs along
    `rotation_rad` = 0 with the pool's x, its y with the pool's y. Pixel (0, 0) is the CENTRE of the first pixel."""

    size_px: tuple[Annotated[int, Field(ge=64, le=8192)], Annotated[int, Field(ge=64, le=8192)]]
    rate_hz: Annotated[float, Field(ge=1, le=240)]
    exposure_s: Annotated[float, Field(gt=0, le=0.05)]
    stamp_marks: Literal["start", "end"] = "end"  # of the exposure: what the camera driver's time stamps tell
    focal_px: tuple[Positive, Positive]
    centre_px: Vec2
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    position_m: Vec3
    rotation_rad: Vec3 = (0.0, 0.0, 0.0)
    water_index: Annotated[float, Field(ge=1, le=2)] = 1.333

    @model_validator(mode="after")
    def _above_water(self) -> Self:
        if self.position_m[2] >= 0:
            raise ValueError(f"position_m z = {self.position_m[2]}: the camera must hang above the water (z < 0)")
        return self


class CameraFile(Section):
    """A file that `localizer calibrate` wrote: an experiment names it as `camera = "lab.toml"`."""

    camera: Camera


class Landmark(Section):
    """A marker (ArUco, DICT_4X4_50) that lies flat and still where its place is known: on the rim (z <= 0) or on the floor.
    Its upper edge points along `yaw_rad`, as a robot's does."""

    id: Annotated[int, Field(ge=0, le=49)]
    position_m: Vec3
    yaw_rad: float = 0.0
    side_m: Positive = 0.2


class Localizer(Section):
    """How the localizer tracks."""

    markers: bool = True
    template_px: Annotated[int, Field(ge=16, le=128)] = 48
    min_peak: Fraction = 0.3
    lost_after_s: Positive = 0.7
    frozen_frames: Annotated[int, Field(ge=2)] = 5
    depth_sigma_m: Positive = 0.015  # of reported depths: mostly their zero. 1 hPa of air pressure and 5 deg of trim are 1 cm
    preview_rate_hz: NotNegative = 5.0
    obstacle_min_m: NotNegative = 0.08  # what covers less than a square of this side is no obstacle; 0: none are looked for


class Picture(Section):
    """What the simulated camera sees besides robots."""

    noise: NotNegative = 2.0  # standard deviation at mid grey, in grey levels of 255
    ripples_m: NotNegative = 0.0015  # height of the surface waves
    caustics: Fraction = 0.25
    glare: Fraction = 0.3
    vignetting: Fraction = 0.15
    shadows: bool = True
    alike: bool = False  # robots in one paint and without numbers; else each has a shade of its own


class Sensors(Section):
    """What the simulated thruster board measures: one standard deviation of noise, and biases drawn per robot."""

    rate_hz: Annotated[float, Field(ge=5, le=400)] = 50.0
    gyro_noise_radps: NotNegative = 0.003
    gyro_bias_radps: NotNegative = 0.002
    heading_noise_rad: NotNegative = 0.01
    heading_bias_rad: NotNegative = 0.03
    pressure_noise_m: NotNegative = 0.002
    pressure_bias_m: NotNegative = 0.003
    battery_v: Positive = 12.4
    battery_noise_v: NotNegative = 0.02
    battery_sag_v: NotNegative = 0.5  # with all thrusters at full thrust


class BoardRules(Section):
    """How the thruster board protects the robot (docs/board.md). A firmware has the same values built in."""

    neutral_after_s: Annotated[float, Field(gt=0, le=0.3)] = 0.25  # age of the last override; then neutral, disarmed
    slew_us_per_s: Positive = 8000.0  # full reverse to full ahead in 0.1 s, a thruster's own time constant


class Numeric(Section):
    """What stands for the camera and the localizer in a numeric flight: the true pose with this noise, sim.latency_s old."""

    pose_noise_m: NotNegative = 0.0  # one standard deviation, x and y each
    yaw_noise_rad: NotNegative = 0.0
    obstacle_noise_m: NotNegative = 0.01  # of sim.drifters
    obstacle_noise_mps: NotNegative = 0.01


class CameraMotion(Section):
    """How the simulated camera moves about [camera]'s pose, as under a hovering drone. Nobody else knows: who wants poses from
    a camera that moves lays out [[landmarks]]."""

    sway_m: NotNegative = 0.0  # largest deviation along each axis
    tilt_rad: NotNegative = 0.0  # largest turn about each axis
    period_s: Positive = 8.0  # of the slowest swing

    @property
    def moves(self) -> bool:
        """Whether there is any motion at all."""
        return self.sway_m > 0.0 or self.tilt_rad > 0.0


class Drifter(Section):
    """A red ball adrift in the simulated pool. Nobody is told of it: the camera has to see it, and no robot bounces off it."""

    radius_m: Positive = 0.1
    start_m: Vec3  # where it is at from_s
    velocity_mps: Vec3 = (0.0, 0.0, 0.0)
    from_s: NotNegative = 0.0  # when it comes into the water

    def place_m(self, time_s: float) -> Array | None:
        """Its middle, (3,); None before it comes."""
        since_s = time_s - self.from_s
        return np.array(self.start_m) + since_s * np.array(self.velocity_mps) if since_s >= 0.0 else None


class Sim(Section):
    """Everything that only the simulator reads."""

    # lockstep and numeric flights: from the middle of an exposure to the control step
    latency_s: Annotated[float, Field(ge=0, le=0.5)] = 0.03
    numeric: Numeric = Numeric()
    plant: Plant = Plant()
    faults: tuple[Fault, ...] = ()
    picture: Picture = Picture()
    camera_motion: CameraMotion = CameraMotion()
    drifters: tuple[Drifter, ...] = ()
    sensors: Sensors = Sensors()
    board: BoardRules = BoardRules()


class ArticleRow(Section):
    """A row of the article's result table: tracking of robot "1", or formation of the pair "1-2"."""

    subject: str
    rms_m: tuple[float, ...] = ()
    rms_yaw_rad: float | None = None
    max_m: tuple[float, ...] = ()


class Limit(Section):
    """Largest values for a run that passes; checked against the plant's truth after the run."""

    rms_m: Positive | None = None
    rms_after_20s_m: Positive | None = None
    rms_yaw_after_20s_rad: Positive | None = None  # to the path's tangent
    max_after_20s_m: Positive | None = None
    arrived_m: Positive | None = None  # each robot from its last reference, horizontally, at the end of the run
    pose_rms_m: Positive | None = None
    wrench_step_rms: Fraction | None = None  # after 20 s: RMS of the inputs' change per step, as a fraction of its bound
    exposure_to_pwm_p99_ms: Positive | None = None


class Experiment(Section):
    """The whole file."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]*$")]
    title: str = ""
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 1
    duration_s: Annotated[float, Field(gt=0, le=36000)]
    vehicle: Vehicle
    pool: Pool
    path: PathSpec
    formation: Formation = Formation()
    robots: Annotated[tuple[Robot, ...], Field(min_length=1, max_length=49)]
    islands: tuple[Island, ...] = ()
    safety: Safety = Safety()
    controller: Controller = Controller()
    camera: Camera
    landmarks: tuple[Landmark, ...] = ()  # with any, the camera is taken to move
    localizer: Localizer = Localizer()
    sim: Sim = Sim()
    limits: Limit = Limit()
    article: tuple[ArticleRow, ...] = ()

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
        hz = self.sim.plant.disturbance_hz
        if isinstance(hz, tuple) and len(hz) != len(ids):
            raise ValueError(f"sim.plant.disturbance_hz: {len(hz)} values for {len(ids)} robots (allowed: one, or one each)")
        return self

    @model_validator(mode="after")
    def _faults_meet_something(self) -> Self:
        processes = ("groundstation", "sim-bridge", "localizer", *(f"agent-{robot}" for robot in self.robot_ids))
        for i, fault in enumerate(self.sim.faults):
            broken, allowed = fault.broken, ", ".join(map(str, self.robot_ids))
            if broken.robot and broken.robot not in self.robot_ids:
                raise ValueError(f"sim.faults.{i}.what = {fault.what!r}: no robot {broken.robot} (allowed: {allowed})")
            if broken.process and broken.process not in processes:
                raise ValueError(f"sim.faults.{i}.what = {fault.what!r}: no such process (allowed: {', '.join(processes)})")
        return self

    @model_validator(mode="after")
    def _landmarks_can_be_told_apart(self) -> Self:
        ids = [landmark.id for landmark in self.landmarks]
        if 0 < len(ids) < LANDMARKS_NEEDED:
            raise ValueError(f"landmarks: {len(ids)} cannot place a camera (allowed: none, or {LANDMARKS_NEEDED} and more)")
        for landmark in self.landmarks:
            if ids.count(landmark.id) > 1:
                raise ValueError(f"landmarks: id {landmark.id} is used twice; each landmark needs its own")
            for robot in self.robots:
                if robot.marker == landmark.id:
                    free = sorted(set(range(50)) - set(ids) - {r.marker for r in self.robots})
                    raise ValueError(
                        f"landmarks: id {landmark.id} is the marker of robot {robot.id} (free: {', '.join(map(str, free))})"
                    )
            depth, floor = landmark.position_m[2], self.pool.size_m[2]
            if depth > floor:
                raise ValueError(f"landmarks: id {landmark.id} at z = {depth} lies below the floor (allowed: up to {floor})")
        return self

    @property
    def robot_ids(self) -> tuple[int, ...]:
        """Ids of all robots, in the file's order."""
        return tuple(robot.id for robot in self.robots)

    def robot(self, robot_id: int) -> Robot:
        """The robot of that id. Raises ConfigError naming the ids there are."""
        for robot in self.robots:
            if robot.id == robot_id:
                return robot
        allowed = ", ".join(str(i) for i in self.robot_ids)
        raise ConfigError(f"robot {robot_id}: not in experiment {self.name!r} (allowed: {allowed})")

    def leader_of(self, robot_id: int) -> int | None:
        """Whom a robot follows instead of its own node; None if nobody."""
        leader = self.robot_ids[0] if self.formation.leader is None else self.formation.leader
        return leader if self.formation.kind == "leader-follower" and leader != robot_id else None

    def path_of(self, robot: Robot) -> PathSpec:
        """The path whose node that robot is on."""
        return self.path if robot.path is None else robot.path

    def nodes_m(self) -> Array:
        """Formation nodes from the virtual centre, shape (robots, 3), scaled by L = l I (15)."""
        return self.formation.scale * np.array([robot.node_m for robot in self.robots])

    @cached_property
    def hash(self) -> str:
        """SHA-256 (hex) over every value of the experiment and its vehicle, defaults included."""
        text = json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()


def dump_experiment(experiment: Experiment) -> str:
    """The whole experiment as TOML, vehicle and defaults included: loading it gives the same hash."""
    return tomli_w.dumps(experiment.model_dump(mode="json", exclude_none=True))


def experiment_path(name_or_path: str) -> Path:
    """Where an experiment lies: a shipped name (`pool`) or a path ending in .toml. Raises ConfigError."""
    if name_or_path.endswith(".toml"):
        return Path(name_or_path)
    path = EXPERIMENTS / f"{name_or_path}.toml"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in EXPERIMENTS.glob("*.toml")))
        raise ConfigError(f"experiment {name_or_path!r}: no such experiment (allowed: {known}, or a path ending in .toml)")
    return path


def load_experiment(name_or_path: str, settings: Sequence[str] = (), faults: Sequence[str] = ()) -> Experiment:
    """Load and check an experiment, with `--set key=value` settings laid over it and `--fault` lines added to its own. Raises
    ConfigError."""
    path = experiment_path(name_or_path)
    table: dict[str, Any] = read_toml(path)
    _insert_files(table, path)
    for setting in settings:
        apply_setting(table, setting)
        _insert_files(table, path)
    _insert_nodes(table)
    sim = table.setdefault("sim", {}) if faults else None
    if isinstance(sim, dict) and isinstance(sim.setdefault("faults", []), list):
        sim["faults"] += map(fault_table, faults)
    return check(Experiment, table, str(path))


def _insert_files(table: dict[str, Any], experiment: Path) -> None:
    """Put vehicle and camera in the place of their files' names, so that settings reach into them and the hash covers them.

    A table may name a file as `like` and say only what is different: `vehicle = { like = "spherical", radius_m = 0.2 }`.
    """
    for key, load in (("vehicle", load_vehicle), ("camera", load_camera)):
        given = table.get(key)
        name = given.get("like") if isinstance(given, dict) else given
        if not isinstance(name, str):
            continue
        try:
            table[key] = load(name, experiment.parent).model_dump(mode="json")
        except ConfigError as error:
            raise ConfigError("\n".join(f"{experiment}: {line}" for line in str(error).splitlines())) from None
        if isinstance(given, dict):
            _lay_over(table[key], {k: value for k, value in given.items() if k != "like"})


def _insert_nodes(table: dict[str, Any]) -> None:
    """Give the robots that have no node one of the formation's shape, in the file's order."""
    formation, robots = table.get("formation"), table.get("robots")
    if not (isinstance(formation, dict) and isinstance(robots, list)) or formation.get("shape") not in SHAPES:
        return
    spacing_m = formation.get("spacing_m", Formation.model_fields["spacing_m"].default)
    if isinstance(spacing_m, int | float) and 0.0 < spacing_m < math.inf:
        for robot, node in zip(robots, shape_nodes(formation["shape"], len(robots), spacing_m).tolist(), strict=True):
            if isinstance(robot, dict):
                robot.setdefault("node_m", node)


def _lay_over(table: dict[str, Any], changes: dict[str, Any]) -> None:
    """Write `changes` into `table`, in place; tables within tables likewise."""
    for key, value in changes.items():
        if isinstance(value, dict) and isinstance(table.get(key), dict):
            _lay_over(table[key], value)
        else:
            table[key] = value


def load_camera(path: str, relative_to: Path | None = None) -> Camera:
    """The camera of a calibration's file. Raises ConfigError."""
    if not path.endswith(".toml"):
        raise ConfigError(f"camera = {path!r}: must be a table, or a path ending in .toml (as `localizer calibrate` writes)")
    place = (relative_to or Path()) / path
    return check(CameraFile, read_toml(place), str(place)).camera

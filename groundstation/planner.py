"""From an experiment to one trajectory per robot, refused when a robot could not fly it or should not.

trajectories = plan(experiment)                     # raises PlanError, one line per problem
starts = start_poses(experiment, trajectories)      # where each robot is put into the water
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from groundstation.formation import Course, NodeMotion, courses, node_motion
from groundstation.pace import slowed
from groundstation.spline import Path, make_path
from groundstation.way import ways
from wire.codec import MAX_MESSAGE_BYTES
from wire.experiment import Experiment
from wire.frames import Array
from wire.messages import Trajectory
from wire.scene import PathSpec, Robot, Route
from wire.toml_file import ConfigError
from wire.vehicle import Vehicle

TOLERANCE = 1e-9  # rounding: a plan exactly at a limit is allowed
BYTES_PER_SAMPLE = 3 * 4 * 8


class PlanError(ConfigError):
    """A plan that must not be flown. One line per problem: robot, time, place, by how much."""


@dataclass(frozen=True)
class _Worst:
    """The sample at which a quantity exceeds its limit most."""

    index: int
    value: float


def plan(experiment: Experiment) -> dict[int, Trajectory]:
    """Each robot's trajectory: samples every controller period from 0 to the run's end, and a controller's horizon more.

    Raises PlanError if a robot would exceed its speed, heave, yaw-rate or thrust limits (with `path.slow` only if slowing
    down does not help), touch a wall, floor or surface, or come closer than 2 R (36) to another on the same path. Those on
    different paths need to be apart at the end only: on the way they give way to one another.
    """
    period_s = experiment.controller.period_s
    flown = round(experiment.duration_s / period_s) + 1
    samples = flown + experiment.controller.mpc.horizon
    if samples * BYTES_PER_SAMPLE > MAX_MESSAGE_BYTES - 1024:
        longest = (MAX_MESSAGE_BYTES - 1024) // BYTES_PER_SAMPLE * period_s
        raise PlanError(f"duration_s = {experiment.duration_s:g}: a trajectory message holds {longest:.0f} s")
    paths = [experiment.path_of(robot) for robot in experiment.robots]
    motions: dict[int, NodeMotion] = {}
    for k, path in enumerate(paths):
        if path not in paths[:k]:
            group = [robot for robot, flies in zip(experiment.robots, paths, strict=True) if flies == path]
            motions.update(_flown(experiment, path, group, samples))
    motions = {robot: motions[robot] for robot in experiment.robot_ids}
    problems = [*_robot_problems(experiment, motions, flown), *_pair_problems(experiment, motions, flown)]
    if problems:
        raise PlanError("\n".join(problems))
    return {robot: _trajectory(motion, period_s) for robot, motion in motions.items()}


def start_poses(experiment: Experiment, trajectories: Mapping[int, Trajectory]) -> dict[int, Array]:
    """Pose (4,) in which each robot begins: its `start`, else its first reference plus `start_offset`.

    Raises PlanError if a robot would begin in a wall or in another robot.
    """
    starts = {
        robot.id: np.array(robot.start)
        if robot.start is not None
        else trajectories[robot.id].eta[0] + np.array(robot.start_offset)
        for robot in experiment.robots
    }
    problems = []
    for robot, eta in starts.items():
        for what, excess in _outside(experiment, eta[None, :3]).items():
            if excess[0] > TOLERANCE:
                problems.append(f"robot {robot} starts at {_place(eta)}: {excess[0]:.3f} m beyond {what}")
    for a, b in combinations(sorted(starts), 2):
        distance = float(np.linalg.norm(starts[a][:3] - starts[b][:3]))
        if distance < 2.0 * experiment.vehicle.radius_m - TOLERANCE:
            problems.append(f"robots {a} and {b} start {distance:.3f} m apart: less than twice their radius")
    if problems:
        raise PlanError("\n".join(problems))
    return starts


def starts_json(starts: Mapping[int, Array]) -> str:
    """Start poses as JSON `{"1": [x_m, y_m, z_m, yaw_rad], ...}`, for whoever puts the robots into the water."""
    return json.dumps({str(robot): starts[robot].tolist() for robot in sorted(starts)}, indent=1) + "\n"


def _flown(experiment: Experiment, given: PathSpec, group: Sequence[Robot], samples: int) -> dict[int, NodeMotion]:
    """The motion of the robots on a path, at `samples` control periods from 0 on; slower than it says if they could not."""
    period_s, formation = experiment.controller.period_s, experiment.formation
    time_s = period_s * np.arange(samples, dtype=np.float64)
    nodes = courses(formation.scale * np.array([robot.node_m for robot in group]), formation.changes, time_s)
    path = _path(experiment, given, group, nodes)
    if given.slow:

        def too_fast(slower: Path) -> Array:
            return _too_fast(experiment, _motions(experiment, slower, group, nodes))

        path = slowed(path, too_fast, samples, period_s)
    if experiment.duration_s > path.end_s + period_s:
        raise PlanError(f"duration_s = {experiment.duration_s:g}: the path ends after {path.end_s:.2f} s")
    return _motions(experiment, path, group, nodes)


def _path(experiment: Experiment, given: PathSpec, group: Sequence[Robot], nodes: Sequence[Course]) -> Path:
    """The centre's path; of a route the first way on which no node touches anything."""
    try:
        if not isinstance(given, Route):
            return make_path(given)
        for way in ways(experiment, given, nodes):
            path = make_path(way)
            motions = _motions(experiment, path, group, nodes).values()
            beyond = (excess.max() for m in motions for excess in _outside(experiment, m.eta[:, :3]).values())
            if max(beyond, default=0.0) <= TOLERANCE:
                break
        return path  # if none is clear, the last: the planner then says where it touches
    except ValueError as error:
        raise PlanError(str(error)) from None


def _motions(experiment: Experiment, path: Path, group: Sequence[Robot], nodes: Sequence[Course]) -> dict[int, NodeMotion]:
    period_s = experiment.controller.period_s
    centre = path.at(np.arange(len(nodes[0].place_m), dtype=np.float64) * period_s)
    return {
        robot.id: node_motion(centre, node, experiment.formation.mode, period_s)
        for robot, node in zip(group, nodes, strict=True)
    }


def _trajectory(motion: NodeMotion, period_s: float) -> Trajectory:
    digest = hashlib.sha256(np.float64(period_s).tobytes())
    for array in (motion.eta, motion.velocity, motion.acceleration):
        digest.update(np.ascontiguousarray(array).tobytes())
    return Trajectory(digest.hexdigest()[:12], period_s, motion.eta, motion.velocity, motion.acceleration)


def _limited(vehicle: Vehicle, motion: NodeMotion) -> Iterator[tuple[str, str, int, float, Array]]:
    """What a motion takes and what there is: name, unit, power of the pace it grows with, limit, values (n,)."""
    limits, v = vehicle.limits, motion.velocity
    speed = np.hypot(v[:, 0], v[:, 1])
    yield "speed", "m/s", 1, limits.speed_mps, speed
    yield "heave", "m/s", 1, limits.heave_mps, np.abs(v[:, 2])
    yield "yaw rate", "rad/s", 1, limits.yaw_rate_radps, np.abs(v[:, 3])
    flow = np.column_stack([speed, speed, np.abs(v[:, 2]), np.abs(v[:, 3])])
    force = vehicle.inertia * motion.acceleration + (vehicle.drag_linear + vehicle.drag_quadratic * flow) * v
    surge_n, heave_n, yaw_nm = limits.wrench
    # no side thruster: in a bend the robot turns inwards until surge gives the side force too
    yield "thrust", "N", 2, surge_n, np.hypot(force[:, 0], force[:, 1])
    yield "heave thrust", "N", 2, heave_n, np.abs(force[:, 2])
    yield "yaw moment", "N m", 2, yaw_nm, np.abs(force[:, 3])


def _too_fast(experiment: Experiment, motions: Mapping[int, NodeMotion]) -> Array:
    """By what factor the worst robot should be slower, at each sample (n,); 1 is at its limit."""
    limited = (entry for motion in motions.values() for entry in _limited(experiment.vehicle, motion))
    return np.asarray(np.max([(value / limit) ** (1.0 / power) for _, _, power, limit, value in limited], axis=0))


def _robot_problems(experiment: Experiment, motions: Mapping[int, NodeMotion], flown: int) -> Iterator[str]:
    for robot, motion in motions.items():
        eta = motion.eta[:flown]
        for what, unit, _, limit, values in _limited(experiment.vehicle, motion):
            worst = _worst(values[:flown], limit)
            if worst is not None:
                over = f"{what} {worst.value:.3f} {unit} exceeds the limit {limit:g} by {worst.value - limit:.3f}"
                yield f"robot {robot}: {over} {_moment(experiment, worst.index, eta[worst.index])}"
        for what, excess in _outside(experiment, eta[:, :3]).items():
            worst = _worst(excess, 0.0)
            if worst is not None:
                yield f"robot {robot}: {worst.value:.3f} m beyond {what} {_moment(experiment, worst.index, eta[worst.index])}"


def _pair_problems(experiment: Experiment, motions: Mapping[int, NodeMotion], flown: int) -> Iterator[str]:
    closest_m = 2.0 * experiment.safety.radius_m
    for a, b in combinations(sorted(motions), 2):
        together = experiment.path_of(experiment.robot(a)) == experiment.path_of(experiment.robot(b))
        counts = slice(flown) if together else slice(flown - 1, flown)
        apart = np.full(flown, np.inf)
        apart[counts] = np.linalg.norm(motions[a].eta[counts, :3] - motions[b].eta[counts, :3], axis=1)
        index = int(np.argmin(apart))
        if apart[index] < closest_m - TOLERANCE:
            short = f"{apart[index]:.3f} m apart, {closest_m - apart[index]:.3f} less than 2 safety.radius_m = {closest_m:g}"
            yield f"robots {a} and {b}: {short} {_moment(experiment, index, motions[a].eta[index])}"


def _outside(experiment: Experiment, position_m: Array) -> dict[str, Array]:
    """How far (n,) positions (n, 3) lie beyond where a robot's hull is clear of islands and each side of the basin, in m.

    At the surface the centre counts, not the hull: a robot may float. Open water has no sides.
    """
    radius = experiment.vehicle.radius_m
    x, y, z = position_m.T
    beyond = {}
    for i, island in enumerate(experiment.islands, 1):
        shore_m = np.hypot(x - island.position_m[0], y - island.position_m[1]) - island.radius_m
        beyond[f"the clearance of island {i}"] = radius - shore_m
    if experiment.sim.plant.walls:
        length, width, depth = experiment.pool.size_m
        beyond |= {
            "the wall's clearance in x": np.abs(x) + radius - length / 2.0,
            "the wall's clearance in y": np.abs(y) + radius - width / 2.0,
            "the floor's clearance": z + radius - depth,
            "the surface": -z,
        }
    return beyond


def _worst(values: Array, limit: float) -> _Worst | None:
    index = int(np.argmax(values))
    return _Worst(index, float(values[index])) if values[index] > limit + TOLERANCE else None


def _moment(experiment: Experiment, index: int, eta: Array) -> str:
    return f"at t = {index * experiment.controller.period_s:.2f} s, {_place(eta)}"


def _place(eta: Array) -> str:
    return f"({eta[0]:.2f}, {eta[1]:.2f}, {eta[2]:.2f}) m"

"""From an experiment to one trajectory per robot, refused when a robot could not fly it or should not.

trajectories = plan(experiment)                     # raises PlanError, one line per problem
starts = start_poses(experiment, trajectories)      # where each robot is put into the water
"""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from groundstation.formation import NodeMotion, node_motion
from groundstation.spline import make_path
from wire.codec import MAX_MESSAGE_BYTES
from wire.experiment import Experiment
from wire.frames import Array
from wire.messages import Trajectory
from wire.toml_file import ConfigError

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

    Raises PlanError if a robot would exceed its speed, heave or yaw-rate limit, touch a wall, floor or surface, or come
    closer than 2 R (36) to another.
    """
    period_s = experiment.controller.period_s
    flown = round(experiment.duration_s / period_s) + 1
    samples = flown + experiment.controller.mpc.horizon
    if samples * BYTES_PER_SAMPLE > MAX_MESSAGE_BYTES - 1024:
        longest = (MAX_MESSAGE_BYTES - 1024) // BYTES_PER_SAMPLE * period_s
        raise PlanError(f"duration_s = {experiment.duration_s:g}: a trajectory message holds {longest:.0f} s")
    try:
        path = make_path(experiment.path)
    except ValueError as error:
        raise PlanError(str(error)) from None
    if experiment.duration_s > path.end_s + period_s:
        raise PlanError(f"duration_s = {experiment.duration_s:g}: the path ends after {path.end_s:.2f} s")
    centre = path.at(np.arange(samples, dtype=np.float64) * period_s)
    motions = {
        robot.id: node_motion(centre, node_m, experiment.formation.mode, period_s)
        for robot, node_m in zip(experiment.robots, experiment.nodes_m(), strict=True)
    }
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


def _trajectory(motion: NodeMotion, period_s: float) -> Trajectory:
    digest = hashlib.sha256(np.float64(period_s).tobytes())
    for array in (motion.eta, motion.velocity, motion.acceleration):
        digest.update(np.ascontiguousarray(array).tobytes())
    return Trajectory(digest.hexdigest()[:12], period_s, motion.eta, motion.velocity, motion.acceleration)


def _robot_problems(experiment: Experiment, motions: Mapping[int, NodeMotion], flown: int) -> Iterator[str]:
    limits = experiment.vehicle.limits
    measures: tuple[tuple[str, str, float, Callable[[Array], Array]], ...] = (
        ("speed", "m/s", limits.speed_mps, lambda v: np.hypot(v[:, 0], v[:, 1])),
        ("heave", "m/s", limits.heave_mps, lambda v: np.abs(v[:, 2])),
        ("yaw rate", "rad/s", limits.yaw_rate_radps, lambda v: np.abs(v[:, 3])),
    )
    for robot, motion in motions.items():
        eta, velocity = motion.eta[:flown], motion.velocity[:flown]
        for what, unit, limit, measure in measures:
            worst = _worst(measure(velocity), limit)
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
        apart = np.linalg.norm(motions[a].eta[:flown, :3] - motions[b].eta[:flown, :3], axis=1)
        index = int(np.argmin(apart))
        if apart[index] < closest_m - TOLERANCE:
            short = f"{apart[index]:.3f} m apart, {closest_m - apart[index]:.3f} less than 2 safety.radius_m = {closest_m:g}"
            yield f"robots {a} and {b}: {short} {_moment(experiment, index, motions[a].eta[index])}"


def _outside(experiment: Experiment, position_m: Array) -> dict[str, Array]:
    """How far (n,) positions (n, 3) lie beyond where a robot's hull is clear of each side of the basin, in m.

    At the surface the centre counts, not the hull: a robot may float. Open water has no sides.
    """
    if not experiment.sim.plant.walls:
        return {}
    radius = experiment.vehicle.radius_m
    length, width, depth = experiment.pool.size_m
    x, y, z = position_m.T
    return {
        "the wall's clearance in x": np.abs(x) + radius - length / 2.0,
        "the wall's clearance in y": np.abs(y) + radius - width / 2.0,
        "the floor's clearance": z + radius - depth,
        "the surface": -z,
    }


def _worst(values: Array, limit: float) -> _Worst | None:
    index = int(np.argmax(values))
    return _Worst(index, float(values[index])) if values[index] > limit + TOLERANCE else None


def _moment(experiment: Experiment, index: int, eta: Array) -> str:
    return f"at t = {index * experiment.controller.period_s:.2f} s, {_place(eta)}"


def _place(eta: Array) -> str:
    return f"({eta[0]:.2f}, {eta[1]:.2f}, {eta[2]:.2f}) m"

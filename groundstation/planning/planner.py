"""From an experiment to one trajectory per robot, refused when a robot could not fly it or should not.

trajectories = plan(experiment)                     # raises PlanError, one line per problem
starts = start_poses(experiment, trajectories)      # where each robot is put into the water
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from groundstation.planning.feasibility import (
    TOLERANCE,
    OutOfTime,
    PlanError,
    PlanFigure,
    check_time,
    figures,
    never,
    outside,
    pair_problems,
    place,
    required_slowdown,
    robot_problems,
)
from groundstation.planning.formation import NodeMotion, SlotOffset, node_motion, slot_offsets
from groundstation.planning.paths import Path, PathState
from groundstation.planning.route_planner import candidate_routes
from groundstation.planning.straight_sides import make_path
from groundstation.planning.time_scaling import scale_time
from shoal.config.experiment import Experiment
from shoal.config.scene import Circle, PathSpec, RobotConfig, Route
from shoal.frames import Array
from shoal.messages.codec import MAX_MESSAGE_BYTES
from shoal.messages.messages import Trajectory

BYTES_PER_SAMPLE = 3 * 4 * 8
MOST_SAMPLES = (MAX_MESSAGE_BYTES - 1024) // BYTES_PER_SAMPLE  # of a trajectory: more are no message


@dataclass(frozen=True, eq=False)
class FleetPlan:
    """Trajectory of each robot, and of the formation's centre, which no robot flies."""

    trajectories: dict[int, Trajectory]
    centre: Trajectory
    flown: PlanFigure  # share of the centre's path that the run flies; not finite for a path that has no end


def plan(experiment: Experiment) -> dict[int, Trajectory]:
    """Each robot's trajectory; see `plan_fleet`."""
    return plan_fleet(experiment).trajectories


def plan_fleet(experiment: Experiment, out_of_time: OutOfTime = never) -> FleetPlan:
    """Each robot's trajectory: samples every controller period from 0 to the run's end, and a controller's horizon more.
    Raises PlanError with the problems of `draft`."""
    drafted, problems = draft(experiment, out_of_time)
    if problems:
        raise PlanError("\n".join(problems))
    return drafted


def draft(experiment: Experiment, out_of_time: OutOfTime = never) -> tuple[FleetPlan, list[str]]:
    """A plan, and every reason for which it must not be flown.

    A reason is that a robot would exceed its speed, heave, yaw-rate or thrust limits (with `path.slow` only if slowing
    down does not help), touch a wall, floor or surface, or come closer than 2 R (36) to another on the same path. Those on
    different paths need to be apart at the end only: in flight they give way to one another. Raises PlanError where there is
    no such path at all, it ends before the run, or `out_of_time`.
    """
    period_s = experiment.controller.period_s
    count = round(experiment.duration_s / period_s) + 1
    samples = count + horizon(experiment)
    if samples > MOST_SAMPLES:
        longest_s = MOST_SAMPLES * period_s
        raise PlanError(f"duration_s = {experiment.duration_s:g}: a trajectory message holds {longest_s:.0f} s")
    paths = [experiment.path_of(robot) for robot in experiment.robots]
    motions: dict[int, NodeMotion] = {}
    centre: NodeMotion | None = None
    share = PlanFigure("path flown", "%", np.nan, 100.0)
    for k, path in enumerate(paths):
        if path not in paths[:k]:
            group = [robot for robot, flies in zip(experiment.robots, paths, strict=True) if flies == path]
            group_motions, middle, flown = _group_motions(experiment, path, group, samples, out_of_time)
            motions.update(group_motions)
            if centre is None or path == experiment.path:
                centre, share = middle, replace(share, value=100.0 * flown, least=not isinstance(path, Circle) and path.stop)
    motions = {robot: motions[robot] for robot in experiment.robot_ids}
    problems = [
        *robot_problems(experiment, motions, count, out_of_time=out_of_time),
        *pair_problems(experiment, motions, count, out_of_time=out_of_time),
    ]
    assert centre is not None  # there is at least one robot
    trajectories = {robot: trajectory(motion, period_s) for robot, motion in motions.items()}
    return FleetPlan(trajectories, trajectory(centre, period_s), share), problems


def description(experiment: Experiment) -> list[str]:
    """Lines that describe the plan before it is flown: starts, clearances, speeds and forces. Raises PlanError."""
    planned = plan_fleet(experiment)
    starts = start_poses(experiment, planned.trajectories)
    lines = [
        f"robot {robot} starts at x {x_m:.2f}, y {y_m:.2f}, z {z_m:.2f} m, yaw {yaw_rad:.2f} rad"
        for robot, (x_m, y_m, z_m, yaw_rad) in starts.items()
    ]
    count = round(experiment.duration_s / experiment.controller.period_s) + 1
    return lines + [str(figure) for figure in plan_figures(experiment, planned, count)]


def plan_figures(experiment: Experiment, planned: FleetPlan, count: int) -> list[PlanFigure]:
    """The share of the path that the run flies, where it has an end, and the figures of the robots' first `count` samples."""
    share = [planned.flown] if np.isfinite(planned.flown.value) else []
    return share + figures(experiment, planned.trajectories, count)


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
        for what, excess in outside(experiment, eta[None, :3]).items():
            if excess[0] > TOLERANCE:
                problems.append(f"robot {robot} starts at {place(eta)}: {excess[0]:.3f} m beyond {what}")
    for a, b in combinations(sorted(starts), 2):
        distance = float(np.linalg.norm(starts[a][:3] - starts[b][:3]))
        if distance < 2.0 * experiment.vehicle.radius_m - TOLERANCE:
            problems.append(f"robots {a} and {b} start {distance:.3f} m apart: less than twice their radius")
    if problems:
        raise PlanError("\n".join(problems))
    return starts


def _group_motions(
    experiment: Experiment, spec: PathSpec, group: Sequence[RobotConfig], samples: int, out_of_time: OutOfTime
) -> tuple[dict[int, NodeMotion], NodeMotion, float]:
    """Motion of the robots on a path, and of its centre, at `samples` control periods from 0 on, slowed down where the robots
    could not follow; and the share of the path that they fly in the experiment's time."""
    period_s, formation = experiment.controller.period_s, experiment.formation
    time_s = period_s * np.arange(samples, dtype=np.float64)
    ids = [robot.id for robot in group]
    nodes = slot_offsets(formation.scale * np.array([robot.node_m for robot in group]), formation.changes, time_s, ids)
    path = centre_path(experiment, spec, group, nodes, out_of_time)
    if spec.slow:

        def _excess(slower: Path) -> Array:
            check_time(out_of_time)
            return required_slowdown(experiment, node_motions(experiment, slower.at(time_s), group, nodes))

        path = scale_time(path, _excess, samples, period_s)
    if experiment.duration_s > path.end_s + period_s:
        raise PlanError(_path_too_short(experiment, path, group, nodes, time_s))
    centre = path.at(time_s)
    middle = node_motion(centre, at_centre(samples), "translate", period_s)
    return node_motions(experiment, centre, group, nodes), middle, path.share_at(experiment.duration_s)


def _path_too_short(
    experiment: Experiment, path: Path, group: Sequence[RobotConfig], nodes: Sequence[SlotOffset], time_s: Array
) -> str:
    """The reason to refuse a path that ends before the experiment. Robots that cannot follow it come first: a path that is
    flown too fast is over too soon."""
    before_s = time_s[: max(int(np.count_nonzero(time_s <= path.end_s)), 2)]
    steps = len(before_s)
    short = [SlotOffset(node.place_m[:steps], node.rate_mps[:steps], node.bend_mps2[:steps]) for node in nodes]
    problems = robot_problems(experiment, node_motions(experiment, path.at(before_s), group, short), steps)
    return "\n".join([*problems, f"duration_s = {experiment.duration_s:g}: the path ends after {path.end_s:.2f} s"])


def centre_path(
    experiment: Experiment,
    spec: PathSpec,
    group: Sequence[RobotConfig],
    nodes: Sequence[SlotOffset],
    out_of_time: OutOfTime = never,
) -> Path:
    """Path of the centre; of a route the first candidate on which no node touches anything."""
    time_s = np.arange(len(nodes[0].place_m), dtype=np.float64) * experiment.controller.period_s
    try:
        if not isinstance(spec, Route):
            return make_path(spec)
        for waypoints in candidate_routes(experiment, spec, nodes, out_of_time):
            path = make_path(waypoints)
            motions = node_motions(experiment, path.at(time_s), group, nodes).values()
            beyond = (excess.max() for m in motions for excess in outside(experiment, m.eta[:, :3]).values())
            if max(beyond, default=0.0) <= TOLERANCE:
                break
        return path  # if none is clear, the last: the planner then says where it touches
    except ValueError as error:
        raise PlanError(str(error)) from None


def horizon(experiment: Experiment) -> int:
    """Samples of the controller's horizon, which a trajectory has beyond its end."""
    return experiment.controller.mpc.horizon


def at_centre(samples: int) -> SlotOffset:
    """Offset of a node at the centre, which no change of form moves."""
    return SlotOffset(np.zeros((samples, 3)), np.zeros((samples, 3)), np.zeros((samples, 3)))


def node_motions(
    experiment: Experiment, centre: PathState, group: Sequence[RobotConfig], nodes: Sequence[SlotOffset]
) -> dict[int, NodeMotion]:
    """Motions of the robots around the centre, sampled every control period."""
    mode, period_s = experiment.formation.mode, experiment.controller.period_s
    return {robot.id: node_motion(centre, node, mode, period_s) for robot, node in zip(group, nodes, strict=True)}


def trajectory(motion: NodeMotion, period_s: float, begin_s: float = 0.0) -> Trajectory:
    """Trajectory message of a motion; its id is a digest of its numbers. Raises PlanError for one that no message holds: a
    plan from a pause near the beginning of the longest run is longer than that run."""
    if len(motion.eta) > MOST_SAMPLES:
        longest_s = MOST_SAMPLES * period_s
        raise PlanError(f"it lasts {len(motion.eta) * period_s:.0f} s: a trajectory message holds {longest_s:.0f} s")
    digest = hashlib.sha256(np.array([period_s, begin_s]).tobytes())
    for array in (motion.eta, motion.velocity, motion.acceleration):
        digest.update(np.ascontiguousarray(array).tobytes())
    return Trajectory(digest.hexdigest()[:12], period_s, motion.eta, motion.velocity, motion.acceleration, begin_s)

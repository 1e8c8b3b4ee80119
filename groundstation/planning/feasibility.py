"""Feasibility of a plan: limits of the robots, walls, islands, distances between robots. Pure."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from groundstation.planning.formation import NodeMotion
from shoal.config.experiment import Experiment
from shoal.errors import ConfigError
from shoal.frames import Array, follows_velocity
from shoal.messages.camera_coverage import outside_m
from shoal.messages.messages import Trajectory

PICTURE_MARGIN_M = 0.05  # between hulls and the picture's edge: the tracking error of a well tracked robot
TOLERANCE = 1e-9  # rounding: a plan exactly at a limit is allowed


OutOfTime = Callable[[], bool]  # True when the caller waits no longer for a plan


class PlanError(ConfigError):
    """A plan that must not be flown. One line per problem: robot, time, place, by how much."""


def never() -> bool:
    """No limit of time: of a run that has to be the same each time."""
    return False


def check_time(out_of_time: OutOfTime) -> None:
    """Raise PlanError once the caller waits no longer. To be called between steps that take a tenth of a second at most."""
    if out_of_time():
        raise PlanError("none was found in time")


@dataclass(frozen=True)
class PlanFigure:
    """A plan's worst value of a quantity, over all robots, and what is allowed: at least, of a distance, else at most."""

    what: str
    unit: str
    value: float
    limit: float
    least: bool = False

    def __str__(self) -> str:
        allowed = "at least" if self.least else "at most"
        return f"{self.what} {self.value:.2f} {self.unit} ({allowed} {self.limit:.2f})"


@dataclass(frozen=True)
class _Worst:
    """The sample at which a quantity exceeds its limit most."""

    index: int
    value: float


def required_slowdown(experiment: Experiment, motions: Mapping[int, NodeMotion]) -> Array:
    """Factor (n,) by which the worst robot should be slower at each sample; 1 is at its limit."""
    limited = (entry for m in motions.values() for entry in experiment.vehicle.demands(m.velocity, m.acceleration))
    return np.asarray(np.max([(value / limit) ** (1.0 / power) for _, _, power, limit, value in limited], axis=0))


def figures(experiment: Experiment, trajectories: Mapping[int, Trajectory], count: int) -> list[PlanFigure]:
    """Clearances, speeds and forces of a plan in its first `count` samples; no distance where there is nothing to be near."""
    eta = {robot: t.eta[:count, :3] for robot, t in trajectories.items()}
    keep_m = 2.0 * experiment.safety.radius_m
    pairs = list(combinations(trajectories, 2))
    gives_way = [give_way(experiment, a, b) for a, b in pairs]
    apart_m = [
        np.linalg.norm(eta[a] - eta[b], axis=1)[-1 if late else 0 :] for (a, b), late in zip(pairs, gives_way, strict=True)
    ]
    nearest_m = min(apart_m, key=np.min, default=np.array([np.inf]))  # of the pair that comes nearest, over time
    least_m = float(nearest_m.min())
    begins_too_near = nearest_m[0] == least_m < keep_m - TOLERANCE
    moves_apart = nearest_m[-1] >= keep_m - TOLERANCE
    when = ", as they lie now" if begins_too_near and moves_apart else ""  # no plan can mend that
    when = when or (" at the end (before, robots give way)" if any(gives_way) else "")
    away_m = float(experiment.clearance_m(np.vstack(list(eta.values()))).min())
    listed = [
        PlanFigure(f"between centres{when}", "m", least_m, keep_m, True),
        PlanFigure("hulls to walls and islands", "m", away_m, 0.0, True),
    ]
    demands = [experiment.vehicle.demands(t.velocity[:count], t.acceleration[:count]) for t in trajectories.values()]
    for same_demand in zip(*demands, strict=True):  # one after the other, of all robots
        what, unit, _, limit, _ = same_demand[0]
        most = max(float(values.max()) for *_, values in same_demand)
        listed.append(PlanFigure(what, unit, most, limit))
    return [figure for figure in listed if np.isfinite(figure.value)]


def robot_problems(
    experiment: Experiment,
    motions: Mapping[int, NodeMotion],
    count: int,
    begin_s: float = 0.0,
    out_of_time: OutOfTime = never,
) -> Iterator[str]:
    """Lines for limits that robots would exceed, one a kind; the first sample is at `begin_s`. Walls and islands count in the
    first `count` samples. Behind those are the ones to which a controller looks ahead: robots ask that these, too, lie in the
    pool and can be flown (guidance/trajectory_check.py)."""
    for robot, motion in motions.items():
        check_time(out_of_time)
        eta = motion.eta[:count]
        for what, unit, _, limit, values in experiment.vehicle.demands(motion.velocity, motion.acceleration):
            worst = _worst(values[:count], limit) or _worst(values, limit)
            if worst is not None:
                over = f"{what} {worst.value:.3f} {unit} exceeds the limit {limit:g} by {worst.value - limit:.3f}"
                yield f"robot {robot}: {over} {_moment(experiment, begin_s, worst.index, motion.eta[worst.index])}"
        for index, what in _leaps(motion, experiment.controller.period_s):
            yield f"robot {robot}: {what} at once {_moment(experiment, begin_s, index, motion.eta[index])}"
        for what, excess in outside(experiment, eta[:, :3]).items():
            worst = _worst(excess, 0.0)
            if worst is not None:
                where = _moment(experiment, begin_s, worst.index, eta[worst.index])
                yield f"robot {robot}: {worst.value:.3f} m beyond {what} {where}"
        ahead = motion.eta[count:, :3] if experiment.pool.walls else motion.eta[:0, :3]
        out = np.flatnonzero(~experiment.pool.holds(ahead))
        if len(out):
            where = _moment(experiment, begin_s, count + int(out[0]), ahead[out[0]])
            yield f"robot {robot}: leaves the pool {where}, on its way on after the end: end sooner, or let the path stop"


def _leaps(motion: NodeMotion, period_s: float) -> Iterator[tuple[int, str]]:
    """The first sample behind which a place, and a heading, moves otherwise than its velocities say, and by how much: no limit
    of speed shows that, and robots refuse it (guidance/trajectory_check.py)."""
    moved, leaps = np.diff(motion.eta, axis=0), ~follows_velocity(motion.eta, motion.velocity, period_s)
    for axes, what, unit in ((slice(3), "its place moves by", "m"), (slice(3, 4), "it turns by", "rad")):
        index = int(np.argmax(leaps[:, axes].any(axis=1)))
        if leaps[index, axes].any():
            yield index, f"{what} {np.linalg.norm(moved[index, axes]):.3f} {unit}"


def pair_problems(
    experiment: Experiment,
    motions: Mapping[int, NodeMotion],
    count: int,
    begin_s: float = 0.0,
    out_of_time: OutOfTime = never,
) -> Iterator[str]:
    """Lines for pairs of robots that come too near; on different paths only the end counts."""
    closest_m = 2.0 * experiment.safety.radius_m
    for a, b in combinations(sorted(motions), 2):
        check_time(out_of_time)
        counts = slice(count - 1 if give_way(experiment, a, b) else 0, count)
        apart = np.full(count, np.inf)
        apart[counts] = np.linalg.norm(motions[a].eta[counts, :3] - motions[b].eta[counts, :3], axis=1)
        index = int(np.argmin(apart))
        if apart[index] < closest_m - TOLERANCE:
            short = f"{apart[index]:.3f} m apart, {closest_m - apart[index]:.3f} less than 2 safety.radius_m = {closest_m:g}"
            yield f"robots {a} and {b}: {short} {_moment(experiment, begin_s, index, motions[a].eta[index])}"


def give_way(experiment: Experiment, a: int, b: int) -> bool:
    """True for two robots on different paths: they give way to each other in flight, and only their ends are kept apart."""
    return experiment.path_of(experiment.robot(a)) != experiment.path_of(experiment.robot(b))


def outside(experiment: Experiment, position_m: Array) -> dict[str, Array]:
    """Distances (n,) in m by which positions (n, 3) violate each clearance: from islands, from the basin's sides, and from the
    edge of the camera's picture.

    At the surface the centre counts, not the hull: a robot may float. Open water has no sides.
    """
    radius = experiment.vehicle.radius_m
    x, y, z = position_m.T
    beyond = {}
    for i, island in enumerate(experiment.islands, 1):
        shore_m = np.hypot(x - island.position_m[0], y - island.position_m[1]) - island.radius_m
        beyond[f"the clearance of island {i}"] = radius - shore_m
    if experiment.pool.walls:
        length, width, depth = experiment.pool.size_m
        beyond |= {
            "the wall's clearance in x": np.abs(x) + radius - length / 2.0,
            "the wall's clearance in y": np.abs(y) + radius - width / 2.0,
            "the floor's clearance": z + radius - depth,
            "the surface": -z,
        }
    if experiment.localizer.uses_camera:
        beyond["the camera's picture"] = beyond_picture(experiment, position_m)
    return beyond


def beyond_picture(experiment: Experiment, position_m: Array) -> Array:
    """Distances (n,) in m by which positions (n, 3) lie outside the area in which a camera surely sees a robot's hull. For a
    moving camera the experiment's pose counts."""
    return outside_m(experiment.all_cameras, position_m, experiment.vehicle.radius_m + PICTURE_MARGIN_M)


def _worst(values: Array, limit: float) -> _Worst | None:
    index = int(np.argmax(values))
    return _Worst(index, float(values[index])) if values[index] > limit + TOLERANCE else None


def _moment(experiment: Experiment, begin_s: float, index: int, eta: Array) -> str:
    return f"at t = {begin_s + index * experiment.controller.period_s:.2f} s, {place(eta)}"


def place(eta: Array) -> str:
    """A position for people."""
    return f"({eta[0]:.2f}, {eta[1]:.2f}, {eta[2]:.2f}) m"

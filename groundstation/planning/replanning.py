"""Replanning in flight: around obstacles on the present path, or to other places. Pure.

    segment = replan(experiment, segment, begin_s, obstacles)   # from an instant ahead; every robot blends over to it

Obstacles are discs (k, 3: x, y, radius) in m. groundstation/planning/route_planner.py finds the route around them; from rest,
groundstation/planning/rest_to_rest.py plans.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from groundstation.planning import planner
from groundstation.planning.feasibility import (
    OutOfTime,
    PlanError,
    check_time,
    never,
    pair_problems,
    required_slowdown,
    robot_problems,
)
from groundstation.planning.formation import NodeMotion, node_motion, own_heading, quintic_blend, slot_offsets
from groundstation.planning.paths import Path
from groundstation.planning.segment import PlanSegment, ceil_to_period, sample, with_forms
from groundstation.planning.shift import move_past
from groundstation.planning.time_scaling import scale_time
from shoal.config.experiment import Experiment
from shoal.config.scene import Island, PathSpec, Route, Waypoints
from shoal.frames import Array
from shoal.messages.messages import Trajectory

BLEND_S = (4.0, 7.0, 2.5)  # blending from the old motion to the new one; tried in turn
STAY_S = 5.0  # at the last place that the operator gave
SAME_M = 1e-3  # nearer than this to a place counts as arrival
LONGEST = 3.0  # the new route may be longer than a straight one by this share of it
BESIDE_M = 0.5  # a place nearer than this to an obstacle is left out: the path by it and around would bend sharply
SMOOTH_M = 1.0  # length over which bends are spread at least
TIGHTER = (1.0, 0.1)  # of mission.detour_clear_m: where there is less room, robots give way as well


def can_replan(experiment: Experiment) -> bool:
    """True if there is one level path, common to all robots, that leads to places."""
    path = experiment.path
    level = isinstance(path, Route) or (isinstance(path, Waypoints) and path.dive_mps == 0.0)
    return level and all(robot.path is None for robot in experiment.robots)


def replan(
    experiment: Experiment,
    segment: PlanSegment,
    begin_s: float,
    obstacles: Array,
    via: Sequence[tuple[float, float]] = (),
    out_of_time: OutOfTime = never,
) -> PlanSegment:
    """Plan the shortest route from the centre at `begin_s` to the remaining places of the path, or to `via`, around obstacles
    (k, 3: x, y, radius). Every robot blends over to it. Raises PlanError, also when `out_of_time`."""
    experiment = with_forms(experiment, segment)
    if via and not can_replan(experiment):
        raise PlanError("only a level path of waypoints or a route, common to all robots, can be changed under way")

    def rerouted(clear_m: float) -> PlanSegment:
        """The shortest way to the places."""
        try:
            return _rerouted(_with_things(experiment, obstacles, clear_m), segment, begin_s, via, out_of_time)
        except PlanError as error:
            raise PlanError(_obstacles_named(str(error), experiment, obstacles)) from None

    def past(clear_m: float) -> PlanSegment:
        """The same path, with the formation aside where an obstacle lies."""
        return move_past(experiment, segment, begin_s, obstacles, clear_m)

    path, reasons = experiment.path, list[PlanError]()
    if via:
        ways = [rerouted]
    elif not can_replan(experiment) or _laps(path):
        ways = [past]
    else:
        straight = isinstance(path, Waypoints) and path.corner != "smooth"  # a route has other corners than its own
        ways = [past, rerouted] if straight else [rerouted, past]
    for share in TIGHTER:
        for way in ways:
            check_time(out_of_time)
            try:
                return way(share * experiment.mission.detour_clear_m)
            except PlanError as error:
                reasons.append(error)
    raise reasons[-len(ways)]


def _laps(path: PathSpec) -> bool:
    """True for a path that comes by its places again: what is left of it is no list of places."""
    return isinstance(path, Waypoints) and (path.laps > 1 or len(set(path.points_m)) < len(path.points_m))


def _obstacles_named(text: str, experiment: Experiment, obstacles: Array) -> str:
    """A reason in which obstacles, planned around as islands, are called obstacles."""
    for k in range(len(obstacles), 0, -1):
        x, y, _ = obstacles[k - 1]
        text = text.replace(f"island {len(experiment.islands) + k}", f"the obstacle at ({x:.2f}, {y:.2f}) m")
    return text


def _with_things(experiment: Experiment, obstacles: Array, clear_m: float) -> Experiment:
    """Experiment with obstacles as islands, so wide that a centre stays safety.radius_m and `clear_m` away from them."""
    wider_m = experiment.safety.radius_m - experiment.vehicle.radius_m + clear_m
    islands = tuple(Island(position_m=(x, y), radius_m=max(r + wider_m, SAME_M)) for x, y, r in obstacles.tolist())
    return experiment.model_copy(update={"islands": (*experiment.islands, *islands)})


def _rerouted(
    experiment: Experiment,
    segment: PlanSegment,
    begin_s: float,
    given_via: Sequence[tuple[float, float]],
    out_of_time: OutOfTime,
    longer: float = 0.4,
) -> PlanSegment:
    """Segment along the new route. `longer`: the route may be longer than a straight one by this share; tried again with
    LONGEST."""
    period_s, formation = experiment.controller.period_s, experiment.formation
    spec = _route_spec(experiment.path)
    now = sample(segment.centre, np.array([begin_s]))
    here = (float(now.eta[0, 0]), float(now.eta[0, 1]))
    waypoints = tuple(given_via) or _places_left(experiment, segment.via or spec.via_m, segment, begin_s)
    smooth_m = max(spec.smooth_m, SMOOTH_M)
    route = spec.model_copy(update={"via_m": (here, *waypoints), "depth_m": float(now.eta[0, 2]), "smooth_m": smooth_m})
    remaining = ceil_to_period(segment.end_s - begin_s, period_s)
    length_m = float(np.hypot(*np.diff(np.array(route.via_m), axis=0).T).sum())
    if length_m / spec.speed_mps > planner.MOST_SAMPLES * period_s:
        raise PlanError(f"it is {length_m:.0f} m long: a trajectory message holds {planner.MOST_SAMPLES * period_s:.0f} s")
    samples = round((max(remaining, 0.0) + longer * length_m / spec.speed_mps) / period_s) + planner.horizon(experiment)
    time_s = period_s * np.arange(samples, dtype=np.float64)
    nodes = slot_offsets(experiment.nodes_m(), formation.changes, begin_s + time_s, experiment.robot_ids)
    path = planner.centre_path(experiment, route, experiment.robots, nodes, out_of_time)

    def excess(slower: Path) -> Array:
        check_time(out_of_time)
        return required_slowdown(experiment, planner.node_motions(experiment, slower.at(time_s), experiment.robots, nodes))

    path = scale_time(path, excess, samples, period_s) if route.slow else path
    state = path.at(time_s)
    new = planner.node_motions(experiment, state, experiment.robots, nodes)
    centre = node_motion(state, planner.at_centre(samples), "translate", period_s)
    arrival = _arrival(centre.eta, waypoints[-1])
    if arrival >= samples - 2 and longer < LONGEST:
        return _rerouted(experiment, segment, begin_s, given_via, out_of_time, LONGEST)
    arrival_s = begin_s + period_s * arrival
    stays_s = STAY_S if route.stop else 0.0  # one that does not stop would fly on beyond the place
    end_s = arrival_s + (stays_s if given_via else segment.end_s - _old_arrival_s(segment, waypoints[-1]))
    kept = min(round((end_s - begin_s) / period_s) + planner.horizon(experiment), samples)
    motions = {r: _cut(motion, kept) for r, motion in new.items()}
    blended = _blended_segment(experiment, segment, begin_s, motions, _cut(centre, kept), end_s)
    return replace(blended, via=tuple(given_via) or segment.via, forms=segment.forms, path_s=segment.path_s)


def _blended_segment(
    experiment: Experiment,
    segment: PlanSegment,
    begin_s: float,
    new: Mapping[int, NodeMotion],
    centre: NodeMotion,
    end_s: float,
) -> PlanSegment:
    """Segment that blends from the old motions to the new ones within the first of the times BLEND_S that can be flown. Raises
    PlanError with the problems of the last one tried."""
    period_s = experiment.controller.period_s
    flown = min(round((end_s - begin_s) / period_s) + 1, len(centre.eta))
    problems = ["the path's end is too near"]
    for blend_s in BLEND_S:
        if begin_s + blend_s > segment.centre.begin_s + (len(segment.centre.eta) - 1) * period_s:
            continue
        motions = {r: blend_trajectories(segment.trajectories[r], motion, begin_s, blend_s) for r, motion in new.items()}
        problems = [
            *robot_problems(experiment, motions, flown, begin_s),
            *pair_problems(experiment, motions, flown, begin_s),
        ]
        if not problems:
            middle = blend_trajectories(segment.centre, centre, begin_s, blend_s)
            return PlanSegment(
                {r: planner.trajectory(m, period_s, begin_s) for r, m in motions.items()},
                planner.trajectory(middle, period_s, begin_s),
                end_s,
            )
    raise PlanError("; ".join(problems))


def blend_trajectories(old: Trajectory, new: NodeMotion, begin_s: float, blend_s: float) -> NodeMotion:
    """Motion that begins as the old trajectory at `begin_s` and is the new one from `blend_s` later on, without a jump in
    position, velocity and acceleration (quintic_blend). Headings follow the resulting motion."""
    period_s = old.period_s
    count = min(round(blend_s / period_s) + 1, len(new.eta))
    time_s = period_s * np.arange(count, dtype=np.float64)
    before = sample(old, begin_s + time_s)
    tau = np.clip(time_s / blend_s, 0.0, 1.0)[:, None]
    s, s1, s2 = quintic_blend(tau, blend_s)
    position, velocity, acceleration = (x[:, :3].copy() for x in (new.eta, new.velocity, new.acceleration))
    # p = old + s (new - old), and its two time derivatives; s, s1, s2: the blend and its derivatives.
    d0, d1 = position[:count] - before.eta[:, :3], velocity[:count] - before.velocity[:, :3]
    d2 = acceleration[:count] - before.acceleration[:, :3]
    acceleration[:count] = before.acceleration[:, :3] + s * d2 + 2.0 * s1 * d1 + s2 * d0
    velocity[:count] = before.velocity[:, :3] + s * d1 + s1 * d0
    position[:count] = before.eta[:, :3] + s * d0
    yaw, yaw_rate = own_heading(velocity, acceleration, new.eta[:, 3], new.velocity[:, 3])
    yaw += 2.0 * np.pi * round((before.eta[0, 3] - yaw[0]) / (2.0 * np.pi))
    yaw[0], yaw_rate[0] = before.eta[0, 3], before.velocity[0, 3]  # exactly, without rounding
    return NodeMotion(
        np.column_stack([position, yaw]),
        np.column_stack([velocity, yaw_rate]),
        np.column_stack([acceleration, np.gradient(yaw_rate, period_s)]),
    )


def _route_spec(path: PathSpec) -> Route:
    """Route through the places of a path, with its speed."""
    if isinstance(path, Route):
        return path
    assert isinstance(path, Waypoints)
    return Route.model_construct(
        kind="route", via_m=path.all_points_m[path.start_index :], speed_mps=path.speed_mps, stop=path.stop
    )


def _places_left(
    experiment: Experiment, places: Sequence[tuple[float, float]], segment: PlanSegment, begin_s: float
) -> tuple[tuple[float, float], ...]:
    """Places that the centre passes after the blend and that are not beside an obstacle; the last one always.

    The search goes backwards from the last place: the centre passes a place where it comes nearest to it before it passes
    the next one. Without that limit, another part of the path may come nearer still.
    """
    *before, last = places
    reach_m = float(np.hypot(*experiment.nodes_m()[:, :2].T).max()) + BESIDE_M
    free = [p for p in before if all(math.dist(p, i.position_m) > i.radius_m + reach_m for i in experiment.islands)]
    left, until_s = [last], _old_arrival_s(segment, last)
    for place in reversed(free):
        until_s = _old_arrival_s(segment, place, until_s)
        if until_s <= begin_s + BLEND_S[0]:
            break
        left.append(place)
    return tuple(reversed(left))


def _arrival(eta: Array, place: tuple[float, float]) -> int:
    """Sample at which a motion is as near to a place as it ever comes, for the last time: where it stays, the first there."""
    away = np.hypot(eta[:, 0] - place[0], eta[:, 1] - place[1])
    near = np.flatnonzero(away <= away.min() + SAME_M)
    breaks = np.flatnonzero(np.diff(near) > 1)
    return int(near[breaks[-1] + 1 if len(breaks) else 0])


def _old_arrival_s(segment: PlanSegment, place: tuple[float, float], before_s: float = math.inf) -> float:
    """Arrival at a place on the present way, as far as it leads before an instant."""
    centre = segment.centre
    rows = len(centre.eta) if before_s == math.inf else max(round((before_s - centre.begin_s) / centre.period_s), 1)
    return centre.begin_s + centre.period_s * _arrival(centre.eta[:rows], place)


def _cut(motion: NodeMotion, samples: int) -> NodeMotion:
    return NodeMotion(motion.eta[:samples], motion.velocity[:samples], motion.acceleration[:samples])

"""Plans for robots that are in the water already: round what lies on the path, home, and into place again. Pure.

    leg = first_leg(experiment)                                     # the run as planned before it
    leg = detour(experiment, leg, begin_s, things)                  # another path from a moment ahead on, under way
    leg = gathered(experiment, leg, begin_s, reached_s, rests)      # from rest into the places of a leg, and on along it
    leg = homeward(experiment, begin_s, rests, starts)              # from rest to where they began

All raise PlanError with the reason. Times are on the clock that runs along the trajectories; it never goes back.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from groundstation import planner
from groundstation.checks import PlanError, pair_problems, robot_problems, too_fast
from groundstation.formation import NodeMotion, courses, node_motion, own_heading
from groundstation.marshal import RAMP_S, TURN_S, marshal, spinning, turning
from groundstation.pace import slowed
from groundstation.spline import Path
from wire.experiment import Experiment
from wire.frames import Array
from wire.messages import Trajectory
from wire.scene import Island, PathSpec, Route, Waypoints

BLEND_S = (4.0, 7.0, 2.5)  # from the old motion to the new one; tried in turn
SETTLE_S = 5.0  # at the end of a way, before anybody disarms
STAY_S = 5.0  # at places that a person sent the formation to
SAME_M = 1e-3
LONGEST = 3.0
LONGEST_WAIT = 36_000  # samples: half an hour at 20 Hz
DRIFT_M = 0.15  # things and robots without control drift while others find their places
BESIDE_M = 0.5  # a place nearer than this to something is left out: the way by it and round the thing would bend sharply
SMOOTH_M = 1.0  # over how long bends are spread: what comes up suddenly is gone round gently
ROUTE = Route(kind="route", via_m=((0.0, 0.0), (1.0, 0.0)), speed_mps=1.0)  # for its defaults
NOTHING = np.zeros((0, 3))
TIGHTER = (1.0, 0.1)  # of mission.detour_clear_m: where there is less room, robots give way as well

Rests = Mapping[int, Array]  # poses (4,) of robots that are at rest


@dataclass(frozen=True, eq=False)
class Leg:
    """What is flown until something changes. `trajectories` are by slot: a robot's own, until gaps close."""

    trajectories: Mapping[int, Trajectory]
    centre: Trajectory
    end_s: float
    home: bool = False
    via: tuple[tuple[float, float], ...] = ()  # places that a person asked for instead of the path's
    own_ways_until_s: float = 0.0  # before it robots go into their places, each on its own way; the centre stands


def first_leg(experiment: Experiment) -> Leg:
    """The run as planned before it."""
    fleet = planner.plan_fleet(experiment)
    return Leg(fleet.trajectories, fleet.centre, experiment.duration_s)


def at(trajectory: Trajectory, time_s: Array) -> NodeMotion:
    """A trajectory at instants (n,): between its samples linearly, as robots read it; at rest beyond its ends."""
    rows = np.hstack([trajectory.eta, trajectory.velocity, trajectory.acceleration])
    place = (time_s - trajectory.begin_s) / trajectory.period_s
    inside = np.clip(place, 0.0, len(rows) - 1)
    low = np.minimum(inside.astype(np.intp), len(rows) - 2)
    found = rows[low] + (inside - low)[:, None] * (rows[low + 1] - rows[low])
    found[(place < 0.0) | (place > len(rows) - 1), 4:] = 0.0
    return NodeMotion(found[:, :4], found[:, 4:8], found[:, 8:])


def continued(flown: Trajectory, then: Trajectory) -> Trajectory:
    """A trajectory up to where the next one begins, and that one: under its id, for whoever looks at the whole run."""
    kept = min(max(round((then.begin_s - flown.begin_s) / flown.period_s), 0), len(flown.eta))
    waits = max(round((then.begin_s - flown.begin_s) / flown.period_s) - kept, 0)  # a run that is over goes on later
    if waits > LONGEST_WAIT:
        return then
    still = np.tile(flown.eta[-1], (waits, 1)), np.zeros((waits, 4))
    return Trajectory(
        then.id,
        flown.period_s,
        np.vstack([flown.eta[:kept], still[0], then.eta]),
        np.vstack([flown.velocity[:kept], still[1], then.velocity]),
        np.vstack([flown.acceleration[:kept], still[1], then.acceleration]),
        flown.begin_s,
    )


def on_grid(time_s: float, period_s: float) -> float:
    """The first sampling instant at or after `time_s`."""
    return math.ceil(time_s / period_s - 1e-9) * period_s


# --- under way: round things, or to other places


def can_detour(experiment: Experiment) -> bool:
    """Whether there is one path, of a kind that leads to places, and level."""
    path = experiment.path
    level = isinstance(path, Route) or (isinstance(path, Waypoints) and path.dive_mps == 0.0)
    return level and all(robot.path is None for robot in experiment.robots)


def detour(experiment: Experiment, leg: Leg, begin_s: float, things: Array, via: Sequence[tuple[float, float]] = ()) -> Leg:
    """The shortest way from where the centre is at `begin_s` to what is left of the path's places, or to `via`, around things
    (k, 3: x, y, radius); every robot goes over to it smoothly."""
    if not can_detour(experiment):
        raise PlanError("only a level path of waypoints or a route, common to all robots, can be changed under way")
    reason = PlanError("")
    for share in TIGHTER:
        around = _with_things(experiment, things, share * experiment.mission.detour_clear_m)
        try:
            return _rerouted(around, leg, begin_s, via)
        except PlanError as error:
            reason = error
    raise reason


def _with_things(experiment: Experiment, things: Array, clear_m: float) -> Experiment:
    """As if things were islands, so wide that a centre stays safety.radius_m and `clear_m` away from them."""
    wider_m = experiment.safety.radius_m - experiment.vehicle.radius_m + clear_m
    islands = tuple(Island(position_m=(x, y), radius_m=max(r + wider_m, SAME_M)) for x, y, r in things.tolist())
    return experiment.model_copy(update={"islands": (*experiment.islands, *islands)})


def _rerouted(
    experiment: Experiment, leg: Leg, begin_s: float, given_via: Sequence[tuple[float, float]], longer: float = 0.4
) -> Leg:
    """`longer`: by how much the new way may be longer than a straight one, as a share of it; more if that is not enough."""
    period_s, formation = experiment.controller.period_s, experiment.formation
    spec = _route_spec(experiment.path)
    now = at(leg.centre, np.array([begin_s]))
    here = (float(now.eta[0, 0]), float(now.eta[0, 1]))
    left = tuple(given_via) or _places_left(experiment, leg.via or spec.via_m, leg, begin_s)
    smooth_m = max(spec.smooth_m, SMOOTH_M)
    given = spec.model_copy(update={"via_m": (here, *left), "depth_m": float(now.eta[0, 2]), "smooth_m": smooth_m})
    remaining = on_grid(leg.end_s - begin_s, period_s)
    length_m = float(np.hypot(*np.diff(np.array(given.via_m), axis=0).T).sum())
    samples = round((max(remaining, 0.0) + longer * length_m / spec.speed_mps) / period_s) + planner.horizon(experiment)
    time_s = period_s * np.arange(samples, dtype=np.float64)
    nodes = courses(experiment.nodes_m(), formation.changes, begin_s + time_s)
    path = planner.centre_path(experiment, given, experiment.robots, nodes)

    def excess(slower: Path) -> Array:
        return too_fast(experiment, planner.node_motions(experiment, slower.at(time_s), experiment.robots, nodes))

    path = slowed(path, excess, samples, period_s) if given.slow else path
    state = path.at(time_s)
    new = planner.node_motions(experiment, state, experiment.robots, nodes)
    centre = node_motion(state, planner.at_centre(samples), "translate", period_s)
    there = _arrival(centre.eta, left[-1])
    if there >= samples - 2 and longer < LONGEST:
        return _rerouted(experiment, leg, begin_s, given_via, LONGEST)
    there_s = begin_s + period_s * there
    end_s = there_s + (STAY_S if given_via else leg.end_s - _old_arrival_s(leg, left[-1]))
    kept = min(round((end_s - begin_s) / period_s) + planner.horizon(experiment), samples)
    found = _gone_over(experiment, leg, begin_s, {r: _cut(m, kept) for r, m in new.items()}, _cut(centre, kept), end_s)
    return replace(found, via=tuple(given_via) or leg.via)


def _gone_over(
    experiment: Experiment, leg: Leg, begin_s: float, new: Mapping[int, NodeMotion], centre: NodeMotion, end_s: float
) -> Leg:
    """The new motions, reached from the old ones over some seconds; the first that can be flown."""
    period_s = experiment.controller.period_s
    flown = min(round((end_s - begin_s) / period_s) + 1, len(centre.eta))
    problems = ["the path's end is too near"]
    for over_s in BLEND_S:
        if begin_s + over_s > leg.centre.begin_s + (len(leg.centre.eta) - 1) * period_s:
            continue
        motions = {r: blended(leg.trajectories[r], motion, begin_s, over_s) for r, motion in new.items()}
        problems = [
            *robot_problems(experiment, motions, flown, begin_s),
            *pair_problems(experiment, motions, flown, begin_s),
        ]
        if not problems:
            middle = blended(leg.centre, centre, begin_s, over_s)
            return Leg(
                {r: planner.trajectory(m, period_s, begin_s) for r, m in motions.items()},
                planner.trajectory(middle, period_s, begin_s),
                end_s,
            )
    raise PlanError("; ".join(problems))


def blended(old: Trajectory, new: NodeMotion, begin_s: float, over_s: float) -> NodeMotion:
    """From the old motion at `begin_s` to the new one `over_s` later: position, velocity and acceleration go over with no
    jump (a quintic weight has two derivatives that vanish at both ends). Headings are those of the motion that comes of it."""
    period_s = old.period_s
    count = min(round(over_s / period_s) + 1, len(new.eta))
    time_s = period_s * np.arange(count, dtype=np.float64)
    before = at(old, begin_s + time_s)
    tau = np.clip(time_s / over_s, 0.0, 1.0)[:, None]
    s = tau**3 * (10.0 - 15.0 * tau + 6.0 * tau**2)
    s1 = 30.0 * tau**2 * (1.0 - tau) ** 2 / over_s
    s2 = 60.0 * tau * (1.0 - tau) * (1.0 - 2.0 * tau) / over_s**2
    place, speed, push = new.eta[:, :3].copy(), new.velocity[:, :3].copy(), new.acceleration[:, :3].copy()
    away, faster = place[:count] - before.eta[:, :3], speed[:count] - before.velocity[:, :3]
    push[:count] = before.acceleration[:, :3] + s * (push[:count] - before.acceleration[:, :3]) + 2.0 * s1 * faster + s2 * away
    speed[:count] = before.velocity[:, :3] + s * faster + s1 * away
    place[:count] = before.eta[:, :3] + s * away
    yaw, rate = own_heading(speed, push, new.eta[:, 3], new.velocity[:, 3])
    yaw += 2.0 * np.pi * round((before.eta[0, 3] - yaw[0]) / (2.0 * np.pi))
    yaw[0], rate[0] = before.eta[0, 3], before.velocity[0, 3]  # the very numbers, whatever rounding says
    return NodeMotion(
        np.column_stack([place, yaw]),
        np.column_stack([speed, rate]),
        np.column_stack([push, np.gradient(rate, period_s)]),
    )


def _route_spec(path: PathSpec) -> Route:
    """What a path says of speed and depth, as a route through its places."""
    if isinstance(path, Route):
        return path
    assert isinstance(path, Waypoints)
    return ROUTE.model_copy(
        update={"via_m": path.points_m[path.start_index :], "speed_mps": path.speed_mps, "stop": path.stop}
    )


def _places_left(
    experiment: Experiment, places: Sequence[tuple[float, float]], leg: Leg, begin_s: float
) -> tuple[tuple[float, float], ...]:
    """Those that the centre has not come by soon after `begin_s` and that are not right beside something; always the last."""
    *before, last = places
    reach_m = float(np.hypot(*experiment.nodes_m()[:, :2].T).max()) + BESIDE_M
    free = [p for p in before if all(math.dist(p, i.position_m) > i.radius_m + reach_m for i in experiment.islands)]
    return (*(place for place in free if _old_arrival_s(leg, place) > begin_s + BLEND_S[0]), last)


def _arrival(eta: Array, place: tuple[float, float]) -> int:
    """The first sample at which a motion is as near to a place as it ever comes."""
    away = np.hypot(eta[:, 0] - place[0], eta[:, 1] - place[1])
    return int(np.argmax(away <= away.min() + SAME_M))


def _old_arrival_s(leg: Leg, place: tuple[float, float]) -> float:
    return leg.centre.begin_s + leg.centre.period_s * _arrival(leg.centre.eta, place)


def _cut(motion: NodeMotion, samples: int) -> NodeMotion:
    return NodeMotion(motion.eta[:samples], motion.velocity[:samples], motion.acceleration[:samples])


# --- from rest


def homeward(experiment: Experiment, begin_s: float, rests: Rests, starts: Rests, things: Array = NOTHING) -> Leg:
    """From where they rest to where they began; who is not told of in `rests` has no part in it."""
    motions = marshal(experiment, rests, {r: starts[r] for r in rests}, keep_away(experiment, things))
    period_s = experiment.controller.period_s
    trajectories = {r: planner.trajectory(_at_least_two(m), period_s, begin_s) for r, m in motions.items()}
    some = next(iter(trajectories.values()))
    return Leg(trajectories, some, begin_s + (len(some.eta) - 1) * period_s + SETTLE_S, home=True)


def gathered(
    experiment: Experiment,
    leg: Leg,
    begin_s: float,
    reached_s: float,
    rests: Rests,
    slots: Mapping[int, int],
    things: Array = NOTHING,
) -> Leg:
    """From where robots rest into their slots of a leg as of `reached_s`, and from rest on along it. Where something lies in a
    slot, further along the leg, as far as it takes."""
    period_s, away = experiment.controller.period_s, keep_away(experiment, things)
    reached_s = _free_from(leg, max(reached_s, leg.own_ways_until_s), [slots[r] for r in rests], away)
    places = {r: at(leg.trajectories[slots[r]], np.array([reached_s])).eta[0] for r in rests}
    moves = marshal(experiment, rests, places, away)
    still = max(len(m.eta) for m in moves.values())
    on_way = {slots[r]: m for r, m in moves.items()}
    left = round((leg.end_s - reached_s + RAMP_S) / period_s) + planner.horizon(experiment)
    trajectories = {s: _then_on(t, on_way.get(s), still, reached_s, left) for s, t in leg.trajectories.items()}
    moved = {s: planner.trajectory(m, period_s, begin_s) for s, m in trajectories.items()}
    centre = planner.trajectory(_then_on(leg.centre, None, still, reached_s, left), period_s, begin_s)
    end_s = begin_s + (still + _turn_samples(period_s)) * period_s + (leg.end_s - reached_s) + 0.5 * RAMP_S
    on_s = begin_s + (still + _turn_samples(period_s)) * period_s
    return Leg(moved, centre, end_s, leg.home, leg.via, on_s)


def _free_from(leg: Leg, reached_s: float, slots: Sequence[int], away: Array) -> float:
    """The first moment at which nothing lies in these slots, discs (k, 3) as a centre sees them."""
    period_s = leg.centre.period_s
    time_s = reached_s + period_s * np.arange(max(round((leg.end_s - reached_s) / period_s), 1), dtype=np.float64)
    free = np.ones(len(time_s), dtype=bool)
    for slot in slots if len(away) else ():
        apart = at(leg.trajectories[slot], time_s).eta[:, None, :2] - away[:, :2]
        free &= np.all(np.hypot(*apart.transpose(2, 0, 1)) > away[:, 2] + SAME_M, axis=1)
    if not free.any():
        raise PlanError("something lies in the formation's places to the end of the path")
    return float(time_s[int(np.argmax(free))])


def _then_on(trajectory: Trajectory, move: NodeMotion | None, still: int, reached_s: float, samples: int) -> NodeMotion:
    """A move of `still` samples, or standing as long, then the trajectory from `reached_s` on, its clock starting slowly."""
    t = trajectory.period_s * np.arange(samples, dtype=np.float64)
    u = np.clip(t / RAMP_S, 0.0, 1.0)
    way_s = RAMP_S * (u**3 - 0.5 * u**4) + np.maximum(t - RAMP_S, 0.0)
    rate, bend = 3.0 * u**2 - 2.0 * u**3, 6.0 * u * (1.0 - u) / RAMP_S
    on = at(trajectory, reached_s + way_s)
    velocity = on.velocity * rate[:, None]
    acceleration = on.acceleration * rate[:, None] ** 2 + on.velocity * bend[:, None]
    if move is None:
        move = NodeMotion(np.tile(on.eta[0], (still, 1)), np.zeros((still, 4)), np.zeros((still, 4)))
    turns = 2.0 * np.pi * round(float(move.eta[-1, 3] - on.eta[0, 3]) / (2.0 * np.pi))
    eta = on.eta + np.array([0.0, 0.0, 0.0, turns])
    count = _turn_samples(trajectory.period_s)
    facing = np.tile(move.eta[-1], (count, 1))
    facing[:, 3] = turning(float(move.eta[-1, 3]), float(eta[0, 3]), count)
    spin, push = np.zeros((count, 4)), np.zeros((count, 4))
    spin[:, 3], push[:, 3] = spinning(facing[:, 3], trajectory.period_s)
    return NodeMotion(
        np.vstack([move.eta, facing, eta]),
        np.vstack([move.velocity, spin, velocity]),
        np.vstack([move.acceleration, push, acceleration]),
    )


def _turn_samples(period_s: float) -> int:
    return round(TURN_S / period_s)


def assigned(leg: Leg, time_s: float, eta: Rests, slots: Sequence[int]) -> dict[int, int]:
    """A slot for every robot so that the sum of squared ways is least: nobody crosses anybody."""
    robots = list(eta)
    nodes = np.array([at(leg.trajectories[s], np.array([time_s])).eta[0, :3] for s in slots])
    ways = np.sum((np.array([eta[r][:3] for r in robots])[:, None] - nodes) ** 2, axis=2)
    chosen = linear_sum_assignment(ways)[1].tolist()
    return {robot: slots[k] for robot, k in zip(robots, chosen, strict=True)}


def keep_away(experiment: Experiment, things: Array) -> Array:
    """Things (k, 3: x, y, radius) as discs that a robot's centre keeps out of."""
    return np.asarray(things.reshape(-1, 3) + np.array([0.0, 0.0, experiment.safety.radius_m + DRIFT_M]))


def _at_least_two(motion: NodeMotion) -> NodeMotion:
    """A trajectory has two samples or more, also of a robot that stays."""
    if len(motion.eta) >= 2:
        return motion
    twice = replace(motion, eta=np.repeat(motion.eta, 2, axis=0))
    return replace(twice, velocity=np.zeros((2, 4)), acceleration=np.zeros((2, 4)))


# --- what lies on the path


def first_contact(experiment: Experiment, leg: Leg, from_s: float, until_s: float, things: Array) -> str:
    """Which robot would come nearer than safety.radius_m to which thing (k, 3), when and where; empty if none does."""
    if len(things) == 0:
        return ""
    time_s = np.arange(from_s, min(until_s, leg.end_s), leg.centre.period_s)
    found = []
    for slot, trajectory in leg.trajectories.items():
        eta = at(trajectory, time_s).eta
        short = things[:, 2] + experiment.safety.radius_m - np.hypot(*(eta[:, None, :2] - things[:, :2]).transpose(2, 0, 1))
        meets = np.flatnonzero(short.max(axis=1) > 0.0)
        if len(meets):
            first = int(meets[0])
            x, y, _ = things[int(np.argmax(short[first]))]
            found.append(
                (first, f"at ({x:.2f}, {y:.2f}) m, on the path of robot {slot}, in {first * leg.centre.period_s:.1f} s")
            )
    return min(found)[1] if found else ""

"""Robots from wherever they rest to wherever they should rest, one clear of the other: the way home, and into place. Pure.

Each robot's way is the shortest around islands and things (route.py), flown from rest to rest. Robots are planned one after
the other; each leaves as early as it stays clear of those planned before it, all along, and of those not yet planned, which
wait where they are. Where no order of robots works (two stand on one another's goals), one first makes room.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from groundstation.checks import PlanError, too_fast
from groundstation.formation import NodeMotion
from groundstation.route import NoRoute, route
from groundstation.spline import SplinePath
from wire.experiment import Experiment
from wire.frames import Array
from wire.scene import Waypoints

RAMP_S = 3.0  # from rest to full speed: 0.15 m/s then takes 0.9 N of the 6 N there are
TURN_S = 4.0  # to face the other way before one leaves: 1.5 rad/s at most, of the 1.9 a robot reaches
CLEAR_M = 0.05  # between hulls and islands or walls, beside the way
WAIT_STEP_S = 1.0
LONGEST_WAIT_S = 120.0
SLOWER = 0.7  # a bend that is too sharp for the speed is taken at less of it
NEAR_M = 1e-3
ABSURD_M = 1.0  # beyond twice the basin nobody is,
ABSURD_RAD = 1e4  # and nobody has turned so often
ORDERS = 6  # orders of the robots that are tried
ASIDE_M = (0.8, 1.2, 1.8, 2.6)  # how far a robot goes to make room
ASIDE_WAYS = 12
MAKING_ROOM = 2  # robots that do so at most


@dataclass(frozen=True, eq=False)
class Trip:
    """One robot's motion, samples (n, .) of a control period; it stands before and after."""

    position: Array
    velocity: Array
    acceleration: Array

    def __len__(self) -> int:
        return len(self.position)


@dataclass(frozen=True, eq=False)
class Basin:
    """What does not move, as a robot's centre sees it: discs (k, 3: x, y, radius) and half the basin's inside."""

    discs: Array
    half_m: tuple[float, float]


def basin(experiment: Experiment, things: Array) -> Basin:
    """Islands, and things (k, 3: x, y, distance to keep the centre at)."""
    room_m = experiment.vehicle.radius_m + CLEAR_M
    islands = [(*island.position_m, island.radius_m + room_m) for island in experiment.islands]
    length, width, _ = experiment.pool.size_m
    walls = experiment.sim.plant.walls
    half_m = (length / 2.0 - room_m, width / 2.0 - room_m) if walls else (math.inf, math.inf)
    return Basin(np.vstack([np.array(islands).reshape(-1, 3), things.reshape(-1, 3)]), half_m)


def marshal(
    experiment: Experiment, starts: Mapping[int, Array], goals: Mapping[int, Array], things: Array
) -> dict[int, NodeMotion]:
    """Motions of all robots, equally long, from `starts` to `goals`, poses (4,). Raises PlanError with the reason."""
    for robot, rest in starts.items():
        if not np.all(np.abs(rest[:3]) <= np.array(experiment.pool.size_m) + ABSURD_M):
            raise PlanError(f"robot {robot} says that it is at ({rest[0]:.3g}, {rest[1]:.3g}, {rest[2]:.3g}) m")
        if not abs(rest[3]) <= ABSURD_RAD:  # true for NaN too
            raise PlanError(f"robot {robot} says that it heads {rest[3]:.3g} rad")
    around = basin(experiment, things)
    trips = _marshal(experiment, around, dict(starts), dict(goals), MAKING_ROOM)
    return {robot: _with_heading(trip, float(starts[robot][3]), experiment) for robot, trip in trips.items()}


def _marshal(
    experiment: Experiment, around: Basin, starts: dict[int, Array], goals: dict[int, Array], depth: int
) -> dict[int, Trip]:
    reason = "no robots"
    for order in _orders(starts, goals):
        try:
            return _one_after_the_other(experiment, around, starts, goals, order)
        except PlanError as error:
            reason = str(error)
    if depth:
        for robot, aside in _asides(experiment, around, starts, goals):
            elsewhere = {**starts, robot: aside}
            try:
                first = _one_after_the_other(experiment, around, starts, elsewhere, list(starts))
                rest = _marshal(experiment, around, elsewhere, goals, depth - 1)
            except PlanError:
                continue
            return {r: _joined(first[r], rest[r]) for r in starts}
    raise PlanError(reason)


def _orders(starts: Mapping[int, Array], goals: Mapping[int, Array]) -> Iterator[list[int]]:
    """Orders worth trying: who has the shorter way first, and turned about."""
    by_way = sorted(starts, key=lambda r: (float(np.linalg.norm(goals[r][:3] - starts[r][:3])), r))
    for turn in range(min(ORDERS // 2, len(by_way))):
        turned = by_way[turn:] + by_way[:turn]
        yield turned
        yield turned[::-1]


def _asides(
    experiment: Experiment, around: Basin, starts: Mapping[int, Array], goals: Mapping[int, Array]
) -> Iterator[tuple[int, Array]]:
    """Who stands on whose goal, and where it might go meanwhile, near places first."""
    keep_m = 2.0 * experiment.safety.radius_m
    blockers = [r for r in starts if any(s != r and np.linalg.norm(goals[s][:2] - starts[r][:2]) < keep_m for s in goals)]
    for far_m in ASIDE_M:
        for robot in blockers:
            for angle in 2.0 * np.pi / ASIDE_WAYS * np.arange(ASIDE_WAYS):
                place = starts[robot].copy()
                place[:2] += far_m * np.array([np.cos(angle), np.sin(angle)])
                others = [p for r in starts for p in (starts[r], goals[r]) if r != robot]
                if _free(place[:2], around) and all(np.linalg.norm(place[:2] - p[:2]) > keep_m for p in others):
                    yield robot, place


def _free(place: Array, around: Basin) -> bool:
    inside = bool(np.all(np.abs(place) <= around.half_m))
    return inside and bool(np.all(np.hypot(*(around.discs[:, :2] - place).T) > around.discs[:, 2]))


def _one_after_the_other(
    experiment: Experiment, around: Basin, starts: Mapping[int, Array], goals: Mapping[int, Array], order: Sequence[int]
) -> dict[int, Trip]:
    done: dict[int, Trip] = {}
    for robot in order:
        waiting = {r: starts[r] for r in order if r not in done and r != robot}
        done[robot] = _earliest(experiment, around, robot, starts, goals, done, waiting)
    longest = max(map(len, done.values()))
    return {robot: _padded(done[robot], 0, longest) for robot in starts}


def _earliest(
    experiment: Experiment,
    around: Basin,
    robot: int,
    starts: Mapping[int, Array],
    goals: Mapping[int, Array],
    done: Mapping[int, Trip],
    waiting: Mapping[int, Array],
) -> Trip:
    """The first trip of a robot that is clear of everybody: straight there, or around where others stand."""
    reasons = []
    step = round(WAIT_STEP_S / experiment.controller.period_s)
    for detour in (False, True):
        parked = [*waiting.values(), *(goals[r] for r in done)] if detour else []
        try:
            trip = _trip(experiment, around, starts[robot], goals[robot], parked)
        except NoRoute as error:
            reasons.append(f"robot {robot}: {error}")
            continue
        if _conflict(experiment, robot, trip, starts, goals, {}, waiting):
            reasons.append(f"robot {robot} would pass too near a robot that waits")
            continue
        for wait in range(round(LONGEST_WAIT_S / WAIT_STEP_S)):
            later = _padded(trip, wait * step, 0)
            if not _conflict(experiment, robot, later, starts, goals, done, {}):
                return later
            if wait * step > max(map(len, done.values()), default=0):
                break
        reasons.append(f"robot {robot} would pass too near another robot")
    raise PlanError(reasons[-1])


def _conflict(
    experiment: Experiment,
    robot: int,
    trip: Trip,
    starts: Mapping[int, Array],
    goals: Mapping[int, Array],
    done: Mapping[int, Trip],
    waiting: Mapping[int, Array],
) -> bool:
    for other in (*done, *waiting):
        length = max(len(trip), len(done[other]) if other in done else 0)
        there = _padded(done[other], 0, length).position if other in done else waiting[other][None, :3]
        apart_m = float(np.linalg.norm(_padded(trip, 0, length).position - there, axis=1).min())
        if apart_m < _keep_m(experiment, starts, goals, robot, other):
            return True
    return False


def _keep_m(experiment: Experiment, starts: Mapping[int, Array], goals: Mapping[int, Array], a: int, b: int) -> float:
    """2 R; less where two rest nearer, now or at the end: they may come no nearer than that."""
    rests = (float(np.linalg.norm(places[a][:3] - places[b][:3])) for places in (starts, goals))
    return min(2.0 * experiment.safety.radius_m, *rests) - NEAR_M


def _trip(experiment: Experiment, around: Basin, start: Array, goal: Array, parked: Sequence[Array]) -> Trip:
    """The shortest way, from rest to rest. Raises NoRoute."""
    rise_m = float(goal[2] - start[2])
    away_m = float(np.hypot(*(goal[:2] - start[:2])))
    period_s = experiment.controller.period_s
    if max(away_m, abs(rise_m)) < NEAR_M:
        return Trip(start[None, :3].copy(), np.zeros((1, 3)), np.zeros((1, 3)))
    path = None
    if away_m >= NEAR_M:
        keep_m = 2.0 * experiment.safety.radius_m
        others = np.array([(*p[:2], keep_m) for p in parked]).reshape(-1, 3)
        discs = _no_wider_than_free(np.vstack([around.discs, others]), start[:2], goal[:2])
        half_m = tuple(max(h, abs(float(start[k])), abs(float(goal[k]))) for k, h in enumerate(around.half_m))
        points = route([(start[0], start[1]), (goal[0], goal[1])], discs, (half_m[0], half_m[1]))
        path = SplinePath(Waypoints(kind="waypoints", points_m=tuple((x, y) for x, y in points.tolist()), speed_mps=1.0))
    flat_m = path.length_m if path is not None else 0.0
    limits = experiment.vehicle.limits
    speed = min(experiment.mission.return_mps, 0.8 * limits.speed_mps)
    speed = min(speed, 0.8 * limits.heave_mps * max(flat_m, abs(rise_m)) / max(abs(rise_m), 1e-9))
    while True:
        way, rate, bend = glide(max(flat_m, abs(rise_m)), speed, period_s)
        trip = _padded(_along(path, start, flat_m, rise_m, way, rate, bend), round(TURN_S / period_s), 0)
        if speed < 0.02 or float(np.max(too_fast(experiment, {0: _with_heading(trip, float(start[3]), experiment)}))) <= 1.0:
            return trip
        speed *= SLOWER


def _no_wider_than_free(discs: Array, *ends: Array) -> Array:
    """Discs shrunk to where the ends are free: a robot that rests near something may leave it, and come to rest there."""
    if len(discs) == 0:
        return discs
    room = np.min([np.hypot(*(discs[:, :2] - end).T) for end in ends], axis=0)
    return np.column_stack([discs[:, :2], np.minimum(discs[:, 2], room * (1.0 - 1e-9))])


def glide(length_m: float, speed_mps: float, period_s: float) -> tuple[Array, Array, Array]:
    """Way (n,), and its two time derivatives: from rest to `speed_mps` and to rest again, with no jump in acceleration."""
    speed = min(speed_mps, length_m / RAMP_S)
    cruise_s = length_m / speed - RAMP_S
    time_s = period_s * np.arange(math.ceil((cruise_s + 2.0 * RAMP_S) / period_s) + 1, dtype=np.float64)

    def ramp(t: Array) -> tuple[Array, Array, Array]:
        u = np.clip(t / RAMP_S, 0.0, 1.0)
        beyond = np.maximum(t - RAMP_S, 0.0)
        way = RAMP_S * (u**3 - 0.5 * u**4) + beyond
        return speed * way, speed * (3.0 * u**2 - 2.0 * u**3), speed * 6.0 * u * (1.0 - u) / RAMP_S

    up, down = ramp(time_s), ramp(time_s - cruise_s - RAMP_S)
    way, rate, bend = (a - b for a, b in zip(up, down, strict=True))
    return np.minimum(way, length_m), rate, bend


def _along(path: SplinePath | None, start: Array, flat_m: float, rise_m: float, way: Array, rate: Array, bend: Array) -> Trip:
    """Over the ground along the path and up or down in step with it; `way` is of whichever is longer."""
    whole = max(flat_m, abs(rise_m))
    position, velocity = np.tile(start[:3], (len(way), 1)), np.zeros((len(way), 3))
    acceleration = np.zeros((len(way), 3))
    if path is not None:
        share = flat_m / whole
        at = path.at(share * way)
        position[:, :2] = at.position_m[:, :2]
        velocity[:, :2] = at.velocity_mps[:, :2] * (share * rate)[:, None]
        acceleration[:, :2] = (
            at.acceleration_mps2[:, :2] * (share * rate)[:, None] ** 2 + at.velocity_mps[:, :2] * (share * bend)[:, None]
        )
    share = rise_m / whole
    position[:, 2] += share * way
    velocity[:, 2], acceleration[:, 2] = share * rate, share * bend
    return Trip(position, velocity, acceleration)


def _padded(trip: Trip, before: int, length: int) -> Trip:
    """Standing `before` samples longer at its start, and at its end until it has `length` samples."""
    behind = max(length - before - len(trip), 0)
    still = np.zeros((before, 3)), np.zeros((behind, 3))
    return Trip(
        np.vstack([np.tile(trip.position[0], (before, 1)), trip.position, np.tile(trip.position[-1], (behind, 1))]),
        np.vstack([still[0], trip.velocity, still[1]]),
        np.vstack([still[0], trip.acceleration, still[1]]),
    )


def _joined(first: Trip, then: Trip) -> Trip:
    return Trip(
        np.vstack([first.position, then.position]),
        np.vstack([first.velocity, then.velocity]),
        np.vstack([first.acceleration, then.acceleration]),
    )


def _with_heading(trip: Trip, yaw_rad: float, experiment: Experiment) -> NodeMotion:
    """Heading where it goes; where it stands it turns from where it came to where it will go."""
    moving = np.hypot(trip.velocity[:, 0], trip.velocity[:, 1]) > NEAR_M
    course = np.arctan2(trip.velocity[:, 1], trip.velocity[:, 0])
    yaw, period_s = np.full(len(trip), yaw_rad), experiment.controller.period_s
    edges = np.flatnonzero(np.diff(np.concatenate([[False], moving, [False]]).astype(np.intp)))
    before, stood = yaw_rad, 0
    for begin, end in edges.reshape(-1, 2).tolist():
        way = np.unwrap(course[begin:end])
        way += 2.0 * np.pi * round((before - way[0]) / (2.0 * np.pi))
        yaw[stood:begin] = turning(before, float(way[0]), begin - stood)
        yaw[begin:end], before, stood = way, float(way[-1]), end
    yaw[stood:] = before
    rate, bend = spinning(yaw, period_s)
    return NodeMotion(
        np.column_stack([trip.position, yaw]),
        np.column_stack([trip.velocity, rate]),
        np.column_stack([trip.acceleration, bend]),
    )


def spinning(yaw_rad: Array, period_s: float) -> tuple[Array, Array]:
    """Rate of a heading that rests at both ends, and the rate's own."""
    if len(yaw_rad) < 2:
        return np.zeros(len(yaw_rad)), np.zeros(len(yaw_rad))
    rate = np.gradient(yaw_rad, period_s)
    rate[[0, -1]] = 0.0
    return rate, np.gradient(rate, period_s)


def turning(from_rad: float, to_rad: float, samples: int) -> Array:
    """From one heading to another in so many samples, smoothly."""
    tau = (np.arange(samples, dtype=np.float64) + 1.0) / (samples + 1.0)
    return from_rad + (to_rad - from_rad) * tau**3 * (10.0 - 15.0 * tau + 6.0 * tau**2)

"""One robot's trip from rest to rest: the shortest way around islands and things (route_planner.py), speed and heading along
it. Pure. How several robots go about theirs, clear of one another, is groundstation/planning/prioritized_planning.py's."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from groundstation.planning.feasibility import required_slowdown
from groundstation.planning.formation import NodeMotion
from groundstation.planning.paths import SplinePath
from groundstation.planning.route_planner import NoRoute, route
from wire.config.experiment import Experiment
from wire.config.scene import Waypoints
from wire.frames import Array

RAMP_S = 3.0  # from rest to full speed: 0.15 m/s then takes 0.9 N of the 6 N there are
TURN_S = 4.0  # to face the other way before one leaves: 1.5 rad/s at most; longer for a vehicle that cannot turn so fast
SLOWER_TURN, LONGEST_TURN_S = 1.1, 60.0  # times as long, until it can; a vehicle that needs more is none for such trips
CLEAR_M = 0.05  # between hulls and islands or walls, beside the way
SLOWER = 0.7  # a bend that is too sharp for the speed is taken at less of it
NEAR_M = 1e-3  # less is no way at all


@dataclass(frozen=True, eq=False)
class Transfer:
    """One robot's motion, samples (n, .) of a control period; it stands before and after."""

    position: Array
    velocity: Array
    acceleration: Array

    def __len__(self) -> int:
        return len(self.position)


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """What does not move, as a robot's centre sees it: discs (k, 3: x, y, radius) and half the basin's inside."""

    discs: Array
    half_m: tuple[float, float]


def free_space(experiment: Experiment, obstacles: Array) -> FreeSpace:
    """Islands, and things (k, 3: x, y, distance to keep the centre at)."""
    room_m = experiment.vehicle.radius_m + CLEAR_M
    islands = [(*island.position_m, island.radius_m + room_m) for island in experiment.islands]
    length, width, _ = experiment.pool.size_m
    walls = experiment.pool.walls
    half_m = (length / 2.0 - room_m, width / 2.0 - room_m) if walls else (math.inf, math.inf)
    return FreeSpace(np.vstack([np.array(islands).reshape(-1, 3), obstacles.reshape(-1, 3)]), half_m)


def is_free(place: Array, around: FreeSpace) -> bool:
    """Whether a robot's centre may be there, (2,)."""
    inside = bool(np.all(np.abs(place) <= around.half_m))
    return inside and bool(np.all(np.hypot(*(around.discs[:, :2] - place).T) > around.discs[:, 2]))


def plan_transfer(experiment: Experiment, around: FreeSpace, start: Array, goal: Array, parked: Sequence[Array]) -> Transfer:
    """The shortest way, from rest to rest. Raises NoRoute."""
    rise_m = float(goal[2] - start[2])
    away_m = float(np.hypot(*(goal[:2] - start[:2])))
    period_s = experiment.controller.period_s
    if max(away_m, abs(rise_m)) < NEAR_M:
        return Transfer(start[None, :3].copy(), np.zeros((1, 3)), np.zeros((1, 3)))
    path = None
    if away_m >= NEAR_M:
        keep_m = 2.0 * experiment.safety.radius_m
        others = np.array([(*p[:2], keep_m) for p in parked]).reshape(-1, 3)
        discs = _no_wider_than_free(np.vstack([around.discs, others]), start[:2], goal[:2])
        half_m = tuple(max(h, abs(float(start[k])), abs(float(goal[k]))) for k, h in enumerate(around.half_m))
        points = route([(start[0], start[1]), (goal[0], goal[1])], discs, (half_m[0], half_m[1]))
        try:
            path = SplinePath(Waypoints(kind="waypoints", points_m=tuple((x, y) for x, y in points.tolist()), speed_mps=1.0))
        except ValueError:
            raise NoRoute("the way there turns on the spot") from None
    flat_m = path.length_m if path is not None else 0.0
    limits = experiment.vehicle.limits
    speed = min(experiment.mission.return_mps, 0.8 * limits.speed_mps)
    speed = min(speed, 0.8 * limits.heave_mps * max(flat_m, abs(rise_m)) / max(abs(rise_m), 1e-9))
    while True:
        way, rate, bend = s_curve_profile(max(flat_m, abs(rise_m)), speed, period_s)
        trip = pad(_along(path, start, flat_m, rise_m, way, rate, bend), turn_samples(experiment), 0)
        if (
            speed < 0.02
            or float(np.max(required_slowdown(experiment, {0: add_heading(trip, float(start[3]), experiment)}))) <= 1.0
        ):
            return trip
        speed *= SLOWER


def _no_wider_than_free(discs: Array, *ends: Array) -> Array:
    """Discs shrunk to where the ends are free: a robot that rests near something may leave it, and come to rest there."""
    if len(discs) == 0:
        return discs
    room = np.min([np.hypot(*(discs[:, :2] - end).T) for end in ends], axis=0)
    return np.column_stack([discs[:, :2], np.minimum(discs[:, 2], room * (1.0 - 1e-9))])


def ramp(time_s: Array) -> tuple[Array, Array, Array]:
    """A clock that starts slowly and goes as clocks go after RAMP_S: what it shows (n,), and its two time derivatives."""
    u = np.clip(time_s / RAMP_S, 0.0, 1.0)
    shown_s = RAMP_S * (u**3 - 0.5 * u**4) + np.maximum(time_s - RAMP_S, 0.0)
    return shown_s, 3.0 * u**2 - 2.0 * u**3, 6.0 * u * (1.0 - u) / RAMP_S


def s_curve_profile(length_m: float, speed_mps: float, period_s: float) -> tuple[Array, Array, Array]:
    """Way (n,), and its two time derivatives: from rest to `speed_mps` and to rest again, with no jump in acceleration."""
    speed = min(speed_mps, length_m / RAMP_S)
    cruise_s = length_m / speed - RAMP_S
    time_s = period_s * np.arange(math.ceil((cruise_s + 2.0 * RAMP_S) / period_s) + 1, dtype=np.float64)
    up, down = ramp(time_s), ramp(time_s - cruise_s - RAMP_S)
    way, rate, bend = (speed * a - speed * b for a, b in zip(up, down, strict=True))
    return np.minimum(way, length_m), rate, bend


def _along(
    path: SplinePath | None, start: Array, flat_m: float, rise_m: float, way: Array, rate: Array, bend: Array
) -> Transfer:
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
    return Transfer(position, velocity, acceleration)


def pad(trip: Transfer, before: int, length: int) -> Transfer:
    """Standing `before` samples longer at its start, and at its end until it has `length` samples."""
    behind = max(length - before - len(trip), 0)
    still = np.zeros((before, 3)), np.zeros((behind, 3))
    return Transfer(
        np.vstack([np.tile(trip.position[0], (before, 1)), trip.position, np.tile(trip.position[-1], (behind, 1))]),
        np.vstack([still[0], trip.velocity, still[1]]),
        np.vstack([still[0], trip.acceleration, still[1]]),
    )


def join(first: Transfer, then: Transfer) -> Transfer:
    """One after the other."""
    return Transfer(
        np.vstack([first.position, then.position]),
        np.vstack([first.velocity, then.velocity]),
        np.vstack([first.acceleration, then.acceleration]),
    )


def add_heading(trip: Transfer, yaw_rad: float, experiment: Experiment) -> NodeMotion:
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
    rate, bend = heading_rates(yaw, period_s)
    return NodeMotion(
        np.column_stack([trip.position, yaw]),
        np.column_stack([trip.velocity, rate]),
        np.column_stack([trip.acceleration, bend]),
    )


def heading_rates(yaw_rad: Array, period_s: float) -> tuple[Array, Array]:
    """Rate of a heading that rests at both ends, and the rate's own."""
    if len(yaw_rad) < 2:
        return np.zeros(len(yaw_rad)), np.zeros(len(yaw_rad))
    rate = np.gradient(yaw_rad, period_s)
    rate[[0, -1]] = 0.0
    return rate, np.gradient(rate, period_s)


def turn_samples(experiment: Experiment) -> int:
    """In how many samples a robot turns half round on the spot, within its limits. Raises NoRoute for one that cannot."""
    period_s, turn_s = experiment.controller.period_s, TURN_S
    while turn_s <= LONGEST_TURN_S:
        samples = round(turn_s / period_s)
        pose = np.zeros((samples + 2, 4))
        pose[1:-1, 3], pose[-1, 3] = turning(0.0, math.pi, samples), math.pi
        spin, push = np.zeros_like(pose), np.zeros_like(pose)
        spin[:, 3], push[:, 3] = heading_rates(pose[:, 3], period_s)
        if float(np.max(required_slowdown(experiment, {0: NodeMotion(pose, spin, push)}))) <= 1.0:
            return samples
        turn_s *= SLOWER_TURN
    raise NoRoute(f"this vehicle does not turn half round within {LONGEST_TURN_S:g} s (limits.yaw_rate_radps, limits.wrench)")


def turning(from_rad: float, to_rad: float, samples: int) -> Array:
    """From one heading to another in so many samples, smoothly."""
    tau = (np.arange(samples, dtype=np.float64) + 1.0) / (samples + 1.0)
    return from_rad + (to_rad - from_rad) * tau**3 * (10.0 - 15.0 * tau + 6.0 * tau**2)

"""Transfer of one robot from rest to rest: the shortest route around islands and obstacles (route_planner.py), speed and
heading along it. Pure. groundstation/planning/prioritized_planning.py keeps the transfers of several robots clear of one
another."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from groundstation.planning.feasibility import OutOfTime, never, required_slowdown
from groundstation.planning.formation import NodeMotion
from groundstation.planning.paths import SplinePath
from groundstation.planning.route_planner import NoRoute, find_route
from shoal.config.experiment import Experiment
from shoal.config.scene import Waypoints
from shoal.frames import Array

RAMP_S = 3.0  # from rest to full speed: 0.15 m/s then takes 0.9 N of the available 6 N
TURN_S = 4.0  # for half a turn before leaving: 1.5 rad/s at most; longer for a vehicle that cannot turn so fast
SLOWER_TURN, LONGEST_TURN_S = 1.1, 60.0  # factor tried until the vehicle can turn; NoRoute beyond the longest turn
CLEAR_M = 0.05  # between hulls and islands or walls
LIMIT_SHARE = 0.8  # of the vehicle's fastest speed and heave: the rest is for its controller
SLOWER, SLOWEST_MPS = 0.7, 0.02  # factor on the speed, tried until all bends can be flown; the last one is taken as it is
NEAR_M = 1e-3  # a shorter distance is no transfer
OFF_M = 0.1  # length of the straight piece away from an obstacle beside an end, where there is no room to bend at once
RIM_M = (
    0.008  # by how much a path may come nearer to an obstacle than its ends lie to it. A nearer one is a contact (BESIDE_M)
)


@dataclass(frozen=True, eq=False)
class Transfer:
    """Motion of one robot, samples (n, .) every control period; at rest before and after."""

    position: Array
    velocity: Array
    acceleration: Array

    def __len__(self) -> int:
        return len(self.position)


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """Space for a robot's centre: outside of discs (k, 3: x, y, radius), inside +-`half_m` of the basin, `apart_m` from the
    centres of other robots, in m."""

    discs: Array
    half_m: tuple[float, float]
    apart_m: float


def free_space(experiment: Experiment, obstacles: Array, apart_m: float) -> FreeSpace:
    """Free space between walls, islands, obstacles (k, 3: x, y, distance to keep the centre at) and robots."""
    room_m = experiment.vehicle.radius_m + CLEAR_M
    islands = [(*island.position_m, island.radius_m + room_m) for island in experiment.islands]
    length, width, _ = experiment.pool.size_m
    walls = experiment.pool.walls
    half_m = (length / 2.0 - room_m, width / 2.0 - room_m) if walls else (math.inf, math.inf)
    return FreeSpace(np.vstack([np.array(islands).reshape(-1, 3), obstacles.reshape(-1, 3)]), half_m, apart_m)


def is_free(place: Array, around: FreeSpace) -> bool:
    """True if a robot's centre may be at `place` (2,)."""
    inside = bool(np.all(np.abs(place) <= around.half_m))
    return inside and bool(np.all(np.hypot(*(around.discs[:, :2] - place).T) > around.discs[:, 2]))


def plan_transfer(
    experiment: Experiment,
    around: FreeSpace,
    start: Array,
    goal: Array,
    parked: Sequence[Array],
    out_of_time: OutOfTime = never,
) -> Transfer:
    """Plan the shortest transfer between two poses (4,), around `parked` robots. Raises NoRoute, and PlanError when
    `out_of_time`."""
    rise_m = float(goal[2] - start[2])
    away_m = float(np.hypot(*(goal[:2] - start[:2])))
    period_s = experiment.controller.period_s
    if max(away_m, abs(rise_m)) < NEAR_M:
        return Transfer(start[None, :3].copy(), np.zeros((1, 3)), np.zeros((1, 3)))
    path = _flat_path(around, start, goal, parked, out_of_time) if away_m >= NEAR_M else None
    flat_m = path.length_m if path is not None else 0.0
    length_m = max(flat_m, abs(rise_m))
    limits = experiment.vehicle.limits
    speed = min(experiment.mission.return_mps, LIMIT_SHARE * limits.speed_mps)
    speed = min(speed, LIMIT_SHARE * limits.heave_mps * length_m / max(abs(rise_m), 1e-9))
    while True:
        distance_m, rate_mps, rate_mps2 = s_curve_profile(length_m, speed, period_s)
        motion = _along(path, start, flat_m, rise_m, distance_m, rate_mps, rate_mps2)
        transfer = pad(motion, turn_samples(experiment), 0)
        if speed < SLOWEST_MPS or _can_be_flown(experiment, transfer, float(start[3])):
            return transfer
        speed *= SLOWER


def _flat_path(
    around: FreeSpace,
    start: Array,
    goal: Array,
    parked: Sequence[Array],
    out_of_time: OutOfTime,
) -> SplinePath:
    """The shortest smooth path in the plane between two poses (4,), around discs and `parked` robots. Raises NoRoute.

    An end may lie inside a disc, for a robot that rests beside an obstacle or a wall. Discs are then shrunk until the ends are
    free, and the basin is widened. Where the path has no room to bend at such an end, discs are shrunk by RIM_M more, and then
    the path first leads straight away.
    """
    parked_discs = np.array([(x, y, around.apart_m) for x, y, *_ in parked]).reshape(-1, 3)
    discs = np.vstack([around.discs, parked_discs])
    ends = start[:2], goal[:2]
    half_x_m, half_y_m = around.half_m
    half_x_m = max(half_x_m, abs(float(start[0])), abs(float(goal[0])))
    half_y_m = max(half_y_m, abs(float(start[1])), abs(float(goal[1])))
    tight_discs, loose_discs = _shrunk_to_free(discs, 0.0, *ends), _shrunk_to_free(discs, RIM_M, *ends)
    attempts = (ends, tight_discs), (ends, loose_discs), (_with_straight_ends(ends, discs), loose_discs)
    points = _first_route(attempts, (half_x_m, half_y_m), out_of_time)
    try:
        return SplinePath(Waypoints(kind="waypoints", points_m=tuple((x, y) for x, y in points.tolist()), speed_mps=1.0))
    except ValueError:
        raise NoRoute("the way there turns on the spot") from None


def _first_route(
    attempts: Iterable[tuple[Sequence[Array], Array]], half_m: tuple[float, float], out_of_time: OutOfTime
) -> Array:
    """The route of the first attempt (points to pass through, discs to avoid) that has a smooth and clear one, (n, 2). Raises
    the last attempt's NoRoute if none has."""
    for points_m, discs in attempts:
        try:
            return find_route([(float(x), float(y)) for x, y in points_m], discs, half_m, out_of_time=out_of_time)
        except NoRoute as error:
            reason = error
    raise reason


def _with_straight_ends(ends: Sequence[Array], discs: Array) -> list[Array]:
    """The two ends of a path, and between them, for each end that lies in a disc, a point OFF_M straight away from the nearest
    centre: at the rim of a small disc there is no room for a smooth bend."""
    points = list(ends)
    for index, end in ((1, ends[0]), (-1, ends[1])):
        apart_m = np.hypot(*(discs[:, :2] - end).T)
        inside = np.flatnonzero((apart_m < discs[:, 2]) & (apart_m > 0.0))
        if len(inside):
            nearest = inside[np.argmin(apart_m[inside])]
            away = (end - discs[nearest, :2]) / apart_m[nearest]
            points.insert(index, end + OFF_M * away)
    return points


def _can_be_flown(experiment: Experiment, transfer: Transfer, start_rad: float) -> bool:
    """True if a transfer that begins at the heading `start_rad` keeps the vehicle's limits at its planned speed."""
    slowdown = required_slowdown(experiment, {0: add_heading(transfer, start_rad, experiment)})
    return float(np.max(slowdown)) <= 1.0


def _shrunk_to_free(discs: Array, by_m: float, *ends: Array) -> Array:
    """Discs (k, 3: x, y, radius), shrunk where needed until every end is outside by `by_m`: a robot that rests near an
    obstacle may leave, and may come to rest there."""
    if len(discs) == 0:
        return discs
    nearest_end_m = np.min([np.hypot(*(discs[:, :2] - end).T) for end in ends], axis=0)
    radius_m = np.minimum(discs[:, 2], np.maximum(nearest_end_m * (1.0 - 1e-9) - by_m, 0.0))
    return np.column_stack([discs[:, :2], radius_m])


def ramp(time_s: Array) -> tuple[Array, Array, Array]:
    """Time of a clock that starts at rate 0 and runs at rate 1 after RAMP_S, (n,) in s, and its two time derivatives."""
    u = np.clip(time_s / RAMP_S, 0.0, 1.0)
    clock_s = RAMP_S * (u**3 - 0.5 * u**4) + np.maximum(time_s - RAMP_S, 0.0)
    return clock_s, 3.0 * u**2 - 2.0 * u**3, 6.0 * u * (1.0 - u) / RAMP_S


def s_curve_profile(length_m: float, speed_mps: float, period_s: float) -> tuple[Array, Array, Array]:
    """Distance (n,) and its two time derivatives: from rest to `speed_mps` and to rest again, without a jump in
    acceleration."""
    speed = min(speed_mps, length_m / RAMP_S)
    cruise_s = length_m / speed - RAMP_S
    time_s = period_s * np.arange(math.ceil((cruise_s + 2.0 * RAMP_S) / period_s) + 1, dtype=np.float64)
    up, down = ramp(time_s), ramp(time_s - cruise_s - RAMP_S)
    distance_m, rate_mps, rate_mps2 = (speed * a - speed * b for a, b in zip(up, down, strict=True))
    return np.minimum(distance_m, length_m), rate_mps, rate_mps2


def _along(
    path: SplinePath | None, start: Array, flat_m: float, rise_m: float, distance_m: Array, rate_mps: Array, rate_mps2: Array
) -> Transfer:
    """Motion along a path of length `flat_m`, and down by `rise_m` in step with it (z points down). `distance_m` (n,) and its
    two time derivatives are measured along the longer of the two."""
    longer_m = max(flat_m, abs(rise_m))
    position, velocity = np.tile(start[:3], (len(distance_m), 1)), np.zeros((len(distance_m), 3))
    acceleration = np.zeros((len(distance_m), 3))
    if path is not None:
        share = flat_m / longer_m
        at = path.at(share * distance_m)
        position[:, :2] = at.position_m[:, :2]
        along_mps, along_mps2 = (share * rate_mps)[:, None], (share * rate_mps2)[:, None]
        velocity[:, :2] = at.velocity_mps[:, :2] * along_mps
        acceleration[:, :2] = at.acceleration_mps2[:, :2] * along_mps**2 + at.velocity_mps[:, :2] * along_mps2
    share = rise_m / longer_m
    position[:, 2] += share * distance_m
    velocity[:, 2], acceleration[:, 2] = share * rate_mps, share * rate_mps2
    return Transfer(position, velocity, acceleration)


def pad(transfer: Transfer, before: int, length: int) -> Transfer:
    """Transfer that rests `before` samples longer at its start, and at its end until it has `length` samples."""
    behind = max(length - before - len(transfer), 0)
    still = np.zeros((before, 3)), np.zeros((behind, 3))
    return Transfer(
        np.vstack(
            [np.tile(transfer.position[0], (before, 1)), transfer.position, np.tile(transfer.position[-1], (behind, 1))]
        ),
        np.vstack([still[0], transfer.velocity, still[1]]),
        np.vstack([still[0], transfer.acceleration, still[1]]),
    )


def join(first: Transfer, then: Transfer) -> Transfer:
    """Transfer made of two, one after the other."""
    return Transfer(
        np.vstack([first.position, then.position]),
        np.vstack([first.velocity, then.velocity]),
        np.vstack([first.acceleration, then.acceleration]),
    )


def add_heading(transfer: Transfer, yaw_rad: float, experiment: Experiment) -> NodeMotion:
    """Motion with headings along the velocity, from the heading `yaw_rad` on. While it rests the robot turns from its last to
    its next direction, the shorter way."""
    moving = np.hypot(transfer.velocity[:, 0], transfer.velocity[:, 1]) > NEAR_M
    direction = np.arctan2(transfer.velocity[:, 1], transfer.velocity[:, 0])
    yaw, period_s = np.full(len(transfer), yaw_rad), experiment.controller.period_s
    edges = np.flatnonzero(np.diff(np.concatenate([[False], moving, [False]]).astype(np.intp)))
    last_rad, rest_begin = yaw_rad, 0
    for begin, end in edges.reshape(-1, 2).tolist():  # samples of one stretch in motion
        headings = np.unwrap(direction[begin:end])
        headings += 2.0 * np.pi * round((last_rad - headings[0]) / (2.0 * np.pi))
        yaw[rest_begin:begin] = turn_profile(last_rad, float(headings[0]), begin - rest_begin)
        yaw[begin:end], last_rad, rest_begin = headings, float(headings[-1]), end
    yaw[rest_begin:] = last_rad
    rate_radps, rate_radps2 = heading_rates(yaw, period_s)
    return NodeMotion(
        np.column_stack([transfer.position, yaw]),
        np.column_stack([transfer.velocity, rate_radps]),
        np.column_stack([transfer.acceleration, rate_radps2]),
    )


def heading_rates(yaw_rad: Array, period_s: float) -> tuple[Array, Array]:
    """First and second derivative (n,) of a heading that rests at both ends."""
    if len(yaw_rad) < 2:
        return np.zeros(len(yaw_rad)), np.zeros(len(yaw_rad))
    rate = np.gradient(yaw_rad, period_s)
    rate[[0, -1]] = 0.0
    return rate, np.gradient(rate, period_s)


def turn_samples(experiment: Experiment) -> int:
    """Samples that a robot needs for half a turn on the spot, within its limits. Raises NoRoute for one that cannot turn."""
    period_s, turn_s = experiment.controller.period_s, TURN_S
    while turn_s <= LONGEST_TURN_S:
        samples = round(turn_s / period_s)
        pose = np.zeros((samples + 2, 4))
        pose[1:-1, 3], pose[-1, 3] = turn_profile(0.0, math.pi, samples), math.pi
        velocity, acceleration = np.zeros_like(pose), np.zeros_like(pose)
        velocity[:, 3], acceleration[:, 3] = heading_rates(pose[:, 3], period_s)
        if float(np.max(required_slowdown(experiment, {0: NodeMotion(pose, velocity, acceleration)}))) <= 1.0:
            return samples
        turn_s *= SLOWER_TURN
    raise NoRoute(f"this vehicle does not turn half round within {LONGEST_TURN_S:g} s (limits.yaw_rate_radps, limits.wrench)")


def turn_profile(from_rad: float, to_rad: float, samples: int) -> Array:
    """Headings (samples,) of a smooth turn, without its ends."""
    tau = (np.arange(samples, dtype=np.float64) + 1.0) / (samples + 1.0)
    return from_rad + (to_rad - from_rad) * tau**3 * (10.0 - 15.0 * tau + 6.0 * tau**2)

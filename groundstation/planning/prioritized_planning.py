"""Prioritized planning of transfers: all robots from rest to rest, clear of one another. Pure.

Each robot has a transfer of its own (transfer.py) around islands and obstacles. Robots are planned one after the other. Each
leaves as early as it stays clear of those planned before it, and of those not yet planned, which wait. Ways leave the room
for which robots give way in flight (2R + WAY_ROOM_M). Where no order of robots works so, ways are 2R apart, and robots may
give way on them; where none works then either (two stand on one another's goals), one first makes room.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from groundstation.planning.feasibility import OutOfTime, PlanError, beyond_picture, never, place
from groundstation.planning.formation import NodeMotion
from groundstation.planning.route_planner import NoRoute
from groundstation.planning.transfer import FreeSpace, Transfer, add_heading, free_space, is_free, join, pad, plan_transfer
from shoal.config.controller import WAY_ROOM_M
from shoal.config.experiment import Experiment
from shoal.frames import Array

WAIT_STEP_S = 1.0
LONGEST_WAIT_S = 120.0
NEAR_M = 1e-3  # of the distance to keep: rounding
TRACKED_M = 0.02  # robots fly that near to their transfers; farther off, they may have to give way
ABSURD_M = 1.0  # a reported pose further outside twice the basin is refused,
ABSURD_RAD = 1e4  # and so is a heading beyond this
ORDERS = 6  # orders of the robots that are tried
ASIDE_M = (0.8, 1.2, 1.8, 2.6)  # how far a robot goes to make room
ASIDE_WAYS = 12
MAKING_ROOM = 2  # robots that do so at most
MOST_TRIES = 1500  # orders of robots in all; a dense fleet has more


class _Exhausted(Exception):
    """No more tries, or no more time. The text is the reason."""


class _Tries:
    """Tries that are left. Time is asked for before each: a try with twenty robots takes a tenth of a second."""

    def __init__(self, out_of_time: OutOfTime) -> None:
        self._left, self.out_of_time = MOST_TRIES, out_of_time

    def spend(self) -> None:
        """Count a try. Raises _Exhausted."""
        if self.out_of_time():
            raise _Exhausted(f"in time, in {MOST_TRIES - self._left} tries")
        if self._left == 0:
            raise _Exhausted(f"in {MOST_TRIES} tries")
        self._left -= 1


def plan_transfers(
    experiment: Experiment,
    starts: Mapping[int, Array],
    goals: Mapping[int, Array],
    obstacles: Array,
    out_of_time: OutOfTime = never,
) -> dict[int, NodeMotion]:
    """Plan motions of all robots, equally long, from `starts` to `goals`, poses (4,). Raises PlanError with the reason, also
    when `out_of_time`."""
    for robot, rest in starts.items():
        if not np.all(np.abs(rest[:3]) <= np.array(experiment.pool.size_m) + ABSURD_M):
            raise PlanError(f"robot {robot} says that it is at ({rest[0]:.3g}, {rest[1]:.3g}, {rest[2]:.3g}) m")
        if not abs(rest[3]) <= ABSURD_RAD:  # true for NaN too
            raise PlanError(f"robot {robot} says that it heads {rest[3]:.3g} rad")
    least_m, tries = 2.0 * experiment.safety.radius_m, _Tries(out_of_time)
    try:
        try:  # so far apart that robots on these ways do not give way to one another
            around = free_space(experiment, obstacles, least_m + WAY_ROOM_M + TRACKED_M)
            transfers = _plan_in_sight(experiment, around, starts, goals, 0, tries)
        except PlanError:
            around = free_space(experiment, obstacles, least_m)
            transfers = _plan_in_sight(experiment, around, starts, goals, MAKING_ROOM, tries)
    except _Exhausted as error:
        raise PlanError(f"no ways clear of one another have been found {error}") from None
    return {robot: add_heading(transfer, float(starts[robot][3]), experiment) for robot, transfer in transfers.items()}


def _plan_in_sight(
    experiment: Experiment,
    around: FreeSpace,
    starts: Mapping[int, Array],
    goals: Mapping[int, Array],
    depth: int,
    tries: _Tries,
) -> dict[int, Transfer]:
    """See `_plan_all`; in the camera's picture. Raises PlanError, and _Exhausted."""
    transfers = _plan_all(experiment, around, dict(starts), dict(goals), depth, tries)
    for robot, transfer in transfers.items():
        _stays_in_sight(experiment, robot, transfer)
    return transfers


def _stays_in_sight(experiment: Experiment, robot: int, transfer: Transfer) -> None:
    """Raise PlanError if a robot would leave the camera's picture. One that rests at the picture's edge may leave from there,
    and may come to rest there."""
    if not experiment.localizer.uses_camera:
        return
    beyond_m = beyond_picture(experiment, transfer.position)
    worst = int(np.argmax(beyond_m))
    if beyond_m[worst] > max(0.0, beyond_m[0], beyond_m[-1]) + NEAR_M:
        where = place(transfer.position[worst])
        raise PlanError(f"robot {robot}: its way leads {beyond_m[worst]:.3f} m beyond the camera's picture, at {where}")


def _plan_all(
    experiment: Experiment,
    around: FreeSpace,
    starts: dict[int, Array],
    goals: dict[int, Array],
    depth: int,
    tries: _Tries,
) -> dict[int, Transfer]:
    """Plan in each order of priority until one succeeds; else let a robot make room first, `depth` times at most."""
    reason = "no robots"
    for order in _orders(starts, goals):
        try:
            return _plan_in_order(experiment, around, starts, goals, order, tries)
        except PlanError as error:
            reason = str(error)
    if depth:
        for robot, aside in _places_to_make_room(experiment, around, starts, goals):
            elsewhere = {**starts, robot: aside}
            try:
                first = _plan_in_order(experiment, around, starts, elsewhere, list(starts), tries)
                rest = _plan_all(experiment, around, elsewhere, goals, depth - 1, tries)
            except PlanError:
                continue
            return {r: join(first[r], rest[r]) for r in starts}
    raise PlanError(reason)


def _orders(starts: Mapping[int, Array], goals: Mapping[int, Array]) -> Iterator[list[int]]:
    """Orders of the robots to try: shorter distances first, and rotations of that order."""
    by_way = sorted(starts, key=lambda r: (float(np.linalg.norm(goals[r][:3] - starts[r][:3])), r))
    for turn in range(min(ORDERS // 2, len(by_way))):
        turned = by_way[turn:] + by_way[:turn]
        yield turned
        yield turned[::-1]


def _in_sight(experiment: Experiment, eta: Array) -> bool:
    return not experiment.localizer.uses_camera or float(beyond_picture(experiment, eta[None, :3])[0]) <= 0.0


def _places_to_make_room(
    experiment: Experiment, around: FreeSpace, starts: Mapping[int, Array], goals: Mapping[int, Array]
) -> Iterator[tuple[int, Array]]:
    """Robots that stand on another's goal, each with a place to make room at, near places first."""
    keep_m = around.apart_m

    def distances_m(place: Array, others: Iterable[Array]) -> list[float]:
        return [float(np.linalg.norm(other[:2] - place[:2])) for other in others]

    def blocks_another(robot: int) -> bool:
        other_goals = [goal for other, goal in goals.items() if other != robot]
        return any(distance_m < keep_m for distance_m in distances_m(starts[robot], other_goals))

    blockers = [robot for robot in starts if blocks_another(robot)]
    for far_m in ASIDE_M:
        for robot in blockers:
            others = [place[other] for other in starts if other != robot for place in (starts, goals)]
            for angle in 2.0 * np.pi / ASIDE_WAYS * np.arange(ASIDE_WAYS):
                aside = starts[robot].copy()
                aside[:2] += far_m * np.array([np.cos(angle), np.sin(angle)])
                is_clear = all(distance_m > keep_m for distance_m in distances_m(aside, others))
                if is_clear and is_free(aside[:2], around) and _in_sight(experiment, aside):
                    yield robot, aside


def _plan_in_order(
    experiment: Experiment,
    around: FreeSpace,
    starts: Mapping[int, Array],
    goals: Mapping[int, Array],
    order: Sequence[int],
    tries: _Tries,
) -> dict[int, Transfer]:
    """Plan one robot after the other, each around those before it. Raises PlanError if one finds no way."""
    tries.spend()
    plans: dict[int, Transfer] = {}
    for robot in order:
        waiting = {r: starts[r] for r in order if r not in plans and r != robot}
        plans[robot] = _earliest(experiment, around, robot, starts, goals, plans, waiting, tries.out_of_time)
    longest = max(map(len, plans.values()))
    return {robot: pad(plans[robot], 0, longest) for robot in starts}


def _earliest(
    experiment: Experiment,
    around: FreeSpace,
    robot: int,
    starts: Mapping[int, Array],
    goals: Mapping[int, Array],
    plans: Mapping[int, Transfer],
    waiting: Mapping[int, Array],
    out_of_time: OutOfTime,
) -> Transfer:
    """Earliest transfer of a robot that is clear of all others: straight there, or around robots that rest."""
    reasons = []
    step = round(WAIT_STEP_S / experiment.controller.period_s)
    for detour in (False, True):
        parked = [*waiting.values(), *(goals[r] for r in plans)] if detour else []
        try:
            transfer = plan_transfer(experiment, around, starts[robot], goals[robot], parked, out_of_time)
        except NoRoute as error:
            reasons.append(f"robot {robot}: {error}")
            continue
        if _conflict(around, robot, transfer, starts, goals, {}, waiting):
            reasons.append(f"robot {robot} would pass too near a robot that waits")
            continue
        for wait in range(round(LONGEST_WAIT_S / WAIT_STEP_S)):
            later = pad(transfer, wait * step, 0)
            if not _conflict(around, robot, later, starts, goals, plans, {}):
                return later
            if wait * step > max(map(len, plans.values()), default=0):
                break
        reasons.append(f"robot {robot} would pass too near another robot")
    raise PlanError(reasons[-1])


def _conflict(
    around: FreeSpace,
    robot: int,
    transfer: Transfer,
    starts: Mapping[int, Array],
    goals: Mapping[int, Array],
    plans: Mapping[int, Transfer],
    waiting: Mapping[int, Array],
) -> bool:
    """True if a transfer comes too close to one already planned, or to a robot that still waits at its start."""
    for other in (*plans, *waiting):
        length = max(len(transfer), len(plans[other]) if other in plans else 0)
        there = pad(plans[other], 0, length).position if other in plans else waiting[other][None, :3]
        apart_m = float(np.linalg.norm(pad(transfer, 0, length).position - there, axis=1).min())
        if apart_m < _keep_m(around, starts, goals, robot, other):
            return True
    return False


def _keep_m(around: FreeSpace, starts: Mapping[int, Array], goals: Mapping[int, Array], a: int, b: int) -> float:
    """Distance in m that two robots keep, less where they rest nearer now or at the end."""
    rests = (float(np.linalg.norm(places[a][:3] - places[b][:3])) for places in (starts, goals))
    return min(around.apart_m, *rests) - NEAR_M

"""Changes of a segment under way that keep its clock: past obstacles on any common path, and into another form. Pure.

    segment = move_past(experiment, segment, begin_s, obstacles)   # all robots move aside alike, and back
    segment = reshape(experiment, segment, begin_s, changes)       # each robot moves within the formation

Both add a shift to the trajectories that are flown, so they suit circles and laps, which lead to no place. A detour to the
places of a route is shorter (groundstation/planning/replanning.py).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from groundstation.planning import planner
from groundstation.planning.feasibility import PlanError, pair_problems, robot_problems
from groundstation.planning.formation import (
    STANDSTILL_MPS,
    NodeMotion,
    SlotOffset,
    own_heading,
    quintic_blend,
    slot_offsets,
    structure_rotation,
)
from groundstation.planning.segment import PlanSegment, ceil_to_period, sample, with_forms
from shoal.config.experiment import Experiment
from shoal.config.scene import Change
from shoal.frames import Array

ASIDE_S = (5.0, 8.0, 13.0, 20.0)  # to move aside, and to come back; tried in turn
EARLIER_S = (1.0, 3.0)  # aside this long before and after the place; tried in turn
LEAST_ASIDE_S = 2.0  # nearer to an obstacle there is no time to move aside
STEP_M = 0.1  # between two distances aside that are tried
MOST_M = 4.0  # aside
SLOW_MPS = 1e-3  # of the centre: slower, there is no side to move to
EXACT_M = 1e-6
TAKEN_S = 1e-3  # a form that robots take at rest counts from so long before they fly on: behind all changes begun before it


def common_path(experiment: Experiment) -> bool:
    """True if all robots fly around one centre."""
    return all(robot.path is None for robot in experiment.robots)


def reshape(experiment: Experiment, segment: PlanSegment, begin_s: float, changes: Sequence[Change]) -> PlanSegment:
    """Plan another form from `begin_s` on: the first of `changes`, the same one at different paces, that can be flown. Forms
    that the experiment changes to later still follow. Raises PlanError."""
    if not common_path(experiment):
        raise PlanError("robots have paths of their own: there is no formation to change")
    reason = PlanError("no form was given")
    for change in changes:
        try:
            reshaped = shifted(experiment, segment, begin_s, form_shifts(experiment, segment, begin_s, change))
            return replace(reshaped, forms=(*segment.forms, change))
        except PlanError as error:
            reason = error
    raise reason


def in_form(experiment: Experiment, segment: PlanSegment, from_s: float, change: Change) -> PlanSegment:
    """The segment, from `from_s` on, as if the formation had taken another form before, whatever changes had begun by then.
    Raises PlanError."""
    begin_s = ceil_to_period(from_s, segment.centre.period_s)
    changes = with_forms(experiment, segment).formation.changes  # the newest of those that begin at one instant comes last
    begun_s = max([each.at_s for each in changes if each.at_s < from_s - TAKEN_S], default=-np.inf)
    taken = change.model_copy(update={"at_s": max(begun_s, from_s - 2.0 * TAKEN_S), "over_s": 0.5 * TAKEN_S})
    reshaped = shifted(experiment, segment, begin_s, form_shifts(experiment, segment, begin_s, taken))
    return replace(reshaped, forms=(*segment.forms, taken))


def form_shifts(experiment: Experiment, segment: PlanSegment, begin_s: float, change: Change) -> dict[int, SlotOffset]:
    """Shift of each slot by a change of form."""
    time_s, centre = _ahead(segment, begin_s)
    nodes, after = experiment.nodes_m(), replace(segment, forms=(*segment.forms, change))
    old, new = (
        slot_offsets(nodes, with_forms(experiment, each).formation.changes, time_s, experiment.robot_ids)
        for each in (segment, after)
    )
    turns = np.zeros_like(centre.eta[:, 3])
    yaw, rate, bend = (centre.eta[:, 3], centre.velocity[:, 3], centre.acceleration[:, 3])
    if experiment.formation.mode == "translate":
        yaw, rate, bend = turns + np.pi / 2.0, turns, turns
    shifts = {}
    for robot, was, will in zip(experiment.robots, old, new, strict=True):
        within = SlotOffset(will.place_m - was.place_m, will.rate_mps - was.rate_mps, will.bend_mps2 - was.bend_mps2)
        shifts[robot.id] = _turned(within, yaw, rate, bend)
    return shifts


def _turned(within: SlotOffset, yaw: Array, rate: Array, bend: Array) -> SlotOffset:
    """A shift s in a level structure that turns, in the pool frame (node_motion). R: the structure's rotation, w: its turn
    rate about the vertical z.

        p = R s        p' = w z x p + R s'        p'' = w' z x p - w^2 p + 2 w z x R s' + R s''        (- w^2 p: x and y alone)
    """
    rotation = structure_rotation(yaw, np.zeros_like(yaw))
    place, velocity, acceleration = (
        np.einsum("nij,nj->ni", rotation, each) for each in (within.place_m, within.rate_mps, within.bend_mps2)
    )
    across_place, across_velocity = (
        np.column_stack([-each[:, 1], each[:, 0], np.zeros(len(each))]) for each in (place, velocity)
    )
    inward = -place * np.array([1.0, 1.0, 0.0])
    w, w_rate = rate[:, None], bend[:, None]
    return SlotOffset(
        place,
        w * across_place + velocity,
        w_rate * across_place + w**2 * inward + 2.0 * w * across_velocity + acceleration,
    )


def move_past(experiment: Experiment, segment: PlanSegment, begin_s: float, obstacles: Array, clear_m: float) -> PlanSegment:
    """Move the whole formation aside wherever a robot would come nearer than safety.radius_m and `clear_m` to an obstacle
    (k, 3: x, y, radius). Raises PlanError that says which obstacle has no way past it, and why."""
    if not common_path(experiment):
        raise PlanError("robots have paths of their own: none can be led past it together")
    time_s, centre = _ahead(segment, begin_s)
    flown = max(round((segment.end_s - begin_s) / segment.centre.period_s) + 1, 2)
    places = np.array([sample(t, time_s).eta[:, :2] for t in segment.trajectories.values()])[:, :flown]
    keep_m = obstacles[:, 2] + experiment.safety.radius_m + clear_m
    spans = _spans(places, obstacles, keep_m)
    if not spans:
        raise PlanError("nothing lies on the path")
    reason = PlanError("")
    for aside_s in ASIDE_S:
        for earlier_s in EARLIER_S:
            for shift in _clear_shifts(segment, spans, places, centre, (obstacles, keep_m), (aside_s, earlier_s)):
                try:
                    return shifted(experiment, segment, begin_s, dict.fromkeys(segment.trajectories, shift), shift)
                except PlanError as error:
                    reason = error
    x, y, _ = obstacles[_nearest(places, obstacles, spans[0])]
    why = str(reason).partition("\n")[0] or "robots would still be too near on either side, or there is no time to move aside"
    raise PlanError(f"beside the obstacle at ({x:z.2f}, {y:z.2f}) m: {why}")


def _spans(places: Array, obstacles: Array, keep_m: Array) -> list[tuple[int, int]]:
    """First and last sample of each passage by obstacles on which a robot is too near."""
    apart = np.hypot(*(places[:, :, None] - obstacles[:, :2]).transpose(3, 0, 1, 2))
    near = np.flatnonzero((apart < keep_m).any(axis=(0, 2)))
    if not len(near):
        return []
    is_gap = np.diff(near) > 1  # between one of these samples and the next
    firsts, lasts = near[np.insert(is_gap, 0, True)], near[np.append(is_gap, True)]
    return list(zip(firsts.tolist(), lasts.tolist(), strict=True))


def _nearest(places: Array, obstacles: Array, span: tuple[int, int]) -> int:
    """Number of the obstacle that a robot comes nearest to in a span."""
    part = places[:, span[0] : span[1] + 1]
    return int(np.hypot(*(part[:, :, None] - obstacles[:, :2]).transpose(3, 0, 1, 2)).min(axis=(0, 1)).argmin())


def _clear_shifts(
    segment: PlanSegment,
    spans: list[tuple[int, int]],
    places: Array,
    centre: NodeMotion,
    around: tuple[Array, Array],
    paces_s: tuple[float, float],
) -> Iterator[SlotOffset]:
    """Shifts, the least on each side, on which every robot stays clear of the obstacles `around` (and their distances)."""
    obstacles, keep_m = around
    period_s, (aside_s, earlier_s) = segment.centre.period_s, paces_s
    profile = _profile(spans, len(centre.eta), period_s, aside_s, earlier_s)
    if profile is None or np.hypot(*centre.velocity[: places.shape[1], :2].T).max() < SLOW_MPS:
        return
    sides = set[float]()
    for step in range(1, round(MOST_M / STEP_M) + 1):
        for side in {-1.0, 1.0} - sides:
            shift = _aside(profile, side * step * STEP_M, centre)
            moved = places + shift.place_m[: places.shape[1], :2]
            apart = np.hypot(*(moved[:, :, None] - obstacles[:, :2]).transpose(3, 0, 1, 2))
            if bool((apart >= keep_m).all()):
                sides.add(side)
                yield shift
        if len(sides) == 2:
            return


def _profile(
    spans: list[tuple[int, int]], samples: int, period_s: float, aside_s: float, earlier_s: float
) -> tuple[Array, Array, Array] | None:
    """Share (samples,) of the distance aside, 1 at the spans and 0 away from them, and its derivatives; None if there is no
    time to move aside before the first."""
    joined = [spans[0]]
    for before, after in pairwise(spans):
        if (after[0] - before[1]) * period_s < 2.0 * (aside_s + earlier_s):
            joined[-1] = joined[-1][0], after[1]
        else:
            joined.append(after)
    time_s = period_s * np.arange(samples, dtype=np.float64)
    share = np.zeros((3, samples))
    for first, last in joined:
        from_s, until_s = max(first * period_s - earlier_s, 0.0), last * period_s + earlier_s
        begin_s = max(from_s - aside_s, 0.0)
        if from_s - begin_s < LEAST_ASIDE_S:
            return None
        up, down = from_s - begin_s, aside_s
        rise = quintic_blend(np.clip((time_s - begin_s) / up, 0.0, 1.0), up)
        fall = quintic_blend(np.clip((time_s - until_s) / down, 0.0, 1.0), down)
        share += np.array(rise) - np.array(fall)
    return share[0], share[1], share[2]


def _aside(profile: tuple[Array, Array, Array], distance_m: float, centre: NodeMotion) -> SlotOffset:
    """Shift along the normal of the centre's motion; positive to starboard."""
    d, d1, d2 = (distance_m * each[:, None] for each in profile)
    yaw, rate, bend = centre.eta[:, 3], centre.velocity[:, 3, None], centre.acceleration[:, 3, None]
    zero = np.zeros_like(yaw)
    along, normal = np.column_stack([np.cos(yaw), np.sin(yaw), zero]), np.column_stack([-np.sin(yaw), np.cos(yaw), zero])
    return SlotOffset(
        d * normal,
        d1 * normal - d * rate * along,
        (d2 - d * rate**2) * normal - (2.0 * d1 * rate + d * bend) * along,
    )


def _ahead(segment: PlanSegment, begin_s: float) -> tuple[Array, NodeMotion]:
    """Instants from `begin_s` to the end of a segment's trajectories, and the centre's motion there."""
    centre = segment.centre
    left = len(centre.eta) - round((begin_s - centre.begin_s) / centre.period_s)
    if left < 2:
        raise PlanError("the path's end is too near")
    time_s = begin_s + centre.period_s * np.arange(left, dtype=np.float64)
    return time_s, sample(centre, time_s)


def shifted(
    experiment: Experiment,
    segment: PlanSegment,
    begin_s: float,
    shifts: Mapping[int, SlotOffset],
    of_centre: SlotOffset | None = None,
) -> PlanSegment:
    """The segment from `begin_s` on with a shift of each slot. Headings are those of the resulting motion. Raises PlanError
    with every reason for which it must not be flown."""
    period_s = segment.centre.period_s
    time_s, centre = _ahead(segment, begin_s)
    motions = {slot: _shifted_motion(sample(t, time_s), shifts[slot], period_s) for slot, t in segment.trajectories.items()}
    flown = min(round((segment.end_s - begin_s) / period_s) + 1, len(time_s))
    problems = [*robot_problems(experiment, motions, flown, begin_s), *pair_problems(experiment, motions, flown, begin_s)]
    if problems:
        raise PlanError("\n".join(problems))
    middle = centre if of_centre is None else _shifted_motion(centre, of_centre, period_s)
    return replace(
        segment,
        trajectories={slot: planner.trajectory(motion, period_s, begin_s) for slot, motion in motions.items()},
        centre=planner.trajectory(middle, period_s, begin_s),
    )


def _shifted_motion(base: NodeMotion, shift: SlotOffset, period_s: float) -> NodeMotion:
    """A motion and a shift. Where the shift begins at 0 the heading begins as the motion's. A robot that stands still differs
    from the motion's heading as when it moved last, or as when it sets out."""
    place, velocity = base.eta[:, :3] + shift.place_m, base.velocity[:, :3] + shift.rate_mps
    acceleration = base.acceleration[:, :3] + shift.bend_mps2
    if float(np.abs(shift.place_m).max()) < EXACT_M:
        return base
    yaw, rate = own_heading(velocity, acceleration, base.eta[:, 3], base.velocity[:, 3])
    moves = np.hypot(*velocity[:, :2].T) > STANDSTILL_MPS
    moving = np.maximum(np.maximum.accumulate(np.where(moves, np.arange(len(moves)), -1)), int(np.argmax(moves)))
    yaw = np.unwrap(np.where(moves, yaw, base.eta[:, 3] + (yaw - base.eta[:, 3])[moving]))
    yaw += 2.0 * np.pi * round(float(base.eta[0, 3] - yaw[0]) / (2.0 * np.pi))
    if float(np.abs(shift.place_m[0]).max()) < EXACT_M:
        yaw[0], rate[0] = base.eta[0, 3], base.velocity[0, 3]  # exactly, without rounding
    return NodeMotion(
        np.column_stack([place, yaw]),
        np.column_stack([velocity, rate]),
        np.column_stack([acceleration, np.gradient(rate, period_s)]),
    )

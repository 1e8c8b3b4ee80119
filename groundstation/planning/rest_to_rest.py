"""Plans for robots that hold: into their slots of a segment and on along it, or back to the starts. Pure.

    segment = plan_regroup(experiment, segment, begin_s, progress_s, rests, slots)   # into their slots, and on
    segment = plan_return(experiment, begin_s, rests, starts)                        # back to the starts

groundstation/planning/prioritized_planning.py plans the transfers, clear of one another.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.optimize import linear_sum_assignment

from groundstation.planning import planner
from groundstation.planning.feasibility import OutOfTime, PlanError, give_way, never
from groundstation.planning.formation import NodeMotion
from groundstation.planning.prioritized_planning import plan_transfers
from groundstation.planning.segment import NO_OBSTACLES, PlanSegment, sample
from groundstation.planning.transfer import RAMP_S, heading_rates, ramp, turn_profile, turn_samples
from shoal.config.experiment import Experiment
from shoal.config.scene import Change
from shoal.frames import Array
from shoal.messages.messages import Trajectory

SETTLE_S = 5.0  # at the end of a return, before robots are disarmed
DRIFT_M = 0.15  # obstacles and robots without control drift while the others move into place
SAME_M = 1e-3  # more than rounding

Rests = Mapping[int, Array]  # poses (4,) of robots that are at rest


def plan_return(
    experiment: Experiment,
    begin_s: float,
    rests: Rests,
    starts: Rests,
    obstacles: Array = NO_OBSTACLES,
    out_of_time: OutOfTime = never,
    lying: Array = NO_OBSTACLES,
) -> PlanSegment:
    """Plan the return of the robots in `rests` from their rest poses to their starts. The ways lead around `obstacles`; none
    may end on a place of `lying`. Raises PlanError."""
    goals = {r: starts[r] for r in rests}
    _must_be_free(experiment, rests, goals, lying)
    motions = plan_transfers(experiment, rests, goals, keep_away(experiment, obstacles), out_of_time)
    period_s = experiment.controller.period_s
    trajectories = {r: planner.trajectory(_at_least_two(m), period_s, begin_s) for r, m in motions.items()}
    some = next(iter(trajectories.values()))
    return PlanSegment(trajectories, some, begin_s + (len(some.eta) - 1) * period_s + SETTLE_S, is_return=True)


def plan_regroup(
    experiment: Experiment,
    segment: PlanSegment,
    begin_s: float,
    progress_s: float,
    rests: Rests,
    slots: Mapping[int, int],
    obstacles: Array = NO_OBSTACLES,
    out_of_time: OutOfTime = never,
) -> PlanSegment:
    """Plan transfers from rest into the slots of a segment at `progress_s`, and on along it. Where an obstacle lies in a slot,
    or slots are those of paths through one another, the transfers lead further along the segment, until all are free."""
    period_s, away = experiment.controller.period_s, keep_away(experiment, obstacles)
    progress_s = _free_from(experiment, segment, max(progress_s, segment.transfer_end_s), [slots[r] for r in rests], away)
    places = {r: sample(segment.trajectories[slots[r]], np.array([progress_s])).eta[0] for r in rests}
    moves = plan_transfers(experiment, rests, places, away, out_of_time)
    still = max(len(m.eta) for m in moves.values())
    on_way = {slots[r]: m for r, m in moves.items()}
    left = round((segment.end_s - progress_s + 0.5 * RAMP_S) / period_s) + planner.horizon(experiment)  # as much as there is
    turn = turn_samples(experiment)
    trajectories = {
        s: _then_trajectory(t, on_way.get(s), still, turn, progress_s, left) for s, t in segment.trajectories.items()
    }
    moved = {s: planner.trajectory(m, period_s, begin_s) for s, m in trajectories.items()}
    centre = planner.trajectory(_then_trajectory(segment.centre, None, still, turn, progress_s, left), period_s, begin_s)
    end_s = begin_s + (still + turn) * period_s + (segment.end_s - progress_s) + 0.5 * RAMP_S
    on_s = begin_s + (still + turn) * period_s
    forms = tuple(_behind_rest(form, progress_s, on_s - progress_s) for form in segment.forms)
    path_s = segment.path_s + on_s + 0.5 * RAMP_S - progress_s
    return PlanSegment(moved, centre, end_s, segment.is_return, segment.via, forms, on_s, path_s)


def _behind_rest(form: Change, progress_s: float, rested_s: float) -> Change:
    """A change of form on the clock behind a rest of `rested_s` at `progress_s`. Of what had begun by then the beginning lies
    before robots fly on: a form that they take later comes after it."""
    at_s, ends_s = (
        time_s + rested_s + (0.0 if time_s <= progress_s else 0.5 * RAMP_S) for time_s in (form.at_s, form.at_s + form.over_s)
    )
    return form.model_copy(update={"at_s": at_s, "over_s": ends_s - at_s})


def _free_from(experiment: Experiment, segment: PlanSegment, progress_s: float, slots: Sequence[int], away: Array) -> float:
    """First progress in s at which these slots are clear of `away`, discs (k, 3) that a centre keeps out of, and of one
    another: on different paths robots give way in flight, but cannot rest at one place."""
    period_s = segment.centre.period_s
    time_s = progress_s + period_s * np.arange(max(round((segment.end_s - progress_s) / period_s), 1), dtype=np.float64)
    free, keep_m = np.ones(len(time_s), dtype=bool), 2.0 * experiment.safety.radius_m + experiment.safety.margin_m
    for pair in combinations(slots, 2):
        if give_way(experiment, *pair):
            one, other = (sample(segment.trajectories[slot], time_s).eta[:, :3] for slot in pair)
            apart_m = np.linalg.norm(one - other, axis=1)
            free &= apart_m >= min(keep_m, float(apart_m[-1])) - SAME_M
    for slot in slots if len(away) else ():
        apart = sample(segment.trajectories[slot], time_s).eta[:, None, :2] - away[:, :2]
        free &= np.all(np.hypot(*apart.transpose(2, 0, 1)) > away[:, 2] + SAME_M, axis=1)
    if not free.any():
        raise PlanError("something, or a robot that is not with the formation, lies in its places to the end of the path")
    return float(time_s[int(np.argmax(free))])


def _then_trajectory(
    trajectory: Trajectory, move: NodeMotion | None, still: int, turn: int, progress_s: float, samples: int
) -> NodeMotion:
    """A move of `still` samples (None: rest as long), a turn of `turn` samples, then the trajectory from `progress_s` on with
    a clock that starts slowly."""
    way_s, rate, bend = ramp(trajectory.period_s * np.arange(samples, dtype=np.float64))
    on = sample(trajectory, progress_s + way_s)
    velocity = on.velocity * rate[:, None]
    acceleration = on.acceleration * rate[:, None] ** 2 + on.velocity * bend[:, None]
    if move is None:
        move = NodeMotion(np.tile(on.eta[0], (still, 1)), np.zeros((still, 4)), np.zeros((still, 4)))
    turns = 2.0 * np.pi * round(float(move.eta[-1, 3] - on.eta[0, 3]) / (2.0 * np.pi))
    eta = on.eta + np.array([0.0, 0.0, 0.0, turns])
    facing = np.tile(move.eta[-1], (turn, 1))
    facing[:, 3] = turn_profile(float(move.eta[-1, 3]), float(eta[0, 3]), turn)
    spin, push = np.zeros((turn, 4)), np.zeros((turn, 4))
    spin[:, 3], push[:, 3] = heading_rates(facing[:, 3], trajectory.period_s)
    return NodeMotion(
        np.vstack([move.eta, facing, eta]),
        np.vstack([move.velocity, spin, velocity]),
        np.vstack([move.acceleration, push, acceleration]),
    )


def assign_slots(segment: PlanSegment, time_s: float, eta: Rests, slots: Sequence[int]) -> dict[int, int]:
    """Slot of each robot so that the sum of squared distances is least; straight ways then do not cross."""
    robots = list(eta)
    nodes = np.array([sample(segment.trajectories[s], np.array([time_s])).eta[0, :3] for s in slots])
    costs = np.sum((np.array([eta[r][:3] for r in robots])[:, None] - nodes) ** 2, axis=2)
    chosen = linear_sum_assignment(costs)[1].tolist()
    return {robot: slots[k] for robot, k in zip(robots, chosen, strict=True)}


def keep_away(experiment: Experiment, obstacles: Array) -> Array:
    """Obstacles (k, 3: x, y, radius) as discs that a robot's centre keeps out of."""
    return np.asarray(obstacles.reshape(-1, 3) + np.array([0.0, 0.0, experiment.safety.radius_m + DRIFT_M]))


def _must_be_free(experiment: Experiment, rests: Rests, goals: Rests, obstacles: Array) -> None:
    """Raise PlanError if a hull would touch an obstacle (k, 3: x, y, radius) at its goal. A robot may move away from one."""
    for robot, rest in rests.items():
        there_m, here_m = (np.hypot(*(obstacles[:, :2] - at[:2]).T) - obstacles[:, 2] for at in (goals[robot], rest))
        touching = (there_m < experiment.vehicle.radius_m) & (there_m < here_m)
        if touching.any():
            x, y, _ = obstacles[int(np.argmax(touching))]
            raise PlanError(f"something lies at ({x:z.2f}, {y:z.2f}) m, where robot {robot} should come to rest: take it away")


def _at_least_two(motion: NodeMotion) -> NodeMotion:
    """Motion with two samples or more: a trajectory needs them, also of a robot that stays."""
    if len(motion.eta) >= 2:
        return motion
    twice = replace(motion, eta=np.repeat(motion.eta, 2, axis=0))
    return replace(twice, velocity=np.zeros((2, 4)), acceleration=np.zeros((2, 4)))

"""A leg: what the fleet flies until something changes, and how one follows upon another. Pure.

Legs are made in three ways: by `first_leg`, before the run; by groundstation/planning/replanning.py, under way; by
groundstation/planning/rest_to_rest.py, for robots that hold. All raise PlanError with the reason. Times are on the clock that
runs along the trajectories; it never goes back.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from groundstation.planning import planner
from groundstation.planning.formation import NodeMotion
from wire.config.experiment import Experiment
from wire.frames import Array
from wire.messages.messages import Trajectory

NO_OBSTACLES = np.zeros((0, 3))  # no things: (k, 3), each x, y, radius
BESIDE_M = 0.01  # nearer than at the ends of its way: less is rounding and what the localizer makes of a thing's outline
LONGEST_WAIT = 36_000  # samples: half an hour at 20 Hz


@dataclass(frozen=True, eq=False)
class PlanSegment:
    """What is flown until something changes. `trajectories` are by slot: a robot's own, until gaps close."""

    trajectories: Mapping[int, Trajectory]
    centre: Trajectory
    end_s: float
    is_return: bool = False
    via: tuple[tuple[float, float], ...] = ()  # places that a person asked for instead of the path's
    transfer_end_s: float = 0.0  # before it robots go into their places, each on its own way; the centre stands

    def is_separate(self, progress_s: float) -> bool:
        """Whether robots are then on ways of their own, not in formation."""
        return self.is_return or progress_s < self.transfer_end_s


def first_segment(experiment: Experiment) -> PlanSegment:
    """The run as planned before it."""
    fleet = planner.plan_fleet(experiment)
    return PlanSegment(fleet.trajectories, fleet.centre, experiment.duration_s)


def sample(trajectory: Trajectory, time_s: Array) -> NodeMotion:
    """A trajectory at instants (n,): between its samples linearly, as robots read it; at rest beyond its ends."""
    rows = np.hstack([trajectory.eta, trajectory.velocity, trajectory.acceleration])
    place = (time_s - trajectory.begin_s) / trajectory.period_s
    inside = np.clip(place, 0.0, len(rows) - 1)
    low = np.minimum(inside.astype(np.intp), len(rows) - 2)
    found = rows[low] + (inside - low)[:, None] * (rows[low + 1] - rows[low])
    found[(place < 0.0) | (place > len(rows) - 1), 4:] = 0.0
    return NodeMotion(found[:, :4], found[:, 4:8], found[:, 8:])


def concatenate(flown: Trajectory, then: Trajectory) -> Trajectory:
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


def ceil_to_period(time_s: float, period_s: float) -> float:
    """The first sampling instant at or after `time_s`."""
    return math.ceil(time_s / period_s - 1e-9) * period_s


def first_contact(experiment: Experiment, segment: PlanSegment, from_s: float, until_s: float, obstacles: Array) -> str:
    """Which robot would come nearer than safety.radius_m to which thing (k, 3), when and where; empty if none does.

    On ways of their own robots may begin and end beside things (groundstation/planning/transfer.py): there only who would come
    nearer than at both ends of its way counts.
    """
    if len(obstacles) == 0:
        return ""
    apart = segment.is_separate(from_s)
    ends_s = segment.end_s if segment.is_return or not apart else segment.transfer_end_s
    time_s = np.arange(from_s, min(until_s, ends_s), segment.centre.period_s)
    found = []
    for slot, trajectory in segment.trajectories.items():
        short = _short_m(experiment, trajectory, time_s, obstacles)
        if apart:
            short -= (
                np.maximum(_short_m(experiment, trajectory, np.array([from_s, ends_s]), obstacles).max(axis=0), 0.0) + BESIDE_M
            )
        meets = np.flatnonzero(short.max(axis=1, initial=-np.inf) > 0.0)
        if len(meets):
            first = int(meets[0])
            x, y, _ = obstacles[int(np.argmax(short[first]))]
            found.append(
                (first, f"at ({x:.2f}, {y:.2f}) m, on the path of robot {slot}, in {first * segment.centre.period_s:.1f} s")
            )
    return min(found)[1] if found else ""


def _short_m(experiment: Experiment, trajectory: Trajectory, time_s: Array, obstacles: Array) -> Array:
    """By how much a robot is too near to things (k, 3) at instants (n,): (n, k)."""
    eta = sample(trajectory, time_s).eta
    apart_m = np.hypot(*(eta[:, None, :2] - obstacles[:, :2]).transpose(2, 0, 1))
    return np.asarray(obstacles[:, 2] + experiment.safety.radius_m - apart_m)

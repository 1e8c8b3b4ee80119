"""Plan segment: the trajectories of the fleet until the next change of plan. Pure.

Segments are made in three ways: by `first_segment`, before the run; by groundstation/planning/replanning.py, under way; by
groundstation/planning/rest_to_rest.py, for robots that hold. All raise PlanError with the reason. Times are on the clock that
runs along the trajectories; it never goes back.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from groundstation.planning import planner
from groundstation.planning.feasibility import OutOfTime, never
from groundstation.planning.formation import NodeMotion
from shoal.config.experiment import Experiment
from shoal.config.scene import Change
from shoal.frames import Array
from shoal.messages.messages import Trajectory

NO_OBSTACLES = np.zeros((0, 3))  # discs (k, 3: x, y, radius)
BESIDE_M = 0.01  # nearer than at the ends of a transfer; less is rounding and noise of an obstacle's outline
ON_GRID = 1e-6  # of a period: an instant so near to a sample's is that one, but for rounding
LONGEST_WAIT = 36_000  # samples: half an hour at 20 Hz


@dataclass(frozen=True, eq=False)
class PlanSegment:
    """Trajectories by slot (a robot's own, until gaps close), and the motion of the centre."""

    trajectories: Mapping[int, Trajectory]
    centre: Trajectory
    end_s: float
    is_return: bool = False
    via: tuple[tuple[float, float], ...] = ()  # places that the operator gave instead of the path's
    forms: tuple[Change, ...] = ()  # that the operator gave, besides the experiment's changes, which count from path_s
    transfer_end_s: float = 0.0  # until then robots fly separate transfers into their slots; the centre stands
    path_s: float = 0.0  # at which the path began, or would have without the times at rest and in transfers

    def is_separate(self, progress_s: float) -> bool:
        """True if robots fly separate transfers at `progress_s`, not in formation."""
        return self.is_return or progress_s < self.transfer_end_s


def with_forms(experiment: Experiment, segment: PlanSegment) -> Experiment:
    """The experiment with the changes of form that the operator gave among its own, all on the clock of the segment."""
    own = later(experiment.formation.changes, segment.path_s)
    changes = tuple(sorted((*own, *segment.forms), key=lambda change: change.at_s))
    formation = experiment.formation.model_copy(update={"changes": changes})
    return experiment.model_copy(update={"formation": formation})


def later(changes: Iterable[Change], seconds: float) -> tuple[Change, ...]:
    """Changes of form, each so much later."""
    return tuple(change.model_copy(update={"at_s": change.at_s + seconds}) for change in changes)


def first_segment(experiment: Experiment, out_of_time: OutOfTime = never) -> PlanSegment:
    """Segment of a run as planned before it."""
    fleet = planner.plan_fleet(experiment, out_of_time)
    return PlanSegment(fleet.trajectories, fleet.centre, experiment.duration_s)


def sample(trajectory: Trajectory, time_s: Array) -> NodeMotion:
    """Motion of a trajectory at instants (n,): linear between its samples, as robots read it; at rest beyond its ends."""
    rows = np.hstack([trajectory.eta, trajectory.velocity, trajectory.acceleration])
    place = (time_s - trajectory.begin_s) / trajectory.period_s
    inside = np.clip(place, 0.0, len(rows) - 1)
    low = np.minimum(inside.astype(np.intp), len(rows) - 2)
    values = rows[low] + (inside - low)[:, None] * (rows[low + 1] - rows[low])
    values[(place < -ON_GRID) | (place > len(rows) - 1 + ON_GRID), 4:] = 0.0
    return NodeMotion(values[:, :4], values[:, 4:8], values[:, 8:])


def concatenate(flown: Trajectory, then: Trajectory) -> Trajectory:
    """Trajectory `flown` up to the beginning of `then`, continued by `then`, under its id; for pages and logs that show a
    run. Where the two are longer than a message may be, the beginning is left out."""
    kept = min(max(round((then.begin_s - flown.begin_s) / flown.period_s), 0), len(flown.eta))
    waits = max(round((then.begin_s - flown.begin_s) / flown.period_s) - kept, 0)  # a run that is over goes on later
    if waits > LONGEST_WAIT:
        return then
    still = np.tile(flown.eta[-1], (waits, 1)), np.zeros((waits, 4))
    left_out = max(kept + waits + len(then.eta) - planner.MOST_SAMPLES, 0)
    return Trajectory(
        then.id,
        flown.period_s,
        np.vstack([flown.eta[:kept], still[0], then.eta])[left_out:],
        np.vstack([flown.velocity[:kept], still[1], then.velocity])[left_out:],
        np.vstack([flown.acceleration[:kept], still[1], then.acceleration])[left_out:],
        flown.begin_s + left_out * flown.period_s,
    )


def ceil_to_period(time_s: float, period_s: float) -> float:
    """First sampling instant at or after `time_s`."""
    return math.ceil(time_s / period_s - 1e-9) * period_s


def first_contact(
    experiment: Experiment,
    segment: PlanSegment,
    from_s: float,
    until_s: float,
    obstacles: Array,
    lost: Sequence[int] = (),
) -> str:
    """Text with cause, place, robot and time of the first contact: a robot nearer than safety.radius_m to an obstacle (k, 3);
    empty if there is none. The last obstacles are the `lost` robots.

    A transfer may begin beside an obstacle (groundstation/planning/transfer.py), and end where the hull does not touch it:
    there only a robot counts that comes nearer than it is now, or will be at the end.
    """
    if len(obstacles) == 0:
        return ""
    apart = segment.is_separate(from_s)
    ends_s = segment.end_s if segment.is_return or not apart else segment.transfer_end_s
    time_s = np.arange(from_s, min(until_s, ends_s), segment.centre.period_s)
    contacts = []
    for slot, trajectory in segment.trajectories.items():
        overlap_m = _overlap_m(experiment, trajectory, time_s, obstacles)
        if apart:
            at_begin_m, at_end_m = _overlap_m(experiment, trajectory, np.array([from_s, ends_s]), obstacles)
            without_touch_m = np.minimum(at_end_m, experiment.safety.radius_m - experiment.vehicle.radius_m)
            overlap_m -= np.maximum(np.maximum(at_begin_m, without_touch_m), 0.0) + BESIDE_M
        meets = np.flatnonzero(overlap_m.max(axis=1, initial=-np.inf) > 0.0)
        if len(meets):
            first = int(meets[0])
            nearest = int(np.argmax(overlap_m[first]))
            x, y, _ = obstacles[nearest]
            lost_index = nearest - (len(obstacles) - len(lost))
            cause = f"robot {lost[lost_index]}" if lost_index >= 0 else "something"
            in_s = first * segment.centre.period_s
            contacts.append((first, f"{cause} lies at ({x:z.2f}, {y:z.2f}) m, on the path of robot {slot}, in {in_s:.1f} s"))
    return min(contacts)[1] if contacts else ""


def _overlap_m(experiment: Experiment, trajectory: Trajectory, time_s: Array, obstacles: Array) -> Array:
    """Distance in m by which a robot is nearer than safety.radius_m to obstacles (k, 3) at instants (n,): (n, k)."""
    eta = sample(trajectory, time_s).eta
    apart_m = np.hypot(*(eta[:, None, :2] - obstacles[:, :2]).transpose(2, 0, 1))
    return np.asarray(obstacles[:, 2] + experiment.safety.radius_m - apart_m)

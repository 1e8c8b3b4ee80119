"""A recorded run on one clock, as arrays: what the figures and the results are made from. Pure; alignment.py fills it.

Time 0 is the common start: the first instant at which every robot that flew was under way on its trajectory. Errors are
against the plant's truth, or in a real pool, which has none, against the localizer's poses.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from groundstation.analysis.comparison import (
    SETTLED_S as SETTLED_S,  # ambiguity A14: errors are given for the whole run and from here on
)
from shoal.config.experiment import Experiment
from shoal.config.vehicle import AXES
from shoal.frames import Array, pose_error
from shoal.messages.messages import BoardReading, Control, Estimate, Mode, RobotState, StepTiming

CHANNELS = 8
HOPS = ("localizer", "network, waiting", "control step", "to the board")  # of a pose, from the exposure to the PWM
SLACK_M = 0.001  # less is the solver's own tolerance
AT_LIMIT = 0.999  # of a bound: the solver stops that close to it
Mask = NDArray[np.bool_]
P = TypeVar("P")


Numbers = float | Array | Sequence[int] | None


def rows_of(parts: Sequence[P | None], value: Callable[[P], Numbers], empty: P, width: int) -> Array:
    """One value of each part as rows (m,) or (m, k) of one width, at least `width`. NaN where a part is None, and behind
    shorter values. `empty` is a part without content, which gives the value's type."""
    values = [None if part is None else np.asarray(value(part), dtype=np.float64) for part in parts]  # None becomes NaN
    shapes = [np.shape(np.asarray(value(empty), dtype=np.float64)), *(row.shape for row in values if row is not None)]
    if shapes[0] == ():
        return np.array([np.nan if row is None else row for row in values], dtype=np.float64)
    rows = np.full((len(values), max(width, *(shape[0] for shape in shapes))), np.nan)
    for k, row in enumerate(values):
        if row is not None:
            rows[k, : len(row)] = row
    return rows


@dataclass(frozen=True, eq=False)
class States:
    """A robot's own account, one row per recorded control step, m rows.

    Its columns have no names of their own: `states.control(lambda c: c.wrench)` is (m, 3). Rows in which the robot had no
    such part are NaN.
    """

    time_s: Array
    messages: Sequence[RobotState]
    with_formation: Mask  # (m,) False while a person leads the robot elsewhere
    hops_ms: Array  # (m, len(HOPS)) from the exposure on; NaN where the log does not say

    def of(self, value: Callable[[RobotState], Numbers], width: int = 0) -> Array:
        """A value of the states themselves."""
        return rows_of(self.messages, value, RobotState(), width)

    def estimate(self, value: Callable[[Estimate], Numbers]) -> Array:
        """A value of the estimates."""
        return rows_of([m.estimate for m in self.messages], value, Estimate(), 0)

    def control(self, value: Callable[[Control], Numbers]) -> Array:
        """A value of the control steps' results."""
        return rows_of([m.control for m in self.messages], value, Control(), 0)

    def board(self, value: Callable[[BoardReading], Numbers], width: int = 0) -> Array:
        """A value of the boards' telemetry."""
        return rows_of([m.board for m in self.messages], value, BoardReading(), width)

    def timing(self, value: Callable[[StepTiming], Numbers]) -> Array:
        """A value of the steps' ages and times."""
        return rows_of([m.timing for m in self.messages], value, StepTiming(), 0)

    @property
    def mode(self) -> Array:
        """Mode as a number."""
        return self.of(lambda s: s.mode)

    @property
    def faulty(self) -> Mask:
        """The rows in which the robot reports a fault."""
        return np.array([bool(m.fault) for m in self.messages], dtype=np.bool_)

    @property
    def tracking(self) -> Mask:
        """The rows under way on the formation's trajectory, (m,)."""
        return np.asarray((self.mode == Mode.TRACKING) & (self.of(lambda s: s.trajectory_s) > 0.0) & self.with_formation)


@dataclass(frozen=True, eq=False)
class RobotSeries:
    """One robot. Rows with index n are on Series.time_s; NaN is unknown."""

    truth: Array  # (n, 4)
    reference: Array  # (n, 4)
    still: Array | None  # (4,) where a robot would sit that never moves: the middle of its reference
    states: States
    truth_at_states: Array  # (m, 4)
    disturbance_at_states: Array  # (m, 4) true
    pose_time_s: Array  # (k,)
    pose: Array  # (k, 3) x, y, yaw as located
    pose_error: Array  # (k, 3) against the truth, NaN where there is none
    led_away: Mask  # (n,) a person leads or holds it, and the formation's reference is not its own
    lost: dict[str, int] = field(default_factory=dict)  # messages that never reached the log, by kind: gaps in their numbers

    @property
    def error(self) -> Array:
        """Tracking error (n, 4), yaw to the path's tangent and wrapped."""
        return pose_error(self.truth, self.reference)


@dataclass(frozen=True)
class TimelineEvent:
    """An event for people; `fault` if it should not have been."""

    time_s: float
    source: str
    text: str
    fault: bool
    times: int = 1  # how often it came, one after the other
    until_s: float | None = None  # the last of several

    @property
    def last_s(self) -> float:
        """Time at which it came last."""
        return self.time_s if self.until_s is None else self.until_s


@dataclass(frozen=True)
class Flight:
    """One flight of a log: from a START of the fleet to the next, or to the log's end."""

    begin_ns: int  # stamp of the first step under way
    over_ns: int  # of the last step under way
    until_ns: int  # where the next flight begins
    flown_s: float  # along the trajectory, by the robot that came farthest
    home: bool = False  # it was only the way home


@dataclass(frozen=True, eq=False)
class Series:
    """A flight of a run on one clock."""

    experiment: Experiment
    start_ns: int  # stamp of time 0
    end_s: float  # of the evaluation
    started: bool  # at least one robot flew
    reached_s: float  # along the trajectory, by the slowest robot, without the way home
    other_path: bool  # a person gave another path, form or way than the experiment's
    planned_s: float  # end of the flight along its trajectory as planned: the experiment's, or that of a path loaded later
    asked_s: float  # along the trajectory, what was to be flown: the same, or less where the path was over
    ended_s: float  # of the flight: its log goes on so long, also after the evaluation
    time_s: Array  # (n,) one row per control period, 0 to end_s
    robots: dict[int, RobotSeries]
    errors_against: str | None  # "truth", "localizer", or None when there is nothing to compare with
    frame_ms: Array = field(default_factory=lambda: np.zeros((0, 2)))  # (f, 2) time in s, processing time of a frame in ms
    timeline_events: tuple[TimelineEvent, ...] = ()
    sent_home_s: float | None = None  # along the trajectory, where the fleet turned home
    cut_short: bool = False  # the evaluation ends before the flight does: its clock leaps
    out_of_water: frozenset[int] = frozenset()  # robots that were, at any time of the flight
    flights: tuple[Flight, ...] = ()  # all of the log
    flight: int = 0  # number of this one, from 1; 0 if there is none

    @property
    def flown_s(self) -> float:
        """Progress along the trajectory that the slowest robot has flown, as far as it is evaluated."""
        return min(self.reached_s, self.end_s)

    def known_share(self, values: Array, rows: Mask | None = None) -> float:
        """Share of the evaluated instants (or those in `rows`, (n,)) at which every number of `values` (n, ...) is known; 0 if
        there are none. A simulation that goes on from a moment of another run begins where its log does."""
        if not len(values):
            return 0.0
        has_truth = np.stack([np.isfinite(robot.truth).all(axis=1) for robot in self.robots.values()]).any(axis=0)
        counted = np.logical_or.accumulate(has_truth) if self.errors_against == "truth" else np.ones_like(has_truth)
        if rows is not None:
            counted &= rows
        is_known: Mask = np.asarray(np.isfinite(values).reshape(len(values), -1).all(axis=1))
        return float(is_known[counted].mean()) if counted.any() else 0.0

    def pair_error(self, a: int, b: int) -> Array:
        """Formation error (p_a - p_b) - (ref_a - ref_b), (n, 4), yaw wrapped."""
        one, other = self.robots[a], self.robots[b]
        return pose_error(one.truth - other.truth, one.reference - other.reference)

    def separation_m(self, a: int, b: int) -> Array:
        """Distance of the two centres, (n,)."""
        return np.asarray(np.linalg.norm(self.robots[a].truth[:, :3] - self.robots[b].truth[:, :3], axis=1))


def active_limits(series: Series, robot: RobotSeries) -> dict[str, Mask]:
    """Which limits held a robot's inputs back, (m,) each, by name; and where its plan entered another's space."""
    experiment, states = series.experiment, robot.states
    limits = {}
    wrench, change = states.control(lambda c: c.wrench), states.control(lambda c: c.wrench_step)
    for k, axis in enumerate(AXES[: wrench.shape[1]]):
        limits[axis] = np.asarray(np.abs(wrench[:, k]) >= AT_LIMIT * experiment.vehicle.limits.wrench[k])
        limits[f"step of {axis}"] = np.asarray(np.abs(change[:, k]) >= AT_LIMIT * experiment.wrench_step[k])
    return limits | {"others' space": np.asarray(states.control(lambda c: c.slack_m) > SLACK_M)}

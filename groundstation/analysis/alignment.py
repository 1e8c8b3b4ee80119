"""From a log to aligned arrays: truth, reference and estimate of every robot on one clock. Pure.

A robot's reference at an instant is where its own trajectory clock (RobotState.trajectory_s) says it should be. A clock that
stands (a fault, dead) leaves the reference standing, and the run counts as incomplete. While a person leads a robot elsewhere
(groundstation/formation_clock.py), and while it holds because it was asked to, it has no reference of the formation, and its
errors are not known: it holds where it could stop, beyond its path's place.

A log may hold several flights. One of them is looked at: the last that was more than the way home, or the one asked for.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from groundstation.analysis.series import HOPS, Flight, Mask, RobotSeries, Series, States, TimelineEvent
from groundstation.analysis.timeline import STOOD_STILL, once
from groundstation.formation_clock import FormationPlans
from groundstation.logs.reader import DecodedMessage, RunLog
from shoal.config.experiment import Experiment
from shoal.config.scene import Circle, PathSpec
from shoal.errors import ConfigError
from shoal.frames import Array, pose_error
from shoal.messages import topics
from shoal.messages.messages import (
    Event,
    LocalizerStatus,
    Mode,
    Pose,
    RobotState,
    StationHeartbeat,
    StepInputs,
    Track,
    Trajectory,
    Truth,
)
from shoal.messages.session_clocks import is_old_line

LONGEST_GAP_S = 0.5  # truth is not invented across a longer gap
OLD_POSE_MS = 150.0  # a step that goes by an older one came without a pose: its age is no latency
WARNING = 3  # level of an Event from which on something is wrong
BACK_S = 5.0  # who held goes on from where the slowest was, a little further back; who goes back further begins again
STOOD_STILL_S = 1.0  # of a process that says something 20 times a second, or 10 times; a late step is no standstill
BEGIN_S = 0.5  # a flight's path begins at 0, one that begins with the return a control period later: a clock stands before it
FRESH_S = 2.0  # a clock that begins anew there and is below this has been started; a robot that rejoins is further on
TURNED_S = 1.0  # a flight that is on its way home so soon was nothing else
HOMEWARD = "RETURNING"  # the mission's state in the station's heartbeat (groundstation/mission/state_machine.py)
SPARE_S = 3600.0  # a flight may take twice its duration and this: longer is a clock that leaps, and would fill the memory
PERIODS_S = (0.001, 10.0)  # of a trajectory's samples; the agent takes up to 1 s


@dataclass(frozen=True, eq=False)
class _Samples:
    """Poses at instants, yaw unwrapped: (k,) ns and (k, columns)."""

    stamp_ns: Array
    values: Array

    def at(self, stamp_ns: Array) -> Array:
        """Values (n, columns) at stamps (n,): linear between two samples, NaN outside and across gaps."""
        columns = self.values.shape[1]
        if len(self.stamp_ns) < 2 or len(stamp_ns) == 0:
            return np.full((len(stamp_ns), columns), np.nan)
        values = np.column_stack([np.interp(stamp_ns, self.stamp_ns, self.values[:, c]) for c in range(columns)])
        after = np.clip(np.searchsorted(self.stamp_ns, stamp_ns), 1, len(self.stamp_ns) - 1)
        gap = self.stamp_ns[after] - self.stamp_ns[after - 1]
        outside = (stamp_ns < self.stamp_ns[0]) | (stamp_ns > self.stamp_ns[-1])
        values[outside | (gap > LONGEST_GAP_S * 1e9)] = np.nan
        return values


@dataclass(frozen=True, eq=False)
class _Recorded:
    """Data of one robot from the log."""

    states: list[DecodedMessage[RobotState]]
    with_formation: Mask  # (states,) False while a person leads the robot elsewhere
    trajectory: Trajectory | None  # the last that was flown holds what was planned before it as well,
    others: dict[str, Trajectory]  # but a robot may have flown on beyond where it begins: all, by their ids
    truth: _Samples
    disturbance: _Samples
    poses: list[DecodedMessage[Pose]]
    inputs: dict[int, StepInputs]  # by their stamps
    lost: dict[str, int]
    clock_ns: Array  # (m,) stamps, and
    clock_s: Array  # (m,) where on its trajectory the robot was; empty if it never flew

    @property
    def flew(self) -> bool:
        return len(self.clock_s) > 0

    @property
    def start_ns(self) -> int:
        return _start_ns(self.clock_ns, self.clock_s)


def align(experiment: Experiment, log: RunLog, flight: int | None = None) -> Series:
    """Bring a flight of a log onto one clock: flight `number`, counted from 1, else the last flight that was more than the way
    home. Works for any part of a run, also for one in which nothing moved. Raises ConfigError where there is no such
    flight."""
    has_truth = bool(log.of(topics.TRUTH, Truth))
    flights = _flights(log, experiment.robot_ids)
    number = _chosen(flights, flight)
    window = (flights[number - 1].begin_ns, flights[number - 1].until_ns) if number else (0, 0)
    recorded = {robot: _gather(log, robot, has_truth, window) for robot in experiment.robot_ids}
    with_flight = [r for r in recorded.values() if r.flew]
    start_ns = _began_ns([r.start_ns for r in with_flight]) if with_flight else _first_stamp_ns(log)
    beats = [beat.message for beat in _beats(log, flights[number - 1])] if number else []
    planned_s = _planned_s(experiment, beats)
    whole_s = _end_s(recorded, with_flight, start_ns, planned_s)
    end_s = min(whole_s, 2.0 * planned_s + SPARE_S)
    rows = int(end_s / experiment.controller.period_s + 1e-6) + 1 if with_flight else 0
    time_s = np.arange(rows, dtype=np.float64) * experiment.controller.period_s
    located = any(len(r.truth.stamp_ns) > 1 for r in recorded.values())
    home_ns = _sent_home_ns(log, flights[number - 1]) if number else None
    reached_s = min((_reached_s(r, home_ns) for r in recorded.values()), default=0.0)
    turned = home_ns is not None and reached_s < planned_s
    return Series(
        experiment=experiment,
        start_ns=start_ns,
        end_s=end_s,
        started=bool(with_flight),
        reached_s=reached_s,
        planned_s=planned_s,
        other_path=any(beat.other_path for beat in beats),
        out_of_water=frozenset(robot for beat in beats for robot in beat.out),
        asked_s=_asked_s(experiment, () if turned else with_flight, planned_s),
        ended_s=(window[1] - start_ns) * 1e-9,
        time_s=time_s,
        robots={robot: _robot_series(experiment, robot, r, time_s, start_ns, has_truth) for robot, r in recorded.items()},
        errors_against=None if not with_flight or not located else "truth" if has_truth else "localizer",
        frame_ms=_frame_times(log, start_ns),
        timeline_events=_happenings(log, recorded, start_ns),
        sent_home_s=reached_s if home_ns is not None else None,
        cut_short=whole_s > end_s,
        flights=tuple(flights),
        flight=number,
    )


def zero_ns(log: RunLog, robots: Sequence[int], flight: int = 0) -> int:
    """The stamp of time 0 of a flight, or of the flight that `align` chooses if none has that number. Needs states,
    trajectories and heartbeats only."""
    flights = _flights(log, robots)
    number = _chosen(flights, flight if 1 <= flight <= len(flights) else None)
    if not number:
        return _first_stamp_ns(log)
    window = (flights[number - 1].begin_ns, flights[number - 1].until_ns)
    clocks = [_clock(_states_with_formation(log, robot), window) for robot in robots]
    return _began_ns([_start_ns(clock_ns, clock_s) for clock_ns, clock_s in clocks if len(clock_s)])


# --- flights


def chosen_flight(log: RunLog, robots: Sequence[int], flight: int | None = None) -> tuple[int, Flight | None]:
    """A flight of a log by its number, or the one that `align` chooses, and its number; 0 and None where nothing flew. Raises
    ConfigError where there is none of that number."""
    flights = _flights(log, robots)
    number = _chosen(flights, flight)
    return number, flights[number - 1] if number else None


def _flights(log: RunLog, robots: Sequence[int]) -> list[Flight]:
    """All flights of the fleet. A new one begins when a robot begins again that has flown in this one, or when nobody of this
    one flies any more."""
    parts = sorted(part for robot in robots for part in _robot_flights(_states_with_formation(log, robot, begins=True), robot))
    groups: list[list[_RobotFlight]] = []
    for part in parts:
        here = groups[-1] if groups else []
        flew_here = any(other.robot == part.robot for other in here)
        if flew_here or all(other.over_ns < part.begin_ns for other in here):
            groups.append([part])
        else:
            here.append(part)
    until_ns = [group[0].begin_ns for group in groups[1:]] + [_last_stamp_ns(log) + 1]
    flights = []
    for k, group in enumerate(groups):
        flight = Flight(
            begin_ns=group[0].begin_ns,
            over_ns=max(part.over_ns for part in group),
            until_ns=until_ns[k],
            flown_s=max(part.reached_s for part in group),
        )
        home_ns = _sent_home_ns(log, flight)
        flights.append(replace(flight, home=home_ns is not None and home_ns < flight.begin_ns + TURNED_S * 1e9))
    return flights


class _RobotFlight(NamedTuple):
    """One robot's part in a flight."""

    begin_ns: int  # stamp of the first step under way
    over_ns: int  # and of the last
    reached_s: float  # of its trajectory
    robot: int


def _robot_flights(states: Sequence[DecodedMessage[RobotState]], robot: int) -> list[_RobotFlight]:
    """All flights of one robot. Another one begins when its trajectory clock goes back."""
    flights: list[_RobotFlight] = []
    last_s, stood_at_begin = 0.0, False
    for e in states:
        clock_s = e.message.trajectory_s
        if _stands_at_begin(e.message):
            stood_at_begin = True
        elif e.message.mode is Mode.TRACKING:
            again = clock_s < last_s - BACK_S or (stood_at_begin and clock_s < min(last_s, FRESH_S))
            if not flights or again:
                flights.append(_RobotFlight(e.stamp_ns, e.stamp_ns, clock_s, robot))
            flights[-1] = flights[-1]._replace(over_ns=e.stamp_ns, reached_s=max(flights[-1].reached_s, clock_s))
            last_s, stood_at_begin = clock_s, False
    return flights


def _chosen(flights: Sequence[Flight], choice: int | None) -> int:
    """Number of the flight to look at, from 1; 0 if there is none."""
    if choice is not None:
        if not 1 <= choice <= len(flights):
            raise ConfigError(f"--flight {choice}: the log holds {len(flights)} (allowed: 1 to {len(flights)})")
        return choice
    outward = [number for number, flight in enumerate(flights, start=1) if not flight.home]
    return outward[-1] if outward else len(flights)


def _sent_home_ns(log: RunLog, flight: Flight) -> int | None:
    """Instant in a flight at which the station first reported the return of the fleet. None if it flew another path after
    that, which a person gave it from a hold on the way."""
    sent_ns: int | None = None
    for beat in _beats(log, flight):
        if beat.message.mission == HOMEWARD:
            sent_ns = beat.stamp_ns if sent_ns is None else sent_ns
        elif beat.message.flight_s > 0.0:
            sent_ns = None
    return sent_ns


def _planned_s(experiment: Experiment, beats: Sequence[StationHeartbeat]) -> float:
    """Planned end of a flight along its trajectory in s: the station's last word before the way home, for a person may load
    another path; the experiment's where it says nothing."""
    ends_s = [beat.flight_s for beat in beats]
    return next((end_s for end_s in reversed(ends_s) if end_s > 0.0), experiment.duration_s)


def _beats(log: RunLog, flight: Flight) -> list[DecodedMessage[StationHeartbeat]]:
    """The station's heartbeats while a flight was under way: of a path that was loaded afterwards it says nothing."""
    beats = log.of(topics.HEARTBEAT, StationHeartbeat)
    return [beat for beat in beats if flight.begin_ns <= beat.stamp_ns <= flight.over_ns]


def _asked_s(experiment: Experiment, flights: Sequence[_Recorded], planned_s: float) -> float:
    """Progress along the trajectory in s that was to be flown, at most the planned one. Trajectories are a controller's
    horizon longer than that."""
    ahead_s = experiment.controller.mpc.horizon * experiment.controller.period_s
    trajectories = [r.trajectory for r in flights if r.trajectory is not None]
    ends = [t.begin_s + (len(t.eta) - 1) * t.period_s - ahead_s for t in trajectories]
    return max(0.0, min([planned_s, *ends]))


# --- one robot


def _plans(log: RunLog, robot: int) -> FormationPlans:
    """The formation's trajectories of a robot, as the station recorded them; a state that names none belongs to it."""
    ids = {e.message.id for e in log.of(topics.TRAJECTORY, Trajectory, robot)}
    return FormationPlans(ids | {""} if ids else None)


def _states_with_formation(log: RunLog, robot: int, begins: bool = False) -> list[DecodedMessage[RobotState]]:
    """A robot's states while it is with the formation. With `begins` those too in which it stands at the beginning of the
    formation's next flight after a person led it elsewhere."""
    states, plans = log.of(topics.STATE, RobotState, robot), _plans(log, robot)
    counts = plans.with_formation(e.message for e in states)
    return [
        e
        for e, counted in zip(states, counts, strict=True)
        if counted or (begins and plans.include(e.message.trajectory_id) and _stands_at_begin(e.message))
    ]


def _stands_at_begin(state: RobotState) -> bool:
    """True for a robot whose clock has not left its trajectory's beginning."""
    return state.trajectory_s <= 0.0 or (state.trajectory_s <= BEGIN_S and state.mode is not Mode.TRACKING)


def _clock(states: Sequence[DecodedMessage[RobotState]], window: tuple[int, int]) -> tuple[Array, Array]:
    """Stamps and where on its trajectory the robot was, from its first step under way in a window on, whatever the mode: while
    it holds, its clock stands. Empty if it did not fly."""
    inside = [e for e in states if window[0] <= e.stamp_ns < window[1] and e.message.trajectory_s > 0.0]
    first = next((k for k, e in enumerate(inside) if e.message.mode is Mode.TRACKING), len(inside))
    clock_ns = np.array([e.stamp_ns for e in inside[first:]], dtype=np.float64)
    return clock_ns, np.array([e.message.trajectory_s for e in inside[first:]], dtype=np.float64)


def _start_ns(clock_ns: Array, clock_s: Array) -> int:
    """Instant at which the robot's trajectory began, from its first step in flight."""
    return round(float(clock_ns[0]) - float(clock_s[0]) * 1e9)


def _reached_s(r: _Recorded, home_ns: int | None) -> float:
    """Progress of a robot along its trajectory, without the way home, on which its clock goes on."""
    outward_s = r.clock_s if home_ns is None else r.clock_s[r.clock_ns <= home_ns]
    return float(outward_s.max(initial=0.0))


def _began_ns(starts_ns: Sequence[int]) -> int:
    """Instant at which the flight began: the last start of the robots that started together. The clock of a robot that joins
    after a hold says a later one, and what the others did before is flight all the same."""
    return max(start_ns for start_ns in starts_ns if start_ns <= min(starts_ns) + BEGIN_S * 1e9)


def _gather(log: RunLog, robot: int, has_truth: bool, window: tuple[int, int]) -> _Recorded:
    """Collect one robot's messages of a flight from the log, not aligned yet."""
    states = log.of(topics.STATE, RobotState, robot)
    inputs = log.of(topics.INPUTS, StepInputs, robot)
    poses = [entry for entry in log.of(topics.POSE, Pose, robot) if entry.message.track is not Track.LOST]
    plans = _plans(log, robot)
    counted = _states_with_formation(log, robot)
    messages = [e.message for e in counted if window[0] <= e.stamp_ns < window[1] and e.message.trajectory_s > 0.0]
    named = [m.trajectory_id for m in messages if m.mode is Mode.TRACKING]
    recorded = [e.message for e in log.of(topics.TRAJECTORY, Trajectory, robot)]
    trajectories = [t for t in recorded if _is_path(t) and plans.include(t.id)]
    chosen = [t for t in trajectories if named and t.id == named[-1]] or trajectories
    truth, disturbance = _truth(log, robot) if has_truth else (_located(states, poses), _samples([], []))
    clock_ns, clock_s = _clock(counted, window)
    return _Recorded(
        states=states,
        with_formation=np.array(list(plans.with_formation(e.message for e in states)), dtype=bool),
        trajectory=chosen[-1] if chosen else None,
        others={t.id: t for t in trajectories},
        truth=truth,
        disturbance=disturbance,
        poses=poses,
        inputs={e.stamp_ns: e.message for e in inputs},
        lost={
            "poses": messages_lost(log.of(topics.POSE, Pose, robot)),
            "states": messages_lost(states),
            "inputs": messages_lost(inputs),
        },
        clock_ns=clock_ns,
        clock_s=clock_s,
    )


def _is_path(trajectory: Trajectory) -> bool:
    """True if the trajectory can be flown: it has samples."""
    return len(trajectory.eta) > 1 and PERIODS_S[0] <= trajectory.period_s <= PERIODS_S[1]


def _truth(log: RunLog, robot: int) -> tuple[_Samples, _Samples]:
    """True pose and true disturbance of a robot; no disturbance if a message has none."""
    stamps: list[int] = []
    poses: list[Array] = []
    disturbances: list[Array] = []
    for entry in log.of(topics.TRUTH, Truth):
        truth = entry.message
        row = truth.robots.index(robot) if robot in truth.robots else len(truth.eta)
        if row < len(truth.eta):
            stamps.append(entry.stamp_ns)
            poses.append(truth.eta[row])
            disturbances += [truth.disturbance[row]] if row < len(truth.disturbance) else []
    has_disturbance = len(disturbances) == len(stamps)
    return _samples(stamps, poses), _samples(stamps, disturbances) if has_disturbance else _samples([], [])


def _located(states: Sequence[DecodedMessage[RobotState]], poses: Sequence[DecodedMessage[Pose]]) -> _Samples:
    """Instead of the truth: the localizer's poses, with the depth that the robot measured."""
    stamps = np.array([entry.stamp_ns for entry in poses], dtype=np.float64)
    measured = [(entry.stamp_ns, entry.message.board.depth_m) for entry in states if entry.message.board is not None]
    if measured:
        measured_at, measured_m = np.array(measured, dtype=np.float64).T
        depth_m = np.interp(stamps, measured_at, measured_m)
    else:
        depth_m = np.full(len(stamps), np.nan)
    etas = []
    for entry, z in zip(poses, depth_m, strict=True):
        pose = entry.message
        etas.append(np.array([pose.x_m, pose.y_m, z, pose.yaw_rad]))
    return _samples(list(stamps), etas)


def _samples(stamps: Sequence[float], rows: Sequence[Array]) -> _Samples:
    values = np.array(rows, dtype=np.float64).reshape(-1, 4)
    values[:, 3] = np.unwrap(values[:, 3])
    return _Samples(np.array(stamps, dtype=np.float64), values)


def _first_stamp_ns(log: RunLog) -> int:
    states = [e.stamp_ns for (name, _), entries in log.entries.items() for e in entries if name == topics.STATE.name]
    anything = [e.stamp_ns for entries in log.entries.values() for e in entries]
    return min(states or anything, default=0)


def _last_stamp_ns(log: RunLog) -> int:
    return max((e.stamp_ns for entries in log.entries.values() for e in entries[-1:]), default=0)


def _end_s(recorded: dict[int, _Recorded], flights: Sequence[_Recorded], start_ns: int, duration_s: float) -> float:
    """Time at which the last robot's trajectory clock reached the run's end or stood still for good; not beyond the truth."""
    ends_ns = []
    for r in flights:
        arrived = np.flatnonzero(r.clock_s >= duration_s - 1e-6)
        moving = np.flatnonzero(np.diff(r.clock_s) > 0.0)
        stopped = moving[-1] + 1 if len(moving) else 0
        ends_ns.append(r.clock_ns[arrived[0] if len(arrived) else stopped])
    known_until_ns = [r.truth.stamp_ns[-1] for r in recorded.values() if len(r.truth.stamp_ns)]
    end_ns = float(min([max(ends_ns, default=start_ns), *known_until_ns]))
    return max(0.0, (end_ns - start_ns) * 1e-9)


def _robot_series(
    experiment: Experiment, robot: int, r: _Recorded, time_s: Array, start_ns: int, has_truth: bool
) -> RobotSeries:
    """Put one robot's messages onto the clock `time_s` (n,) of the flight that began at `start_ns`."""
    stamps = start_ns + time_s * 1e9
    states = _states(r.states, r.with_formation, r.inputs, start_ns)
    state_stamps = np.array([e.stamp_ns for e in r.states], dtype=np.float64)
    pose = np.array([[e.message.x_m, e.message.y_m, e.message.yaw_rad] for e in r.poses], dtype=np.float64).reshape(-1, 3)
    pose_stamps = np.array([e.stamp_ns for e in r.poses], dtype=np.float64)
    true_pose = r.truth.at(pose_stamps)
    measured_eta = np.column_stack([pose[:, :2], true_pose[:, 2], pose[:, 2]])
    error = pose_error(measured_eta, true_pose)[:, [0, 1, 3]] if has_truth else np.full_like(pose, np.nan)
    return RobotSeries(
        truth=r.truth.at(stamps),
        reference=_reference(r, stamps),
        still=_middle(experiment.path_of(experiment.robot(robot)), experiment.duration_s, r.trajectory),
        states=states,
        truth_at_states=r.truth.at(state_stamps),
        disturbance_at_states=r.disturbance.at(state_stamps),
        pose_time_s=(pose_stamps - start_ns) * 1e-9,
        pose=pose,
        pose_error=error,
        led_away=_led_away(r, stamps),
        lost=r.lost,
    )


def poses_along(trajectory: Trajectory, along_s: Array) -> Array:
    """Poses (n, 4) at seconds (n,) from a trajectory's first sample: cubic in between, with the samples' velocities (Hermite);
    its ends beyond them."""
    place = np.clip(along_s / trajectory.period_s, 0.0, len(trajectory.eta) - 1)
    low = np.minimum(place.astype(np.intp), len(trajectory.eta) - 2)
    u = (place - low)[:, None]
    begin, end = trajectory.eta[low], trajectory.eta[low + 1]
    leaves, arrives = trajectory.period_s * trajectory.velocity[low], trajectory.period_s * trajectory.velocity[low + 1]
    eta: Array = begin + u * u * (3.0 - 2.0 * u) * (end - begin) + u * (1.0 - u) * ((1.0 - u) * leaves - u * arrives)
    return eta


def _reference(r: _Recorded, stamps: Array) -> Array:
    """Pose (n, 4) on the robot's trajectory at each stamp (n,) in ns.

    NaN where there was no reference: the robot did not fly, its clock is not in the log, or a person led it elsewhere.
    """
    if r.trajectory is None or not r.flew:
        return np.full((len(stamps), 4), np.nan)
    clock_s = np.interp(stamps, r.clock_ns, r.clock_s)
    reference, ids = np.full((len(stamps), 4), np.nan), _trajectory_ids(r, stamps)
    for trajectory_id in set(ids):
        trajectory, rows = r.others.get(trajectory_id, r.trajectory), ids == trajectory_id
        along_s = clock_s[rows] - trajectory.begin_s
        has_sample = along_s >= -trajectory.period_s  # a trajectory too long for a message comes without its beginning
        reference[np.flatnonzero(rows)[has_sample]] = poses_along(trajectory, along_s[has_sample])
    reference[~_clock_is_logged(r, stamps) | _led_away(r, stamps)] = np.nan
    return reference


def _clock_is_logged(r: _Recorded, stamps: Array) -> Mask:
    """True at the stamps at which the log holds the robot's clock, (n,): neither in a gap longer than LONGEST_GAP_S, nor by
    more than that before the robot joined or after it was last heard."""
    gap_ns = LONGEST_GAP_S * 1e9
    logged = (stamps >= r.clock_ns[0] - gap_ns) & (stamps <= r.clock_ns[-1] + gap_ns)
    if len(r.clock_ns) > 1:
        after = np.clip(np.searchsorted(r.clock_ns, stamps), 1, len(r.clock_ns) - 1)
        is_between = (stamps > r.clock_ns[after - 1]) & (stamps < r.clock_ns[after])
        logged &= ~(is_between & (r.clock_ns[after] - r.clock_ns[after - 1] > gap_ns))
    return np.asarray(logged)


def _last_state(r: _Recorded, stamps: Array) -> NDArray[np.intp]:
    """Index of the robot's newest state at each stamp, (n,); -1 before the first."""
    return np.searchsorted(np.array([e.stamp_ns for e in r.states], dtype=np.float64), stamps, side="right") - 1


def _trajectory_ids(r: _Recorded, stamps: Array) -> NDArray[np.str_]:
    """Id of the trajectory that the robot was on at each stamp, (n,); empty before it reported one."""
    ids = np.array(["", *(e.message.trajectory_id for e in r.states)])
    return np.asarray(ids[_last_state(r, stamps) + 1])


def _led_away(r: _Recorded, stamps: Array) -> Mask:
    """True at the stamps at which a person led the robot elsewhere, or it held its place at a person's request, (n,)."""
    held = np.array([e.message.mode is Mode.HOLDING and not e.message.fault for e in r.states], dtype=bool)
    away = held | ~r.with_formation
    if not away.any():
        return np.zeros(len(stamps), dtype=bool)
    last = _last_state(r, stamps)
    return np.asarray((last >= 0) & away[np.maximum(last, 0)])


def _middle(path: PathSpec, duration_s: float, trajectory: Trajectory | None) -> Array | None:
    """The middle of a reference (4,): a circle's centre, else the mean over the run."""
    if trajectory is None:
        return None
    if isinstance(path, Circle):
        rate_radps = 2.0 * np.pi / path.lap_s
        return np.asarray(trajectory.eta[0] + trajectory.acceleration[0] / rate_radps**2)  # a = -rate^2 (p - centre)
    return np.asarray(trajectory.eta[: round(duration_s / trajectory.period_s) + 1].mean(axis=0))


def hops_of(state: DecodedMessage[RobotState], inputs: StepInputs | None) -> Array:
    """Shares in ms of the time from the exposure to the PWM, by HOPS; NaN where the pose was an old one, or nothing is
    known."""
    unknown = np.full(len(HOPS), np.nan)
    timing = state.message.timing
    if inputs is None or inputs.pose is None or timing.exposure_to_pwm_ms is None or timing.pose_age_ms is None:
        return unknown
    told_ms = inputs.pose_told_age_ns * 1e-6
    age_ms = (state.stamp_ns - state.shift_ns - inputs.pose_instant_ns) * 1e-6  # both on the robot's own clock
    answered_ms, step_ms = timing.exposure_to_pwm_ms - timing.pose_age_ms, timing.step_us * 1e-3
    hops = np.array([told_ms, age_ms - told_ms, step_ms, max(answered_ms - step_ms, 0.0)])
    return hops if age_ms <= OLD_POSE_MS else unknown


def messages_lost(entries: Sequence[DecodedMessage[Any]]) -> int:
    """Numbers left out; a sender that begins anew begins at 1."""
    steps = np.diff([e.sequence for e in entries]) if len(entries) > 1 else np.zeros(0)
    return int((steps[steps > 1] - 1).sum())


def _states(
    entries: Sequence[DecodedMessage[RobotState]], with_formation: Mask, inputs: Mapping[int, StepInputs], start_ns: int
) -> States:
    """A robot's states, one row a control step."""
    return States(
        time_s=np.array([(e.stamp_ns - start_ns) * 1e-9 for e in entries], dtype=np.float64),
        messages=[e.message for e in entries],
        with_formation=with_formation,
        hops_ms=np.array([hops_of(e, inputs.get(e.stamp_ns)) for e in entries], dtype=np.float64).reshape(-1, len(HOPS)),
    )


def _frame_times(log: RunLog, start_ns: int) -> Array:
    statuses = log.of(topics.LOCALIZER, LocalizerStatus)  # none has a frame where the simulator stands for the localizer
    frames = [((e.stamp_ns - start_ns) * 1e-9, e.message.frame_ms) for e in statuses if e.message.frame_ms > 0.0]
    return np.array(frames, dtype=np.float64).reshape(-1, 2)


def _happenings(log: RunLog, recorded: dict[int, _Recorded], start_ns: int) -> tuple[TimelineEvent, ...]:
    """Every change of a robot's mode, guidance or fault, and every event, each once and in order."""
    events = []
    for robot, r in recorded.items():
        before: tuple[str, str] | None = None
        for e in r.states:
            now = (e.message.doing, e.message.fault)
            if now != before:
                text = now[0] + (f": {now[1]}" if now[1] else "")
                events.append(TimelineEvent((e.stamp_ns - start_ns) * 1e-9, f"robot {robot}", text, bool(now[1])))
            before = now
    begun_ns = min((e.arrived_ns for entries in log.entries.values() for e in entries), default=0)
    for event in log.of(topics.EVENT, Event):
        m = event.message
        if event.stamp_ns < begun_ns and is_old_line(event.stamp_ns, event.arrived_ns):  # of an earlier run
            continue
        events.append(TimelineEvent((event.stamp_ns - start_ns) * 1e-9, m.source, m.message, m.level >= WARNING))
    senders: dict[str, Sequence[DecodedMessage[Any]]] = {f"robot {robot}": r.states for robot, r in recorded.items()}
    senders["groundstation"] = log.of(topics.HEARTBEAT, StationHeartbeat)
    senders["localizer"] = log.of(topics.LOCALIZER, LocalizerStatus)
    for source, entries in senders.items():
        events.extend(_standstills(source, entries, start_ns))
    return once(events)


def _standstills(source: str, entries: Sequence[DecodedMessage[Any]], start_ns: int) -> Iterator[TimelineEvent]:
    """Times at which a process that publishes in every period did nothing: its next number comes long after the last one. A
    gap in the numbers is no standstill: there messages were lost."""
    for before, after in pairwise(entries):
        still_s = (after.stamp_ns - before.stamp_ns) * 1e-9
        if after.sequence == before.sequence + 1 and still_s > STOOD_STILL_S:
            begin_s = (before.stamp_ns - start_ns) * 1e-9
            yield TimelineEvent(begin_s, source, f"{STOOD_STILL}{still_s:.1f} s", False, until_s=begin_s + still_s)

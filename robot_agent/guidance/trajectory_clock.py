"""Clock of the trajectory: the trajectory flown, the robot's time along it, and the trajectory that comes next. Pure.

The timetable is the robot's own clock, counted from an instant that all robots share. START and RESUME name it on the
station's clock, so a robot that receives one late is at once where it should be by then. The trajectory's clock is the
timetable minus the formation's lag, which the station sends with every heartbeat: so all slow down together. A late heartbeat
moves no reference. One with a very different lag moves the reference no faster than FASTER allows.
"""

import numpy as np

from robot_agent.guidance.reference import Follow, pose_at, splice, splice_objection
from robot_agent.guidance.trajectory_check import unflyable
from robot_agent.inputs import StationView
from shoal.config.experiment import Experiment
from shoal.frames import Array
from shoal.messages.messages import ALONE, Command, CommandKind, Trajectory

FARTHEST_S = 60.0  # a start may lie ahead, or be over, by this much; the station names one half a second ahead
FASTER = 0.5  # of the timetable's pace: by this much faster a reference catches up when the station reports less lag
BEGINS = frozenset({CommandKind.START, CommandKind.RESUME})


class TrajectoryClock:
    """Trajectory and clock of one robot, from LOAD to LOAD."""

    def __init__(self, experiment: Experiment, robot: int) -> None:
        self._pool, self._vehicle = experiment.pool, experiment.vehicle
        self._me, self._join_within_m = experiment.robot(robot), experiment.safety.join_within_m
        self.reached_s = 0.0  # on the trajectory's clock
        self.trajectory: Trajectory | None = None  # what is flown
        self._next: Trajectory | None = None  # loaded under way, until SWITCH
        self._planned_m = 0.0  # from the path's first pose to where the experiment puts the robot into the water
        self._time_zero_ns = 0  # when the timetable was, or will be, at 0
        self._earliest_s = 0.0  # waits at this point of it until its time has come
        self._started_by = 0  # session of the station whose lag counts
        self._lag_s: float | None = None  # of the reference; None: the next reported lag is taken at once
        self._rate, self._stepped_ns = 1.0, 0

    @property
    def id(self) -> str:
        """Id of the trajectory; empty if there is none."""
        return self.trajectory.id if self.trajectory is not None else ""

    @property
    def formation_s(self) -> float:
        """Time along the formation's trajectory in s; 0 on one that the robot flies on its own."""
        return 0.0 if self.id.startswith(ALONE) else self.reached_s

    def flaw(self, command: Command) -> str:
        """Return the reason why a LOAD's trajectory cannot be flown; empty if it can. It takes as long as a control step for
        each quarter of an hour of the trajectory; it reads nothing that a step changes, so it may run beside one."""
        return unflyable(command.trajectory, self._pool, self._vehicle) if command.order is CommandKind.LOAD else ""

    def objection(
        self,
        command: Command,
        under_way: bool,
        station: StationView,
        begins_ns: int,
        now_ns: int,
        eta: Array | None,
        flaw: str | None = None,
    ) -> str:
        """Return the reason to refuse a command about trajectories; empty if there is none. START and RESUME take effect at
        `begins_ns` on our clock; `eta` (4,) is the robot's estimate, None without one; `flaw` is the result
        of that method, None if it was not called."""
        if command.order is CommandKind.LOAD:
            flaw = self.flaw(command) if flaw is None else flaw
            return flaw or (self._unjoinable(command.trajectory) if under_way else "")
        if command.order is CommandKind.SWITCH:
            if self._next is None or self._next.id != command.trajectory_id:
                return f"trajectory {command.trajectory_id} is not loaded"
            return self._unjoinable(self._next)
        if command.order in BEGINS:
            return self._unstartable(command, station, begins_ns, now_ns, eta)
        return ""

    def _unjoinable(self, new: Trajectory | None) -> str:
        """Reason why the robot cannot go over from its trajectory to a new one; empty if it can."""
        if self.trajectory is None or new is None:
            return "no trajectory is flown"
        if new.begin_s <= self.reached_s:
            return f"too late: it begins at {new.begin_s:.2f} s, {self.reached_s:.2f} s have gone by"
        return splice_objection(self.trajectory, new)

    def _unstartable(self, command: Command, station: StationView, begins_ns: int, now_ns: int, eta: Array | None) -> str:
        """Reason why a START or RESUME cannot be carried out, for example a robot too far from its path; empty if it can."""
        if self.trajectory is None:
            return "no trajectory is loaded"
        if command.trajectory_id != self.id:
            return f"names trajectory {command.trajectory_id or '(none)'}, this robot has {self.id}"
        ahead_s = (begins_ns - now_ns) * 1e-9
        if abs(ahead_s) > FARTHEST_S:
            return f"begins {ahead_s:.1f} s from now, allowed are -{FARTHEST_S:g} to {FARTHEST_S:g} s"
        if eta is None:
            return "the robot does not know where it is"
        lag_s, _ = self._formation_lag(station)
        reached_s = command.trajectory_s + max(-ahead_s, 0.0) - lag_s
        away_m = float(np.linalg.norm(pose_at(self.trajectory, reached_s)[:3] - eta[:3]))
        limit_m = self._planned_m + self._join_within_m
        if not away_m <= limit_m:
            planned = f", {self._planned_m:.2f} m of it as planned" if self._planned_m else ""
            return (
                f"is {away_m:.2f} m from where its path is at {reached_s:.2f} s, allowed are {limit_m:.2f} m{planned} "
                "(safety.join_within_m); bring it there, or: groundstation mission return"
            )
        return ""

    def apply(self, command: Command, under_way: bool, station: StationView, begins_ns: int) -> None:
        """Carry out a command without objection. START and RESUME take effect at `begins_ns` on our clock."""
        if command.order is CommandKind.LOAD and under_way:
            self._next = command.trajectory
        elif command.order is CommandKind.LOAD and command.trajectory is not None:
            self._take(command.trajectory)
        if command.order is CommandKind.SWITCH and self.trajectory is not None and self._next is not None:
            self.trajectory, self._next = splice(self.trajectory, self._next, self.reached_s), None
        if command.order in BEGINS:
            self._earliest_s, self._started_by = command.trajectory_s, station.session
            self._time_zero_ns = begins_ns - round(self._earliest_s * 1e9)
            self._lag_s = None

    def _take(self, trajectory: Trajectory) -> None:
        """Make a trajectory the one that is flown, at its beginning."""
        self.trajectory, self.reached_s = trajectory, trajectory.begin_s
        self._planned_m = 0.0
        if trajectory.begin_s == 0.0:  # the run's own; later ones are made for robots that rest at their beginning
            put = self._me.start if self._me.start is not None else trajectory.eta[0] + np.array(self._me.start_offset)
            self._planned_m = float(np.linalg.norm(np.array(put)[:3] - trajectory.eta[0, :3]))

    def drop_next(self) -> None:
        """Forget the trajectory loaded for a SWITCH: the robot no longer flies."""
        self._next = None

    def goal(self, station: StationView, now_ns: int) -> Follow | None:
        """Return the goal at `now_ns`; None without a trajectory."""
        if self.trajectory is None:
            return None
        self._follow_lag(station, now_ns)
        timetable_s = (now_ns - self._time_zero_ns) * 1e-9
        self.reached_s = max(timetable_s, self._earliest_s) - (self._lag_s or 0.0)
        return Follow(self.trajectory, self.reached_s, self._rate, max(self._earliest_s - timetable_s, 0.0))

    def _follow_lag(self, station: StationView, now_ns: int) -> None:
        """Follow the formation's lag: at once at a start; later so that the reference never goes back, nor faster than FASTER
        allows. Only the station that started the robot is followed."""
        passed_s, self._stepped_ns = max(now_ns - self._stepped_ns, 0) * 1e-9, now_ns
        if station.session != self._started_by:
            self._rate = 1.0
            return
        reported_s, rate = self._formation_lag(station)
        before_s = reported_s if self._lag_s is None else self._lag_s
        self._lag_s = min(max(reported_s, before_s - FASTER * passed_s), before_s + passed_s)
        self._rate = rate if self._lag_s == reported_s else 1.0 - (self._lag_s - before_s) / max(passed_s, 1e-3)

    @staticmethod
    def _formation_lag(station: StationView) -> tuple[float, float]:
        """Return the formation's lag behind the timetable in s, extrapolated from the last heartbeat to now, and the rate of
        its clock (0 to 1)."""
        slowing = min(max(station.slowing, 0.0), 1.0)
        since_s = station.age_s if slowing else 0.0  # infinity if no station was ever heard
        return max(station.lag_s + slowing * since_s, 0.0), 1.0 - slowing

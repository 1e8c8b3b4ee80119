"""The trajectory that a robot flies, where on it the robot is to be, and the one that comes next. Pure.

The timetable is the robot's own clock, counted from a start that all share. The trajectory's clock is that less the
formation's lag, which the station tells with every heartbeat: so all slow down together, and a late heartbeat moves nobody's
reference.
"""

import numpy as np

from robot_agent.orders import StationView
from robot_agent.reference import Follow, seam_trouble, spliced
from wire.messages import Command, Order, Trajectory


class Course:
    """One robot's, from LOAD to LOAD."""

    def __init__(self, pool_m: tuple[float, float, float]) -> None:
        self._pool_m = pool_m
        self.reached_s = 0.0  # on the trajectory's clock
        self.trajectory: Trajectory | None = None  # what is flown
        self._next: Trajectory | None = None  # loaded under way, until SWITCH
        self._time_zero_ns = 0  # when the timetable was, or will be, at 0
        self._earliest_s = 0.0  # waits at this point of it until its time has come
        self._started_by = 0  # session of the station whose lag counts
        self._lag_s, self._rate = 0.0, 1.0

    @property
    def id(self) -> str:
        """Of the trajectory; empty if there is none."""
        return self.trajectory.id if self.trajectory is not None else ""

    def objection(self, command: Command, under_way: bool) -> str:
        """Why an order about trajectories cannot be followed; empty if it can."""
        if command.order is Order.LOAD:
            return _bad_trajectory(command.trajectory, self._pool_m) or (
                self._unjoinable(command.trajectory) if under_way else ""
            )
        if command.order is Order.SWITCH:
            if self._next is None or self._next.id != command.trajectory_id:
                return f"trajectory {command.trajectory_id} is not loaded"
            return self._unjoinable(self._next)
        if command.order in (Order.START, Order.RESUME) and self.trajectory is None:
            return "no trajectory is loaded"
        return ""

    def _unjoinable(self, new: Trajectory | None) -> str:
        if self.trajectory is None or new is None:
            return "no trajectory is flown"
        if new.begin_s <= self.reached_s:
            return f"too late: it begins at {new.begin_s:.2f} s, {self.reached_s:.2f} s have gone by"
        return seam_trouble(self.trajectory, new)

    def follow(self, command: Command, under_way: bool, station: StationView, given_ns: int) -> None:
        """Carry out an order without objection, given at that instant on our clock."""
        if command.order is Order.LOAD and under_way:
            self._next = command.trajectory
        elif command.order is Order.LOAD and command.trajectory is not None:
            self.trajectory, self.reached_s = command.trajectory, command.trajectory.begin_s
        if command.order is Order.SWITCH and self.trajectory is not None and self._next is not None:
            self.trajectory, self._next = spliced(self.trajectory, self._next, self.reached_s), None
        if command.order in (Order.START, Order.RESUME):
            self._earliest_s, self._started_by = command.trajectory_s, station.session
            self._time_zero_ns = given_ns + round((command.start_in_s - self._earliest_s) * 1e9)

    def drop_next(self) -> None:
        """Whoever stops flying goes over to nothing."""
        self._next = None

    def goal(self, station: StationView, now_ns: int) -> Follow | None:
        """Where to be now; None if there is no trajectory."""
        if self.trajectory is None:
            return None
        if station.session == self._started_by:
            self._lag_s, self._rate = station.lag_s + station.slowing * station.age_s, 1.0 - station.slowing
        self.reached_s = max((now_ns - self._time_zero_ns) * 1e-9, self._earliest_s) - self._lag_s
        return Follow(self.trajectory, self.reached_s, self._rate)


def _bad_trajectory(trajectory: Trajectory | None, pool_m: tuple[float, float, float]) -> str:
    """Why a trajectory cannot be flown at all; empty if it can. (The planner has checked it against the vehicle's limits.)"""
    if trajectory is None:
        return "carries no trajectory"
    if not trajectory.id:
        return "trajectory.id is empty"
    if not 0.001 <= trajectory.period_s <= 1.0:
        return f"trajectory.period_s = {trajectory.period_s:g}: must be 0.001 to 1"
    if not 0.0 <= trajectory.begin_s <= 1e6:
        return f"trajectory.begin_s = {trajectory.begin_s:g}: must be 0 to 1e6"
    lengths = {len(trajectory.eta), len(trajectory.velocity), len(trajectory.acceleration)}
    if len(lengths) != 1 or min(lengths) < 2:
        return "trajectory: eta, velocity and acceleration must have the same number of samples, at least 2"
    if float(np.abs(np.diff(trajectory.eta, axis=0)).max()) > 1.0:
        return "trajectory.eta jumps by more than 1 m or 1 rad between samples"
    if (np.abs(trajectory.eta[:, :3]) > [0.5 * pool_m[0], 0.5 * pool_m[1], pool_m[2]]).any():
        return "trajectory.eta leaves the pool"
    return ""

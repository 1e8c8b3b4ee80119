"""Tracking error of each lap and set of gains, so that two sets can be compared lap by lap. Pure."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from shoal.messages.messages import RobotState

EXACT_S = 1e-3  # between two beginnings of a lap that are the same, but for rounding
KEPT = 12  # rows, the newest: as many as the page shows
BACK_S = 5.0  # after a hold a robot goes on a little further back, with the slowest; further back than this is another run


@dataclass(frozen=True)
class FlownLaps:
    """The laps of the path that is flown, on the clock that runs along the trajectories."""

    lap_s: float | None  # None: the path has none
    path_s: float = 0.0  # beginning of the first
    end_s: float = math.inf  # of the path
    flight: int = 0  # another path, or another run, has another number
    goes_on_s: float = 0.0  # before that robots are on their way into place: path_s counts from here on

    def number(self, clock_s: float) -> int:
        """Number of the lap, from 1. Robots on their way into place are in the lap in which they fly on. 0 on a path that has
        none."""
        flown_s = max(clock_s, self.goes_on_s) - self.path_s
        return max(math.floor(flown_s / self.lap_s), 0) + 1 if self.lap_s else 0

    def begins_at(self, clock_s: float) -> bool:
        """True if a lap begins at this instant of the clock."""
        return self.number(clock_s + EXACT_S) != self.number(clock_s - EXACT_S)

    def next_s(self, clock_s: float) -> float:
        """Beginning of the next lap of a path that has some."""
        return self.path_s + self.number(clock_s) * (self.lap_s or 0.0)


@dataclass(frozen=True)
class Lap:
    """One lap, or the part of it that was flown with one set of gains; all robots together."""

    number: int  # from 1; 0 on a path that has none
    tuning_id: str
    time_s: float  # flown, by the robot that flew it longest: one that joins later, or leaves, makes it no shorter
    rms_m: float  # distance from the reference
    max_m: float


@dataclass
class _Row:
    """Times and errors of one lap and set of gains."""

    times_s: dict[int, float] = field(default_factory=dict)  # flown, by robot
    squares: float = 0.0  # of errors [m^2], of all robots
    count: int = 0
    largest_m: float = 0.0

    def add(self, robot: int, step_s: float, error_m: float) -> None:
        """Take in a robot's step along its trajectory, and its error."""
        self.times_s[robot] = self.times_s.get(robot, 0.0) + step_s
        self.squares, self.count = self.squares + error_m**2, self.count + 1
        self.largest_m = max(self.largest_m, error_m)


class LapStatistics:
    """Collects tracking errors from the robots' states."""

    def __init__(self) -> None:
        self._flight = 0
        self._last_s: dict[int, float] = {}
        self._flew: frozenset[int] = frozenset()  # robots that flew in the cycle before
        self._rows: dict[tuple[int, str], _Row] = {}  # by lap and set of gains

    def update(self, flying: Mapping[int, RobotState], laps: FlownLaps) -> None:
        """Take in the newest states of the robots that fly with the formation. A trajectory that begins again starts another
        table; so does another path or run, once it is flown."""
        if flying and laps.flight != self._flight:
            self._flight = laps.flight
            self._rows.clear()
            self._last_s.clear()
        for robot, state in flying.items():
            last_s = self._last_s.get(robot, state.trajectory_s)
            if state.trajectory_s < last_s - BACK_S:
                self._rows.clear()
                self._last_s.clear()
                last_s = state.trajectory_s
            elif state.trajectory_s == last_s and robot in self._last_s:
                continue
            error_m = state.error_m
            if error_m is None:  # not known is not zero; the way flown meanwhile counts with the next error that is
                continue
            step_s = state.trajectory_s - last_s
            if robot not in self._flew:  # it was led elsewhere or held: what the others flew meanwhile is not its own
                step_s = min(step_s, 0.0)
            self._last_s[robot] = state.trajectory_s
            key = (laps.number(state.trajectory_s), state.tuning_id)
            self._rows.setdefault(key, _Row()).add(robot, step_s, error_m)
        self._flew = frozenset(flying)
        while len(self._rows) > KEPT:
            del self._rows[next(iter(self._rows))]

    def laps(self) -> list[Lap]:
        """Laps, the newest last. Other threads may call it: each copy is one step of the interpreter."""
        return [
            Lap(number, tuning_id, max(list(row.times_s.values())), math.sqrt(row.squares / row.count), row.largest_m)
            for (number, tuning_id), row in list(self._rows.items())
        ]

"""Tracking error of each lap and set of gains, so that two sets can be compared lap by lap. Pure."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from shoal.config.experiment import Experiment
from shoal.config.scene import Circle
from shoal.messages.messages import RobotState

KEPT = 12  # rows, the newest: as many as the page shows
BACK_S = 5.0  # after a hold a robot goes on a little further back, with the slowest; further back than this is another run


@dataclass(frozen=True, eq=False)
class LapClock:
    """Laps of the path that is flown, by the clock that runs along the trajectories. A person may load another path, which
    begins only after the ways into its places."""

    flown: Experiment  # with that path
    end_s: float  # of the path

    @property
    def lap_s(self) -> float | None:
        """Time of a lap; None for a path that has none."""
        path = self.flown.path
        return path.lap_s if isinstance(path, Circle) else None

    @property
    def begin_s(self) -> float:
        """Time at which the path begins."""
        return self.end_s - self.flown.duration_s

    def number(self, clock_s: float) -> int:
        """Number of the lap at a time; 0 before the first, and on a path that has none."""
        return 0 if self.lap_s is None else max(math.floor((clock_s - self.begin_s) / self.lap_s) + 1, 0)

    def next_s(self, clock_s: float) -> float | None:
        """Time at which the next lap begins; None on a path that has none."""
        return None if self.lap_s is None else self.begin_s + self.number(clock_s) * self.lap_s


@dataclass(frozen=True)
class Lap:
    """One lap, or the part of it that was flown with one set of gains; all robots together."""

    number: int  # from 1; 0 before the first, and on a path that has none
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
        self._flown: Experiment | None = None
        self._last_s: dict[int, float] = {}
        self._flew: frozenset[int] = frozenset()  # robots that flew in the cycle before
        self._rows: dict[tuple[int, str], _Row] = {}  # by lap and set of gains

    def update(self, flying: Mapping[int, RobotState], laps: LapClock) -> None:
        """Take in the newest states of the robots that fly with the formation. A trajectory that begins again starts another
        run, and so does another path."""
        if laps.flown is not self._flown:
            self._rows.clear()
            self._last_s.clear()
            self._flown = laps.flown
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
            key = laps.number(state.trajectory_s), state.tuning_id
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

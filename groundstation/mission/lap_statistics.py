"""Tracking error of each lap and set of gains, so that two sets can be compared lap by lap. Pure."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from shoal.messages.messages import RobotState

KEPT = 12  # rows, the newest: as many as the page shows
BACK_S = 5.0  # after a hold a robot goes on a little further back, with the slowest; further back than this is another run


@dataclass(frozen=True)
class Lap:
    """One lap, or the part of it that was flown with one set of gains; all robots together."""

    number: int  # from 1; 0 on a path that has none
    tuning_id: str
    time_s: float  # flown, mean over the robots
    rms_m: float  # distance from the reference
    max_m: float


class LapStatistics:
    """Collects tracking errors from the robots' states."""

    def __init__(self, lap_s: float | None) -> None:
        self._lap_s = lap_s
        self._last_s: dict[int, float] = {}
        self._rows: dict[tuple[int, str], tuple[float, float, int, float]] = {}  # robot seconds, sum of squares, count, max

    def update(self, flying: Mapping[int, RobotState]) -> None:
        """Take in the newest states of the robots that fly with the formation. A trajectory that begins again starts another
        run."""
        for robot, state in flying.items():
            last_s = self._last_s.get(robot, state.trajectory_s)
            if state.trajectory_s < last_s - BACK_S:
                self._rows.clear()
                self._last_s.clear()
                last_s = state.trajectory_s
            elif state.trajectory_s == last_s and robot in self._last_s:
                continue
            self._last_s[robot] = state.trajectory_s
            key = (int(state.trajectory_s // self._lap_s) + 1 if self._lap_s else 0, state.tuning_id)
            error_m = math.dist(state.eta[:3], state.eta_reference[:3])
            time_s, squares, count, largest = self._rows.get(key, (0.0, 0.0, 0, 0.0))
            self._rows[key] = time_s + state.trajectory_s - last_s, squares + error_m**2, count + 1, max(largest, error_m)
        while len(self._rows) > KEPT:
            del self._rows[next(iter(self._rows))]

    def laps(self) -> list[Lap]:
        """Laps, the newest last. Other threads may call it: the copy is one step of the interpreter."""
        robots = max(len(self._last_s), 1)
        return [
            Lap(number, tuning_id, time_s / robots, math.sqrt(squares / count), largest)
            for (number, tuning_id), (time_s, squares, count, largest) in list(self._rows.items())
        ]

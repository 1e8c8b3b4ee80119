"""Detection of a robot that has left its path without a known reason. Pure. What covers the ways there and back is in
path_watch.py.

Known reasons are avoidance of a robot or obstacle, or room made for one, that began while the robot was on its path, or to
which the path itself would have led (a robot that drifts off comes near to others as well, but its path does not), and a robot
that has not arrived yet. A robot that starts off its path, or returns to it, is watched from the instant at which it is close
to it and as fast. When the path's velocity leaps, all robots have to arrive again.
"""

ARRIVED = 0.5  # of the limit
FORESEEN_S = 1.0  # a robot that stays that close for this time at its present speed is as fast as its path
AT_ONCE_MPS = 0.05  # a leap of the path's velocity from one step to the next; after a smaller one a robot keeps up
LASTS_S = 0.5


class PathDeviationMonitor:
    """Deviation of one robot from its path."""

    def __init__(self, limit_m: float) -> None:
        self._limit_m = limit_m
        self.reset()

    def reset(self) -> None:
        """Start anew, with another goal or none."""
        self.left = False  # stays so until the next reset
        self.has_arrived = False  # near the path, as fast, and free: from now on it is held to the limit
        self.is_on_path = False  # the same, also while it avoids something near its path
        self._since_ns: int | None = None
        self._before: tuple[complex, complex, int] | None = None
        self._path_mps: complex | None = None

    def step(self, place_m: complex, path_m: complex, is_free: bool, path_is_blocked: bool, now_ns: int) -> None:
        """Take in the robot's place and its reference, both x + iy in m. `is_free`: the robot avoids nothing at this step.
        `path_is_blocked`: it avoids what it would meet on its path too."""
        off_m = abs(place_m - path_m)
        drift_mps, path_leaps = self._motion(place_m, path_m, now_ns)
        if path_leaps:
            self.has_arrived = self.is_on_path = False
        if off_m + drift_mps * FORESEEN_S < ARRIVED * self._limit_m:
            self.has_arrived, self.is_on_path = is_free, True
        if path_is_blocked:
            self.has_arrived = False
        if off_m > ARRIVED * self._limit_m and not self.has_arrived:
            self.is_on_path = False
        if not (self.has_arrived and off_m > self._limit_m):
            self._since_ns = None
        elif self._since_ns is None:
            self._since_ns = now_ns
        else:
            self.left |= now_ns - self._since_ns >= LASTS_S * 1e9

    def _motion(self, place_m: complex, path_m: complex, now_ns: int) -> tuple[float, bool]:
        """Return the robot's speed relative to its path (m/s, infinity at the first step), and True if the path's velocity
        leaps."""
        before, self._before = self._before, (place_m, path_m, now_ns)
        if before is None:
            return float("inf"), False
        place_before_m, path_before_m, before_ns = before
        per_s = 1e9 / max(now_ns - before_ns, 1)
        robot_mps = (place_m - place_before_m) * per_s
        path_mps = (path_m - path_before_m) * per_s
        leaps = self._path_mps is not None and abs(path_mps - self._path_mps) > AT_ONCE_MPS
        self._path_mps = path_mps
        return abs(robot_mps - path_mps), leaps

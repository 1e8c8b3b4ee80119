"""Has a robot left its path without a reason? Pure. The last line: whatever it is that nobody has thought of, a robot that
does not go where it means to go says so.

Reasons are a way round somebody or something, or room made for somebody, from when the robot was still on its path (whoever
drifts off comes near to others as well), and not having arrived yet: a robot that starts off its path, or comes back to it, is
watched from where it has been close to it.
"""

ARRIVED = 0.5  # of the limit
LASTS_S = 0.5


class PathWatch:
    """One robot's."""

    def __init__(self, limit_m: float) -> None:
        self._limit_m = limit_m
        self.reset()

    def reset(self) -> None:
        """It has another goal, or none."""
        self.left = False  # stays so until the next reset
        self._has_arrived = False
        self._since_ns: int | None = None

    def step(self, off_m: float, is_free: bool, now_ns: int) -> None:
        """How far off its path the robot is; `is_free`: nothing leads it round, or aside."""
        if off_m < ARRIVED * self._limit_m:
            self._has_arrived = is_free
        if not (self._has_arrived and off_m > self._limit_m):
            self._since_ns = None
        elif self._since_ns is None:
            self._since_ns = now_ns
        else:
            self.left |= now_ns - self._since_ns >= LASTS_S * 1e9

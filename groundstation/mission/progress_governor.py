"""Formation feedback on the virtual structure: its clock goes slower while a robot lags. Pure.

The pace that is wanted falls from 1 at `wait_from_m` to `slowest` at `wait_at_m` of the worst robot's tracking error. The
pace itself follows through a critically damped second-order lag: no jump in any reference's velocity, nor in its rate of
change.
"""

from wire.config.mission import MissionConfig

ANSWER_S = 0.7  # time constant: slower than a robot's own tracking (0.3 s), or the two chase one another
STEADY_S = 0.1  # longest step of the pace: after a stall of the station it goes on from where it was, with no leap
ON_TIME = 1e-4  # of the pace: nearer than this it is 1
NOTICED = 0.95  # of the timetable's pace: below it the mission says that it waits


class Pace:
    """How fast the virtual structure goes, and how far it is behind its timetable."""

    def __init__(self, conduct: MissionConfig) -> None:
        self.lag_s = 0.0
        self.rate = 1.0
        self._change_per_s = 0.0
        self._conduct = conduct

    def reset(self) -> None:
        """Full pace again, the lag as it is: whoever holds is not waited for."""
        self.rate, self._change_per_s = 1.0, 0.0

    def start(self) -> None:
        """On time again."""
        self.reset()
        self.lag_s = 0.0

    @property
    def slowed(self) -> bool:
        """Whether it is worth telling people."""
        return self.rate < NOTICED

    def step(self, worst_error_m: float | None, elapsed_s: float) -> None:
        """`elapsed_s` later, with this tracking error; None: nobody is waited for. The lag grows as robots were told that it
        would, however late this step comes; the pace changes by no more than in STEADY_S."""
        self.lag_s += (1.0 - self.rate) * elapsed_s
        if worst_error_m is None:
            self.reset()
            return
        goal, step_s = self._goal(worst_error_m), min(elapsed_s, STEADY_S)
        if goal == self.rate == 1.0 and self._change_per_s == 0.0:
            return  # exactly on time stays exactly so
        pull = (goal - self.rate) / ANSWER_S**2 - 2.0 / ANSWER_S * self._change_per_s
        self._change_per_s += pull * step_s
        self.rate = min(max(self.rate + self._change_per_s * step_s, self._conduct.slowest), 1.0)
        if goal == 1.0 and 1.0 - self.rate < ON_TIME and abs(self._change_per_s) < ON_TIME:
            self.reset()

    def _goal(self, error_m: float) -> float:
        begin = self._conduct.wait_from_m
        if begin is None or error_m <= begin:
            return 1.0
        share = min((error_m - begin) / (self._conduct.wait_at_m - begin), 1.0)
        return 1.0 - share * (1.0 - self._conduct.slowest)

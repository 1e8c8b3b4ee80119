"""Instants of control steps by the wall clock. Pure: instants are arguments, in seconds on one monotonic clock.

Steps stand on a grid, one in each period: filters, plans and rate limits count in periods. The grid follows the camera slowly.
If the camera has the loop's rate, or a multiple of it, the two fall in step, and from then on each step comes with its pose:
up to EARLY before its place on the grid or LATE after. At any other rate steps come on the grid, with the newest pose. Either
way the mean period is the configured one.
"""

import math

EARLY = 0.25  # of a period: in step with the camera a step may come this much before its place, for a pose that arrives then
LATE = 0.5  # of a period: and waits this much longer for one; a step with an old pose is worth less than a late one
APART = 0.49  # of a period: no two steps are nearer; less than what LATE leaves of one, or rounding would cost a step
FOLLOWS = 0.1  # share of a pose's distance from the grid by which the grid moves with each step: averages the poses' delay
MOST = 0.01  # of a period, the grid's largest move in a step: keeps the period within 1 % at any camera rate
IN_STEP = 0.15  # of a period: poses are in step that are off the grid by less than this in the mean; at 30 Hz it is 0.17
MOST_LATE_S = 0.5  # of steps that count as late: what made a loop slow while the robot lay there is over that soon after it
BUDGET = 0.5  # of a period: pulses that leave later than this after their step was due are late


class StepClock:
    """Step clock of one control loop."""

    def __init__(self, period_s: float, now_s: float) -> None:
        self.missed = 0  # steps whose pulses left late
        self.late_steps = 0  # recent late steps less timely ones
        self._period_s, self._grid_s = period_s, now_s
        self._most_late = math.ceil(MOST_LATE_S / period_s)
        self._off_s = period_s  # mean distance of poses from the grid
        self._had_pose = False  # True if the last step had a new pose

    @property
    def opens_s(self) -> float:
        """Instant before which no pose brings a step."""
        return self._grid_s - EARLY * self._period_s

    def due_s(self, arrived_s: float | None) -> float:
        """Instant of the next step. `arrived_s` is the arrival of the newest pose, None if a step has taken it."""
        if self._off_s > IN_STEP * self._period_s:
            return self._grid_s
        # A step waits for its pose, but not after a step without one: a camera that is gone delays only one step.
        latest_s = self._grid_s + (LATE if self._had_pose else 0.0) * self._period_s
        if arrived_s is None or arrived_s <= self.opens_s:  # none new, or one that came too late for the step before
            return latest_s
        return min(arrived_s, latest_s)

    def note_step(self, now_s: float, arrived_s: float | None) -> None:
        """Move the grid on after a step at `now_s` with the pose that came at `arrived_s` (None: an old one), and towards that
        pose. Missed places on the grid are left out."""
        self._had_pose = arrived_s is not None
        if arrived_s is not None:
            off_s, most_s = math.remainder(arrived_s - self._grid_s, self._period_s), MOST * self._period_s
            self._grid_s += min(max(FOLLOWS * off_s, -most_s), most_s)
            self._off_s += FOLLOWS * (abs(off_s) - self._off_s)
        behind_s = now_s + APART * self._period_s - self._grid_s
        self._grid_s += max(math.ceil(behind_s / self._period_s), 0) * self._period_s

    def count_lateness(self, late_s: float) -> None:
        """Count a step whose pulses were sent `late_s` after it was due. A timely step cancels a late one: a single delay ends
        nothing, and a loop that cannot keep up is found in any pattern."""
        is_late = late_s > BUDGET * self._period_s
        self.missed += is_late
        self.late_steps = min(self.late_steps + 1, self._most_late) if is_late else max(self.late_steps - 1, 0)

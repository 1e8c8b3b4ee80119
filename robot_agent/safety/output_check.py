"""Comparison of the thruster board's echo with the commands sent to it. Pure.

The echo is one burst old, and its delay on the wire varies. But all its outputs are of one instant. So all outputs together
must lie at a command sent lately, or between it and the next one. (Each output checked by itself would excuse too much: of two
crossed outputs, one is now at the value that the other had a moment ago whenever the two cross.) The check finds outputs that
are crossed, stuck or limited otherwise than the vehicle file says, a board that obeys another sender, and a wire that is slow
in both directions. It cannot see two crossed outputs with equal commands, which do no harm.
"""

from collections import deque
from collections.abc import Sequence

import numpy as np

from robot_agent.safety.sent_commands import SentCommands
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Ints, IntTable
from shoal.mavlink.agent_link import CHANNELS
from shoal.messages.messages import BoardReading

TOLERANCE_US = 5
LATELY_NS = 350_000_000  # 100 ms each way on a bad wire, a board's loop, and what its slew rate takes
LEAP_US = 200  # a thruster's pulse may take longer for it than to the next command: then it is anywhere it was told lately
JUDGED_NS = 1_000_000_000  # an echo that happens to look right is no proof: what counts is how much of this was wrong
LONGEST_NS = 100_000_000  # that one echo speaks for
KEPT = 512  # commands: half of them are more than that of the fastest loop


@kernel(part=True)
def lies_between(echo_us: Ints, told_us: IntTable, first: int, last: int) -> bool:
    """True if every output (n,) lies within the range of the commands `first` to `last` of `told_us` (commands, n)."""
    for i in range(len(echo_us)):
        low = high = told_us[first, i]
        for k in range(first + 1, last + 1):
            low, high = min(low, told_us[k, i]), max(high, told_us[k, i])
        if echo_us[i] < low - TOLERANCE_US or echo_us[i] > high + TOLERANCE_US:
            return False
    return True


@kernel
def is_explained(echo_us: Ints, sent_ns: Ints, told_us: IntTable, count: int, arrival_ns: int, thrusters: int) -> bool:
    """True if an echo (n,) that came at `arrival_ns` is one of the first `count` commands, (commands, n) from the instants
    `sent_ns` on, that was in force within LATELY_NS, or lies between two that followed each other. Where one of the first
    `thrusters` outputs leapt, it may lie anywhere between all of them."""
    last = count - 1
    while last >= 0 and sent_ns[last] > arrival_ns:
        last -= 1
    if last < 0:
        return True
    first = last
    while first > 0 and sent_ns[first] > arrival_ns - LATELY_NS:
        first -= 1
    for k in range(first, last):
        for i in range(thrusters):
            if abs(told_us[k + 1, i] - told_us[k, i]) > LEAP_US:
                return lies_between(echo_us, told_us, first, last)
    is_between = False
    for k in range(first, last + 1):
        is_between |= lies_between(echo_us, told_us, k, min(k + 1, last))
    return is_between


class OutputCheck:
    """Commands to one board, compared with its echoes."""

    def __init__(self, thrusters: int) -> None:
        """`thrusters` is how many of the outputs, from the first on, are thrusters'."""
        self._thrusters = thrusters
        self._sent = SentCommands(CHANNELS, KEPT, np.int64)
        self.wrong_s = 0.0  # for how much of the last second the board, armed all the time, has put out something else
        self._wrong: deque[tuple[int, int]] = deque()  # instant, ns that it speaks for
        self._judged_ns = 0

    def note_pulses(self, pulse_us: Sequence[int], now_ns: int) -> None:
        """Take note of pulses that went out. Of two at one instant the last counts."""
        self._sent.note(pulse_us, now_ns)

    def note_board(self, board: BoardReading, now_ns: int) -> None:
        """Judge the newest echo. Call it once a step."""
        since_ns, self._judged_ns = now_ns - self._judged_ns, now_ns
        if not board.armed or len(board.echo_us) != CHANNELS:
            self._wrong.clear()
            self.wrong_s = 0.0
            return
        while self._wrong and self._wrong[0][0] <= now_ns - JUDGED_NS:
            self._wrong.popleft()
        sent, echo_us = self._sent, np.array(board.echo_us)
        if since_ns > 0 and not is_explained(
            echo_us, sent.at_ns, sent.commands, sent.count, board.arrival_ns, self._thrusters
        ):
            self._wrong.append((now_ns, min(since_ns, LONGEST_NS)))
        self.wrong_s = sum(ns for _, ns in self._wrong) * 1e-9

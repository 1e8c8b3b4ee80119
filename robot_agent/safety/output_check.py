"""Comparison of the thruster board's echo with the commands sent to it. Pure.

The echo is one burst old, and its delay on the wire varies. But all its outputs are of one instant. So all outputs together
must lie at a command sent lately, or between it and the next one. (Each output checked by itself would excuse too much: of two
crossed outputs, one is now at the value that the other had a moment ago whenever the two cross.) The check finds outputs that
are crossed, stuck or limited otherwise than the vehicle file says, a board that obeys another sender, and a wire that is slow
in both directions. It cannot see two crossed outputs with equal commands, which do no harm.
"""

from collections import deque
from collections.abc import Sequence
from itertools import pairwise

from wire.mavlink.agent_link import CHANNELS, Telemetry

TOLERANCE_US = 5
LATELY_NS = 350_000_000  # 100 ms each way on a bad wire, a board's loop, and what its slew rate takes
LEAP_US = 200  # a thruster's pulse may take longer for it than to the next command: then it is anywhere it was told lately
JUDGED_NS = 1_000_000_000  # an echo that happens to look right is no proof: what counts is how much of this was wrong
LONGEST_NS = 100_000_000  # that one echo speaks for
KEPT = 256  # commands: more than that of the fastest loop

Pulses = tuple[int, ...]


class OutputCheck:
    """Commands to one board, compared with its echoes."""

    def __init__(self) -> None:
        self._told: deque[tuple[int, Pulses]] = deque(maxlen=KEPT)
        self.wrong_s = 0.0  # for how much of the last second the board, armed all the time, has put out something else
        self._wrong: deque[tuple[int, int]] = deque()  # instant, ns that it speaks for
        self._judged_ns = 0

    def note_pulses(self, pulse_us: Sequence[int], now_ns: int) -> None:
        """Take note of pulses that went out. Of two at one instant the last counts."""
        if self._told and self._told[-1][0] == now_ns:
            self._told.pop()
        self._told.append((now_ns, tuple(pulse_us)))

    def note_telemetry(self, telemetry: Telemetry, now_ns: int) -> None:
        """Judge the newest echo. Call it once a step."""
        since_ns, self._judged_ns = now_ns - self._judged_ns, now_ns
        if not telemetry.armed or len(telemetry.echo_us) != CHANNELS:
            self._wrong.clear()
            self.wrong_s = 0.0
            return
        while self._wrong and self._wrong[0][0] <= now_ns - JUDGED_NS:
            self._wrong.popleft()
        if since_ns > 0 and not self._is_right(telemetry):
            self._wrong.append((now_ns, min(since_ns, LONGEST_NS)))
        self.wrong_s = sum(ns for _, ns in self._wrong) * 1e-9

    def _is_right(self, telemetry: Telemetry) -> bool:
        lately = self._lately(telemetry.arrival_ns)
        if not lately:
            return True
        if any(abs(a - b) > LEAP_US for one, other in pairwise(lately) for a, b in zip(one[:4], other[:4], strict=True)):
            return _between(telemetry.echo_us, lately)
        return any(_between(telemetry.echo_us, lately[i : i + 2]) for i in range(len(lately)))

    def _lately(self, arrival_ns: int) -> list[Pulses]:
        """Return the commands sent before an echo came, newest first; also the last one before that time span, which held into
        it."""
        lately = []
        for sent_ns, pulse_us in reversed(self._told):
            if sent_ns <= arrival_ns:
                lately.append(pulse_us)
                if sent_ns <= arrival_ns - LATELY_NS:
                    break
        return lately


def _between(echo_us: Pulses, told: Sequence[Pulses]) -> bool:
    """True if every output lies within the range of the given commands."""
    return all(
        min(pulses) - TOLERANCE_US <= echo <= max(pulses) + TOLERANCE_US
        for echo, pulses in zip(echo_us, zip(*told, strict=True), strict=True)
    )

"""Does the thruster board put out what it is told? Pure.

The board's echo is a burst old, and on its way outputs pass everything between two commands at the board's own rate. So an
echo is right if every output lies within what it was told lately. That finds outputs that are crossed, stuck or limited
otherwise than the vehicle file says, a board that listens to somebody else, and a wire that is slow both ways.
"""

from collections import deque
from collections.abc import Sequence

from wire.mavlink import CHANNELS, Telemetry

TOLERANCE_US = 5
LATELY_NS = 350_000_000  # 100 ms each way on a bad wire, a board's loop, and what its slew rate takes
KEPT = 256  # commands: more than that of the fastest loop


class EchoCheck:
    """What one board was told, beside what it says."""

    def __init__(self) -> None:
        self._told: deque[tuple[int, tuple[int, ...]]] = deque(maxlen=KEPT)
        self._wrong_since_ns: int | None = None

    def told(self, pulse_us: Sequence[int], now_ns: int) -> None:
        """These pulses went out. Of two at one instant the last counts."""
        if self._told and self._told[-1][0] == now_ns:
            self._told.pop()
        self._told.append((now_ns, tuple(pulse_us)))

    def wrong_s(self, telemetry: Telemetry, now_ns: int) -> float:
        """For how long the board, being armed, has put out something else; 0 if it does not. Call it at every step."""
        if not telemetry.armed or len(telemetry.echo_us) != CHANNELS or self._is_right(telemetry):
            self._wrong_since_ns = None
            return 0.0
        if self._wrong_since_ns is None:
            self._wrong_since_ns = now_ns
        return (now_ns - self._wrong_since_ns) * 1e-9

    def _is_right(self, telemetry: Telemetry) -> bool:
        """Commands still count when they were the last before the time looked at: they held into it."""
        from_ns, lately = telemetry.arrival_ns - LATELY_NS, []
        for sent_ns, pulse_us in reversed(self._told):
            if sent_ns <= telemetry.arrival_ns:
                lately.append(pulse_us)
                if sent_ns <= from_ns:
                    break
        if not lately:
            return True
        return all(
            min(told) - TOLERANCE_US <= echo <= max(told) + TOLERANCE_US
            for echo, told in zip(telemetry.echo_us, zip(*lately, strict=True), strict=True)
        )

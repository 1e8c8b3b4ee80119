"""Delay of messages beyond the fastest, estimated without a shared clock. Pure.

What a network or a stopped process has held back comes in a burst, and each message looks as if it had just been sent. But
between the sender's clock and ours there is, up to drift, one constant and the time on the way: a message that took longer
than the fastest of the last while is late by the difference. What all messages take alike cannot be seen so.

No length of delay is too long to be one: a process's clock is never set (WallClock), and a new process is a new session. Only
a computer that slept falls behind; its messages count as late for one to two windows.
"""

WINDOW_NS = 10_000_000_000  # the fastest of the last one to two windows counts: clocks drift by at most 1 ms meanwhile
DRIFT = 2e-4  # of two clocks against each other: 100 ppm each, twice what a crystal may have


class DelayEstimator:
    """The delay estimate of the messages of one sender."""

    def __init__(self) -> None:
        self._session: int | None = None
        self._least_ns = self._least_before_ns = 0  # in this window and in the one before: arrived minus sent
        self._since_ns = self._arrived_ns = 0

    def excess_ns(self, session: int, sent_ns: int, arrived_ns: int) -> int:
        """The delay of a message beyond the fastest of late. `sent_ns` is on the sender's clock, `arrived_ns` on the
        receiver's."""
        took_ns = arrived_ns - sent_ns
        silent_ns, self._arrived_ns = arrived_ns - self._arrived_ns, arrived_ns
        beyond_ns = took_ns - min(self._least_ns, self._least_before_ns)
        drifted = silent_ns > 2 * WINDOW_NS and abs(beyond_ns) <= DRIFT * silent_ns
        if session != self._session or drifted:
            self._session, self._since_ns = session, arrived_ns
            self._least_ns = self._least_before_ns = took_ns
            return 0
        if arrived_ns - self._since_ns > WINDOW_NS:
            self._least_before_ns, self._least_ns, self._since_ns = self._least_ns, took_ns, arrived_ns
        self._least_ns = min(self._least_ns, took_ns)
        return took_ns - min(self._least_ns, self._least_before_ns)

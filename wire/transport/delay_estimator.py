"""Delay of messages beyond the fastest, estimated without a shared clock. Pure.

What a network or a stopped process has held back comes in a burst, and each message looks as if it had just been sent. But
between the sender's clock and ours there is, up to drift, one constant and the time on the way: a message that took longer
than the fastest of the last while is late by the difference. What all messages take alike cannot be seen so.
"""

WINDOW_NS = 10_000_000_000  # the fastest of the last one to two windows counts: clocks drift by at most 1 ms meanwhile
ANOTHER_CLOCK_NS = 5_000_000_000  # a jump beyond this is a clock that was set: links are given up after 1 s


class DelayEstimator:
    """The delay estimate of the messages of one sender."""

    def __init__(self) -> None:
        self._session: int | None = None
        self._least_ns = self._least_before_ns = 0  # in this window and in the one before: arrived minus sent
        self._since_ns = 0

    def excess_ns(self, session: int, sent_ns: int, arrived_ns: int) -> int:
        """The delay of a message beyond the fastest of late. `sent_ns` is on the sender's clock, `arrived_ns` on the
        receiver's."""
        took_ns = arrived_ns - sent_ns
        least_ns = min(self._least_ns, self._least_before_ns)
        forgotten = arrived_ns - self._since_ns > 2 * WINDOW_NS  # nothing came for so long: clocks may have drifted apart
        if session != self._session or forgotten or took_ns - least_ns > ANOTHER_CLOCK_NS:
            self._session, self._since_ns = session, arrived_ns
            self._least_ns = self._least_before_ns = took_ns
            return 0
        if arrived_ns - self._since_ns > WINDOW_NS:
            self._least_before_ns, self._least_ns, self._since_ns = self._least_ns, took_ns, arrived_ns
        self._least_ns = min(self._least_ns, took_ns)
        return took_ns - min(self._least_ns, self._least_before_ns)

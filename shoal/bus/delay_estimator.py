"""Delay of messages beyond the fastest, estimated without a shared clock. Pure.

What a network or a stopped process has held back comes in a burst, and each message looks as if it had just been sent. But
between the sender's clock and ours there is, up to drift, one constant and the time on the way: a message that took longer
than the fastest of the last while is late by the difference. What all messages take alike cannot be seen so.

No length of delay is too long to be one: a process's clock is never set (WallClock), and a new process is a new session. Only
a computer that slept falls behind; its messages count as late for as long as WINDOWS lasts.

Clocks drift: what the fastest of several windows show of it is taken off, for a pose comes by way of three clocks and more.
"""

from collections import OrderedDict, deque

from shoal.messages.codec import Header

WINDOW_NS = 2_000_000_000
WINDOWS = 8  # the fastest of so many counts; a way that has been slower for longer is the usual one
SENDERS = 4096  # remembered by `SenderDelays`; each terminal's command is one
DRIFT = 2e-4  # of two clocks against each other: 100 ppm each, twice what a crystal may have


class DelayEstimator:
    """The delay estimate of the messages of one session."""

    def __init__(self) -> None:
        self._fastest = deque[tuple[int, int]](maxlen=WINDOWS)  # of each window: arrival, and arrived minus sent
        self._rate = 0.0  # at which the two clocks drift apart
        self._since_ns = self._arrived_ns = 0  # begin of the last window, and the last arrival

    def excess_ns(self, sent_ns: int, arrived_ns: int) -> int:
        """Take in a message, and return its delay beyond the fastest message of the last windows. `sent_ns` is on the sender's
        clock, `arrived_ns` on the receiver's."""
        took_ns = arrived_ns - sent_ns
        silent_ns = arrived_ns - self._arrived_ns
        self._arrived_ns = arrived_ns
        if not self._fastest or self._is_drift(took_ns, arrived_ns, silent_ns):
            self._begin_window(arrived_ns, 0.0)
            self._fastest.clear()
            self._fastest.append((arrived_ns, took_ns))
            return 0
        if arrived_ns - self._since_ns > WINDOW_NS:
            self._begin_window(arrived_ns, self._drift())
            self._fastest.append((arrived_ns, took_ns))
        fastest_arrived_ns, fastest_ns = self._fastest[-1]
        if took_ns <= fastest_ns + self._rate * (arrived_ns - fastest_arrived_ns):
            self._fastest[-1] = arrived_ns, took_ns
        return took_ns - self._least_ns(arrived_ns)

    def _is_drift(self, took_ns: int, arrived_ns: int, silent_ns: int) -> bool:
        """True for the first message after a silence longer than all windows, if the drift of two clocks in that silence
        explains its difference from the fastest: then all begins anew with it."""
        is_long_silence = silent_ns > WINDOWS * WINDOW_NS
        return is_long_silence and abs(took_ns - self._least_ns(arrived_ns)) <= DRIFT * silent_ns

    def _begin_window(self, now_ns: int, rate: float) -> None:
        """Begin a window, with the drift that is taken off in it."""
        self._since_ns = now_ns
        self._rate = rate

    def _least_ns(self, arrived_ns: int) -> int:
        """Arrival minus sending of the fastest of late, if it came now."""
        return min((took_ns + round(self._rate * (arrived_ns - at_ns)) for at_ns, took_ns in self._fastest))

    def _drift(self) -> float:
        """The rate by the first and the last window, if a drift can be so fast; else what was known."""
        (begin_ns, first_ns), (end_ns, last_ns) = self._fastest[0], self._fastest[-1]
        rate = (last_ns - first_ns) / (end_ns - begin_ns) if end_ns > begin_ns else 0.0
        return rate if abs(rate) <= DRIFT else self._rate


class SenderDelays:
    """The delay estimates of many senders' messages: of those that were heard last."""

    def __init__(self) -> None:
        self._senders: OrderedDict[int, DelayEstimator] = OrderedDict()  # by session

    def excess_ns(self, header: Header, arrived_ns: int) -> int:
        """Take in a message, and return its delay beyond the fastest one of its sender."""
        sender = self._senders.setdefault(header.session, DelayEstimator())
        self._senders.move_to_end(header.session)
        if len(self._senders) > SENDERS:
            self._senders.popitem(last=False)
        return sender.excess_ns(header.stamp_ns + header.age_ns, arrived_ns)

"""Send window of one page: at most two frames on the way, the latest state and picture, every note in order. Pure.

A browser that stops acknowledging stops being sent to. What it costs is one state, one picture and MOST_NOTES notes, and the
bytes of two frames in a socket; nothing waits for it. Notes and states take turns, so that neither keeps the other waiting.
Before the connection ends, all that waits goes out at once.
"""

from collections import deque

UNACKNOWLEDGED = 2
MOST_NOTES = 256


class SendWindow:
    """One watcher's side of the stream. Frames are bodies without a number; `next` numbers them."""

    def __init__(self) -> None:
        self.round_trip_s = 0.0  # of the last frame acknowledged: network and drawing together
        self._notes: deque[bytes] = deque()
        self._latest: dict[str, bytes] = {}  # by kind, the one that waited longest first
        self._sent_s: dict[int, float] = {}
        self._n = 0
        self._noted = False  # the frame before was a note
        self._ends = False

    def note(self, body: bytes) -> None:
        """Queue something that must arrive: an answer, an event. The oldest go when the page takes none."""
        if len(self._notes) >= MOST_NOTES:
            self._notes.popleft()
        self._notes.append(body)

    def offer(self, kind: str, body: bytes) -> None:
        """Keep something of which only the latest counts."""
        self._latest[kind] = body

    def next(self, now_s: float) -> tuple[int, bytes] | None:
        """Number and body of the frame to send now; None when there is nothing or too much is on its way."""
        full = len(self._sent_s) >= UNACKNOWLEDGED and not self._ends
        if full or not (self._notes or self._latest):
            return None
        self._noted = bool(self._notes) and not (self._noted and self._latest)
        body = self._notes.popleft() if self._noted else self._latest.pop(next(iter(self._latest)))
        self._n += 1
        self._sent_s[self._n] = now_s
        return self._n, body

    def end(self) -> None:
        """Wait for no acknowledgement from now on: the connection is about to be closed."""
        self._ends = True

    def acknowledge(self, n: int, now_s: float) -> None:
        """Frame `n` and those before it have arrived. A number that was never sent changes nothing."""
        if n in self._sent_s:
            self.round_trip_s = now_s - self._sent_s[n]
        self._sent_s = {number: at for number, at in self._sent_s.items() if number > n}

"""Send window of one page: at most two frames on the way, the latest state and picture, every answer and note in order. Pure.

A browser that stops acknowledging stops being sent to. What it costs is one state, one picture, MOST_NOTES notes and as many
answers, and the bytes of two frames in a socket; nothing waits for it. Notes and states take turns, so that neither keeps the
other waiting. Answers go before notes, and no number of notes drops one. Before the connection ends, all that waits goes out.
"""

from collections import deque

UNACKNOWLEDGED = 2
MOST_NOTES = 256


class SendWindow:
    """One watcher's side of the stream. Frames are bodies without a number; `next` numbers them."""

    def __init__(self) -> None:
        """Begin with nothing queued and nothing on its way."""
        self.round_trip_s = 0.0  # of the last frame acknowledged: network and drawing together
        self._answers: deque[bytes] = deque(maxlen=MOST_NOTES)
        self._notes: deque[bytes] = deque(maxlen=MOST_NOTES)
        self._latest: dict[str, bytes] = {}  # by kind, the one that waited longest first
        self._sent_s: dict[int, float] = {}  # instants of the frames that are not acknowledged, by number
        self._last_number = 0
        self._last_was_queued = False  # the frame before was an answer or a note, no state
        self._ends = False

    def answer(self, body: bytes) -> None:
        """Queue something that the page waits for. The oldest go when the page asks and takes none."""
        self._answers.append(body)

    def greet(self, body: bytes) -> None:
        """Queue what the page is to hear before anything else."""
        self._answers.appendleft(body)

    def note(self, body: bytes) -> None:
        """Queue an event. The oldest go when the page takes none."""
        self._notes.append(body)

    def offer(self, kind: str, body: bytes) -> None:
        """Keep something of which only the latest counts."""
        self._latest[kind] = body

    def next(self, now_s: float) -> tuple[int, bytes] | None:
        """Number and body of the frame to send now; None when there is nothing or too much is on its way."""
        full = len(self._sent_s) >= UNACKNOWLEDGED and not self._ends
        queue = self._answers or self._notes
        if full or not (queue or self._latest):
            return None
        is_turn_of_latest = self._last_was_queued and bool(self._latest)
        self._last_was_queued = bool(queue) and not is_turn_of_latest
        if self._last_was_queued:
            body = queue.popleft()
        else:
            longest_waiting = next(iter(self._latest))
            body = self._latest.pop(longest_waiting)
        self._last_number += 1
        self._sent_s[self._last_number] = now_s
        return self._last_number, body

    def end(self) -> None:
        """Wait for no acknowledgement from now on: the connection is about to be closed."""
        self._ends = True

    def acknowledge(self, n: int, now_s: float) -> None:
        """Frame `n` and those before it have arrived. A number that was never sent changes nothing."""
        if n in self._sent_s:
            self.round_trip_s = now_s - self._sent_s[n]
        self._sent_s = {number: at for number, at in self._sent_s.items() if number > n}

"""Is a number larger, for a while, than anything of its kind was before? Pure.

What a robot cannot explain is never zero, and in rough water it is much. So what counts as too much is learned in flight:
twice the largest that came before. Of that the newest second does not count (else what breaks would excuse itself), and the
rest for minutes, for gusts come seldom; but starts are rough in any water, and what came of them is soon forgotten.
"""

import math
from collections import deque

NS = 1_000_000_000
FACTOR = 2.0
YOUNG_NS = NS  # what is younger does not count yet: what breaks must not excuse itself
HELD_S = 200.0
START_S = 10.0


class Unusual:
    """One number, looked at step by step."""

    def __init__(self, first: float, first_held_s: float, start_held_s: float, least: float, lasts_s: float) -> None:
        """`first` stands for what came before there was anything, and counts for `first_held_s`; what comes of a start counts
        for `start_held_s`. What is not above `least` is never too much; what is shorter than `lasts_s` is a bump."""
        self._first_held_s, self._start_held_s, self._least, self._lasts_s = first_held_s, start_held_s, least, lasts_s
        self._first, self._start, self._peak, self._over_s, self._flown_s = first, 0.0, 0.0, 0.0, 0.0
        self._young: deque[tuple[int, float]] = deque()  # not yet old enough for the peaks

    def step(self, value: float, elapsed_s: float, at_ns: int) -> bool:
        """Whether it has been too large for long enough by now."""
        is_large = value > max(self._least, FACTOR * max(self._first, self._start, self._peak))
        self._over_s = self._over_s + elapsed_s if is_large else 0.0
        self._flown_s += elapsed_s
        self._first *= math.exp(-elapsed_s / self._first_held_s)
        self._start *= math.exp(-elapsed_s / self._start_held_s)
        self._peak *= math.exp(-elapsed_s / HELD_S)
        self._young.append((at_ns, value))
        while self._young[0][0] <= at_ns - YOUNG_NS:
            _, old = self._young.popleft()
            if self._flown_s < START_S:
                self._start = max(self._start, old)
            else:
                self._peak = max(self._peak, old)
        return self._over_s > self._lasts_s - 1e-9

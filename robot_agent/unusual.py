"""Is a number larger, for a while, than anything of its kind was lately? Pure.

What a robot cannot explain is never zero, and in rough water it is much. So what counts as too much is learned in flight: a
multiple of the largest that came before, of which the newest second does not count (else what breaks would excuse itself) and
the rest counts less the longer ago it is.
"""

import math
from collections import deque

NS = 1_000_000_000
PEAK_AGE_NS = NS


class Unusual:
    """One number, looked at step by step."""

    def __init__(self, factor: float, first: float, least: float, held_s: float, lasts_s: float) -> None:
        """Too much is `factor` times what came before, and more than `least`. `first` stands for what came before there was
        anything; the past counts for `held_s`; shorter than `lasts_s` is a bump."""
        self._factor, self._least, self._held_s, self._lasts_s = factor, least, held_s, lasts_s
        self._peak, self._over_s = first, 0.0
        self._young: deque[tuple[int, float]] = deque()  # not yet old enough for the peak

    def step(self, value: float, elapsed_s: float, at_ns: int) -> bool:
        """Whether it has been too large for long enough by now."""
        self._over_s = self._over_s + elapsed_s if value > max(self._least, self._factor * self._peak) else 0.0
        self._peak *= math.exp(-elapsed_s / self._held_s)
        self._young.append((at_ns, value))
        while self._young[0][0] <= at_ns - PEAK_AGE_NS:
            self._peak = max(self._peak, self._young.popleft()[1])
        return self._over_s > self._lasts_s - 1e-9

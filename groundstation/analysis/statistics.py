"""Figures for people: three digits, and means over flights with 95 % bootstrap confidence intervals. Pure."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

NOTHING = "–"  # what is not known
MOST_PLACES = 4
CONFIDENCE = 0.95
RESAMPLES = 1000  # of a bootstrap: its interval's ends are then known to a few per cent of its width
AT_ONCE = 1_000_000  # numbers that are drawn at a time: 16 MB


def three(value: float | None, factor: float = 1.0) -> str:
    """Value times factor with three significant digits, never in powers of ten; a dash for an unknown value."""
    if value is None or not math.isfinite(value):
        return NOTHING
    scaled = value * factor
    if scaled == 0.0:
        return "0"
    power = int(f"{scaled:.2e}".partition("e")[2])  # after rounding: 99.96 is 100
    places = min(max(0, 2 - power), MOST_PLACES)
    return f"{scaled:.{places}f}"


@dataclass(frozen=True)
class Interval:
    """A figure and its confidence interval. A bound is None if there are too few flights for it."""

    value: float
    low: float | None
    high: float | None

    def __str__(self) -> str:
        """Value and interval as text, such as `7.90 [0.310, 19.5]`."""
        if self.low is None or self.high is None:
            return three(self.value)
        return f"{three(self.value)} [{three(self.low)}, {three(self.high)}]"


def mean(values: Sequence[float]) -> Interval:
    """Mean with its bootstrap interval (percentiles of the means of samples drawn again, always the same ones): it stays
    within the values, so what cannot be negative has no negative bound."""
    numbers = np.asarray(values, dtype=np.float64)
    centre, count = float(numbers.mean()), len(numbers)
    if count < 2:
        return Interval(centre, None, None)
    random, rows = np.random.default_rng(0), max(AT_ONCE // count, 1)
    means = [
        numbers[random.integers(count, size=(min(rows, RESAMPLES - row), count))].mean(axis=1)
        for row in range(0, RESAMPLES, rows)
    ]
    low, high = np.quantile(np.concatenate(means), [(1.0 - CONFIDENCE) / 2.0, (1.0 + CONFIDENCE) / 2.0])
    return Interval(centre, float(low), float(high))

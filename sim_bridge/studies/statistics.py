"""Statistics over flights: means, quantiles and rates, each with its 95 % confidence interval. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

CONFIDENCE = 0.95
RESAMPLES = 1000  # of a bootstrap: its interval's ends are then known to a few per cent of its width
HIGH = 0.95  # the quantile that is reported beside the median


@dataclass(frozen=True)
class Interval:
    """A figure and its confidence interval. A bound is None if there are too few flights for it."""

    value: float
    low: float | None
    high: float | None


@dataclass(frozen=True)
class Distribution:
    """One metric over many flights."""

    n: int
    mean: Interval
    median: Interval
    high: Interval  # the HIGH quantile
    least: float
    most: float


def rate(hits: int, n: int) -> Interval:
    """Share of flights, with Wilson's interval, which is good near 0 and 1 too."""
    found = stats.binomtest(hits, n).proportion_ci(CONFIDENCE, "wilson")
    return Interval(hits / n, float(found.low), float(found.high))


def distribution(values: Sequence[float]) -> Distribution:
    """Distribution of at least one value."""
    ranked = np.sort(np.asarray(values, dtype=np.float64))
    return Distribution(
        len(ranked), mean(ranked.tolist()), quantile(ranked, 0.5), quantile(ranked, HIGH), float(ranked[0]), float(ranked[-1])
    )


def quantile(ranked: np.ndarray[tuple[int], np.dtype[np.float64]], share: float) -> Interval:
    """A quantile of sorted values. The interval is between order statistics, for any distribution (scipy's quantile test).
    A bound is None if no value lies beyond it with that confidence."""
    found: Any = stats.quantile_test(ranked, p=share).confidence_interval(CONFIDENCE)
    low, high = (None if np.isnan(end) else float(end) for end in (found.low, found.high))
    return Interval(float(np.quantile(ranked, share)), low, high)


def mean(values: Sequence[float]) -> Interval:
    """Mean with its bootstrap interval (percentiles of the means of samples drawn again, always the same ones): it stays
    within the values, so what cannot be negative has no negative bound."""
    known = np.asarray(values, dtype=np.float64)
    centre = float(known.mean())
    if len(known) < 2:
        return Interval(centre, None, None)
    drawn = known[np.random.default_rng(0).integers(len(known), size=(RESAMPLES, len(known)))].mean(axis=1)
    low, high = np.quantile(drawn, [(1.0 - CONFIDENCE) / 2.0, (1.0 + CONFIDENCE) / 2.0])
    return Interval(centre, float(low), float(high))

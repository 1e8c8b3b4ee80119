"""What many flights say together: means, quantiles and rates, each with its 95 % confidence interval. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

CONFIDENCE = 0.95
HIGH = 0.95  # the quantile that is reported beside the median


@dataclass(frozen=True)
class Interval:
    """A figure and where the true one lies, at the confidence above. None: too few flights to say."""

    value: float
    low: float | None
    high: float | None


@dataclass(frozen=True)
class Distribution:
    """One measure over many flights."""

    n: int
    mean: Interval
    median: Interval
    high: Interval  # the HIGH quantile
    least: float
    most: float


def rate(hits: int, n: int) -> Interval:
    """Share of flights (Wilson's interval, good near 0 and 1 too)."""
    found = stats.binomtest(hits, n).proportion_ci(CONFIDENCE, "wilson")
    return Interval(hits / n, float(found.low), float(found.high))


def distribution(values: Sequence[float]) -> Distribution:
    """Of at least one value."""
    ranked = np.sort(np.asarray(values, dtype=np.float64))
    return Distribution(
        len(ranked), _mean(ranked), quantile(ranked, 0.5), quantile(ranked, HIGH), float(ranked[0]), float(ranked[-1])
    )


def quantile(ranked: np.ndarray[tuple[int], np.dtype[np.float64]], share: float) -> Interval:
    """A quantile of sorted values. The interval is between order statistics, whatever the distribution: the number of values
    below the true quantile is binomial. A bound is None where no value lies beyond it with that confidence."""
    n = len(ranked)
    at = float(np.quantile(ranked, share))
    tail = (1.0 - CONFIDENCE) / 2.0
    low = int(stats.binom.ppf(tail, n, share))  # P(fewer than low + 1 lie below) reaches the tail here
    high = int(stats.binom.isf(tail, n, share)) + 1
    return Interval(
        at,
        float(ranked[low - 1]) if low >= 1 and stats.binom.cdf(low - 1, n, share) <= tail else None,
        float(ranked[high - 1]) if high <= n else None,
    )


def _mean(ranked: np.ndarray[tuple[int], np.dtype[np.float64]]) -> Interval:
    """Student's interval: good for the mean of some tens of flights, whatever their distribution."""
    n, mean = len(ranked), float(ranked.mean())
    if n < 2:
        return Interval(mean, None, None)
    half = float(stats.t.isf((1.0 - CONFIDENCE) / 2.0, n - 1) * ranked.std(ddof=1) / np.sqrt(n))
    return Interval(mean, mean - half, mean + half)

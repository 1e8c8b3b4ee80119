"""Statistics over flights: means, quantiles and rates, each with its 95 % confidence interval. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from groundstation.analysis.statistics import CONFIDENCE, Interval, mean

HIGH = 0.95  # the quantile that is reported beside the median


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
    bounds = stats.binomtest(hits, n).proportion_ci(CONFIDENCE, "wilson")
    return Interval(hits / n, float(bounds.low), float(bounds.high))


def distribution(values: Sequence[float]) -> Distribution:
    """Distribution of at least one value."""
    ranked = np.sort(np.asarray(values, dtype=np.float64))
    return Distribution(
        len(ranked), mean(ranked.tolist()), quantile(ranked, 0.5), quantile(ranked, HIGH), float(ranked[0]), float(ranked[-1])
    )


def quantile(ranked: np.ndarray[tuple[int], np.dtype[np.float64]], share: float) -> Interval:
    """A quantile of sorted values. The interval is between order statistics, for any distribution (scipy's quantile test).
    A bound is None if no value lies beyond it with that confidence."""
    bounds: Any = stats.quantile_test(ranked, p=share).confidence_interval(CONFIDENCE)
    low, high = (None if np.isnan(end) else float(end) for end in (bounds.low, bounds.high))
    return Interval(float(np.quantile(ranked, share)), low, high)

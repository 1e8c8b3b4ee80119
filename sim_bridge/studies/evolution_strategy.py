"""Tuning a law: one search for all, with the same budget, from the same kind of first guess. Pure but for `cost`.

Every gain is searched on a logarithmic scale. A quarter of the budget goes to random draws around the first guess, by a factor
of 4 up or down; the rest to a (1+1) evolution strategy from the best of them, whose step follows the one-fifth success rule
(Rechenberg 1973; Beyer and Schwefel 2002). It needs no gradients, has no parameters worth tuning, and cannot be led astray by
the kinks that limits make.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from wire.config.controller_benchmark import FlightMetrics
from wire.frames import Array

DRAWN = 0.25  # of the budget
REACH = math.log(4.0)
FIRST_STEP = 0.4  # of a factor e per gain
GROW = 1.5  # one success makes up for four failures
FLOOR_M = 0.001  # errors below are as good as none
WEAR = 2.0  # what the largest input change all the time would cost: as much as both errors e times as large
FAILED = 10.0  # what robots would cost that never get under way


@dataclass(frozen=True, eq=False)
class Trial:
    """One set of gains that was flown."""

    gains: Array
    cost: float


def cost(flights: Sequence[FlightMetrics]) -> float:
    """Mean over flights of ln(error in the whole run, m and rad) + ln(distance after 20 s, m) + WEAR x change of inputs. By
    logarithms scenes whose errors differ by a factor of a hundred count alike."""
    return sum(_cost(figures) for figures in flights) / len(flights)


def _cost(figures: FlightMetrics) -> float:
    whole, settled = math.hypot(figures.rms_m, figures.rms_yaw_rad), figures.rms_after_20s_m + FLOOR_M
    return math.log(whole) + math.log(settled) + WEAR * figures.input_step_rms + FAILED * (1.0 - figures.under_way)


def search(first: Array, budget: int, seed: int, fly: Callable[[Array], float]) -> Iterator[Trial]:
    """`budget` trials; the first is the guess itself."""
    random = np.random.default_rng(seed)
    best = Trial(first, fly(first))
    yield best
    for _ in range(max(1, round(DRAWN * budget)) - 1):
        trial = _tried(first * np.exp(random.uniform(-REACH, REACH, first.shape)), fly)
        best = min(best, trial, key=lambda t: t.cost)
        yield trial
    step = FIRST_STEP
    for _ in range(budget - max(1, round(DRAWN * budget))):
        trial = _tried(best.gains * np.exp(step * random.standard_normal(first.shape)), fly)
        better = trial.cost < best.cost
        best = trial if better else best
        step *= GROW if better else GROW**-0.25
        yield trial


def _tried(gains: Array, fly: Callable[[Array], float]) -> Trial:
    rounded = np.array([float(f"{gain:.3g}") for gain in gains])  # what is flown is what can be written down
    return Trial(rounded, fly(rounded))

"""Comparisons of laws whose figures are given."""

import dataclasses
import math

import numpy as np

from groundstation.analysis.comparison import Comparison, FlightRecord, Traces, Variant
from tests.sim_bridge.studies.flight_metrics import GOOD

COMMIT = "0123456789abcdef0123456789abcdef01234567"
SINE = [round(9.0 * math.sin(0.1 * k), 3) for k in range(100)]
TRACES = Traces(0.5, [0.5 * 0.9**k for k in range(60)], 0.05, [SINE, SINE], [[max(-6.0, min(6.0, v)) for v in SINE]] * 2)


def variant(name: str, factor: float, seeds: int = 4) -> Variant:
    random = np.random.default_rng(seeds)  # the same for all: seeds are flown by everyone
    flights = []
    for seed in range(1, seeds + 1):
        luck = float(random.uniform(0.5, 2.0))
        figures = dataclasses.replace(GOOD, rms_after_20s_m=0.01 * factor * luck, min_separation_m=0.7)
        flights.append(FlightRecord(seed, figures, TRACES if seed == 1 else None))
    return Variant(name, [f"controller.law={name}"], flights)


def comparison(*variants: Variant) -> Comparison:
    return Comparison("pool", "Two robots <&>", 45.0, 0.1, ["seed=3"], 6.0, [1, 2], list(variants), 0.6, COMMIT)

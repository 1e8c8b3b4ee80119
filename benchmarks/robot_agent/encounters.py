"""`python -m benchmarks encounters`: 200 random starts of every scene in which robots are in one another's way (30 minutes).

The starts are those of tests/flights/encounters.py.
"""

import dataclasses
import os
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from benchmarks.harness import Row
from shoal.config.experiment import load_experiment
from sim_bridge.studies.worker_pool import worker_pool
from tests.flights.encounters import SCENES, Encounter, meet

STARTS = 200
NEAREST_M = 0.6  # twice safety.radius_m in all scenes: how near centres may come


def _flown(task: tuple[str, int]) -> Encounter:
    name, seed = task
    return dataclasses.replace(meet(load_experiment(name), seed), track=np.zeros(0))


def campaign(scenes: Sequence[str] = SCENES, seeds: Iterable[int] = range(STARTS)) -> Iterator[tuple[str, list[Encounter]]]:
    """All flights of each scene, on all cores."""
    with worker_pool(os.cpu_count() or 1) as pool:
        for name in scenes:
            yield name, list(pool.map(_flown, [(name, seed) for seed in seeds]))


def run() -> Iterable[Row]:
    """Separation, deadlocks, time to the goal."""
    for name, flights in campaign():
        worst = min(flights, key=lambda flight: min(flight.nearest_m, flight.clear_m))
        stuck = [flight.seed for flight in flights if flight.deadlock]
        nearest_m = min(worst.nearest_m, worst.clear_m)
        print(f"{name}: nearest {nearest_m:.3f} m with seed {worst.seed}; deadlocks: {stuck or 'none'}")
        if len(worst.arrived_s) > 1:
            nearer = [NEAREST_M - flight.nearest_m for flight in flights]
            yield Row.of("encounters", name, "ours", f"m nearer than {NEAREST_M:g} m", nearer)
        else:
            nearer = [NEAREST_M / 2.0 - flight.clear_m for flight in flights]
            yield Row.of("encounters", name, "ours", f"m nearer than {NEAREST_M / 2.0:g} m", nearer)
        yield Row.of("encounters", name, "ours", "m of slack", [flight.slack_m for flight in flights])
        yield Row.of("encounters", name, "ours", "s to the goal", [max(flight.arrived_s) for flight in flights])
        yield Row("encounters", name, "ours", "deadlocks", len(stuck), len(stuck), len(stuck), len(flights))

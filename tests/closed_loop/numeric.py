"""Numeric flights, flown in the process of the test."""

from functools import cache

from benchmarks import flights
from benchmarks.flights import SceneFlight
from shoal.config.experiment import load_experiment


@cache
def flown(name: str, *settings: str) -> SceneFlight:
    return flights.flown(load_experiment(name, settings))

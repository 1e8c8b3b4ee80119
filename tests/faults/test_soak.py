"""Flights in which anything may break at any time: nothing crashes, and no number is ever not finite."""

import subprocess
import sys
import time

import numpy as np
import pytest

from groundstation.analysis.alignment import align
from groundstation.analysis.measures import measures
from groundstation.analysis.metrics import evaluate
from groundstation.logs.reader import log_in_memory
from shoal.config.experiment import load_experiment
from shoal.messages import topics
from shoal.messages.messages import Event, is_finite
from sim_bridge.in_process.fleet import fly
from tests.faults.soak import Watch, random_faults
from tests.flights.scene_flights import prepared, rough_water

pytestmark = pytest.mark.real_time


def soak(name: str, seed: int, duration_s: float) -> None:
    random = np.random.default_rng(seed)
    settings = [
        f"seed={seed}",
        f"duration_s={duration_s}",
        *rough_water(random),
        f"sim.sensors.battery_v={random.uniform(11.0, 12.6):.1f}",
    ]
    robots = load_experiment(name).robot_ids
    experiment = load_experiment(name, settings, random_faults(random, robots, duration_s))
    fleet, water = prepared(experiment)
    fleet.start()
    log = log_in_memory(fly(fleet, water), {"mode": "numeric"})
    events = [entry.message.message for entry in log.of(topics.EVENT, Event)]
    assert sum(text.startswith("fault: ") for text in events) == 6
    assert np.isfinite(fleet.truth).all() and np.abs(np.array(fleet.truth)[..., :3]).max() < 50.0
    series = align(experiment, log)
    assert all(value is None or np.isfinite(value) for value in measures(series, log, evaluate(series, log)).values())
    for robot in fleet.robots:
        for state in robot.states:
            assert is_finite(state.estimate) and is_finite(state.control)
            assert all(500 <= pulse <= 2500 for pulse in state.pulse_us)


def test_a_short_flight_with_everything_breaking() -> None:
    soak("pool", 1, 12.0)


LEAK = """
import time
kept = []
while True:
    kept = [*kept, bytearray(500_000)] if {keeps} else [bytearray(500_000)]
    time.sleep(0.01)
"""


@pytest.mark.parametrize("keeps", [0, 1])
def test_a_process_that_grows_is_told_from_one_that_does_not(keeps: int) -> None:
    process = subprocess.Popen([sys.executable, "-c", LEAK.format(keeps=keeps)])
    watch = Watch()
    try:
        for _ in range(16):
            time.sleep(0.1)
            watch.look({"one": process.pid})
    finally:
        process.kill()
        process.wait()
    trends = {trend.what: trend for trend in watch.trends()}
    assert trends["memory MB"].steady is not bool(keeps)
    assert trends["threads"].steady and trends["threads"].last == 1.0

"""Time until a robot detects a broken thruster, and the rate of false alarms.

A sample is a numeric flight of `pool` in still water, in which a thruster breaks 8 to 20 s after the start; only the time
counts in which 0.1 N or more are lacking. Beside ours stands the distance from the path alone, with the limit that still water
allows. False alarms are of robots in rough water, with mass, drag and thrusters off by up to 30 %.
"""

from collections.abc import Iterator

import numpy as np

from benchmarks.harness import Row
from shoal.config.experiment import load_experiment
from tests.flights.broken_thrusters import THRUST_LEFT, WATCHED_S, lacking_s
from tests.flights.scene_flights import flew, rough_water

BENCHMARK = "thrusters"
BROKEN = (*THRUST_LEFT, "stuck")
FLIGHTS = 24
SUBJECTS = {"ours": (), "the path alone": ("safety.watch_thrusters=false",)}
LONG_FLIGHTS, LONG_S = 16, 120.0


def false_alarms(seed: int) -> list[float]:
    """For each robot of a long flight 1 if it thought that a thruster was broken."""
    random = np.random.default_rng(seed)
    model = (
        f"sim.plant.drag_error={random.uniform(-0.3, 0.3):.2f}",
        f"sim.plant.thruster_spread={random.uniform(0.0, 0.3):.2f}",
    )
    settings = [*rough_water(random), *model, f"seed={seed}", f"duration_s={LONG_S}"]
    fleet = flew(load_experiment(("pool", "figure-eight")[seed % 2], settings))
    return [float(any(s.fault.startswith("thrusters do not do as told") for s in robot.states)) for robot in fleet.robots]


def run() -> Iterator[Row]:
    """Each way to break, then none."""
    for how in BROKEN:
        for subject, settings in SUBJECTS.items():
            samples = [lacking_s(how, seed, settings) for seed in range(FLIGHTS)]
            yield Row.of(BENCHMARK, how, subject, f"s that 0.1 N lacked; {WATCHED_S:g}: not noticed", samples)
    alarms = [alarm for seed in range(LONG_FLIGHTS) for alarm in false_alarms(seed)]
    yield Row.of(BENCHMARK, f"rough water, {LONG_S:g} s", "ours", "robots with a false alarm: 1", alarms)

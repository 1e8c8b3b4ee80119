"""Time until a robot detects a broken thruster, and the rate of false alarms.

A sample is a numeric flight of `pool` in still water, in which a thruster breaks 8 to 20 s after the start; only the time
counts in which 0.1 N or more are lacking. Beside ours stands the distance from the path alone, with the limit that still water
allows. False alarms are of robots in rough water, with mass, drag and thrusters off by up to 30 %.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from benchmarks.flights import flew, rough_water
from benchmarks.harness import Row
from shoal.config.experiment import load_experiment
from shoal.messages.messages import Mode

BENCHMARK = "thrusters"
THRUST_LEFT = {"dead": 0.0, "reversed": -1.0, "weak 0.3": 0.3}  # of what a thruster is told
BROKEN = (*THRUST_LEFT, "stuck")
FLIGHTS = 24
STILL = ("safety.off_path_m=0.1", "sim.numeric.pose_noise_m=0.0005", "sim.numeric.yaw_noise_rad=0.003")
SUBJECTS = {"ours": (), "the path alone": ("safety.watch_thrusters=false",)}
WATCHED_S = 8.0
LACKING_N = 0.1  # the least that counts: two thirds of what a thruster idles with
LONG_FLIGHTS, LONG_S = 16, 120.0


def lacking_s(how: str, seed: int, settings: Sequence[str]) -> float:
    """Seconds for which a robot flew on though a thruster lacked force; WATCHED_S where it did not notice at all."""
    random = np.random.default_rng(seed)
    robot, number, at_s = int(random.integers(1, 3)), int(random.integers(1, 5)), float(random.uniform(8.0, 20.0))
    fault = f"t={at_s:.2f} thruster {robot}/{number} {how}"
    fleet = flew(load_experiment("pool", [*STILL, *settings, f"seed={seed}", f"duration_s={at_s + WATCHED_S}"], [fault]))
    states = [state for state in fleet.robots[robot - 1].states if state.trajectory_s > at_s]
    if states[-1].mode is not Mode.FAULT:
        return WATCHED_S
    pulses = np.array([state.pulse_us[number - 1] for state in states if state.mode is Mode.TRACKING], dtype=float)
    told_n = fleet.experiment.vehicle.thruster.force_n(pulses)
    given_n = told_n[0] if how == "stuck" else THRUST_LEFT[how] * told_n
    return fleet.experiment.controller.period_s * float((np.abs(told_n - given_n) > LACKING_N).sum())


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

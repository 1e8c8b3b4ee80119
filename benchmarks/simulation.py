"""Speed of the simulator: the plant alone, a frame, numeric flights, and all processes in lockstep.

Plant, frames and numeric flights are timed by this process's own processor time, so that other work on the machine does not
count; lockstep and real time need the whole machine, and count the wall clock.
"""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import Row
from shoal.config.experiment import Experiment, dump_experiment, load_experiment
from shoal.config.scene import RobotConfig
from shoal.frames import Array
from shoal.system import programs
from sim_bridge.camera.renderer import Renderer
from sim_bridge.in_process.fleet import fly
from sim_bridge.plant.fleet import Plant
from tests.flights.scene_flights import prepared

BENCHMARK = "simulation"
LOCKSTEP_S = 10.0  # starting all programs takes as long
SPEEDS = {  # targets, times real time
    "lockstep, pool, camera in the loop": "6",
    "lockstep, pool, camera in the loop, one process": "12",
    "lockstep, pool, camera in the loop, two seeds side by side, one process each": "20",
}
FLOWN_S = 12.0
FLIGHTS = 2


def crowd(robots: int, *settings: str) -> Experiment:
    """The pool experiment with any number of robots, one metre apart in water that is wide enough."""
    side = int(np.ceil(np.sqrt(robots)))
    experiment = load_experiment("pool", (f"pool.size_m=[{side + 2},{side + 2},3]", *settings))
    return experiment.model_copy(update={"robots": tuple(RobotConfig(id=1, node_m=(0.0, 0.0, 0.0)) for _ in range(robots))})


def places(robots: int) -> Array:
    """Poses (robots, 4) on a grid."""
    side = int(np.ceil(np.sqrt(robots)))
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    flat = np.stack([x.ravel(), y.ravel()], axis=1)[:robots] - (side - 1) / 2
    return np.column_stack([flat, np.full(robots, 1.0), np.linspace(0.0, 6.0, robots)])


def cpu_ms(call: Callable[[], object], n: int) -> list[float]:
    """Processor time of each of n calls, after one that is not counted."""
    call()
    samples = []
    for _ in range(n):
        begin_ns = time.process_time_ns()
        call()
        samples.append((time.process_time_ns() - begin_ns) * 1e-6)
    return samples


def plant_rows() -> Iterator[Row]:
    """One step of the plant, and how much faster than real time that is."""
    for robots in (1, 3, 20, 49):  # an experiment allows 49: there are no more markers
        for subject, settings in (("six axes", ()), ("four axes", ("sim.plant.tilt.enabled=false",))):
            experiment = crowd(robots, *settings)
            fleet = Plant(experiment, 1)
            state = fleet.start(places(robots))
            pulses = np.tile([1600.0, 1550.0, 1600.0, 1550.0, *[1500.0] * 4], (robots, 1))
            for _ in range(20):
                state = fleet.step(state, pulses)
            samples = cpu_ms(lambda fleet=fleet, state=state, pulses=pulses: fleet.step(state, pulses), 300)  # type: ignore[misc]
            yield Row.of(BENCHMARK, f"plant, {robots} robots", subject, "ms a step", samples)
            speed = [1000.0 * experiment.sim.plant.step_s / sample for sample in samples if sample > 0]
            yield Row.of(BENCHMARK, f"plant, {robots} robots", subject, "x real time", speed)
        together = cpu_ms(lambda fleet=fleet, state=state, pulses=pulses: fleet.step(state, pulses, steps=10), 100)  # type: ignore[misc]
        yield Row.of(
            BENCHMARK, f"plant, {robots} robots", "four axes, ten steps a call", "ms a step", [ms / 10 for ms in together]
        )


def frame_rows() -> Iterator[Row]:
    """A 1280x960 frame with all effects, and before it the pictures of moving water, each of which is drawn once."""
    experiment = load_experiment("pool")
    renderer = Renderer(experiment, 1)
    begin_ns = time.process_time_ns()
    renderer.backdrop.prepare()
    drawn_ms = (time.process_time_ns() - begin_ns) * 1e-6
    yield Row.of(BENCHMARK, "frame, 1280x960, all backgrounds, once", "ours", "ms", [drawn_ms])
    eta = np.array([[-0.4, 0.1, 0.3, 0.3], [0.4, -0.1, 0.3, 2.0]])
    nu = np.array([[0.3, 0.0, 0.0, 0.5], [0.2, 0.0, 0.0, -0.5]])
    frames = iter(range(10**9))

    def frame() -> None:
        index = next(frames)
        renderer.render(eta, nu, 0.05 * index, index)

    yield Row.of(BENCHMARK, "frame, 1280x960, 2 robots moving", "ours", "ms", cpu_ms(frame, 100), "1")


def flight_rows() -> Iterator[Row]:
    """Agents and plant in one process."""
    for name in ("numeric", "pool", "open-water"):
        speeds = []
        for seed in range(1, FLIGHTS + 1):
            experiment = load_experiment(name, [f"duration_s={FLOWN_S}", f"seed={seed}"])
            fleet, water = prepared(experiment)
            fleet.start()
            begin_s = time.process_time()
            for _ in fly(fleet, water):
                pass
            speeds.append(fleet.time_s / (time.process_time() - begin_s))
        yield Row.of(
            BENCHMARK, f"numeric flight, {name}, {len(experiment.robots)} robots", "ours", "x real time", speeds, "120"
        )


def first_of_fleet(robots: int) -> Experiment:
    """The first robots of fleet-20."""
    whole = load_experiment("fleet-20")
    kept = whole.robots[:robots]
    numbers = {robot.id for robot in kept}
    beside = [robot.model_copy(update={"neighbours": tuple(sorted(numbers & set(robot.neighbours)))}) for robot in kept]
    return whole.model_copy(update={"name": f"fleet-{robots}", "robots": tuple(beside)})


def flown(experiment: Experiment, options: tuple[str, ...], seeds: int = 1) -> list[dict[str, Any]]:
    """Results of runs of the whole system, of as many seeds side by side. Empty, with the reason on stderr, if one of them did
    not fly to its end."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "experiment.toml"
        file.write_text(dump_experiment(experiment), encoding="utf-8")
        words = ["sil", str(file), "--no-web", "--duration", str(LOCKSTEP_S), *options]
        outs = [Path(folder) / str(seed) for seed in range(1, seeds + 1)]
        started = [
            programs.start(
                "sim_bridge",
                [*words, "--seed", out.name, "--out", str(out)],
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
            )
            for out in outs
        ]
        outputs = [run.communicate()[0].decode() for run in started]
        results = [json.loads(path.read_text(encoding="utf-8")) for out in outs for path in out.glob("*/result.json")]
    whole = [result for result in results if result["duration_s"] >= 0.9 * LOCKSTEP_S]
    if len(whole) < seeds:
        print("not measured:", *outputs, file=sys.stderr)
        return []
    return whole


def process_rows() -> Iterator[Row]:
    """The whole system: in lockstep as fast as it goes, and fleets in real time."""
    pool, fleet = load_experiment("pool"), load_experiment("fleet-20")
    runs = (
        ("lockstep, pool, camera in the loop", pool, ("--lockstep",)),
        ("lockstep, pool, camera in the loop, one process", pool, ("--lockstep", "--one-process")),
        ("lockstep, pool, poses instead of frames", pool, ("--lockstep", "--poses")),
        ("lockstep, 5 of fleet-20, poses instead of frames", first_of_fleet(5), ("--lockstep", "--poses")),
        ("lockstep, fleet-20, poses instead of frames", fleet, ("--lockstep", "--poses")),
        ("real time, 5 of fleet-20, poses instead of frames", first_of_fleet(5), ("--real-time", "--poses")),
        ("real time, 10 of fleet-20, poses instead of frames", first_of_fleet(10), ("--real-time", "--poses")),
        ("real time, fleet-20, poses instead of frames", fleet, ("--real-time", "--poses")),
    )
    for case, experiment, options in runs:
        for result in flown(experiment, options):
            if "--lockstep" in options and result["real_time_factor"] is not None:
                yield Row.of(BENCHMARK, case, "ours", "x real time", [result["real_time_factor"]], SPEEDS.get(case, ""))
            elif result["missed_deadlines_fraction"] is not None:
                late = 100.0 * result["missed_deadlines_fraction"]
                yield Row.of(BENCHMARK, case, "ours", "% of control steps late", [late], "1")
    for case, options in (("processes", ("--lockstep",)), ("one process each", ("--lockstep", "--one-process"))):
        together = [result["real_time_factor"] for result in flown(pool, options, seeds=2)]
        if together and None not in together:
            subject = f"lockstep, pool, camera in the loop, two seeds side by side, {case}"
            yield Row.of(BENCHMARK, subject, "ours", "x real time, both", [sum(together)], SPEEDS.get(subject, ""))


def run() -> Iterator[Row]:
    """From the plant to the whole."""
    yield from plant_rows()
    yield from frame_rows()
    yield from flight_rows()
    yield from process_rows()

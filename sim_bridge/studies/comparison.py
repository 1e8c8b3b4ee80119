"""SHELL: `sim-bridge compare`: flies variants of an experiment on the same seeds, in parallel; the station reports."""

import multiprocessing
import os
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from sim_bridge.in_process.run import STATION, plan
from sim_bridge.studies.variants import VARIANTS, Task, fly, scattered
from wire.config.controller_benchmark import SETTLED_S, Comparison, Flight, Variant
from wire.config.experiment import NO_CAMERA, Experiment, load_experiment
from wire.process.output_files import replace_text
from wire.toml_loader import ConfigError


def run(
    name: str,
    settings: Sequence[str],
    variants: Sequence[str],
    seeds: Sequence[int],
    scatter: float,
    jobs: int,
    folder: Path,
    console: Console,
) -> int:
    """Fly, write comparison.json and comparison.html into `folder`, print the table. Returns the exit code."""
    plain = load_experiment(name, [*settings, NO_CAMERA])
    if plain.duration_s <= SETTLED_S:
        raise ConfigError(
            f"duration_s = {plain.duration_s:g}: must be more than {SETTLED_S:g} s, after which errors are compared"
        )
    experiments = _distinct({v: load_experiment(name, [*settings, *VARIANTS[v], NO_CAMERA]) for v in variants}, console)
    planned = tasks_of(plain, seeds, scatter)  # the same for all: variants differ in what flies it
    tasks = [replace(task, experiment=e) for e in experiments.values() for task in planned]
    with workers(jobs) as pool:
        flights = list(_watched(pool.map(fly, tasks), len(tasks), console))
    found = [Variant(v, list(VARIANTS[v]), flights[i * len(seeds) : (i + 1) * len(seeds)]) for i, v in enumerate(experiments)]
    comparison = Comparison(
        scene=plain.name,
        title=plain.title or plain.name,
        duration_s=plain.duration_s,
        scatter=scatter,
        settings=list(settings),
        surge_limit_n=plain.vehicle.limits.wrench[0],
        robots=list(plain.robot_ids),
        variants=found,
    )
    replace_text(folder / "comparison.json", comparison.to_json())
    return subprocess.run([*STATION, "benchmark", "report", str(folder)], check=False).returncode


def tasks_of(experiment: Experiment, seeds: Sequence[int], scatter: float) -> list[Task]:
    """The flights of one experiment, the first with traces. Raises ConfigError if it cannot be planned."""
    trajectories, starts = plan(experiment)
    places = np.array([starts[robot] for robot in experiment.robot_ids])
    apart_m = 2.0 * experiment.safety.radius_m
    return [Task(experiment, trajectories, scattered(places, scatter, s, apart_m), s, s == seeds[0]) for s in seeds]


def workers(jobs: int) -> ProcessPoolExecutor:
    """Processes that fly, of which results never depend: they start afresh, and on one thread each."""
    for library in ("OMP", "OPENBLAS"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    return ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn"))


def _watched(flights: Iterable[Flight], count: int, console: Console) -> Iterator[Flight]:
    """The same, with a progress bar."""
    columns = (TextColumn("flights"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        yield from progress.track(flights, total=count)


def _distinct(experiments: dict[str, Experiment], console: Console) -> dict[str, Experiment]:
    """Without those that are the same as one before: the numeric scenes know no sway anyway."""
    kept: dict[str, Experiment] = {}
    for name, experiment in experiments.items():
        twin = next((other for other, known in kept.items() if known.hash == experiment.hash), None)
        if twin is None:
            kept[name] = experiment
        else:
            console.print(f"{name} is the same as {twin} here: left out", soft_wrap=True)
    return kept

"""SHELL: `sim-bridge compare`: control laws and variants flown on the same seeds, in parallel; the station reports."""

import math
import tempfile
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import get_args

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from groundstation.analysis.comparison import (
    SETTLED_S,
    Comparison,
    FlightRecord,
    Variant,
    flight_figures,
    flight_traces,
    step_times,
)
from shoal.config.baseline_controllers import LawName
from shoal.config.experiment import NO_CAMERA, Experiment, load_experiment
from shoal.errors import ConfigError
from shoal.frames import Array
from shoal.messages.messages import Trajectory
from shoal.runtime.output import flush
from shoal.runtime.output_files import replace_text
from shoal.runtime.version import code
from shoal.system import programs
from sim_bridge.in_process.fleet import AgentFleet, DirectPlant
from sim_bridge.in_process.run import plan
from sim_bridge.plant.random_streams import Stream, generator
from sim_bridge.studies.worker_pool import worker_pool

MOST_DRAWS = 1000  # attempts to draw starts that keep robots apart

VARIANTS: dict[str, tuple[str, ...]] = {
    **{law: (f"controller.law={law}",) for law in get_args(LawName)},
    "backstepping-without-eso": ("controller.law=backstepping", "controller.estimator.enabled=false"),
    "article-without-eso": ("controller.law=eso-mpc-article", "controller.estimator.enabled=false"),
    "nmpc-without-sway": ("controller.estimator.sway=false",),
    "nmpc-without-disturbance": ("controller.estimator.enabled=false",),
    "nmpc-leader-follower": ("formation.kind=leader-follower",),
}


@dataclass(frozen=True, eq=False)
class FlightTask:
    experiment: Experiment
    trajectories: Mapping[int, Trajectory]
    starts: Array  # (n, 4)
    seed: int
    with_traces: bool  # keep traces


def scattered(starts: Array, scatter: float, seed: int, apart_m: float = 0.0) -> Array:
    """Starts (n, 4) moved by up to `scatter` m and rad in each coordinate; the same for every variant of a seed.

    Drawn again while two are nearer than `apart_m`, horizontally and in depth. Raises ConfigError after MOST_DRAWS
    attempts.
    """
    random = generator(seed, Stream.SCATTER)
    for _ in range(MOST_DRAWS):
        moved = starts + scatter * random.uniform(-1.0, 1.0, starts.shape)
        gaps = [moved[a] - moved[b] for a, b in combinations(range(len(moved)), 2)]
        if all(math.hypot(gap[0], gap[1]) >= apart_m or abs(gap[2]) >= apart_m for gap in gaps):
            return moved
    raise ConfigError(f"--scatter {scatter:g}: no starts of seed {seed} keep the robots {apart_m:g} m apart")


def fly(task: FlightTask) -> FlightRecord:
    """Fly one variant on one seed. Raises ConfigError if the robots cannot start there."""
    water = DirectPlant(task.experiment, task.seed, task.starts)
    fleet = AgentFleet(task.experiment, task.trajectories, water, task.seed, time.thread_time_ns)
    fleet.start()
    while fleet.time_s < task.experiment.duration_s - 1e-9:
        fleet.step()
    states, truth = [robot.states[fleet.begin :] for robot in fleet.robots], np.array(fleet.truth[fleet.begin :])
    error = fleet.errors()
    traces = flight_traces(task.experiment.controller.period_s, states, error) if task.with_traces else None
    figures = flight_figures(task.experiment, states, truth, error)
    return FlightRecord(task.seed, figures, traces, step_times(states))


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
    experiments = _distinct({v: load_experiment(name, [*settings, *changes_of(v), NO_CAMERA]) for v in variants}, console)
    planned = tasks_of(plain, seeds, scatter)  # the same for all: variants differ in what flies it
    tasks = [replace(task, experiment=e) for task in planned for e in experiments.values()]  # what is cut off has whole seeds
    with worker_pool(jobs) as pool:
        flights = _watched([pool.submit(fly, task) for task in tasks], console)
    whole = _whole_seeds(flights, len(experiments))
    results = [Variant(v, list(changes_of(v)), [seed[i] for seed in whole]) for i, v in enumerate(experiments)]
    comparison = Comparison(
        scene=plain.name,
        title=plain.title or plain.name,
        duration_s=plain.duration_s,
        scatter=scatter,
        settings=list(settings),
        surge_limit_n=plain.vehicle.limits.wrench[0],
        robots=list(plain.robot_ids),
        variants=results,
        separation_m=2.0 * plain.safety.radius_m,
        commit=code().commit,
    )
    _write_results(folder / "comparison.json", comparison.to_json())
    lost = next((flight for flight in flights if not isinstance(flight, FlightRecord)), None)
    if lost is not None:
        console.print(
            f"{len(whole)} of {len(seeds)} seeds were flown by all; of the others one ended so: {type(lost).__name__}: {lost}",
            style="red", highlight=False, soft_wrap=True,
        )  # fmt: skip
    flush()
    return programs.start("groundstation", ["benchmark", "report", str(folder)]).wait() or int(lost is not None)


def _write_results(path: Path, text: str) -> None:
    """Write what may be hours of flights: where the disk does not take it, into the system's folder for temporary files.
    Raises ConfigError that says where it is."""
    try:
        replace_text(path, text)
    except OSError as error:
        spare = Path(tempfile.mkdtemp(prefix="comparison-"))
        replace_text(spare / path.name, text)
        raise ConfigError(f"{path}: {error.strerror}; it is in {spare} (groundstation benchmark report {spare})") from None


def changes_of(variant: str) -> tuple[str, ...]:
    """The settings of a variant: one of VARIANTS, or a law of one's own, MODULE:NAME (docs/baselines.md)."""
    return VARIANTS.get(variant, (f"controller.law={variant}",))


def tasks_of(experiment: Experiment, seeds: Sequence[int], scatter: float) -> list[FlightTask]:
    """The flights of one experiment, the first with traces. Raises ConfigError if it cannot be planned."""
    trajectories, starts = plan(experiment)
    places = np.array([starts[robot] for robot in experiment.robot_ids])
    apart_m = 2.0 * experiment.safety.radius_m
    return [FlightTask(experiment, trajectories, scattered(places, scatter, s, apart_m), s, s == seeds[0]) for s in seeds]


def _watched(flights: Sequence[Future[FlightRecord]], console: Console) -> list[FlightRecord | BaseException]:
    """The flights in their order, or what ended them, with a progress bar. Ctrl-C ends those that have not begun."""
    columns = (TextColumn("flights"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        try:
            for flight in progress.track(flights):
                flight.exception()
        except KeyboardInterrupt:
            for flight in flights:
                flight.cancel()
        return [KeyboardInterrupt() if f.cancelled() else f.exception() or f.result() for f in flights]


def _whole_seeds(flights: Sequence[FlightRecord | BaseException], variants: int) -> list[list[FlightRecord]]:
    """The flights of each seed that all variants have flown. One that ends otherwise takes no others with it: they may be
    hours. Raises what ended the first one if no seed is whole."""
    by_seed = [flights[k : k + variants] for k in range(0, len(flights), variants)]
    whole = [[f for f in seed if isinstance(f, FlightRecord)] for seed in by_seed]
    whole = [seed for seed in whole if len(seed) == variants]
    if not whole:
        raise next(flight for flight in flights if isinstance(flight, BaseException))
    return whole


def _distinct(experiments: dict[str, Experiment], console: Console) -> dict[str, Experiment]:
    """The experiments without those that equal an earlier one, as a numeric scene without sway equals its variant."""
    kept: dict[str, Experiment] = {}
    for name, experiment in experiments.items():
        twin = next((other for other, other_experiment in kept.items() if other_experiment.hash == experiment.hash), None)
        if twin is None:
            kept[name] = experiment
        else:
            console.print(f"{name} is the same as {twin} here: left out", soft_wrap=True)
    return kept

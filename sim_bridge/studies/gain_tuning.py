"""SHELL: `sim-bridge tune`: search for a law's gains on simulated flights, with a fixed budget, the same search for all laws.

Every gain is searched on a logarithmic scale by CMA-ES (Hansen 2016, the package `cma`), from the first guess on. It needs no
gradients and tolerates the kinks that limits cause. The trials of a generation do not depend on one another and fly at once.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import tomli_w
from rich.console import Console

from groundstation.analysis.comparison import FlightMetrics
from shoal.config.baseline_controllers import FeedbackLawConfig
from shoal.config.experiment import NO_CAMERA, Experiment, load_experiment
from shoal.errors import ConfigError
from shoal.frames import Array
from sim_bridge.studies.comparison import FlightTask, fly, tasks_of
from sim_bridge.studies.worker_pool import worker_pool

NOISE = ("sim.numeric.pose_noise_m=0.0015", "sim.numeric.yaw_noise_rad=0.008")  # the localizer's, as measured
SCENES: dict[str, tuple[float, tuple[str, ...]]] = {  # scatter of the starts, settings
    "numeric-disturbed": (0.5, ()),
    "pool": (0.1, (*NOISE, "sim.plant.step_s=0.025")),
}
DURATION_S = 28.0
INTERRUPTED = "it was interrupted"


@dataclass(frozen=True)
class TuningResult:
    """The outcome for one law."""

    law: str
    first: float
    best: float
    section: dict[str, Any]  # of the experiment file
    trials: int
    cut_short: str = ""  # what ended the search before its budget was spent

    def toml(self) -> str:
        """The gains as a section of an experiment file."""
        return tomli_w.dumps({"controller": {self.law.replace("-", "_"): self.section}})


def run(
    laws: Sequence[str],
    scenes: Sequence[str],
    settings: Sequence[str],
    seeds: Sequence[int],
    budget: int,
    jobs: int,
    console: Console,
) -> Iterator[TuningResult]:
    """Tune one law after another. What ends a search, Ctrl-C too, takes no trial with it that was flown: they may be hours.
    Raises what ended one that had flown none."""
    unknown = [scene for scene in scenes if scene not in SCENES]
    if unknown:
        raise ConfigError(f"scene {unknown[0]!r}: nothing is known of its scatter (allowed: {', '.join(SCENES)})")
    tasks: list[FlightTask] = []
    for scene in scenes:
        scatter, own = SCENES[scene]
        tasks += tasks_of(load_experiment(scene, [f"duration_s={DURATION_S}", *own, *settings, NO_CAMERA]), seeds, scatter)
    for law in laws:
        with worker_pool(jobs) as pool:  # of its own: one whose process died flies no more
            tuned = _tune(law, tasks, budget, pool, console)
        yield tuned
        if tuned.cut_short == INTERRUPTED:
            return


def _tune(law: str, tasks: Sequence[FlightTask], budget: int, pool: ProcessPoolExecutor, console: Console) -> TuningResult:
    """Search the gains of one law within a budget of trials."""
    first: FeedbackLawConfig = getattr(tasks[0].experiment.controller, law.replace("-", "_"))

    def flown(generation: Sequence[Array]) -> list[float]:
        """The cost of each set of gains of a generation, flown in all tasks."""
        sections = [with_gains(first, gains) for gains in generation]
        changed = [replace(t, experiment=_under(t.experiment, law, s), with_traces=False) for s in sections for t in tasks]
        figures = [flight.figures for flight in pool.map(fly, changed)]  # of a set of gains one after the other
        return [cost(figures[k : k + len(tasks)]) for k in range(0, len(figures), len(tasks))]

    trials, cut_short = list[Trial](), ""
    try:
        for trial in search(np.array(values(first)), budget, seed=1, fly=flown):
            trials.append(trial)
            best = min(trials, key=lambda t: t.cost)
            if best is trial:
                console.print(f"{law}, trial {len(trials)} of {budget}: cost {trial.cost:.3f}", soft_wrap=True)
    except (Exception, KeyboardInterrupt) as error:
        pool.shutdown(wait=False, cancel_futures=True)
        if not trials:
            raise
        cut_short = INTERRUPTED if isinstance(error, KeyboardInterrupt) else f"{type(error).__name__}: {error}"
    return TuningResult(law, trials[0].cost, best.cost, with_gains(first, best.gains).model_dump(), len(trials), cut_short)


def values(section: FeedbackLawConfig) -> list[float]:
    return [gain for value in section.model_dump().values() for gain in (value if isinstance(value, tuple) else (value,))]


def with_gains(section: FeedbackLawConfig, gains: Array) -> FeedbackLawConfig:
    """The section with other gains, in the order of its fields; a field that is a tuple takes as many as it has."""
    rest = iter(gains.tolist())
    table = {
        name: tuple(next(rest) for _ in value) if isinstance(value, tuple) else next(rest)
        for name, value in section.model_dump().items()
    }
    return type(section).model_validate(table)


def _under(experiment: Experiment, law: str, section: FeedbackLawConfig) -> Experiment:
    controller = experiment.controller.model_copy(update={"law": law, law.replace("-", "_"): section})
    return experiment.model_copy(update={"controller": controller})


SPREAD = 0.4  # first standard deviation of a gain's logarithm: a factor of two
FLOOR_M = 0.001  # m added to errors, so that smaller ones do not count
WEAR = 2.0  # cost of the largest input change at all times: as much as both errors e times as large
FAILED = 10.0  # cost of robots that never get under way


@dataclass(frozen=True, eq=False)
class Trial:
    """One set of gains that was flown, with its cost."""

    gains: Array
    cost: float


def cost(flights: Sequence[FlightMetrics]) -> float:
    """Mean over flights of ln(error in the whole run, m and rad) + ln(distance after 20 s, m) + WEAR x change of inputs.

    By the logarithms scenes count alike whose errors differ by a factor of a hundred.
    """
    return sum(_cost(figures) for figures in flights) / len(flights)


def _cost(figures: FlightMetrics) -> float:
    whole, settled = math.hypot(figures.rms_m, figures.rms_yaw_rad), figures.rms_after_20s_m + FLOOR_M
    return math.log(whole) + math.log(settled) + WEAR * figures.input_step_rms + FAILED * (1.0 - figures.under_way)


def search(first: Array, budget: int, seed: int, fly: Callable[[Sequence[Array]], list[float]]) -> Iterator[Trial]:
    """`budget` trials; the first is the guess itself. `fly` returns the costs of a generation of gains."""
    import cma

    yield Trial(first, fly([first])[0])
    spent, random = 1, np.random.default_rng(seed)
    options = {"randn": lambda *shape: random.standard_normal(shape), "seed": math.nan, "verbose": -9}  # nan: seeds nothing
    evolution = cma.CMAEvolutionStrategy(np.zeros(len(first)), SPREAD, options)
    while spent < budget:
        points = evolution.ask()
        generation = [_rounded(first * np.exp(point)) for point in points[: budget - spent]]
        costs = fly(generation)
        spent += len(generation)
        yield from map(Trial, generation, costs)
        if len(costs) == len(points):
            evolution.tell(points, costs)


def _rounded(gains: Array) -> Array:
    """Gains as they will be written, to be flown as such."""
    return np.array([float(f"{gain:.3g}") for gain in gains])

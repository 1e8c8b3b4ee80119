"""SHELL: `sim-bridge tune`: searches the gains of a law on flights of its own (evolution_strategy.py says how), with a fixed
budget."""

from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import tomli_w
from rich.console import Console

from sim_bridge.studies.comparison import tasks_of, workers
from sim_bridge.studies.evolution_strategy import Trial, cost, search
from sim_bridge.studies.variants import Task, fly
from wire.config.baseline_controllers import FeedbackLawConfig
from wire.config.experiment import NO_CAMERA, Experiment, load_experiment
from wire.frames import Array
from wire.toml_loader import ConfigError

NOISE = ("sim.numeric.pose_noise_m=0.0015", "sim.numeric.yaw_noise_rad=0.008")  # what the localizer reaches
SCENES: dict[str, tuple[float, tuple[str, ...]]] = {  # scatter of the starts, settings
    "numeric-disturbed": (0.5, ()),
    "pool": (0.1, (*NOISE, "sim.plant.step_s=0.025")),
}
DURATION_S = 28.0


@dataclass(frozen=True)
class Tuned:
    """The outcome for one law."""

    law: str
    first: float
    best: float
    section: dict[str, Any]  # of the experiment file

    def toml(self) -> str:
        """As a section of an experiment file."""
        return tomli_w.dumps({"controller": {self.law.replace("-", "_"): self.section}})


def run(
    laws: Sequence[str],
    scenes: Sequence[str],
    settings: Sequence[str],
    seeds: Sequence[int],
    budget: int,
    jobs: int,
    console: Console,
) -> Iterator[Tuned]:
    """Tune one law after another."""
    unknown = [scene for scene in scenes if scene not in SCENES]
    if unknown:
        raise ConfigError(f"scene {unknown[0]!r}: nothing is known of its scatter (allowed: {', '.join(SCENES)})")
    tasks: list[Task] = []
    for scene in scenes:
        scatter, own = SCENES[scene]
        tasks += tasks_of(load_experiment(scene, [f"duration_s={DURATION_S}", *own, *settings, NO_CAMERA]), seeds, scatter)
    with workers(jobs) as pool:
        for law in laws:
            yield _tune(law, tasks, budget, pool, console)


def _tune(law: str, tasks: Sequence[Task], budget: int, pool: ProcessPoolExecutor, console: Console) -> Tuned:
    first: FeedbackLawConfig = getattr(tasks[0].experiment.controller, law.replace("-", "_"))

    def flown(gains: Array) -> float:
        section = with_gains(first, gains)
        changed = [replace(task, experiment=_under(task.experiment, law, section), look=False) for task in tasks]
        return cost([flight.figures for flight in pool.map(fly, changed)])

    trials: list[Trial] = []
    for trial in search(np.array(values(first)), budget, seed=1, fly=flown):
        best = min([*trials, trial], key=lambda t: t.cost)
        if best is trial:
            console.print(f"{law}, trial {len(trials) + 1} of {budget}: cost {trial.cost:.3f}", soft_wrap=True)
        trials.append(trial)
    return Tuned(law, trials[0].cost, best.cost, with_gains(first, best.gains).model_dump())


def values(section: FeedbackLawConfig) -> list[float]:
    """All gains in the order of the section."""
    return [gain for value in section.model_dump().values() for gain in (value if isinstance(value, tuple) else (value,))]


def with_gains(section: FeedbackLawConfig, gains: Array) -> FeedbackLawConfig:
    """The section with other gains."""
    rest = iter(gains.tolist())
    table = {
        name: tuple(next(rest) for _ in value) if isinstance(value, tuple) else next(rest)
        for name, value in section.model_dump().items()
    }
    return type(section).model_validate(table)


def _under(experiment: Experiment, law: str, section: FeedbackLawConfig) -> Experiment:
    controller = experiment.controller.model_copy(update={"law": law, law.replace("-", "_"): section})
    return experiment.model_copy(update={"controller": controller})

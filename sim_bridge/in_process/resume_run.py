"""SHELL: `sim-bridge sil --from RUN --at S`: goes on from a moment of a run, agents and plant in this process."""

import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from sim_bridge import fault_schedule
from sim_bridge.in_process.fleet import AgentFleet, BareWater
from sim_bridge.in_process.resume import Memory, branch, remember
from sim_bridge.in_process.run import STATION, fly_and_report
from wire.config.experiment import Experiment, dump_experiment, load_experiment
from wire.messages.pipe import read_pipe
from wire.process.cli_options import caution
from wire.process.runtime import Stop
from wire.toml_loader import ConfigError


def experiment_of(run: Path, settings: Sequence[str], more_faults: Sequence[str]) -> Experiment:
    """What was flown, with changes. Raises ConfigError."""
    experiment = load_experiment(str(run / "experiment.toml"), settings, more_faults)
    caution(experiment)
    fault_schedule.only(experiment, fault_schedule.NUMERIC, "from a logged moment on there is none")
    return experiment


def prepared(experiment: Experiment, source: Path, at_s: float) -> tuple[AgentFleet, BareWater]:
    """Robots as they were `at_s` along the trajectories of the run in `source`. Raises ConfigError, and leaves nothing behind,
    if the run does not tell."""
    memories = [_remembered(experiment, source, at_s, robot) for robot in experiment.robot_ids]
    return branch(experiment, memories, experiment.seed, time.perf_counter_ns)


def run(fleet: AgentFleet, water: BareWater, folder: Path, *, stop: Stop, console: Console) -> int:
    """Go on with what is `prepared`. Returns the exit code: 0 passed, 1 failed, 130 interrupted."""
    (folder / "experiment.toml").write_text(dump_experiment(fleet.experiment), encoding="utf-8")
    return fly_and_report(fleet, water, folder, stop=stop, console=console)


def _remembered(experiment: Experiment, source: Path, at_s: float, robot: int) -> Memory:
    command = [*STATION, "moment", str(source), "--at", str(at_s), "--robot", str(robot)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as telling:
        assert telling.stdout is not None and telling.stderr is not None
        lines = list(read_pipe(telling.stdout))
        said = telling.stderr.read().decode(errors="replace").strip()
    if telling.returncode != 0:
        raise ConfigError(said or f"groundstation moment ended with exit code {telling.returncode}")
    return remember(experiment, robot, lines)

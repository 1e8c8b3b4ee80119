"""SHELL: simulated flights from a script: flown to their end, or led by the script as its operator."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from shoal.fleet import ConnectedFleet, connect
from shoal.runs import FlownRun
from wire.config.experiment import NO_CAMERA, load_experiment
from wire.process.output_files import new_run_folder
from wire.process.runtime import Failed, Stop
from wire.toml_loader import toml_value

STATION = "station: "  # begins the line in which `sim-bridge sil` tells the endpoint of its station
START_WITHIN_S = 300.0  # on a busy machine whose kernels were never compiled; otherwise a few seconds
END_WITHIN_S = 300.0  # of a run's processes, its report written


def simulate(
    experiment: str,
    settings: Mapping[str, Any] | None = None,
    *,
    seed: int | None = None,
    duration_s: float | None = None,
    faults: Sequence[str] = (),
    camera: bool = False,
    out: str | Path = "runs",
) -> FlownRun:
    """Fly an experiment in this process, as fast as it goes, and write log and report.

    Without `camera` as `sim-bridge numeric` flies, with it as `sim-bridge sil --lockstep --one-process`; its bits are the same
    under OMP_NUM_THREADS=1. `settings` are keys of the experiment: {"controller.mpc.horizon": 60}. Raises ConfigError for an
    experiment that cannot be flown."""
    from rich.console import Console  # the simulator's packages: a station's laptop has none of them

    from sim_bridge.in_process import run
    from sim_bridge.sil.commands import RunOptions, check

    lines = _lines(settings, seed, duration_s)
    loaded = load_experiment(experiment, lines if camera else [*lines, NO_CAMERA], faults)
    quiet, stop = Console(quiet=True), Stop(install=False)
    if camera:
        from sim_bridge.in_process import executor

        options = RunOptions(lockstep=True, one_process=True)
        check(loaded, options)
        folder = new_run_folder(Path(out), loaded.name)
        executor.run(loaded, folder, options, stop, quiet)
    else:
        fleet, water = run.prepared(loaded)
        folder = new_run_folder(Path(out), loaded.name)
        run.run(fleet, water, folder, stop=stop, console=quiet)
    return FlownRun(folder)


@contextmanager
def simulation(
    experiment: str,
    settings: Mapping[str, Any] | None = None,
    *,
    seed: int | None = None,
    duration_s: float | None = None,
    camera: bool = False,
    lockstep: bool = False,
    out: str | Path = "runs",
) -> Iterator[ConnectedFleet]:
    """All processes of an experiment on this machine, as `sim-bridge sil --manual` starts them, and the connection to their
    station once its preflight has passed. When the block ends, they are ended. The run's folder in `out` has its report.

    `lockstep` flies as fast as the machine can, or slower than time where it cannot."""
    command = [sys.executable, "-m", "sim_bridge", "sil", experiment, "--manual", "--no-web", "--out", str(out)]
    command += [*(["--lockstep"] if lockstep else []), *([] if camera else ["--poses"])]
    for line in _lines(settings, seed, duration_s):
        command += ["--set", line]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    child = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment, start_new_session=True
    )
    assert child.stdout is not None
    said, ended = list[str](), False
    try:
        for line in child.stdout:
            said.append(line)
            if line.startswith(STATION):
                break
        else:
            raise Failed("".join(said).strip() or f"sim-bridge sil ended with exit code {child.wait()}")
        threading.Thread(target=said.extend, args=(child.stdout,), name="sil-output", daemon=True).start()
        with connect(said[-1].removeprefix(STATION).split()[0], patience_s=START_WITHIN_S) as fleet:
            fleet.wait_ready(START_WITHIN_S)
            yield fleet
            ended = fleet.ended
    finally:
        if not ended and child.poll() is None:
            child.send_signal(signal.SIGINT)
        try:
            child.wait(END_WITHIN_S)
        except subprocess.TimeoutExpired:
            os.killpg(child.pid, signal.SIGKILL)  # and its children, which would keep ports and files


def _lines(settings: Mapping[str, Any] | None, seed: int | None, duration_s: float | None) -> list[str]:
    """The settings as `--set` takes them."""
    named = {"seed": seed, "duration_s": duration_s}
    lines = [f"{key}={toml_value(value)}" for key, value in (settings or {}).items()]
    return lines + [f"{key}={value}" for key, value in named.items() if value is not None]

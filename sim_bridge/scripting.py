"""SHELL: simulated flights from a script: flown to their end, or led by the script as its operator."""

import io
import re
import shutil
import signal
import subprocess
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from groundstation import client
from groundstation.scripting.fleet import ConnectedFleet, NotHeard
from groundstation.scripting.runs import FlownRun
from shoal.config.experiment import NO_CAMERA, load_experiment
from shoal.config.loader import toml_value
from shoal.errors import ConfigError, Unreached
from shoal.runtime.output_files import new_run_folder
from shoal.runtime.runtime import Failed, Stop
from shoal.system import programs

STATION = "station: "  # begins the line in which `sim-bridge sil` tells the endpoint of its station
PROGRESS = re.compile(r" *[-\d.]+ / [\d.]+ s  ")  # begins the lines in which it tells how far the flight has come
START_WITHIN_S = 300.0  # on a busy machine whose kernels were never compiled; otherwise a few seconds
END_WITHIN_S = 300.0  # of a run's processes, its report written
LAST_WORDS_S = 5.0  # for the output of a process that has ended to be read


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
    under OMP_NUM_THREADS=1. `settings` are keys of the experiment: {"controller.nmpc.arm_m": 0.1}. Raises ConfigError for an
    experiment that cannot be flown, Failed if a part of the run has ended."""
    from rich.console import Console  # the simulator's packages: a station's laptop has none of them

    from sim_bridge.in_process import run
    from sim_bridge.sil.commands import RunOptions, check

    lines = _lines(settings, seed, duration_s)
    loaded = load_experiment(experiment, lines if camera else [*lines, NO_CAMERA], faults)
    quiet, stop = Console(quiet=True, markup=False), Stop(install=False)
    if camera:
        from sim_bridge.in_process import executor
        from sim_bridge.sil import launcher

        options = RunOptions(lockstep=True, one_process=True)
        check(loaded, options)
        folder = new_run_folder(Path(out), loaded.name)
        launcher.write_experiment(loaded, folder)
        try:
            succeeded = executor.fly(loaded, folder, options, stop, quiet)
        except ConfigError:
            if not (folder / "run.mcap").exists():
                shutil.rmtree(folder)  # nothing was flown
            raise
        launcher.conclude(folder, True, succeeded, stop, quiet)
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
    real_time: bool = False,
    out: str | Path = "runs",
) -> Iterator[ConnectedFleet]:
    """All processes of an experiment on this machine, as `sim-bridge sil --manual` starts them, and the connection to their
    station once its preflight has passed. When the block ends, they are ended. The run's folder in `out` has its report.

    Time goes as in `sim-bridge sil`: in real time, and slower while the machine is busy; `lockstep` is as fast as it can,
    `real_time` by the wall clock. Raises Failed with the reason where the run is refused or ends before it is ready,
    NotHeard with the preflight's findings where it does not get ready."""
    options = {"--lockstep": lockstep, "--real-time": real_time, "--poses": not camera}
    words = ["sil", experiment, "--manual", "--no-web", "--out", str(out)]
    words += [option for option, given in options.items() if given]
    for line in _lines(settings, seed, duration_s):
        words += ["--set", line]
    child = programs.start(
        "sim_bridge", words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, more={"PYTHONUNBUFFERED": "1"}
    )
    assert child.stdout is not None
    output_lines, ended = list[str](), False
    try:
        lines = io.TextIOWrapper(child.stdout, "utf-8", errors="replace")
        for line in lines:
            output_lines.append(line)
            if line.startswith(STATION):
                break
        else:
            raise Failed("".join(output_lines).strip() or f"sim-bridge sil ended with exit code {child.wait()}")
        output = threading.Thread(target=output_lines.extend, args=(lines,), name="sil-output", daemon=True)
        output.start()

        def gone() -> str:
            return "" if child.poll() is None else f"the simulation has ended: {_last_words(output_lines, output)}"

        address = output_lines[-1].removeprefix(STATION).split()[0]
        with ExitStack() as closing:
            try:
                bus = client.connect(address, patience_s=START_WITHIN_S, stopped=lambda: child.poll() is not None)
                fleet = closing.enter_context(ConnectedFleet(bus, gone))
                fleet.wait_ready(START_WITHIN_S)
            except (Unreached, NotHeard):
                if child.poll() is None:
                    raise
                raise Failed(_last_words(output_lines, output)) from None
            yield fleet
            ended = fleet.ended
    finally:
        if not ended and child.poll() is None:
            child.send_signal(signal.SIGTERM)  # SIGINT would be a person
        try:
            child.wait(END_WITHIN_S)
        except subprocess.TimeoutExpired:
            child.kill()  # its own children end with it


def _last_words(lines: Sequence[str], output: threading.Thread) -> str:
    """Output of `sim-bridge sil`, which has ended, after its station's endpoint."""
    output.join(LAST_WORDS_S)
    begin = next(k for k, line in enumerate(lines) if line.startswith(STATION))
    return "".join(line for line in lines[begin + 1 :] if not PROGRESS.match(line)).strip() or "it said nothing"


def _lines(settings: Mapping[str, Any] | None, seed: int | None, duration_s: float | None) -> list[str]:
    """The settings as `--set` takes them."""
    named = {"seed": seed, "duration_s": duration_s}
    lines = [f"{key}={toml_value(value)}" for key, value in (settings or {}).items()]
    return lines + [f"{key}={value}" for key, value in named.items() if value is not None]

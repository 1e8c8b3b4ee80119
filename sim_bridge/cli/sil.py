"""SHELL: `sim-bridge sil`, `numeric` and `campaign`: whole experiments, flown on this machine."""

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from shoal.errors import ConfigError
from shoal.runtime.cli_options import (
    Duration,
    ExperimentName,
    FaultLines,
    KeyRing,
    Seed,
    Settings,
    as_run,
    caution,
    experiments,
    finite,
)
from shoal.runtime.output import background, terminal
from shoal.runtime.output_files import new_run_folder
from shoal.runtime.runtime import Stop
from shoal.system import programs
from sim_bridge.cli.pool import Pace, Poses

if TYPE_CHECKING:
    from rich.console import Console

    from shoal.config.experiment import Experiment
    from sim_bridge.sil.commands import RunOptions

OutFolder = Annotated[Path, typer.Option(help="Folder for the run's own folder.")]


def sil(
    context: typer.Context,
    experiment: Annotated[
        str | None,
        typer.Argument(
            metavar="EXPERIMENT",
            help="A shipped experiment, e.g. `pool`, or a path ending in .toml.",
            autocompletion=experiments,
        ),
    ] = None,
    lockstep: Annotated[bool, typer.Option("--lockstep", help="As fast as the machine can, with the same bits.")] = False,
    real_time: Annotated[
        bool, typer.Option("--real-time", help="By the wall clock, as in a pool: measures latency, and needs a fast machine.")
    ] = False,
    one_process: Annotated[
        bool, typer.Option("--one-process", help="The same bits from one process, without a network.")
    ] = False,
    pace: Pace = None,
    seed: Seed = None,
    duration: Duration = None,
    out: OutFolder = Path("runs"),
    settings: Settings = None,
    faults: FaultLines = None,
    poses: Poses = False,
    manual: Annotated[
        bool, typer.Option("--manual", help="Wait for the operator: arm, start and end it on the page.")
    ] = False,
    web: Annotated[
        str, typer.Option(metavar="HOST:PORT", help="Where the operator's page is; another port if that one is taken.")
    ] = "127.0.0.1:8000",
    no_web: Annotated[bool, typer.Option("--no-web", help="Serve no page.")] = False,
    keys: KeyRing = None,
    signed: Annotated[bool, typer.Option("--signed", help="Sign the links to the thruster boards, with new keys.")] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only say what would be flown and started, or why it cannot be.")
    ] = False,
    source: Annotated[
        Path | None,
        typer.Option(
            "--from", metavar="RUN", help="Go on from a moment of this run, instead of an EXPERIMENT.", callback=as_run
        ),
    ] = None,
    at: Annotated[
        float | None,
        typer.Option(min=0.0, help="With --from: the moment, in seconds along the trajectories. Default: 0.", callback=finite),
    ] = None,
    flight: Annotated[
        int | None, typer.Option(min=1, help="With --from: of several flights in the run, which. Default: the last.")
    ] = None,
) -> None:
    """Fly an experiment with all its processes on this machine, the pool simulated; write log and report.

    It goes in real time, and slower where the machine is busy: the same seed gives the same bits either way. With --real-time
    the programs live by the wall clock, as they do in a pool, and a machine that is too slow is late.

    Exit code 0 if the mission succeeded and every limit of the experiment held, 1 if not.

    With --from, agents and plant go on in this process, as in `numeric`: each agent is first led through what its robot had
    been through, so it remembers; the robots are put where they were, moving as they did.

    Examples:  sim-bridge sil pool          sim-bridge sil pool --lockstep --one-process
               sim-bridge sil pool --lockstep --seed 3 --set 'sim.plant.current_mps=[0.014,0,0]'
               sim-bridge sil pool --fault "t=20 thruster 2/3 dead" --fault "t=40 for=3 camera frozen"
               sim-bridge sil pool --set path.lap_s=30 --dry-run
               sim-bridge sil --from runs/pool-20260101-120000 --at 35 --set controller.nmpc.turning_m=0.1
    """
    if source is not None and dry_run:
        raise typer.BadParameter("--dry-run is for an EXPERIMENT, not for --from")
    if source is not None:
        _fly_from_run(experiment, source, at or 0.0, flight, _changes(seed, duration, settings), faults, out)
    if at is not None or flight is not None:
        raise typer.BadParameter("--at and --flight name a moment of a run: with --from only")
    if experiment is None:
        raise typer.BadParameter("name an EXPERIMENT, or a run with --from")
    from shoal.config.experiment import NO_CAMERA
    from shoal.kernels.build import ensure_compiled
    from sim_bridge.sil import launcher as software_in_the_loop
    from sim_bridge.sil.commands import RunOptions, check, pace_of
    from sim_bridge.sil.ports import page_address

    source_of_keys = context.get_parameter_source("keys")
    if one_process and source_of_keys is not None and source_of_keys.name == "ENVIRONMENT":
        keys = None  # for this person's other programs: here is no link that could be listened to
        del os.environ["SHOAL_KEYS"]
    if one_process and not dry_run:
        _with_one_thread()
    loaded = _load(experiment, seed, duration, [*(settings or ()), *([NO_CAMERA] if poses else [])], faults)
    console = terminal(background(sys.stdout))
    page = None if no_web else page_address(web)
    if not (poses or loaded.localizer.uses_camera):
        poses = True
        console.print("no camera (localizer.uses_camera = false): the simulator gives the poses", soft_wrap=True)
    pace = pace_of(lockstep, real_time, one_process, pace)
    options = RunOptions(not real_time, page, manual, poses, keys, signed, one_process, pace)
    if dry_run:
        check(loaded, options)
        raise typer.Exit(software_in_the_loop.dry_run(loaded, out / f"{loaded.name}-TIME", options, console))
    ensure_compiled()
    raise typer.Exit(_fly_on(loaded, out, options, console))


def _fly_on(experiment: "Experiment", out: Path, options: "RunOptions", console: "Console") -> int:
    """Fly an experiment, and then what a person chooses on the page. Returns the exit code of the last run that was flown."""
    from sim_bridge.sil.after_run import EndedRun, next_experiment
    from sim_bridge.sil.commands import check

    run: EndedRun | None = None
    while True:
        problem, stop = "", Stop()
        try:
            check(experiment, options)
            folder, code = _fly(experiment, out, options, stop, console)
        except ConfigError as error:
            if run is None:
                raise
            problem = str(error)
        else:
            if folder.exists():
                run = EndedRun(experiment, folder, code)
            elif run is None:
                return code
            else:
                problem = "the station refused to fly this: the terminal says why"
        chosen = next_experiment(run, options, problem, stop, console)
        if chosen is None:
            return run.code
        experiment = chosen


def _fly(experiment: "Experiment", out: Path, options: "RunOptions", stop: Stop, console: "Console") -> tuple[Path, int]:
    """Fly an experiment once. Returns its folder, which is gone if nothing was flown, and the exit code."""
    from sim_bridge.sil.commands import time_in_words

    folder, how = new_run_folder(out, experiment.name), time_in_words(options)
    console.print(
        f"{experiment.title or experiment.name}: {experiment.duration_s:g} s {how}; seed {experiment.seed}, into {folder}",
        soft_wrap=True,
    )
    if options.one_process:
        from sim_bridge.in_process import executor

        return folder, executor.run(experiment, folder, options, stop, console)
    from sim_bridge.sil import launcher

    return folder, launcher.run(experiment, folder, options, stop, console)


def numeric(
    experiment: ExperimentName,
    seed: Seed = None,
    duration: Duration = None,
    out: OutFolder = Path("runs"),
    settings: Settings = None,
    faults: FaultLines = None,
) -> None:
    """Fly an experiment with agents and plant in one process, as fast as it goes; write log and report.

    No camera, no network, no thruster boards: poses are the plant's (sim.numeric: noise, sim.latency_s: age), pulses act on
    the thrusters. Exit code 0 if every limit of the experiment held, 1 if not.

    Examples:  sim-bridge numeric numeric      sim-bridge numeric numeric-disturbed --set controller.estimator.enabled=false
    """
    from shoal.config.experiment import NO_CAMERA
    from sim_bridge.in_process import run

    loaded = _load(experiment, seed, duration, [*(settings or ()), NO_CAMERA], faults)
    console = terminal(background(sys.stdout))
    fleet, water = run.prepared(loaded)
    folder = new_run_folder(out, loaded.name)
    console.print(f"{loaded.title or loaded.name}: {loaded.duration_s:g} s, seed {loaded.seed}, into {folder}", soft_wrap=True)
    raise typer.Exit(run.run(fleet, water, folder, stop=Stop(), console=console))


def campaign(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The campaign, a TOML file (docs/simulator.md).")],
    camera: Annotated[bool, typer.Option("--camera", help="Fly with the camera in the loop, as camera = true.")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of the campaign; default: runs/campaign-NAME.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with what an earlier run left.")] = False,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; default: one for each core.")] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Fly on this Dask cluster, e.g. tcp://192.0.2.10:8786.")
    ] = None,
) -> None:
    """Fly an experiment many times, keys swept or drawn, on all cores or on a cluster; write Parquet and a report.

    Flights are numeric, or with --camera as `sil --lockstep --one-process` flies them.

    Exit code 0 if every flight was flown, well or badly; 1 if one was refused or failed.

    Examples:  sim-bridge campaign errors.toml       sim-bridge campaign errors.toml --resume --scheduler tcp://192.0.2.10:8786
    """
    from shoal.config.loader import check, read_toml
    from sim_bridge.studies import campaign_runner
    from sim_bridge.studies.campaign import Campaign

    loaded = check(Campaign, {**read_toml(file), **({"camera": True} if camera else {})}, str(file))
    folder = out or Path("runs") / f"campaign-{loaded.name}"
    raise typer.Exit(
        campaign_runner.run(
            loaded,
            folder,
            workers=workers,
            scheduler=scheduler,
            resume=resume,
            stop=Stop(),
            console=terminal(background(sys.stdout)),
        )
    )


def _with_one_thread() -> None:
    """Begin this program again where its numerical libraries have more threads than those of `sil`'s processes: they read
    their number when they are loaded, and the last bit of a result may depend on it."""
    from sim_bridge.sil.processes import ONE_THREAD

    if not ONE_THREAD.items() <= os.environ.items():
        os.execve(sys.executable, programs.command("sim_bridge", sys.argv[1:]), programs.environment(ONE_THREAD))


def _load(
    name: str, seed: int | None, duration_s: float | None, settings: list[str] | None, faults: list[str] | None
) -> "Experiment":
    from shoal.config.experiment import load_experiment

    return _cautioned(load_experiment(name, _changes(seed, duration_s, settings), faults or ()))


def _cautioned(experiment: "Experiment") -> "Experiment":
    """Print the warnings that the experiment deserves, and return it."""
    from sim_bridge.fault_schedule import faults_after_the_end

    caution(*faults_after_the_end(experiment))
    return experiment


def _changes(seed: int | None, duration_s: float | None, settings: list[str] | None) -> list[str]:
    changes = list(settings or ())
    changes += [f"seed={seed}"] if seed is not None else []
    changes += [f"duration_s={duration_s}"] if duration_s is not None else []
    return changes


def _fly_from_run(
    experiment: str | None,
    source: Path,
    at_s: float,
    flight: int | None,
    changes: list[str],
    faults: list[str] | None,
    out: Path,
) -> NoReturn:
    from sim_bridge.in_process import resume, run

    if experiment is not None:
        raise typer.BadParameter(f"{experiment!r}: with --from, the run says what is flown (change it with --set)")
    moment = resume.find_moment(source, at_s, flight)
    loaded, left_out = resume.load_changed(source, moment, changes, faults or ())
    caution(*left_out)
    _cautioned(loaded)
    fleet, water = resume.prepared(loaded, source, moment)
    folder, console = new_run_folder(out, f"{loaded.name}-from-{at_s:g}"), terminal(background(sys.stdout))
    console.print(f"{loaded.title or loaded.name}: from {at_s:g} s of {source} on, into {folder}", soft_wrap=True)
    raise typer.Exit(run.run(fleet, water, folder, stop=Stop(), console=console))

"""SHELL: `groundstation run`, and `plan`: what it would fly."""

import json
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from groundstation.cli.foxglove import Foxglove, address
from groundstation.cli.replay import show
from shoal.errors import ConfigError, os_errors_as_config_errors
from shoal.runtime.cli_options import (
    DEFAULT_FLEET,
    DEFAULT_STATION,
    DEFAULT_WEB,
    ExperimentName,
    ExternalRouter,
    FleetName,
    Insecure,
    KeyRing,
    ListenAddress,
    Settings,
    Verbose,
    WebAddress,
    finite,
)
from shoal.runtime.optional_packages import require
from shoal.runtime.output_files import page_was_open, run_folder
from shoal.runtime.runtime import Stop, run_steps, start_log
from shoal.system.printable import printable
from shoal.system.secret_files import refuse_shared

if TYPE_CHECKING:  # the page's server takes a second to import
    from shoal.config.experiment import Experiment
    from shoal.runtime.web_access import WebOptions

LONGEST_TOKEN = 10_000  # bytes
NoWeb = Annotated[bool, typer.Option("--no-web", help="Serve no page.")]


def run(
    experiment: ExperimentName,
    out: Annotated[Path, typer.Option(help="Folder for the run's own folder.")] = Path("runs"),
    run_dir: Annotated[Path | None, typer.Option(help="Use exactly this folder, without a log so far.")] = None,
    no_report: Annotated[
        bool, typer.Option("--no-report", help="Leave the report to `groundstation log report`, as a launcher does.")
    ] = False,
    auto: Annotated[bool, typer.Option("--auto", help="Load, arm, start and finish without being asked.")] = False,
    give_up: Annotated[
        float | None,
        typer.Option(
            min=1.0,
            metavar="SECONDS",
            help="With --auto: fail after so long without progress. Default: wait for ever.",
            callback=finite,
        ),
    ] = None,
    listen: ListenAddress = DEFAULT_STATION,
    external_router: ExternalRouter = False,
    settings: Settings = None,
    fleet: FleetName = DEFAULT_FLEET,
    keys: KeyRing = None,
    insecure: Insecure = False,
    verbose: Verbose = False,
    web: WebAddress = DEFAULT_WEB,
    no_web: NoWeb = False,
    web_certificate: Annotated[
        Path | None, typer.Option(exists=True, dir_okay=False, help="TLS certificate (PEM) of the page.")
    ] = None,
    web_key: Annotated[Path | None, typer.Option(exists=True, dir_okay=False, help="Its private key (PEM).")] = None,
    web_token_file: Annotated[Path | None, typer.Option(help="File with the token that a page must know.")] = None,
    foxglove: Foxglove = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would be flown, or why it cannot be.")] = False,
) -> None:
    """Fly an experiment: be the fleet's router, wait for the robots, run the mission, record, write the report.

    Without --auto the station waits for orders: from the operator's page, or from another terminal
    (`groundstation mission start`), until a person ends the run (`groundstation end`, or Ctrl-C). A page that is open at the
    end shows the recorded run, and can have it flown again, until it is closed.
    Exit code 0 if the mission succeeded and every limit of the experiment held, 1 if not.

    Examples:  groundstation run pool --listen tls/0.0.0.0:7447 --keys keys
               groundstation run pool --auto --dry-run
    """
    from shoal.config.experiment import load_experiment

    loaded = load_experiment(experiment, settings or ())  # before what takes a second to import: a bad one is told at once

    from groundstation.gate.gate import Gate
    from groundstation.station import process
    from groundstation.station.discovery import announced
    from shoal.bus.bus import Bus
    from shoal.bus.network import endpoint
    from shoal.bus.zenoh_transport import ZenohTransport
    from shoal.messages.topics import Role, process_name
    from shoal.runtime.web_access import web_options

    require("matplotlib", "jinja2")  # of the report
    token = _token(web_token_file) if web_token_file is not None else ""
    page = None if no_web else web_options(web, web_certificate, web_key, token)
    viewer = address(foxglove) if foxglove is not None else None
    start_log("groundstation", verbose)
    me = process_name(Role.STATION)
    where = endpoint(listen, me, keys, insecure=insecure, router=not external_router, fleet=fleet)
    if dry_run:
        typer.echo(_intent(loaded, run_dir or out))
        return

    def fly(folder: Path, stop: Stop) -> bool:
        """Fly once. Returns whether the mission succeeded."""
        if (folder / "run.mcap").exists():
            raise ConfigError(f"{folder / 'run.mcap'}: is there already, and would be lost (allowed: a folder without a log)")
        with Bus(ZenohTransport(where, stop, gate=Gate), fleet) as bus, announced(where, fleet, loaded.name, bus):
            bus.claim(me, stop)
            options = process.StationOptions(auto, give_up, page, viewer, where.insecure)
            return run_steps(process.cycles(loaded, bus, folder, options, stop))

    again = True
    while again:
        stop = Stop()
        with nullcontext(run_dir) if run_dir is not None else run_folder(out, loaded.name) as folder:
            succeeded = fly(folder, stop)
        if no_report:
            raise typer.Exit(0 if succeeded else 1)
        from groundstation.report.report import write_report

        result = write_report(folder)
        typer.echo(f"report: {folder / 'report.html'} ({result.verdict})")
        for note in result.notes if result.passed and not succeeded else ():
            typer.echo(printable(note))
        offers = ("again", "close") if run_dir is None else ("close",)  # a folder that was named holds one run
        again = page is not None and page_was_open(folder) and not stop.terminated and _flies_again(folder, page, offers)
    raise typer.Exit(0 if succeeded and result.passed else 1)


def _flies_again(folder: Path, page: "WebOptions", offers: tuple[str, ...]) -> bool:
    """Show the recorded run to the page that is open, until it is closed. Returns True if it is to be flown again: the same
    experiment, because the robots have no other."""
    typer.echo("the page shows the recorded run: Close there, close the page, or press Ctrl-C")
    choice = show(folder, page, Stop(), until_closed=True, offers=offers)
    return choice is not None and choice.what == "again"


def _token(file: Path) -> str:
    """The page's token from its file, which nobody else may read. Raises ConfigError."""
    with os_errors_as_config_errors(file):
        try:
            with file.open("rb") as opened:  # also a pipe that a shell makes of a command's output
                token = opened.read(LONGEST_TOKEN).decode().strip()
        except UnicodeDecodeError:
            raise ConfigError(f"--web-token-file {file}: not a text") from None
    if not token:
        raise ConfigError(f"--web-token-file {file}: is empty: an empty token protects nothing")
    refuse_shared(file, "the page's token")
    return token


def _intent(experiment: "Experiment", folder: Path) -> str:
    """Summary of the run that would be flown. Raises ConfigError for one that cannot."""
    from groundstation.logs.recorder import check_room
    from groundstation.planning import planner

    description = planner.description(experiment)
    check_room(folder, experiment.recording.min_free_gb)
    flown = f"{experiment.title or experiment.name}: {experiment.duration_s:g} s"
    return "\n".join([f"{flown}, experiment {experiment.hash[:8]}, into {folder}", *description])


def plan(experiment: ExperimentName, settings: Settings = None) -> None:
    """Plan an experiment's trajectories without flying: prints them as JSON, or says why they cannot be flown.

    Example:  groundstation plan islands > plan.json
    """
    from groundstation.planning import planner
    from shoal.config.experiment import load_experiment

    loaded = load_experiment(experiment, settings or ())
    trajectories = planner.plan(loaded)
    starts = planner.start_poses(loaded, trajectories)
    robots = {
        robot: {
            "id": t.id,
            "start": starts[robot].tolist(),
            "period_s": t.period_s,
            "eta": t.eta.tolist(),
            "velocity": t.velocity.tolist(),
            "acceleration": t.acceleration.tolist(),
        }
        for robot, t in trajectories.items()
    }
    typer.echo(json.dumps({"experiment": loaded.name, "hash": loaded.hash, "robots": robots}))

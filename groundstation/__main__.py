"""SHELL: `groundstation`: plan, fly, record, report."""

import json
import sys
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from groundstation.deploy_commands import deploy
from groundstation.keys_commands import keys_cli
from groundstation.rerun_commands import moment, rerun
from groundstation.viewer_commands import Foxglove, address, foxglove_layout
from wire.experiment import Experiment, dump_experiment, load_experiment
from wire.messages import Command, Order, Tuning
from wire.options import (
    DEFAULT_FLEET,
    DEFAULT_STATION,
    REPLAY_PREFIX,
    ExperimentName,
    FleetName,
    Insecure,
    KeyRing,
    LockstepMode,
    Settings,
    StationAddress,
    Verbose,
)
from wire.runtime import SLICE_S, Stop, run_app, start_log
from wire.toml_file import ConfigError

cli = typer.Typer(
    help="Ground station: plans trajectories, commands the fleet, records everything, writes the report.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

ORDER_TIMEOUT_S = 2.0
AsJson = Annotated[bool, typer.Option("--json", help="Print it as JSON, for a script.")]
DEFAULT_WEB = "127.0.0.1:8000"
WebAddress = Annotated[str, typer.Option("--web", metavar="HOST:PORT", help="Where the operator's page is served.")]
NoWeb = Annotated[bool, typer.Option("--no-web", help="Serve no page.")]
cli.add_typer(keys_cli, name="keys")
cli.command()(deploy)
FLEET_ORDERS = (
    "load", "arm", "start", "hold", "resume", "return", "rejoin", "test", "stop", "disarm", "clear-stop",
)  # fmt: skip


def _orders(begun: str) -> list[str]:
    """How an order may go on, for the shell."""
    return [order for order in FLEET_ORDERS if order.startswith(begun)]


@cli.command()
def run(
    experiment: ExperimentName,
    out: Annotated[Path, typer.Option(help="Folder for the run's own folder.")] = Path("runs"),
    run_dir: Annotated[Path | None, typer.Option(help="Use exactly this folder for the run.")] = None,
    auto: Annotated[bool, typer.Option("--auto", help="Load, arm, start and finish without being asked.")] = False,
    listen: Annotated[str, typer.Option(metavar="ENDPOINT", help="Where the fleet's Zenoh router listens.")] = DEFAULT_STATION,
    external_router: Annotated[bool, typer.Option(help="Connect to a router that runs elsewhere at --listen.")] = False,
    settings: Settings = None,
    fleet: FleetName = DEFAULT_FLEET,
    lockstep: LockstepMode = False,
    keys: KeyRing = None,
    insecure: Insecure = False,
    verbose: Verbose = False,
    web: WebAddress = DEFAULT_WEB,
    no_web: NoWeb = False,
    web_certificate: Annotated[Path | None, typer.Option(help="TLS certificate (PEM) of the page.")] = None,
    web_key: Annotated[Path | None, typer.Option(help="Its private key (PEM).")] = None,
    web_token_file: Annotated[Path | None, typer.Option(help="File with the token that a page must know.")] = None,
    foxglove: Foxglove = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would be flown, or why it cannot be.")] = False,
) -> None:
    """Fly an experiment: be the fleet's router, wait for the robots, run the mission, record, write the report.

    Without --auto the station waits for orders: from the operator's page, or from another terminal
    (`groundstation order start`).
    Exit code 0 if the mission succeeded, 1 if not.

    Examples:  groundstation run pool --listen tcp/0.0.0.0:7447 --keys keys
               groundstation run pool --auto --dry-run
    """
    loaded = load_experiment(experiment, settings or ())  # before what takes a second to import: a bad one is told at once

    from groundstation import station
    from groundstation.web.guard import web_options
    from wire.bus import Bus
    from wire.network import endpoint
    from wire.topics import Role, process_name
    from wire.transport import ZenohTransport

    token = web_token_file.read_text(encoding="utf-8").strip() if web_token_file is not None else ""
    page = None if no_web else web_options(web, web_certificate, web_key, token)
    viewer = address(foxglove) if foxglove is not None else None
    if dry_run:
        typer.echo(_intent(loaded, run_dir or out))
        return
    start_log("groundstation", verbose)
    stop = Stop()
    me = process_name(Role.STATION)
    where = endpoint(listen, me, keys, insecure=insecure, router=not external_router, lossless=lockstep, fleet=fleet)
    folder = run_dir or out / f"{loaded.name}-{time.strftime('%Y%m%d-%H%M%S')}"
    folder.mkdir(parents=True, exist_ok=True)
    text = dump_experiment(loaded)
    (folder / "experiment.toml").write_text(text, encoding="utf-8")
    with Bus(ZenohTransport(where, stop), fleet) as bus:
        succeeded = station.run(
            loaded,
            text,
            bus,
            folder,
            automatic=auto,
            lockstep=lockstep,
            stop=stop,
            web=page,
            insecure=where.insecure,
            viewer=viewer,
        )
    if run_dir is None:  # a launcher that names the folder writes the report itself, when every process has stopped
        report(folder)
    raise typer.Exit(0 if succeeded else 1)


def _intent(experiment: Experiment, folder: Path) -> str:
    """What a run of it would be. Raises ConfigError for what cannot be flown."""
    from groundstation import planner
    from groundstation.recorder import check_room

    starts = planner.start_poses(experiment, planner.plan(experiment))
    check_room(
        next(place for place in (folder, *folder.resolve().parents) if place.is_dir()), experiment.recording.min_free_gb
    )
    lines = [
        f"{experiment.title or experiment.name}: {experiment.duration_s:g} s, experiment {experiment.hash[:8]}, into {folder}"
    ]
    for robot, (x_m, y_m, z_m, yaw_rad) in starts.items():
        lines.append(f"robot {robot} starts at x {x_m:.2f}, y {y_m:.2f}, z {z_m:.2f} m, yaw {yaw_rad:.2f} rad")
    return "\n".join(lines)


@cli.command()
def order(
    what: Annotated[str, typer.Argument(metavar="ORDER", help=f"One of: {', '.join(FLEET_ORDERS)}.", autocompletion=_orders)],
    station: StationAddress = DEFAULT_STATION,
    fleet: FleetName = DEFAULT_FLEET,
    keys: KeyRing = None,
    insecure: Insecure = False,
) -> None:
    """Give the whole fleet an order through the running station. Exit code 1 and the reason if it refuses.

    Example:  groundstation order start
    """
    if what not in FLEET_ORDERS:
        raise typer.BadParameter(f"{what!r} is no order (allowed: {', '.join(FLEET_ORDERS)})")
    _tell_station(what, Command(Order[what.upper().replace("-", "_")], robot=0), station, fleet, keys, insecure)


def _tell_station(what: str, command: Command, station: str, fleet: str, keys: Path | None, insecure: bool) -> None:
    """Give the running station an order as its operator, and say what becomes of it."""
    from wire.bus import Bus
    from wire.network import endpoint
    from wire.topics import Role, process_name
    from wire.transport import ZenohTransport

    where = endpoint(station, process_name(Role.OPERATOR), keys, insecure=insecure)
    with Bus(ZenohTransport(where, patience_s=ORDER_TIMEOUT_S), fleet) as bus:
        reply = bus.order(command, time.time_ns(), ORDER_TIMEOUT_S)
    typer.echo(f"{what}: {'under way' if reply.accepted else 'refused: ' + reply.reason}")
    raise typer.Exit(0 if reply.accepted else 1)


@cli.command("set")
def tune(
    changes: Annotated[
        list[str] | None, typer.Argument(metavar="KEY=VALUE...", help="For example controller.mpc.q=[2,2,1,1].")
    ] = None,
    undo: Annotated[bool, typer.Option("--undo", help="Go back to the gains before.")] = False,
    station: StationAddress = DEFAULT_STATION,
    fleet: FleetName = DEFAULT_FLEET,
    keys: KeyRing = None,
    insecure: Insecure = False,
) -> None:
    """Change weights and gains while the fleet flies: all robots at the same instant, or none. Exit code 1 if refused.

    Examples:  groundstation set controller.mpc.q=[2,2,1,1]
               groundstation set --undo
    """
    from wire.tunable import values_of

    values = values_of(changes or ())
    if bool(values) == undo:
        raise typer.BadParameter("either KEY=VALUE, or --undo")
    wanted = Tuning("", tuple(values), np.array(list(values.values())))
    _tell_station("set", Command(Order.TUNE, robot=0, tuning=wanted), station, fleet, keys, insecure)


@cli.command()
def stop(
    station: StationAddress = DEFAULT_STATION,
    fleet: FleetName = DEFAULT_FLEET,
    keys: KeyRing = None,
    insecure: Insecure = False,
) -> None:
    """Emergency stop: every robot to neutral, latched until `groundstation order clear-stop`.

    Example:  groundstation stop
    """
    order("stop", station, fleet, keys, insecure)


@cli.command("return")
def come_back(
    station: StationAddress = DEFAULT_STATION,
    fleet: FleetName = DEFAULT_FLEET,
    keys: KeyRing = None,
    insecure: Insecure = False,
) -> None:
    """Every robot back to where it started, clear of one another, of islands and of what the camera sees; then disarm.

    Example:  groundstation return
    """
    order("return", station, fleet, keys, insecure)


@cli.command(context_settings={"ignore_unknown_options": True})
def go(
    places: Annotated[list[float], typer.Argument(metavar="X Y [X Y ...]", help="Places for the formation's centre, in m.")],
    station: StationAddress = DEFAULT_STATION,
    fleet: FleetName = DEFAULT_FLEET,
    keys: KeyRing = None,
    insecure: Insecure = False,
) -> None:
    """Lead the running formation to other places than planned, by the shortest clear way, without stopping it.

    Example:  groundstation go 2.0 -1.5 4.0 0.5
    """
    if len(places) % 2:
        raise typer.BadParameter(f"{len(places)} numbers: each place has two, x and y")
    command = Command(Order.GO, robot=0, via=np.array(places).reshape(-1, 2))
    _tell_station("go", command, station, fleet, keys, insecure)


@cli.command()
def phases() -> None:
    """Print the mission's table: its states, which order counts when, and what it does by itself.

    Example:  groundstation phases
    """
    from groundstation.phases import markdown

    typer.echo(markdown(), nl=False)


@cli.command()
def plan(experiment: ExperimentName, settings: Settings = None) -> None:
    """Plan an experiment's trajectories without flying: prints them as JSON, or says why they cannot be flown.

    Example:  groundstation plan islands > plan.json
    """
    from groundstation import planner

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


@cli.command()
def replay(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.")],
    against: Annotated[
        Path | None, typer.Option(metavar="RUN", help="Another run of the same robots, drawn beside it.")
    ] = None,
    web: WebAddress = DEFAULT_WEB,
    on_bus: Annotated[bool, typer.Option("--bus", help="No page: put it back on the bus, as fleet replay/FLEET.")] = False,
    rate: Annotated[float, typer.Option(min=0.01, help="With --bus: times as fast.")] = 1.0,
    begin: Annotated[float, typer.Option(min=0.0, help="With --bus: from this second of the log on.")] = 0.0,
    end: Annotated[float, typer.Option(min=0.0, help="With --bus: up to this second.")] = float("inf"),
    listen: Annotated[str, typer.Option(metavar="ENDPOINT", help="With --bus: where its router listens.")] = DEFAULT_STATION,
    external_router: Annotated[bool, typer.Option(help="Connect to a router that runs elsewhere at --listen.")] = False,
    fleet: FleetName = DEFAULT_FLEET,
    keys: KeyRing = None,
    insecure: Insecure = False,
) -> None:
    """Show a recorded run on the operator's page, with a time slider, or put it back on the bus. Ends with Ctrl-C.

    On the bus goes what was seen and said, never what made anything move.

    Examples:  groundstation replay runs/pool-20260101-120000
               groundstation replay runs/pool-20260101-120000 --bus --rate 4 --begin 30
    """
    from groundstation.web.guard import web_options
    from groundstation.web.replay import Replay
    from groundstation.web.server import WebServer

    start_log("groundstation")
    stop = Stop()
    if on_bus:
        from groundstation.bus_replay import chosen, send
        from groundstation.logfile import open_log
        from wire.bus import Bus
        from wire.network import endpoint
        from wire.topics import Role, process_name
        from wire.transport import ZenohTransport

        name, me = f"{REPLAY_PREFIX}{fleet}", process_name(Role.STATION)
        where = endpoint(listen, me, keys, insecure=insecure, router=not external_router, fleet=name)
        with open_log(run_folder) as log, Bus(ZenohTransport(where, stop), name) as bus:
            typer.echo(f"{run_folder}: on {listen} as fleet {name}")
            typer.echo(f"{send(bus, chosen(log, begin, end), rate, stop)} messages")
        return
    options = web_options(web)
    with Replay(run_folder, against) as source, WebServer(source, options):
        typer.echo(f"{source.experiment.title or source.experiment.name}: {options.url}")
        while not stop.requested:
            time.sleep(SLICE_S)


@cli.command()
def record(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder with experiment.toml; run.mcap goes there.")],
    mode: Annotated[str, typer.Option(help="How time went in the run; told in the report.")] = "numeric",
) -> None:
    """Write the log of a run that another program hands over on stdin, as `sim-bridge numeric` does.

    Example:  sim-bridge numeric numeric        (starts it, and hands over what is flown)
    """
    from groundstation import piped

    problem = piped.record(load_experiment(str(run_folder / "experiment.toml")), run_folder, mode, sys.stdin.buffer)
    if problem:
        typer.echo(f"{run_folder / 'run.mcap'}: {problem}", err=True)
    raise typer.Exit(1 if problem else 0)


@cli.command()
def report(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.")],
    pdf: Annotated[Path | None, typer.Option(metavar="FOLDER", help="Write every figure there as a PDF, too.")] = None,
    as_json: AsJson = False,
) -> None:
    """Write result.json and report.html of a run again, from its log.

    Example:  groundstation report runs/pool-20260101-120000 --pdf figures
    """
    from groundstation import report as reporting

    result = reporting.write_report(run_folder)
    figures = reporting.write_figures(run_folder, pdf) if pdf is not None else []
    if as_json:
        typer.echo(result.to_json(), nl=False)
        return
    typer.echo(f"report: {run_folder / 'report.html'}")
    for path in figures:
        typer.echo(path)


@cli.command()
def compare(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders of two or more runs.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The page to write.")] = Path("compare.html"),
    as_json: AsJson = False,
) -> None:
    """Put runs side by side: their figures, in what their experiments differ, and a page with their errors over time.

    Example:  groundstation compare runs/pool-20260101-120000 runs/pool-20260101-130000 --out why.html
    """
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from groundstation import report as reporting
    from groundstation.side_by_side import Run, differences, figures_of

    if len(runs) < 2:
        raise ConfigError("compare: two runs or more are needed")
    missing = [str(run) for run in runs if not (run / "run.mcap").is_file()]
    if missing:
        raise ConfigError(f"{missing[0]}: no run.mcap there")
    names = [run.resolve().name for run in runs]
    names = names if len(set(names)) == len(names) else [str(run) for run in runs]
    read = []
    for name, folder in zip(names, runs, strict=True):
        series, _, result = reporting.evaluated(folder)
        read.append(Run(name, series, result))
    reporting.write_comparison(read, out)
    if as_json:
        figures = [{"name": row.name, "unit": row.unit, "values": row.values} for row in figures_of(read)]
        changed = [{"key": key, "values": values} for key, values in differences(read)]
        typer.echo(json.dumps({"runs": names, "figures": figures, "differences": changed}, indent=1))
        return
    console = Console()
    for title, rows in (
        ("figures", [(f"{row.name} [{row.unit}]" if row.unit else row.name, *row.values) for row in figures_of(read)]),
        ("what was different", [(key, *values) for key, values in differences(read)]),
    ):
        table = Table(title=title)
        for column in ("", *names):
            table.add_column(column, overflow="fold")
        for row in rows:
            table.add_row(*(f"{v:.4g}" if isinstance(v, float) else "–" if v is None else escape(str(v)) for v in row))
        console.print(table)
    console.print(f"page: {out}", soft_wrap=True)


@cli.command()
def export(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.")],
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="Where the files go.")],
    parquet: Annotated[bool, typer.Option("--parquet", help="Parquet instead of CSV.")] = False,
    foxglove: Annotated[bool, typer.Option("--foxglove", help="For Foxglove-family viewers instead.")] = False,
) -> None:
    """Write a run's messages as tables, one per topic and robot: a row per message, a column per number.

    Or, for 3-D viewers, the log with the scene in it, and a layout that shows it.

    Examples:  groundstation export runs/pool-20260101-120000 --out tables
               groundstation export runs/pool-20260101-120000 --out viewer --foxglove
    """
    if foxglove:
        from groundstation import viewer_export

        for path in viewer_export.export(run_folder, out):
            typer.echo(path)
        return
    from groundstation import tables

    for path, rows in tables.export(run_folder / "run.mcap", out, parquet):
        typer.echo(f"{path}: {rows} rows")


@cli.command()
def recover(log_file: Annotated[Path, typer.Argument(metavar="FILE", help="A log that was cut off.")]) -> None:
    """Make a cut log whole: everything up to the cut, and the index that readers want. Reports do this by themselves.

    Example:  groundstation recover runs/pool-20260101-120000/run.mcap
    """
    from groundstation import recorder

    if not log_file.is_file():
        raise ConfigError(f"{log_file}: no such file")
    typer.echo(f"{log_file}: {'mended up to the cut' if recorder.recover(log_file) else 'is whole, nothing to mend'}")


@cli.command()
def comparison(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Where comparison.json is, as `sim-bridge compare` writes it.")
    ],
) -> None:
    """Print the table of a comparison and write comparison.html beside it. Exit code 1 if a flight failed.

    Example:  groundstation comparison runs/compare-pool
    """
    from groundstation import compare_report

    raise typer.Exit(0 if compare_report.write(folder) else 1)


cli.command()(rerun)
cli.command()(foxglove_layout)
cli.command(hidden=True)(moment)


def app() -> None:
    """Entry point."""
    run_app(cli)


if __name__ == "__main__":
    app()

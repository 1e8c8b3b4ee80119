"""SHELL: `groundstation log replay`: a run on the page again, or on the bus."""

import time
from pathlib import Path
from typing import Annotated

import typer

from wire.process.cli_options import (
    DEFAULT_FLEET,
    DEFAULT_STATION,
    DEFAULT_WEB,
    REPLAY_PREFIX,
    ExternalRouter,
    FleetName,
    Insecure,
    KeyRing,
    WebAddress,
)
from wire.process.runtime import SLICE_S, Stop, start_log


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
    external_router: ExternalRouter = False,
    fleet: FleetName = DEFAULT_FLEET,
    keys: KeyRing = None,
    insecure: Insecure = False,
) -> None:
    """Show a recorded run on the operator's page, with a time slider, or put it back on the bus. Ends with Ctrl-C.

    On the bus goes what was seen and said, never what made anything move.

    Examples:  groundstation log replay runs/pool-20260101-120000
               groundstation log replay runs/pool-20260101-120000 --bus --rate 4 --begin 30
    """
    from groundstation.web.auth import web_options
    from groundstation.web.replay_backend import ReplayBackend
    from groundstation.web.server import WebServer

    start_log("groundstation")
    stop = Stop()
    if on_bus:
        from groundstation.logs.reader import open_log
        from groundstation.replay.bus_replay import chosen, send
        from wire.messages.topics import Role, process_name
        from wire.transport.bus import Bus
        from wire.transport.network import endpoint
        from wire.transport.zenoh_transport import ZenohTransport

        name, me = f"{REPLAY_PREFIX}{fleet}", process_name(Role.STATION)
        where = endpoint(listen, me, keys, insecure=insecure, router=not external_router, fleet=name)
        with open_log(run_folder) as log, Bus(ZenohTransport(where, stop), name) as bus:
            typer.echo(f"{run_folder}: on {listen} as fleet {name}")
            typer.echo(f"{send(bus, chosen(log, begin, end), rate, stop)} messages")
        return
    options = web_options(web)
    with ReplayBackend(run_folder, against) as source, WebServer(source, options):
        typer.echo(f"{source.experiment.title or source.experiment.name}: {options.url}")
        while not stop.requested:
            time.sleep(SLICE_S)

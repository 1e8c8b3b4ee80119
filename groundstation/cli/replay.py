"""SHELL: `groundstation log replay`: a run on the page again, or on the bus."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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

if TYPE_CHECKING:  # the page's server takes a second to import
    from wire.web_access import WebOptions

CLOSED_S = 6.0  # without an open page; one that is cut off or loaded again is back within 4 s


def replay(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.")],
    against: Annotated[
        Path | None, typer.Option(metavar="RUN", help="Another run of the same robots, drawn beside it.")
    ] = None,
    web: WebAddress = DEFAULT_WEB,
    until_closed: Annotated[
        bool, typer.Option("--until-closed", help=f"End when no page has been open for {CLOSED_S:g} s.")
    ] = False,
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
    from wire.web_access import web_options

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
    show(run_folder, web_options(web), stop, against, until_closed)


def show(run_folder: Path, options: "WebOptions", stop: Stop, against: Path | None = None, until_closed: bool = False) -> None:
    """Show a recorded run on the page, until it is told to stop or, with `until_closed`, no page is open."""
    from groundstation.web.replay_backend import ReplayBackend
    from groundstation.web.server import WebServer

    with ReplayBackend(run_folder, against) as source, WebServer(source, options) as server:
        typer.echo(f"{source.experiment.title or source.experiment.name}: {options.url}")
        seen_s = time.monotonic()
        while not stop.requested and not (until_closed and time.monotonic() - seen_s > CLOSED_S):
            time.sleep(SLICE_S)
            if server.watched:
                seen_s = time.monotonic()

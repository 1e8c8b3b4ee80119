"""SHELL: `groundstation log replay`: a run on the page again, or on the bus. `ended` shows one that has just ended."""

import json
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from shoal.runtime.cli_options import (
    DEFAULT_FLEET,
    DEFAULT_STATION,
    DEFAULT_WEB,
    REPLAY_PREFIX,
    ExternalRouter,
    FleetName,
    Insecure,
    KeyRing,
    RunFolder,
    WebAddress,
    as_run,
    finite,
)
from shoal.runtime.runtime import SLICE_S, Stop, start_log

if TYPE_CHECKING:  # the page's server takes a second to import
    from groundstation.web.replay_backend import RunChoice
    from shoal.runtime.web_access import WebOptions

CLOSED_S = 6.0  # without an open page; one that is cut off or loaded again is back within 4 s
RETURN_S = 75.0  # for a page that was open to come the first time: Chromium wakes one in a hidden tab once a minute


def replay(
    run_folder: RunFolder,
    against: Annotated[
        Path | None, typer.Option(metavar="RUN", help="Another run of the same robots, drawn beside it.", callback=as_run)
    ] = None,
    web: WebAddress = DEFAULT_WEB,
    until_closed: Annotated[
        bool, typer.Option("--until-closed", help=f"End when no page has been open for {CLOSED_S:g} s.")
    ] = False,
    on_bus: Annotated[bool, typer.Option("--bus", help="No page: put it back on the bus, as fleet replay/FLEET.")] = False,
    rate: Annotated[float, typer.Option(min=0.01, help="With --bus: times as fast.", callback=finite)] = 1.0,
    begin: Annotated[float, typer.Option(min=0.0, help="With --bus: from this second of the log on.", callback=finite)] = 0.0,
    end: Annotated[
        float | None, typer.Option(min=0.0, help="With --bus: up to this second; default: its end.", callback=finite)
    ] = None,
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
    from shoal.runtime.web_access import web_options

    start_log("groundstation")
    stop = Stop()
    if on_bus:
        from groundstation.gate.gate import Gate
        from groundstation.logs.bus_replay import chosen, send
        from groundstation.logs.reader import open_log
        from shoal.bus.bus import Bus
        from shoal.bus.network import endpoint
        from shoal.bus.zenoh_transport import ZenohTransport
        from shoal.messages.topics import Role, process_name

        name, me = f"{REPLAY_PREFIX}{fleet}", process_name(Role.STATION)
        where = endpoint(listen, me, keys, insecure=insecure, router=not external_router, fleet=name)
        with open_log(run_folder) as log, Bus(ZenohTransport(where, stop, gate=Gate), name) as bus:
            typer.echo(f"{run_folder}: on {listen} as fleet {name}")
            typer.echo(f"{send(bus, chosen(log, begin, math.inf if end is None else end), rate, stop)} messages")
        return
    show(run_folder, web_options(web), stop, against, until_closed)


def ended(
    run_folder: RunFolder,
    web: WebAddress = DEFAULT_WEB,
    problem: Annotated[str, typer.Option(help="Shown beside the verdict.")] = "",
) -> None:
    """Show a run that has just ended to its page, and hand over to stdout what a person chose then, for `sim-bridge sil`."""
    from shoal.config.experiment import dump_experiment
    from shoal.runtime.web_access import web_options

    start_log("groundstation")
    choice = show(
        run_folder, web_options(web), Stop(), until_closed=True, offers=("again", "edited", "close"), problem=problem
    )
    text = dump_experiment(choice.experiment) if choice is not None and choice.experiment is not None else ""
    typer.echo(json.dumps({"what": choice.what if choice is not None else "close", "experiment": text}))


def show(
    run_folder: Path,
    options: "WebOptions",
    stop: Stop,
    against: Path | None = None,
    until_closed: bool = False,
    offers: Sequence[str] = (),
    problem: str = "",
) -> "RunChoice | None":
    """Show a recorded run on the page, until it is told to stop, a person chooses one of the `offers` or, with `until_closed`,
    no page is open. Returns the choice."""
    from groundstation.web.replay_backend import ReplayBackend
    from groundstation.web.server import WebServer

    with ReplayBackend(run_folder, against, offers, problem) as source, WebServer(source, options) as server:
        if not offers:
            typer.echo(f"{source.experiment.title or source.experiment.name}: {options.url}")
        closed_s = time.monotonic() + RETURN_S if offers else math.inf  # then it counts as closed; else nobody had it open yet
        while not stop.requested and source.choice is None and not (until_closed and time.monotonic() > closed_s):
            time.sleep(SLICE_S)
            if server.watched:
                closed_s = time.monotonic() + CLOSED_S
        return source.choice

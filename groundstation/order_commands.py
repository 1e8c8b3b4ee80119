"""SHELL: what a person tells the running station from a terminal: `groundstation order`, `set`, `stop`, `return`, `go`; and
what counts when, `phases`."""

import json
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from wire.messages import Command, Order, Tuning
from wire.options import DEFAULT_FLEET, DEFAULT_STATION, AsJson, FleetName, Insecure, KeyRing, StationAddress

ORDER_TIMEOUT_S = 2.0
FLEET_ORDERS = (
    "load", "arm", "start", "hold", "resume", "return", "rejoin", "test", "stop", "disarm", "clear-stop",
)  # fmt: skip


def _orders(begun: str) -> list[str]:
    """How an order may go on, for the shell."""
    return [order for order in FLEET_ORDERS if order.startswith(begun)]


def order(
    what: Annotated[str, typer.Argument(metavar="ORDER", help=f"One of: {', '.join(FLEET_ORDERS)}.", autocompletion=_orders)],
    station: StationAddress = DEFAULT_STATION,
    fleet: FleetName = DEFAULT_FLEET,
    keys: KeyRing = None,
    insecure: Insecure = False,
    as_json: AsJson = False,
) -> None:
    """Give the whole fleet an order through the running station. Exit code 1 and the reason if it refuses.

    Example:  groundstation order start
    """
    if what not in FLEET_ORDERS:
        raise typer.BadParameter(f"{what!r} is no order (allowed: {', '.join(FLEET_ORDERS)})")
    _tell_station(what, Command(Order[what.upper().replace("-", "_")], robot=0), station, fleet, keys, insecure, as_json)


def tune(
    changes: Annotated[
        list[str] | None, typer.Argument(metavar="KEY=VALUE", help="For example controller.mpc.q=[2,2,1,1].")
    ] = None,
    undo: Annotated[bool, typer.Option("--undo", help="Go back to the gains before.")] = False,
    station: StationAddress = DEFAULT_STATION,
    fleet: FleetName = DEFAULT_FLEET,
    keys: KeyRing = None,
    insecure: Insecure = False,
    as_json: AsJson = False,
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
    _tell_station("set", Command(Order.TUNE, robot=0, tuning=wanted), station, fleet, keys, insecure, as_json)


def stop(
    station: StationAddress = DEFAULT_STATION,
    fleet: FleetName = DEFAULT_FLEET,
    keys: KeyRing = None,
    insecure: Insecure = False,
    as_json: AsJson = False,
) -> None:
    """Emergency stop: every robot to neutral, latched until `groundstation order clear-stop`.

    Example:  groundstation stop
    """
    order("stop", station, fleet, keys, insecure, as_json)


def come_back(
    station: StationAddress = DEFAULT_STATION,
    fleet: FleetName = DEFAULT_FLEET,
    keys: KeyRing = None,
    insecure: Insecure = False,
    as_json: AsJson = False,
) -> None:
    """Every robot back to where it started, clear of one another, of islands and of what the camera sees; then disarm.

    Example:  groundstation return
    """
    order("return", station, fleet, keys, insecure, as_json)


def go(
    places: Annotated[
        list[float],
        typer.Argument(metavar="X Y", help="Places for the formation's centre, x and y in m; as many as you like."),
    ],
    station: StationAddress = DEFAULT_STATION,
    fleet: FleetName = DEFAULT_FLEET,
    keys: KeyRing = None,
    insecure: Insecure = False,
    as_json: AsJson = False,
) -> None:
    """Lead the running formation to other places than planned, by the shortest clear way, without stopping it.

    Example:  groundstation go 2.0 -1.5 4.0 0.5
    """
    if len(places) % 2:
        raise typer.BadParameter(f"{len(places)} numbers: each place has two, x and y")
    if not np.all(np.isfinite(places)):
        raise typer.BadParameter(f"{' '.join(map(str, places))}: no places (allowed: finite numbers, in m)")
    command = Command(Order.GO, robot=0, via=np.array(places).reshape(-1, 2))
    _tell_station("go", command, station, fleet, keys, insecure, as_json)


def phases() -> None:
    """Print the mission's table: its states, which order counts when, and what it does by itself.

    Example:  groundstation phases
    """
    from groundstation.phases import markdown

    typer.echo(markdown(), nl=False)


def _tell_station(
    what: str, command: Command, station: str, fleet: str, keys: Path | None, insecure: bool, as_json: bool
) -> None:
    """Give the running station an order as its operator, and say what becomes of it."""
    from wire.bus import Bus
    from wire.gate import nearest
    from wire.network import endpoint
    from wire.topics import Role, process_name
    from wire.transport import ZenohTransport

    where = nearest(endpoint(station, process_name(Role.OPERATOR), keys, insecure=insecure))
    with Bus(ZenohTransport(where, patience_s=ORDER_TIMEOUT_S), fleet) as bus:
        reply = bus.order(command, time.time_ns(), ORDER_TIMEOUT_S)
    if as_json:
        typer.echo(json.dumps({"order": what, "accepted": reply.accepted, "reason": reply.reason}))
    else:
        typer.echo(f"{what}: {'under way' if reply.accepted else 'refused: ' + reply.reason}")
    raise typer.Exit(0 if reply.accepted else 1)

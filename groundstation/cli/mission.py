"""SHELL: what a person asks of the running station from a terminal: `groundstation order`, `set`, `stop`, `return`, `go`,
`end`; and what counts when, `phases`.

Each command waits for the outcome of its request, tells it robot by robot, and exits by it (docs/commands.md).
"""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from wire.messages.messages import Command, Order, Outcome, Progress, Reply, Tuning
from wire.process.cli_options import DEFAULT_FLEET, AsJson, FleetName, Insecure, KeyRing

ORDER_TIMEOUT_S = 2.0
ASK_EVERY_S = 0.2
PATIENCE_S = {Order.STOP: 5.0, Order.RETURN: 600.0, Order.TUNE: 120.0}  # a lap, for gains that change with the next one
OTHERWISE_S = 60.0  # the station itself gives a robot up after 10 s in each of a request's stages

Station = Annotated[
    str | None,
    typer.Option(
        "--station",
        metavar="ENDPOINT",
        help="Where the ground station's router listens (Zenoh endpoint). Default: the station that runs on this machine.",
        show_default=False,
    ),
]
Wait = Annotated[
    float | None,
    typer.Option(
        "--wait",
        min=0.0,
        metavar="SECONDS",
        help="How long to wait for the outcome; 0: only until the station has taken the request.",
        show_default=False,
    ),
]
FLEET_ORDERS = (
    "load", "arm", "start", "hold", "resume", "return", "rejoin", "test", "stop", "disarm", "clear-stop", "end",
)  # fmt: skip


def _orders(begun: str) -> list[str]:
    """How an order may go on, for the shell."""
    return [order for order in FLEET_ORDERS if order.startswith(begun)]


def order(
    what: Annotated[str, typer.Argument(metavar="ORDER", help=f"One of: {', '.join(FLEET_ORDERS)}.", autocompletion=_orders)],
    station: Station = None,
    fleet: FleetName = DEFAULT_FLEET,
    keys: KeyRing = None,
    insecure: Insecure = False,
    wait: Wait = None,
    as_json: AsJson = False,
) -> None:
    """Give the whole fleet an order through the running station, and wait for what comes of it, robot by robot.

    Exit code 0 when it is done, 1 and the reason if not.

    Example:  groundstation order start
    """
    if what not in FLEET_ORDERS:
        raise typer.BadParameter(f"{what!r} is no order (allowed: {', '.join(FLEET_ORDERS)})")
    _tell_station(what, Command(Order[what.upper().replace("-", "_")], robot=0), station, fleet, keys, insecure, wait, as_json)


def tune(
    changes: Annotated[
        list[str] | None, typer.Argument(metavar="KEY=VALUE", help="For example controller.mpc.q=[2,2,1,1].")
    ] = None,
    undo: Annotated[bool, typer.Option("--undo", help="Go back to the gains before.")] = False,
    station: Station = None,
    fleet: FleetName = DEFAULT_FLEET,
    keys: KeyRing = None,
    insecure: Insecure = False,
    wait: Wait = None,
    as_json: AsJson = False,
) -> None:
    """Change weights and gains while the fleet flies: all robots at the same instant, or none.

    Exit code 0 when all fly with them, 1 and the reason if not.

    Examples:  groundstation set controller.mpc.q=[2,2,1,1]
               groundstation set --undo
    """
    from wire.messages.live_gains import values_of

    values = values_of(changes or ())
    if bool(values) == undo:
        raise typer.BadParameter("either KEY=VALUE, or --undo")
    wanted = Tuning("", tuple(values), np.array(list(values.values())))
    _tell_station("set", Command(Order.TUNE, robot=0, tuning=wanted), station, fleet, keys, insecure, wait, as_json)


def stop(
    station: Station = None,
    fleet: FleetName = DEFAULT_FLEET,
    keys: KeyRing = None,
    insecure: Insecure = False,
    wait: Wait = None,
    as_json: AsJson = False,
) -> None:
    """Emergency stop: every robot to neutral, latched until `groundstation order clear-stop`.

    Exit code 0 when every robot of the experiment has confirmed, 1 with the names of those that have not.

    Example:  groundstation stop
    """
    order("stop", station, fleet, keys, insecure, wait, as_json)


def come_back(
    station: Station = None,
    fleet: FleetName = DEFAULT_FLEET,
    keys: KeyRing = None,
    insecure: Insecure = False,
    wait: Wait = None,
    as_json: AsJson = False,
) -> None:
    """Every robot back to where it started, clear of one another, of islands and of what the camera sees; then disarm.

    Waits until all are there (`--wait`). Exit code 0 then, 1 and the reason if not, also when one had to be left out.

    Example:  groundstation return
    """
    order("return", station, fleet, keys, insecure, wait, as_json)


def go(
    places: Annotated[
        list[float],
        typer.Argument(metavar="X Y", help="Places for the formation's centre, x and y in m; as many as you like."),
    ],
    station: Station = None,
    fleet: FleetName = DEFAULT_FLEET,
    keys: KeyRing = None,
    insecure: Insecure = False,
    wait: Wait = None,
    as_json: AsJson = False,
) -> None:
    """Lead the running formation to other places than planned, by the shortest clear way, without stopping it.

    Exit code 0 when all fly the new way, 1 and the reason if there is none.

    Example:  groundstation go 2.0 -1.5 4.0 0.5
    """
    if len(places) % 2:
        raise typer.BadParameter(f"{len(places)} numbers: each place has two, x and y")
    if not np.all(np.isfinite(places)):
        raise typer.BadParameter(f"{' '.join(map(str, places))}: no places (allowed: finite numbers, in m)")
    command = Command(Order.GO, robot=0, via=np.array(places).reshape(-1, 2))
    _tell_station("go", command, station, fleet, keys, insecure, wait, as_json)


def end(
    station: Station = None,
    fleet: FleetName = DEFAULT_FLEET,
    keys: KeyRing = None,
    insecure: Insecure = False,
    wait: Wait = None,
    as_json: AsJson = False,
) -> None:
    """End the run: disarm every robot, then let the station write what it has, and stop. In `sim-bridge sil` everything ends.

    Example:  groundstation end
    """
    order("end", station, fleet, keys, insecure, wait, as_json)


def phases() -> None:
    """Print the mission's table: its states, which order counts when, and what it does by itself.

    Example:  groundstation phases
    """
    from groundstation.mission.state_machine import markdown

    typer.echo(markdown(), nl=False)


def _tell_station(
    what: str,
    command: Command,
    given: str | None,
    fleet: str,
    keys: Path | None,
    insecure: bool,
    wait_s: float | None,
    as_json: bool,
) -> None:
    """Ask something of the running station as its operator, wait for what becomes of it, and exit by that."""
    from groundstation.station.discovery import station
    from wire.messages.topics import Role, process_name
    from wire.transport.bus import Bus
    from wire.transport.gate import nearest
    from wire.transport.network import endpoint
    from wire.transport.zenoh_transport import ZenohTransport

    where = nearest(endpoint(station(given, fleet), process_name(Role.OPERATOR), keys, insecure=insecure))
    patience_s = PATIENCE_S.get(command.order, OTHERWISE_S) if wait_s is None else wait_s
    told = _Told(what, as_json)
    try:
        with Bus(ZenohTransport(where, patience_s=ORDER_TIMEOUT_S), fleet) as bus:
            reply = follow(lambda c: bus.order(c, time.time_ns(), ORDER_TIMEOUT_S), command, patience_s, told.progress)
    except KeyboardInterrupt:
        typer.echo(f"{what}: not waited for; the station goes on with it", err=True)
        raise typer.Exit(130) from None
    raise typer.Exit(told.end(reply, patience_s))


def follow(ask: Callable[[Command], Reply], command: Command, patience_s: float, told: Callable[[Outcome], None]) -> Reply:
    """Ask for something, and then what became of it, until it is over or `patience_s` have gone by. Returns the last answer.
    An emergency stop that nobody answers is asked for again."""
    deadline = time.monotonic() + patience_s
    reply = ask(command)
    while command.order is Order.STOP and reply.silent and time.monotonic() < deadline:
        reply = ask(command)
    while reply.accepted and reply.outcome is not None and reply.outcome.progress is Progress.UNDER_WAY:
        told(reply.outcome)
        if time.monotonic() >= deadline:
            return reply
        time.sleep(ASK_EVERY_S)
        answer = ask(Command(Order.NONE, robot=0, about=reply.outcome.request))
        reply = reply if answer.silent else answer
    return reply


class _Told:
    """What has been printed of a request."""

    def __init__(self, what: str, as_json: bool) -> None:
        self._what, self._as_json = what, as_json
        self._robots: dict[int, str] = {}
        self._mission = ""

    def progress(self, outcome: Outcome) -> None:
        """Each thing once."""
        if self._as_json:
            return
        if outcome.mission != self._mission:
            self._mission = outcome.mission
            typer.echo(f"  mission: {outcome.mission.lower().replace('_', ' ')}")
        for robot in outcome.confirmed:
            if self._robots.get(robot) != "confirmed":
                self._robots[robot] = "confirmed"
                typer.echo(f"  robot {robot}: confirmed")

    def end(self, reply: Reply, patience_s: float) -> int:
        """The outcome. Returns the exit code."""
        outcome = reply.outcome
        if outcome is None:
            done, text = False, f"refused: {reply.reason}" if not reply.silent else f"not heard: {reply.reason}"
            done, text = (
                (False, "under way, and this station does not tell what becomes of it") if reply.accepted else (done, text)
            )
        elif outcome.progress is Progress.UNDER_WAY:
            done = patience_s == 0.0
            text = "taken by the station" if done else f"not done within {patience_s:g} s"
        else:
            done = outcome.progress is Progress.DONE
            text = f"{'done' if done else 'failed'}{f': {outcome.reason}' if outcome.reason else ''}"
        if self._as_json:
            robots = dict.fromkeys(outcome.confirmed, "confirmed") if outcome is not None else {}
            robots |= dict(zip(outcome.waiting, outcome.why, strict=False)) if outcome is not None else {}
            told = {"order": self._what, "accepted": reply.accepted, "done": done, "text": text, "robots": robots}
            typer.echo(json.dumps(told | {"reason": reply.reason}))
            return 0 if done else 1
        if outcome is not None and patience_s > 0.0:
            self.progress(outcome)
            for robot, why in zip(outcome.waiting, outcome.why, strict=False):
                typer.echo(f"  robot {robot}: NOT confirmed: {why}")
        typer.echo(f"{self._what}: {text}")
        return 0 if done else 1

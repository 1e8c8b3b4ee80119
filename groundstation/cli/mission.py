"""SHELL: requests of the operator to the running station: `groundstation mission ...`, `gains ...`, `stop`, `end`.

Each command waits for the outcome of its request, prints it robot by robot, and exits by it (docs/commands.md).
"""

import functools
import inspect
import json
import re
from collections.abc import Callable, Sequence
from typing import Annotated, Any, ParamSpec

import typer

from groundstation.mission.state_machine import (
    FLEET_REQUESTS,
    ONE_ROBOT,
    WATER,
    markdown,
    order_name,
    order_named,
    request_named,
)
from shoal.config.formation_shapes import FORM_USAGE, SHAPES
from shoal.messages.messages import WHOLE_FLEET, Command, CommandKind, Outcome, Reply
from shoal.runtime.cli_options import DEFAULT_FLEET, AsJson, FleetName, Insecure, KeyRing, Settings, finite
from shoal.system.printable import printable

P = ParamSpec("P")
LONGEST_WAIT_S = 86_400.0
INTERRUPTED = 130  # exit code of a command that a person's Ctrl-C ends, as shells have it

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
        max=LONGEST_WAIT_S,
        metavar="SECONDS",
        help="How long to wait for the outcome; 0: only until the station has taken the request.",
        show_default=False,
        callback=finite,
    ),
]
Robot = Annotated[
    int | None,
    typer.Option(
        "--robot",
        min=1,
        max=49,
        metavar="ID",
        help="Only this robot; in flight it is out of the formation until `groundstation mission rejoin`.",
        show_default=False,
    ),
]
HELP = {
    "arm": "Load the trajectories and arm all robots, and go no further.",
    "start": "Load, arm and start: fly the experiment.",
    "hold": "Make all robots hold their places under power.",
    "resume": "Go on after a hold.",
    "return": """Bring every robot back to its start, clear of the others, of islands and of obstacles; then disarm.

    Waits until all are there (`--wait`). Exit code 1 also when a robot had to be left out.""",
    "rejoin": "Let lost robots that are heard and fit again take part.",
    "test": "Test every thruster of every robot, briefly and with little thrust.",
    "disarm": "Disarm all robots: neutral, and no pulses until they are armed again.",
    "clear-stop": "Clear an emergency stop. Robots stay disarmed until they are armed again.",
    "out": """Say that a person has taken a robot out of the water.

    The others keep clear of its last place no longer, it stops no mission, and no run counts on it or has it flown, until
    `groundstation mission back-in`.""",
    "back-in": """Say that a robot is in the water again: at rest it takes part in the next run, in flight it may rejoin.""",
    "stop": """Emergency stop: every robot of every station here to neutral, latched until `groundstation mission clear-stop`.

    On the station's machine it needs no keys. It stops first, and names afterwards what it could not use of its command line.
    Exit code 0 when every robot of every station has confirmed, 1 with the names of those that have not.""",
    "end": """End the run: disarm every robot, then let the station write what it has, and stop. In `sim-bridge sil`
    everything ends.""",
}

FORM_HELP = re.sub(r"\[(?=[a-z])", r"\\[", FORM_USAGE)  # Rich takes [a word] for a style, and leaves it out

mission_cli = typer.Typer(
    help="Requests to the running station for the whole fleet (docs/missions.md).",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
gains_cli = typer.Typer(
    help="Weights and gains of the controller, changed while the fleet flies.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


def _tell_station(
    what: str,
    command: Command,
    *,
    station: Station = None,
    fleet: FleetName = DEFAULT_FLEET,
    keys: KeyRing = None,
    insecure: Insecure = False,
    wait: Wait = None,
    as_json: AsJson = False,
) -> None:
    """Make a request of the running station as its operator, wait for the outcome, and exit by it."""
    from groundstation import client

    patience_s = client.patience_s(command) if wait is None else wait
    printer, is_heard = OutcomePrinter(what, as_json), False
    try:
        with client.connect(station, fleet, keys, insecure) as bus:
            send = client.sender(bus)

            def ask(command: Command) -> Reply:
                nonlocal is_heard
                reply = send(command)
                is_heard = is_heard or not reply.silent
                return reply

            reply = client.follow(ask, command, client.limit(bus, patience_s), printer.progress)
    except KeyboardInterrupt:
        silence = "NOT HEARD: the station has not answered, and may not have got it"
        typer.echo(f"{what}: not waited for; {'the station goes on with it' if is_heard else silence}", err=True)
        raise typer.Exit(INTERRUPTED) from None
    raise typer.Exit(printer.end(reply, patience_s))


def request(command: Callable[P, tuple[str, Command]]) -> Callable[..., None]:
    """Turn a function that makes a request, and gives its name, into a command of a terminal: with the options that all
    requests have. It sends the request to the running station, waits for the outcome, and exits by it."""
    own, common = inspect.signature(command, eval_str=True), inspect.signature(_tell_station, eval_str=True)
    options = [option for option in common.parameters.values() if option.kind is option.KEYWORD_ONLY]

    @functools.wraps(command)
    def ask(*arguments: Any, **given: Any) -> None:
        shared = {option.name: given.pop(option.name) for option in options if option.name in given}
        _tell_station(*command(*arguments, **given), **shared)

    ask.__signature__ = own.replace(parameters=[*own.parameters.values(), *options], return_annotation=None)  # type: ignore[attr-defined]
    return ask


def fleet_request(name: str) -> Callable[..., None]:
    """Command that makes one request of the whole fleet, and of one robot where that can be."""

    def for_one(robot: Robot = None) -> tuple[str, Command]:
        return name, request_named(name, robot or WHOLE_FLEET)

    return request(for_one if order_named(name) in ONE_ROBOT else lambda: (name, request_named(name)))


def robot_request(name: str) -> Callable[..., None]:
    """Command that makes one request of one robot."""

    def for_one(
        robot: Annotated[int, typer.Option("--robot", min=1, max=49, metavar="ID", help="The robot.", show_default=False)],
    ) -> tuple[str, Command]:
        return name, request_named(name, robot)

    return request(for_one)


def register(cli: typer.Typer, name: str, group: str = "") -> None:
    """Add the request `name` to a group of commands."""
    of_one = order_named(name) in WATER
    help_text = f"{HELP[name]}\n\n    Example:  groundstation {group}{name}{' --robot 2' if of_one else ''}"
    cli.command(name, help=help_text)(robot_request(name) if of_one else fleet_request(name))


for _name in (*FLEET_REQUESTS, *map(order_name, WATER)):
    if _name not in ("stop", "end", "load"):  # words of their own
        register(mission_cli, _name, "mission ")


@mission_cli.command()
@request
def load(
    experiment: Annotated[
        str | None,
        typer.Argument(metavar="[EXPERIMENT]", help="Another one for the same robots: a shipped name, or a .toml file."),
    ] = None,
    settings: Settings = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would be flown, or why it cannot be.")] = False,
) -> tuple[str, Command]:
    """Fly another experiment's path in the running session; without one, load the trajectories into all robots.

    The plan's starts, clearances, speeds and forces are printed first. Robots at rest stay so: the next `start` flies the new
    path. Robots that hold fly to its beginning and along it. In flight: `groundstation mission hold` first. Pool, vehicle,
    control and limits stay those of the session. Exit code 0 when it is planned or flown, 1 and the reason if it cannot be.

    Examples:  groundstation mission load square.toml --dry-run

               groundstation mission load figure-eight --set path.speed_mps=0.1
    """
    if experiment is None:
        if settings or dry_run:
            raise typer.BadParameter("--set and --dry-run go with an experiment")
        return "load", request_named("load")
    from groundstation.client import flight_of, path_command
    from groundstation.planning import planner

    loaded = flight_of(experiment, settings or ())
    lines = [f"{loaded.title or loaded.name}: {loaded.duration_s:g} s", *planner.description(loaded)]
    for line in lines:
        typer.echo(printable(line), err=not dry_run)  # stdout is for the outcome, which may be JSON
    if dry_run:
        raise typer.Exit
    return "load", path_command(loaded)


@gains_cli.command("set")
@request
def set_gains(
    changes: Annotated[list[str], typer.Argument(metavar="KEY=VALUE", help="For example controller.nmpc.turning_m=0.02.")],
) -> tuple[str, Command]:
    """Change weights and gains while the fleet flies: all robots at the same instant, or none.

    Exit code 0 when all fly with them, 1 and the reason if not.

    Example:  groundstation gains set 'controller.mpc.q_formation=[0.3,0.3,0.3,0.3]'
    """
    return _gains(changes)


@gains_cli.command("undo")
@request
def undo_gains() -> tuple[str, Command]:
    """Go back to the gains before the last change, as `gains set` does.

    Example:  groundstation gains undo
    """
    return _gains(())


def _gains(changes: Sequence[str]) -> tuple[str, Command]:
    """Request of these gains; of those before if there are none."""
    from groundstation.client import gains_command

    return "set" if changes else "undo", gains_command(changes)


@mission_cli.command(context_settings={"ignore_unknown_options": True})  # places may be negative
@request
def go(
    places: Annotated[
        list[float],
        typer.Argument(
            metavar="X Y", help="Places for the formation's centre, x and y in m; as many as you like.", callback=finite
        ),
    ],
    robot: Robot = None,
) -> tuple[str, Command]:
    """Lead the running formation to other places than planned, by the shortest clear route, without stopping it.

    Exit code 0 when all fly the new path, 1 and the reason if there is none. One robot is sent to one place; then it is 0 when
    the robot is there.

    Example:  groundstation mission go 2.0 -1.5 4.0 0.5
    """
    if len(places) % 2:
        raise typer.BadParameter(f"{len(places)} numbers: each place has two, x and y")
    from groundstation.client import go_command

    try:
        return "go", go_command(list(zip(places[::2], places[1::2], strict=True)), robot or WHOLE_FLEET)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None


@mission_cli.command()
@request
def formation(
    form: Annotated[str, typer.Argument(metavar="FORM", help=f"{FORM_HELP}; shapes: {', '.join(SHAPES)}.")],
) -> tuple[str, Command]:
    """Let the formation take another form: in flight on its way, from a hold before it goes on.

    Exit code 0 when all fly it, 1 and the reason if it cannot be flown.

    Examples:  groundstation mission formation "line 0.8"

               groundstation mission formation "triangle 1.0 turn 30 over 20"
    """
    return "formation", Command(CommandKind.FORMATION, WHOLE_FLEET, text=form)


@mission_cli.command()
@request
def fault(
    what: Annotated[
        str, typer.Argument(metavar="WHAT", help="What breaks, as with --fault, and `for SECONDS`; `repair` mends it all.")
    ],
) -> tuple[str, Command]:
    """Break something in a simulated run, now. The log keeps it, and `sim-bridge sil --from` repeats it, unless a camera or a
    board's link broke.

    Examples:  groundstation mission fault "thruster 2/3 dead"

               groundstation mission fault "marker 1 lost for 5"

               groundstation mission fault repair
    """
    return "fault", Command(CommandKind.FAULT, WHOLE_FLEET, text=what)


@mission_cli.command()
def states() -> None:
    """Print the mission's table: its states, the requests that each allows, and the events that move it.

    Example:  groundstation mission states
    """
    typer.echo(markdown(), nl=False)


class OutcomePrinter:
    """Prints the progress of a request, each fact once."""

    def __init__(self, what: str, as_json: bool) -> None:
        self._what, self._as_json = what, as_json
        self._robots: dict[int, str] = {}
        self._mission = ""

    def progress(self, outcome: Outcome) -> None:
        """Print what is new of an outcome."""
        if self._as_json:
            return
        if outcome.mission != self._mission:
            self._mission = outcome.mission
            typer.echo(printable(f"  mission: {outcome.mission.lower().replace('_', ' ')}"))
        for robot in outcome.confirmed:
            if self._robots.get(robot) != "confirmed":
                self._robots[robot] = "confirmed"
                typer.echo(f"  robot {robot}: confirmed")

    def end(self, reply: Reply, patience_s: float) -> int:
        """Print the outcome. Returns the exit code."""
        from groundstation.client import verdict

        outcome = reply.outcome
        done, text = verdict(reply, patience_s)
        if self._as_json:
            robots = dict.fromkeys(outcome.confirmed, "confirmed") if outcome is not None else {}
            robots |= dict(zip(outcome.waiting, outcome.why, strict=False)) if outcome is not None else {}
            summary = {"order": self._what, "accepted": reply.accepted, "done": done, "text": text, "robots": robots}
            typer.echo(json.dumps(summary | {"reason": reply.reason}))
            return 0 if done else 1
        if outcome is not None and patience_s > 0.0:
            self.progress(outcome)
            for robot, why in zip(outcome.waiting, outcome.why, strict=False):
                typer.echo(printable(f"  robot {robot}: NOT confirmed: {why}"))
        typer.echo(printable(f"{self._what}: {text}"))
        return 0 if done else 1

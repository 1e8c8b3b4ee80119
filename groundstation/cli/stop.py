"""SHELL: `groundstation stop`, the emergency stop of a terminal: it stops first, and complains afterwards.

It is sent to every station of this user on this machine before anything is printed, whatever else is wrong with the command
line, the environment or the keys. What cannot be used is left out, and named at the end.
"""

import json
import os
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from groundstation.cli.mission import HELP, INTERRUPTED, LONGEST_WAIT_S, Station, Wait
from shoal.errors import ConfigError
from shoal.messages.messages import WHOLE_FLEET, Command, CommandKind, Reply
from shoal.runtime.cli_options import DEFAULT_FLEET, DEFAULT_STATION, AsJson, Insecure, KeyRing, fleet_name
from shoal.system.printable import printable

if TYPE_CHECKING:
    from groundstation.station.discovery import RunningStation

NAME = "stop"
COMPLAINTS = "complaints"  # where the command's context keeps what it could not use
GROUPS = ("mission", "order")  # before it, by habit
LATE_S = 10.0  # beyond the patience: for a connection that hangs
HEARD_WITHIN_S = 3.0  # for a station that was named to answer; then those of this machine are stopped too
OnlyFleet = Annotated[
    str | None, typer.Option("--fleet", help="Only stations of this fleet. Default: every fleet.", show_default=False)
]


def _seconds(text: str) -> None:
    if not 0.0 <= float(text) <= LONGEST_WAIT_S:
        raise ValueError(f"must be 0 to {LONGEST_WAIT_S:g} seconds")


def _address(text: str) -> None:
    from shoal.bus.endpoint import parse_address

    parse_address(text)


CHECKS: dict[str, Callable[[str], Any]] = {
    "--station": _address,
    "--fleet": fleet_name,
    "--keys": Path,
    "--wait": _seconds,
}
FLAGS = ("--insecure", "--json", "--help")


def usable_arguments(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """The arguments that `stop` can use, and complaints about the others."""
    kept, complaints, left = list[str](), list[str](), list(arguments)
    while left:
        word = left.pop(0)
        name, joined, value = word.partition("=")
        if word in FLAGS:
            kept.append(word)
        elif name not in CHECKS:
            complaints.append(f"{word!r} means nothing to `stop`")
        elif not joined and (not left or left[0].startswith("--")):
            complaints.append(f"{word} has no value")
        else:
            value = value if joined else left.pop(0)
            try:
                CHECKS[name](value)
                kept += [name, value]
            except (ConfigError, ValueError) as error:
                complaints.append(str(error) if name in str(error) else f"{name} {value!r} cannot be used: {error}")
    return kept, complaints


def without_options(arguments: Sequence[str]) -> list[str]:
    """The words of a command line that are neither options nor the values of options that `stop` has. The word `stop` is never
    taken for a value."""
    words, left = list[str](), list(arguments)
    while left:
        word = left.pop(0)
        if not word.startswith("-"):
            words.append(word)
        elif word in CHECKS and left[:1] != [NAME]:
            del left[:1]
    return words


class StopCommand(TyperCommand):
    """A command that runs whatever its arguments are."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse what can be used."""
        kept, ctx.meta[COMPLAINTS] = usable_arguments(args)
        return super().parse_args(ctx, kept)


class ProgramGroup(TyperGroup):
    """The program's commands. What stands before `stop` is an argument of it; `mission stop` and `order stop` are it too."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the program's own options, after a `stop` has come to the front: all other words are its arguments."""
        words = without_options(args)
        first = next((place for place, word in enumerate(words) if word in self.commands), 0)
        if words[first : first + 1] == [NAME] or words[first : first + 2] in ([group, NAME] for group in GROUPS):
            args = [NAME, *(word for word in args if word not in (NAME, *GROUPS))]
        return super().parse_args(ctx, args)


@dataclass
class StationStop:
    """A stop on its way to one station."""

    station: "RunningStation"
    patience_s: float
    keys: Path | None
    insecure: bool
    reply: Reply | None = None
    trouble: str = "no answer"  # where there is no reply
    complaints: list[str] = field(default_factory=list)
    is_heard: bool = False  # the station has answered
    _thread: threading.Thread | None = None
    _settled: threading.Event = field(default_factory=threading.Event)  # it is heard, or never will be

    def begin(self) -> None:
        """Send it. Returns at once."""
        self._thread = threading.Thread(target=self._send, name="stop", daemon=True)
        self._thread.start()

    def await_answer(self) -> bool:
        """Wait for the station's first answer. Returns whether there was one within HEARD_WITHIN_S."""
        self._settled.wait(HEARD_WITHIN_S)
        return self.is_heard

    def await_end(self) -> None:
        """Wait for the outcome, or the end of the patience."""
        assert self._thread is not None
        self._thread.join(self.patience_s + LATE_S)

    def _send(self) -> None:
        """Send the stop, without keys if those are no good, and note the reply or why there is none."""
        try:
            try:
                self.reply = self._follow(self.keys, self.insecure)
            except ConfigError as error:  # of the keys, or of a network without: all that we send is a stop
                self.complaints.append(str(error))
                self.reply = self._follow(None, True)
        except Exception as error:  # whatever it is: the other stations are stopped all the same
            self.trouble = str(error) or type(error).__name__
        finally:
            self._settled.set()

    def _follow(self, keys: Path | None, insecure: bool) -> Reply:
        """Send the stop and follow it until it is done, or no patience is left."""
        from groundstation import client
        from shoal.bus.network import address_with

        if not self.station.pid:  # nobody knows it here: it is called as its keys have it
            self.station = replace(self.station, endpoint=address_with(keys, self.station.endpoint))
        patience_s = max(self.patience_s, client.ORDER_TIMEOUT_S)
        fleet = self.station.fleet or DEFAULT_FLEET
        with client.connect_for_requests(self.station, fleet, keys, insecure, patience_s) as bus:
            until_s = time.monotonic() + self.patience_s
            request, send = Command(CommandKind.STOP, WHOLE_FLEET), client.sender(bus)

            def ask(command: Command) -> Reply:
                reply = send(command)
                if not reply.silent:
                    self.is_heard = True
                    self._settled.set()
                return reply

            return client.follow(ask, request, lambda: time.monotonic() >= until_s, lambda outcome: None)

    def outcome(self) -> tuple[bool, str]:
        """True if every robot has confirmed, and the outcome in words."""
        from groundstation import client

        return client.verdict(self.reply, self.patience_s) if self.reply is not None else (False, f"NOT HEARD: {self.trouble}")

    @property
    def interrupted(self) -> str:
        """Text about a stop that is waited for no longer."""
        if self.is_heard:
            return f"{NAME}: not waited for; the station goes on with it"
        return f"{NAME}: NOT HEARD: interrupted before the station answered; it may not have got it"

    def print(self, as_json: bool) -> None:
        """Print the outcome, robot by robot."""
        is_done, text = self.outcome()
        outcome = self.reply.outcome if self.reply is not None else None
        robots = dict.fromkeys(outcome.confirmed, "confirmed") if outcome is not None else {}
        missing = dict(zip(outcome.waiting, outcome.why, strict=False)) if outcome is not None else {}
        if as_json:
            station = self.station
            line = {"order": NAME, "station": station.endpoint, "fleet": station.fleet, "done": is_done, "text": text}
            accepted, reason = (self.reply.accepted, self.reply.reason) if self.reply is not None else (False, self.trouble)
            typer.echo(json.dumps(line | {"accepted": accepted, "robots": robots | missing, "reason": reason}))
            return
        typer.echo(printable(f"station {self.station.name}"))
        for robot in robots if self.patience_s else ():
            typer.echo(f"  robot {robot}: confirmed")
        for robot, why in missing.items() if self.patience_s else ():
            typer.echo(printable(f"  robot {robot}: NOT confirmed: {why}"))
        typer.echo(printable(f"{NAME}: {text}"))


def stop(
    ctx: typer.Context,
    station: Station = None,
    fleet: OnlyFleet = None,
    keys: KeyRing = None,
    insecure: Insecure = False,
    wait: Wait = None,
    as_json: AsJson = False,
) -> None:
    """Emergency stop: every robot of every station here to neutral. The help is HELP's."""
    complaints: list[str] = ctx.meta[COMPLAINTS]
    from groundstation import client

    patience_s = client.PATIENCE_S[CommandKind.STOP] if wait is None else wait
    stops: list[StationStop] = []
    unread: OSError | None = None

    def send(stations: "Sequence[RunningStation]") -> None:
        for one in stations:
            stops.append(StationStop(one, patience_s, keys, insecure))
            stops[-1].begin()

    try:
        _send_to_all(station, fleet, complaints, send, stops)
        for one in stops:
            one.await_end()
            try:
                one.print(as_json)
            except OSError as error:  # nobody reads it (`stop | head -1`): the stops of the others are awaited all the same
                unread = error
    except KeyboardInterrupt:
        for one in stops:
            typer.echo(printable(f"station {one.station.name}: {one.interrupted}"), err=True)
        if not stops:
            typer.echo(f"{NAME}: NOT SENT: interrupted before that", err=True)
        sys.stdout.flush()
        os._exit(INTERRUPTED)  # a thread that still connects would abort an interpreter that ends
    for complaint in dict.fromkeys([*complaints, *(text for one in stops for text in one.complaints)]):
        typer.echo(printable(f"left out: {complaint}"), err=True)
    if unread is not None:
        raise unread
    raise typer.Exit(0 if all(one.outcome()[0] for one in stops) else 1)


def _send_to_all(
    station: str | None,
    fleet: str | None,
    complaints: list[str],
    send: "Callable[[Sequence[RunningStation]], None]",
    stops: list[StationStop],
) -> None:
    """Stop what was named: a station, the stations of a fleet, or all. Where nobody answers to that name, stop all that run
    here: a stop that reaches nobody is worse than one that reaches too many."""
    from groundstation.station import discovery
    from groundstation.station.discovery import RunningStation

    here = discovery.running()
    if station is not None:
        named = discovery.named(station)
        send([named if named.pid else replace(named, fleet=fleet or "")])
        others = [one for one in here if one.endpoint != named.endpoint]
        if others and not stops[0].await_answer():
            complaints.append(f"--station {station}: nobody answers there; every station of this machine was stopped")
            send(others)
        return
    chosen = [one for one in here if fleet in (None, one.fleet)]
    if here and not chosen:
        complaints.append(f"--fleet {fleet}: no such station runs here; every station of this machine was stopped")
    send(chosen or here or [RunningStation(DEFAULT_STATION, fleet or DEFAULT_FLEET, "", 0)])


def register_stop(cli: typer.Typer) -> None:
    """Add the command to the program."""
    help_text = f"{HELP[NAME]}\n\n    Example:  groundstation {NAME}"
    cli.command(NAME, cls=StopCommand, help=help_text)(stop)

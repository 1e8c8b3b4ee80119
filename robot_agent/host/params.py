"""SHELL: `robot-agent params`: the parameters of the thruster board, read and written."""

import math
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from shoal.config import LARGEST_ROBOT
from shoal.errors import ConfigError
from shoal.mavlink.board_address import DEFAULT_LINK, LINK_HELP
from shoal.runtime.cli_options import LinkInsecure, LinkKey, finite

if TYPE_CHECKING:
    from shoal.mavlink.board_port import Link
    from shoal.mavlink.parameters import ParameterClient

AGAIN_S = 0.3  # between one question and its repetition
WITHIN_S = 5.0  # for an answer, beyond what a board needs before it speaks
LARGEST = 3.4028234e38  # of single precision, which parameters have on the wire

LinkAddress = Annotated[str, typer.Option("--link", help=LINK_HELP)]
WhichRobot = Annotated[
    int | None, typer.Option("--robot", min=1, max=LARGEST_ROBOT, help="Whose board; default: the one that is heard first.")
]
Name = Annotated[str, typer.Argument(metavar="NAME", help="The parameter's name, for example SLEW_US_S.")]

cli = typer.Typer(help="The thruster board's parameters (docs/board.md). They change only while it is disarmed.")


class ParameterSession:
    """Link to a board and the client that talks over it."""

    def __init__(self, link: "Link", client: "ParameterClient") -> None:
        self._link, self.client = link, client

    def until(self, done: Callable[[], bool], ask: Callable[[], bytes]) -> bool:
        """Repeat a request until `done()`. Returns False after WITHIN_S without success."""
        end_s = time.monotonic() + WITHIN_S + (0.0 if self.client.has_answered else self._link.first_word_s)
        asked_s = 0.0
        while time.monotonic() < end_s:
            if time.monotonic() - asked_s > AGAIN_S:
                asked_s = time.monotonic()
                self._link.send(self.client.heartbeat() + ask())
            self._link.wait(0.05)
            self.client.receive(self._link.read(), time.monotonic_ns())
            if done():
                return True
        return False

    def has(self, name: str, value: float) -> bool:
        """True if the board has told this value, as single precision holds it."""
        return abs(self.client.values.get(name, math.inf) - value) <= 1e-6 * max(abs(value), 1.0)

    def set(self, name: str, value: float) -> bool:
        """Ask for another value; True once the board has it, False if it refuses or does not answer."""
        client = self.client
        done = self.until(lambda: client.error is not None or self.has(name, value), lambda: client.set(name, value))
        return done and client.error is None


@contextmanager
def talk(link: str, robot: int | None, key: Path | None, insecure: bool) -> Iterator[ParameterSession]:
    """A session with a board that is heard. Raises ConfigError with the reason if none is."""
    from shoal.mavlink.board_port import open_link
    from shoal.mavlink.parameters import LINK_ID, ParameterClient
    from shoal.mavlink.signing_key import Signing

    signing = Signing.of(key, "params", LINK_ID) if key is not None else None
    client = ParameterClient(robot) if signing is None else ParameterClient(robot, signing.key, signing.stamps)
    wires = open_link(link, secured=signing is not None or insecure)
    try:
        session = ParameterSession(wires, client)
        session.until(lambda: client.autopilot is not None, lambda: b"")
        if (reason := client.objection(wires.trouble)) or client.robot_id is None:
            raise ConfigError(f"--link {link}: {reason or 'what is there does not say which board it is'}")
        yield session
    finally:
        wires.close()


@cli.command("list")
def list_all(
    link: LinkAddress = DEFAULT_LINK, robot: WhichRobot = None, key: LinkKey = None, insecure: LinkInsecure = False
) -> None:
    """Print all parameters, one a line: name, value.

    Example:  robot-agent params list --link serial:/dev/serial/by-id/NAME
    """
    with talk(link, robot, key, insecure) as session:
        if not session.until(lambda: session.client.complete, session.client.ask_all):
            raise ConfigError(f"--link {link}: the board told {len(session.client.values)} parameters, and then no more")
        for name, value in session.client.values.items():
            typer.echo(f"{name:16} {value:.7g}")


@cli.command()
def get(
    name: Name, link: LinkAddress = DEFAULT_LINK, robot: WhichRobot = None, key: LinkKey = None, insecure: LinkInsecure = False
) -> None:
    """Print one parameter's value.

    Example:  robot-agent params get SLEW_US_S --link serial:/dev/serial/by-id/NAME
    """
    _check_name(name)
    with talk(link, robot, key, insecure) as session:
        client = session.client
        session.until(lambda: name in client.values or client.error is not None, lambda: client.ask(name))
        typer.echo(f"{answered_value(client, name):.7g}")


@cli.command("set")
def set_one(
    name: Name,
    value: Annotated[float, typer.Argument(metavar="VALUE", help="Its new value.", callback=finite)],
    link: LinkAddress = DEFAULT_LINK,
    robot: WhichRobot = None,
    key: LinkKey = None,
    insecure: LinkInsecure = False,
) -> None:
    """Give a parameter another value. Exit code 2 if the board refuses it, with the reason.

    Example:  robot-agent params set THR1_TRIM_US -- -12
    """
    _check_name(name)
    if not abs(value) <= LARGEST:  # as NaN is not
        raise ConfigError(f"{name} {value:g}: no value for a parameter (allowed: numbers up to {LARGEST:g})")
    with talk(link, robot, key, insecure) as session:
        done, client = session.set(name, value), session.client
        now = answered_value(client, name)
        if not done:
            raise ConfigError(f"{name} is still {now:.7g}: {client.last_words or 'the board does not say why'}")
        typer.echo(f"{name} = {now:.7g}")


@cli.command("give-key")
def give_key(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The key: `robot-agent link-key FILE` makes one.")],
    link: LinkAddress = DEFAULT_LINK,
    robot: WhichRobot = None,
) -> None:
    """Give a board that has no key this one: from then on it takes only what is signed with it.

    Over a cable, and disarmed: every reader of the wire learns the key. A board that has a key keeps it.

    Example:  robot-agent params give-key robot-1.key --link serial:/dev/serial/by-id/NAME
    """
    from shoal.mavlink.parameters import LINK_ID
    from shoal.mavlink.signing_key import Signing

    signing = Signing.of(file, "params", LINK_ID)
    with talk(link, robot, None, insecure=False) as session:
        client, newest = session.client, signing.stamps()
        session.until(
            lambda: client.signed or client.last_words.startswith("no new key"), lambda: client.give(signing.key, newest)
        )
        if client.last_words.startswith("no new key"):
            raise ConfigError(f"--link {link}: {client.last_words}")
        robot = client.robot_id
    with talk(link, robot, file, insecure=False) as session:
        if not session.until(lambda: session.client.value_count > 0, session.client.ask_all):
            raise ConfigError(f"--link {link}: the board does not answer to the key")
    typer.echo(f"robot {robot}: the link is signed with {file}")


def _check_name(name: str) -> None:
    if not re.fullmatch(r"[!-~]{1,16}", name):
        raise ConfigError(
            f"{name!r}: no parameter's name (allowed: 1 to 16 ASCII characters, as `robot-agent params list` has them)"
        )


def answered_value(client: "ParameterClient", name: str) -> float:
    """Value of a parameter as the board has told it. Raises ConfigError with the reason if it has not."""
    if name not in client.values:
        raise ConfigError(f"{name}: {_refusal(client)}")
    return client.values[name]


def _refusal(client: "ParameterClient") -> str:
    """Text about a missing value."""
    from shoal.mavlink.parameters import DOES_NOT_EXIST

    if client.error is None:
        return "no answer"
    if client.error[1] == DOES_NOT_EXIST:
        return "the board has no such parameter"
    return f"the board refuses: {client.last_words or f'error {client.error[1]}'}"

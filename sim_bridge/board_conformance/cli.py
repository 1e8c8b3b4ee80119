"""SHELL: `sim-bridge board-conformance`: a lab's own thruster board against the rules of docs/board.md."""

import json
import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from shoal.errors import ConfigError
from shoal.runtime.cli_options import LinkInsecure, LinkKey
from shoal.runtime.runtime import signals_raise

if TYPE_CHECKING:
    from shoal.mavlink.board_port import Link, UdpLink
    from shoal.mavlink.parameters import ParameterClient
    from sim_bridge.board_conformance.probe import BoardWire
    from sim_bridge.board_conformance.runner import RuleResult

HEARD_WITHIN_S = 5.0
STRANGERS = 9  # peers without a key; more than the board has places for
CAREFUL = "Thrusters will turn slowly, each way; on a board that is wrong, perhaps fast. Are all hands away from them?"


class LinkWire:
    """The `BoardWire` of a real link, by the monotonic clock."""

    def __init__(self, link: "Link") -> None:
        self._link = link
        self._others: list[UdpLink] = []

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def send(self, data: bytes) -> None:
        self._link.send(data)

    def receive(self, until_ns: int) -> bytes:
        self._link.wait((until_ns - time.monotonic_ns()) * 1e-9)
        return self._link.read()

    def strangers(self) -> tuple[Callable[[], None], Callable[[], int]] | None:
        """See `BoardWire`: over UDP STRANGERS peers, at ports of their own; a serial line has one other end."""
        from shoal.mavlink.board_port import UdpLink

        link = self._link
        if not isinstance(link, UdpLink):
            return None
        self._others = self._others or [UdpLink(*link.address) for _ in range(STRANGERS)]

        def send_bytes() -> None:
            for other in self._others:
                other.send(b"x")

        def count_answered() -> int:
            return sum(bool(other.read()) for other in self._others)

        return send_bytes, count_answered

    def close(self) -> None:
        """Close the links that `strangers` opened."""
        for other in self._others:
            other.close()


def board_conformance(
    port: Annotated[str, typer.Option(help="Where the board is: a serial device, serial:DEVICE:BAUD or udp:HOST:PORT.")],
    robot: Annotated[int | None, typer.Option(help="The board's system id; default: of the board that is heard.")] = None,
    key: LinkKey = None,
    insecure: LinkInsecure = False,
    dry: Annotated[bool, typer.Option("--dry", help="Command no thrust, and leave out the rules that need it.")] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before thrusters may turn.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Try every rule of docs/board.md on a thruster board, and say what was measured. Takes about a minute.

    The robot's own computer must be off the link. Parameters that are changed on the way are put back, however it ends.
    Exit code 0 if no rule failed, 1 if one did.

    Example:  sim-bridge board-conformance --port /dev/serial/by-id/NAME --dry
    """
    from shoal.mavlink.board_port import open_link
    from shoal.mavlink.parameters import ParameterClient
    from shoal.mavlink.signing_key import Signing
    from sim_bridge.board_conformance.probe import BoardProbe
    from sim_bridge.board_conformance.rules import RULES
    from sim_bridge.board_conformance.runner import RuleVerdict, examine

    if not dry and not yes and not typer.confirm(CAREFUL, err=True):
        raise ConfigError("nothing was tried (allowed: with all hands away; --dry tries every rule that needs no thrust)")
    signing = Signing.of(key, "conformance") if key is not None else None
    address = port if port.startswith(("udp:", "serial:")) else f"serial:{port}"
    link = open_link(address, secured=signing is not None or insecure, option="--port")
    wire = LinkWire(link)
    try:
        client = ParameterClient(robot) if signing is None else ParameterClient(robot, signing.key, signing.stamps)
        _listen(wire, client, link.first_word_s)
        if (reason := client.objection(link.trouble)) or client.robot_id is None:
            raise ConfigError(f"--port {port}: {reason or 'what is there does not say which board it is'}")
        robot = client.robot_id
        if _in_hil(wire, client):
            raise ConfigError(
                f"--port {port}: the board is in HIL mode and measures nothing itself "
                f"(allowed: after a loss of power, or robot-agent params set HIL_MODE 0 --link {address})"
            )
        probe = BoardProbe(wire, robot) if signing is None else BoardProbe(wire, robot, signing.key, signing.stamps)
        with signals_raise():
            outcomes = list(_print_results(examine(probe, dry, RULES), quiet=as_json))
    finally:
        wire.close()
        link.close()
    failed = sum(outcome.verdict is RuleVerdict.FAILED for outcome in outcomes)
    if as_json:
        rows = [{**asdict(outcome), "verdict": outcome.verdict.name.lower()} for outcome in outcomes]
        typer.echo(json.dumps({"board": robot, "dry": dry, "failed": failed, "rules": rows}, indent=1))
    else:
        skipped = sum(outcome.verdict is RuleVerdict.SKIPPED for outcome in outcomes)
        typer.echo(f"board {robot}: {len(outcomes) - failed - skipped} passed, {failed} failed, {skipped} skipped")
    raise typer.Exit(1 if failed else 0)


def _listen(wire: "BoardWire", client: "ParameterClient", first_word_s: float) -> None:
    """Listen until a heartbeat says what is there, for HEARD_WITHIN_S at most beyond what it needs to speak."""
    _ask(wire, client, client.heartbeat, lambda: client.autopilot is not None, HEARD_WITHIN_S + first_word_s)


def _in_hil(wire: "BoardWire", client: "ParameterClient") -> bool:
    """True if the board says that it is in HIL mode."""

    def is_over() -> bool:
        return "HIL_MODE" in client.values or client.error is not None

    _ask(wire, client, lambda: client.ask("HIL_MODE"), is_over, HEARD_WITHIN_S)
    return client.values.get("HIL_MODE") == 1.0


def _ask(
    wire: "BoardWire", client: "ParameterClient", question: Callable[[], bytes], is_over: Callable[[], bool], within_s: float
) -> None:
    """Listen until `is_over`, for so long at most, and ask each second: a question or its answer may be lost."""
    end_ns, asked_ns = wire.now_ns() + round(within_s * 1e9), -math.inf
    while not is_over() and wire.now_ns() < end_ns:
        if wire.now_ns() - asked_ns > 1e9:
            asked_ns = wire.now_ns()
            wire.send(question())
        client.receive(wire.receive(wire.now_ns() + 50_000_000), wire.now_ns())


def _print_results(outcomes: "Iterable[RuleResult]", quiet: bool) -> "Iterator[RuleResult]":
    """Print each result as it comes, and pass it on."""
    from sim_bridge.board_conformance.runner import RuleVerdict

    colours = {RuleVerdict.PASSED: "green", RuleVerdict.FAILED: "red", RuleVerdict.SKIPPED: None}
    for outcome in outcomes:
        if not quiet:
            verdict = typer.style(f"{outcome.verdict.value:8}", fg=colours[outcome.verdict])
            typer.echo(f"{outcome.rule:18}{verdict} {outcome.measured:32} {outcome.requirement}")
        yield outcome

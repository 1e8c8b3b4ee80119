"""SHELL: `groundstation deploy`: the agent, its keys and its experiment onto the robots' boards."""

import shlex
from pathlib import Path
from typing import Annotated

import typer

from shoal.errors import ConfigError
from shoal.mavlink.board_address import DEFAULT_LINK, LINK_HELP
from shoal.runtime.cli_options import DEFAULT_FLEET, FleetName, Insecure, KeyRing, Settings
from shoal.runtime.output import terminal


def deploy(
    boards: Annotated[list[str], typer.Argument(metavar="[USER@]HOST=ROBOT", help="Boards, and which robot each is.")],
    station: Annotated[str, typer.Option(metavar="ENDPOINT", help="Where robots find the station: tls/192.0.2.10:7447.")],
    experiment: Annotated[str, typer.Option(help="What is flown: a shipped experiment, or a path.")] = "pool",
    settings: Settings = None,
    fleet: FleetName = DEFAULT_FLEET,
    link: Annotated[str, typer.Option(help=f"{LINK_HELP} The same on every robot.")] = DEFAULT_LINK,
    link_key: Annotated[str | None, typer.Option(metavar="FILE", help="What signs that link: a file on the board.")] = None,
    home: Annotated[str, typer.Option(help="Folder on the board; the user must be able to write it.")] = "/opt/shoal",
    keys: KeyRing = None,
    insecure: Insecure = False,
    wheelhouse: Annotated[Path | None, typer.Option(metavar="FOLDER", help="Ready-made wheels; default: made here.")] = None,
    ssh: Annotated[str, typer.Option(help="The ssh command, with options.")] = "ssh",
    restart: Annotated[bool, typer.Option(help="Restart the service where something has changed.")] = True,
    force: Annotated[bool, typer.Option("--force", help="Restart also where the robot is armed: it disarms.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would change, and change nothing.")] = False,
) -> None:
    """Bring robots' boards up to date over SSH: software, certificates, experiment, settings, service.

    What is there already does not travel; a board where nothing has changed is not touched. A robot that is not disarmed is
    refused. Exit code 1 if one has failed.

    Examples:  groundstation deploy pi@192.0.2.21=1 pi@192.0.2.22=2 --station tls/192.0.2.10:7447 --keys keys
               groundstation deploy pi@192.0.2.21=1 --station tls/192.0.2.10:7447 --keys keys --dry-run
    """
    from rich.table import Table
    from rich.text import Text

    from groundstation.deploy.manifest import parse_targets
    from groundstation.deploy.ssh import DeployRequest, check, deploy_all
    from shoal.config.experiment import load_experiment

    targets = parse_targets(boards)
    loaded = load_experiment(experiment, settings or ())
    command = _command(ssh)
    request = DeployRequest(
        loaded, station, fleet, link, link_key, home, keys, insecure, wheelhouse, command, restart, dry_run, force
    )
    check(targets, request)
    table = Table("board", "robot", "would change" if dry_run else "changed", "version", "service")
    failed, notes = False, []
    for outcome in deploy_all(targets, request):
        failed |= bool(outcome.trouble)
        what: Text | str = Text(outcome.trouble, "red") if outcome.trouble else ", ".join(outcome.changed) or "nothing"
        table.add_row(outcome.target.host, str(outcome.target.robot), what, outcome.version, outcome.service)
        notes += [Text(f"{outcome.target.host}: {outcome.note}", "yellow")] if outcome.note else []
    terminal().print(table, *notes)
    raise typer.Exit(1 if failed else 0)


def _command(text: str) -> tuple[str, ...]:
    """Words of the command that is given with --ssh. Raises ConfigError if there are none."""
    try:
        words = tuple(shlex.split(text))
    except ValueError as error:
        raise ConfigError(f"--ssh {text!r}: no command: {error}") from None
    if not words:
        raise ConfigError("--ssh '': no command (default: ssh)")
    return words

"""SHELL: `robot-agent init`, `unit`, `compile` and `check`: configuration, service and preflight of a robot's computer."""

import re
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from robot_agent.host.board_zero import FILE, SERVICE_FOLDER, confirmed, state_folder, write_record
from shoal.config import LARGEST_ROBOT
from shoal.errors import ConfigError, os_errors_as_config_errors
from shoal.mavlink.board_address import DEFAULT_LINK, LINK_HELP, parse_link
from shoal.runtime.cli_options import DEFAULT_FLEET, FleetName
from shoal.runtime.output_files import check_output, replace_text
from shoal.runtime.runtime import start_log

if TYPE_CHECKING:
    from robot_agent.preflight.findings import CheckFinding
    from shoal.config.experiment import Experiment

ConfigFile = Annotated[Path, typer.Option("--config", metavar="FILE", help="The board's configuration (`robot-agent init`).")]
DEFAULT_CONFIG = Path("agent.toml")
COLOURS = {"ok": "green", "warn": "yellow", "FAIL": "red", "skipped": None}  # by verdict
UNIT_NAME = "shoal-agent.service"
CAREFUL = "Each thruster will turn, and each ankle. Is the robot free, and are all hands away from it?"


def init(
    robot: Annotated[int, typer.Option(min=1, max=LARGEST_ROBOT, help="Which robot of the experiment this is.")],
    station: Annotated[str, typer.Option(metavar="ENDPOINT", help="Where the station's router listens.")],
    experiment: Annotated[
        str, typer.Option(help="What is flown: a shipped experiment, or a path, relative to the file.")
    ] = "pool",
    fleet: FleetName = DEFAULT_FLEET,
    link: Annotated[str, typer.Option(help=LINK_HELP)] = DEFAULT_LINK,
    link_key: Annotated[str | None, typer.Option(metavar="FILE", help="What signs the link, relative to the file.")] = None,
    keys: Annotated[str | None, typer.Option(metavar="FOLDER", help="The key ring, relative to the file.")] = None,
    insecure: Annotated[bool, typer.Option("--insecure", help="An open network, without keys.")] = False,
    out: Annotated[Path, typer.Option(metavar="FILE", help="Where to write it.")] = DEFAULT_CONFIG,
    force: Annotated[bool, typer.Option("--force", help="Write over a file that is there.")] = False,
) -> None:
    """Write a commented configuration for this board.

    Example:  robot-agent init --robot 2 --station tls/192.0.2.10:7447 --keys keys
    """
    from robot_agent.host.config import merge_config, template
    from shoal.bus.endpoint import parse_address
    from shoal.bus.network import refuse_open
    from shoal.config.experiment import load_experiment

    parse_address(station)
    if keys is None:
        refuse_open(station, insecure)
    parse_link(link)
    if not experiment.endswith(".toml"):  # a file may be brought later
        load_experiment(experiment).robot(robot)
    given = {"experiment": experiment, "robot": robot, "link": link, "station": station, "fleet": fleet}
    board = merge_config({**given, "link_key": link_key, "keys": keys, "insecure": insecure}, None)
    with os_errors_as_config_errors(out):
        if out.exists() and not force:
            raise ConfigError(f"{out}: is there already (--force writes over it)")
        check_output(out, [Path(given) for given in (experiment, link_key) if given is not None])
        replace_text(out, template(out.name, board))
    typer.echo(f"{out}: written; `robot-agent check --config {out}` looks the board over")


def unit(
    home: Annotated[str, typer.Option(help="Folder with venv/ and agent.toml.")] = "/opt/shoal",
    user: Annotated[str, typer.Option(help="Whom the program runs as.")] = "shoal",
) -> None:
    """Print the systemd unit that runs the agent on a board.

    Example:  robot-agent unit --user pi | sudo tee /etc/systemd/system/shoal-agent.service
    """
    typer.echo(unit_text(home, user), nl=False)


def unit_text(home: str, user: str) -> str:
    """Systemd unit of an agent that is installed in `home` and runs as `user`. Raises ConfigError for a folder or a user that
    systemd would misread."""
    if not re.fullmatch(r"/[\w./-]+", home):
        raise ConfigError(f"{home!r}: not a folder for a unit file (allowed: an absolute path of letters, digits, . _ - /)")
    if not re.fullmatch(r"[a-z_][\w-]*", user):
        raise ConfigError(f"{user!r}: not a user's name")
    template = resources.files("robot_agent.host") / "templates" / UNIT_NAME
    return template.read_text(encoding="utf-8").replace("@HOME@", home.rstrip("/")).replace("@USER@", user)


def compile_kernels(
    clear: Annotated[bool, typer.Option("--clear", help="Remove all that was compiled, as before `pip uninstall`.")] = False,
) -> None:
    """Compile the numeric kernels that are not in the cache yet, so that no start of the agent has to.

    Half a minute on a quick machine, some minutes on a small board, where 250 MB of memory are enough; nothing if all are
    there. The cache is the folder that NUMBA_CACHE_DIR names, else the installation itself, else the user's cache. The service
    has its own: `groundstation deploy` fills it; by hand, as the service's user, after each installation:

    Example:  NUMBA_CACHE_DIR=/var/lib/shoal-agent/kernels robot-agent compile
    """
    from shoal.kernels import cache as kernel_cache
    from shoal.kernels.build import ensure_compiled

    if clear:
        for folder in kernel_cache.clear():
            typer.echo(f"{folder}: {'cannot be removed' if folder.exists() else 'removed'}")
        return
    start_log("compile")
    outcome = ensure_compiled(("robot_agent",))
    if not outcome.is_complete:
        raise typer.Exit(1)
    typer.echo(f"{outcome.compiled} kernels compiled")


def confirm_zero(
    config: ConfigFile = DEFAULT_CONFIG,
    in_air: Annotated[bool, typer.Option("--in-air", help="The robot is in air: the board takes its zero anew.")] = False,
    folder: Annotated[
        Path | None, typer.Option("--state", metavar="FOLDER", help=f"The service's state; default: {SERVICE_FOLDER}.")
    ] = None,
) -> None:
    """Confirm the thruster board's depth zero, after a restart under way: then the robot may arm.

    For a robot that refuses to arm because the zero is in question: its depth as `robot-agent check` shows it is right, or the
    robot is in air and the board is to take the zero anew (`--in-air`). The service passes it on to the board. Without the
    service this opens the link of `--config`.

    Example:  sudo robot-agent confirm-zero
    """
    from robot_agent.host.config import load_agent_config
    from robot_agent.host.zero_request import ask_program, only_request, tell_board
    from shoal.mavlink.agent_link import CALIBRATE, UNSUPPORTED

    where = folder or state_folder() or SERVICE_FOLDER
    with os_errors_as_config_errors(where / FILE), only_request(where):
        if not ask_program(where, in_air):
            telemetry = tell_board(load_agent_config(config), in_air)
            if (where / FILE).exists():
                if telemetry.board_ms < 0:
                    raise ConfigError("the board reports no depth: try again")
                write_record(where, confirmed(telemetry), durable=True)
            elif telemetry.acknowledged == (CALIBRATE, UNSUPPORTED):
                raise ConfigError("the board keeps no zero that could be confirmed: restart it in air")
    typer.echo("the thruster board takes its depth zero anew" if in_air else "the thruster board's depth zero is confirmed")


def check(
    config: ConfigFile = DEFAULT_CONFIG,
    thrusters: Annotated[
        bool, typer.Option("--thrusters", help="Move each thruster and ankle a little, asking what was seen.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="With --thrusters: do not ask.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Look this board over: software, experiment, devices, permissions, certificate, station, clock, CPU, thrusters.

    Exit code 0 if nothing has failed, 1 if something has.

    Example:  robot-agent check --json
    """
    from robot_agent.host.config import load_agent_config
    from robot_agent.preflight.board import run_preflight
    from robot_agent.preflight.findings import exit_code, to_json
    from robot_agent.preflight.thrusters import turn_thrusters

    start_log("check")
    board = load_agent_config(config)
    if thrusters and not yes and not typer.confirm(CAREFUL, err=True):
        thrusters = False

    def ask(question: str) -> bool:
        return typer.confirm(question, default=None, err=True)  # a hand that only hits Enter has said nothing

    def turn(experiment: "Experiment") -> "Iterator[CheckFinding]":
        return turn_thrusters(experiment, board, None if yes else ask)

    findings = []
    for finding in run_preflight(board, turn if thrusters else None):
        findings.append(finding)
        if not json:
            verdict = finding.verdict.value
            typer.echo(f"{finding.what:16}{typer.style(f'{verdict:9}', fg=COLOURS[verdict])}{finding.detail}")
    if json:
        typer.echo(to_json(findings))
    raise typer.Exit(exit_code(findings))

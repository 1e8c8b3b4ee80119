"""SHELL: `robot-agent`: the program on a robot's computer."""

from pathlib import Path
from typing import Annotated

import typer

from robot_agent.commands import check, compile_kernels, confirm_zero, init, unit
from robot_agent.host.params import cli as params
from robot_agent.preflight.identify import cli as identify
from shoal.mavlink.board_address import DEFAULT_LINK, LINK_HELP
from shoal.runtime.cli_options import (
    DEFAULT_FLEET,
    DEFAULT_STATION,
    Insecure,
    KeyRing,
    LinkInsecure,
    LinkKey,
    Settings,
    Verbose,
    Version,
    live_fleet,
)
from shoal.runtime.runtime import Stop, log, run_app, start_log

cli = typer.Typer(
    help="The program on a robot's board: poses in, pulses for thrusters and ankles out.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


@cli.callback()
def main(version: Version = False) -> None:
    """The program on a robot's board."""


cli.command()(init)
cli.command()(unit)
cli.command("compile")(compile_kernels)
cli.command()(check)
cli.command()(confirm_zero)


cli.add_typer(params, name="params")
cli.add_typer(identify, name="identify")


@cli.command()
def run(
    experiment: Annotated[
        str | None, typer.Argument(metavar="EXPERIMENT", help="A shipped experiment, or a path ending in .toml.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The board's configuration (`robot-agent init`); options go before it.")
    ] = None,
    robot: Annotated[int | None, typer.Option(help="Which robot of the experiment this is.")] = None,
    link: Annotated[str | None, typer.Option(help=LINK_HELP, show_default=DEFAULT_LINK)] = None,
    link_key: LinkKey = None,
    link_insecure: LinkInsecure = False,
    station: Annotated[
        str | None, typer.Option(metavar="ENDPOINT", help="Where the station's router listens.", show_default=DEFAULT_STATION)
    ] = None,
    fleet: Annotated[
        str | None, typer.Option(callback=live_fleet, help="Name of the fleet.", show_default=DEFAULT_FLEET)
    ] = None,
    settings: Settings = None,
    keys: KeyRing = None,
    insecure: Insecure = False,
    verbose: Verbose = False,
) -> None:
    """Fly one robot. Starts disarmed, waits for the station, and puts out neutral pulses until it is told to arm and start.

    Examples on a board:  robot-agent run pool --robot 1 --station tls/192.0.2.10:7447 --keys keys
                          robot-agent run --config /etc/shoal/agent.toml
    """
    from robot_agent.host import realtime
    from robot_agent.host.config import merge_config, open_board_link
    from robot_agent.host.sd_notify import ServiceNotifier
    from robot_agent.node import AgentNode
    from shoal.bus.bus import Bus
    from shoal.bus.network import endpoint
    from shoal.bus.zenoh_transport import ZenohTransport, receive_on_one_thread
    from shoal.config.experiment import load_experiment
    from shoal.messages.topics import Role, process_name

    given = {
        "experiment": experiment,
        "robot": robot,
        "link": link,
        "link_key": None if link_key is None else str(link_key),
        "link_insecure": link_insecure or None,
        "station": station,
        "fleet": fleet,
        "settings": settings,
        "keys": None if keys is None else str(keys),
        "insecure": insecure or None,
    }
    board = merge_config(given, config)
    start_log(f"agent-{board.robot}", verbose)
    stop = Stop()
    loaded = load_experiment(board.experiment, board.settings)
    loaded.robot(board.robot)
    ring = None if board.keys is None else Path(board.keys)
    me = process_name(Role.ROBOT, board.robot)
    where = endpoint(board.station, me, ring, insecure=board.insecure)
    (wires, signing), watchdog = open_board_link(board), ServiceNotifier()
    if wires.trouble:  # said before the station is waited for, which may take long
        log.warning("thruster board: %s", wires.trouble)
    try:
        receive_on_one_thread()
        with Bus(ZenohTransport(where, stop), board.fleet) as bus:
            bus.claim(me, stop)
            for refused in realtime.apply(board.realtime):
                log.warning("real time: %s", refused)
            node = AgentNode(loaded, board.robot, bus, wires, stop, watchdog, signing)
            realtime.settle()
            node.run()
    finally:
        watchdog.stopping()
        wires.close()


@cli.command()
def link_key(file: Annotated[Path, typer.Argument(metavar="FILE", help="Where to write it.")]) -> None:
    """Make a key for signing the link to a thruster board. Board and agent get the same; no two boards share one.

    Example:  robot-agent link-key board-1.key
    """
    from shoal.mavlink.signing_key import new_key

    new_key(file)
    typer.echo(f"{file}: a new key, for its owner's eyes only")


@cli.command()
def modes() -> None:
    """Print the tables of modes and guidance states: which order is accepted when, and what a robot does by itself.

    Example:  robot-agent modes
    """
    from robot_agent.safety import guidance_states
    from robot_agent.safety.modes import table

    typer.echo(table() + "\n" + guidance_states.table(), nl=False)


def app() -> None:
    """Entry point."""
    run_app(cli)


if __name__ == "__main__":
    app()

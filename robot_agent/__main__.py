"""SHELL: `robot-agent`: what runs on a robot's board."""

import sys
from typing import Annotated

import typer

from wire.experiment import load_experiment
from wire.options import (
    DEFAULT_FLEET,
    DEFAULT_STATION,
    ExperimentName,
    FleetName,
    Insecure,
    KeyRing,
    LockstepMode,
    Settings,
    StationAddress,
    Verbose,
)
from wire.runtime import Stop, run_app, start_log

cli = typer.Typer(
    help="The program on a robot's board: poses in, pulses for thrusters and ankles out.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


@cli.command()
def run(
    experiment: ExperimentName,
    robot: Annotated[int, typer.Option(help="Which robot of the experiment this is.")],
    link: Annotated[
        str, typer.Option(help="The thruster board: udp:HOST:PORT or serial:DEVICE[:BAUD].")
    ] = "serial:/dev/ttyACM0:115200",
    station: StationAddress = DEFAULT_STATION,
    fleet: FleetName = DEFAULT_FLEET,
    settings: Settings = None,
    lockstep: LockstepMode = False,
    keys: KeyRing = None,
    insecure: Insecure = False,
    verbose: Verbose = False,
) -> None:
    """Fly one robot. Starts disarmed, waits for the station, and puts out neutral pulses until it is told to arm and start.

    Example on a board:  robot-agent run pool --robot 1 --station tls/192.168.1.10:7447 --keys keys
    """
    from robot_agent.link import open_link
    from robot_agent.shell import Shell
    from wire.bus import Bus
    from wire.network import endpoint
    from wire.topics import Role, process_name
    from wire.transport import ZenohTransport

    start_log(f"agent-{robot}", verbose)
    stop = Stop()
    loaded = load_experiment(experiment, settings or ())
    loaded.robot(robot)
    where = endpoint(station, process_name(Role.ROBOT, robot), keys, insecure=insecure, lossless=lockstep)
    wires = open_link(link)
    try:
        with Bus(ZenohTransport(where, stop), fleet) as bus:
            Shell(loaded, robot, bus, wires, lockstep, stop).run()
    finally:
        wires.close()


@cli.command(hidden=True)
def rerun(
    experiment: ExperimentName,
    robot: Annotated[int, typer.Option(help="Which robot of the experiment this is.")],
    settings: Settings = None,
) -> None:
    """Do a robot's control steps again on what comes through stdin, and say on stdout what came of them.

    For `groundstation rerun`, which reads a log and compares.
    """
    from robot_agent.rerun import Rerun
    from wire.pipe import PipeWriter, read_pipe

    said = PipeWriter(sys.stdout.buffer, session=1)
    for topic, message, stamp_ns in Rerun(load_experiment(experiment, settings or ()), robot).run(read_pipe(sys.stdin.buffer)):
        said.publish(topic, message, stamp_ns, robot)


@cli.command()
def modes() -> None:
    """Print the tables of modes: which order is accepted when, and what a robot does by itself."""
    from robot_agent.mode import table

    typer.echo(table(), nl=False)


def app() -> None:
    """Entry point."""
    run_app(cli)


if __name__ == "__main__":
    app()

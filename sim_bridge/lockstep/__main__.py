"""SHELL: `python -m sim_bridge.lockstep station|agent|localizer|fuse`: the nodes of the other programs by the simulator's
clock, each in a process of its own. `sim-bridge sil` starts them beside `sim-bridge pool --lockstep`; nobody types this."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from shoal.config.experiment import load_experiment
from shoal.runtime.cli_options import (
    DEFAULT_FLEET,
    DEFAULT_STATION,
    DEFAULT_WEB,
    ExperimentName,
    FrameRingOption,
    KeyRing,
    ListenAddress,
    StationAddress,
    WebAddress,
)
from shoal.runtime.optional_packages import require, run_role
from shoal.runtime.runtime import Stop, log, run_app, run_steps, start_log

cli = typer.Typer(help="Nodes by the simulator's clock.", no_args_is_help=True, pretty_exceptions_enable=False)


@cli.command()
def station(
    experiment: ExperimentName,
    run_dir: Annotated[Path, typer.Option(help="The run's folder, without a log so far.")],
    auto: Annotated[bool, typer.Option("--auto", help="Load, arm, start and finish without being asked.")] = False,
    give_up: Annotated[float | None, typer.Option(help="With --auto: fail after so long without progress.")] = None,
    listen: ListenAddress = DEFAULT_STATION,
    keys: KeyRing = None,
    web: WebAddress = DEFAULT_WEB,
    no_web: Annotated[bool, typer.Option("--no-web", help="Serve no page.")] = False,
) -> None:
    """Run the ground station."""
    require("matplotlib", "jinja2")  # of the report
    from groundstation.gate.gate import Gate
    from groundstation.station import process
    from groundstation.station.discovery import announced
    from shoal.bus.bus import Bus
    from shoal.bus.network import endpoint
    from shoal.bus.zenoh_transport import ZenohTransport
    from shoal.messages.topics import Role, process_name
    from shoal.runtime.web_access import web_options
    from sim_bridge.lockstep.station import simulated_time

    loaded, page = load_experiment(experiment), None if no_web else web_options(web)
    start_log("groundstation")
    stop, me = Stop(), process_name(Role.STATION)
    where = endpoint(listen, me, keys, router=True, lossless=True)
    with Bus(ZenohTransport(where, stop, gate=Gate)) as bus, announced(where, DEFAULT_FLEET, loaded.name, bus):
        bus.claim(me, stop)
        options = process.StationOptions(auto, give_up, page)
        succeeded = run_steps(process.cycles(loaded, bus, run_dir, options, stop, simulated_time(bus, stop)))
    raise typer.Exit(0 if succeeded else 1)


@cli.command()
def agent(
    experiment: ExperimentName,
    robot: Annotated[int, typer.Option(help="Which robot of the experiment this is.")],
    link: Annotated[str, typer.Option(help="The thruster board.")],
    link_key: Annotated[Path | None, typer.Option(help="What signs the link.")] = None,
    station: StationAddress = DEFAULT_STATION,
    keys: KeyRing = None,
) -> None:
    """Run one robot's agent."""
    from robot_agent.host.config import merge_config, open_board_link
    from shoal.bus.bus import Bus
    from shoal.bus.network import endpoint
    from shoal.bus.zenoh_transport import ZenohTransport, receive_on_one_thread
    from shoal.messages.topics import Role, process_name
    from sim_bridge.lockstep.agent import agent_in_lockstep

    start_log(f"agent-{robot}")
    loaded, stop, me = load_experiment(experiment), Stop(), process_name(Role.ROBOT, robot)
    given = {"experiment": experiment, "robot": robot, "link": link, "link_key": str(link_key) if link_key else None}
    wires, signing = open_board_link(merge_config(given, None))
    if wires.trouble:  # said before the station is waited for, which may take long
        log.warning("thruster board: %s", wires.trouble)
    try:
        receive_on_one_thread()
        with Bus(ZenohTransport(endpoint(station, me, keys, lossless=True), stop)) as bus:
            bus.claim(me, stop)
            agent_in_lockstep(loaded, robot, bus, wires, stop, signing).run()
    finally:
        wires.close()


@cli.command()
def localizer(
    experiment: ExperimentName,
    camera: Annotated[str, typer.Option(help="Of several cameras: which.")] = "",
    frame_ring: FrameRingOption = None,
    station: StationAddress = DEFAULT_STATION,
    keys: KeyRing = None,
) -> None:
    """Run the localizer of a camera."""
    import cv2

    from shoal.bus.bus import Bus
    from shoal.bus.frame_ring import codec_of
    from shoal.bus.network import endpoint
    from shoal.bus.zenoh_transport import ZenohTransport
    from shoal.messages.topics import Role, localizer_name, process_name
    from sim_bridge.lockstep.localizer import localizer_in_lockstep

    start_log(localizer_name(camera))
    cv2.setNumThreads(1)  # as `localizer run`
    loaded, stop = load_experiment(experiment), Stop()
    where = endpoint(station, process_name(Role.LOCALIZER), keys, lossless=True)
    with Bus(ZenohTransport(where, stop), DEFAULT_FLEET, *codec_of(frame_ring)) as bus:
        bus.claim(localizer_name(camera), stop)
        localizer_in_lockstep(loaded, bus, stop, camera).run()
    stop.raise_failure()


@cli.command()
def fuse(experiment: ExperimentName, station: StationAddress = DEFAULT_STATION, keys: KeyRing = None) -> None:
    """Fuse the poses of several cameras."""
    from shoal.bus.bus import Bus
    from shoal.bus.network import endpoint
    from shoal.bus.zenoh_transport import ZenohTransport
    from shoal.messages.topics import Role, localizer_name, process_name
    from sim_bridge.lockstep.localizer import fusion_in_lockstep

    start_log("localizer")
    stop = Stop()
    with Bus(ZenohTransport(endpoint(station, process_name(Role.LOCALIZER), keys, lossless=True), stop)) as bus:
        bus.claim(localizer_name(""), stop)
        fusion_in_lockstep(load_experiment(experiment), bus, stop).run()


EXTRAS = {"station": "station", "localizer": "localizer", "fuse": "localizer"}  # that a command's packages come with

if __name__ == "__main__":
    run_role(lambda: run_app(cli), EXTRAS.get("".join(sys.argv[1:2]), "all"))

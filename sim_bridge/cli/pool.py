"""SHELL: `sim-bridge pool` and `board`: the simulated side of the wires alone."""

from pathlib import Path
from typing import Annotated

import typer

from wire.config.experiment import load_experiment
from wire.process.cli_options import (
    DEFAULT_FLEET,
    DEFAULT_STATION,
    ExperimentName,
    FleetName,
    FrameRingOption,
    Insecure,
    KeyRing,
    LockstepMode,
    Settings,
    StationAddress,
    Verbose,
)
from wire.process.runtime import Stop, log, start_log

Poses = Annotated[
    bool, typer.Option("--poses", help="No camera, no localizer: true poses with the noise of sim.numeric instead.")
]
BoardFolder = Annotated[
    Path | None,
    typer.Option(
        "--boards",
        metavar="FOLDER",
        help="Where thruster boards keep their parameters, robot-N.json; a robot-N.key in it makes its link a signed one.",
    ),
]


def pool(
    experiment: ExperimentName,
    station: StationAddress = DEFAULT_STATION,
    fleet: FleetName = DEFAULT_FLEET,
    ports: Annotated[int, typer.Option(min=0, help="The board of robot N is at UDP port PORTS + N.")] = 14550,
    settings: Settings = None,
    boards: BoardFolder = None,
    lockstep: LockstepMode = False,
    poses: Poses = False,
    frame_ring: FrameRingOption = None,
    keys: KeyRing = None,
    insecure: Insecure = False,
    verbose: Verbose = False,
) -> None:
    """Be the pool: thruster boards on UDP, camera frames on the bus. The other programs run as they would beside water.

    Example:  sim-bridge pool pool --station tls/192.168.1.10:7447 --keys keys
    """
    import cv2

    from sim_bridge.node.board_ports import UdpPorts
    from sim_bridge.node.pool import PoolNode
    from sim_bridge.thruster_board.board import ThrusterBoard
    from sim_bridge.thruster_board.nonvolatile import boards_in
    from wire.messages.topics import Role, process_name
    from wire.transport.bus import Bus
    from wire.transport.frame_ring import codec_of
    from wire.transport.network import endpoint
    from wire.transport.zenoh_transport import ZenohTransport

    start_log("sim-bridge", verbose)
    cv2.setNumThreads(1)  # of this process: with the fleet's others on the machine, more threads only fight
    stop = Stop()
    loaded = load_experiment(experiment, settings or ())
    where = endpoint(station, process_name(Role.SIMULATOR), keys, insecure=insecure, lossless=lockstep)
    make = boards_in(boards) if boards is not None else ThrusterBoard
    sockets = UdpPorts(ports, loaded.robot_ids, loaded.seed)  # ports that are taken are told before the wait for the station
    with Bus(ZenohTransport(where, stop), fleet, *codec_of(frame_ring)) as bus:
        PoolNode(loaded, bus, sockets, stop, lockstep, poses, make).run()
    stop.raise_failure()


def board(
    experiment: ExperimentName,
    port: Annotated[str, typer.Option(help="Where to be plugged in: udp:HOST:PORT or pty:PATH.")] = "udp:127.0.0.1:14551",
    robot: Annotated[int, typer.Option(help="Which robot's board this is.")] = 1,
    boards: BoardFolder = None,
    settings: Settings = None,
    verbose: Verbose = False,
) -> None:
    """Be one thruster board on a bench, at rest: for programs that talk to boards.

    Example:  sim-bridge board pool --port pty:/tmp/board, and then: robot-agent params list --link serial:/tmp/board
    """
    from sim_bridge.node import bench
    from sim_bridge.thruster_board.board import ThrusterBoard
    from sim_bridge.thruster_board.nonvolatile import boards_in

    start_log(f"board-{robot}", verbose)
    stop, loaded = Stop(), load_experiment(experiment, settings or ())
    loaded.robot(robot)
    made = (boards_in(boards) if boards is not None else ThrusterBoard)(loaded, robot, loaded.seed)
    socket = bench.open_socket(port, signed=made.signed)
    try:
        log.info("%s, at %s", "signed" if made.signed else "not signed", port)
        bench.run(made, socket, stop)
    finally:
        socket.close()

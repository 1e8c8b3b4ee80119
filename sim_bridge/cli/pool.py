"""SHELL: `sim-bridge pool`, `hil` and `board`: the simulated side of the wires alone."""

from pathlib import Path
from typing import Annotated

import typer

from shoal.runtime.cli_options import (
    DEFAULT_FLEET,
    DEFAULT_STATION,
    ExperimentName,
    FleetName,
    FrameRingOption,
    Insecure,
    KeyRing,
    LinkInsecure,
    Settings,
    StationAddress,
    Verbose,
    finite,
)
from shoal.runtime.runtime import Stop, log, start_log

Poses = Annotated[
    bool, typer.Option("--poses", help="No camera, no localizer: true poses with the noise of sim.numeric instead.")
]
Pace = Annotated[
    float | None,
    typer.Option(
        min=0.01,
        metavar="TIMES",
        help="No faster than this many times real time. Default: 1; with --lockstep no limit.",
        callback=finite,
    ),
]
BoardFolder = Annotated[
    Path | None,
    typer.Option(
        "--boards",
        metavar="FOLDER",
        help="Where thruster boards keep their parameters, robot-N.json; a robot-N.key in it makes its link a signed one.",
    ),
]


BoardHost = Annotated[
    str,
    typer.Option(
        "--host",
        metavar="ADDRESS",
        help="Where the boards' ports listen. Off this machine every link has to be signed: robot-N.key in --boards.",
    ),
]
BasePort = Annotated[int, typer.Option(min=0, help="The board of robot N is at UDP port PORTS + N.")]


def pool(
    experiment: ExperimentName,
    station: StationAddress = DEFAULT_STATION,
    fleet: FleetName = DEFAULT_FLEET,
    ports: BasePort = 14550,
    host: BoardHost = "127.0.0.1",
    link_insecure: LinkInsecure = False,
    settings: Settings = None,
    boards: BoardFolder = None,
    lockstep: Annotated[bool, typer.Option("--lockstep", help="Own the time: the others step when this says so.")] = False,
    pace: Annotated[
        float | None,
        typer.Option(
            min=0.01, metavar="TIMES", help="With --lockstep: no faster than this many times real time.", callback=finite
        ),
    ] = None,
    poses: Poses = False,
    frame_ring: FrameRingOption = None,
    keys: KeyRing = None,
    insecure: Insecure = False,
    verbose: Verbose = False,
) -> None:
    """Simulate the pool: thruster boards on UDP, camera frames on the bus. The other programs run as they would beside water.

    Example:  sim-bridge pool pool --station tls/192.0.2.10:7447 --keys keys
    """
    from shoal.config.experiment import load_experiment
    from sim_bridge.node.wires import PoolWires, run_pool

    if pace is not None and not lockstep:
        raise typer.BadParameter("--pace: the wall clock has a pace of its own (allowed: with --lockstep)")
    start_log("sim-bridge", verbose)
    wires = PoolWires(station, fleet, keys, insecure, ports, host, boards, link_insecure)
    run_pool(load_experiment(experiment, settings or ()), wires, {}, lockstep, poses, frame_ring, pace)


def hil(
    experiment: ExperimentName,
    real: Annotated[
        list[str] | None,
        typer.Option(
            "--board",
            metavar="N=WHERE",
            help="Robot N's board: serial:DEVICE[:BAUD], udp:HOST:PORT, or simulated, as those not named are. Repeatable.",
        ),
    ] = None,
    station: StationAddress = DEFAULT_STATION,
    fleet: FleetName = DEFAULT_FLEET,
    ports: BasePort = 14550,
    host: BoardHost = "127.0.0.1",
    link_insecure: LinkInsecure = False,
    settings: Settings = None,
    boards: BoardFolder = None,
    poses: Poses = False,
    keys: KeyRing = None,
    insecure: Insecure = False,
    verbose: Verbose = False,
) -> None:
    """Simulate the pool around real thruster boards in HIL mode: their outputs move the robots, and they measure that water.

    Agents speak with their boards through the ports here, as beside `pool`. A robot-N.key in --boards signs a link. A board
    that is not in HIL mode, or that falls silent, ends the run: exit code 1, or 2 if it was so from the start.

    Example:  sim-bridge hil pool --board 1=serial:/dev/serial/by-id/NAME --board 2=udp:10.0.0.7:14550
    """
    from shoal.config.experiment import load_experiment
    from sim_bridge.node.wires import PoolWires, real_boards, run_pool

    start_log("sim-bridge", verbose)
    loaded = load_experiment(experiment, settings or ())
    wires = PoolWires(station, fleet, keys, insecure, ports, host, boards, link_insecure)
    run_pool(loaded, wires, real_boards(loaded, real or ()), poses=poses)


def board(
    experiment: ExperimentName,
    port: Annotated[str, typer.Option(help="Where to be plugged in: udp:HOST:PORT or pty:PATH.")] = "udp:127.0.0.1:14551",
    robot: Annotated[int, typer.Option(help="Which robot's board this is.")] = 1,
    boards: BoardFolder = None,
    settings: Settings = None,
    verbose: Verbose = False,
) -> None:
    """Simulate one thruster board on a bench, at rest: for programs that talk to boards.

    Example:  sim-bridge board pool --port pty:/tmp/board, and then: robot-agent params list --link serial:/tmp/board
    """
    from shoal.config.experiment import load_experiment
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

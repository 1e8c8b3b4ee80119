"""SHELL: the simulated pool at its wires: the bus, the ports at which agents find their boards, real boards in HIL mode."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import cv2

from shoal.bus.bus import Bus
from shoal.bus.frame_ring import codec_of
from shoal.bus.network import endpoint
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.config.experiment import Experiment
from shoal.errors import ConfigError
from shoal.mavlink.board_address import parse_link
from shoal.mavlink.board_port import is_local
from shoal.messages.topics import Role, process_name
from shoal.runtime.runtime import Stop, log
from sim_bridge.node.board_ports import UdpPorts
from sim_bridge.node.hil_board import HilBoard, connect
from sim_bridge.node.pool import PoolNode
from sim_bridge.thruster_board.board import ThrusterBoard
from sim_bridge.thruster_board.nonvolatile import boards_in
from sim_bridge.world import WorldBoard

SIMULATED = "simulated"


@dataclass(frozen=True)
class PoolWires:
    """Addresses and keys of a simulated pool."""

    station: str
    fleet: str
    keys: Path | None
    insecure: bool  # no keys for the bus
    ports: int  # the board of robot N is at UDP port `ports` + N ...
    host: str  # ... of this address
    boards: Path | None  # folder of what boards keep, and of the links' keys
    link_insecure: bool  # links may leave this machine without a key

    def link_key(self, robot: int) -> Path | None:
        """The key of a robot's link, if there is one."""
        key = None if self.boards is None else self.boards / f"robot-{robot}.key"
        return key if key is not None and key.exists() else None

    def check_host(self, robots: Sequence[int]) -> None:
        """Raises ConfigError if links would leave this machine without a key, or `host` is no address."""
        try:
            local = is_local(self.host)
        except (OSError, UnicodeError):
            raise ConfigError(f"--host {self.host!r}: no address of a host, nor a name that has one") from None
        unsigned = [robot for robot in robots if self.link_key(robot) is None]
        if unsigned and not (local or self.link_insecure):
            raise ConfigError(
                f"--host {self.host}: links leave this machine, and that of robot {unsigned[0]} has no key "
                f"(allowed: with robot-{unsigned[0]}.key in the folder of --boards, or with --link-insecure)"
            )


def real_boards(experiment: Experiment, given: Sequence[str]) -> dict[int, str]:
    """Addresses of the real boards, by robot, from texts N=WHERE. Raises ConfigError naming what is allowed."""
    addresses: dict[int, str] = {}
    for text in given:
        number, _, where = text.partition("=")
        if not (number.isdecimal() and int(number) in experiment.robot_ids):
            robots = ", ".join(map(str, experiment.robot_ids))
            raise ConfigError(f"--board {text!r}: no robot of {experiment.name} (allowed: N=WHERE, N one of {robots})")
        if int(number) in addresses:
            raise ConfigError(f"--board {text!r}: robot {number} has a board already")
        if where != SIMULATED:
            parse_link(where, f"--board {number}")
        addresses[int(number)] = where
    return {robot: where for robot, where in addresses.items() if where != SIMULATED}


def run_pool(
    experiment: Experiment,
    wires: PoolWires,
    real: Mapping[int, str],
    lockstep: bool = False,
    poses: bool = False,
    frame_ring: int | None = None,
    pace: float | None = None,
) -> None:
    """Simulate the pool until told to stop. `real` are the addresses of boards that are not simulated, `frame_ring` is the
    descriptor of the launcher's ring for camera frames, `pace` the most that lockstep may be faster than real time. Raises
    Failed if a part of it cannot go on, ConfigError for wires that cannot be used, and where another simulator is in the
    fleet."""
    cv2.setNumThreads(1)  # of this process: with the fleet's others on the machine, more threads only fight
    stop = Stop()
    wires.check_host(experiment.robot_ids)
    simulated = boards_in(wires.boards) if wires.boards is not None else ThrusterBoard
    where = endpoint(wires.station, process_name(Role.SIMULATOR), wires.keys, insecure=wires.insecure, lossless=lockstep)
    with ExitStack() as stack:
        links = {}
        for robot, address in real.items():
            links[robot] = connect(robot, address, wires.link_key(robot), wires.link_insecure)
            stack.callback(links[robot][0].close)
            log.info("robot %d: the board at %s is in HIL mode", robot, address)

        def make(experiment: Experiment, robot: int, seed: int) -> WorldBoard:
            if robot not in real:
                return simulated(experiment, robot, seed)
            return HilBoard(experiment, robot, seed, real[robot], *links[robot])

        # ports that are taken are told before the wait for the station
        sockets = UdpPorts(wires.ports, experiment.robot_ids, experiment.seed, wires.host)
        bus = stack.enter_context(Bus(ZenohTransport(where, stop), wires.fleet, *codec_of(frame_ring)))
        bus.claim(process_name(Role.SIMULATOR), stop)
        PoolNode(experiment, bus, sockets, stop, lockstep, poses, make, pace).run()
    stop.raise_failure()

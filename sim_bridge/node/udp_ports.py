"""SHELL: the thruster boards' UDP ports."""

import select
import socket

from sim_bridge.node.lossy_link import LossyLink
from sim_bridge.world import World
from wire.mavlink.agent_link import is_override
from wire.toml_loader import ConfigError

READ_BYTES = 65536
READ_MOST = 10  # datagrams of a port at a time: 2,000 a second at steps of 5 ms; computer and ground stations send some 100
FORGET_MOST = 1000  # reads, however much goes on arriving
FLOODED_WAIT_S = 0.005  # a port with more than that is looked at again after so long
PEERS = 8  # the robot's computer, and ground stations beside it
PEER_GONE_NS = 10_000_000_000  # a MAVLink program sends a heartbeat each second

Address = tuple[str, int]


class Port:
    """A board's UDP port. It answers to those whose frames the board has taken lately."""

    def __init__(self, host: str, port: int) -> None:
        """Port 0 is any free one. Raises OSError."""
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self.socket.bind((host, port))
        except OSError:
            self.socket.close()
            raise
        self.socket.setblocking(False)
        self.is_flooded = False  # the last `read` left something there
        self._heard_ns: dict[Address, int] = {}

    @property
    def heard(self) -> bool:
        """Whether anybody is there to answer to."""
        return bool(self._heard_ns)

    def read(self) -> list[tuple[bytes, Address]]:
        """The datagrams that have arrived, in order, and who sent them; READ_MOST at a time, so that whoever floods a port
        holds up nothing but that port."""
        datagrams: list[tuple[bytes, Address]] = []
        while len(datagrams) < READ_MOST:
            try:
                datagrams.append(self.socket.recvfrom(READ_BYTES))
            except (BlockingIOError, ConnectionRefusedError):
                self.is_flooded = False
                return datagrams
        self.is_flooded = True
        return datagrams

    def hear(self, peer: Address, now_ns: int) -> None:
        """The board has taken a frame of this peer. When there are too many, the one that was silent longest makes room."""
        if peer not in self._heard_ns and len(self._heard_ns) >= PEERS:
            del self._heard_ns[min(self._heard_ns, key=self._heard_ns.__getitem__)]
        self._heard_ns[peer] = now_ns

    def forget(self) -> None:
        """As if nobody had spoken yet."""
        for _ in range(FORGET_MOST):
            if not self.read():
                break
        self._heard_ns.clear()

    def send(self, data: bytes, now_ns: int) -> None:
        """To all who are there."""
        for peer, heard_ns in list(self._heard_ns.items()):
            if now_ns - heard_ns > PEER_GONE_NS and len(self._heard_ns) > 1:
                del self._heard_ns[peer]
                continue
            try:
                self.socket.sendto(data, peer)
            except OSError:  # its computer is gone; the board times out by itself
                continue

    def fileno(self) -> int:
        """For `select`."""
        return self.socket.fileno()

    def close(self) -> None:
        """Free the port."""
        self.socket.close()


class Sockets:
    """One UDP port per thruster board. Between a port and its board lies the link that faults can cut, slow down or make
    noisy."""

    def __init__(self, base_port: int, robots: tuple[int, ...], seed: int) -> None:
        """The board of robot N is at `base_port` + N. Raises ConfigError naming a port that cannot be had."""
        self.commands = [0] * len(robots)  # sets of pulses that reached each port, whatever the link made of them
        self.burst_ms = [0] * len(robots)  # board time of the last burst that went out of each port
        self._measured_ms = [0] * len(robots)
        self._to_board: list[LossyLink[Address | None]] = [LossyLink(seed, robot, 0, None) for robot in robots]
        self._from_board = [LossyLink(seed, robot, 1, 0) for robot in robots]
        self._ports: list[Port] = []
        for robot in robots:
            try:
                self._ports.append(Port("127.0.0.1", base_port + robot))
            except (OSError, OverflowError) as error:
                self.close()
                why = error.strerror if isinstance(error, OSError) else "allowed: up to 65535"
                raise ConfigError(
                    f"--ports {base_port}: UDP port {base_port + robot}, of robot {robot}'s board: {why}"
                ) from None

    def forget(self) -> None:
        """Throw away what lies there, and who it is from: the last of it may have been dropped, and what follows on such a gap
        in the numbers looks old to a board."""
        for port in self._ports:
            port.forget()

    def exchange(self, world: World) -> None:
        """Take what has arrived; give the boards what the links let through by now."""
        for i, port in enumerate(self._ports):
            for data, peer in port.read():
                self.commands[i] += is_override(data)
                self._to_board[i].push(data, world.now_ns, world.faults.links[i], peer)
        self.deliver(world)

    def deliver(self, world: World) -> None:
        """Let the links bring what is due."""
        for i, (there, back) in enumerate(zip(self._to_board, self._from_board, strict=True)):
            for data, peer in there.pop(world.now_ns):
                if world.receive(i, data) and peer is not None:
                    self._ports[i].hear(peer, world.now_ns)
            for data, burst_ms in back.pop(world.now_ns):
                self._ports[i].send(data, world.now_ns)
                self.burst_ms[i] = max(self.burst_ms[i], burst_ms)

    @property
    def all_heard(self) -> bool:
        """Whether every board knows whom to answer."""
        return all(port.heard for port in self._ports)

    def send(self, i: int, data: bytes, world: World) -> None:
        """Hand a board's bytes to its link."""
        if data:
            burst_ms = world.board_ms(i)
            tag = burst_ms if burst_ms != self._measured_ms[i] else 0
            self._measured_ms[i] = burst_ms
            self._from_board[i].push(data, world.now_ns, world.faults.links[i], tag)

    def wait(self, timeout_s: float) -> None:
        """Sleep until something arrives; from a port that is flooded, a little."""
        quiet = [port for port in self._ports if not port.is_flooded]
        at_most_s = timeout_s if len(quiet) == len(self._ports) else min(timeout_s, FLOODED_WAIT_S)
        select.select(quiet, [], [], max(at_most_s, 0.0))

    def close(self) -> None:
        """Free the ports."""
        for port in self._ports:
            port.close()

"""SHELL: the thruster boards' ports, and the links behind them that faults disturb.

BoardPorts is their common part, UdpPorts has a UDP port for each board (sim_bridge/in_process/executor.py: ports in memory).

A LossyLink loses, delays, duplicates and reorders datagrams in one direction. It is pure and seeded and runs in the
plant's time, so that a lockstep run repeats to the bit.
"""

import heapq
import select
import socket
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Generic, Protocol, TypeVar

from shoal.errors import ConfigError
from shoal.mavlink.agent_link import is_override
from sim_bridge.fault_schedule import LinkFaults
from sim_bridge.plant.random_streams import Stream, generator
from sim_bridge.world import World

T = TypeVar("T")  # type of a datagram's tag
OVERTAKEN_NS = 50_000_000  # ns, longest delay of an overtaken datagram: a control period, so that the order changes


class LossyLink(Generic[T]):
    """Datagrams on their way in one direction."""

    def __init__(self, seed: int, robot: int, direction: int, overtaken_tag: T) -> None:
        """`overtaken_tag` replaces the tag of a datagram that was overtaken."""
        self._overtaken_tag = overtaken_tag
        self._random = generator(seed, Stream.LINK, robot, direction)
        self._queue: list[tuple[int, int, bytes, T]] = []  # due, order of arrival, datagram, tag
        self._count = self._newest = 0

    def push(self, data: bytes, now_ns: int, trouble: LinkFaults, tag: T) -> None:
        """A datagram enters, with a tag that leaves beside it."""
        if trouble.cut:
            return
        due_ns = now_ns + round(trouble.delay_s * 1e9)
        if trouble.loss == 0.0:
            self._put(due_ns, data, tag)
            return
        lost, doubled, overtaken, by = self._random.random(4).tolist()
        if lost < trouble.loss:
            return
        self._put(due_ns + (round(by * OVERTAKEN_NS) if overtaken < trouble.loss else 0), data, tag)
        if doubled < trouble.loss:
            self._put(due_ns, data, tag)

    def _put(self, due_ns: int, data: bytes, tag: T) -> None:
        self._count += 1
        heapq.heappush(self._queue, (due_ns, self._count, data, tag))

    @property
    def next_due_ns(self) -> int | None:
        """Plant time at which the next datagram leaves; None if there is none."""
        return self._queue[0][0] if self._queue else None

    def pop(self, now_ns: int) -> list[tuple[bytes, T]]:
        """Take out the datagrams that are due, each with its tag. One that a later datagram has overtaken gets the tag for
        that: MAVLink refuses it as stale."""
        due: list[tuple[bytes, T]] = []
        while self._queue and self._queue[0][0] <= now_ns:
            _, order, data, tag = heapq.heappop(self._queue)
            is_overtaken = order <= self._newest
            due.append((data, self._overtaken_tag if is_overtaken else tag))
            self._newest = max(self._newest, order)
        return due


READ_BYTES = 65536
READ_MOST = 10  # datagrams of a port per read: 2,000 a second at steps of 5 ms; computer and ground stations send some 100
FORGET_MOST = 1000  # reads that discard old datagrams, so that a flood cannot hold up the start
FLOODED_WAIT_S = 0.005  # s until a port with more than READ_MOST datagrams is read again
PEERS = 8  # peers of a port: the robot's computer, and ground stations beside it
PEER_GONE_NS = 10_000_000_000  # ns of silence after which a peer is dropped; MAVLink programs send a heartbeat each second

Address = tuple[str, int]


class Port(Protocol):
    """A board's port, as BoardPorts reads and answers it."""

    def read(self) -> list[tuple[bytes, Address]]: ...
    def hear(self, peer: Address, now_ns: int) -> None: ...
    def send(self, data: bytes, now_ns: int) -> None: ...


class UdpPort:
    """A board's UDP port. It answers to the peers whose frames the board has taken lately."""

    def __init__(self, host: str, port: int) -> None:
        """Bind the port; port 0 is any free one. Raises OSError."""
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
    def has_peer(self) -> bool:
        """True if there is a peer to answer to."""
        return bool(self._heard_ns)

    def read(self) -> list[tuple[bytes, Address]]:
        """The datagrams that have arrived, in order, with their senders; READ_MOST at a time, so that a flood holds up
        only its own port."""
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
        """Note that the board has taken a frame of this peer. If there are too many peers, the one that was silent longest
        is dropped."""
        if peer not in self._heard_ns and len(self._heard_ns) >= PEERS:
            del self._heard_ns[min(self._heard_ns, key=self._heard_ns.__getitem__)]
        self._heard_ns[peer] = now_ns

    def forget(self) -> None:
        """Discard waiting datagrams and all peers."""
        for _ in range(FORGET_MOST):
            if not self.read():
                break
        self._heard_ns.clear()

    def send(self, data: bytes, now_ns: int) -> None:
        """Send a datagram to each peer that was heard of late, and to the last one in any case."""
        for peer, heard_ns in list(self._heard_ns.items()):
            if now_ns - heard_ns > PEER_GONE_NS and len(self._heard_ns) > 1:
                del self._heard_ns[peer]
                continue
            try:
                self.socket.sendto(data, peer)
            except OSError:  # its computer is gone; the board times out by itself
                continue

    def fileno(self) -> int:
        """The file descriptor, for `select`."""
        return self.socket.fileno()

    def close(self) -> None:
        self.socket.close()


class BoardPorts(ABC):
    """One port per thruster board. Between a port and its board lies the link that faults can cut, delay or make noisy."""

    def __init__(self, ports: Sequence[Port], robots: tuple[int, ...], seed: int) -> None:
        self.commands = [0] * len(robots)  # sets of pulses that reached each port, whatever the link made of them
        self.burst_ms = [0] * len(robots)  # board time of the last burst that went out of each port
        self._measured_ms = [0] * len(robots)
        self._to_board: list[LossyLink[Address | None]] = [LossyLink(seed, robot, 0, None) for robot in robots]
        self._from_board = [LossyLink(seed, robot, 1, 0) for robot in robots]
        self._ports = ports

    def exchange(self, world: World) -> None:
        """Read what has arrived, and give the boards the datagrams that their links let through by now."""
        for i, port in enumerate(self._ports):
            for data, peer in port.read():
                self.commands[i] += is_override(data)
                self._to_board[i].push(data, world.now_ns, world.faults.links[i], peer)
        self.deliver(world)

    def deliver(self, world: World) -> None:
        """Deliver the datagrams that are due on the links, both ways."""
        for i, (there, back) in enumerate(zip(self._to_board, self._from_board, strict=True)):
            for data, peer in there.pop(world.now_ns):
                if world.receive(i, data) and peer is not None:
                    self._ports[i].hear(peer, world.now_ns)
            for data, burst_ms in back.pop(world.now_ns):
                self._ports[i].send(data, world.now_ns)
                self.burst_ms[i] = max(self.burst_ms[i], burst_ms)

    def quiet_until_ns(self, until_ns: int) -> int:
        """The first plant time up to `until_ns` at which a datagram leaves one of the links; else `until_ns`."""
        due = [link.next_due_ns for link in self._to_board] + [link.next_due_ns for link in self._from_board]
        return min([until_ns, *(ns for ns in due if ns is not None)])

    def send(self, i: int, data: bytes, world: World) -> None:
        """Hand a board's bytes to its link."""
        if data:
            burst_ms = world.board_ms(i)
            tag = burst_ms if burst_ms != self._measured_ms[i] else 0
            self._measured_ms[i] = burst_ms
            self._from_board[i].push(data, world.now_ns, world.faults.links[i], tag)

    @property
    @abstractmethod
    def all_heard(self) -> bool:
        """True if every board has a peer to answer to."""

    @abstractmethod
    def forget(self) -> None:
        """Discard waiting datagrams and all peers. The last of a queue may have been dropped, and frames after such a gap
        in the sequence numbers look stale to a board."""

    @abstractmethod
    def wait(self, timeout_s: float) -> None:
        """Wait until something arrives."""

    @abstractmethod
    def close(self) -> None:
        """Free the ports."""


class UdpPorts(BoardPorts):
    """A UDP port per thruster board."""

    def __init__(self, base_port: int, robots: tuple[int, ...], seed: int, host: str = "127.0.0.1") -> None:
        """Bind the ports: the board of robot N is at `base_port` + N of the address `host`. Raises ConfigError naming a port
        that cannot be bound."""
        self._bound: list[UdpPort] = []
        for robot in robots:
            try:
                self._bound.append(UdpPort(host, base_port + robot))
            except (OSError, OverflowError) as error:
                self.close()
                why = error.strerror if isinstance(error, OSError) else "allowed: up to 65535"
                raise ConfigError(
                    f"--ports {base_port}: UDP port {base_port + robot}, of robot {robot}'s board: {why}"
                ) from None
        super().__init__(self._bound, robots, seed)

    @property
    def all_heard(self) -> bool:
        return all(port.has_peer for port in self._bound)

    def forget(self) -> None:
        for port in self._bound:
            port.forget()

    def wait(self, timeout_s: float) -> None:
        """Sleep until something arrives, or a short time while a port is flooded."""
        quiet = [port for port in self._bound if not port.is_flooded]
        at_most_s = timeout_s if len(quiet) == len(self._bound) else min(timeout_s, FLOODED_WAIT_S)
        select.select(quiet, [], [], max(at_most_s, 0.0))

    def close(self) -> None:
        for port in self._bound:
            port.close()

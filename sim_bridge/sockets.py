"""SHELL: the thruster boards' UDP ports."""

import select
import socket

from sim_bridge.lossy_link import LossyLink
from sim_bridge.world import World
from wire.mavlink import is_override

READ_BYTES = 65536


class Sockets:
    """One UDP port per thruster board. A board answers to where it was last spoken to from. Between a port and its board lies
    the link that faults can cut, slow down or make noisy."""

    def __init__(self, base_port: int, robots: tuple[int, ...], seed: int) -> None:
        self.commands = [0] * len(robots)  # sets of pulses that reached each port, whatever the link made of them
        self.burst_ms = [0] * len(robots)  # board time of the last burst that went out of each port
        self._measured_ms = [0] * len(robots)
        self._to_board = [LossyLink(seed, robot, 0) for robot in robots]
        self._from_board = [LossyLink(seed, robot, 1) for robot in robots]
        self._sockets = []
        self._peers: list[tuple[str, int] | None] = [None] * len(robots)
        for robot in robots:
            board = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            board.bind(("127.0.0.1", base_port + robot))
            board.setblocking(False)
            self._sockets.append(board)

    def exchange(self, world: World) -> None:
        """Take what has arrived; give the boards what the links let through by now."""
        for i, board in enumerate(self._sockets):
            while True:
                try:
                    data, self._peers[i] = board.recvfrom(READ_BYTES)
                except (BlockingIOError, ConnectionRefusedError):
                    break
                self.commands[i] += is_override(data)
                self._to_board[i].push(data, world.now_ns, world.faults.links[i])
        self.deliver(world)

    def deliver(self, world: World) -> None:
        """Let the links bring what is due."""
        for i, (there, back) in enumerate(zip(self._to_board, self._from_board, strict=True)):
            for data, _ in there.pop(world.now_ns):
                world.receive(i, data)
            for data, burst_ms in back.pop(world.now_ns):
                self._send(i, data)
                self.burst_ms[i] = max(self.burst_ms[i], burst_ms)

    @property
    def all_heard(self) -> bool:
        """Whether every board knows whom to answer."""
        return None not in self._peers

    def send(self, i: int, data: bytes, world: World) -> None:
        """Hand a board's bytes to its link."""
        if data:
            burst_ms = world.board_ms(i)
            tag = burst_ms if burst_ms != self._measured_ms[i] else 0
            self._measured_ms[i] = burst_ms
            self._from_board[i].push(data, world.now_ns, world.faults.links[i], tag)

    def _send(self, i: int, data: bytes) -> None:
        """Put a board's bytes on the wire, if somebody has spoken to it."""
        peer = self._peers[i]
        if peer is not None:
            try:
                self._sockets[i].sendto(data, peer)
            except OSError:  # its computer is gone; the board times out by itself
                return

    def wait(self, timeout_s: float) -> None:
        """Sleep until something arrives."""
        select.select(self._sockets, [], [], max(timeout_s, 0.0))

    def close(self) -> None:
        """Free the ports."""
        for board in self._sockets:
            board.close()

"""SHELL: one simulated thruster board on a bench: dry, at rest, by the wall clock, on a UDP port or a pseudo-terminal.

For writing programs that talk to boards, and for trying `sim-bridge board-conformance`.
"""

import os
import select
import time
import tty
from pathlib import Path
from typing import Protocol

import numpy as np

from shoal.errors import ConfigError
from shoal.mavlink.board_port import is_local
from shoal.runtime.runtime import Stop, log
from sim_bridge.node.board_ports import UdpPort
from sim_bridge.thruster_board.board import ThrusterBoard

STEP_S = 0.005
READ_BYTES = 65536
NOBODY = ("", 0)  # the peer of a terminal, which has no addresses
FORMS = "udp:HOST:PORT or pty:PATH, for example udp:127.0.0.1:14551 or pty:/tmp/board"


class BoardSocket(Protocol):
    """The end of a link that a computer can be connected to."""

    def read(self) -> list[tuple[bytes, tuple[str, int]]]: ...
    def hear(self, peer: tuple[str, int], now_ns: int) -> None: ...
    def send(self, data: bytes, now_ns: int) -> None: ...
    def fileno(self) -> int: ...
    def close(self) -> None: ...


class PseudoTerminal:
    """A pseudo-terminal, opened like a serial port at `path`, a link that is created and removed again."""

    def __init__(self, path: Path) -> None:
        self._path = path
        if path.is_symlink() and not path.exists():  # of a board that was killed: its terminal is gone
            path.unlink()
        self._board, self._computer = os.openpty()  # the other end is held open, or a computer that disconnects would end it
        tty.setraw(self._computer)
        os.set_blocking(self._board, False)
        path.symlink_to(os.ttyname(self._computer))

    def read(self) -> list[tuple[bytes, tuple[str, int]]]:
        try:
            return [(os.read(self._board, READ_BYTES), NOBODY)]
        except BlockingIOError:
            return []

    def hear(self, peer: tuple[str, int], now_ns: int) -> None:
        """Do nothing: a terminal has one peer."""

    def send(self, data: bytes, now_ns: int) -> None:
        try:
            os.write(self._board, data)
        except BlockingIOError:  # no program reads
            return

    def fileno(self) -> int:
        return self._board

    def close(self) -> None:
        self._path.unlink(missing_ok=True)
        os.close(self._board)
        os.close(self._computer)


def open_socket(address: str, signed: bool) -> BoardSocket:
    """Open a port or terminal. Raises ConfigError naming the allowed forms."""
    kind, _, rest = address.partition(":")
    host, _, port = rest.rpartition(":")
    try:
        if kind == "pty" and rest:
            return PseudoTerminal(Path(rest))
        if kind == "udp" and host and port.isdecimal() and int(port) < 65536:
            if not (signed or is_local(host)):
                raise ConfigError(f"--port {address!r}: off this machine the board needs a key (--boards, robot-N.key in it)")
            return UdpPort(host, int(port))
    except OSError as error:
        raise ConfigError(f"--port {address!r}: {error.strerror}") from None
    raise ConfigError(f"--port {address!r}: nowhere to be plugged in (allowed: {FORMS})")


def run(board: ThrusterBoard, socket: BoardSocket, stop: Stop) -> None:
    """Run the board until told to stop."""
    still, begin_ns, steps = np.zeros(4), time.monotonic_ns(), 0
    state = (False, True)
    while not stop.requested:
        now_ns = time.monotonic_ns() - begin_ns
        for data, peer in socket.read():
            if board.receive(data, now_ns):
                socket.hear(peer, now_ns)
        if now_ns >= steps * STEP_S * 1e9:
            steps = int(now_ns / (STEP_S * 1e9)) + 1
            data = board.step(now_ns, still, still, still)
            if data:
                socket.send(data, now_ns)
        if (board.armed, board.neutral) != state:
            state = (board.armed, board.neutral)
            log.info("%s, %s", "armed" if state[0] else "disarmed", "neutral" if state[1] else "thrusting")
        due_s = steps * STEP_S - (time.monotonic_ns() - begin_ns) * 1e-9
        select.select([socket.fileno()], [], [], max(due_s, 0.0))

"""SHELL: wires that can be broken: between a robot's computer and its board (a pseudo-terminal at the computer's end), and
between a process and the station's router. Each runs in a thread of the harness.
"""

import os
import pty
import select
import socket
import threading
import time
import tty
from dataclasses import dataclass, field

import numpy as np

from shoal.mavlink.agent_link import AgentLink
from shoal.mavlink.frame_codec import MARKER
from shoal.mavlink.parameters import ParameterClient
from sim_bridge.thruster_board.board_link import BoardLink, Override

READ_BYTES = 65536
NUMBER_AT = 4  # in a frame
IDLE_S = 0.02
GREET_S = 1.0  # a board behind UDP speaks to a wire that it has heard lately; one on a serial port speaks unasked


@dataclass
class LineTrouble:
    """The faults of a robot's wire, in both directions."""

    cut: bool = False
    flip: float = 0.0  # chance of each byte to have one bit turned over
    junk: float = 0.0  # chance that bytes which look like a frame's beginning come before a piece of data
    doubled: float = 0.0  # chance that a piece comes twice; and that it comes again a second later
    forged: tuple[bytes, ...] = ()  # put on the wire to the board, once

    @property
    def any(self) -> bool:
        """True if there is any fault."""
        return self.cut or bool(self.flip or self.junk or self.doubled)


@dataclass
class SerialWire:
    """A pseudo-terminal for the computer, joined to its board's UDP port. What the computer says is noted before anything
    happens to it: the truth against which a board's doings are held."""

    robot: int
    board_port: int
    seed: int
    trouble: LineTrouble = field(default_factory=LineTrouble)
    overrides: list[tuple[int, tuple[int, ...]]] = field(default_factory=list)  # instants, and pulses that the computer sent
    number: int = 0  # of the newest frame that the computer sent

    def __post_init__(self) -> None:
        self._master, self._slave = pty.openpty()
        tty.setraw(self._master)
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._board = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._board.connect(("127.0.0.1", self.board_port))
        self._board.setblocking(False)
        self._random = np.random.default_rng([self.seed, self.robot])
        self._reader, self._greeter, self._greeted_s = BoardLink(self.robot), ParameterClient(self.robot), -GREET_S
        self._later: list[tuple[float, bytes]] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"wire-{self.robot}", daemon=True)
        self._thread.start()

    @property
    def link(self) -> str:
        """As `robot-agent --link` takes it."""
        return f"serial:{os.ttyname(self._slave)}:115200"

    def _run(self) -> None:
        while not self._stop.is_set():
            if time.monotonic() - self._greeted_s >= GREET_S:
                self._greeted_s = time.monotonic()
                self._put(self._greeter.heartbeat(), to_board=True)
            ready, _, _ = select.select([self._master, self._board.fileno()], [], [], IDLE_S)
            for end in ready:
                try:
                    data = os.read(end, READ_BYTES)
                except OSError:  # nobody at the other end now
                    time.sleep(0.001)
                    continue
                self._pass(data, to_board=end == self._master)
            for forged in self.trouble.forged:
                self._put(forged, to_board=True)
            self.trouble.forged = ()
            due = [data for at_s, data in self._later if at_s <= time.monotonic()]
            self._later = [entry for entry in self._later if entry[0] > time.monotonic()]
            for data in due:
                self._put(data, to_board=True)

    def _pass(self, data: bytes, to_board: bool) -> None:
        trouble, random, now_ns = self.trouble, self._random, time.monotonic_ns()
        if to_board:
            events = self._reader.receive(data, now_ns)
            self.overrides += [(now_ns, event.pulses_us) for _, event in events if isinstance(event, Override)]
            if len(data) > NUMBER_AT and data[0] == MARKER:
                self.number = data[NUMBER_AT]
        if trouble.cut:
            return
        if trouble.junk and random.random() < trouble.junk:
            data = bytes([0xFD, *random.integers(0, 256, int(random.integers(1, 40)))]) + data
        if trouble.flip:
            hit = random.random(len(data)) < trouble.flip
            data = bytes(b ^ (1 << int(random.integers(8))) if h else b for b, h in zip(data, hit, strict=True))
        self._put(data, to_board)
        if to_board and trouble.doubled and random.random() < trouble.doubled:
            self._put(data, to_board)
            self._later.append((time.monotonic() + 1.0, data))

    def _put(self, data: bytes, to_board: bool) -> None:
        try:
            if to_board:
                self._board.send(data)
            else:
                os.write(self._master, data)
        except OSError:  # full or gone: bytes on a wire are lost then
            return

    def close(self) -> None:
        """Take the wire away."""
        self._stop.set()
        self._thread.join()
        self._board.close()
        os.close(self._master)
        os.close(self._slave)


FORGED_US = 1717  # a pulse that no test ever commands


def forgeries(robot: int, number: int, random: np.random.Generator) -> tuple[bytes, ...]:
    """Overrides that no board may take: for another robot, damaged, cut short, beyond a servo's range. The last comes in the
    computer's name after its frame of this number: with any other it might be refused for that alone."""
    pulses = (FORGED_US, *[1500] * 7)
    whole = AgentLink(robot).pulses(pulses)
    damaged = bytearray(whole)
    damaged[12] ^= 1 << int(random.integers(8))
    computer = AgentLink(robot)
    for _ in range((number + 1) % 256):
        computer.pulses(pulses)
    return (
        AgentLink(robot % 49 + 1).pulses(pulses),
        bytes(damaged),
        whole[: int(random.integers(5, len(whole)))],
        computer.pulses((2499, *pulses[1:])),
    )


class NetWire:
    """A TCP path to the station's router that can be cut one way, both ways, or be slow. Bytes are held back while it is
    cut, as those of a lost network are, and come afterwards if the connection still stands."""

    def __init__(self, router_port: int) -> None:
        self.up = self.down = True  # towards the router, and from it
        self.jitter_s = 0.0
        self._router_port = router_port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._stop = threading.Event()
        self._random = np.random.default_rng(self.port)
        threading.Thread(target=self._accept, name="net-wire", daemon=True).start()

    def _accept(self) -> None:
        self._listener.settimeout(0.2)
        while not self._stop.is_set():
            try:
                near, _ = self._listener.accept()
            except OSError:
                continue
            try:
                if not (self.up and self.down):
                    near.close()  # a network that is down takes no calls
                    continue
                far = socket.create_connection(("127.0.0.1", self._router_port), timeout=1.0)
            except OSError:
                near.close()
                continue
            for end in (near, far):
                end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            for source, sink, is_up in ((near, far, True), (far, near, False)):
                threading.Thread(target=self._pump, args=(source, sink, is_up), daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket, is_up: bool) -> None:
        try:
            source.settimeout(None)
            while not self._stop.is_set() and (data := source.recv(READ_BYTES)):
                if self.jitter_s:
                    time.sleep(float(self._random.uniform(0.0, self.jitter_s)))
                while not (self.up if is_up else self.down):
                    time.sleep(0.002)
                sink.sendall(data)
        except OSError:
            pass
        finally:
            source.close()
            sink.close()

    def close(self) -> None:
        """Take the path away."""
        self._stop.set()
        self._listener.close()

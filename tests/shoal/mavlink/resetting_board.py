"""A thruster board as a stock Arduino Mega has it, on a real pseudo-terminal: reset by DTR, bootloader, baud rate."""

import fcntl
import os
import select
import struct
import termios
import threading
import time
import tty
from pathlib import Path
from random import Random

import numpy as np

from shoal.config.experiment import load_experiment
from sim_bridge.thruster_board.board import ThrusterBoard

TCGETS2 = 0x802C542A
BOOT_S, SESSION_S = 0.4, 1.5  # a stock Mega's stk500v2 waits 0.9 s for a byte, and 5 s after the last one
STEP_S = 0.005


class ResettingBoard:
    """The board, at `path`. Each opening of the port resets it, unless DTR has stayed up since the last one. The bootloader
    stays while bytes come; a host at another baud rate than the firmware's reads noise."""

    def __init__(self, path: Path, baud: int = 250_000) -> None:
        self.path, self.baud = path, baud
        self.resets, self.bytes_in_bootloader = 0, 0
        self.is_powered = True
        self._board, host = os.openpty()
        tty.setraw(host)
        settings = termios.tcgetattr(host)
        settings[2] |= termios.HUPCL  # as every serial port begins, but for terminals
        termios.tcsetattr(host, termios.TCSANOW, settings)
        path.symlink_to(os.ttyname(host))
        os.close(host)
        os.set_blocking(self._board, False)
        self._noise, self._stop = Random(1), threading.Event()
        self._thread = threading.Thread(target=self._run, name="mega")
        self._firmware: ThrusterBoard | None = None
        self._thread.start()

    def reset(self) -> None:
        """Restart it, as a brown-out does."""
        self.resets += 1
        self._firmware, self._leaves_s = None, time.monotonic() + BOOT_S

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        os.close(self._board)
        self.path.unlink()

    @property
    def runs(self) -> bool:
        """True if the firmware runs."""
        return self._firmware is not None

    @property
    def host_baud(self) -> int:
        """The baud rate that the host has set."""
        answer = fcntl.ioctl(self._board, TCGETS2, bytes(44))
        return int(struct.unpack_from("I", answer, 36)[0])

    def _run(self) -> None:
        is_open, drops_dtr = False, True
        poll = select.poll()
        poll.register(self._board, select.POLLIN)
        while not self._stop.wait(STEP_S):
            hung_up = any(event & select.POLLHUP for _, event in poll.poll(0))
            if hung_up and is_open:
                drops_dtr = bool(termios.tcgetattr(self._board)[2] & termios.HUPCL)
            if is_open == hung_up:
                is_open = not hung_up
                if is_open and drops_dtr:
                    self.reset()
            if is_open and self.is_powered:
                self._step()

    def _step(self) -> None:
        now_s = time.monotonic()
        try:
            data = os.read(self._board, 4096)
        except BlockingIOError:
            data = b""
        except OSError:  # closed just then
            return
        if self._firmware is None:
            if data:
                self.bytes_in_bootloader += len(data)
                self._leaves_s = now_s + SESSION_S
            if now_s < self._leaves_s:
                return
            self._firmware, self._on_s = ThrusterBoard(load_experiment("pool"), 1, 1), now_s
        now_ns = round((now_s - self._on_s) * 1e9)
        self._firmware.receive(data, now_ns)
        still = np.zeros(4)
        said = self._firmware.step(now_ns, still, still, still)
        if self.host_baud != self.baud:
            said = self._noise.randbytes(len(said))
        if said:
            try:
                os.write(self._board, said)
            except BlockingIOError:  # nobody reads
                return

"""SHELL: the wire to the thruster board: a UDP socket or a serial port. Bytes only; shoal/mavlink/agent_link.py gives them
meaning. A serial port looks at them for one thing: whether it hears a board, and at which baud rate."""

import errno
import math
import os
import select
import socket
import termios
import time
import tty
from contextlib import suppress
from pathlib import Path
from typing import Protocol

import serial

from shoal.errors import ConfigError
from shoal.mavlink.board_address import parse_link, serial_trouble
from shoal.mavlink.framing import Receiver
from shoal.mavlink.signing import SignatureVerifier
from shoal.runtime.runtime import log
from shoal.system.loopback import is_loopback

READ_BYTES = 65536
READ_DATAGRAMS = 256  # at one read: more than a board sends in 2 s; a flood of them does not delay a control step
# Where a board is looked for that is not understood at the configured rate. 1200 is not among them: to many boards with USB of
# their own it says to start the bootloader.
USUAL_BAUDS = (250_000, 115_200, 57_600, 230_400, 460_800, 500_000, 921_600, 1_000_000)
BAUD_S = 0.3  # at each rate: 15 bursts of a board that has it
SETTLE_S = 0.1  # after the opening; what comes until then a board may have said before the opening reset it
SILENT_S = 0.5  # 25 bursts; a board that is silent for so long may be in its bootloader
QUIET_START_S = 2.0  # of a board that was reset: 0.9 s of bootloader, and its firmware's start
# The longest that a board may need before it speaks: the end of a programming session in its bootloader, 5 s after the last
# byte, the firmware's start, and a round of baud rates.
FIRST_WORD_S = 9.0
NOTHING_SENT = "and nothing is sent before it speaks (a bootloader would take it for programming)"
IN_USE = "in use by another program (a robot's agent that runs has it: systemctl stop shoal-agent)"


class Link(Protocol):
    """A way to a board. Never blocks, never raises for a board that is not there: its silence is noticed by its age."""

    def send(self, data: bytes) -> None: ...
    def read(self) -> bytes: ...
    def wait(self, timeout_s: float) -> None: ...
    def close(self) -> None: ...

    @property
    def trouble(self) -> str:
        """The reason why nothing gets through, as far as this end can tell; else empty."""
        return ""

    @property
    def advice(self) -> str:
        """The setting that a person should change though the link works; else empty."""
        return ""

    @property
    def first_word_s(self) -> float:
        """The longest that a board may be silent after the opening, beyond the time of an answer."""
        return 0.0


class UdpLink:
    """A board behind UDP, as in simulation or on an Ethernet autopilot."""

    advice = ""
    first_word_s = 0.0

    def __init__(self, host: str, port: int) -> None:
        self.socket = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect((host, port))
        self.socket.setblocking(False)
        self.address = (host, port)
        self.trouble = ""

    def send(self, data: bytes) -> None:
        try:
            self.socket.send(data)
        except OSError as error:
            self._note_trouble(error)

    def read(self) -> bytes:
        """The bytes that have come, up to the size of one read. The rest comes with the next."""
        datagrams: list[bytes] = []
        left = READ_BYTES
        for _ in range(READ_DATAGRAMS):
            try:
                datagrams.append(self.socket.recv(READ_BYTES))
                self.trouble = ""
                left -= len(datagrams[-1])
                if left <= 0:
                    break
            except BlockingIOError:
                break
            except OSError as error:  # the answer to an earlier send
                self._note_trouble(error)
                if not isinstance(error, ConnectionRefusedError):  # a firewall's "prohibited", a router's "network unknown"
                    break  # behind a refusal may be data
        return b"".join(datagrams)

    def _note_trouble(self, error: OSError) -> None:
        refused = "connection refused: the machine is there, but nothing listens on that port"
        self.trouble = refused if isinstance(error, ConnectionRefusedError) else error.strerror or str(error)

    def wait(self, timeout_s: float) -> None:
        """Sleep until something can be read, at most this long."""
        select.select([self.socket], [], [], max(timeout_s, 0.0))

    def close(self) -> None:
        self.socket.close()


class SerialLink:
    """A board on a serial port or USB. An unplugged port is opened again when it is back.

    Opening the port resets many a board, through DTR. Its bootloader takes any byte for the start of a programming session,
    and the firmware does not start while bytes come. So nothing is sent before an intact frame has come, nor after SILENT_S
    without a byte. While what comes is no frame, the port listens at the usual baud rates by turns.
    """

    def __init__(self, device: str, baud: int) -> None:
        self._device, self._baud = device, baud
        self._bauds = (baud, *(rate for rate in USUAL_BAUDS if rate != baud))
        self._port: serial.Serial | None = None
        self._refusal = ""
        self._unsent = b""  # the rest of a frame of which the port has taken a part
        self._found_baud = baud  # the last one at which a frame came
        self._turn = 0  # of the rates, since the last frame
        self._is_understood = False  # an intact frame has come, at this rate and since the last silence
        self._opened_s = self._heard_s = (
            self._turn_s
        ) = -math.inf  # of the port; of the last byte; of the first one at this rate
        self._listener = _listener()
        self._reopen()

    @property
    def trouble(self) -> str:
        """Trouble with the port, or with the bytes from it; empty while all is well, or too early to judge."""
        if self._port is None:
            return serial_trouble(Path(self._device)) or self._refusal
        now_s = time.monotonic()
        is_silent = now_s - self._heard_s > SILENT_S
        if now_s - self._opened_s < QUIET_START_S or (self._is_understood and not is_silent):
            return ""
        if self._heard_s < self._opened_s:
            return f"{self._device}: open, but not a byte has come, {NOTHING_SENT}; is the board powered, with its firmware?"
        if is_silent:
            return f"{self._device}: silent, {NOTHING_SENT}"
        tried = f" at any of {', '.join(map(str, self._bauds))} baud" if self._turn >= len(self._bauds) else ""
        return f"{self._device}: what comes is no MAVLink 2{tried}, {NOTHING_SENT}"

    @property
    def first_word_s(self) -> float:
        return FIRST_WORD_S if self._port is not None else 0.0

    @property
    def advice(self) -> str:
        if self._found_baud == self._baud:
            return ""
        return (
            f"{self._device}: the board speaks at {self._found_baud} baud, not at {self._baud} as configured: "
            f"set the link to serial:{self._device}:{self._found_baud}"
        )

    def _reopen(self) -> None:
        """Open the serial port again, or note why that cannot be done."""
        try:
            self._port = serial.Serial(self._device, self._found_baud, timeout=0, write_timeout=0, exclusive=True)
            _keep_dtr(self._port.fileno())
        except (OSError, ValueError, termios.error) as error:  # the last two: pulled out just then, or no such baud rate
            self._drop()
            taken = isinstance(error, OSError) and error.errno in (errno.EAGAIN, errno.EBUSY)
            self._refusal = f"{self._device}: {IN_USE if taken else error}"
            return
        self._opened_s, self._is_understood = time.monotonic(), False

    def send(self, data: bytes) -> None:
        """Hand bytes to the port. A port that takes a part of them gets the rest with the next call, before anything else: the
        board loses no frame that it has half of, nor those behind it. What it takes nothing of is dropped, and so is what is
        for a board that may be in its bootloader."""
        if self._port is None:
            return
        try:
            if not (self._is_understood and self._is_heard(self._port)):
                self._unsent = b""
                return
            while self._unsent:
                self._unsent = self._unsent[os.write(self._port.fileno(), self._unsent) :]
            self._unsent = data[os.write(self._port.fileno(), data) :]  # pyserial's own, told not to wait, tries for ever
        except BlockingIOError:  # the board takes nothing, and the port holds no more
            return
        except (OSError, serial.SerialException):
            self._drop()

    def _is_heard(self, port: serial.Serial) -> bool:
        """True if a byte has come within SILENT_S, or one is there to be read."""
        return time.monotonic() - self._heard_s <= SILENT_S or port.in_waiting > 0

    def read(self) -> bytes:
        if self._port is None:
            self._reopen()
        try:
            data = bytes(self._port.read(READ_BYTES)) if self._port is not None else b""
            if data and self._port is not None:
                self._note_bytes(self._port, data, time.monotonic())
            return data
        except (OSError, serial.SerialException, termios.error):  # the last: pulled out as its rate was being set
            self._drop()
            return b""

    def _note_bytes(self, port: serial.Serial, data: bytes, now_s: float) -> None:
        """Take note of bytes of the board, and search for its baud rate: until an intact frame is among them, the next rate
        is tried every BAUD_S."""
        if now_s - self._opened_s < SETTLE_S:
            return
        if now_s - self._heard_s > SILENT_S or self._heard_s < self._opened_s:  # it may have been reset
            self._is_understood = False
            self._turn = 0
            self._listen_at(port, port.baudrate, now_s)
        self._heard_s = now_s
        if self._is_understood:
            return
        self._listener.receive(data, round(now_s * 1e9))
        if self._listener.foreign_peer is not None:
            self._is_understood = True
            self._turn = 0
            is_new_rate = port.baudrate != self._found_baud
            self._found_baud = port.baudrate
            if is_new_rate and self.advice:
                log.warning("thruster board: %s", self.advice)
        elif now_s - self._turn_s > BAUD_S:
            self._turn += 1
            next_index = (self._bauds.index(port.baudrate) + 1) % len(self._bauds)
            self._listen_at(port, self._bauds[next_index], now_s)

    def _listen_at(self, port: serial.Serial, baud: int, now_s: float) -> None:
        """Listen for a frame at a baud rate. One that the port does not have leaves it as it is, until the next one's turn."""
        self._listener, self._turn_s = _listener(), now_s
        if baud != port.baudrate:
            with suppress(ValueError, termios.error):
                port.baudrate = baud
            port.reset_input_buffer()

    def wait(self, timeout_s: float) -> None:
        """Sleep until something can be read, at most this long."""
        select.select([self._port.fileno()] if self._port is not None else [], [], [], max(timeout_s, 0.0))

    def _drop(self) -> None:
        if self._port is not None:
            self._port.close()
        self._port, self._unsent = None, b""

    def close(self) -> None:
        self._drop()


def _listener() -> Receiver:
    """A receiver that takes no frame, and so knows the last sender of an intact one as a foreign peer."""
    return Receiver(lambda peer: False, SignatureVerifier(None))


def _keep_dtr(descriptor: int) -> None:
    """Have a port keep DTR when it is closed: a program that opens it later does not reset the board again."""
    settings = termios.tcgetattr(descriptor)
    settings[tty.CFLAG] &= ~termios.HUPCL
    termios.tcsetattr(descriptor, termios.TCSANOW, settings)


def _resolved(host: str) -> tuple[socket.AddressFamily, str]:
    """The address of a host, IPv4 where it has both, as simulated boards do. Raises OSError if it has none."""
    places = socket.getaddrinfo(host, None, type=socket.SOCK_DGRAM)
    family, _, _, _, place = min(places, key=lambda entry: entry[0] != socket.AF_INET)
    return family, str(place[0])


def is_local(host: str) -> bool:
    """True if a host name resolves to a loopback address. Raises OSError if it has no address."""
    return is_loopback(_resolved(host)[1])


def open_link(text: str, secured: bool = False, option: str = "--link") -> Link:
    """The link of an address. UDP to another machine has to be `secured`: signed, or said to be insecure. Raises ConfigError
    naming what is allowed."""
    address = parse_link(text, option)
    if address.kind == "serial":
        return SerialLink(address.where, address.number)
    try:
        if not (secured or is_local(address.where)):
            raise ConfigError(
                f"{option} {text!r}: unsigned UDP leaves this machine, and any sender on its way could drive the thrusters "
                "(allowed: with --link-key FILE, which `robot-agent link-key` makes, or with --link-insecure)"
            )
        return UdpLink(_resolved(address.where)[1], address.number)
    except (socket.gaierror, UnicodeError):  # the second for a part of a name that is empty or longer than 63
        raise ConfigError(f"{option} {text!r}: {address.where!r} is no address of a host, nor a name that has one") from None
    except OSError as error:
        raise ConfigError(f"{option} {text!r}: {error.strerror}") from None

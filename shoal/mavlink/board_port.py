"""SHELL: the wire to the thruster board: a UDP socket or a serial port. Bytes only; shoal/mavlink/agent_link.py gives them
meaning."""

import errno
import os
import select
import socket
import termios
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import serial

from shoal.errors import ConfigError
from shoal.system.loopback import is_loopback

READ_BYTES = 65536
READ_DATAGRAMS = 256  # at one read: more than a board sends in 2 s; a flood of them does not delay a control step
BOARD_BAUD = 250_000  # of the firmware, as firmware/Makefile builds it; an ATmega at 16 MHz has it exactly
FORMS = f"udp:HOST:PORT or serial:DEVICE[:BAUD], for example udp:127.0.0.1:14551 or serial:/dev/ttyACM0:{BOARD_BAUD}"
BAUDS = range(300, 12_000_001)
IN_USE = "in use by another program (a robot's agent that runs has it: systemctl stop shoal-agent)"


@dataclass(frozen=True)
class Address:
    """The address of a thruster board: `kind` is udp or serial, `number` the port or the baud rate."""

    kind: str
    where: str
    number: int


def parse_link(text: str, option: str = "--link") -> Address:
    """The parts of an address. Raises ConfigError naming what is allowed."""
    kind, _, rest = text.partition(":")
    first, _, last = rest.rpartition(":")
    if kind == "udp" and first and last.isdecimal() and 0 < int(last) < 65536:
        return Address(kind, first.removeprefix("[").removesuffix("]"), int(last))
    if kind == "serial" and rest:
        device, baud = (first, int(last)) if first and last.isdecimal() else (rest, BOARD_BAUD)
        if baud in BAUDS:
            return Address(kind, device, baud)
        raise ConfigError(f"{option} {text!r}: no baud rate (allowed: {BAUDS.start} to {BAUDS.stop - 1})")
    raise ConfigError(f"{option} {text!r}: not an address of a thruster board (allowed: {FORMS})")


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


class UdpLink:
    """A board behind UDP, as in simulation or on an Ethernet autopilot."""

    def __init__(self, host: str, port: int) -> None:
        self.socket = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect((host, port))
        self.socket.setblocking(False)
        self.address = (host, port)
        self.trouble = ""

    def send(self, data: bytes) -> None:
        try:
            self.socket.send(data)
        except OSError as error:  # refused: the other end does not listen now
            self.trouble = error.strerror or str(error)

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
            except ConnectionRefusedError:
                self.trouble = "connection refused: the machine is there, but nothing listens on that port"
                continue  # the answer to an earlier send; behind it may be data
            except OSError as error:  # another such answer: a firewall's "prohibited", a router's "network unknown"
                self.trouble = error.strerror or str(error)
                break
        return b"".join(datagrams)

    def wait(self, timeout_s: float) -> None:
        """Sleep until something can be read, at most this long."""
        select.select([self.socket], [], [], max(timeout_s, 0.0))

    def close(self) -> None:
        self.socket.close()


class SerialLink:
    """A board on a serial port or USB. An unplugged port is opened again when it is back."""

    def __init__(self, device: str, baud: int) -> None:
        self._device, self._baud = device, baud
        self._port: serial.Serial | None = None
        self._refusal = ""
        self._unsent = b""  # the rest of a frame of which the port has taken a part
        self._reopen()

    @property
    def trouble(self) -> str:
        return "" if self._port is not None else serial_trouble(Path(self._device)) or self._refusal

    def _reopen(self) -> None:
        try:
            self._port = serial.Serial(self._device, self._baud, timeout=0, write_timeout=0, exclusive=True)
        except (OSError, ValueError, termios.error) as error:  # the last two: pulled out just then, or no such baud rate
            self._port = None
            taken = isinstance(error, OSError) and error.errno in (errno.EAGAIN, errno.EBUSY)
            self._refusal = f"{self._device}: {IN_USE if taken else error}"

    def send(self, data: bytes) -> None:
        """Hand bytes to the port. A port that takes a part of them gets the rest with the next call, before anything else: the
        board loses no frame that it has half of, nor those behind it. What it takes nothing of is dropped."""
        if self._port is None:
            return
        try:
            while self._unsent:
                self._unsent = self._unsent[os.write(self._port.fileno(), self._unsent) :]
            self._unsent = data[os.write(self._port.fileno(), data) :]  # pyserial's own, told not to wait, tries for ever
        except BlockingIOError:  # the board takes nothing, and the port holds no more
            return
        except (OSError, serial.SerialException):
            self._drop()

    def read(self) -> bytes:
        if self._port is None:
            self._reopen()
        try:
            return bytes(self._port.read(READ_BYTES)) if self._port is not None else b""
        except (OSError, serial.SerialException):
            self._drop()
            return b""

    def wait(self, timeout_s: float) -> None:
        """Sleep until something can be read, at most this long."""
        select.select([self._port.fileno()] if self._port is not None else [], [], [], max(timeout_s, 0.0))

    def _drop(self) -> None:
        if self._port is not None:
            self._port.close()
        self._port, self._unsent = None, b""

    def close(self) -> None:
        self._drop()


def serial_trouble(device: Path) -> str:
    """The reason why a serial port cannot be opened, as far as can be seen without opening it; empty if it can."""
    if not device.exists():
        return f"{device}: not there; is the board plugged in, and powered?"
    if not device.is_char_device():
        return f"{device}: is no serial port"
    if not os.access(device, os.R_OK | os.W_OK):
        return f"{device}: no permission; add the user to its group (sudo usermod -aG dialout USER)"
    return ""


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

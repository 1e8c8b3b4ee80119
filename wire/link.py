"""SHELL: the wire to the thruster board: a UDP socket or a serial port. Bytes only; wire/mavlink.py gives them meaning."""

import ipaddress
import select
import socket
from typing import Protocol

import serial

from wire.toml_file import ConfigError

READ_BYTES = 65536
FORMS = "udp:HOST:PORT or serial:DEVICE[:BAUD], for example udp:127.0.0.1:14551 or serial:/dev/ttyACM0:115200"


class Link(Protocol):
    """Never blocks, never raises for a board that is not there: its silence is noticed by its age."""

    def send(self, data: bytes) -> None: ...
    def read(self) -> bytes: ...
    def wait(self, timeout_s: float) -> None: ...
    def close(self) -> None: ...


class UdpLink:
    """A board behind UDP, as in simulation or on an Ethernet autopilot."""

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect((host, port))
        self._socket.setblocking(False)

    def send(self, data: bytes) -> None:
        try:
            self._socket.send(data)
        except OSError:  # refused: nobody is at the other end now
            return

    def read(self) -> bytes:
        datagrams = []
        while True:
            try:
                datagrams.append(self._socket.recv(READ_BYTES))
            except BlockingIOError:
                return b"".join(datagrams)
            except ConnectionRefusedError:
                continue  # the answer to an earlier send; behind it may be data

    def wait(self, timeout_s: float) -> None:
        """Sleep until something can be read, at most this long."""
        select.select([self._socket], [], [], max(timeout_s, 0.0))

    def close(self) -> None:
        self._socket.close()


class SerialLink:
    """A board on a serial port or USB. An unplugged port is opened again when it is back."""

    def __init__(self, device: str, baud: int) -> None:
        self._device, self._baud = device, baud
        self._port: serial.Serial | None = None
        self._reopen()

    def _reopen(self) -> None:
        try:
            self._port = serial.Serial(self._device, self._baud, timeout=0, write_timeout=0, exclusive=True)
        except (OSError, serial.SerialException):
            self._port = None

    def send(self, data: bytes) -> None:
        try:
            if self._port is not None:
                self._port.write(data)
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
        self._port = None

    def close(self) -> None:
        self._drop()


def is_local(host: str) -> bool:
    """Whether a host is this machine, by its loopback address. Raises ConfigError if it has none."""
    try:
        return ipaddress.ip_address(socket.gethostbyname(host)).is_loopback
    except OSError as error:
        raise ConfigError(f"{host!r}: no address of a host: {error.strerror}") from None


def open_link(address: str, secured: bool = False) -> Link:
    """The link of an address. UDP to another machine has to be `secured`: signed, or said to be insecure. Raises ConfigError
    naming what is allowed."""
    kind, _, rest = address.partition(":")
    first, _, last = rest.rpartition(":")
    if kind == "udp" and first and last.isdigit() and 0 < int(last) < 65536:
        if not (secured or is_local(first)):
            raise ConfigError(
                f"--link {address!r}: unsigned UDP leaves this machine, and anybody on its way could drive the thrusters "
                "(allowed: with --link-key FILE, which `robot-agent link-key` makes, or with --link-insecure)"
            )
        try:
            return UdpLink(first, int(last))
        except OSError as error:
            raise ConfigError(f"--link {address!r}: {error.strerror}") from None
    if kind == "serial" and rest:
        device, baud = (first, int(last)) if first and last.isdigit() else (rest, 115200)
        return SerialLink(device, baud)
    raise ConfigError(f"--link {address!r}: not an address of a thruster board (allowed: {FORMS})")

"""SHELL: addresses of thruster boards, and names of serial ports: what programs need that open no port."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from shoal.errors import ConfigError

BOARD_BAUD = 250_000  # of the firmware, as firmware/Makefile builds it; an ATmega at 16 MHz has it exactly
DEFAULT_LINK = f"serial:/dev/ttyACM0:{BOARD_BAUD}"  # right while only one board is plugged in
PORTS_BY_ID = Path("/dev/serial/by-id")  # names that stay with a board; /dev/ttyACM0 is the first one that is plugged in
FORMS = f"udp:HOST:PORT or serial:DEVICE[:BAUD], for example udp:127.0.0.1:14551 or serial:{PORTS_BY_ID}/NAME:{BOARD_BAUD}"
LINK_HELP = f"The thruster board: udp:HOST:PORT or serial:DEVICE[:BAUD], best a DEVICE of {PORTS_BY_ID}."
BAUDS = range(300, 12_000_001)


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


def serial_ports() -> tuple[str, ...]:
    """Names of the serial ports that are plugged in, each of which stays with its board; empty where there are none."""
    return tuple(map(str, sorted(PORTS_BY_ID.iterdir()))) if PORTS_BY_ID.is_dir() else ()


def serial_trouble(device: Path) -> str:
    """The reason why a serial port cannot be opened, as far as can be seen without opening it; empty if it can."""
    if not device.exists():
        return missing_port(str(device), serial_ports())
    if not device.is_char_device():
        return f"{device}: is no serial port"
    if not os.access(device, os.R_OK | os.W_OK):
        return f"{device}: no permission; add the user to its group (sudo usermod -aG dialout USER)"
    return ""


def missing_port(device: str, present: Sequence[str]) -> str:
    """The text about a serial port that does not exist, with the names of those that are `present`."""
    others = f"; there are {', '.join(present)}" if present else ""
    return f"{device}: not there; is the board plugged in, and powered?{others}"


def number_in_name(device: str, present: Sequence[str]) -> str:
    """The text about a serial port that is named by its number while several are `present`; empty for any other."""
    if len(present) < 2 or not device.startswith(("/dev/ttyACM", "/dev/ttyUSB")):
        return ""
    return f"{device}: may be another board's after a reboot, for several are plugged in: choose of {', '.join(present)}"

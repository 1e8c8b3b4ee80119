"""SHELL: the ways into a station's router that has keys: the public port with its guard, and a door for this machine's user.

* At the public port the guard accepts (wire/security/guard.py), in a process of its own, and passes on to two loopback ports
  of the router, one for origins that are new to it and one for those that are known. Another process of this machine could
  find these ports and knock there past the guard; strangers on the network cannot.
* The door is a Unix socket in a folder that only the station's user may enter. Through it go a terminal's orders
  (`groundstation stop`), with an operator's rights, whatever happens at the public port. The router knows by the kind of link
  who comes that way (wire/security/access_control.py); that user could as well read the operator's key.
"""

import contextlib
import errno
import logging
import os
import socket
import stat
import subprocess
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import IO

from wire import programs
from wire.security.access_control import DOOR
from wire.transport.connection_diagnostics import public_listener
from wire.transport.endpoint import Endpoint, parse_address

log = logging.getLogger("shoal")

BACKLOG = 1024
AGAIN_S = 0.2  # between a guard that has ended and the next one
FREED_S = 0.5  # an earlier station's guard may hold the port for so long after its station was killed
ENDS_S = 2.0  # what a guard may take to end
LONGEST_DOOR = 100  # bytes of a Unix socket's path; systems allow 104 (macOS) or 108
INNER_HANDSHAKE_MS = 3000  # the router's own limit behind the guard: PROOF_S of wire/security/admission.py


class Gate:
    """The ways in. Make it, have the router listen at `endpoint`, then `open` it; close it after the router."""

    def __init__(self, endpoint: Endpoint) -> None:
        """Takes the public port. Raises OSError where that cannot be had."""
        self._listener = _public_listener(endpoint.address)
        self._listener.listen(BACKLOG)
        self._public = endpoint
        self._ports = (0, 0)
        self._guard: subprocess.Popen[bytes] | None = None
        self._turn = threading.Lock()  # around the guard's start and end
        self._closed = False
        self._watch = threading.Thread(target=self._watch_guard, name="gate", daemon=True)
        self.endpoint = endpoint
        self.draw()

    def draw(self) -> None:
        """Choose free loopback ports (again, where another program was quicker) for the router to listen at."""
        self._ports = _free_port(), _free_port()
        inner = tuple(f"tls/127.0.0.1:{port}#tls_handshake_timeout_ms={INNER_HANDSHAKE_MS}" for port in self._ports)
        port = parse_address(self._public.address)[2]
        door = door_of(port, make=True)
        if door is None:
            log.warning("no door for this machine: %s is not a folder of this user alone", door_folder())
        self.endpoint = replace(self._public, listens=(*inner, *([f"{DOOR}/{door}"] if door is not None else [])))

    @property
    def inside(self) -> Endpoint:
        """The endpoint for another session of the station's own process, which bypasses the guard."""
        return replace(self._public, address=f"tls/127.0.0.1:{self._ports[1]}", router=False, access=None)

    @property
    def guard_pid(self) -> int:
        """The guard's process, 0 while there is none."""
        return self._guard.pid if self._guard is not None else 0

    def open(self) -> None:
        """Let connections in. The router listens already."""
        self._start()
        self._watch.start()

    def _start(self) -> None:
        with self._turn:
            if self._closed:
                return
            self._guard = programs.start(
                "wire.security.guard",
                [str(self._listener.fileno()), *map(str, self._ports)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                inherits=[self._listener.fileno()],
            )

    def _watch_guard(self) -> None:
        """Tell of whom the guard refused. One that ends is started again: without it no member is connected."""
        while not self._closed:
            guard = self._guard
            if guard is not None:
                assert guard.stdout is not None
                _tell(guard.stdout)
                code = guard.wait()
                if self._closed:
                    return
                log.error("the guard of %s has ended (exit code %d): it is started again", self._public.address, code)
            time.sleep(AGAIN_S)
            try:
                self._start()
            except Exception as error:  # no memory, no process, no thread to be had: again, until there is
                log.error("the guard of %s cannot be started: %s: %s", self._public.address, type(error).__name__, error)
                self._guard = None

    def close(self) -> None:
        """End the guard, and give the port back."""
        with self._turn:
            self._closed = True
        guard = self._guard
        if guard is not None:
            assert guard.stdin is not None
            with contextlib.suppress(OSError):
                guard.stdin.close()
            try:
                guard.wait(ENDS_S)
            except subprocess.TimeoutExpired:
                guard.kill()
                guard.wait()
        if self._watch.is_alive():
            self._watch.join(ENDS_S)
        self._listener.close()


def _public_listener(address: str) -> socket.socket:
    """The socket of the public port. Raises OSError. A station that was killed has a guard that needs a moment to notice."""
    until_s = time.monotonic() + FREED_S
    while True:
        try:
            return public_listener(address)
        except OSError as error:
            if error.errno != errno.EADDRINUSE or time.monotonic() > until_s:
                raise
        time.sleep(0.05)


def _tell(lines: IO[bytes]) -> None:
    for line in lines:
        log.warning("%s", line.decode("utf-8", errors="replace").rstrip("\n"))


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def door_folder() -> Path:
    """The folder of the doors of this user's stations."""
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    return Path(runtime) / "shoal" if runtime else Path(tempfile.gettempdir()) / f"shoal-{os.getuid()}"


def private_folder(make: bool = False) -> Path | None:
    """The folder of what runs for this user, which need not be there; None where it is not the user's alone. With `make` it is
    made."""
    folder = door_folder()
    try:
        if make:
            folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError:
        return None
    private = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not stat.S_IMODE(found.st_mode) & 0o077
    return folder if private else None


def door_of(port: int, make: bool = False) -> Path | None:
    """The door of this user's station at a port, which need not be there; None where the folder is not the user's alone.
    With `make` the folder is made."""
    folder = private_folder(make)
    door = folder / f"station-{port}.sock" if folder is not None else None
    return door if door is not None and len(os.fsencode(door)) <= LONGEST_DOOR else None


def nearest(endpoint: Endpoint) -> Endpoint:
    """Endpoint for a terminal's orders: the station's door, where it runs on this machine as this user; else the given one."""
    _, host, port = parse_address(endpoint.address)
    door = door_of(port)
    if door is None or not _is_here(host) or not _answers(door):
        return endpoint
    return replace(endpoint, address=f"{DOOR}/{door}", keys=None)


def _is_here(host: str) -> bool:
    """True if a program could listen at this address, because it belongs to this machine."""
    try:
        family, kind, _, _, place = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.bind(place)
    except OSError:
        return False
    return True


def _answers(door: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(os.fspath(door))
        except OSError:
            return False
    return True

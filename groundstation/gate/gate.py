"""SHELL: the ways into a station's router that has keys: the public port with its guard, and a door for this machine's user.

* At the public port the guard accepts (guard.py), in a process of its own, and passes on to two loopback ports
  of the router, one for origins that are new to it and one for those that are known. Another process of this machine could
  find these ports and knock there past the guard; strangers on the network cannot.
* The router's door is a Unix socket in a folder that only the station's user may enter. Through it come that user's scripts
  (`import shoal`), with an operator's rights and without a key. The router knows by the kind of link who comes that way
  (shoal/bus/access_control.py); that user could as well read the operator's key. A terminal's requests have a door of
  their own, which is not the router's (own_door.py).
"""

import contextlib
import errno
import logging
import socket
import subprocess
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import IO

from groundstation.gate.own_door import opens
from groundstation.gate.user_folders import fits, user_folders
from shoal.bus.access_control import DOOR
from shoal.bus.connection_diagnostics import public_listener
from shoal.bus.endpoint import Endpoint, parse_address
from shoal.system import programs

log = logging.getLogger("shoal")

BACKLOG = 1024
AGAIN_S = 0.2  # between a guard that has ended and the next one
FREED_S = 0.5  # an earlier station's guard may hold the port for so long after its station was killed
ENDS_S = 2.0  # what a guard may take to end
INNER_HANDSHAKE_MS = 3000  # the router's own limit behind the guard: PROOF_S of admission.py


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
        doors = doors_of(port, make=True)
        if not doors:
            log.warning("no door for this machine: there is no folder of this user alone (%s)", "XDG_RUNTIME_DIR, /tmp")
        self.endpoint = replace(self._public, listens=(*inner, *(f"{DOOR}/{door}" for door in doors[:1])))

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
        """Start the guard's program, which inherits the socket that listens."""
        with self._turn:
            if self._closed:
                return
            self._guard = programs.start(
                "groundstation.gate.guard",
                [str(self._listener.fileno()), *map(str, self._ports)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                inherits=[self._listener.fileno()],
            )

    def _watch_guard(self) -> None:
        """Report the connections that the guard refused, and start the guard again if it ended: without it no member is
        connected."""
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

    def expel(self, port: int) -> None:
        """Have the guard end the connection that reaches the router from this loopback port."""
        with self._turn:
            guard = self._guard
            if guard is not None and guard.stdin is not None and not self._closed:
                with contextlib.suppress(OSError, ValueError):  # it has ended, and its connections with it
                    guard.stdin.write(f"{port}\n".encode())
                    guard.stdin.flush()

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


def doors_of(port: int, make: bool = False) -> list[Path]:
    """Paths at which the router of this user's station at a port may have its door, which need not be there. With `make` the
    folders are made."""
    doors = [folder / f"station-{port}.sock" for folder in user_folders(make)]
    return [door for door in doors if fits(door)]


def through_door(address: str) -> Endpoint | None:
    """Endpoint for a station that runs on this machine as this user: its router's door. None where it has none."""
    _, host, port = parse_address(address)
    open_doors = (door for door in doors_of(port) if opens(door)) if is_here(host) else iter(())
    door = next(open_doors, None)
    return Endpoint(f"{DOOR}/{door}") if door is not None else None


def is_here(host: str) -> bool:
    """True if a program could listen at this address, because it belongs to this machine."""
    try:
        family, kind, _, _, place = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.bind(place)
    except OSError:
        return False
    return True

"""SHELL: notify systemd of the process's start, its robot's mode, and each turn of its control loop (Type=notify,
WatchdogSec).

The protocol of sd_notify(3) is one datagram to the socket that $NOTIFY_SOCKET names. It is sent from the completed control
step only: a separate thread could not vouch for a loop that hangs. The wait for the station, before there is a loop, sends its
own.

The robot's mode is also written to the file `status` of the service's runtime folder, with the process's number:
`groundstation deploy` reads it before it restarts the service (groundstation/deploy/templates/armed.sh).
"""

import contextlib
import os
import socket
from pathlib import Path

from shoal.runtime.output_files import replace_text

TIMES_A_WATCH = 4  # per watchdog period: one may be late and one lost


class ServiceNotifier:
    """Connection to the service manager; without one, every call does nothing."""

    def __init__(self, environment: dict[str, str] | None = None) -> None:
        variables = dict(os.environ) if environment is None else environment
        address = variables.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address  # an abstract socket's begins with an @
        mine = variables.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        watch_us = variables.get("WATCHDOG_USEC", "")
        self._every_ns = int(watch_us) * 1000 // TIMES_A_WATCH if mine and watch_us.isdecimal() else 0
        self._due_ns = 0
        folder = variables.get("RUNTIME_DIRECTORY", "")
        self._status = Path(folder) / "status" if folder else None
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if self._address else None
        if self._socket is not None:
            self._socket.setblocking(False)

    def ready(self, status: str) -> None:
        """Report that the process is ready."""
        self._send(f"READY=1\nSTATUS={status}")

    def mode(self, mode: str, why: str = "") -> None:
        """Report the robot's mode by name, with a reason."""
        if self._status is not None:
            try:
                replace_text(self._status, f"{mode} {os.getpid()}\n", durable=False)
            except OSError:  # without the file a deployment asks for --force; with the mode before it would end a flight
                self._remove_status()
        self._send(f"STATUS={mode.lower()}{f': {why}' if why else ''}")

    def alive(self, now_ns: int) -> None:
        """Report one more turn of the loop. `now_ns` is monotonic."""
        if self._every_ns and now_ns >= self._due_ns:
            self._due_ns = now_ns + self._every_ns
            self._send("WATCHDOG=1")

    def stopping(self) -> None:
        """Report that the process ends by request."""
        self._send("STOPPING=1")
        self._remove_status()

    def _remove_status(self) -> None:
        if self._status is not None:
            with contextlib.suppress(OSError):
                self._status.unlink(missing_ok=True)

    def _send(self, text: str) -> None:
        """Send a line to systemd, if it listens."""
        if self._socket is None:
            return
        try:
            self._socket.sendto(text.encode(), self._address)
        except OSError:  # no listener, or a slow one: the loop does not wait
            return

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

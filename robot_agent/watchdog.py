"""SHELL: telling systemd that this process is up, and that its control loop goes round (Type=notify, WatchdogSec).

The protocol of sd_notify(3) is one datagram to the socket that $NOTIFY_SOCKET names. It goes out from the completed control
step and from nowhere else: no thread of its own could vouch for a loop that hangs. While the process still waits for its
station there is no loop to vouch for; that wait says so itself.
"""

import os
import socket

TIMES_A_WATCH = 4  # per watchdog period: one may be late and one lost


class Watchdog:
    """The service manager's ear; nobody's, where there is none."""

    def __init__(self, environment: dict[str, str] | None = None) -> None:
        found = dict(os.environ) if environment is None else environment
        address = found.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address  # an abstract socket's begins with an @
        mine = found.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        watch_us = found.get("WATCHDOG_USEC", "")
        self._every_ns = int(watch_us) * 1000 // TIMES_A_WATCH if mine and watch_us.isdecimal() else 0
        self._due_ns = 0
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if self._address else None
        if self._socket is not None:
            self._socket.setblocking(False)

    def ready(self, status: str) -> None:
        """The process does what it is for."""
        self._send(f"READY=1\nSTATUS={status}")

    def alive(self, now_ns: int) -> None:
        """The loop has gone round once more. `now_ns` is monotonic."""
        if self._every_ns and now_ns >= self._due_ns:
            self._due_ns = now_ns + self._every_ns
            self._send("WATCHDOG=1")

    def stopping(self) -> None:
        """The process ends because it was told to."""
        self._send("STOPPING=1")

    def _send(self, text: str) -> None:
        if self._socket is None:
            return
        try:
            self._socket.sendto(text.encode(), self._address)
        except OSError:  # nobody listens, or too slowly: the loop does not wait for that
            return

    def close(self) -> None:
        """Forget the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

"""SHELL: a station's own door for the requests of this machine's user: a Unix socket apart from Zenoh and its ports.

Nothing that happens on the network holds it up: it has a thread of its own, and neither sessions, certificates nor limits. The
folder that it stands in lets nobody else in (user_folders.py). A connection carries one request and its reply,
each a head of lengths and then bytes.
"""

import contextlib
import os
import socket
import struct
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from socketserver import StreamRequestHandler, ThreadingUnixStreamServer
from typing import Any, NoReturn

from shoal.bus.transport import Await
from shoal.system.open_files import NO_FILES, REST_S

LocalAnswer = Callable[[str, bytes, bytes], bytes | None]  # arguments: key, payload, header; None: nobody answers to this key

REQUEST = struct.Struct("!III")  # bytes of key, payload, header
REPLY = struct.Struct("!I")
MOST_BYTES = 1 << 20  # of a request or a reply: a GO has some hundred bytes, a reply of 49 robots some thousand
REQUEST_S = 2.0  # from a connection to its whole request
TRY_AGAIN_S = 0.1  # where no door opens


class _Server(ThreadingUnixStreamServer):
    daemon_threads = True
    block_on_close = False
    request_queue_size = 128

    def __init__(self, path: Path, answer: LocalAnswer) -> None:
        self.answer = answer
        super().__init__(os.fspath(path), _Handler)

    def get_request(self) -> tuple[Any, Any]:
        """Accept a terminal's connection. Without a free file descriptor the terminal stays in the queue, and the loop rests:
        it would be called again at once, for ever."""
        try:
            return super().get_request()
        except OSError as error:
            if error.errno in NO_FILES:
                time.sleep(REST_S)
            raise


class _Handler(StreamRequestHandler):
    timeout = REQUEST_S
    server: _Server

    def handle(self) -> None:
        with contextlib.suppress(OSError, EOFError, ValueError):  # the terminal's trouble, which notices that nobody answers
            key, payload, header = _read_request(self.rfile.read, REQUEST)
            reply = self.server.answer(key.decode(), payload, header)
            if reply is not None:
                self.wfile.write(REPLY.pack(len(reply)) + reply)


def _read_request(read: Callable[[int], bytes], head: struct.Struct) -> list[bytes]:
    """Read a head and the parts whose lengths it has. Raises EOFError, or ValueError for lengths that none can have."""
    sizes = head.unpack(_whole(read, head.size))
    if sum(sizes) > MOST_BYTES:
        raise ValueError(f"{sum(sizes)} bytes (allowed: {MOST_BYTES})")
    return [_whole(read, size) for size in sizes]


def _whole(read: Callable[[int], bytes], size: int) -> bytes:
    """Read exactly `size` bytes. Raises EOFError if there are fewer."""
    data = read(size)
    if len(data) < size:
        raise EOFError
    return data


class OwnDoor:
    """The station's side. Raises OSError where the socket cannot be made."""

    def __init__(self, path: Path, answer: LocalAnswer) -> None:
        self._path, self._server = path, _Server(path, answer)
        self._thread = threading.Thread(target=self._server.serve_forever, name="door", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Close the door, and remove its socket."""
        self._path.unlink(missing_ok=True)
        self._server.shutdown()
        self._server.server_close()


class DoorTransport:
    """A terminal's side: a transport (shoal/bus/transport.py) that takes requests, and nothing else."""

    def __init__(self, doors: Sequence[Path]) -> None:
        """`doors` all lead to one station: the first that opens is taken."""
        self._doors = doors

    def ask(self, key: str, payload: bytes, header: bytes, timeout_s: float) -> Await:
        """Send a request now; the result waits for its reply."""
        deadline_s = time.monotonic() + timeout_s
        parts = key.encode(), payload, header
        connection = self._connect(deadline_s, REQUEST.pack(*map(len, parts)) + b"".join(parts))

        def answer() -> bytes | None:
            if connection is None:
                time.sleep(TRY_AGAIN_S)
                return None
            with connection, contextlib.suppress(OSError, EOFError, ValueError), connection.makefile("rb") as file:
                connection.settimeout(max(deadline_s - time.monotonic(), TRY_AGAIN_S))
                return _read_request(file.read, REPLY)[0]
            time.sleep(TRY_AGAIN_S)  # the door has closed without a reply: the station is about to serve, or to end
            return None

        return answer

    def _connect(self, deadline_s: float, request: bytes) -> socket.socket | None:
        """A connection to the first door that is open, with the request sent; None if all are closed."""
        for door in self._doors:
            connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            try:
                connection.settimeout(max(deadline_s - time.monotonic(), TRY_AGAIN_S))
                connection.connect(os.fspath(door))
                connection.sendall(request)
                return connection
            except OSError:
                connection.close()
        return None

    def _none(self, *arguments: object, **options: object) -> NoReturn:
        raise TypeError("a station's own door takes requests only")

    publisher = subscribe = collect = serve = announce = watch = _none

    def close(self) -> None:
        """Nothing stays open between two requests."""


def opens(door: Path) -> bool:
    """True if a station listens at a door."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.settimeout(TRY_AGAIN_S)
            probe.connect(os.fspath(door))
        except BlockingIOError:  # a queue of others waits there
            return True
        except OSError:
            return False
    return True

"""SHELL: strangers at a port of this machine: short connections, silent ones, and handshakes without a certificate; also
holders of a certificate, who say no more than it takes to show it, or open one session after the other.

Loopback addresses only, and bounded in number and time: what they attack is started by the test itself.
"""

import contextlib
import json
import socket
import ssl
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

import zenoh

from shoal.bus.endpoint import Endpoint, settings
from shoal.bus.key_ring import Keys

MOST_HALF_OPEN = 1000
MOST_PER_S = 500
MOST_S = 30.0
REPLACED = 20  # half-open connections that were closed, ten times a second


def _unsuspecting() -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return context


class Strangers:
    """Attack a port from `source` until the context ends, or MOST_S have passed.

    `knocks_hz`: connections that send five bytes and close. `half_open`: connections that stay and say nothing; those that
    are closed are replaced. `handshakes_hz`: whole TLS handshakes without a certificate. `certificate`: folder of a
    certificate and its key, with which each half-open connection completes its handshake."""

    def __init__(
        self,
        port: int,
        source: str = "127.0.0.1",
        *,
        knocks_hz: float = 0.0,
        half_open: int = 0,
        handshakes_hz: float = 0.0,
        certificate: Path | None = None,
    ) -> None:
        assert source.startswith("127.") and half_open <= MOST_HALF_OPEN and max(knocks_hz, handshakes_hz) <= MOST_PER_S
        self._port, self._source = port, source
        self._over = threading.Event()
        self._held: list[socket.socket] = []
        self._half_open = half_open
        self.made = 0  # connections, of all kinds
        self._context = _unsuspecting()
        if certificate is not None:
            self._context.load_cert_chain(certificate / "cert.pem", certificate / "key.pem")
        self._shows = certificate is not None
        ways: list[tuple[Callable[[], None], float]] = [(self._knock, knocks_hz), (self._handshake, handshakes_hz)]
        ways.append((self._hold, 10.0 if half_open else 0.0))
        self._threads = [threading.Thread(target=self._at, args=way, daemon=True) for way in ways if way[1]]

    def _connect(self) -> socket.socket:
        self.made += 1
        return socket.create_connection(("127.0.0.1", self._port), timeout=1.0, source_address=(self._source, 0))

    def _at(self, once: Callable[[], None], rate_hz: float) -> None:
        begin_s, count = time.monotonic(), 0
        while not self._over.wait(max(begin_s + count / rate_hz - time.monotonic(), 0.0)):
            if time.monotonic() - begin_s > MOST_S:
                return
            count += 1
            with contextlib.suppress(OSError):
                once()

    def _knock(self) -> None:
        with self._connect() as stranger:
            stranger.sendall(b"hello")

    def _handshake(self) -> None:
        with self._context.wrap_socket(self._connect()) as stranger:
            stranger.settimeout(0.2)
            stranger.recv(1)

    def _hold(self) -> None:
        for held in list(self._held):
            held.setblocking(False)
            with contextlib.suppress(BlockingIOError, ssl.SSLWantReadError):
                with contextlib.suppress(ConnectionError, ssl.SSLError):
                    if held.recv(1):
                        continue
                held.close()
                self._held.remove(held)
        missing = self._half_open - len(self._held)
        for _ in range(missing if self.made < self._half_open else min(missing, REPLACED)):
            if not self._over.is_set():
                one = self._connect()
                self._held.append(self._context.wrap_socket(one) if self._shows else one)

    @property
    def held(self) -> int:
        """Connections that stand, as of the last look."""
        return len(self._held)

    def __enter__(self) -> "Strangers":
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join()
        for held in self._held:
            held.close()


class Sessions:
    """Zenoh sessions with one certificate from `source`, as many as are let in, up to `count`."""

    def __init__(self, address: str, source: str, keys: Path, count: int) -> None:
        assert source.startswith("127.") and count <= MOST_HALF_OPEN
        self._where = Endpoint(f"{address}#bind={source}:0", keys=Keys(keys))
        self._count, self._over, self._sessions = count, threading.Event(), list[zenoh.Session]()
        self.tried = 0
        self._thread = threading.Thread(target=self._attack, daemon=True)

    def _attack(self) -> None:
        while self.tried < self._count and not self._over.is_set():
            self.tried += 1
            try:
                self._sessions.append(self._session())
            except zenoh.ZError:
                time.sleep(0.1)

    def _session(self) -> zenoh.Session:
        config = zenoh.Config()
        for key, value in settings(self._where).items():
            config.insert_json5(key, json.dumps(value))
        return zenoh.open(config)

    def open(self) -> int:
        """The number of sessions that have a link to the router."""
        return sum(bool(session.info.routers_zid()) for session in self._sessions)

    def __enter__(self) -> "Sessions":
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        self._thread.join()
        for session in self._sessions:
            session.close()

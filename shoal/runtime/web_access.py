"""Access to the pages that our programs serve: addresses, origins, tokens, headers. Pure.

On loopback the danger is another page in the same browser: so the request's Host must be this machine by a name that nobody
else can own (no rebinding), and a WebSocket's Origin must be that same host. Off loopback the network is the danger: TLS and a
token are then not optional.
"""

import hmac
import re
from collections.abc import Awaitable, Callable, Iterable, MutableMapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shoal.errors import ConfigError
from shoal.system.loopback import is_loopback

SHORTEST_TOKEN = 16
_LOCAL_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})
_HOST = re.compile(r"(?:\[([0-9A-Fa-f:.]{2,45})\]|([A-Za-z0-9.-]{1,253}))(?::([0-9]{1,5}))?")  # of a Host header: name, port

HEADERS = {
    "content-security-policy": "default-src 'self'; img-src 'self' blob: data:; style-src 'self' 'unsafe-inline'; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}


@dataclass(frozen=True)
class WebOptions:
    """Address, certificate and token of the page's server."""

    host: str = "127.0.0.1"
    port: int = 8000
    certificate: Path | None = None
    key: Path | None = None
    token: str = ""

    @property
    def local(self) -> bool:
        """True if only this machine can reach it."""
        return is_loopback(self.host)

    @property
    def url(self) -> str:
        """Address to open in a browser."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'https' if self.certificate else 'http'}://{host}:{self.port}/"


def web_options(address: str, certificate: Path | None = None, key: Path | None = None, token: str = "") -> WebOptions:
    """Checked options from `host:port`. Raises ConfigError for what would be open to others without TLS and a token."""
    host, _, port = address.rpartition(":")
    host = host.strip("[]")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ConfigError(f"--web {address!r}: must be HOST:PORT, for example 127.0.0.1:8000")
    if (certificate is None) != (key is None):
        raise ConfigError("--web-certificate and --web-key: one without the other is of no use")
    options = WebOptions(host, int(port), certificate, key, token)
    if not options.local and (certificate is None or len(token) < SHORTEST_TOKEN):
        raise ConfigError(
            f"--web {address}: other machines could command the robots; off loopback the page needs "
            f"--web-certificate, --web-key and --web-token-file with a token of {SHORTEST_TOKEN} characters or more"
        )
    return options


def host_allowed(options: WebOptions, host: str) -> bool:
    """True if a request with this Host header may be answered."""
    match = _HOST.fullmatch(host)
    if match is None:
        return False
    name = match[1] or match[2]
    return not options.local or name.lower() in _LOCAL_NAMES or name == options.host


def origin_allowed(options: WebOptions, host: str, origin: str) -> bool:
    """True if a WebSocket comes from our own page: scheme and host of its Origin are those of the request itself."""
    return host_allowed(options, host) and origin == f"{'https' if options.certificate else 'http'}://{host}"


def token_allowed(options: WebOptions, token: str) -> bool:
    """Compared in constant time."""
    return hmac.compare_digest(options.token.encode(), token.encode())


Scope = MutableMapping[str, Any]
Channel = Callable[..., Awaitable[Any]]


def body_fits(headers: Iterable[tuple[bytes, bytes]], longest_body: int) -> bool:
    """True if a request with these headers has a body of at most so many bytes. One that does not say its length has too
    many."""
    fields = dict(headers)
    length = fields.get(b"content-length", b"0")
    return b"transfer-encoding" not in fields and length.isdigit() and len(length) < 19 and int(length) <= longest_body


class Guarded:
    """An ASGI application that answers only to names that are ours, reads no body that nobody wants, and puts the security
    headers on everything."""

    def __init__(self, app: Any, options: WebOptions, longest_body: int = 0) -> None:
        """`longest_body`: bytes of a request."""
        self._app, self._options, self._longest_body = app, options, longest_body

    async def __call__(self, scope: Scope, receive: Channel, send: Channel) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        host = next((value.decode("latin-1") for name, value in scope["headers"] if name == b"host"), "")
        if not body_fits(scope["headers"], self._longest_body):
            await _refuse(send, 413, f"the longest body that is read has {self._longest_body} bytes")
            return
        if not host_allowed(self._options, host):
            await _refuse(send, 421, "this page has another name")
            return

        async def send_guarded(message: Any) -> None:
            if message["type"] == "http.response.start":
                hashed = scope["path"].startswith("/assets/")
                always = {"cache-control": "public, max-age=31536000, immutable" if hashed else "no-cache"}
                own = {name.decode("latin-1"): value for name, value in message["headers"]} | _bytes(always)
                headers = _bytes(HEADERS) | own
                message = {**message, "headers": [(name.encode("latin-1"), value) for name, value in headers.items()]}
            await send(message)

        await self._app(scope, receive, send_guarded)


async def _refuse(send: Channel, status: int, why: str) -> None:
    """Answer, and close the connection: what still comes of the request is not read."""
    headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"connection", b"close")]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": why.encode()})


def _bytes(headers: dict[str, str]) -> dict[str, bytes]:
    return {name: value.encode("latin-1") for name, value in headers.items()}

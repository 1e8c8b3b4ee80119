"""SHELL: connections that are no pages yet: each has to ask for something soon, and no address may hold many.

A browser sends its request with the connection, and its few requests are answered within a second. A connection that sends
no request, or does not take the answer, is aborted after a time; an address with too many connections loses its oldest.
"""

import asyncio
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

ASKS_WITHIN_S = 5.0  # from the connection, or from the answer before
TAKES_WITHIN_S = 30.0  # the answer: the page is 60 kB
HANDSHAKE_WITHIN_S = 5.0  # TLS
MOST_EACH = 32  # from one address: a browser opens six, and a lab's pages may come from one proxy
MOST = 128


class ConnectionLimiter:
    """Connections that are no pages yet, the oldest first, with the addresses that they come from."""

    def __init__(self) -> None:
        self._from: dict[Any, str] = {}

    def join(self, connection: Any, address: str) -> None:
        """Note a new connection. Ends the oldest one where its address, or all together, hold too many."""
        self._from[connection] = address
        if list(self._from.values()).count(address) > MOST_EACH:
            self._end_oldest(address)
        elif len(self._from) > MOST:
            addresses = list(self._from.values())
            self._end_oldest(max(set(addresses), key=addresses.count))

    def leave(self, connection: Any) -> None:
        """Forget a connection that has gone, or become a page."""
        self._from.pop(connection, None)

    def _end_oldest(self, address: str) -> None:
        oldest = next(connection for connection, from_address in self._from.items() if from_address == address)
        self.leave(oldest)
        oldest.transport.abort()


def http_class(limiter: ConnectionLimiter) -> type[H11Protocol]:
    """uvicorn's protocol class for a connection, which aborts one that neither asks nor takes its answer in time."""

    class LimitedConnection(H11Protocol):
        _deadline: asyncio.TimerHandle | None = None

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            self._expect_within(ASKS_WITHIN_S)
            limiter.join(self, self.client[0] if self.client else "")

        def handle_events(self) -> None:
            cycle = self.cycle
            super().handle_events()
            if self.cycle is not cycle:
                self._expect_within(TAKES_WITHIN_S)

        def on_response_complete(self) -> None:
            super().on_response_complete()
            self._expect_within(ASKS_WITHIN_S)

        def handle_websocket_upgrade(self, event: Any) -> None:
            self._leave()
            super().handle_websocket_upgrade(event)

        def connection_lost(self, exc: Exception | None) -> None:
            self._leave()
            super().connection_lost(exc)

        def _expect_within(self, within_s: float) -> None:
            if self._deadline is not None:
                self._deadline.cancel()
            self._deadline = self.loop.call_later(within_s, self._abort)

        def _abort(self) -> None:
            if self.transport is not None:
                self.transport.abort()

        def _leave(self) -> None:
            if self._deadline is not None:
                self._deadline.cancel()
            limiter.leave(self)

    return LimitedConnection

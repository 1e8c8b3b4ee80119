"""SHELL: connections that are no pages yet: each has to ask for something soon, and no address may hold many.

A browser sends its request with the connection, and its few requests are answered within a second. Whoever opens connections
and says nothing, or asks and never takes the answer, keeps no place that a page needs: from one address the oldest goes when
one too many comes.
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


def http_class(crowd: ConnectionLimiter) -> type[H11Protocol]:
    """uvicorn's protocol for a connection, with an end to its patience."""

    class Patient(H11Protocol):
        _deadline: asyncio.TimerHandle | None = None

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            self._wait(ASKS_WITHIN_S)
            crowd.join(self, self.client[0] if self.client else "")

        def handle_events(self) -> None:
            cycle = self.cycle
            super().handle_events()
            if self.cycle is not cycle:
                self._wait(TAKES_WITHIN_S)

        def on_response_complete(self) -> None:
            super().on_response_complete()
            self._wait(ASKS_WITHIN_S)

        def handle_websocket_upgrade(self, event: Any) -> None:
            self._gone()
            super().handle_websocket_upgrade(event)

        def connection_lost(self, exc: Exception | None) -> None:
            self._gone()
            super().connection_lost(exc)

        def _wait(self, within_s: float) -> None:
            if self._deadline is not None:
                self._deadline.cancel()
            self._deadline = self.loop.call_later(within_s, self._give_up)

        def _give_up(self) -> None:
            if self.transport is not None:
                self.transport.abort()

        def _gone(self) -> None:
            if self._deadline is not None:
                self._deadline.cancel()
            crowd.leave(self)

    return Patient

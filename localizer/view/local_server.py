"""SHELL: pages for browsers of this machine (`localizer run --show`, `localizer setup`), and streams of pictures on them.

A browser shows a multipart JPEG stream by itself; over SSH, `ssh -L 8090:127.0.0.1:8090 camera-computer`. Viewers are few.
Each gets the newest picture when it is ready for one, and one that stops reading is dropped, so none slows the localizer.
"""

import asyncio
import contextlib
import errno
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse
from starlette.routing import BaseRoute

from shoal.errors import ConfigError
from shoal.runtime.runtime import Stop, guarded_thread, log
from shoal.runtime.web_access import Channel, Guarded, Scope, WebOptions

MOST_VIEWERS = 4  # of a stream; each has a thread while it waits for a picture
_TAKEN_WITHIN_S = 5.0  # s after which a viewer that stopped reading is dropped
_GRACE_S = 2  # s that open streams get when the program ends
_BOUNDARY = "picture"


def bind(port: int, option: str) -> socket.socket:
    """A socket at 127.0.0.1 that listens; port 0: any that is free. Raises ConfigError, which names the option."""
    try:
        return socket.create_server(("127.0.0.1", port))
    except (OSError, OverflowError) as error:
        in_use = isinstance(error, OSError) and error.errno == errno.EADDRINUSE
        raise ConfigError(f"{option} {port}: {'in use' if in_use else error} (choose another one)") from None


class LocalServer:
    """A thread that serves `routes` at a socket of `bind`, to requests for this machine by its own names only."""

    def __init__(
        self, routes: Sequence[BaseRoute], options: WebOptions, bound: socket.socket, stop: Stop, longest_body: int = 0
    ) -> None:
        """`longest_body`: bytes of a request."""
        config = uvicorn.Config(
            Guarded(Starlette(routes=routes, exception_handlers={Exception: _failed}), options, longest_body),
            loop="asyncio",
            ws="none",
            lifespan="off",
            log_config=None,
            log_level="critical",  # it tells a viewer that was dropped as an error; ours are told by _failed
            access_log=False,
            server_header=False,
            timeout_graceful_shutdown=_GRACE_S,
        )
        self._server, self._socket = uvicorn.Server(config), bound
        self._thread = guarded_thread(stop, "page", lambda: self._server.run(sockets=[bound]), daemon=True)
        self._thread.start()

    @property
    def serves(self) -> bool:
        """False once it has ended."""
        return self._thread.is_alive()

    def close(self) -> None:
        """End it. Streams have to end by themselves, or are cut off."""
        self._server.should_exit = True
        self._thread.join()
        self._socket.close()


def page_name(request: Request) -> str:
    """The name that a page gives itself."""
    return request.query_params.get("page", "")[:40]


async def _failed(request: Request, error: Exception) -> Response:
    log.error("page: %s", request.url.path, exc_info=error)
    return PlainTextResponse("an error of this program: its log has it", 500)


class PictureStream:
    """A stream of JPEG pictures for a few viewers.

    `newest(last_number)` waits for a picture with another number and returns its number and bytes (none: no picture yet), or
    after a while the same one again, by which viewers that left are noticed. It returns None when the stream ends.
    """

    def __init__(self, newest: Callable[[int], tuple[int, bytes] | None]) -> None:
        self._newest = newest
        self._places = threading.BoundedSemaphore(MOST_VIEWERS)
        self._viewers: list[str] = []  # by the names of their pages

    def answer(self, request: Request) -> Response:
        """The stream, or a refusal where all places are taken."""
        if not self._places.acquire(blocking=False):
            return PlainTextResponse(f"{MOST_VIEWERS} viewers already", 503)
        page = page_name(request)
        self._viewers.append(page)

        def ended() -> None:
            self._viewers.remove(page)
            self._places.release()

        return _Stream(self._multipart(), ended)

    def has_viewer(self, page: str) -> bool:
        """True if a page is being sent the pictures."""
        return page in self._viewers

    def _multipart(self) -> Iterator[bytes]:
        """Pictures as an endless multipart response (MJPEG)."""
        last_number = 0
        yield f"--{_BOUNDARY}\r\n".encode()
        while (news := self._newest(last_number)) is not None:
            last_number, jpeg = news
            head = f"Content-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
            # with the next boundary at once, as browsers show a picture only when it has come
            yield head.encode() + jpeg + f"\r\n--{_BOUNDARY}\r\n".encode() if jpeg else b""


class _Stream(StreamingResponse):
    """A stream that ends when its viewer leaves or stops reading. `ended` is called once, however it ends."""

    def __init__(self, parts: Iterator[bytes], ended: Callable[[], None]) -> None:
        headers = {"cache-control": "no-store"}
        super().__init__(parts, headers=headers, media_type=f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
        self._ended = ended

    async def __call__(self, scope: Scope, receive: Channel, send: Channel) -> None:
        async def in_time(message: Any) -> None:
            await asyncio.wait_for(send(message), _TAKEN_WITHIN_S)

        try:
            with contextlib.suppress(TimeoutError):
                await super().__call__(scope, receive, in_time)
        finally:
            self._ended()

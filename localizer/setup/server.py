"""SHELL: the server of the setup's page, for browsers of this machine that have its key.

GET /live is the picture (multipart JPEG), GET /state what the page shows, POST /do one request: {"do": name, ...}. A request
of another page of the same browser has no key.
"""

import asyncio
import socket
import subprocess
import time
from pathlib import Path
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from localizer.setup.camera_feed import CameraFeed
from localizer.setup.session import SetupSession
from localizer.view.local_server import LocalServer, PictureStream, page_name
from shoal.errors import ConfigError
from shoal.runtime.runtime import SLICE_S, Stop
from shoal.runtime.web_access import WebOptions, token_allowed
from shoal.system import programs

STATIC = Path(__file__).parent / "static"
_PAGE_GONE_S = 3.0  # s without a look at the state after which a page counts as closed
STOPS_WITHIN_S = 15.0  # of a stop of every station here; it tells within 5 s what it has reached
_LONGEST_REQUEST = 100_000  # bytes; a mask of a thousand corners has 20,000


class SetupServer:
    """The page's server: `run` until told to stop."""

    def __init__(self, session: SetupSession, feed: CameraFeed, bound: socket.socket, key: str) -> None:
        self._session, self._socket = session, bound
        self._options = WebOptions(port=bound.getsockname()[1], token=key)
        self._stream = PictureStream(feed.next)
        self._pages: dict[str, float] = {}  # by the name that each gives itself: when it looked last

    @property
    def address(self) -> str:
        """URL for a browser, with the key behind #, which no server or log is told."""
        return f"{self._options.url}#key={self._options.token}"

    def run(self, stop: Stop) -> None:
        """Serve until told to stop."""
        routes = [
            Route("/", self._index),
            Route("/live", self._live),
            Route("/state", self._state),
            Route("/do", self._answer_request, methods=["POST"]),
            Mount("/", StaticFiles(directory=STATIC)),
        ]
        server = LocalServer(routes, self._options, self._socket, stop, _LONGEST_REQUEST)
        while not stop.requested and server.serves:
            time.sleep(SLICE_S)
        server.close()

    def _allowed(self, request: Request) -> bool:
        return token_allowed(self._options, request.headers.get("x-key") or request.query_params.get("key", ""))

    async def _index(self, request: Request) -> Response:
        return FileResponse(STATIC / "setup.html")

    def _live(self, request: Request) -> Response:
        if not self._allowed(request):
            return _refused()
        return self._stream.answer(request)

    def _state(self, request: Request) -> Response:
        if not self._allowed(request):
            return _refused()
        now_s, page = time.monotonic(), page_name(request)
        self._pages[page] = now_s
        self._pages = {page: at_s for page, at_s in self._pages.items() if now_s - at_s < _PAGE_GONE_S}
        return JSONResponse(self._session.state(len(self._pages)) | {"streams": self._stream.has_viewer(page)})

    async def _answer_request(self, request: Request) -> Response:
        """Do what the page asks for, in a thread. The reply holds a problem or what was found."""
        if not self._allowed(request):
            return _refused()
        try:
            arguments: dict[str, Any] = dict(await request.json())
        except (ValueError, TypeError, RecursionError):
            return PlainTextResponse("not a JSON object", 400)
        if arguments.get("do") == "stop":  # in threads that nothing else takes
            return JSONResponse({"problem": "", "found": await asyncio.to_thread(_stop_fleet)})
        try:
            answer: Any = await run_in_threadpool(self._session.do, str(arguments.pop("do", "")), arguments)
        except ConfigError as error:
            return JSONResponse({"problem": str(error)})
        return JSONResponse({"problem": "", "found": answer})


def _stop_fleet() -> str:
    """Give the emergency stop to every station of this machine, as `groundstation stop` does; returns what became of it at
    each."""
    with programs.start("groundstation", ["stop"], stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as stopping:
        try:
            output, _ = stopping.communicate(timeout=STOPS_WITHIN_S)
        except subprocess.TimeoutExpired:
            stopping.kill()
            return f"emergency stop: no answer within {STOPS_WITHIN_S:g} s"
    lines = output.decode(errors="replace").strip().splitlines()
    stations, outcomes = ([line for line in lines if line.startswith(begin)] for begin in ("station ", "stop: "))
    if len(outcomes) > 1:  # the last is that of one of them only
        return "; ".join(f"{name}: {outcome}" for name, outcome in zip(stations, outcomes, strict=False))
    return (outcomes or lines[-1:] or [f"emergency stop: ended with exit code {stopping.returncode}"])[0]


def _refused() -> Response:
    return PlainTextResponse("the key is missing or wrong: open the address that localizer setup printed", 403)

"""SHELL: serves the operator's page from a thread of its own, with its own event loop.

with WebServer(backend, options): ...                  # binds when it is made, or says why not
"""

import asyncio
import contextlib
import logging
import socket
import ssl
import threading
import time
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles

from groundstation.web import protocol
from groundstation.web.backend import Backend
from groundstation.web.client_hub import ClientHub
from groundstation.web.connection_limits import HANDSHAKE_WITHIN_S, ConnectionLimiter, http_class
from groundstation.web.run_desk import REPORT_POLICY, RunDesk
from shoal.errors import ConfigError
from shoal.runtime.runtime import log
from shoal.runtime.web_access import Guarded, WebOptions
from shoal.system.secret_files import refuse_shared

STATIC = Path(__file__).parent / "static"
START_WITHIN_S = 30.0  # on a starved machine; then the station does not start, and says why

SAY_AGAIN_S = 10.0  # how often a text of a library is told
MOST_TEXTS = 100  # that are told at all
LONGEST_LINE = 300  # characters of one
FAREWELL_WITHIN_S = 1.0  # a page's thread that hangs delays no exit


def make_app(hub: ClientHub, desk: RunDesk, options: WebOptions) -> Any:
    """The ASGI application."""

    @contextlib.asynccontextmanager
    async def lifespan(app: Starlette) -> Any:
        pump = asyncio.create_task(hub.pump())
        pump.add_done_callback(_told_why)
        try:
            yield
        finally:
            pump.cancel()
            hub.close()

    async def index(request: Any) -> FileResponse:
        return FileResponse(STATIC / "index.html")

    def report(request: Request) -> Response:
        file = desk.report(request.path_params["run"], request.query_params.get("key", ""))
        if file is None:
            return PlainTextResponse("no such report", 404)
        return FileResponse(file, headers={"content-security-policy": REPORT_POLICY})

    routes = [
        Route("/", index),
        Route("/runs/{run}/report.html", report),
        WebSocketRoute("/live", hub.watch),
        Mount("/", StaticFiles(directory=STATIC)),
    ]
    return Guarded(Starlette(routes=routes, lifespan=lifespan), options)


def _told_why(pump: asyncio.Task[None]) -> None:
    if not pump.cancelled() and pump.exception() is not None:
        log.error("page: stopped: %r", pump.exception())


class _Loop(asyncio.SelectorEventLoop):
    """Gives a connection that does not finish its TLS handshake up sooner than asyncio does."""

    async def create_server(self, *arguments: Any, **options: Any) -> asyncio.Server:
        if options.get("ssl") is not None:
            options.setdefault("ssl_handshake_timeout", HANDSHAKE_WITHIN_S)
        return await super().create_server(*arguments, **options)


def bind(options: WebOptions) -> socket.socket:
    """The page's socket, bound. Raises ConfigError if the address cannot be had, or the certificate not be used."""
    if options.certificate is not None:
        try:
            ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(options.certificate, options.key)
        except OSError as error:
            files = f"--web-certificate {options.certificate}, --web-key {options.key}"
            raise ConfigError(f"{files}: {error.strerror or error} (two files in PEM are needed)") from None
        refuse_shared(options.key or options.certificate, "the page's private key")
    bound = socket.socket(socket.AF_INET6 if ":" in options.host else socket.AF_INET, socket.SOCK_STREAM)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        bound.bind((options.host, options.port))
    except OSError as error:
        bound.close()
        raise ConfigError(f"--web {options.host}:{options.port}: {error.strerror} (another address, or --no-web)") from None
    return bound


class SeldomRelay(logging.Handler):
    """Takes a library's lines into our log, each text once in SAY_AGAIN_S with the number since: a stranger at the page's port
    must not fill the log."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._counts: dict[str, int] = {}  # of each text since it was told
        self._told_s: dict[str, float] = {}

    def emit(self, record: logging.LogRecord) -> None:
        """Log a stranger's message; of the same text within SAY_AGAIN_S only the number, with the next one."""
        text, now_s = str(record.msg), time.monotonic()  # without arguments: these are the stranger's
        if now_s - self._told_s.get(text, float("-inf")) < SAY_AGAIN_S or (
            text not in self._told_s and len(self._told_s) >= MOST_TEXTS
        ):
            self._counts[text] = self._counts.get(text, 0) + (text in self._told_s)
            return
        self._told_s[text] = now_s
        count = self._counts.pop(text, 0)
        more = f" ({count} more of them since last told)" if count else ""
        log.log(record.levelno, "page: %s%s", record.getMessage()[:LONGEST_LINE], more, exc_info=record.exc_info)


class WebServer:
    """The page's thread. A page that fails says so in the log and is gone; the station flies on."""

    def __init__(self, source: Backend, options: WebOptions, bound: socket.socket | None = None) -> None:
        """Serve at `bound`; None: `bind` here."""
        self._failure, self._where = "", f"{options.host}:{options.port}"
        self._loop: asyncio.AbstractEventLoop | None = None
        self._socket = bound or bind(options)
        for name in ("uvicorn.error", "websockets.server"):
            logging.getLogger(name).handlers, logging.getLogger(name).propagate = [SeldomRelay()], False
        desk = RunDesk(source.run_dir)
        self._hub = ClientHub(source, options, desk)
        config = uvicorn.Config(
            make_app(self._hub, desk, options),
            loop="asyncio",
            http=http_class(ConnectionLimiter()),
            ws="websockets-sansio",
            ws_max_size=protocol.LONGEST_BYTES,
            ws_per_message_deflate=False,  # costs more time than a local network's bytes
            ws_ping_interval=5.0,
            ws_ping_timeout=20.0,
            lifespan="on",
            log_config=None,
            log_level="warning",
            access_log=False,
            server_header=False,
            date_header=False,
            timeout_graceful_shutdown=1,
            ssl_certfile=options.certificate,
            ssl_keyfile=options.key,
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._run, name="page", daemon=True)

    @property
    def watched(self) -> bool:
        """True if a page is open."""
        return self._hub.watched

    def _run(self) -> None:
        """Serve the page in this thread. An error is logged, and ends the page but not the flight."""
        try:
            with asyncio.Runner(loop_factory=_Loop) as runner:
                self._loop = runner.get_loop()
                runner.run(self._server.serve(sockets=[self._socket]))
        except (Exception, SystemExit) as error:  # the flight does not depend on the page
            self._failure = f"{type(error).__name__}: {error}"
            log.error("page: %s", self._failure)

    def __enter__(self) -> "WebServer":
        self._thread.start()
        deadline = time.monotonic() + START_WITHIN_S
        while not self._server.started and self._thread.is_alive() and time.monotonic() < deadline:
            time.sleep(0.005)
        if not self._server.started:
            failure = self._failure or f"it has not come up within {START_WITHIN_S:g} s"
            self.__exit__()
            raise ConfigError(f"--web {self._where}: {failure} (try again, or --no-web)")
        return self

    def __exit__(self, *exception: object) -> None:
        if self._server.started and self._loop is not None and self._thread.is_alive():
            with contextlib.suppress(TimeoutError, RuntimeError):  # it hangs, or has just ended
                asyncio.run_coroutine_threadsafe(self._hub.farewell(), self._loop).result(FAREWELL_WITHIN_S)
        self._server.should_exit = True
        self._thread.join(START_WITHIN_S)
        self._socket.close()

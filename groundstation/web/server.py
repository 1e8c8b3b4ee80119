"""SHELL: serves the operator's page from a thread of its own, with its own event loop.

with WebServer(backend, options): ...                  # binds when it is made, or says why not
"""

import asyncio
import contextlib
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
from wire.process.runtime import log
from wire.toml_loader import ConfigError
from wire.web_access import Guarded, WebOptions

STATIC = Path(__file__).parent / "static"
START_WITHIN_S = 30.0  # on a starved machine; then the station does not start, and says why

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
    bound = socket.socket(socket.AF_INET6 if ":" in options.host else socket.AF_INET, socket.SOCK_STREAM)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        bound.bind((options.host, options.port))
    except OSError as error:
        bound.close()
        raise ConfigError(f"--web {options.host}:{options.port}: {error.strerror} (another address, or --no-web)") from None
    return bound


class WebServer:
    """The page's thread. A page that fails says so in the log and is gone; the station flies on."""

    def __init__(self, source: Backend, options: WebOptions, bound: socket.socket | None = None) -> None:
        """Serve at `bound`; None: `bind` here."""
        self._failure, self._where = "", f"{options.host}:{options.port}"
        self._loop: asyncio.AbstractEventLoop | None = None
        self._socket = bound or bind(options)
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

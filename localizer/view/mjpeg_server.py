"""SHELL: a web server for the newest annotated picture, for a browser on this machine (`localizer run --show`).

The headless OpenCV has no windows, and a window would need a display at the camera's computer. A browser shows a multipart
JPEG stream by itself, so the standard library's server is enough; over SSH, `ssh -L 8090:127.0.0.1:8090 camera-computer`.
Only this machine is served. Viewers have threads of their own, their number is limited, and each gets the newest picture
when it is ready for one: none of them can slow the localizer.
"""

import errno
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from wire.process.runtime import Stop, guarded_thread, log
from wire.toml_loader import ConfigError

MAX_VIEWERS = 4
_HOSTS = frozenset({"127.0.0.1", "localhost"})  # any other Host is a foreign page whose name was made to point here
_TIMEOUT_S = 5.0  # s after which a viewer that stopped reading is dropped
_WAIT_S = 1.0  # s after which the same picture is sent again, to notice viewers that left
_BOUNDARY = "picture"
_HTML = b"""<!doctype html><html lang="en"><meta charset="utf-8"><title>localizer</title>
<style>body{margin:0;background:#111}img{display:block;margin:auto;max-width:100vw;max-height:100vh}</style>
<img src="/stream" alt="no picture">"""


class MjpegServer:
    """Server of the last picture given to `show`, at http://127.0.0.1:port/."""

    def __init__(self, port: int, stop: Stop) -> None:
        """Raises ConfigError if the port is taken. Port 0: any that is free."""
        self._news = threading.Condition()
        self._number, self._jpeg, self._closed = 0, b"", False
        self._places = threading.BoundedSemaphore(MAX_VIEWERS)
        handler = type("Handler", (_Handler,), {"page": self})
        try:
            self._server = ThreadingHTTPServer(("127.0.0.1", port), handler)
        except (OSError, OverflowError) as error:
            taken = isinstance(error, OSError) and error.errno == errno.EADDRINUSE
            raise ConfigError(f"--show-port {port}: {'in use; choose another one' if taken else error}") from None
        self._server.daemon_threads = True  # a viewer that stopped reading must not keep the process
        self._thread = guarded_thread(stop, "page", lambda: self._server.serve_forever(0.1), daemon=True)
        self._thread.start()
        log.info("what the camera sees: %s", self.address)

    @property
    def address(self) -> str:
        """URL for a browser."""
        return f"http://127.0.0.1:{self._server.server_address[1]}/"

    def show(self, jpeg: bytes) -> None:
        """Replace the picture. Never waits."""
        with self._news:
            self._number, self._jpeg = self._number + 1, jpeg
            self._news.notify_all()

    def next(self, seen: int) -> tuple[int, bytes] | None:
        """The newest picture and its number as soon as it is not number `seen`; the same one again after _WAIT_S. None
        when the server closes."""
        with self._news:
            self._news.wait_for(lambda: self._closed or self._number != seen, _WAIT_S)
            return None if self._closed else (self._number, self._jpeg)

    def acquire_viewer(self) -> bool:
        """Reserve a place for one more viewer. Returns False if all are taken; `release_viewer` frees it."""
        return self._places.acquire(blocking=False)

    def release_viewer(self) -> None:
        """Free the place of a viewer that is gone."""
        self._places.release()

    def close(self) -> None:
        """End all streams."""
        with self._news:
            self._closed = True
            self._news.notify_all()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Handler(BaseHTTPRequestHandler):
    page: MjpegServer
    timeout = _TIMEOUT_S

    def do_GET(self) -> None:
        host = self.headers.get("Host", "").rpartition(":")[0] or self.headers.get("Host", "")
        if host not in _HOSTS:
            self.send_error(HTTPStatus.FORBIDDEN, "only for this machine")
        elif self.path == "/":
            self._send_page()
        elif self.path != "/stream":
            self.send_error(HTTPStatus.NOT_FOUND)
        elif not self.page.acquire_viewer():
            self.send_error(HTTPStatus.SERVICE_UNAVAILABLE, f"{MAX_VIEWERS} viewers already")
        else:
            try:
                self._stream()
            except OSError:  # the viewer left, or stopped reading
                self.close_connection = True
            finally:
                self.page.release_viewer()

    def _send_page(self) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.send_header("Content-Length", str(len(_HTML)))
        self.end_headers()
        self.wfile.write(_HTML)

    def _stream(self) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.close_connection = True
        seen = 0
        while (news := self.page.next(seen)) is not None:
            seen, jpeg = news
            if jpeg:
                head = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                self.wfile.write(head.encode() + jpeg + b"\r\n")

    def log_message(self, format: str, *args: object) -> None:
        log.debug("page: " + format, *args)

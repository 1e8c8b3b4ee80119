"""SHELL: a page with the newest annotated picture, for a browser of this machine (`localizer run --show`).

The headless OpenCV has no windows, and a window would need a display at the camera's computer.
"""

import threading

from starlette.responses import HTMLResponse
from starlette.routing import Route

from localizer.view.local_server import LocalServer, PictureStream, bind
from shoal.runtime.runtime import Stop, log
from shoal.runtime.web_access import WebOptions

_WAIT_S = 1.0  # s after which the same picture is sent again, to notice viewers that left
_HTML = """<!doctype html><html lang="en"><meta charset="utf-8"><title>localizer</title>
<style>body{margin:0;background:#111}img{display:block;margin:auto;max-width:100vw;max-height:100vh}</style>
<img src="/stream" alt="no picture">"""


class MjpegServer:
    """Server of the last picture given to `show`, at http://127.0.0.1:port/."""

    def __init__(self, port: int, stop: Stop) -> None:
        """Raises ConfigError if the port is taken. Port 0: any that is free."""
        self._news = threading.Condition()
        self._number, self._jpeg, self._closed = 0, b"", False
        bound = bind(port, "--show-port")
        options = WebOptions(port=bound.getsockname()[1])
        page, stream = HTMLResponse(_HTML), PictureStream(self.next)
        self._server = LocalServer([Route("/", page), Route("/stream", stream.answer)], options, bound, stop)
        self.address = options.url
        log.info("what the camera sees: %s", self.address)

    def show(self, jpeg: bytes) -> None:
        """Replace the picture. Never waits."""
        with self._news:
            self._number, self._jpeg = self._number + 1, jpeg
            self._news.notify_all()

    def next(self, last_number: int) -> tuple[int, bytes] | None:
        """The newest picture and its number as soon as it is not number `last_number`; the same one again after _WAIT_S. None
        when the server closes."""
        with self._news:
            self._news.wait_for(lambda: self._closed or self._number != last_number, _WAIT_S)
            return None if self._closed else (self._number, self._jpeg)

    def close(self) -> None:
        """End all streams."""
        with self._news:
            self._closed = True
            self._news.notify_all()
        self._server.close()

"""SHELL: the thread that takes a source's frames for a setup, and hands out the newest picture to the page's viewers."""

import threading

from localizer.setup.session import SetupSession
from localizer.sources.base import FrameSource
from localizer.view.worker import LatestItemWorker
from shoal.errors import ConfigError
from shoal.runtime.runtime import Stop, guarded_thread

_AGAIN_S = 1.0  # s after which a viewer gets the same picture again, which notices one that left


class CameraFeed:
    """The threads, ended by `close` after `stop`."""

    def __init__(self, source: FrameSource, session: SetupSession, stop: Stop) -> None:
        self._source, self._session, self._stop = source, session, stop
        self._news, self._number = threading.Condition(), 0
        self._jpeg: tuple[object, bytes] = (None, b"")  # with the frame's number and the overlay that it was made for
        self._encoding = threading.Lock()
        self._board: LatestItemWorker[int] = LatestItemWorker("board", lambda _: session.look_for_board(), stop)
        self._thread = guarded_thread(stop, "frames", self._take_all, daemon=True)
        self._thread.start()

    def next(self, last_number: int) -> tuple[int, bytes] | None:
        """The newest picture as JPEG and its number, as soon as it is not number `last_number`; the same one again after a
        second. None at the program's end. Each picture is encoded once, for all pages."""
        with self._news:
            self._news.wait_for(lambda: self._stop.requested or self._number != last_number, _AGAIN_S)
            number = self._number
        if self._stop.requested:
            return None
        with self._encoding:
            made_for = number, self._session.overlay
            if self._jpeg[0] != made_for:
                self._jpeg = made_for, self._session.jpeg()
            return number, self._jpeg[1]

    def close(self) -> None:
        """End the threads."""
        self._board.close()
        self._source.close()
        self._thread.join()

    def _take_all(self) -> None:
        """Hand the source's pictures to the session and the page, until it stops. The session keeps why there are none."""
        before_ns = 0
        try:
            for captured in self._source.frames(self._stop):
                if captured is None:
                    self._session.trouble = self._source.trouble or f"no picture for {self._source.silent_after_s:g} s"
                    continue
                interval_s = (captured.arrived_ns - before_ns) * 1e-9 if before_ns else 0.0
                before_ns = captured.arrived_ns
                self._session.take(captured, interval_s)
                self._board.offer(self._number)
                with self._news:
                    self._number += 1
                    self._news.notify_all()
        except ConfigError as error:
            self._session.trouble = str(error)
            return
        if not self._stop.requested:
            self._session.end_recording()

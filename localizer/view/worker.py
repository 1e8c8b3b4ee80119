"""SHELL: a thread that works on the newest item that it is given, beside the localizer's loop."""

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from localizer.sources.latest_value import LatestValue
from shoal.runtime.runtime import SLICE_S, Stop, guarded_thread, log

T = TypeVar("T")


class LatestItemWorker(Generic[T]):
    """A thread that calls `handle` with the newest item, until it is closed.

    An exception of `handle` costs that item, not the thread: the poses go on without video or preview. The first of a row
    is an error in the log. If the thread itself ends, the process ends with the reason.
    """

    def __init__(
        self,
        name: str,
        handle: Callable[[T], None],
        stop: Stop,
        begin: Callable[[], None] = lambda: None,
        combine: Callable[[T, T], T] = lambda waiting, newer: newer,
    ) -> None:
        """`begin` is called once, in the thread. `combine` makes the item that replaces a waiting one (LatestValue)."""
        self._name, self._handle, self._begin = name, handle, begin
        self._newest = LatestValue(combine)
        self._closing = threading.Event()
        self.failed = 0  # items that `handle` raised for, in a row
        self._thread = guarded_thread(stop, name, self._work)
        self._thread.start()

    def offer(self, item: T) -> None:
        """Work on this item next. Never waits."""
        self._newest.put(item)

    def work(self, item: T) -> None:
        """Work on this item now, in the caller's thread, which offers nothing then. Only the first failure in a row is logged,
        and the first success after it."""
        try:
            self._handle(item)
        except Exception as error:
            self.failed += 1
            if self.failed == 1:
                log.error("%s: %s: %s; the next picture is tried", self._name, type(error).__name__, error)
            return
        if self.failed:
            log.info("%s: works again, after %d pictures", self._name, self.failed)
            self.failed = 0

    def close(self) -> None:
        """Finish the item under way, and end the thread."""
        self._closing.set()
        self._thread.join()

    def _work(self) -> None:
        """Work on the newest item, as often as there is a new one, until closed."""
        self._begin()
        while not self._closing.is_set():
            item = self._newest.take(SLICE_S)
            if item is not None:
                self.work(item)

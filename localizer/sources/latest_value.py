"""SHELL: a mailbox for one item between two threads: the newest wins, and what it replaced is counted."""

import threading
from typing import Generic, TypeVar

T = TypeVar("T")


class LatestValue(Generic[T]):
    """Never a queue: a slow taker gets the newest item, not the oldest."""

    def __init__(self) -> None:
        self.overtaken = 0  # items replaced before anyone took them
        self._item: T | None = None
        self._arrival = threading.Condition()

    def put(self, item: T) -> None:
        """Never waits."""
        with self._arrival:
            self.overtaken += self._item is not None
            self._item = item
            self._arrival.notify()

    def take(self, timeout_s: float) -> T | None:
        """The newest item, as soon as there is one; None when the time is over."""
        with self._arrival:
            self._arrival.wait_for(lambda: self._item is not None, timeout_s)
            item, self._item = self._item, None
            return item

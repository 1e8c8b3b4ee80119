"""SHELL: a mailbox for one item between two threads: the newest wins, and replaced items are counted."""

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class LatestValue(Generic[T]):
    """A mailbox that is never a queue: a slow reader gets the newest item, not the oldest."""

    def __init__(self, combine: Callable[[T, T], T] = lambda waiting, newer: newer) -> None:
        """`combine` makes the item that replaces a waiting one, out of that and the newer."""
        self._combine = combine
        self.overtaken = 0  # items replaced before they were taken
        self._item: T | None = None
        self._arrival = threading.Condition()

    def put(self, item: T) -> None:
        """Replace the item. Never waits."""
        with self._arrival:
            self.overtaken += self._item is not None
            self._item = item if self._item is None else self._combine(self._item, item)
            self._arrival.notify()

    def take(self, timeout_s: float) -> T | None:
        """The newest item, as soon as there is one; None after the timeout."""
        with self._arrival:
            self._arrival.wait_for(lambda: self._item is not None, timeout_s)
            item, self._item = self._item, None
            return item

"""Flights in threads of this process, which a test interrupts as Ctrl-C does."""

import signal
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, ClassVar


class WatchedPool(ThreadPoolExecutor):
    """An executor that knows its flights."""

    flights: ClassVar[list[Future[Any]]] = []

    def __init__(self, workers: int) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
        super().__init__(workers)

    def submit(self, *call: Any, **options: Any) -> Future[Any]:
        self.flights.append(super().submit(*call, **options))
        return self.flights[-1]

    @classmethod
    def interrupt(cls) -> None:
        """Press Ctrl-C, and wait until the last flight is given up. The signal wakes a main thread that waits."""
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
        while not cls.flights[-1].cancelled():
            time.sleep(0.01)

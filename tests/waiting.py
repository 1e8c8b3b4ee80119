"""Waiting for other threads and processes. Tests that pass wait no longer than the other side takes."""

import time
from collections.abc import Callable

PERIOD_S = 0.005  # between two looks


def eventually(ready: Callable[[], object], timeout_s: float = 5.0) -> bool:
    """True as soon as `ready()` is true; False if it was not within the timeout, in s. Not asked again once it was true."""
    deadline_s = time.monotonic() + timeout_s
    while not ready():
        if time.monotonic() > deadline_s:
            return False
        time.sleep(PERIOD_S)
    return True

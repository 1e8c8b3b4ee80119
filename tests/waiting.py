"""Waiting for other threads and processes. Tests that pass wait no longer than the other side takes."""

import time
from collections.abc import Callable
from pathlib import Path

PERIOD_S = 0.005  # between two looks


def eventually(ready: Callable[[], object], timeout_s: float = 30.0) -> bool:
    """True as soon as `ready()` is true; False if it was not within the timeout, in s. Not asked again once it was true."""
    deadline_s = time.monotonic() + timeout_s
    while not ready():
        if time.monotonic() > deadline_s:
            return False
        time.sleep(PERIOD_S)
    return True


def wait_for_line(log: Path, text: str, timeout_s: float = 40.0, times: int = 1) -> None:
    """Wait until a log file holds `text`, as often as given. Raises AssertionError with the log after the timeout."""
    if not eventually(lambda: log.exists() and log.read_text().count(text) >= times, timeout_s):
        content = log.read_text() if log.exists() else "no such file"
        raise AssertionError(f"{log.name} never said {text!r} {times} times:\n{content}")

"""SHELL: clock, stop, log and threads of a process.

One loop, whatever drives it:

    for instant in pace:            # by the wall clock when an input arrives or the period is over; the simulator has a pace
        outputs = core.step(...)    # and a clock of its own (sim_bridge/lockstep)
"""

import errno
import io
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn, Protocol, TextIO, TypeVar, cast

from shoal.errors import ConfigError, Unreached
from shoal.runtime import output
from shoal.runtime.foreign_packages import foreign_package
from shoal.system.printable import printable, printable_lines
from shoal.system.programs import end_with_parent

if TYPE_CHECKING:
    from shoal.bus.bus import Bus, Received

log = logging.getLogger("shoal")
T = TypeVar("T")
speaking: ContextVar[str | None] = ContextVar("speaking", default=None)  # whose step this is, where one process runs several

SLICE_S = 0.1  # how long a wait may keep a process from noticing that it was told to stop

# Of a disk that is full, gone or read-only. A write raises these without the file's name.
DISK_TROUBLE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS, errno.ENODEV, errno.ENXIO, errno.ESTALE)

_LEVELS = {logging.DEBUG: 1, logging.INFO: 2, logging.WARNING: 3, logging.ERROR: 4, logging.CRITICAL: 5}


class Clock(Protocol):
    """The process's time, and when on it a received message's content was true."""

    @property
    def waits(self) -> bool: ...  # time stands while a step is made: nothing is late, and nothing is measured
    def now_ns(self) -> int: ...
    def instant_ns(self, received: "Received[Any]") -> int: ...
    def arrival_ns(self, stamp_ns: int) -> int: ...  # of a message with this stamp that comes now


class WallClock:
    """Unix time as it was at the start, carried on by the monotonic clock: a step of the system's clock changes nothing."""

    waits = False

    def __init__(self) -> None:
        self._offset_ns = time.time_ns() - time.monotonic_ns()

    def now_ns(self) -> int:
        return time.monotonic_ns() + self._offset_ns

    def instant_ns(self, received: "Received[Any]") -> int:
        """Arrival here, less the age that the sender states and what it was held up on its way. What the sender's clock shows
        plays no part."""
        return self._offset_ns - received.age_ns(0)

    def arrival_ns(self, stamp_ns: int) -> int:
        return self.now_ns()


def age_s(clock: Clock, received: "Received[Any]") -> float:
    """Seconds since a message's content was true."""
    return (clock.now_ns() - clock.instant_ns(received)) * 1e-9


class Failed(Exception):
    """A part of this process cannot go on, so the process has ended itself: exit code 1, the text is the reason."""


class Stop:
    """Set by SIGINT, SIGTERM, SIGHUP or a call; every loop looks at it. The second SIGINT or SIGTERM ends the process at once,
    with files half written. A SIGHUP does not count: a terminal that goes sends it from the kernel and from the shell, and the
    end of a login sends a SIGTERM as well. Nor does a call: a process that ends by itself has not been signalled yet.
    `nohup` is respected.

    A part of the process that cannot go on calls `fail`; all loops then end as for a signal, within SLICE_S, and who has
    closed everything calls `raise_failure`, so that the process does not end as if all were well."""

    def __init__(self, install: bool = True) -> None:
        self.requested = False
        self.interrupted = False  # by SIGINT: a person pressed Ctrl-C
        self._by_signal = False  # by a SIGINT or SIGTERM
        self._wakes: list[Callable[[], None]] = []
        self.failure = ""  # why the process ends itself; empty: nothing has failed
        if install:
            signal.signal(signal.SIGINT, self._on_signal)
            signal.signal(signal.SIGTERM, self._on_signal)
            if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
                signal.signal(signal.SIGHUP, self._on_signal)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if number != signal.SIGHUP:
            if self._by_signal:
                os._exit(128 + number)
            self._by_signal = True
        self.request(number == signal.SIGINT)

    def __call__(self) -> bool:
        """True once a stop has been asked for."""
        return self.requested

    def request(self, interrupted: bool = False) -> None:
        """Ask for a clean stop. `interrupted`: a person has pressed Ctrl-C."""
        self.interrupted = self.interrupted or interrupted
        self.requested = True
        for wake in self._wakes:
            threading.Thread(target=wake, name="stop", daemon=True).start()

    @property
    def terminated(self) -> bool:
        """True if a stop was asked for by a program, and not by a person's Ctrl-C."""
        return self.requested and not self.interrupted

    def on_request(self, wake: Callable[[], None]) -> None:
        """Have `wake` called when a stop is asked for, for a loop that sleeps too long to look. On a thread of its own: a
        signal may come while the loop holds a lock that `wake` needs."""
        self._wakes.append(wake)

    def fail(self, reason: str) -> None:
        """Ask for a stop because a part of the process cannot go on. From any thread; the first reason counts."""
        if not self.failure:
            self.failure = reason
            log.critical("%s", reason)
        self.request()

    def raise_failure(self) -> None:
        """Raises Failed if a part of the process has failed."""
        if self.failure:
            raise Failed(self.failure)


@contextmanager
def signals_raise() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the block as Ctrl-C does: through its `finally`, which disarms a board or puts back what was
    changed on it. For programs without a loop that looks at a Stop."""

    def end(number: int, frame: FrameType | None) -> None:
        for one in before:  # a terminal that goes sends more than one, which would end that as well
            signal.signal(one, signal.SIG_IGN)
        raise SystemExit(128 + number)

    before = {number: signal.signal(number, end) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def guarded_thread(stop: Stop, name: str, work: Callable[[], object], daemon: bool = False) -> threading.Thread:
    """A thread, not started yet, that the process cannot do without: an exception that leaves `work` ends the process with
    the reason. `work` itself survives what it can."""

    def run() -> None:
        try:
            work()
        except BaseException as error:  # SystemExit too would end a thread without a word
            log.debug("thread %s", name, exc_info=True)
            stop.fail(f"thread {name} ended: {type(error).__name__}: {error}")

    return threading.Thread(target=run, name=name, daemon=daemon)


def run_steps(steps: Generator[None, None, T]) -> T:
    """Run a process that yields between its steps to its end. Returns its result."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return end.value  # type: ignore[no-any-return]


def wait(bus: "Bus", stop: Stop, ready: Callable[[], bool], timeout_s: float) -> bool:
    """Sleep until `ready()`, the time is over or a stop is asked for. Returns whether `ready()`."""
    deadline = time.monotonic() + timeout_s
    while not stop.requested:
        left = deadline - time.monotonic()
        if bus.wait(ready, min(left, SLICE_S)):
            return True
        if left <= SLICE_S:
            return False
    return False


class _BusHandler(logging.Handler):
    """Publishes the log's lines as events, so that the recorder has them."""

    def __init__(self, bus: "Bus", clock: Clock, source: str) -> None:
        super().__init__(logging.INFO)
        self._bus, self._clock, self._source = bus, clock, source

    def emit(self, record: logging.LogRecord) -> None:
        """Publish a line of the log as an event."""
        from shoal.messages import topics
        from shoal.messages.messages import Event

        if self._bus.closed:  # the gate's guard speaks to the end
            return
        try:
            event = Event(_LEVELS.get(record.levelno, 2), self._source, record.getMessage())
            self._bus.publish(topics.EVENT, event, self._clock.now_ns())
        except Exception:  # whatever goes wrong here must not end the process: the line is on stderr anyway
            self.handleError(record)


class LineFormatter(logging.Formatter):
    """One line an event, and a traceback's lines below it, without what a terminal would act on: texts come from others."""

    def __init__(self, process: str) -> None:
        super().__init__(f"%(asctime)s.%(msecs)03d {process} %(levelname)s %(message)s", "%H:%M:%S")

    def formatMessage(self, record: logging.LogRecord) -> str:
        """The event's line."""
        return printable(super().formatMessage(record))

    def formatException(self, ei: Any) -> str:
        """The traceback's lines."""
        return printable_lines(super().formatException(ei))


class _OutputHandler(logging.StreamHandler[TextIO]):
    """Writes lines without waiting for what takes them."""

    def __init__(self, stream: TextIO | None) -> None:
        super().__init__(cast(TextIO, output.background(stream)))

    def close(self) -> None:
        """Close the log's own descriptor, once its lines are written."""
        self.stream.close()
        super().close()


def log_handler(process: str, stream: TextIO | None = None) -> logging.Handler:
    """A handler that writes one line an event, with the process's name, to stderr or `stream`. Close it before the stream."""
    handler = _OutputHandler(stream or sys.stderr)
    handler.setFormatter(LineFormatter(process))
    handler.addFilter(lambda _: speaking.get() in (None, process))
    return handler


def start_log(process: str, verbose: bool = False) -> None:
    """Log to stderr."""
    log.handlers[:] = [log_handler(process)]
    log.setLevel(logging.DEBUG if verbose else logging.INFO)
    log.propagate = False


def log_to_bus(bus: "Bus", clock: Clock, process: str) -> None:
    """Send the log's lines out as events too, from now on."""
    handler = _BusHandler(bus, clock, process)
    handler.addFilter(lambda _: speaking.get() in (None, process))
    log.addHandler(handler)


def run_app(app: Callable[[], None]) -> None:
    """Run a command line. A configuration that cannot be used, or a file that cannot be read or written, is one message and
    exit code 2, a station that cannot be reached, or a part of the process that has failed, one message and exit code 1;
    never a traceback. What the terminal's locale cannot show is replaced."""
    end_with_parent()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")
    try:
        app()
    except ConfigError as error:
        _end(error, 2)
    except OSError as error:
        if error.filename is None and error.errno not in DISK_TROUBLE:  # no file of a person's: a bug
            raise
        _end(f"{error.filename2 or error.filename or 'a file that was being written'}: {error.strerror}", 2)
    except (Unreached, Failed) as error:
        _end(error, 1)
    except ModuleNotFoundError:  # a role that was not installed: optional_packages.py says so
        raise
    except Exception as error:
        foreign = foreign_package(error)
        if not foreign:
            raise
        _end(f"{type(error).__name__}: {error}\n{foreign}", 2)


def _end(reason: object, code: int) -> NoReturn:
    """Say why the process ends, behind what it has logged, and end it."""
    output.background(sys.stderr).write(f"{printable_lines(str(reason))}\n")
    sys.exit(code)

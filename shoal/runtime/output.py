"""SHELL: output that nobody waits for: one thread of the process writes what is logged and what progress is printed.

A terminal that is stopped (Ctrl-S), a pipe that is not read and a full disk block whoever writes to them, or raise. A control
loop must not stop for that. So texts go into a queue with a bound, and one daemon thread writes them. What does not fit, and
what cannot be written, is dropped and counted; the number is said in the output as soon as it takes text again.
"""

import atexit
import io
import os
import queue
import threading
from typing import IO, TYPE_CHECKING, cast

if TYPE_CHECKING:
    from rich.console import Console

MOST_WAITING = 4096  # texts, of all streams: some minutes of a busy log; a few hundred kB
CLOSE = b""  # in place of a text: the stream's end
AT_EXIT_S = 1.0  # s for which a process that ends waits for its output; a slow SD card takes a tenth of this


class _Writer:
    """The thread that writes for all streams of the process."""

    def __init__(self) -> None:
        self._texts: queue.SimpleQueue[tuple[_Stream, bytes] | threading.Event] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._start = threading.Lock()

    def put(self, stream: "_Stream", data: bytes) -> bool:
        """Have data written. Returns False where too much waits already."""
        if self._texts.qsize() >= MOST_WAITING:
            return False
        self.start()
        self._texts.put((stream, data))
        return True

    def start(self) -> None:
        """Start the thread, unless it runs. A forked child has no thread, and starts its own."""
        with self._start:
            if self._thread is None or not self._thread.is_alive():
                self._thread = threading.Thread(target=self._run, name="output", daemon=True)
                self._thread.start()

    def flush(self, limit_s: float) -> None:
        """Wait until everything that was put is written, or the limit is over."""
        if self._thread is not None and self._thread.is_alive():
            written = threading.Event()
            self._texts.put(written)
            written.wait(limit_s)

    def _run(self) -> None:
        """Write texts to their streams as they come, and set each event once all texts before it are written."""
        while True:
            match self._texts.get():
                case threading.Event() as written:
                    written.set()
                case stream, data:
                    stream.put_out(data)


_writer = _Writer()
os.register_at_fork(after_in_child=_writer.__init__)  # type: ignore[misc]  # locks and texts of the parent's are not the child's
atexit.register(_writer.flush, AT_EXIT_S)


def flush(limit_s: float = AT_EXIT_S) -> None:
    """Wait until all output is written, or the limit is over."""
    _writer.flush(limit_s)


def terminal(stream: IO[str] | None = None) -> "Console":
    """A console over a stream; stdout without one. It prints texts as they are: names of files and titles of people hold
    brackets and colons too, which would end the program as wrong markup, or be left out as a colour's or an emoji's name."""
    from rich.console import Console  # takes a tenth of a second, and agents print nothing

    return Console(file=stream, markup=False, emoji=False)


def background(stream: IO[str] | None) -> IO[str]:
    """A stream over another one's file that neither blocks nor raises. A stream in memory, which cannot block, is written to
    at once; None, which is Python's name for a closed one, takes nothing."""
    return cast(IO[str], _Stream(stream))


class _Stream(io.TextIOBase):
    """See `background`. It has a descriptor of its own, so that what still waits can never reach a file that another part of
    the process has opened in the meantime."""

    def __init__(self, stream: IO[str] | None) -> None:
        super().__init__()
        self._stream = stream
        self._encoding = getattr(stream, "encoding", None) or "utf-8"
        self._unqueued = 0  # texts that found no room since the last one that did
        self._unwritten = 0  # texts that could not be written since the last one that could
        try:
            self._descriptor = os.dup(stream.fileno()) if stream is not None else -1
        except (OSError, ValueError):  # in memory, or closed
            self._descriptor = -1
        if self._descriptor >= 0:
            _writer.start()  # not later, from a control loop with a real-time priority

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """The other stream's encoding."""
        return str(self._encoding)

    def writable(self) -> bool:
        return True

    def isatty(self) -> bool:
        """True over a terminal."""
        return self._stream is not None and not self._stream.closed and self._stream.isatty()

    def fileno(self) -> int:
        """The descriptor. Raises OSError in memory."""
        if self._descriptor < 0:
            raise OSError("in memory")
        return self._descriptor

    def write(self, text: str) -> int:
        """Have a text written; returns its length, whatever becomes of it."""
        if self._descriptor < 0:
            if self._stream is not None and not self._stream.closed:
                self._stream.write(text)
        elif text:
            data = (_gap(self._unqueued) + text).encode(self._encoding, errors="replace")
            self._unqueued = 0 if _writer.put(self, data) else self._unqueued + 1
        return len(text)

    def flush(self) -> None:
        """Do nothing: the thread writes as soon as it can."""

    def close(self) -> None:
        """Give the descriptor back, once what waits is written; what is not within AT_EXIT_S is lost."""
        if self._descriptor >= 0 and not self.closed:
            _writer.put(self, CLOSE)
            _writer.flush(AT_EXIT_S)
        super().close()

    def __del__(self) -> None:
        """Give the descriptor back at once: what waits would refer to the stream. When the interpreter ends, no thread can be
        waited for."""
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)

    def put_out(self, data: bytes) -> None:
        """Write to the file itself, or close it, from the writer's thread."""
        if data == CLOSE:
            descriptor, self._descriptor = self._descriptor, -1
            os.close(descriptor)
            return
        data = _gap(self._unwritten).encode() + data
        try:
            while data:
                data = data[os.write(self._descriptor, data) :]
        except OSError:  # full, gone, or nobody reads it any more
            self._unwritten += 1
        else:
            self._unwritten = 0


def _gap(count: int) -> str:
    return f"[{count} outputs are missing here: nothing took them]\n" if count else ""

"""SHELL: writes a run into an MCAP file from its own thread, so that a crash loses half a second and a full disk loses the
log, never the run.

    recorder = Recorder(run_dir / "run.mcap", experiment_toml, {"mode": "lockstep", "hash": experiment.hash})
    recorder.gather([bus.collect(topic) for topic in topics.TOPICS if topic.recorded], lambda header: clock.now_ns())
    ...
    recorder.close()                    # in a finally; what a killed process leaves behind, groundstation/logs/repair.py mends

When the disk fills, pictures are given up first: the rest of a log is small, and worth more.

The wire's bytes go in unchanged, with protobuf schemas, so the usual viewers open the file. `log_time` is the arrival by the
caller's clock (in lockstep the simulated one), `publish_time` the header's stamp. How fast the run went by the wall clock is
told by pairs (`log_time`, monotonic time) in the closing metadata. The file's index stays in memory until the end: with 25
topics some 16 MB an hour. A sender's restart opens a second channel on the same topic: its session is in the channel's
metadata.
"""

import fcntl
import importlib.metadata
import itertools
import json
import math
import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, NamedTuple, cast

from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Schema
from mcap.writer import Writer
from mcap_protobuf.schema import build_file_descriptor_set

from shoal.bus.bus import Collected
from shoal.config.experiment import Experiment
from shoal.errors import ConfigError
from shoal.messages.codec import Header, protobuf_class
from shoal.messages.topics import STATE, Qos, Role, Topic
from shoal.runtime.mcap_records import SESSION
from shoal.runtime.output_files import check_named, disk_free, sync_folder
from shoal.runtime.version import code

FLUSH_PERIOD_S = 0.5  # what a kill -9 loses at most, plus the time of one write; the requirement is 1 s
GATHER_S = 0.01  # how far `log_time` may be behind the arrival; a control step's messages come in bursts
CHUNK_BYTES = 256 * 1024  # only previews reach it between flushes; several chunks a flush compress as well as one
MAX_PENDING_BYTES = 64 * 1024 * 1024  # a disk that stalls this long (minutes of messages) must not eat the memory
JOIN_S = 10.0  # a disk that hangs must not keep the process from ending

EXPERIMENT_NAME = "experiment.toml"
RUN_METADATA = "run"
END_METADATA = "recorder"
REPAIR_METADATA = "repair"  # damage that a mended log has lost


def mode_text(mode: str) -> str:
    """The kind of time that a run had, for people. A lockstep run may go as fast as the clock."""
    return {"lockstep": "simulated time", "real-time": "by the wall clock"}.get(mode, mode)


def run_metadata(experiment: Experiment, mode: str) -> dict[str, str]:
    """Metadata of a run for its log; `mode`: real-time, lockstep or numeric."""
    return {
        "scene": experiment.name,
        "seed": str(experiment.seed),
        "mode": mode,
        "experiment_hash": experiment.hash,
        "version": code().version,
        "commit": code().commit,
        "zenoh": importlib.metadata.version("eclipse-zenoh"),
    }


def claim(fd: int, path: Path, how: int, taken: str) -> None:
    """Lock a log, for as long as it is open. Raises OSError saying `taken` where another process has it; a file system that
    knows no locks lets everybody in."""
    try:
        fcntl.flock(fd, how | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise OSError(error.errno, taken, str(path)) from None
    except OSError:
        return


class _Output:
    """File for mcap's Writer: collects bytes, writes them in one go, and knows the length up to which the file is good."""

    def __init__(self, path: Path) -> None:
        try:  # a log is never written over, nor through a link
            self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
        except FileExistsError as error:
            raise FileExistsError(error.errno, "is there already, and would be lost (take a new folder)", str(path)) from None
        claim(self._fd, path, fcntl.LOCK_EX, "another program has it")
        self._path = path
        self._pending = bytearray()
        self.good_bytes = 0

    def write(self, data: bytes) -> int:
        self._pending += data
        return len(data)

    def tell(self) -> int:
        return self.good_bytes + len(self._pending)

    def flush(self) -> None:
        rest = memoryview(bytes(self._pending))
        while rest:
            rest = rest[os.write(self._fd, rest) :]
        self.good_bytes += len(self._pending)
        self._pending.clear()

    def sync(self) -> None:
        """Have the bytes on the disk. Raises OSError, also for a file that was deleted meanwhile."""
        os.fsync(self._fd)
        check_named(self._fd, self._path)

    def cut(self) -> None:
        """Take off what a failed write left behind the last good byte. The file stays open, and locked: its run goes on."""
        os.ftruncate(self._fd, self.good_bytes)

    def close(self) -> None:
        """Close the file. Idempotent."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)


class _PendingMessage(NamedTuple):
    """A message that is to be written."""

    topic: Topic
    key: str
    header: Header
    payload: bytes
    log_time_ns: int
    arrived_ns: int  # by the monotonic clock


class Recorder:
    """Records messages into one file. `put` may be called from any thread and never waits for the disk."""

    def __init__(
        self,
        path: Path,
        experiment_toml: str,
        metadata: Mapping[str, str],
        stop_pictures_below: int = 0,
        free_bytes: Callable[[Path], int] = disk_free,
    ) -> None:
        """Open the file and put what must survive any crash into it: the experiment and the metadata (mode, seed, hash,
        versions). With fewer than `stop_pictures_below` bytes free on its disk no pictures are recorded any longer. Raises
        OSError when the file cannot be made: without a log no run should begin."""
        self._free_bytes, self._folder = free_bytes, path.parent
        self._stop_pictures_below, self._no_pictures, self._warning = stop_pictures_below, False, ""
        self.whole_until_ns: int | None = None  # robots' messages with later stamps wait; those left at the end are left out
        self._dropped = 0
        self._error = ""
        self._lock = threading.Lock()
        self._pending: list[_PendingMessage] = []
        self._pending_bytes = 0
        self._pace: list[tuple[int, int]] = []  # (log time, monotonic time of arrival) of one state message per flush
        self._closing = threading.Event()
        self._gathered = threading.Event()  # to be ended: the last messages are fetched before the log is closed
        self._gatherer: threading.Thread | None = None
        self._schemas: dict[type, int] = {}
        self._channels: dict[tuple[str, int], int] = {}
        self._declarations: Any = RecordBuilder()  # since the last flush; Any: mcap is typed in part
        self._output = _Output(path)
        self._writer: Any = Writer(cast(IO[bytes], self._output), chunk_size=CHUNK_BYTES)
        self._writer.start(library="shoal")
        now_ns = time.time_ns()
        self._writer.add_attachment(now_ns, now_ns, EXPERIMENT_NAME, "application/toml", experiment_toml.encode())
        self._writer.add_metadata(RUN_METADATA, dict(metadata))
        try:
            self._flush()
            sync_folder(path.parent)
        except OSError as error:
            self._output.close()
            with suppress(OSError):  # nothing is in it, and it would keep the next run out of the folder
                path.unlink()
            raise OSError(error.errno, error.strerror, str(path)) from None
        self._thread = threading.Thread(target=self._write_until_closed, name="recorder", daemon=True)
        self._thread.start()

    @property
    def error(self) -> str:
        """Reason for which nothing, or not everything, is recorded any more; empty while all is well."""
        if self._error or not self._dropped:
            return self._error
        return f"{self._dropped} messages are lost: the disk does not take them as fast as they come"

    @property
    def warning(self) -> str:
        """Topics that are not recorded any more, and the reason; empty while all are."""
        return self._warning

    @property
    def dropped(self) -> int:
        """Messages that did not get into the log."""
        return self._dropped

    def put(self, topic: Topic, key: str, header: Header, payload: bytes, log_time_ns: int) -> None:
        """Record a message that arrived at `log_time_ns`. Returns at once, and counts the message if it has to be dropped.
        Messages after `close` are not recorded."""
        with self._lock:
            if self._closing.is_set() or (self._no_pictures and topic.qos is Qos.IMAGE):
                return
            if self._error or self._pending_bytes + len(payload) > MAX_PENDING_BYTES:
                self._dropped += 1
                return
            self._pending.append(_PendingMessage(topic, key, header, payload, log_time_ns, time.monotonic_ns()))
            self._pending_bytes += len(payload)

    def gather(self, sources: Sequence[Collected], arrival_ns: Callable[[Header], int]) -> None:
        """Record what has come to these, from now until `close`, in a thread of its own: one that waited for the disk would
        leave messages lying. `arrival_ns` tells what `log_time` becomes. Call it once."""
        self._gatherer = threading.Thread(target=self._gather, args=(sources, arrival_ns), name="gatherer", daemon=True)
        self._gatherer.start()

    def _gather(self, sources: Sequence[Collected], arrival_ns: Callable[[Header], int]) -> None:
        """Put what the bus has collected into the log, again and again, until the recorder is closed."""
        ended = False
        try:
            while not ended:
                ended = self._gathered.wait(GATHER_S)
                for topic, key, header, payload in itertools.chain.from_iterable(source() for source in sources):
                    self.put(topic, key, header, payload, arrival_ns(header))
        except BaseException as error:  # nothing comes into the log any more, and without this the operator would not be told
            with self._lock:
                self._error = self._error or f"log stopped: {type(error).__name__}: {error}"
            raise

    def close(self) -> None:
        """Write the pending messages and the file's index. May be called again; a failing disk raises nothing, see `error`."""
        self._gathered.set()
        if self._gatherer is not None:
            self._gatherer.join(JOIN_S)
        self._closing.set()
        self._thread.join(JOIN_S)
        if self._thread.is_alive():
            self._error = self._error or f"the disk did not take the log's end within {JOIN_S:g} s"
        else:
            self._finish_file(self._output.close)

    def _write_until_closed(self) -> None:
        """Write what is pending, in a thread, until closed; then end the file. An error ends the log, and is told."""
        try:
            while not self._closing.wait(FLUSH_PERIOD_S):
                self._end_pictures_on_full_disk()
                self._write_pending()
                self._flush()
            self._write_pending()
            self._writer.flush()  # the end comes behind the last message, or a log cut between them would count as whole
            self._writer.add_metadata(END_METADATA, {"dropped": str(self._dropped), "pace": json.dumps(self._pace)})
            self._writer.finish()
            self._output.flush()
            self._output.sync()
        except OSError as error:
            self._fail(f"{error.strerror or error} (errno {error.errno})")
        except BaseException as error:  # SystemExit too would end a thread without a word
            self._fail(f"{type(error).__name__}: {error}")
            raise  # a bug: threading's hook prints where; the operator already sees that the log has stopped
        else:
            self._finish_file(self._output.close)

    def _end_pictures_on_full_disk(self) -> None:
        """Stop to record pictures, for good, when the disk is nearly full: a video that comes and goes with the last megabyte
        is of no use."""
        if self._no_pictures or not self._stop_pictures_below:
            return
        free = self._free_bytes(self._folder)
        if free < self._stop_pictures_below:
            self._no_pictures = True
            self._warning = f"pictures are not recorded any longer: {free / 1e9:.2f} GB are free on the log's disk"

    def _write_pending(self) -> None:
        """Write the pending messages, without those of robots stamped later than `whole_until_ns`: others may still come
        before them."""
        with self._lock:
            until_ns = math.inf if self.whole_until_ns is None else self.whole_until_ns
            batch, later = list[_PendingMessage](), list[_PendingMessage]()
            for pending in self._pending:
                is_later = pending.topic.writers == (Role.ROBOT,) and pending.header.stamp_ns > until_ns
                (later if is_later else batch).append(pending)
            self._pending = later
            self._pending_bytes = sum(len(pending.payload) for pending in later)
        states = [pending for pending in batch if pending.topic is STATE]
        self._pace += [(state.log_time_ns, state.arrived_ns) for state in states[-1:]]
        for pending in batch:
            header = pending.header
            channel = self._channel(pending.topic, pending.key, header.session)
            # MCAP's times and sequence numbers are unsigned; a stranger's header must not stop the log
            stamp_ns, sequence = max(header.stamp_ns, 0), header.sequence & 0xFFFFFFFF
            self._writer.add_message(channel, max(pending.log_time_ns, 0), pending.payload, stamp_ns, sequence)

    def _channel(self, topic: Topic, key: str, session: int) -> int:
        """Number of the log's channel for a topic of a sender, which is declared at the first message."""
        cls = protobuf_class(topic.type)
        if cls not in self._schemas:
            name, files = cls.DESCRIPTOR.full_name, build_file_descriptor_set(cls).SerializeToString()
            self._schemas[cls] = self._writer.register_schema(name, "protobuf", files)
            Schema(self._schemas[cls], files, "protobuf", name).write(self._declarations)
        if (key, session) not in self._channels:
            schema, metadata = self._schemas[cls], {SESSION: f"{session:x}", "publisher": topic.publisher}
            self._channels[key, session] = self._writer.register_channel(key, "protobuf", schema, metadata)
            Channel(
                self._channels[key, session], topic=key, message_encoding="protobuf", metadata=metadata, schema_id=schema
            ).write(self._declarations)
        return self._channels[key, session]

    def _flush(self) -> None:
        """Write out what there is. The writer puts a channel's declaration into the chunk of its first message alone: it is
        repeated behind that chunk, for the chunk may be damaged, and the end, which repeats it too, be cut off."""
        self._writer.flush()
        self._output.write(self._declarations.end())
        self._output.flush()
        self._output.sync()

    def _fail(self, reason: str) -> None:
        """End the log for a reason: messages that wait are dropped and counted, and the file is cut to what is whole."""
        with self._lock:
            self._error = f"log stopped: {reason}"
            self._dropped += len(self._pending)
            self._pending, self._pending_bytes = [], 0
        self._finish_file(self._output.cut)

    def _finish_file(self, do: Callable[[], None]) -> None:
        """Do the last thing with the file. An error of the disk becomes the log's, if it has none yet."""
        try:
            do()
        except OSError as error:
            self._error = self._error or f"log stopped: {error.strerror} (errno {error.errno})"


def check_room(folder: Path, least_gb: float) -> None:
    """Raises ConfigError where there is no room for a log in a folder, which need not be there yet."""
    free_gb = disk_free(next(place for place in (folder, *folder.resolve().parents) if place.is_dir())) / 1e9
    if free_gb < least_gb:
        raise ConfigError(
            f"{folder}: {free_gb:.2f} GB free, a run needs {least_gb:g} (recording.min_free_gb): make room, or --out elsewhere"
        )

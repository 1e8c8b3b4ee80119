"""SHELL: a recorded log, message by message with bytes unchanged; also one that was cut off."""

import re
import shutil
import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from heapq import heappop, heappush
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO

from mcap.records import Channel

from groundstation.logs.reader import key_topic
from groundstation.logs.repair import is_complete, parse, recover
from wire.messages import log_records
from wire.messages.codec import Header
from wire.messages.log_records import CHANNEL, CHUNK, FOOTER, MAGIC, MESSAGE, MESSAGE_INDEX, Allowance, Damaged
from wire.messages.topics import Topic
from wire.toml_loader import ConfigError

_CHUNK_HEAD = struct.Struct("<QQQ")  # first and last log time, unpacked size


@dataclass(frozen=True)
class LogMessage:
    """One message of the log. The age that its sender stated is not recorded."""

    topic: Topic
    robot: int  # 0: the topic has no robots
    header: Header
    payload: bytes
    arrived_ns: int


@dataclass(frozen=True)
class _Place:
    """Position of a chunk in the file, with the times and channels that it states."""

    start_ns: int
    end_ns: int
    at: int
    length: int  # of the record, after its head
    channels: set[int] = field(default_factory=set)  # of its messages; empty if the file has no index of it


class LogFile:
    """A whole log, open. Chunks are read when they are needed, one after the other."""

    def __init__(self, file: IO[bytes], path: Path, readable: Path) -> None:
        """`readable` is the file that is read: `path`, or a mended copy. Raises ConfigError for one without messages, or that
        wire/messages/log_records.py refuses."""
        self.path, self.readable = path, readable
        self._file = file
        self._channels: dict[int, tuple[Topic, int, int]] = {}
        try:
            self._places = sorted(self._index(), key=lambda place: (place.start_ns, place.at))
        except Damaged as error:
            raise ConfigError(f"{path}: cannot be read: {error}") from None
        if not self._places:
            raise ConfigError(f"{path}: holds no messages")
        self.start_ns = self._places[0].start_ns
        self.end_ns = max(place.end_ns for place in self._places)

    def _index(self) -> list[_Place]:
        """The places of all chunks; fills `_channels`."""
        file_bytes = self._file.seek(0, 2)
        allowed, at, found = Allowance(file_bytes), len(MAGIC), list[_Place]()
        opcode = 0
        while opcode != FOOTER:
            self._file.seek(at)
            opcode, length = log_records.read_head(self._file, at, file_bytes)
            if opcode == CHUNK:
                head = self._file.read(min(_CHUNK_HEAD.size, length))
                if len(head) < _CHUNK_HEAD.size:
                    raise Damaged(f"byte {at}: a chunk of {length} bytes")
                start_ns, end_ns, size = _CHUNK_HEAD.unpack(head)
                allowed.take(size, at)
                found += [_Place(start_ns, end_ns, at, length)] if size else []
            elif opcode == MESSAGE_INDEX and found and length >= 2:
                found[-1].channels.add(int.from_bytes(self._file.read(2), "little"))
            elif opcode == CHANNEL:
                self._add(self._file.read(length))
            elif opcode == MESSAGE:
                raise Damaged(f"byte {at}: a message outside a chunk, which our recorder does not write")
            at += 9 + length
        with_messages = [place for place in found if place.channels]
        return with_messages or found  # where there is an index, a chunk that is not in it has none

    def _add(self, body: bytes) -> None:
        channel = parse(CHANNEL, body)
        assert isinstance(channel, Channel)
        found, session = key_topic(channel.topic), channel.metadata.get("session", "0")
        if found is None:
            return
        if not re.fullmatch("[0-9a-fA-F]{1,16}", session):
            raise Damaged(f"channel {channel.topic}: session {session[:20]!r} is no number of 16 hexadecimal digits")
        self._channels[channel.id] = (*found, int(session, 16))

    def messages(
        self, wanted: Callable[[Topic, int], bool], from_ns: int | None = None, before_ns: int | None = None
    ) -> Iterator[LogMessage]:
        """The messages of the wanted topics and robots in the order of their arrival, from `from_ns` on and before
        `before_ns`. Raises ConfigError where the log is damaged."""
        channels = {number for number, (topic, robot, _) in self._channels.items() if wanted(topic, robot)}
        low = 0 if from_ns is None else from_ns
        high = 1 << 64 if before_ns is None else before_ns
        waiting: list[tuple[int, int, int, LogMessage]] = []  # log time, place in the file, place in the chunk
        for place in self._places:
            if place.end_ns < low or place.start_ns >= high or (place.channels and not place.channels & channels):
                continue
            while waiting and waiting[0][0] < place.start_ns:
                yield heappop(waiting)[-1]
            for k, line in enumerate(self._chunk(place, channels)):
                if low <= line.arrived_ns < high:
                    heappush(waiting, (line.arrived_ns, place.at, k, line))
        while waiting:
            yield heappop(waiting)[-1]

    def _chunk(self, place: _Place, channels: set[int]) -> Iterator[LogMessage]:
        """The messages of some channels in a chunk."""
        try:
            self._file.seek(place.at + 9)
            found = log_records.chunk(self._file.read(place.length), place.at)
            data = log_records.unpacked(found, Allowance(self._file.seek(0, 2)), place.at)
            for opcode, body in log_records.parts(data, place.at):
                if opcode == MESSAGE:
                    number, sequence, log_ns, stamp_ns, payload = log_records.message(body)
                    if number in channels:
                        topic, robot, session = self._channels[number]
                        yield LogMessage(topic, robot, Header(session, sequence, stamp_ns), payload, log_ns)
        except Damaged as error:
            raise ConfigError(f"{self.path}: cannot be read: {error}") from None


@contextmanager
def open_log(run: Path) -> Iterator[LogFile]:
    """The log in a run's folder. Of one that was cut off a copy is mended: its run may still go on. Raises ConfigError for
    what is no run."""
    path = run / "run.mcap"
    with ExitStack() as opened:
        try:
            readable = path
            if not is_complete(path):
                readable = Path(opened.enter_context(TemporaryDirectory())) / path.name
                shutil.copyfile(path, readable)
                recover(readable)
            log = LogFile(opened.enter_context(readable.open("rb")), path, readable)
        except OSError as error:
            raise ConfigError(f"{path}: {error.strerror or error}") from None
        yield log

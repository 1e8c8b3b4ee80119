"""SHELL: reads a recorded run back. A cut file gives what lies before the cut, a damaged one all but its damaged chunks.

with open_log(run) as log:                     # bytes unchanged, in order of arrival, any part of the time
    for line in log.messages(wanted): ...
log = read_log(run / "run.mcap")               # decoded messages in memory
for record in valid_records(path): ...         # everything in the file, in its order
"""

import io
import json
import os
import re
import struct
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from heapq import heappop, heappush
from pathlib import Path
from typing import IO, Any, Generic, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, McapRecord, Message, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from groundstation.logs.recorder import END_METADATA, EXPERIMENT_NAME, REPAIR_METADATA, RUN_METADATA
from shoal.errors import ConfigError
from shoal.messages import topics
from shoal.messages.codec import DecodeError, Header, decode
from shoal.messages.session_clocks import SessionClocks
from shoal.messages.topics import Topic
from shoal.runtime import mcap_records as log_records
from shoal.runtime.mcap_records import (
    ATTACHMENT,
    CHANNEL,
    CHUNK,
    FOOTER,
    MAGIC,
    MESSAGE,
    MESSAGE_INDEX,
    METADATA,
    SCHEMA,
    Allowance,
    Damaged,
)
from shoal.system.regular_files import open_regular

M = TypeVar("M")
SentMessage = tuple[Topic, int | None, Any, int]  # topic, robot, message, stamp in ns

READ = (
    topics.TRUTH,
    topics.POSE,
    topics.LOCALIZER,
    topics.STATE,
    topics.INPUTS,
    topics.HEARTBEAT,
    topics.TRAJECTORY,
    topics.TUNING,
    topics.EVENT,
)
# below any fleet's name: "shoal/robot/3/pose" is topic POSE of robot 3; no robot has a number of more than three digits
# "shoal/camera/west/robot/3/pose" is that of one of several cameras, and comes first: its end reads like the other
_PARTS = {"{robot}": r"(?P<robot>[1-9][0-9]{0,2})", "{camera}": r"(?P<camera>[a-z][a-z0-9-]*)"}
_PATTERNS = tuple(
    (re.compile(r"(?:.*/)?" + re.sub(r"\{\w+\}", lambda part: _PARTS[part[0]], name)), topic)
    for name, topic in (
        *((topic.of_camera("{camera}").name, topic) for topic in topics.OF_CAMERAS),
        *((topic.name, topic) for topic in topics.TOPICS),
    )
)
_READ: dict[int, Any] = {SCHEMA: Schema, CHANNEL: Channel, ATTACHMENT: Attachment, METADATA: Metadata}
MOST_NAMED = 5  # topics of another system that a message names
_CHUNK_HEAD = struct.Struct("<QQQ")  # first and last log time, unpacked size


# --- records


def is_complete(path: Path) -> bool:
    """True if the file was closed: a file that was cut does not end in MCAP's magic. Raises ConfigError for what never was a
    log, which must not be mended: nothing would be left of it."""
    with open_regular(path) as file:
        if not MCAP0_MAGIC.startswith(file.read(len(MCAP0_MAGIC))):
            raise ConfigError(f"{path}: is no log: it does not begin as MCAP files do")
        if file.seek(0, os.SEEK_END) < 2 * len(MCAP0_MAGIC):
            return False
        file.seek(-len(MCAP0_MAGIC), os.SEEK_END)
        return file.read() == MCAP0_MAGIC


def valid_records(path: Path, damage: list[str] | None = None) -> Iterator[McapRecord]:
    """All records that are whole, up to the first that cannot be followed, or is larger than shoal/runtime/mcap_records.py
    allows. `damage` takes what was left out, and where reading ended before the file did."""
    damage = [] if damage is None else damage
    with open_regular(path) as file:
        try:
            yield from _checked_records(file, damage)
        except Damaged as error:
            damage.append(str(error))


def _checked_records(file: IO[bytes], skipped: list[str]) -> Iterator[McapRecord]:
    """All schemas, channels, messages, attachments and metadata of a file; chunks taken apart, checksums verified. Raises
    Damaged where it is cut; damaged chunks are left out and go into `skipped`."""
    for opcode, body in log_records.records(file, skipped):
        if opcode == MESSAGE:
            yield _message(body)
        elif opcode in _READ:
            yield _parse(opcode, body)


def _message(body: bytes) -> Message:
    channel, sequence, log_time, publish_time, data = log_records.message(body)
    return Message(channel, log_time, data, publish_time, sequence)


def _parse(opcode: int, body: bytes) -> McapRecord:
    """A record of one of the kinds in _READ. Raises Damaged."""
    try:
        record: McapRecord = _READ[opcode].read(ReadDataStream(io.BytesIO(body)))
    except (McapError, ValueError, struct.error) as error:
        raise Damaged(f"a record {opcode} that cannot be read: {error}") from None
    return record


def key_topic(key: str) -> tuple[Topic, int] | None:
    """Topic and robot of a recorded key, robot 0 where the topic has none; None for a key that is not ours."""
    for pattern, topic in _PATTERNS:
        match = pattern.fullmatch(key)
        if match:
            parts = match.groupdict()
            return topic.of_camera(parts.get("camera", "")), int(parts.get("robot", 0))
    return None


# --- messages


@dataclass(frozen=True)
class LogMessage:
    """One message of the log. The age that its sender stated is not recorded."""

    topic: Topic
    robot: int  # 0: the topic has no robots
    header: Header
    payload: bytes
    arrived_ns: int


class Channels(dict[int, tuple[Topic, int, int]]):
    """Topic, robot and session of each channel of a log, as far as it is ours."""

    def take(self, record: McapRecord) -> LogMessage | None:
        """Take in a record. Returns the message that it is, if it is one of ours."""
        if isinstance(record, Channel):
            topic_and_robot, session = key_topic(record.topic), log_records.session_of(record.metadata)
            if topic_and_robot is not None and session is not None:
                self[record.id] = (*topic_and_robot, session)
        elif isinstance(record, Message) and record.channel_id in self:
            topic, robot, session = self[record.channel_id]
            header = Header(session, record.sequence, record.publish_time)
            return LogMessage(topic, robot, header, record.data, record.log_time)
        return None


def valid_messages(path: Path) -> Iterator[LogMessage]:
    """All messages of ours, in the order of the file, up to where it is cut."""
    channels = Channels()
    lines = (channels.take(record) for record in valid_records(path))
    return (line for line in lines if line is not None)


# --- any part of a log


@dataclass(frozen=True)
class _Place:
    """Position of a chunk in the file, with the times and channels that it states."""

    start_ns: int
    end_ns: int
    at: int
    length: int  # of the record, after its head
    channels: set[int] = field(default_factory=set)  # of its messages; empty if the file has no index of it


class LogFile:
    """A whole log, open. Chunks are read when they are needed, one after the other. Of one that was cut off, whose run may
    still go on, all chunks that were whole when it was opened."""

    def __init__(self, file: IO[bytes], path: Path) -> None:
        """Raises ConfigError for a file without messages, and for a damaged one that was not cut off."""
        self.path, self._file, self._cut = path, file, not is_complete(path)
        self._channels, places = Channels(), list[_Place]()
        try:
            self._index(places)
        except Damaged as error:
            if not self._cut:
                raise ConfigError(f"{path}: cannot be read: {error}") from None
        for place in places if self._cut else ():
            self._look_through(place)
        with_messages = [place for place in places if place.channels]
        if not with_messages and not self._cut:  # a file without an index of its messages
            with_messages = places
        if not with_messages:
            raise ConfigError(f"{path}: holds no messages")
        self._places = sorted(with_messages, key=lambda place: (place.start_ns, place.at))
        self.start_ns = self._places[0].start_ns
        self.end_ns = max(place.end_ns for place in self._places)

    def _index(self, places: list[_Place]) -> None:
        """Find the places of all chunks, and fill `_channels` with the channels declared outside of them: a closed file
        repeats its channels behind its chunks. Raises Damaged."""
        file_bytes = self._file.seek(0, os.SEEK_END)
        allowed, at, opcode = Allowance(file_bytes), len(MAGIC), 0
        while opcode != FOOTER:
            self._file.seek(at)
            opcode, length = log_records.read_head(self._file, at, file_bytes)
            if opcode == CHUNK:
                head = self._file.read(min(_CHUNK_HEAD.size, length))
                if len(head) < _CHUNK_HEAD.size:
                    raise Damaged(f"byte {at}: a chunk of {length} bytes")
                start_ns, end_ns, size = _CHUNK_HEAD.unpack(head)
                allowed.take(size, at)
                place = _Place(start_ns, end_ns, at, length)
                places += [place] if size else []
            elif opcode == MESSAGE_INDEX and places and length >= 2 and not self._cut:
                places[-1].channels.add(int.from_bytes(self._file.read(2), "little"))
            elif opcode == CHANNEL:
                self._channels.take(_parse(CHANNEL, self._file.read(length)))
            elif opcode == MESSAGE:
                raise Damaged(f"byte {at}: a message outside a chunk, which our recorder does not write")
            at += 9 + length

    def _look_through(self, place: _Place) -> None:
        """Note the channels that a chunk declares, and those of its messages, up to where it is damaged."""
        with suppress(Damaged):
            for part, body in self._chunk_records(place):
                if part == CHANNEL:
                    self._channels.take(_parse(CHANNEL, body))
                elif part == MESSAGE and (number := _message(body).channel_id) in self._channels:
                    place.channels.add(number)

    def _chunk_records(self, place: _Place) -> Iterator[tuple[int, bytes]]:
        """The records of a chunk. Raises Damaged."""
        self._file.seek(place.at + 9)
        chunk = log_records.chunk(self._file.read(place.length), place.at)
        data = log_records.unpacked(chunk, Allowance(self._file.seek(0, os.SEEK_END)), place.at)
        return log_records.parts(data, place.at)

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
        """Messages of some channels from one chunk of the file."""
        try:
            for opcode, body in self._chunk_records(place):
                record = _message(body) if opcode == MESSAGE else None
                if record is not None and record.channel_id in channels:
                    line = self._channels.take(record)
                    assert line is not None
                    yield line
        except Damaged as error:
            raise ConfigError(f"{self.path}: cannot be read: {error}") from None


@contextmanager
def open_log(run: Path) -> Iterator[LogFile]:
    """The log in a run's folder. Raises ConfigError for what is no run."""
    path = run / "run.mcap"
    try:
        file = open_regular(path)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from None
    with file:
        yield LogFile(file, path)


def metadata_of(path: Path) -> dict[str, str]:
    """Metadata that a log begins with: version, commit, mode and more of its run; empty if there is none. Raises OSError."""
    entries = (r.metadata for r in valid_records(path) if isinstance(r, Metadata) and r.name == RUN_METADATA)
    return next(entries, {})


# --- the whole run in memory


@dataclass(frozen=True, eq=False)
class DecodedMessage(Generic[M]):
    """A recorded message: the instant it is about and its arrival, both on the recorder's clock, and its place in the
    sequence."""

    stamp_ns: int
    arrived_ns: int
    sequence: int
    message: M
    session: int = 0
    shift_ns: int = 0  # `stamp_ns` minus the stamp as the sender's own clock has it


@dataclass(frozen=True, eq=False)
class RunLog:
    entries: dict[tuple[str, int], list[DecodedMessage[Any]]] = field(
        default_factory=dict
    )  # by topic name and robot (0: no robot)
    metadata: dict[str, str] = field(default_factory=dict)
    experiment_toml: str = ""
    exists: bool = True  # there is a file
    messages: int = 0  # of all topics, also of those that are not read here
    complete: bool = False  # the recorder came to the run's end
    damage: str = ""  # why reading ended before the file did, or left parts of it out
    ended: bool = False  # the recorder's last word is there
    dropped: int = 0  # messages the recorder could not take
    pace: tuple[tuple[int, int], ...] = ()  # (log time, wall time) pairs in ns, from the recorder; empty if it was cut off
    undecodable: int = 0
    clocks: SessionClocks = field(default_factory=SessionClocks)
    foreign: str = ""  # topics of a log that holds none of ours

    @property
    def trouble(self) -> str:
        """Trouble with the log as a whole, the first line of its report. Empty if it holds the whole run."""
        if not self.exists:
            return "No log: there is no run.mcap in this folder."
        if not self.messages:
            why = f" ({self.damage})" if self.damage else ""
            return f"Empty log: run.mcap holds no message that can be read{why}."
        if self.foreign:
            return f"Log of another system: none of its topics is recorded here ({self.foreign})."
        if not self.complete and self.ended:
            return f"Damaged log: not all of run.mcap can be read ({self.damage}). What could be read is evaluated."
        if not self.complete:
            why = f" ({self.damage})" if self.damage else ""
            return f"Cut log: run.mcap ends before its run does{why}. What could be read is evaluated."
        if self.dropped:
            return f"Log with gaps: the recorder could not take {self.dropped} messages."
        return ""

    def of(self, topic: Topic, kind: type[M], robot: int = 0) -> list[DecodedMessage[M]]:
        """Everything recorded of a topic, in the order of the stamps."""
        assert kind is topic.type
        return self.entries.get((topic.name, robot), [])


def log_in_memory(messages: Iterable[SentMessage], metadata: Mapping[str, str]) -> RunLog:
    """The log of a run that this process flies, without a file. Every message arrives at its stamp."""
    entries: dict[tuple[str, int], list[DecodedMessage[Any]]] = {}
    for topic, robot, message, stamp_ns in messages:
        messages_of_topic = entries.setdefault((topic.name, robot or 0), [])
        messages_of_topic.append(DecodedMessage(stamp_ns, stamp_ns, len(messages_of_topic) + 1, message))
    count = sum(map(len, entries.values()))
    return RunLog(entries, dict(metadata), messages=count, complete=True, ended=True)


def read_log(path: Path, wanted: Collection[Topic] = READ, kept_of: Callable[[Any], Any] = lambda message: message) -> RunLog:
    """Read the wanted topics of a run into memory (docs/runs.md says how much that takes), of each message what `kept_of`
    returns. Raises OSError if there is no such file; damage inside it only shortens what is found, and is told in `damage`."""
    channels, entries = Channels(), dict[tuple[str, int], list[DecodedMessage[Any]]]()
    others = dict[str, None]()  # topics that are not ours
    metadata: dict[str, dict[str, str]] = {}
    experiment_toml, messages, undecodable = "", 0, 0
    damage, clocks = list[str](), SessionClocks()
    for record in valid_records(path, damage):
        messages += isinstance(record, Message)
        if isinstance(record, Attachment) and record.name == EXPERIMENT_NAME:
            experiment_toml = record.data.decode(errors="replace")
        elif isinstance(record, Metadata):
            metadata[record.name] = record.metadata
        if isinstance(record, Channel):
            others[record.topic] = None
        line = channels.take(record)
        if line is None:
            continue
        topic, header = line.topic, line.header
        if topic not in wanted:
            clocks.note(topic, header.session, header.stamp_ns, line.arrived_ns, None)
            continue
        try:
            message: Any = decode(line.topic.type, line.payload, "log", line.topic.name)
        except DecodeError:
            undecodable += 1
            continue
        clocks.note(topic, header.session, header.stamp_ns, line.arrived_ns, message)
        entry = DecodedMessage(header.stamp_ns, line.arrived_ns, header.sequence, kept_of(message), header.session)
        entries.setdefault((line.topic.name, line.robot), []).append(entry)
    damage += [text for text in [metadata.get(REPAIR_METADATA, {}).get("damage", "")] if text]
    for (name, _), found_entries in entries.items():
        found_entries[:] = (_carried(entry, name, clocks) for entry in found_entries)
        found_entries.sort(key=lambda entry: entry.stamp_ns)
    end = metadata.get(END_METADATA, {})
    return RunLog(
        entries=entries,
        metadata=metadata.get(RUN_METADATA, {}),
        experiment_toml=experiment_toml,
        messages=messages,
        # a mended file ends as it should, and lacks what was cut off all the same
        complete=END_METADATA in metadata and not damage,
        damage=damage_in_words(damage),
        ended=END_METADATA in metadata,
        dropped=_dropped(end),
        pace=_pace(end),
        undecodable=undecodable,
        clocks=clocks,
        foreign="" if channels or RUN_METADATA in metadata else _named(others),
    )


def _carried(entry: DecodedMessage[M], topic: str, clocks: SessionClocks) -> DecodedMessage[M]:
    """A message with its stamp on the recorder's clock."""
    shift_ns = clocks.shift_ns(topic, entry.session, entry.stamp_ns)
    return replace(entry, stamp_ns=entry.stamp_ns + shift_ns, shift_ns=shift_ns) if shift_ns else entry


def _named(names: Iterable[str]) -> str:
    """The first of some names, for people."""
    some = list(names)
    return ", ".join(some[:MOST_NAMED]) + (f" and {len(some) - MOST_NAMED} more" if len(some) > MOST_NAMED else "")


def damage_in_words(damage: Sequence[str]) -> str:
    """Damage in one line: the first, and how many more there are."""
    more = f", and {len(damage) - 1} more" if len(damage) > 1 else ""
    return f"{damage[0]}{more}" if damage else ""


def _dropped(end: Mapping[str, str]) -> int:
    """Number of messages that the recorder dropped, as it wrote it at the end; 0 for what is no number."""
    text = end.get("dropped", "0")
    return int(text) if re.fullmatch(r"[0-9]{1,18}", text) else 0


def _pace(end: Mapping[str, str]) -> tuple[tuple[int, int], ...]:
    """Pairs of (log time, wall clock) in ns, as the recorder wrote them at the end; empty for what is no list of pairs."""
    try:
        return tuple((int(stamp_ns), int(wall_ns)) for stamp_ns, wall_ns in json.loads(end.get("pace", "[]")))
    except (ValueError, TypeError, OverflowError, RecursionError):
        return ()

"""SHELL: reads a recorded run back into checked messages. A cut or damaged file gives what lies before the damage."""

import json
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

from mcap.records import Attachment, Channel, McapRecord, Message, Metadata

from groundstation.logs.recorder import END_METADATA, EXPERIMENT_NAME, RUN_METADATA
from groundstation.logs.repair import checked_records
from wire.messages import topics
from wire.messages.codec import DecodeError, decode
from wire.messages.log_records import Damaged
from wire.messages.topics import Topic

M = TypeVar("M")

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
EVERYTHING = tuple(topic for topic in topics.TOPICS if topic.recorded)
# below any fleet's name: "shoal/robot/3/pose" is topic POSE of robot 3; no robot has a number of more than three digits
_PATTERNS = tuple(
    (re.compile(r"(?:.*/)?" + topic.name.replace("{robot}", r"([1-9][0-9]{0,2})")), topic) for topic in topics.TOPICS
)


@dataclass(frozen=True, eq=False)
class DecodedMessage(Generic[M]):
    """A recorded message: the instant it is about (sender's clock), its arrival (wall clock), its place in the sequence."""

    stamp_ns: int
    arrived_ns: int
    sequence: int
    message: M


@dataclass(frozen=True, eq=False)
class RunLog:
    """A recorded run."""

    entries: dict[tuple[str, int], list[DecodedMessage[Any]]] = field(
        default_factory=dict
    )  # by topic name and robot (0: no robot)
    metadata: dict[str, str] = field(default_factory=dict)
    experiment_toml: str = ""
    found: bool = True  # there is a file
    messages: int = 0  # of all topics, also of those that are not read here
    complete: bool = False  # the recorder came to the run's end
    damage: str = ""  # why reading ended before the file did
    dropped: int = 0  # messages the recorder could not take
    pace: tuple[tuple[int, int], ...] = ()  # (stamp, wall time) pairs in ns, from the recorder; empty if it was cut off
    undecodable: int = 0

    @property
    def trouble(self) -> str:
        """Trouble with the log as a whole, the first line of its report. Empty if it holds the whole run."""
        if not self.found:
            return "No log: there is no run.mcap in this folder."
        if not self.messages:
            why = f" ({self.damage})" if self.damage else ""
            return f"Empty log: run.mcap holds no message that can be read{why}."
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


def read_log(path: Path, wanted: Collection[Topic] = READ) -> RunLog:
    """Read the wanted topics of a run into memory (docs/runs.md says how much that takes). Raises OSError if there is no such
    file; damage inside it only shortens what is found, and is told in `damage`."""
    reading = _Reading(wanted)
    damage = ""
    with path.open("rb") as file:
        try:
            for record in checked_records(file):
                reading.take(record)
        except Damaged as error:
            damage = str(error)
    for found_entries in reading.entries.values():
        found_entries.sort(key=lambda entry: entry.stamp_ns)
    end = reading.metadata.get(END_METADATA, {})
    return RunLog(
        entries=reading.entries,
        metadata=reading.metadata.get(RUN_METADATA, {}),
        experiment_toml=reading.experiment_toml,
        messages=reading.messages,
        # a mended file ends as it should, and lacks what was cut off all the same
        complete=END_METADATA in reading.metadata and not damage,
        damage=damage,
        dropped=_dropped(end),
        pace=_pace(end),
        undecodable=reading.undecodable,
    )


@dataclass(eq=False)
class _Reading:
    """Content of a log as read so far."""

    wanted: Collection[Topic]
    entries: dict[tuple[str, int], list[DecodedMessage[Any]]] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    experiment_toml: str = ""
    messages: int = 0
    undecodable: int = 0
    channels: dict[int, tuple[Topic, int]] = field(default_factory=dict)

    def take(self, record: McapRecord) -> None:
        """Take in one record."""
        if isinstance(record, Message):
            self._message(record)
        elif isinstance(record, Channel):
            found = key_topic(record.topic)
            if found is not None and found[0] in self.wanted:
                self.channels[record.id] = found
        elif isinstance(record, Attachment) and record.name == EXPERIMENT_NAME:
            self.experiment_toml = record.data.decode(errors="replace")
        elif isinstance(record, Metadata):
            self.metadata[record.name] = record.metadata

    def _message(self, record: Message) -> None:
        self.messages += 1
        if record.channel_id not in self.channels:
            return
        topic, robot = self.channels[record.channel_id]
        try:
            message: Any = decode(topic.type, record.data, "log", topic.name)
        except DecodeError:
            self.undecodable += 1
            return
        entry = DecodedMessage(record.publish_time, record.log_time, record.sequence, message)
        self.entries.setdefault((topic.name, robot), []).append(entry)


def _dropped(end: Mapping[str, str]) -> int:
    """As the recorder wrote it at the end; 0 for what is no number."""
    text = end.get("dropped", "0")
    return int(text) if re.fullmatch(r"[0-9]{1,18}", text) else 0


def _pace(end: Mapping[str, str]) -> tuple[tuple[int, int], ...]:
    """As the recorder wrote it at the end; empty for what is no list of pairs."""
    try:
        return tuple((int(stamp_ns), int(wall_ns)) for stamp_ns, wall_ns in json.loads(end.get("pace", "[]")))
    except (ValueError, TypeError, OverflowError, RecursionError):
        return ()


def key_topic(key: str) -> tuple[Topic, int] | None:
    """Topic and robot (0: it has none) of a recorded key; None for what is none of ours."""
    for pattern, topic in _PATTERNS:
        match = pattern.fullmatch(key)
        if match:
            return topic, int(match[1]) if match.groups() else 0
    return None

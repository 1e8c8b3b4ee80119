"""SHELL: reads a recorded run back into checked messages. A cut or damaged file gives what lies before the damage."""

import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

from mcap.records import Attachment, Channel, Message, Metadata

from groundstation.recorder import END_METADATA, EXPERIMENT_NAME, RUN_METADATA
from groundstation.recovery import valid_records
from wire import topics
from wire.codec import DecodeError, decode
from wire.topics import Topic

M = TypeVar("M")

READ = (
    topics.TRUTH,
    topics.POSE,
    topics.LOCALIZER,
    topics.STATE,
    topics.INPUTS,
    topics.TRAJECTORY,
    topics.TUNING,
    topics.EVENT,
)
# below any fleet's name: "shoal/robot/3/pose" is topic POSE of robot 3
_PATTERNS = tuple((re.compile(r"(?:.*/)?" + topic.name.replace("{robot}", r"(\d+)")), topic) for topic in topics.TOPICS)


@dataclass(frozen=True, eq=False)
class Entry(Generic[M]):
    """A recorded message: the instant it is about (sender's clock), its arrival (wall clock), its place in the sequence."""

    stamp_ns: int
    arrived_ns: int
    sequence: int
    message: M


@dataclass(frozen=True, eq=False)
class RunLog:
    """A run as it was recorded."""

    entries: dict[tuple[str, int], list[Entry[Any]]] = field(default_factory=dict)  # by topic name and robot (0: no robot)
    metadata: dict[str, str] = field(default_factory=dict)
    experiment_toml: str = ""
    complete: bool = False  # the recorder came to the run's end
    dropped: int = 0  # messages the recorder could not take
    pace: tuple[tuple[int, int], ...] = ()  # (stamp, wall time) pairs in ns, from the recorder; empty if it was cut off
    undecodable: int = 0

    def of(self, topic: Topic, kind: type[M], robot: int = 0) -> list[Entry[M]]:
        """Everything recorded of a topic, in the order of the stamps."""
        assert kind is topic.type
        return self.entries.get((topic.name, robot), [])


def read_log(path: Path) -> RunLog:
    """Read a run. Raises OSError if there is no such file; damage inside it only shortens what is found."""
    entries: dict[tuple[str, int], list[Entry[Any]]] = {}
    metadata: dict[str, dict[str, str]] = {}
    experiment_toml, undecodable = "", 0
    channels: dict[int, tuple[Topic, int]] = {}
    for record in valid_records(path):
        if isinstance(record, Channel):
            found = key_topic(record.topic)
            if found is not None and found[0] in READ:
                channels[record.id] = found
        elif isinstance(record, Message) and record.channel_id in channels:
            topic, robot = channels[record.channel_id]
            try:
                message: Any = decode(topic.type, record.data, "log", topic.name)
            except DecodeError:
                undecodable += 1
                continue
            entry = Entry(record.publish_time, record.log_time, record.sequence, message)
            entries.setdefault((topic.name, robot), []).append(entry)
        elif isinstance(record, Attachment) and record.name == EXPERIMENT_NAME:
            experiment_toml = record.data.decode(errors="replace")
        elif isinstance(record, Metadata):
            metadata[record.name] = record.metadata
    for found_entries in entries.values():
        found_entries.sort(key=lambda entry: entry.stamp_ns)
    end = metadata.get(END_METADATA, {})
    return RunLog(
        entries=entries,
        metadata=metadata.get(RUN_METADATA, {}),
        experiment_toml=experiment_toml,
        complete=END_METADATA in metadata,  # a mended file ends as it should, and lacks what was cut off all the same
        dropped=int(end.get("dropped", "0")),
        pace=tuple((int(stamp_ns), int(wall_ns)) for stamp_ns, wall_ns in json.loads(end.get("pace", "[]"))),
        undecodable=undecodable,
    )


def key_topic(key: str) -> tuple[Topic, int] | None:
    """Topic and robot (0: it has none) of a recorded key; None for what is none of ours."""
    for pattern, topic in _PATTERNS:
        match = pattern.fullmatch(key)
        if match:
            return topic, int(match[1]) if match.groups() else 0
    return None

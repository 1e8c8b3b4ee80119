"""SHELL: a recorded log as it was heard: message by message, bytes unchanged, also one that was cut off."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from mcap.exceptions import McapError
from mcap.reader import McapReader, make_reader

from groundstation.recovery import is_complete, recover
from groundstation.runlog import key_topic
from wire.codec import Header
from wire.toml_file import ConfigError
from wire.topics import Topic


@dataclass(frozen=True)
class Line:
    """One message of the log. The age that its sender stated is not in it."""

    topic: Topic
    robot: int  # 0: the topic has no robots
    header: Header
    payload: bytes
    arrived_ns: int


class LogFile:
    """A whole log, open."""

    def __init__(self, reader: McapReader, path: Path, readable: Path) -> None:
        """`readable` is the file that is read: `path`, or a mended copy."""
        summary = reader.get_summary()
        if summary is None or summary.statistics is None or not summary.statistics.message_count:
            raise ConfigError(f"{path}: holds no messages")
        self.path, self.readable = path, readable
        self.start_ns = summary.statistics.message_start_time
        self.end_ns = summary.statistics.message_end_time
        self._reader = reader
        self._channels = {
            channel.id: (channel.topic, *found, int(channel.metadata.get("session", "0"), 16))
            for channel in summary.channels.values()
            if (found := key_topic(channel.topic)) is not None
        }

    def lines(
        self, wanted: Callable[[Topic, int], bool], from_ns: int | None = None, before_ns: int | None = None
    ) -> Iterator[Line]:
        """The messages of the wanted topics and robots in the order of their arrival, from `from_ns` on and before
        `before_ns`."""
        keys = sorted({key for key, topic, robot, _ in self._channels.values() if wanted(topic, robot)})
        if not keys:
            return
        for _, channel, message in self._reader.iter_messages(topics=keys, starting_at=from_ns, ending_before=before_ns):
            _, topic, robot, session = self._channels[channel.id]
            header = Header(session, message.sequence, message.publish_time)
            yield Line(topic, robot, header, message.data, message.log_time)


@contextmanager
def open_log(run: Path) -> Iterator[LogFile]:
    """The log in a run's folder. Of one that was cut off a copy is mended: its run may still go on. Raises ConfigError for
    what is no run."""
    path = run / "run.mcap"
    with TemporaryDirectory() as place:
        readable = path
        try:
            if not is_complete(path):
                readable = Path(place) / path.name
                shutil.copyfile(path, readable)
                recover(readable)
            with readable.open("rb") as file:
                yield LogFile(make_reader(file), path, readable)
        except OSError as error:
            raise ConfigError(f"{path}: {error.strerror or error}") from None
        except McapError as error:
            raise ConfigError(f"{path}: {error}") from None

"""SHELL: repair of a log that was cut by a crash or a kill, or has damaged chunks: a whole file made of its valid records.

if recover(path): ...           # mended; the file opens in all readers

What a mended log has lost stands in its metadata, so that every report tells it. The original stays beside it, as
`run.mcap.original`: nobody can say how much of what follows the damage could still be read.
"""

import fcntl
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mcap.records import Attachment, Channel, McapRecord, Message, Metadata, Schema
from mcap.writer import Writer

from groundstation.logs.reader import damage_in_words, is_complete, valid_records
from groundstation.logs.recorder import CHUNK_BYTES, REPAIR_METADATA, claim
from shoal.errors import ConfigError
from shoal.runtime.output_files import replacing
from shoal.system.regular_files import open_regular

ORIGINAL = ".original"  # end of the name that the file keeps
MOST_KEPT = 100


def recover(path: Path) -> bool:
    """Make a cut or damaged file whole again: keep every whole chunk up to the cut, add the index. True if there was something
    to mend.

    Raises OSError if the mended file cannot be written, or the recorder still writes this one, which would go on in a file
    without a name; ConfigError for what never was a log, or has no record that can be read. The file then stays as it is.
    """
    complete, damage = is_complete(path), list[str]()
    for _ in valid_records(path, damage) if complete else ():
        pass
    if complete and not damage:
        return False
    with open_regular(path) as cut:
        claim(cut.fileno(), path, fcntl.LOCK_SH, "its run still goes on")
        damage.clear()
        with replacing(path, keep=originals) as file:
            writer: Any = Writer(file, chunk_size=CHUNK_BYTES)  # Any: mcap is typed in part
            writer.start(library="shoal, recovered")
            copier, is_empty = RecordCopier(writer), True
            for record in valid_records(path, damage):
                copier.copy(record)
                is_empty = False
            if is_empty:
                raise ConfigError(f"{path}: nothing to keep: no record can be read ({damage_in_words(damage)})")
            if damage:
                writer.add_metadata(REPAIR_METADATA, {"damage": damage_in_words(damage)})
            writer.finish()
    return True


def originals(path: Path) -> Iterator[Path]:
    """Names under which the original of a mended log is kept."""
    yield from (path.with_name(f"{path.name}{ORIGINAL}{f'-{number}' if number > 1 else ''}") for number in range(1, MOST_KEPT))


class RecordCopier:
    """Copies records of one log into another, with the numbers that schemas and channels have there."""

    def __init__(self, writer: Any) -> None:
        self._writer = writer
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, int] = {}

    def copy(self, record: McapRecord) -> None:
        """Copy a record. A channel of an unknown schema goes without one; a message of an unknown channel is left out."""
        writer = self._writer
        if isinstance(record, Schema) and record.id not in self._schemas:
            self._schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in self._channels:
            schema = self._schemas.get(record.schema_id, 0)
            self._channels[record.id] = writer.register_channel(record.topic, record.message_encoding, schema, record.metadata)
        elif isinstance(record, Message) and record.channel_id in self._channels:
            channel = self._channels[record.channel_id]
            writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
        elif isinstance(record, Attachment):
            writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
        elif isinstance(record, Metadata):
            writer.add_metadata(record.name, record.metadata)

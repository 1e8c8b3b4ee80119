"""SHELL: a log that was cut, by a crash or a kill: what of it is good, and how it becomes whole again.

if recover(path): ...           # mended; the file opens in all readers
for record in valid_records(path): ...
"""

import fcntl
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import zstandard
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC, Writer

from groundstation.recorder import CHUNK_BYTES, claim
from wire.toml_file import ConfigError

MAX_RECORD_BYTES = 256 * 1024 * 1024  # a damaged length field must not make the reader ask for all memory


def is_complete(path: Path) -> bool:
    """Whether the file was closed: a file that was cut does not end in MCAP's magic. Raises ConfigError for what never was a
    log, which must not be mended: nothing would be left of it."""
    with path.open("rb") as file:
        if not MCAP0_MAGIC.startswith(file.read(len(MCAP0_MAGIC))):
            raise ConfigError(f"{path}: is no log: it does not begin as MCAP files do")
        file.seek(0, os.SEEK_END)
        if file.tell() < 2 * len(MCAP0_MAGIC):
            return False
        file.seek(-len(MCAP0_MAGIC), os.SEEK_END)
        return file.read() == MCAP0_MAGIC


def valid_records(path: Path) -> Iterator[McapRecord]:
    """All records up to the first that is cut or damaged, chunks taken apart, checksums verified."""
    with path.open("rb") as file:
        reader = StreamReader(file, validate_crcs=True, record_size_limit=MAX_RECORD_BYTES)
        try:
            yield from reader.records
        except (McapError, ValueError, struct.error, zstandard.ZstdError, MemoryError):  # the last: of a length that is none
            return


def recover(path: Path) -> bool:
    """Make a cut file whole again: keep everything up to the cut, add the index. True if there was something to mend.

    Raises OSError if the mended file cannot be written, or the recorder still writes this one, which would go on in a file
    without a name; ConfigError for what never was a log. The file then stays as it is.
    """
    if is_complete(path):
        return False
    mended = path.with_name(path.name + ".mending")
    with path.open("rb") as cut:
        claim(cut.fileno(), path, fcntl.LOCK_SH, "its run still goes on")
        try:
            with mended.open("wb") as file:
                _copy(path, Writer(file, chunk_size=CHUNK_BYTES))
                file.flush()
                os.fsync(file.fileno())
            mended.replace(path)
        finally:
            mended.unlink(missing_ok=True)
    return True


def _copy(path: Path, writer: Any) -> None:
    schemas: dict[int, int] = {0: 0}
    channels: dict[int, int] = {}
    writer.start(library="shoal, recovered")
    for record in valid_records(path):
        if isinstance(record, Schema) and record.id not in schemas:
            schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in channels:
            channels[record.id] = writer.register_channel(
                record.topic, record.message_encoding, schemas[record.schema_id], record.metadata
            )
        elif isinstance(record, Message):
            channel = channels[record.channel_id]
            writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
        elif isinstance(record, Attachment):
            writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
        elif isinstance(record, Metadata):
            writer.add_metadata(record.name, record.metadata)
    writer.finish()

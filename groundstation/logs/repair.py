"""SHELL: repair of a log that was cut by a crash or a kill: its valid records, and a whole file made of them.

if recover(path): ...           # mended; the file opens in all readers
for record in valid_records(path): ...
"""

import fcntl
import io
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, McapRecord, Message, Metadata, Schema
from mcap.writer import MCAP0_MAGIC, Writer

from groundstation.logs.recorder import CHUNK_BYTES, claim
from wire.messages import log_records
from wire.messages.log_records import ATTACHMENT, CHANNEL, MESSAGE, METADATA, SCHEMA, Damaged
from wire.process.output_files import replacing
from wire.toml_loader import ConfigError

_READ: dict[int, Any] = {SCHEMA: Schema, CHANNEL: Channel, ATTACHMENT: Attachment, METADATA: Metadata}


def is_complete(path: Path) -> bool:
    """True if the file was closed: a file that was cut does not end in MCAP's magic. Raises ConfigError for what never was a
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
    """All records up to the first that is cut, damaged, or larger than wire/messages/log_records.py allows; chunks taken
    apart, checksums verified."""
    with path.open("rb") as file:
        try:
            yield from checked_records(file)
        except Damaged:
            return


def checked_records(file: IO[bytes]) -> Iterator[McapRecord]:
    """All schemas, channels, messages, attachments and metadata of a file. Raises Damaged where it is cut or damaged."""
    for opcode, body in log_records.records(file):
        if opcode == MESSAGE:
            channel, sequence, log_time, publish_time, data = log_records.message(body)
            yield Message(channel, log_time, data, publish_time, sequence)
        elif opcode in _READ:
            yield parse(opcode, body)


def parse(opcode: int, body: bytes) -> McapRecord:
    """A record of one of the kinds in _READ. Raises Damaged."""
    try:
        found: McapRecord = _READ[opcode].read(ReadDataStream(io.BytesIO(body)))
    except (McapError, ValueError, struct.error) as error:
        raise Damaged(f"a record {opcode} that cannot be read: {error}") from None
    return found


def recover(path: Path) -> bool:
    """Make a cut file whole again: keep everything up to the cut, add the index. True if there was something to mend.

    Raises OSError if the mended file cannot be written, or the recorder still writes this one, which would go on in a file
    without a name; ConfigError for what never was a log. The file then stays as it is.
    """
    if is_complete(path):
        return False
    with path.open("rb") as cut:
        claim(cut.fileno(), path, fcntl.LOCK_SH, "its run still goes on")
        with replacing(path, durable=True) as file:
            _copy(path, Writer(file, chunk_size=CHUNK_BYTES))
    return True


def _copy(path: Path, writer: Any) -> None:
    """Copy everything that belongs to something: a channel of an unknown schema goes without one, a message of an unknown
    channel says nothing to anybody and is left out."""
    schemas: dict[int, int] = {0: 0}
    channels: dict[int, int] = {}
    writer.start(library="shoal, recovered")
    for record in valid_records(path):
        if isinstance(record, Schema) and record.id not in schemas:
            schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in channels:
            schema = schemas.get(record.schema_id, 0)
            channels[record.id] = writer.register_channel(record.topic, record.message_encoding, schema, record.metadata)
        elif isinstance(record, Message) and record.channel_id in channels:
            channel = channels[record.channel_id]
            writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
        elif isinstance(record, Attachment):
            writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
        elif isinstance(record, Metadata):
            writer.add_metadata(record.name, record.metadata)
    writer.finish()

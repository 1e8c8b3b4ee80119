"""SHELL: the records of an MCAP file, read with bounds on memory and time: a log may come from an unknown source.

    for opcode, body in records(file): ...      # chunks taken apart; raises Damaged where the file stops being a log
    skipped: list[str] = []
    for opcode, body in records(file, skipped): ...     # goes on behind a damaged chunk or attachment, and says which

A record is refused before its bytes are read when it is larger than the file can hold or than LARGEST_BYTES, a chunk before it
is unpacked when it says, or turns out, to be larger than LARGEST_BYTES. All chunks together may unpack to UNPACKED_AT_LEAST
bytes and UNPACKED_TIMES the size of the file: what a reader keeps in memory grows with the file that it was given.
Layout: https://mcap.dev/spec. Needs only the standard library, and zstandard or lz4 for chunks that are packed with them.
"""

import importlib
import os
import re
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import IO, NamedTuple

MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, ATTACHMENT, METADATA, DATA_END, FOOTER = 3, 4, 5, 6, 7, 9, 12, 15, 2
IN_CHUNKS = frozenset({SCHEMA, CHANNEL, MESSAGE})  # what the specification allows there

LARGEST_BYTES = 32 * 1024 * 1024  # of a record, and of an unpacked chunk; the recorder's largest chunk has 4.3 MB
UNPACKED_AT_LEAST = 16 * 1024 * 1024
UNPACKED_TIMES = 64  # a pool's log unpacks to twice its size, its best chunk to five times

SESSION = "session"  # a channel's metadata: the session of its sender, in hexadecimal digits
LATEST_NS = (1 << 63) - 1  # MCAP's times have 64 bits without a sign, ours, and those of other programs' tables, have one

_HEAD = struct.Struct("<BQ")  # opcode, length
_CHUNK = struct.Struct("<QQQI")  # first and last log time, unpacked size, checksum of it
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_U16, _U32, _U64 = struct.Struct("<H"), struct.Struct("<I"), struct.Struct("<Q")


class Damaged(Exception):
    """Raised where a file stops being a readable log, with the place and the reason."""


@dataclass(frozen=True)
class Packed:
    """A chunk as it lies in the file."""

    start_ns: int  # as it says: log time of its first message
    end_ns: int
    size: int  # unpacked
    checksum: int  # of the unpacked bytes; 0: none
    packing: str
    data: bytes


def records(file: IO[bytes], skipped: list[str] | None = None) -> Iterator[tuple[int, bytes]]:
    """Opcode and body of every record in order, chunks replaced by what is in them, checksums verified. Raises Damaged where
    the records themselves cannot be followed. With `skipped` a chunk or an attachment that is damaged in itself is left out
    and named there; without it that is an error too. A channel is declared once, in the chunk of its first message: in place
    of the first damaged chunk come the declarations of the file's end, or nothing behind that chunk could be read."""
    allowed = Allowance(file.seek(0, os.SEEK_END))
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        raise Damaged("does not begin as MCAP files do")
    checksum, are_declared = zlib.crc32(MAGIC), False
    while True:
        at = file.tell()
        opcode, length = read_head(file, at, allowed.file_bytes)
        body = file.read(length)
        if len(body) < length:
            raise Damaged(f"byte {at}: cut within a record")
        if opcode == CHUNK:
            count = len(skipped or ())
            yield from _within(body, allowed, at, skipped)
            if len(skipped or ()) > count and not are_declared:
                are_declared = True
                yield from _declared(file, allowed.file_bytes)
        elif opcode == ATTACHMENT and len(body) >= 4 and _U32.unpack(body[-4:])[0] not in (0, zlib.crc32(body[:-4])):
            _tell(Damaged(f"byte {at}: an attachment's checksum is wrong"), skipped)
        else:
            if opcode == DATA_END and len(body) >= 4 and _U32.unpack_from(body)[0] not in (0, checksum):
                _tell(Damaged(f"byte {at}: the file's checksum is wrong"), skipped)
            yield opcode, body
        if opcode == FOOTER:
            return
        checksum = zlib.crc32(body, zlib.crc32(_HEAD.pack(opcode, length), checksum))


def _within(body: bytes, allowed: "Allowance", at: int, skipped: list[str] | None) -> Iterable[tuple[int, bytes]]:
    """The records of a chunk; none, with `skipped`, of a damaged one."""
    try:
        within = parts(unpacked(chunk(body, at), allowed, at), at)
        return within if skipped is None else list(within)
    except Damaged as error:
        _tell(error, skipped)
        return ()


def _declared(file: IO[bytes], file_bytes: int) -> Iterator[tuple[int, bytes]]:
    """The schemas and channels that stand outside of chunks from here on. The file is then read on from here."""
    begin = at = file.tell()
    with suppress(Damaged):
        opcode = 0
        while opcode != FOOTER:
            file.seek(at)
            opcode, length = read_head(file, at, file_bytes)
            at += _HEAD.size + length
            if opcode in (SCHEMA, CHANNEL):
                yield opcode, file.read(length)
    file.seek(begin)


def _tell(error: Damaged, skipped: list[str] | None) -> None:
    if skipped is None:
        raise error
    skipped.append(str(error))


class Allowance:
    """The number of bytes to which the chunks of one file may still unpack."""

    def __init__(self, file_bytes: int) -> None:
        self.file_bytes = file_bytes
        self._left = UNPACKED_AT_LEAST + UNPACKED_TIMES * file_bytes

    def take(self, size: int, at: int) -> None:
        """Raises Damaged for a chunk that is too large, or one too many."""
        if size > LARGEST_BYTES:
            raise Damaged(f"byte {at}: a chunk of {size} bytes (allowed: {LARGEST_BYTES})")
        self._left -= size
        if self._left < 0:
            raise Damaged(f"byte {at}: chunks of more than {UNPACKED_TIMES} times the file's {self.file_bytes} bytes")


def read_head(file: IO[bytes], at: int, file_bytes: int) -> tuple[int, int]:
    """Opcode and length of the record that begins here. Raises Damaged for one that cannot be."""
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        raise Damaged(f"byte {at}: the file ends without its last record")
    opcode, length = _HEAD.unpack(head)
    if opcode == 0:
        raise Damaged(f"byte {at}: no record of MCAP")
    if length > min(LARGEST_BYTES, file_bytes - at):
        raise Damaged(f"byte {at}: a record of {length} bytes (allowed: {LARGEST_BYTES}, {file_bytes - at} are left)")
    return opcode, length


def chunk(body: bytes, at: int) -> Packed:
    """The chunk in a record's body. Raises Damaged."""
    try:
        start_ns, end_ns, size, checksum = _CHUNK.unpack_from(body)
        packing, place = _text(body, _CHUNK.size)
        length = _U64.unpack_from(body, place)[0]
    except (struct.error, UnicodeDecodeError) as error:
        raise Damaged(f"byte {at}: no chunk: {error}") from None
    data = body[place + 8 : place + 8 + length]
    if len(data) < length:
        raise Damaged(f"byte {at}: a chunk of {length} bytes in a record of {len(body)}")
    return Packed(start_ns, end_ns, size, checksum, packing, data)


def unpacked(packed: Packed, allowed: Allowance, at: int) -> bytes:
    """A chunk's content. Raises Damaged; ImportError where the package that unpacks it is not installed."""
    allowed.take(packed.size, at)
    data = _unpack(packed, at)
    if len(data) != packed.size:
        raise Damaged(f"byte {at}: a chunk that does not unpack to the {packed.size} bytes that it says")
    if packed.checksum and zlib.crc32(data) != packed.checksum:
        raise Damaged(f"byte {at}: a chunk's checksum is wrong")
    return data


def _unpack(packed: Packed, at: int) -> bytes:
    """Unpack a chunk to never more than one byte beyond the size that the chunk says."""
    if packed.packing == "":
        return packed.data
    if packed.packing == "zstd":
        import zstandard

        try:
            unpacker = zstandard.ZstdDecompressor(max_window_size=LARGEST_BYTES)
            with unpacker.stream_reader(packed.data) as stream:
                return stream.read(packed.size + 1)
        except (zstandard.ZstdError, MemoryError) as error:
            raise Damaged(f"byte {at}: a chunk that cannot be unpacked: {error}") from None
    if packed.packing == "lz4":
        lz4_frame = importlib.import_module("lz4.frame")  # it ships no types
        try:
            return bytes(lz4_frame.LZ4FrameDecompressor().decompress(packed.data, packed.size + 1))
        except RuntimeError as error:
            raise Damaged(f"byte {at}: a chunk that cannot be unpacked: {error}") from None
    raise Damaged(f"byte {at}: a chunk packed with {packed.packing[:20]!r} (allowed: zstd, lz4, none)")


def parts(data: bytes, at: int) -> Iterator[tuple[int, bytes]]:
    """The records of an unpacked chunk. Raises Damaged."""
    place, end = 0, len(data)
    while place < end:
        if end - place < _HEAD.size:
            raise Damaged(f"byte {at}: a chunk that ends within a record")
        opcode, length = _HEAD.unpack_from(data, place)
        place += _HEAD.size
        if opcode not in IN_CHUNKS or length > end - place:
            raise Damaged(f"byte {at}: a chunk with a record {opcode} of {length} bytes in it")
        yield opcode, data[place : place + length]
        place += length


class RecordedMessage(NamedTuple):
    """A message of a log: both times by the clock that its name says."""

    topic: str  # empty where none was told
    session: int  # of the sender; 0 where none was told
    stamp_ns: int  # by the sender's clock
    arrived_ns: int  # by the recorder's
    data: bytes


def recorded_messages(file: IO[bytes]) -> Iterator[RecordedMessage]:
    """Each message of a file, in order. Raises what `records` raises."""
    channels: dict[int, tuple[str, int]] = {}
    for opcode, body in records(file):
        if opcode == CHANNEL:
            number, topic = channel_topic(body)
            channels[number] = topic, session_of(channel_metadata(body)) or 0
        elif opcode == MESSAGE:
            number, _, arrived_ns, stamp_ns, data = message(body)
            yield RecordedMessage(*channels.get(number, ("", 0)), stamp_ns, arrived_ns, data)


def messages(file: IO[bytes]) -> Iterator[tuple[str, int, bytes]]:
    """Topic, publish time and payload of each message of a file, in order; the topic is empty where none was told. Raises
    what `records` raises."""
    return ((one.topic, one.stamp_ns, one.data) for one in recorded_messages(file))


def message(body: bytes) -> tuple[int, int, int, int, bytes]:
    """Channel, sequence number, log time, publish time and payload of a message. Raises Damaged."""
    try:
        channel, sequence, log_ns, stamp_ns = _MESSAGE.unpack_from(body)
    except struct.error as error:
        raise Damaged(f"a message of {len(body)} bytes: {error}") from None
    if max(log_ns, stamp_ns) > LATEST_NS:
        raise Damaged(f"a message of {max(log_ns, stamp_ns)} ns: no clock of ours shows that")
    return channel, sequence, log_ns, stamp_ns, body[_MESSAGE.size :]


def channel_topic(body: bytes) -> tuple[int, str]:
    """A channel's number and topic. Raises Damaged."""
    try:
        return _U16.unpack_from(body)[0], _text(body, 4)[0]
    except (struct.error, UnicodeDecodeError) as error:
        raise Damaged(f"a channel of {len(body)} bytes: {error}") from None


def channel_metadata(body: bytes) -> dict[str, str]:
    """The texts that a channel has beside its topic, by name. Raises Damaged."""
    texts = list[str]()
    try:
        place = _text(body, _text(body, 4)[1])[1] + 4  # behind the length of them all
        end = place + _U32.unpack_from(body, place - 4)[0]
        while place < end:
            text, place = _text(body, place)
            texts.append(text)
        return dict(zip(texts[::2], texts[1::2], strict=True))
    except (struct.error, UnicodeDecodeError, ValueError) as error:
        raise Damaged(f"a channel of {len(body)} bytes: {error}") from None


def session_of(metadata: Mapping[str, str]) -> int | None:
    """The session that a channel's metadata tell: 0 if they tell none, None if what they tell is none."""
    text = metadata.get(SESSION, "0")
    return int(text, 16) if re.fullmatch("[0-9a-fA-F]{1,16}", text) else None


def _text(data: bytes, place: int) -> tuple[str, int]:
    """A text with its length before it, and where it ends."""
    length = _U32.unpack_from(data, place)[0]
    end = place + 4 + length
    if end > len(data):
        raise struct.error(f"a text of {length} bytes")
    return data[place + 4 : end].decode(), end

"""Records of MCAP files at the edges of what they may be: each limit is allowed, and nothing beyond it."""

import io
import struct
import zlib

import pytest

from shoal.runtime import mcap_records
from shoal.runtime.mcap_records import (
    CHANNEL,
    CHUNK,
    DATA_END,
    FOOTER,
    LARGEST_BYTES,
    LATEST_NS,
    MAGIC,
    MESSAGE,
    METADATA,
    SCHEMA,
    UNPACKED_AT_LEAST,
    UNPACKED_TIMES,
    Allowance,
    Damaged,
    Packed,
    channel_topic,
    chunk,
    message,
    parts,
    read_head,
    unpacked,
)

EMPTY = struct.pack("<BQ", MESSAGE, 0)


def _record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def _message(channel: int, stamp_ns: int, payload: bytes = b"") -> bytes:
    return struct.pack("<HIQQ", channel, 1, 0, stamp_ns) + payload


def _channel(number: int, topic: bytes) -> bytes:
    return struct.pack("<HHI", number, 0, len(topic)) + topic + struct.pack("<II", 0, 0)  # no encoding, no metadata


def _packed(data: bytes, size: int, checksum: int = 0, packing: str = "") -> Packed:
    return Packed(0, 1, size, checksum, packing, data)


def _file(*records: bytes) -> io.BytesIO:
    return io.BytesIO(MAGIC + b"".join(records))


@pytest.mark.parametrize(
    ("data", "count"),
    [
        (b"", 0),
        (EMPTY, 1),
        (EMPTY[:-1], None),
        (EMPTY + EMPTY[:8], None),
        (_record(SCHEMA, b"a") + _record(CHANNEL, b"bc") + EMPTY, 3),
        (_record(MESSAGE, b"ab")[:-1], None),
        (_record(METADATA, b""), None),
        (_record(CHUNK, b""), None),
    ],
)
def test_a_chunk_holds_whole_records_of_three_kinds(data: bytes, count: int | None) -> None:
    if count is not None:
        assert b"".join(_record(*part) for part in parts(data, 0)) == data and len(list(parts(data, 0))) == count
    else:
        with pytest.raises(Damaged, match="byte 7: a chunk"):
            list(parts(data, 7))


def test_a_message_has_a_head_and_times_that_a_clock_can_show() -> None:
    assert message(_message(3, LATEST_NS, b"xy")) == (3, 1, 0, LATEST_NS, b"xy")
    for damaged in (_message(3, 5)[:-1], _message(3, LATEST_NS + 1), struct.pack("<HIQQ", 3, 1, LATEST_NS + 1, 0)):
        with pytest.raises(Damaged, match="a message of"):
            message(damaged)


def test_a_channel_has_its_whole_topic() -> None:
    assert channel_topic(_channel(9, b"pose")) == (9, "pose")
    for damaged in (_channel(9, b"pose")[:11], b"\0", _channel(9, b"\xff")):
        with pytest.raises(Damaged, match="a channel of"):
            channel_topic(damaged)


def test_a_chunk_has_all_bytes_that_it_says() -> None:
    body = struct.pack("<QQQII", 1, 2, 3, 4, 4) + b"zstd" + struct.pack("<Q", 5) + b"12345"
    assert chunk(body, 0) == Packed(1, 2, 3, 4, "zstd", b"12345")
    for damaged, why in ((body[:-1], "a chunk of 5 bytes"), (body[:30], "no chunk"), (body[:36], "no chunk")):
        with pytest.raises(Damaged, match=f"byte 7: {why}"):
            chunk(damaged, 7)


@pytest.mark.parametrize(
    ("packed", "why"),
    [
        (_packed(b"abc", 3), None),
        (_packed(b"abc", 3, zlib.crc32(b"abc")), None),
        (_packed(b"abc", 2), "does not unpack to the 2 bytes"),
        (_packed(b"abc", 4), "does not unpack to the 4 bytes"),
        (_packed(b"abc", 3, 1), "checksum is wrong"),
        (_packed(b"abc", 3, 0, "zstd"), "cannot be unpacked"),
        (_packed(b"abc", 3, 0, "rar"), r"packed with 'rar' \(allowed: zstd, lz4, none\)"),
    ],
)
def test_a_chunk_unpacks_to_what_it_says(packed: Packed, why: str | None) -> None:
    if why is None:
        assert unpacked(packed, Allowance(0), 7) == b"abc"
    else:
        with pytest.raises(Damaged, match=f"byte 7: .*{why}"):
            unpacked(packed, Allowance(0), 7)


def test_the_chunks_of_a_file_unpack_to_a_multiple_of_it_together() -> None:
    most, file_bytes = UNPACKED_AT_LEAST + UNPACKED_TIMES * 1000, 1000
    allowed = Allowance(file_bytes)
    allowed.take(most - 10, 0)
    allowed.take(10, 0)
    with pytest.raises(Damaged, match=r"byte 7: chunks of more than 64 times the file's 1000 bytes"):
        allowed.take(1, 7)
    Allowance(LARGEST_BYTES).take(LARGEST_BYTES, 0)
    with pytest.raises(Damaged, match="byte 7: a chunk of"):
        Allowance(LARGEST_BYTES).take(LARGEST_BYTES + 1, 7)


def test_a_record_is_no_longer_than_what_is_left_of_the_file() -> None:
    data = _record(MESSAGE, b"abc")
    assert read_head(io.BytesIO(data), 7, 10) == (MESSAGE, 3)
    for damaged, left, why in ((data, 9, "a record of 3 bytes"), (data[:8], 99, "ends without"), (bytes(9), 99, "no record")):
        with pytest.raises(Damaged, match=f"byte 7: .*{why}"):
            read_head(io.BytesIO(damaged), 7, left)


def test_messages_have_the_topic_of_their_channel_and_none_without_one() -> None:
    records = (
        _record(MESSAGE, _message(1, 10, b"a")), _record(CHANNEL, _channel(1, b"one")), _record(CHANNEL, _channel(2, b"two")),
        _record(MESSAGE, _message(2, 20, b"b")), _record(MESSAGE, _message(1, 30)), _record(FOOTER, b""), b"behind the end",
    )  # fmt: skip
    assert list(mcap_records.messages(_file(*records))) == [("", 10, b"a"), ("two", 20, b"b"), ("one", 30, b"")]


def test_a_files_own_checksum_counts_every_record_before_it() -> None:
    records = (_record(METADATA, b"a"), _record(METADATA, b"b"))
    right = zlib.crc32(MAGIC + b"".join(records))
    for checksum, whole in ((right, True), (0, True), (right ^ 1, False)):
        file = _file(*records, _record(DATA_END, struct.pack("<I", checksum)), _record(FOOTER, b""))
        skipped: list[str] = []
        assert [opcode for opcode, _ in mcap_records.records(file, skipped)] == [METADATA, METADATA, DATA_END, FOOTER]
        assert bool(skipped) is not whole
        if not whole:
            with pytest.raises(Damaged, match="checksum"):
                list(mcap_records.records(file))

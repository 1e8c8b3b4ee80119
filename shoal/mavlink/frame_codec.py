"""Single MAVLink 2 frames <-> pymavlink's messages, sans-IO: the bytes and fields that pymavlink itself gives, in less time.

pymavlink copies a frame several times and sorts its fields in a loop, which costs more than all else that is done with it.
Messages with text or arrays, which are rare, are left to it.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from operator import attrgetter
from typing import Any

from pymavlink.dialects.v20 import common as dialect

MARKER = 0xFD
HEADER_BYTES, CHECKSUM_BYTES = 10, 2

Peer = tuple[int, int]  # MAVLink system and component

# An environment variable can switch pymavlink's checksums off. Not for thrusters.
dialect.MAVLINK_IGNORE_CRC = 0

_HEADER = struct.Struct("<BBBBBBBHB")  # marker, length, flags twice, sequence, system, component, kind: low 16 bits, high 8
_reader = dialect.MAVLink(None)


@dataclass(frozen=True)
class Layout:
    """A kind of message whose fields are single numbers."""

    kind: Any  # pymavlink's class
    number: int
    payload: struct.Struct
    fields: tuple[str, ...]  # as they lie in the payload
    values: Callable[[Any], tuple[Any, ...]]
    crc_extra: bytes
    common: dict[str, Any]  # what every message of this kind has


@cache
def _layout(number: int) -> Layout | None:
    """The layout of a kind of message; None if it has other fields than single numbers."""
    kind = dialect.mavlink_map[number]
    fields = tuple(kind.ordered_fieldnames)
    if "s" in kind.unpacker.format or any(kind.array_lengths) or len(fields) < 2:
        return None
    common = {
        "_payload": None, "_signed": False, "_link_id": None, "_instances": None, "_type": kind.msgname,
        "_fieldnames": kind.fieldnames, "_instance_field": kind.instance_field, "_instance_offset": kind.instance_offset,
    }  # fmt: skip
    return Layout(kind, number, kind.unpacker, fields, attrgetter(*fields), bytes([kind.crc_extra]), common)


def checksum(covered: bytes, crc_extra: bytes) -> bytes:
    """The two bytes behind a frame, from those between marker and checksum."""
    crc: int = dialect.x25crc(covered + crc_extra).crc
    return crc.to_bytes(CHECKSUM_BYTES, "little")


def pack(message: Any, peer: Peer, sequence: int, flags: int = 0) -> bytes:
    """The frame of a message, up to its checksum. Raises struct.error for a value that its field cannot hold."""
    number = type(message).id  # some have a field of this name
    layout = _layout(number)
    if layout is None:
        writer = dialect.MAVLink(None, *peer)
        writer.seq = sequence
        frame: bytes = message.pack(writer)
        payload, crc_extra = frame[HEADER_BYTES:-CHECKSUM_BYTES], bytes([message.crc_extra])
    else:
        whole = layout.payload.pack(*layout.values(message))
        payload, crc_extra = whole.rstrip(b"\0") or whole[:1], layout.crc_extra
    head = _HEADER.pack(MARKER, len(payload), flags, 0, sequence, *peer, number & 0xFFFF, number >> 16)
    return head + payload + checksum(head[1:] + payload, crc_extra)


def unpack(frame: bytes) -> Any:
    """The message of a whole frame of a kind that the dialect has, whose length is that of its header; None if its checksum is
    wrong. A signature is not looked at."""
    _, size, flags, more_flags, sequence, system, component, low, high = _HEADER.unpack_from(frame)
    end = HEADER_BYTES + size
    layout = _layout(low | high << 16)
    if layout is None:
        try:
            return _reader.decode(bytearray(frame))
        except dialect.MAVError:
            return None
    sent_checksum = frame[end : end + CHECKSUM_BYTES]
    if checksum(frame[1:end], layout.crc_extra) != sent_checksum:
        return None
    whole = layout.payload.size
    values = layout.payload.unpack(frame[HEADER_BYTES:end].ljust(whole, b"\0")[:whole])
    message = object.__new__(layout.kind)
    message.__dict__.update(layout.common)
    message.__dict__.update(zip(layout.fields, values, strict=True))
    message._msgbuf, message._crc = frame, int.from_bytes(sent_checksum, "little")
    message._header = dialect.MAVLink_header(layout.number, flags, more_flags, size, sequence, system, component)
    return message

"""Messages through a pipe, for a program that hands a whole run to another without a network: `sim-bridge numeric` flies,
`groundstation log record` writes the log; `groundstation log rerun` reads one, `robot-agent rerun` does its steps again. Both
ends belong to one installation, so a topic is told by its row in the table.
"""

import struct
from collections.abc import Iterator
from typing import IO

from shoal.messages.codec import MAX_MESSAGE_BYTES, DecodeError, Header, encode
from shoal.messages.messages import Message
from shoal.messages.topics import TOPICS, Topic

_FRAME = struct.Struct("<BBI")  # row of the topic, robot (0: none), bytes of the payload; then header and payload
_HEADER_BYTES = len(Header(0, 0, 0).encode())
_PEER = "pipe"


class PipeWriter:
    """The sending end: numbers and encodes messages like shoal/bus/bus.py."""

    def __init__(self, stream: IO[bytes], session: int) -> None:
        self._stream, self._session = stream, session
        self._sequences: dict[str, int] = {}

    def publish(self, topic: Topic, message: Message, stamp_ns: int, robot: int | None = None) -> None:
        """Send a message about the instant `stamp_ns`."""
        key = topic.key(robot)
        sequence = self._sequences[key] = self._sequences.get(key, 0) + 1
        write_raw(self._stream, topic, robot or 0, Header(self._session, sequence, stamp_ns), encode(message, stamp_ns))


def write_raw(stream: IO[bytes], topic: Topic, robot: int, header: Header, payload: bytes) -> None:
    """Send a message as it was on the wire; robot 0: it has none."""
    stream.write(_FRAME.pack(TOPICS.index(topic), robot, len(payload)) + header.encode() + payload)


def read_pipe(stream: IO[bytes]) -> Iterator[tuple[Topic, int | None, Header, bytes]]:
    """Topic, robot, header and payload of every message until the pipe ends. Raises DecodeError for what is no message,
    or half of one."""
    while frame := stream.read(_FRAME.size):
        if len(frame) < _FRAME.size:
            raise DecodeError(_PEER, "unknown", "frame", f"ends after {len(frame)} of {_FRAME.size} bytes")
        row, robot, size = _FRAME.unpack(frame)
        if row >= len(TOPICS) or size > MAX_MESSAGE_BYTES:
            raise DecodeError(_PEER, "unknown", "frame", f"topic {row}, {size} bytes: not written by this version")
        topic = TOPICS[row]
        body = stream.read(_HEADER_BYTES + size)
        if len(body) < _HEADER_BYTES + size:
            raise DecodeError(_PEER, topic.name, "payload", f"ends after {len(body)} of {_HEADER_BYTES + size} bytes")
        header = Header.decode(body[:_HEADER_BYTES], _PEER, topic.name)
        yield topic, robot or None, header, body[_HEADER_BYTES:]

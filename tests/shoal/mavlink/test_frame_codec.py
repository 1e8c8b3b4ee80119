"""Frames against pymavlink's own packing and decoding, for every kind of message of the dialect."""

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as dialect

from shoal.mavlink import frame_codec
from shoal.mavlink.signing import SIGNED

KINDS = sorted(dialect.mavlink_map)
BYTES = st.integers(0, 255)


def framed(number: int, payload: bytes, sequence: int, peer: tuple[int, int], flags: int = 0) -> bytes:
    """A frame, put together by hand."""
    head = struct.pack("<BBBBBB", len(payload), flags, 0, sequence, *peer) + number.to_bytes(3, "little")
    checksum: int = dialect.x25crc(head + payload + bytes([dialect.mavlink_map[number].crc_extra])).crc
    return b"\xfd" + head + payload + checksum.to_bytes(2, "little")


@given(st.data())
@settings(max_examples=400)
def test_frames_and_fields_are_those_of_pymavlink(data: st.DataObject) -> None:
    """Any payload, also shortened, or with what a newer dialect has appended, from any peer."""
    number = data.draw(st.sampled_from(KINDS))
    whole = dialect.mavlink_map[number].unpacker.size
    payload = data.draw(
        st.one_of(st.binary(min_size=whole, max_size=whole), st.binary(min_size=1, max_size=min(whole + 32, 255)))
    )
    sequence, peer = data.draw(BYTES), (data.draw(BYTES), data.draw(BYTES))
    frame = framed(number, payload, sequence, peer)
    theirs, ours = dialect.MAVLink(None).decode(bytearray(frame)), frame_codec.unpack(frame)
    assert type(ours) is type(theirs) and ours.get_type() == theirs.get_type()
    assert repr(ours.to_dict()) == repr(theirs.to_dict())  # NaN is not equal to itself
    assert vars(ours.get_header()) == vars(theirs.get_header())
    assert (ours.get_crc(), ours.get_signed()) == (theirs.get_crc(), theirs.get_signed())
    sender = dialect.MAVLink(None, *peer)
    sender.seq = sequence
    packed = theirs.pack(sender)
    assert frame_codec.pack(theirs, peer, sequence) == packed == frame_codec.pack(ours, peer, sequence)
    assert (
        frame_codec.unpack(framed(number, payload, sequence, peer, SIGNED) + bytes(13)).to_dict().keys()
        == theirs.to_dict().keys()
    )


@given(st.data())
def test_no_damaged_frame_is_read(data: st.DataObject) -> None:
    """One byte between marker and checksum, or of the checksum, is another; length and kind of the header stay."""
    number = data.draw(st.sampled_from(KINDS))
    frame = framed(number, data.draw(st.binary(min_size=1, max_size=dialect.mavlink_map[number].unpacker.size)), 7, (1, 191))
    place = data.draw(st.sampled_from([*range(4, 7), *range(10, len(frame))]))
    damage = data.draw(st.integers(1, 255))
    assert frame_codec.unpack(frame[:place] + bytes([frame[place] ^ damage]) + frame[place + 1 :]) is None


@pytest.mark.parametrize("heading", ["north", None, 1e40])
def test_a_value_that_does_not_fit_is_refused(heading: object) -> None:
    message = dialect.MAVLink_attitude_message(1, 0.0, 0.0, heading, 0.0, 0.0, 0.0)
    with pytest.raises((struct.error, OverflowError)):
        frame_codec.pack(message, (1, 1), 0)
    with pytest.raises((struct.error, OverflowError)):
        message.pack(dialect.MAVLink(None))

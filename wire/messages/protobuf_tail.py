"""The last field of a protobuf message, put on and taken off as it is: of a picture protobuf makes two or three copies. Pure.

The wire form is protobuf's own: a field's number and kind, then for bytes their count and the bytes.
"""

BYTES = 2  # kind of a field that is told with its length
SIZES = {1: 8, 5: 4}  # bytes of the kinds that have a fixed length
FIELDS, VARINT_BYTES = 32, 10  # at most: whatever is sent, looking for the tail takes no time


def joined(head: bytes, number: int, tail: memoryview) -> bytes:
    """A message whose other fields are `head`, with field `number` after them."""
    return b"".join((head, _varint(number << 3 | BYTES), _varint(tail.nbytes), tail))


def parted(message: bytes, number: int) -> tuple[bytes, memoryview] | None:
    """The fields before field `number`, and its bytes; None unless the first such field is soon found, and is the last of
    all."""
    try:
        at = 0
        for _ in range(FIELDS):
            begin, (key, at) = at, _read_varint(message, at)
            if key >> 3 == number and key & 7 == BYTES:
                size, at = _read_varint(message, at)
                return (message[:begin], memoryview(message)[at:]) if at + size == len(message) else None
            at = _behind(message, at, key & 7)
    except (IndexError, KeyError):  # cut off, or of a kind that protobuf may know
        return None
    return None


def _behind(message: bytes, at: int, kind: int) -> int:
    """Where the field ends whose value begins at `at`."""
    if kind == BYTES:
        size, at = _read_varint(message, at)
        return at + size
    return _read_varint(message, at)[1] if kind == 0 else at + SIZES[kind]


def _varint(value: int) -> bytes:
    """Protobuf's base-128 form of a number that is not negative."""
    low, rest = value & 0x7F, value >> 7
    return bytes((low | 0x80,)) + _varint(rest) if rest else bytes((low,))


def _read_varint(message: bytes, at: int) -> tuple[int, int]:
    """The number at `at`, and where it ends."""
    value = 0
    for i in range(VARINT_BYTES):
        value |= (message[at + i] & 0x7F) << 7 * i
        if message[at + i] < 0x80:
            return value, at + i + 1
    raise IndexError("a number without end")

"""bytes <-> frozen dataclass. Decoding checks everything: a message that gets through is finite, sized and typed.

Our own messages have protobuf classes built from them (schema.py), with the same fields; some messages travel as foxglove.*
schemas so that logs open in the usual viewers. A `Header` travels beside every message.
"""

import dataclasses
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from typing import Any, TypeVar, cast, get_args, get_origin, get_type_hints

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.descriptor import Descriptor
from google.protobuf.message import DecodeError as ProtobufError

from shoal.messages.messages import Command, CommandTaken, Event, Frame, Message, Picture, Preview, Trajectory, Video
from shoal.messages.schema import may_be_absent, message_classes, nested_message, present_type

MAX_FRAME_BYTES = 64 * 1024 * 1024
MAX_MESSAGE_BYTES = 4 * 1024 * 1024  # half an hour of trajectory at 20 Hz; anything larger is no message of ours
MAX_SMALL_BYTES = 64 * 1024  # without path or picture: a plan of 200 nodes has 13 kB, 290 obstacles fill it
WRENCH_AXES = (3, 4)  # numbers of a wrench, without and with sway
MAX_EVENT_BYTES = 16 * 1024  # of a line of the log: LONGEST_LINE characters, their source and more
LONGEST_LINE = 1000  # characters of a line of the log; the rest is cut off
LONGEST_TEXT = 8000  # characters of any other text, for example every reason that keeps fifty robots from arming
SHARED = "shared_memory"  # encoding of a picture whose pixels are in a ring of frames (shoal/bus/frame_ring.py)
_SHORT = 32  # numbers
# Of a header's times: 36 years. Sums and differences of a few of them, and of our clock, stay within the 64 bits that instants
# have on the wire: one robot's wild stamp must not end those that record when its plan was made.
FARTHEST_NS = 1 << 60
LATEST_NS = 4 * FARTHEST_NS  # of a stamp: the year 2116
LARGEST = 1e12  # no quantity in any message comes near it; squares of it are still finite

M = TypeVar("M")


class DecodeError(Exception):
    """Bytes that are no valid message. Says which peer, topic and field."""

    def __init__(self, peer: str, topic: str, field: str, reason: str) -> None:
        super().__init__(f"from {peer}, topic {topic}, field {field}: {reason}")
        self.peer, self.topic, self.field, self.reason = peer, topic, field, reason


@dataclass(frozen=True)
class Header:
    """The header that travels beside every message.

    `stamp_ns` is the instant the content is about, on the sender's clock (for logs, and for ages in lockstep);
    `age_ns` is how long before publishing that was, by the sender's monotonic clock.
    """

    session: int  # drawn when the sender's process starts: a restart is a new session
    sequence: int  # 1, 2, 3 ... per topic and session
    stamp_ns: int
    age_ns: int = 0

    _LAYOUT = struct.Struct("<QIqq")

    def encode(self) -> bytes:
        """28 bytes, little-endian: session u64, sequence u32, stamp i64, age i64."""
        return self._LAYOUT.pack(self.session, self.sequence, self.stamp_ns, self.age_ns)

    @classmethod
    def decode(cls, data: bytes, peer: str, topic: str) -> "Header":
        """Raises DecodeError for a wrong size, and for times that no clock of ours shows."""
        if len(data) != cls._LAYOUT.size:
            raise DecodeError(peer, topic, "header", f"{len(data)} bytes, must be {cls._LAYOUT.size}")
        header = cls(*cls._LAYOUT.unpack(data))
        for name, low, value, high in (
            ("age_ns", 0, header.age_ns, FARTHEST_NS),
            ("stamp_ns", -FARTHEST_NS, header.stamp_ns, LATEST_NS),
        ):
            if not low <= value <= high:
                raise DecodeError(peer, topic, f"header.{name}", f"{value} is not allowed (allowed: {low} to {high})")
        return header


# --- our own messages: dataclass fields and protobuf fields have the same names


class _Invalid(Exception):
    """A field's value is not acceptable; the caller adds peer and topic."""

    def __init__(self, field: str, reason: str) -> None:
        super().__init__(f"{field}: {reason}")
        self.field, self.reason = field, reason


@cache
def _fields(cls: Any) -> tuple[tuple[str, Callable[[Any, str], Any], type | None, bool], ...]:
    """Per field of a message: its name, the checked conversion from the protobuf value, the message class that it holds, and
    whether that may be absent."""
    hints = get_type_hints(cls)
    return tuple(
        (f.name, _reader(hints[f.name], f.metadata), nested, may_be_absent(hints[f.name]))
        for f in dataclasses.fields(cls)
        for nested in (nested_message(hints[f.name]),)
    )


@cache
def _row_arrays(cls: Any) -> tuple[str, ...]:
    """Names of the arrays of any number of rows, the same for all of a message."""
    return tuple(f.name for f in dataclasses.fields(cls) if -1 in f.metadata.get("shape", ()))


@cache
def _wrenches(cls: Any) -> tuple[str, ...]:
    """Names of the wrenches, which have 3 or 4 numbers each."""
    return tuple(f.name for f in dataclasses.fields(cls) if f.metadata.get("wrench"))


@cache
def _row_numbers(cls: Any) -> tuple[str, ...]:
    """Names of the integers that say whose each row of the arrays is."""
    return tuple(f.name for f in dataclasses.fields(cls) if f.metadata.get("each_row"))


def _reader(hint: Any, metadata: Any) -> Callable[[Any, str], Any]:
    """The function that reads and checks a field of such a type from protobuf."""
    if metadata.get("wrench"):
        return _array_reader((-1,))  # `_shape_wrenches` gives it its rows
    if "shape" in metadata:
        return _array_reader(metadata["shape"])
    if present_type(hint) is float:
        return _read_positive if metadata.get("positive") else _read_float
    if isinstance(hint, type) and issubclass(hint, IntEnum):
        return lambda value, name: _read_enum(value, name, hint)
    if hint is str:
        return _read_text
    if get_origin(hint) is tuple:
        return lambda value, name: tuple(value)
    nested = nested_message(hint)
    if nested is not None:
        return lambda value, name: _from_protobuf(nested, value, f"{name}.")
    return lambda value, name: value


def _read_float(value: float, name: str) -> float:
    if not -LARGEST <= value <= LARGEST:  # true for NaN too
        raise _Invalid(name, f"{value} is not a finite number below {LARGEST:g}")
    return value


def _read_positive(value: float, name: str) -> float:
    if _read_float(value, name) <= 0.0:
        raise _Invalid(name, f"{value} is not more than 0")
    return value


def _read_text(value: str, name: str) -> str:
    if len(value) > LONGEST_TEXT:
        raise _Invalid(name, f"{len(value)} characters, more than the allowed {LONGEST_TEXT}")
    return value


def _cut(text: str, longest: int) -> str:
    """A text as it can be sent and shown: shortened where it is too long, and bytes of a file's name that are no text escaped,
    as a log shows them."""
    shown = text if text.isascii() else text.encode("utf-8", errors="backslashreplace").decode()
    return shown if len(shown) <= longest else shown[: longest - 1] + "…"


def _read_enum(value: int, name: str, enum: type[IntEnum]) -> IntEnum:
    """The member of an enum with this value. Raises _Invalid with the allowed ones."""
    try:
        return enum(value)
    except ValueError:
        allowed = ", ".join(f"{member.value} {member.name}" for member in enum)
        raise _Invalid(name, f"{value} is not allowed (allowed: {allowed})") from None


def _array_reader(shape: tuple[int, ...]) -> Callable[[Any, str], Any]:
    """Function that checks a repeated field's numbers and gives them a shape, in which -1 stands for any length."""
    has_any_length = -1 in shape
    row_size = math.prod(n for n in shape if n != -1)  # of the whole shape if no length is open

    def read(value: Any, name: str) -> Any:
        if len(value) > _SHORT:
            array = np.array(value, dtype=np.float64)
            is_valid = bool(np.abs(array).max() <= LARGEST)  # false for NaN
        else:  # of a few numbers lists are faster
            numbers = value[:]
            array = np.array(numbers, dtype=np.float64)
            is_valid = sum(map(abs, numbers)) <= LARGEST or bool(np.abs(array).max() <= LARGEST)
        if not is_valid:
            raise _Invalid(name, f"holds a value that is not a finite number below {LARGEST:g}")
        fits = array.size % row_size == 0 if has_any_length else array.size == row_size
        if not fits:
            raise _Invalid(name, f"{array.size} values do not fill the shape {shape}")
        return array.reshape(shape)

    return read


def _from_protobuf(cls: type[M], message: Any, prefix: str = "") -> M:
    """Build a dataclass from its protobuf message. Raises _Invalid for a field that breaks its rules."""
    values: dict[str, Any] = {}
    for name, read, nested, optional in _fields(cast(Any, cls)):
        absent = (optional or nested is not None) and not message.HasField(name)
        if absent and not optional:
            raise _Invalid(prefix + name, "is missing")
        values[name] = getattr(cls, name) if absent else read(getattr(message, name), prefix + name)
    first, *others = _row_arrays(cast(Any, cls)) or ("",)
    if wrenches := _wrenches(cast(Any, cls)):
        in_rows = not set(wrenches).isdisjoint((first, *others))  # one for each row of the message's arrays, or one in all
        _shape_wrenches(values, wrenches, len(values[first]) if in_rows else None, prefix)
    for name in others:
        if len(values[name]) != len(values[first]):
            raise _Invalid(prefix + name, f"{len(values[name])} rows, but {first} has {len(values[first])}")
    for name in _row_numbers(cast(Any, cls)):
        if len(values[name]) != len(values[first]):
            raise _Invalid(prefix + name, f"{len(values[name])} numbers for {len(values[first])} rows of {first}")
    built = object.__new__(cls)
    built.__dict__.update(values)  # what cls(**values) does, but for a frozen class that sets one field after the other
    return built


def _shape_wrenches(values: dict[str, Any], names: tuple[str, ...], rows: int | None, prefix: str) -> None:
    """Give the wrenches of a message, flat arrays of numbers, their shape: 3 or 4 numbers each, the same for all; in `rows`
    rows, or one wrench alone for None."""
    fitting: tuple[int, ...] = WRENCH_AXES
    for name in names:
        size = values[name].size
        fitting = tuple(axes for axes in fitting if size == axes * (1 if rows is None else rows))
        if not fitting:
            per = "" if rows is None else f" for {rows} rows"
            raise _Invalid(
                prefix + name, f"{size} values{per} do not fill the shape of a wrench (3 each, or 4 with sway, all alike)"
            )
        if rows is not None:
            values[name] = values[name].reshape(rows, fitting[0])


def _to_protobuf(message: Any, cls: Any, target: Any) -> Any:
    """Fill in the protobuf message `target` with the fields of message class `cls`: those that a subclass adds stay here."""
    for name, _, nested, _ in _fields(cls):
        value = getattr(message, name)
        kind = type(value)
        if kind is float or kind is int:
            setattr(target, name, value)
        elif kind is str:
            if value:  # the default is not sent
                setattr(target, name, _cut(value, LONGEST_TEXT))
        elif isinstance(value, np.ndarray):
            getattr(target, name).extend(value.ravel().tolist())
        elif isinstance(value, tuple):
            texts = value and type(value[0]) is str
            getattr(target, name).extend([_cut(text, LONGEST_TEXT) for text in value] if texts else value)
        elif value is None:
            pass  # absent
        elif nested is None:
            setattr(target, name, value)
        else:
            _to_protobuf(value, nested, getattr(target, name))
    return target


# --- the pixels of a raw picture: put behind the other fields, and found there, without protobuf, which copies them three
#     times and twice: for 1280 x 960 pixels 0.05 ms instead of 2.7 ms to write, and 0.005 ms instead of 1 ms to read

_BYTES = 2  # protobuf's wire type of a field that states its length
_FIXED = {1: 8, 5: 4}  # bytes of the fields of its other wire types, but for 0, a varint
_LONGEST_VARINT = 10  # bytes
_MOST_FIELDS = 16  # that are looked through: a picture has seven


def _append_field(head: bytes, number: int, tail: memoryview) -> bytes:
    """A protobuf message: the encoded fields `head`, then field `number` with the bytes `tail`."""
    return b"".join((head, _varint(number << 3 | _BYTES), _varint(tail.nbytes), tail))


def _varint(value: int) -> bytes:
    """Protobuf's base-128 form of a number that is not negative."""
    low, rest = value & 0x7F, value >> 7
    return bytes((low | 0x80,)) + _varint(rest) if rest else bytes((low,))


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    """The number that begins at a place of `data`, and the place behind it. Raises IndexError where `data` ends before it."""
    number = 0
    for i in range(_LONGEST_VARINT):
        number |= (data[at + i] & 0x7F) << 7 * i
        if data[at + i] < 0x80:
            return number, at + i + 1
    raise IndexError("no varint")


def _split_last_field(data: bytes, number: int) -> tuple[bytes, memoryview | None]:
    """The inverse of `_append_field`: the other fields, and the bytes of field `number`, not copied. All of `data` and None
    where the last field is another."""
    at = 0
    try:
        for _ in range(_MOST_FIELDS):
            begin = at
            key, at = _read_varint(data, at)
            if key & 7 in _FIXED:
                at += _FIXED[key & 7]
                continue
            size, at = _read_varint(data, at)
            if key & 7 == _BYTES:
                at += size
                if key >> 3 == number and at == len(data):
                    return data[:begin], memoryview(data)[at - size :]
            elif key & 7 != 0:
                break
    except IndexError:
        pass
    return data, None


# --- messages that travel as foxglove schemas


def _stamp(target: Any, stamp_ns: int) -> None:
    target.timestamp.seconds, target.timestamp.nanos = divmod(stamp_ns, 1_000_000_000)


def encode_frame(shape: tuple[int, ...], encoding: str, data: memoryview | bytes, stamp_ns: int) -> bytes:
    """A foxglove.RawImage of `shape` (height, width)."""
    height, width = shape
    image = RawImage(frame_id="camera", width=width, height=height, step=width, encoding=encoding)
    _stamp(image, stamp_ns)
    return _append_field(image.SerializeToString(), RawImage.DATA_FIELD_NUMBER, memoryview(data))


def _encode_pixels(frame: Frame, stamp_ns: int) -> bytes:
    return encode_frame(frame.pixels.shape, "bayer_rggb8", np.ascontiguousarray(frame.pixels).data.cast("B"), stamp_ns)


def _frame_from_protobuf(image: Any, pixels: memoryview | None = None) -> Frame:
    """Check a foxglove.RawImage, and make a frame (height, width) uint8 of it without a copy. `pixels`: its data, where they
    were split off before the image was parsed."""
    data = image.data if pixels is None else pixels
    if image.encoding == SHARED:
        raise _Invalid("encoding", "the pixels are in memory that `sim-bridge sil` shares with its own localizer alone")
    if image.encoding != "bayer_rggb8":
        raise _Invalid("encoding", f"{image.encoding[:20]!r} is not allowed (allowed: bayer_rggb8)")
    if not (0 < image.width <= 16384 and 0 < image.height <= 16384 and image.step == image.width):
        raise _Invalid("step", f"{image.width} x {image.height} with step {image.step} is no packed picture")
    if len(data) != image.step * image.height:
        raise _Invalid("data", f"{len(data)} bytes, must be {image.step * image.height}")
    return Frame(np.frombuffer(data, np.uint8).reshape(image.height, image.width))


def _image(cls: Any, schema: Any, form: str) -> tuple[Any, Callable[[Any, int], bytes], Callable[[Any], Any]]:
    """The carrier of messages that hold one compressed image. Their one field is named after its format."""

    def encode_image(picture: Any, stamp_ns: int) -> bytes:
        image = schema(frame_id="camera", format=form, data=getattr(picture, form))
        _stamp(image, stamp_ns)
        return bytes(image.SerializeToString())

    def from_protobuf(image: Any) -> Any:
        if image.format != form:
            raise _Invalid("format", f"{image.format[:20]!r} is not allowed (allowed: {form})")
        return cls(bytes(image.data))

    return schema, encode_image, from_protobuf


def _encode_event(event: Event, stamp_ns: int) -> bytes:
    log = Log(name=_cut(event.source, LONGEST_LINE), message=_cut(event.message, LONGEST_LINE))
    log.level = cast(Log.Level.ValueType, event.level)
    _stamp(log, stamp_ns)
    return log.SerializeToString()


def _event_from_protobuf(log: Any) -> Event:
    if not 1 <= log.level <= 5:
        raise _Invalid("level", f"{log.level} is not allowed (allowed: 1 to 5)")
    return Event(log.level, _cut(log.name, LONGEST_LINE), _cut(log.message, LONGEST_LINE))


_FOXGLOVE: dict[type, tuple[Any, Callable[[Any, int], bytes], Callable[[Any], Any]]] = {
    Frame: (RawImage, _encode_pixels, _frame_from_protobuf),
    Preview: _image(Preview, CompressedImage, "jpeg"),
    Picture: _image(Picture, CompressedImage, "jpeg"),
    Video: _image(Video, CompressedVideo, "h264"),
    Event: (Log, _encode_event, _event_from_protobuf),
}


# --- the two directions


OWN: tuple[type, ...] = tuple(cls for cls in get_args(Message) if cls not in _FOXGLOVE)
_CLASSES = message_classes("fleet", OWN)


def protobuf_class(cls: type) -> Any:
    """The protobuf class of messages of dataclass `cls`."""
    return _FOXGLOVE[cls][0] if cls in _FOXGLOVE else _CLASSES[cls]


def descriptor(cls: type) -> Descriptor:
    """Protobuf descriptor of a message class, for the log's schemas."""
    protobuf_descriptor: Descriptor = protobuf_class(cls).DESCRIPTOR
    return protobuf_descriptor


def encode(message: Message, stamp_ns: int = 0) -> bytes:
    """The wire form of a message. `stamp_ns` goes into schemas that carry a time of their own."""
    if type(message) in _FOXGLOVE:
        return _FOXGLOVE[type(message)][1](message, stamp_ns)
    encoded: bytes = _to_protobuf(message, type(message), protobuf_class(type(message))()).SerializeToString()
    return encoded


_LARGE = {Trajectory, Command, CommandTaken, Preview, Picture, Video}  # with a path, or compressed pictures


def max_bytes(cls: type) -> int:
    """The most bytes that a message of a class may have: what any member can send must not fill another's memory."""
    if cls in (Frame, Event):
        return MAX_FRAME_BYTES if cls is Frame else MAX_EVENT_BYTES
    return MAX_MESSAGE_BYTES if cls in _LARGE else MAX_SMALL_BYTES


def decode(cls: type[M], data: bytes, peer: str, topic: str) -> M:
    """A checked message of class `cls` from its wire form. Raises DecodeError, and nothing else, for any bytes."""
    limit = max_bytes(cls)
    if len(data) > limit:
        raise DecodeError(peer, topic, "(size)", f"{len(data)} bytes, more than the allowed {limit}")
    pixels = None
    if cls is Frame:
        data, pixels = _split_last_field(data, RawImage.DATA_FIELD_NUMBER)
    message = protobuf_class(cls)()
    try:
        message.ParseFromString(data)
    except (ProtobufError, UnicodeDecodeError) as error:
        raise DecodeError(peer, topic, "(all)", f"no valid {message.DESCRIPTOR.full_name}: {error}") from None
    try:
        if cls is Frame:
            return cast(M, _frame_from_protobuf(message, pixels))
        content: M = _FOXGLOVE[cls][2](message) if cls in _FOXGLOVE else _from_protobuf(cls, message)
        return content
    except _Invalid as error:
        raise DecodeError(peer, topic, error.field, error.reason) from None

"""Hypothesis strategies for every message, read off the dataclasses and the limits of their protobuf fields."""

import dataclasses
import enum
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from shoal.messages import codec
from shoal.messages.messages import Event, Frame, Message, Picture, Preview, Video
from shoal.messages.schema import may_be_absent, nested_message, present_type

CLASSES: tuple[type, ...] = get_args(Message)
FOREIGN = (Frame, Preview, Video, Picture, Event)
OWN = tuple(cls for cls in CLASSES if cls not in FOREIGN)  # the others have schemas of their own

_LIMITS = {
    FieldDescriptor.TYPE_INT64: (-(2**63), 2**63 - 1),
    FieldDescriptor.TYPE_UINT64: (0, 2**64 - 1),
    FieldDescriptor.TYPE_UINT32: (0, 2**32 - 1),
}

floats = st.floats(-codec.LARGEST, codec.LARGEST)


def _field(hint: Any, field: dataclasses.Field[Any], kind: int, rows: int) -> st.SearchStrategy[Any]:
    if "shape" in field.metadata:
        shape = tuple(rows if n == -1 else n for n in field.metadata["shape"])
        return arrays(np.float64, shape, elements=floats)
    if field.metadata.get("positive"):
        return st.floats(0.0, codec.LARGEST, exclude_min=True)
    nested = nested_message(hint)
    if nested is not None:
        return valid(nested) | st.none() if may_be_absent(hint) else valid(nested)
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        return st.sampled_from(hint)
    simple: dict[Any, st.SearchStrategy[Any]] = {float: floats, bool: st.booleans(), str: st.text()}
    if present_type(hint) in simple:
        return simple[present_type(hint)] | (st.none() if may_be_absent(hint) else st.nothing())
    if get_args(hint)[:1] == (str,):
        return st.lists(st.text(), max_size=8).map(tuple)
    integers = st.integers(*_LIMITS[kind])
    if field.metadata.get("each_row"):
        return st.lists(integers, min_size=rows, max_size=rows).map(tuple)
    return st.lists(integers, max_size=8).map(tuple) if get_origin(hint) is tuple else integers


@st.composite
def _own(draw: st.DrawFn, cls: Any) -> Any:
    hints, fields = get_type_hints(cls), codec.descriptor(cls).fields_by_name
    rows = draw(st.integers(0, 3))
    return cls(**{f.name: draw(_field(hints[f.name], f, fields[f.name].type, rows)) for f in dataclasses.fields(cls)})


def valid(cls: type) -> st.SearchStrategy[Any]:
    """Any message of a class that must survive the wire."""
    if cls is Frame:
        pictures = arrays(np.uint8, st.tuples(st.integers(1, 6), st.integers(1, 6)))
        return pictures.map(Frame)
    if cls in (Preview, Video, Picture):
        return st.binary(max_size=50).map(cls)
    if cls is Event:
        return st.builds(Event, st.integers(1, 5), st.text(), st.text())
    return _own(cls)


def example(cls: Any) -> Any:
    """One fixed valid message, with two rows in every array and no field at its default."""
    if cls in FOREIGN:
        pictures: dict[Any, Any] = {Preview: Preview(b"jpeg"), Video: Video(b"h264"), Picture: Picture(b"jpeg")}
        fixed = {Frame: Frame(np.eye(3, dtype=np.uint8)), Event: Event(2, "me", "hello"), **pictures}
        return fixed[cls]
    hints = get_type_hints(cls)
    values: dict[str, Any] = {}
    for number, field in enumerate(dataclasses.fields(cls), 1):
        hint = hints[field.name]
        if "shape" in field.metadata:
            shape = tuple(2 if n == -1 else n for n in field.metadata["shape"])
            values[field.name] = np.arange(np.prod(shape), dtype=np.float64).reshape(shape) + number
        elif (nested := nested_message(hint)) is not None:
            values[field.name] = example(nested)
        elif get_args(hint)[:1] == (str,):
            values[field.name] = (f"text {number}", "more")
        elif get_origin(hint) is tuple:
            values[field.name] = (number, number + 1)
        elif isinstance(hint, type) and issubclass(hint, enum.Enum):
            values[field.name] = list(hint)[-1]
        else:
            values[field.name] = {float: number + 0.5, bool: True, str: f"text {number}", int: number}[present_type(hint)]
    return cls(**values)


def same(a: Any, b: Any) -> bool:
    """Two messages equal in every field, types included."""
    if type(a) is not type(b):
        return False
    if isinstance(a, np.ndarray):
        return (a.shape, a.dtype.str, a.tobytes()) == (b.shape, b.dtype.str, b.tobytes())
    if dataclasses.is_dataclass(a):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    return bool(a == b)


def damaged(data: bytes, random: np.random.Generator, edits: int = 5, longest: int = 16) -> bytes:
    """A valid payload with up to `edits` pieces of up to `longest` bytes changed, cut, doubled or inserted."""
    changed = bytearray(data)
    for _ in range(random.integers(1, edits + 1)):
        at, length = int(random.integers(0, len(changed) + 1)), int(random.integers(1, longest + 1))
        match random.integers(0, 4):
            case 0:
                changed[at : at + 1] = random.bytes(1)
            case 1:
                del changed[at : at + length]
            case 2:
                changed[at:at] = changed[at : at + length]
            case _:
                changed[at:at] = random.bytes(length)
    return bytes(changed)

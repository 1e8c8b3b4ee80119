"""Encoding and decoding the messages that matter most, checks included.

Beside ours: the protobuf classes alone (the floor under ours: no dataclass, no checks), JSON, a struct of fixed layout (the
floor under everything in Python: no names, no optional parts, sizes known beforehand) and msgspec's MessagePack.
"""

import dataclasses
import enum
import functools
import json
import struct
from collections.abc import Callable, Iterator
from typing import Any, get_type_hints

import numpy as np

from benchmarks.harness import Row, run_peer, time_us
from shoal.messages import codec, messages

CALLS = 3000
FRAME_CALLS = 100
MSGSPEC = ("msgspec==0.22.0",)


def examples() -> dict[str, Any]:
    """Messages as they are on the wire of a running fleet: 50 steps of plan, a full camera picture."""
    random = np.random.default_rng(1)
    return {
        "RobotState": messages.RobotState(
            mode=messages.Mode.TRACKING,
            experiment_hash="0123456789abcdef" * 4,
            trajectory_id="0123456789ab",
            pulse_us=(1600, 1600, 1400, 1400, 1500, 1500, 1500, 1500),
            track=messages.Track.MARKER,
            heard=(2, 3),
            estimate=messages.Estimate(eta=random.normal(size=4), nu=random.normal(size=4), disturbance=random.normal(size=4)),
            control=messages.Control(
                eta_reference=random.normal(size=4),
                eta_command=random.normal(size=4),
                wrench=random.normal(size=3),
                wrench_step=random.normal(size=3),
                wrench_delivered=random.normal(size=3),
            ),
            board=messages.BoardReading(echo_us=(1600, 1600, 1400, 1400, 1500, 1500, 1500, 1500)),
        ),
        "Pose": messages.Pose(0.4, -0.1, 0.3, np.diag([1e-6, 1e-6, 1e-5]), messages.Track.MARKER, True, 0.9, 0.3),
        "Plan": messages.Plan(0.05, random.normal(size=(51, 4)), random.normal(size=(51, 4)), 0.02, False, (2, 3)),
        "Frame": messages.Frame(random.integers(0, 256, (960, 1280), np.uint8)),
    }


@dataclasses.dataclass(frozen=True)
class _Subject:
    """A way to the wire and back for one message."""

    name: str
    encode: Callable[[], bytes]
    decode: Callable[[bytes], Any]


def _ours(message: Any) -> _Subject:
    kind = type(message)
    return _Subject("ours", lambda: codec.encode(message), lambda data: codec.decode(kind, data, "peer", "topic"))


def _protobuf(message: Any) -> _Subject:
    """Fill the generated class from plain lists; read it back no further than parsed."""
    kind = codec.protobuf_class(type(message))
    fields = _plain(message)

    def encode() -> bytes:
        data: bytes = kind(**fields).SerializeToString()
        return data

    return _Subject("protobuf alone", encode, kind.FromString)


def _plain(message: Any) -> dict[str, Any]:
    """A message as numbers, text and lists."""
    values = {field.name: getattr(message, field.name) for field in dataclasses.fields(message)}
    return {name: value.ravel().tolist() if isinstance(value, np.ndarray) else value for name, value in values.items()}


def _json(message: Any) -> _Subject:
    kind = type(message)
    arrays = {field.name: field.metadata["shape"] for field in dataclasses.fields(message) if "shape" in field.metadata}

    def encode() -> bytes:
        return json.dumps(_plain(message)).encode()

    def decode(data: bytes) -> Any:
        values = json.loads(data)
        for name, shape in arrays.items():
            values[name] = np.array(values[name]).reshape(shape)
        return kind(**values)

    return _Subject("json", encode, decode)


def _struct(message: Any) -> _Subject:
    """Layout fixed by this very message, so there is nothing to look at when packing and unpacking."""
    kind, layout, slots = type(message), "<", []
    for name, value in _plain(message).items():
        many = isinstance(value, list | tuple)
        first = value[0] if many and value else value
        letter = "?" if isinstance(first, bool) else "i" if isinstance(first, int | enum.Enum) else "d"
        count = len(value) if many else 1
        layout += f"{len(value.encode())}s" if isinstance(value, str) else f"{count}{letter}" if count else ""
        slots.append((name, count, many, getattr(message, name)))
    packer = struct.Struct(layout)

    def encode() -> bytes:
        flat: list[Any] = []
        for value in _plain(message).values():
            if isinstance(value, str):
                flat.append(value.encode())
            elif isinstance(value, list | tuple):
                flat.extend(value)
            else:
                flat.append(value)
        return packer.pack(*flat)

    def decode(data: bytes) -> Any:
        flat, at, values = packer.unpack(data), 0, {}
        for name, count, many, model in slots:
            part = flat[at : at + count] if many else flat[at]
            values[name] = np.array(part).reshape(model.shape) if isinstance(model, np.ndarray) else part
            at += count
        return kind(**values)

    return _Subject("struct, fixed layout", encode, decode)


def _raw(frame: messages.Frame) -> _Subject:
    """A picture's bytes and nothing else: one copy to make them, none to look at them."""
    shape = frame.pixels.shape
    return _Subject("bytes alone", frame.pixels.tobytes, lambda data: np.frombuffer(data, np.uint8).reshape(shape))


def _subjects(message: Any) -> Iterator[_Subject]:
    yield _ours(message)
    if isinstance(message, messages.Frame):
        yield _raw(message)
    else:
        yield from (_protobuf(message), _json(message), _struct(message))


def _description(message: Any) -> dict[str, Any]:
    """Field types and values of a message, for a peer that has neither our classes nor numpy."""
    hints = get_type_hints(type(message))
    kinds = {}
    for field in dataclasses.fields(message):
        hint = hints[field.name]
        is_enum = isinstance(hint, type) and issubclass(hint, enum.Enum)
        simple = "int" if is_enum else getattr(hint, "__name__", "")
        kinds[field.name] = "floats" if "shape" in field.metadata else "ints" if simple == "tuple" else simple
    return {"kinds": kinds, "values": _plain(message)}


def run() -> Iterator[Row]:
    """All subjects, message by message."""
    fleet = examples()
    task = {name: _description(message) for name, message in fleet.items() if name != "Frame"}
    peers = run_peer("codec_msgspec", MSGSPEC, {"calls": CALLS, "messages": task})
    for name, message in fleet.items():
        calls = FRAME_CALLS if name == "Frame" else CALLS
        subjects = list(_subjects(message))
        for subject in subjects:
            yield Row.of("codec", f"encode {name}", subject.name, "us", time_us(subject.encode, calls))
        yield from (row for row in peers if row.case == f"encode {name}")
        for subject in subjects:
            decode = functools.partial(subject.decode, subject.encode())
            yield Row.of("codec", f"decode {name}", subject.name, "us", time_us(decode, calls))
        yield from (row for row in peers if row.case == f"decode {name}")
        for subject in subjects:
            size = float(len(subject.encode()))
            yield Row("codec", f"size of {name}", subject.name, "bytes", size, size, size, 1)
        yield from (row for row in peers if row.case == f"size of {name}")

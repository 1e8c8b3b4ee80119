"""The messages as a .proto file, for programs in other languages."""

import dataclasses
import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto

from shoal.messages import codec, messages
from shoal.messages.schema import file_descriptor
from tools.messages import field_comments

HEAD = """// Messages of the fleet that no foxglove.* schema covers. Written by `make docs` from shoal/messages/messages.py.
// Session, sequence number, stamp and age travel beside every message (messages.md), never inside it.
syntax = "proto3";
package fleet;
"""


def _type_name(field: FieldDescriptorProto) -> str:
    """The type of a field as it stands in a .proto file."""
    name = field.type_name.rpartition(".")[2] or FieldDescriptorProto.Type.Name(field.type).removeprefix("TYPE_").lower()
    if field.label == FieldDescriptorProto.LABEL_REPEATED:
        return f"repeated {name}"
    return f"optional {name}" if field.proto3_optional else name


def _about(cls: Any) -> Iterator[str]:
    """The docstring of a class as comments, after an empty line."""
    yield ""
    yield from (f"// {line}".rstrip() for line in (inspect.getdoc(cls) or "").splitlines())


def _shape(field: Any) -> str:
    """Rows and columns of an array, as its comment begins; n is any number. Empty for other fields."""
    shape = field.metadata.get("shape", ())
    return f"[{','.join('n' if n == -1 else str(n) for n in shape)}] " if shape else ""


def _message(cls: Any, message: DescriptorProto) -> Iterator[str]:
    comments, shapes = field_comments(cls), {field.name: _shape(field) for field in dataclasses.fields(cls)}
    yield from _about(cls)
    yield f"message {message.name} {{"
    for field in message.field:
        words = f"{shapes[field.name]}{comments[field.name]}".rstrip()
        comment = f"  // {words}" if words else ""
        yield f"  {_type_name(field)} {field.name} = {field.number};{comment}"
    yield "}"


def text() -> str:
    """The whole file."""
    file = file_descriptor("fleet", codec.OWN)
    lines = [HEAD.rstrip("\n")]
    for choices in file.enum_type:
        cls = getattr(messages, choices.name)
        comments = {member.value: field_comments(cls)[member.name] for member in cls}
        words = {number: f"  // {comment}" if comment else "" for number, comment in comments.items()}
        values = (f"  {value.name} = {value.number};{words[value.number]}" for value in choices.value)
        lines += [*_about(cls), f"enum {choices.name} {{", *values, "}"]
    for cls, message in zip(codec.OWN, file.message_type, strict=True):
        lines += _message(cls, message)
    return "\n".join(lines) + "\n"


def files() -> dict[Path, str]:
    """The file and its text."""
    return {Path(__file__).parents[1] / "docs" / "reference" / "fleet.proto": text()}

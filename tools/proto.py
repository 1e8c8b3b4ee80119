"""The messages as a .proto file, for programs in other languages."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto

from shoal.messages import codec
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


def _message(cls: Any, message: DescriptorProto) -> Iterator[str]:
    comments = field_comments(cls)
    yield f"\nmessage {message.name} {{"
    for field in message.field:
        comment = f"  // {comments[field.name]}" if comments[field.name] else ""
        yield f"  {_type_name(field)} {field.name} = {field.number};{comment}"
    yield "}"


def text() -> str:
    """The whole file."""
    file = file_descriptor("fleet", codec.OWN)
    lines = [HEAD.rstrip("\n")]
    for choices in file.enum_type:
        lines += [f"\nenum {choices.name} {{", *(f"  {value.name} = {value.number};" for value in choices.value), "}"]
    for cls, message in zip(codec.OWN, file.message_type, strict=True):
        lines += _message(cls, message)
    return "\n".join(lines) + "\n"


def files() -> dict[Path, str]:
    """The file and its text."""
    return {Path(__file__).parents[1] / "docs" / "reference" / "fleet.proto": text()}

"""Protobuf classes of the messages, built from their dataclasses: a message is written down once.

    classes = message_classes("fleet", (RobotState, Command))
    classes[RobotState](fault="late").SerializeToString()

A field's type, with its number and the width of its integers, stands beside the field (messages.py). A log holds the result as
its schema, and docs/reference/fleet.proto shows it to other programs.
"""

import dataclasses
import re
import types
from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

SIMPLE = {
    float: FieldDescriptorProto.TYPE_DOUBLE,
    bool: FieldDescriptorProto.TYPE_BOOL,
    str: FieldDescriptorProto.TYPE_STRING,
    "int64": FieldDescriptorProto.TYPE_INT64,
    "uint32": FieldDescriptorProto.TYPE_UINT32,
    "uint64": FieldDescriptorProto.TYPE_UINT64,
}


def may_be_absent(hint: Any) -> bool:
    """Say whether a field of this type may be None."""
    return types.NoneType in get_args(hint)


def present_type(hint: Any) -> Any:
    """The type of a field's value where there is one."""
    return next(part for part in get_args(hint) if part is not types.NoneType) if may_be_absent(hint) else hint


def nested_message(hint: Any) -> type | None:
    """The message class of a field that holds a message, or may hold one; None of another field."""
    kind = present_type(hint)
    return kind if isinstance(kind, type) and dataclasses.is_dataclass(kind) else None


def enum_prefix(choices: type[IntEnum]) -> str:
    """Prefix of the names of an enum's values in protobuf, where they share one space: `CAMERA_HEALTH_`."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", choices.__name__).upper() + "_"


def _width(hint: Any) -> tuple[Any, Any]:
    """A type without its annotation, and the key of its protobuf type in SIMPLE."""
    if get_origin(hint) is not Annotated:
        return hint, hint
    plain, *notes = get_args(hint)
    return plain, next((note for note in notes if note in SIMPLE), plain)


def _field(package: str, field: dataclasses.Field[Any], hint: Any) -> tuple[FieldDescriptorProto, type[IntEnum] | None]:
    """Description of a field, and the enum that it uses, if any. Raises TypeError for one without number."""
    kind, simple = _width(hint)
    nested = nested_message(kind)
    optional = nested is None and may_be_absent(kind)
    if optional:
        kind = simple = present_type(kind)
    numbers = [note for note in get_args(hint)[1:] if isinstance(note, int)] if get_origin(hint) is Annotated else []
    if len(numbers) != 1:
        raise TypeError(f"{field.name}: {hint} states no field number")
    described = FieldDescriptorProto(name=field.name, number=numbers[0], label=FieldDescriptorProto.LABEL_OPTIONAL)
    if "shape" in field.metadata:
        described.type, described.label = FieldDescriptorProto.TYPE_DOUBLE, FieldDescriptorProto.LABEL_REPEATED
    elif get_origin(kind) is tuple:
        _, item = _width(get_args(kind)[0])
        described.type, described.label = SIMPLE[item], FieldDescriptorProto.LABEL_REPEATED
    elif nested is not None:
        described.type, described.type_name = FieldDescriptorProto.TYPE_MESSAGE, f".{package}.{nested.__name__}"
    elif isinstance(kind, type) and issubclass(kind, IntEnum):
        described.type, described.type_name = FieldDescriptorProto.TYPE_ENUM, f".{package}.{kind.__name__}"
        return described, kind
    else:
        described.type, described.proto3_optional = SIMPLE[simple], optional
    return described, None


def fields(cls: Any) -> Iterator[tuple[dataclasses.Field[Any], Any]]:
    """The fields of a message with their annotated types."""
    hints = get_type_hints(cls, include_extras=True)
    for field in dataclasses.fields(cls):
        yield field, hints[field.name]


def file_descriptor(package: str, classes: Sequence[type]) -> FileDescriptorProto:
    """The description of message classes, and of the enums that they use."""
    file = FileDescriptorProto(name=f"{package}.proto", package=package, syntax="proto3")
    enums: dict[type[IntEnum], None] = {}
    for cls in classes:
        message = file.message_type.add(name=cls.__name__)
        for field, hint in fields(cls):
            described, choices = _field(package, field, hint)
            if described.proto3_optional:  # whether it is there travels as a choice of one
                described.oneof_index = len(message.oneof_decl)
                message.oneof_decl.add(name=f"_{field.name}")
            message.field.append(described)
            if choices is not None:
                enums[choices] = None
    for choices in enums:
        described_enum = file.enum_type.add(name=choices.__name__)
        for member in choices:
            described_enum.value.add(name=enum_prefix(choices) + member.name, number=member.value)
    return file


def message_classes(package: str, classes: Sequence[type]) -> dict[type, Any]:
    """The protobuf class of each message class."""
    pool = DescriptorPool()
    pool.Add(file_descriptor(package, classes))
    return {cls: GetMessageClass(pool.FindMessageTypeByName(f"{package}.{cls.__name__}")) for cls in classes}

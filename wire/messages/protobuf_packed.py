"""Protobuf classes that hand out arrays of doubles as the bytes that they are: protobuf makes a Python number of each. Pure.

On the wire a packed `repeated double` and `bytes` are the same: a length, then so many bytes, little-endian. proto3 packs.
"""

from typing import Any

from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClassesForFiles

DOUBLE = "<f8"  # as numpy calls it


def packed_classes(schema: FileDescriptor) -> dict[str, Any]:
    """The classes of a schema's messages by their full names, each array of doubles a field of bytes."""
    file = FileDescriptorProto.FromString(schema.serialized_pb)
    for message in file.message_type:
        for field in message.field:
            if (field.type, field.label) == (FieldDescriptorProto.TYPE_DOUBLE, FieldDescriptorProto.LABEL_REPEATED):
                field.type, field.label = FieldDescriptorProto.TYPE_BYTES, FieldDescriptorProto.LABEL_OPTIONAL
    pool = DescriptorPool()
    pool.Add(file)
    return GetMessageClassesForFiles([file.name], pool)

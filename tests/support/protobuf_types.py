"""Messages of protobuf types that are defined here, written by Google's library."""

from typing import Any

from google.protobuf import (  # type: ignore[import-untyped]
    descriptor_pb2,
    descriptor_pool,
    message_factory,
    timestamp_pb2,
)

from crosscue.replay.columns import Topic

F = descriptor_pb2.FieldDescriptorProto


def schema_of(name: str, fields: Any) -> bytes:
    """Return a FileDescriptorSet that defines ``foxglove.<name>`` and its imports."""
    file = descriptor_pb2.FileDescriptorProto(
        name=f"foxglove/{name}.proto",
        package="foxglove",
        syntax="proto3",
        dependency=["google/protobuf/timestamp.proto"],
    )
    message = file.message_type.add(name=name)
    for field_name, number, kind, *rest in fields:
        each = message.field.add(name=field_name, number=number, type=kind, label=F.LABEL_OPTIONAL)
        if rest and rest[0]:
            each.type_name = rest[0]
        if len(rest) > 1:
            each.label = F.LABEL_REPEATED
    stamp = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(stamp)
    # The importing file is first on purpose, because the order in a set is undefined.
    return bytes(descriptor_pb2.FileDescriptorSet(file=[file, stamp]).SerializeToString())


def proto_topic(name: str, fields: Any) -> tuple[Topic, Any]:
    """Return a topic of a type, and the class of its messages."""
    schema = schema_of(name, fields)
    pool = descriptor_pool.DescriptorPool()
    for file in reversed(descriptor_pb2.FileDescriptorSet.FromString(schema).file):
        pool.Add(file)
    of = message_factory.GetMessageClass(pool.FindMessageTypeByName(f"foxglove.{name}"))
    return Topic("/t", f"foxglove.{name}", "protobuf", schema, "protobuf"), of

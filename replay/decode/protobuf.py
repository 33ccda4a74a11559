"""Decode protobuf messages, whose schema is a serialized FileDescriptorSet.

Pictures are large and are located as ranges of the log by parsing only the outermost fields. All
other messages are rare and are parsed one by one with the protobuf package.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from google.protobuf import (  # type: ignore[import-untyped]
    descriptor_pb2,
    descriptor_pool,
    message_factory,
)
from google.protobuf.descriptor import (  # type: ignore[import-untyped]
    Descriptor,
    FieldDescriptor,
)
from google.protobuf.message import DecodeError, Message  # type: ignore[import-untyped]
from numpy.typing import NDArray

from crosscue.replay.columns import Block, Messages, Table, Topic
from crosscue.replay.errors import SchemaError, one_line
from crosscue.replay.ledger import Ledger
from crosscue.replay.limits import DEFAULT_LIMITS

from .coding import MAGIC_BYTES
from .foxglove import MAX_SECONDS, PICTURES, TABLES, PictureKind, SourceField, stamp_ns
from .pictures import PictureRow, images_of
from .refuse import MISFIT, refuse

MAX_DEPTH: Final = 8
MAX_LEAVES: Final = 2048
TIMES: Final = ("google.protobuf.Timestamp", "google.protobuf.Duration")

_DTYPES: Final[dict[int, str]] = {
    FieldDescriptor.CPPTYPE_INT32: "i4",
    FieldDescriptor.CPPTYPE_UINT32: "u4",
    FieldDescriptor.CPPTYPE_INT64: "i8",
    FieldDescriptor.CPPTYPE_UINT64: "u8",
    FieldDescriptor.CPPTYPE_DOUBLE: "f8",
    FieldDescriptor.CPPTYPE_FLOAT: "f4",
    FieldDescriptor.CPPTYPE_BOOL: "?",
    FieldDescriptor.CPPTYPE_ENUM: "i4",
}


def protobuf_decoder(topic: Topic) -> Callable[[Block, Ledger], Block] | None:
    """Return the decoder of a protobuf topic; None if the log does not define its type.

    Raises:
        SchemaError: The descriptor is damaged, too large, or contradicts its type's name.
    """
    if not topic.schema:
        return None
    try:
        descriptor = _descriptor(topic)
        if topic.type_name in PICTURES:
            return _picture_decoder(topic.type_name, descriptor)
        return _TableDecoder(
            message_factory.GetMessageClass(descriptor), _leaves(topic.type_name, descriptor)
        )
    except SchemaError as error:
        raise SchemaError(f"{topic.name}: {error}") from None


def _descriptor(topic: Topic) -> Descriptor:
    name = topic.type_name
    if len(topic.schema) > DEFAULT_LIMITS.schema_bytes:
        raise SchemaError(
            f"{name}: descriptor has {len(topic.schema)} bytes, over the limit of "
            f"{DEFAULT_LIMITS.schema_bytes}"
        )
    pool = descriptor_pool.DescriptorPool()
    try:
        files = {each.name: each for each in _files(topic.schema)}
        _add(pool, files)
        return pool.FindMessageTypeByName(name)
    except (DecodeError, TypeError, KeyError, ValueError, RecursionError) as error:
        words = one_line(error, 120)
        raise SchemaError(f"{name}: its protobuf descriptor cannot be used: {words}") from None


def _files(schema: bytes) -> list[Any]:
    found = descriptor_pb2.FileDescriptorSet()
    found.ParseFromString(schema)
    return list(found.file)


def _add(pool: descriptor_pool.DescriptorPool, files: dict[str, Any]) -> None:
    """Add files after their imports; a set with a cycle or a missing import is refused."""
    added: set[str] = set()
    waiting = dict(files)
    while waiting:
        ready = [name for name, each in waiting.items() if added.issuperset(each.dependency)]
        if not ready:
            raise ValueError(f"file {min(waiting)!r} imports a missing file")
        for name in ready:
            pool.AddSerializedFile(waiting.pop(name).SerializeToString())
            added.add(name)


@dataclass(frozen=True, slots=True)
class _Leaf:
    """One column of a table.

    Attributes:
        column: Name of the column.
        steps: Field names from the root.
        dtype: NumPy code; ``time``; or empty for the length of a repeated field.
        count: Length of the array, as in ``SourceField``.
    """

    column: str
    steps: tuple[str, ...]
    dtype: str
    count: int = 0


def _leaves(name: str, descriptor: Descriptor) -> tuple[_Leaf, ...]:
    standard = TABLES.get(name)
    if standard is None:
        leaves = tuple(_walk_type(descriptor, (), (descriptor.full_name,)))
        if len(leaves) > MAX_LEAVES:
            raise SchemaError(f"{name}: over {MAX_LEAVES} fields")
        return leaves
    stamp = [leaf for leaf in _walk_type(descriptor, (), ()) if leaf.column == "timestamp"]
    return (*stamp, *(_standard_leaf(name, descriptor, c, s) for c, s in standard.items()))


def _standard_leaf(name: str, descriptor: Descriptor, column: str, source: SourceField) -> _Leaf:
    steps = tuple(source.path.split("."))
    at: Descriptor | None = descriptor
    each = None
    for step in steps:
        each = at.fields_by_name.get(step) if at is not None else None
        at = each.message_type if each is not None else None
    if each is None or each.is_repeated != (source.count != 0) or each.cpp_type not in _DTYPES:
        raise SchemaError(
            f"{name}: its descriptor lacks the field {source.path}; "
            "the log's definition and the type's name do not agree"
        )
    return _Leaf(column, steps, _DTYPES[each.cpp_type], source.count)


def _walk_type(
    descriptor: Descriptor, steps: tuple[str, ...], seen: tuple[str, ...]
) -> Iterator[_Leaf]:
    for each in descriptor.fields:
        path = (*steps, each.name)
        inner = each.message_type
        if each.is_repeated:
            yield _Leaf(".".join(path) + ".length", path, "")
        elif inner is not None and inner.full_name in TIMES:
            _check_time(inner)
            yield _Leaf(".".join(path), path, "time")
        elif inner is not None:
            if inner.full_name not in seen and len(path) < MAX_DEPTH:
                yield from _walk_type(inner, path, (*seen, inner.full_name))
        elif each.cpp_type in _DTYPES:
            yield _Leaf(".".join(path), path, _DTYPES[each.cpp_type])


def _check_time(descriptor: Descriptor) -> None:
    """Refuse a descriptor of a time whose fields are not those of a time."""
    wanted = (("seconds", 1, FieldDescriptor.TYPE_INT64), ("nanos", 2, FieldDescriptor.TYPE_INT32))
    for name, number, kind in wanted:
        each = descriptor.fields_by_name.get(name)
        if each is None or (each.number, each.type) != (number, kind) or each.is_repeated:
            raise SchemaError(f"{descriptor.full_name}: its descriptor lacks the field {name}")


@dataclass(frozen=True, slots=True)
class _TableDecoder:
    message: type[Message]
    leaves: tuple[_Leaf, ...]

    def __call__(self, block: Block, ledger: Ledger) -> Block:
        if not isinstance(block.rows, Messages):
            return block
        kept, parsed = [], []
        for i in range(len(block)):
            try:
                row = self._row(bytes(block.rows.payload(i)))
            except (DecodeError, ValueError, OverflowError, RecursionError) as error:
                why = one_line(error, 120)
                refuse(ledger, block, i, MISFIT, why)
                continue
            kept.append(i)
            parsed.append(row)
        picked = block.take(np.array(kept, np.intp))
        columns = {
            leaf.column: _column(leaf, [row[k] for row in parsed])
            for k, leaf in enumerate(self.leaves)
        }
        stamp = columns.pop("timestamp", None)
        if not columns:
            columns["present"] = np.ones(len(kept), np.bool_)
        header_ns = None if stamp is None else stamp.astype(np.int64)
        return replace(picked, rows=Table(columns), header_ns=header_ns)

    def _row(self, payload: bytes) -> list[Any]:
        message = self.message()
        message.ParseFromString(payload)
        return [_value(message, leaf) for leaf in self.leaves]


def _value(message: Message, leaf: _Leaf) -> Any:
    at: Any = message
    for step in leaf.steps:
        at = getattr(at, step)
    if leaf.dtype == "":
        return len(at)
    if leaf.dtype == "time":
        if abs(at.seconds) > MAX_SECONDS:
            raise ValueError(f"{leaf.column}: {at.seconds} s is not a time")
        return at.seconds * 1_000_000_000 + at.nanos
    if leaf.count > 0:
        if len(at) not in (0, leaf.count):
            raise ValueError(f"{leaf.column}: expected {leaf.count} values, got {len(at)}")
        return list(at) or [np.nan] * leaf.count
    return list(at) if leaf.count else at


def _column(leaf: _Leaf, values: list[Any]) -> NDArray[np.generic]:
    if leaf.count < 0:
        width = max(map(len, values), default=0)
        return np.array([v + [np.nan] * (width - len(v)) for v in values], np.float64).reshape(
            len(values), width
        )
    if leaf.count:
        return np.array(values, np.float64).reshape(len(values), leaf.count)
    return np.array(values, np.int64 if leaf.dtype in ("", "time") else leaf.dtype)


@dataclass(frozen=True, slots=True)
class _PictureDecoder:
    """Decoder of picture messages, with their field numbers."""

    picture: PictureKind
    numbers: dict[int, str]

    def __call__(self, block: Block, ledger: Ledger) -> Block:
        if not isinstance(block.rows, Messages):
            return block
        rows: list[PictureRow | str] = []
        for i in range(len(block)):
            try:
                rows.append(self._row(block.rows, i))
            except (ValueError, DecodeError, UnicodeDecodeError) as error:
                rows.append(one_line(error, 120))
        return images_of(block, block.rows.buffer, self.picture, rows, ledger)

    def _row(self, messages: Messages, i: int) -> PictureRow:
        payload = messages.payload(i)
        found: dict[str, Any] = {}
        for number, begin, end, plain in outer_fields(payload):
            name = self.numbers.get(number)
            if name in ("data", "timestamp", "format", "encoding"):
                if plain is not None:
                    raise ValueError(f"{name} has a wrong wire type")
                found[name] = (begin, end)
            elif name is not None:
                found[name] = plain if plain is not None else 0
        first = int(messages.start[i])
        begin, end = found.get("data", (0, 0))
        return PictureRow(
            stamp_ns=_stamp(payload, found.get("timestamp")),
            start=first + begin,
            stop=first + end,
            magic=payload[begin : min(end, begin + MAGIC_BYTES)].tobytes(),
            label=_text(payload, found.get("format") or found.get("encoding")),
            width_px=found.get("width", 0),
            height_px=found.get("height", 0),
            step_bytes=found.get("step", 0),
        )


def _text(payload: memoryview, place: tuple[int, int] | None) -> str:
    return "" if place is None else payload[place[0] : place[1]].tobytes().decode("utf-8")


def _stamp(payload: memoryview, place: tuple[int, int] | None) -> int | None:
    if place is None:
        return None
    seconds = nanos = 0
    for number, _, _, plain in outer_fields(payload[place[0] : place[1]]):
        if number == 1 and plain is not None:
            seconds = plain - (1 << 64) if plain >= 1 << 63 else plain
        elif number == 2 and plain is not None:
            nanos = plain
    return stamp_ns(seconds, nanos)


def _picture_decoder(name: str, descriptor: Descriptor) -> _PictureDecoder:
    wanted: dict[str, tuple[int, ...]] = {
        "timestamp": (FieldDescriptor.TYPE_MESSAGE,),
        "data": (FieldDescriptor.TYPE_BYTES,),
    }
    number = (FieldDescriptor.TYPE_FIXED32, FieldDescriptor.TYPE_UINT32)
    if PICTURES[name] is PictureKind.RAW:
        wanted |= {"encoding": (FieldDescriptor.TYPE_STRING,)}
        wanted |= dict.fromkeys(("width", "height", "step"), number)
    else:
        wanted |= {"format": (FieldDescriptor.TYPE_STRING,)}
    numbers = {}
    for field_name, types in wanted.items():
        each = descriptor.fields_by_name.get(field_name)
        if each is None or each.type not in types or each.is_repeated:
            raise SchemaError(
                f"{name}: its descriptor lacks the field {field_name}; "
                "the log's definition and the type's name do not agree"
            )
        if each.message_type is not None:
            _check_time(each.message_type)
        numbers[each.number] = field_name
    return _PictureDecoder(PICTURES[name], numbers)


def outer_fields(payload: memoryview) -> Iterator[tuple[int, int, int, int | None]]:
    """Yield the outermost fields of a protobuf message: number, first byte, end, scalar value.

    Raises:
        ValueError: A field extends past the end, or has an invalid wire type.
    """
    at, size = 0, len(payload)
    while at < size:
        key, at = _varint(payload, at)
        number, wire = key >> 3, key & 7
        if number < 1:
            raise ValueError("field number 0")
        begin, plain = at, None
        if wire == 0:
            plain, at = _varint(payload, at)
        elif wire in (1, 5):
            at += 8 if wire == 1 else 4
            plain = int.from_bytes(payload[begin:at], "little")
        elif wire == 2:
            length, begin = _varint(payload, at)
            at = begin + length
        else:
            raise ValueError(f"field {number} has the wire type {wire}")
        if at > size:
            raise ValueError(f"field {number} extends past the end")
        yield number, begin, at, plain


def _varint(payload: memoryview, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(payload):
            raise ValueError("a number extends past the end")
        byte = payload[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value & (1 << 64) - 1, at
    raise ValueError("a number has over ten bytes")

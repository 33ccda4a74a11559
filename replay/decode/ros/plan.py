"""Compile a message definition into the steps that parse its bytes.

Nested messages are flattened, so that a plan is a short list of three kinds of step: a *run* of
fields with fixed sizes, a string, and a sequence. Inside a run the offset of every field depends
only on the start of the run modulo 8 (CDR aligns each value to its own size), so a table of eight
rows contains all offsets.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Final, TypeAlias

import numpy as np

from crosscue.replay.columns import Int64s
from crosscue.replay.decode.ros.definition import (
    DURATION,
    PRIMITIVES,
    TIME,
    Definitions,
    MessageField,
    Multiplicity,
    well_known,
)
from crosscue.replay.errors import SchemaError
from crosscue.replay.limits import DEFAULT_LIMITS

MAX_DEPTH: Final = 32
MAX_STEPS: Final = 20_000
HEADER: Final = "std_msgs/msg/Header"
# Name of the byte that represents an empty message on the wire; it holds no value.
FILLER: Final = "structure_needs_at_least_one_member"


@dataclass(frozen=True, slots=True)
class Value:
    """A number, a time or a fixed array inside a run.

    Attributes:
        path: Dotted name from the message's root.
        code: NumPy code without byte order (``f8``), ``time`` or ``duration``.
        count: Length of an array, 0 for a single value.
        is_bool: True for a bool, stored as a byte that is true unless zero.
    """

    path: str
    code: str
    count: int = 0
    is_bool: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class FixedFields:
    """Adjacent fields of fixed size.

    Attributes:
        values: K values.
        widths: Bytes of each value.
        place: Shape (8, K), int64: offset of each value from the run's start, by start modulo 8.
        size: Shape (8,), int64: bytes from the run's start to its end, by start modulo 8.
        cdr_widths: Bytes of each value in CDR, where an empty message has one byte and a ROS 1
            header has no counter.
        cdr_place: Like ``place``, in CDR; differs from it in plans for ROS 1.
        cdr_size: Like ``size``, in CDR.
    """

    values: tuple[Value, ...]
    widths: tuple[int, ...]
    place: Int64s
    size: Int64s
    cdr_widths: tuple[int, ...]
    cdr_place: Int64s
    cdr_size: Int64s


@dataclass(frozen=True, slots=True)
class Text:
    """A string."""

    path: str
    bound: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Items:
    """A sequence, or an array whose items vary in size or are too many to name.

    Attributes:
        path: Dotted name.
        item: Steps of one item.
        count: Length of an array; None for a sequence, whose length precedes it.
        bound: Max number of items, 0 for no bound.
        code: NumPy code of a sequence of numbers, else empty.
        jumps: Shape (K, 8): bytes of 2**k items, by start modulo 8; None if items vary in size.
        cdr_jumps: Like ``jumps``, in CDR.
        item_bytes: Min bytes of one item.
    """

    path: str
    item: tuple[Step, ...]
    count: int | None
    bound: int
    code: str
    jumps: Int64s | None
    cdr_jumps: Int64s | None
    item_bytes: int


Step: TypeAlias = FixedFields | Text | Items


@dataclass(frozen=True, slots=True, eq=False)
class ParsingPlan:
    """Parsing plan of one message type.

    Attributes:
        type_name: Name for error messages.
        is_cdr: True for CDR with alignment and terminated strings; False for ROS 1.
        steps: Steps in wire order.
        values: Named values by path.
        texts: Paths of strings outside sequences.
        sequences: Sequences and arrays outside other sequences, by path.
    """

    type_name: str
    is_cdr: bool
    steps: tuple[Step, ...]
    values: Mapping[str, Value]
    texts: frozenset[str]
    sequences: Mapping[str, Items]


def compile_plan(type_name: str, known: Definitions, *, is_cdr: bool) -> ParsingPlan:
    """Compile the parsing plan of ``type_name``.

    Raises:
        SchemaError: A type is missing or contains itself, or every message exceeds the limits.
    """
    steps = _Planner(type_name, known, is_cdr).message(type_name, "", 0)
    runs = [step for step in steps if isinstance(step, FixedFields)]
    return ParsingPlan(
        type_name,
        is_cdr,
        steps,
        {v.path: v for run in runs for v in run.values if not v.path.endswith(FILLER)},
        frozenset(step.path for step in steps if isinstance(step, Text)),
        {step.path: step for step in steps if isinstance(step, Items)},
    )


@dataclass(frozen=True, slots=True)
class _Fixed:
    """A value before it is added to a run: alignment and bytes as stored, and in CDR."""

    value: Value
    align: int
    width: int
    cdr_align: int
    cdr_width: int


_Piece: TypeAlias = _Fixed | Text | Items


@dataclass(slots=True)
class _Planner:
    root: str
    known: Definitions
    is_cdr: bool
    made: int = field(default=0)

    def message(self, name: str, prefix: str, depth: int) -> tuple[Step, ...]:
        return tuple(_in_runs(self._pieces(name, prefix, depth)))

    def _pieces(self, name: str, prefix: str, depth: int) -> Iterator[_Piece]:
        if depth > MAX_DEPTH:
            raise SchemaError(f"{self.root}: {name} is nested deeper than {MAX_DEPTH} levels")
        if name in (TIME, DURATION):
            code = "time" if name == TIME else "duration"
            yield self._value(Value(prefix or "stamp", code), 4, 8)
            return
        fields = self._fields(name)
        if not fields:
            # In CDR an empty message still takes one byte.
            filler = Value(f"{prefix}.{FILLER}".lstrip("."), "u1")
            yield _Fixed(filler, 1, 1 if self.is_cdr else 0, 1, 1)
        for each in fields:
            path = f"{prefix}.{each.name}" if prefix else each.name
            is_counter = name == HEADER and each is fields[0] and each.name == "seq"
            for piece in self._field(each, path, depth):
                if not self.is_cdr and is_counter and isinstance(piece, _Fixed):
                    yield replace(piece, cdr_align=1, cdr_width=0)
                else:
                    yield piece

    def _fields(self, name: str) -> tuple[MessageField, ...]:
        fields = self.known.get(name)
        if fields is None and self.is_cdr:
            fields = (well_known(name) or {}).get(name)
        if fields is None:
            raise SchemaError(f"{self.root}: its definition lacks the type {name}")
        return fields

    def _field(self, each: MessageField, path: str, depth: int) -> Iterator[_Piece]:
        if each.shape is Multiplicity.ONE:
            yield from self._one(each, path, depth)
            return
        if each.shape is Multiplicity.ARRAY:
            if each.size < 1:
                raise SchemaError(f"{self.root}: array {path} of length {each.size}")
            if each.type_name in PRIMITIVES:
                yield self._number(each, path, each.size)
                return
        yield self._items(each, path, depth)

    def _one(self, each: MessageField, path: str, depth: int) -> Iterator[_Piece]:
        if each.type_name in PRIMITIVES:
            yield self._number(each, path, 0)
        elif each.type_name == "string":
            self._count()
            yield Text(path, each.text_bound)
        elif "/" in each.type_name:
            yield from self._pieces(each.type_name, path, depth + 1)
        else:
            raise SchemaError(f"{self.root}: {path} has the unsupported type {each.type_name}")

    def _number(self, each: MessageField, path: str, count: int) -> _Piece:
        code = PRIMITIVES[each.type_name]
        width = int(code[1])
        value = Value(path, code, count, each.type_name == "bool")
        return self._value(value, width, width * max(count, 1))

    def _value(self, value: Value, align: int, size: int) -> _Fixed:
        self._count()
        if size > DEFAULT_LIMITS.message_bytes:
            raise SchemaError(
                f"{self.root}: {value.path} alone takes {size} bytes, over the limit of "
                f"{DEFAULT_LIMITS.message_bytes} for a message"
            )
        return _Fixed(value, align if self.is_cdr else 1, size, align, size)

    def _items(self, each: MessageField, path: str, depth: int) -> Items:
        self._count()
        one = MessageField(each.name, each.type_name, text_bound=each.text_bound)
        item = tuple(_in_runs(self._one(one, path, depth)))
        min_bytes = sum(_min_bytes(step) for step in item)
        is_array = each.shape is Multiplicity.ARRAY
        if is_array and min_bytes * each.size > DEFAULT_LIMITS.message_bytes:
            raise SchemaError(
                f"{self.root}: {path} alone takes {min_bytes * each.size} bytes, over the limit of "
                f"{DEFAULT_LIMITS.message_bytes} for a message"
            )
        runs = [step for step in item if isinstance(step, FixedFields)]
        is_fixed = len(runs) == len(item)
        return Items(
            path,
            item,
            each.size if is_array else None,
            0 if is_array else each.size,
            PRIMITIVES.get(each.type_name, ""),
            _jumps([run.size for run in runs]) if is_fixed else None,
            _jumps([run.cdr_size for run in runs]) if is_fixed else None,
            min_bytes,
        )

    def _count(self) -> None:
        self.made += 1
        if self.made > MAX_STEPS:
            raise SchemaError(f"{self.root}: its definition expands to over {MAX_STEPS} fields")


def _min_bytes(step: Step) -> int:
    if isinstance(step, FixedFields):
        return int(step.size.min())
    if isinstance(step, Text):
        return 4
    return 4 if step.count is None else step.count * step.item_bytes


def _in_runs(pieces: Iterator[_Piece]) -> Iterator[Step]:
    waiting: list[_Fixed] = []
    for piece in pieces:
        if isinstance(piece, _Fixed):
            waiting.append(piece)
            continue
        if waiting:
            yield _run(waiting)
            waiting = []
        yield piece
    if waiting:
        yield _run(waiting)


def _run(pieces: list[_Fixed]) -> FixedFields:
    stored = [(piece.align, piece.width) for piece in pieces]
    cdr = [(piece.cdr_align, piece.cdr_width) for piece in pieces]
    return FixedFields(
        tuple(piece.value for piece in pieces),
        tuple(piece.width for piece in pieces),
        *_laid_out(stored),
        tuple(piece.cdr_width for piece in pieces),
        *_laid_out(cdr),
    )


def _laid_out(pieces: list[tuple[int, int]]) -> tuple[Int64s, Int64s]:
    """Return offsets of pieces, (8, K), and their total size, (8,), by start modulo 8."""
    place = np.zeros((8, len(pieces)), np.int64)
    size = np.zeros(8, np.int64)
    for begin in range(8):
        at = begin
        for k, (align, width) in enumerate(pieces):
            at = -(-at // align) * align
            place[begin, k] = at - begin
            at += width
        size[begin] = at - begin
    return place, size


def _jumps(sizes: list[Int64s]) -> Int64s:
    """Return the bytes of 1, 2, 4, ... 2**31 items, by start modulo 8, by repeated squaring."""
    one = np.zeros(8, np.int64)
    begin = np.arange(8)
    for size in sizes:
        one += size[(begin + one) & 7]
    jumps = [one]
    for _ in range(31):
        last = jumps[-1]
        jumps.append(last + last[(begin + last) & 7])
    return np.stack(jumps)


def jumped(jumps: Int64s, at: Int64s, count: Int64s) -> Int64s:
    """Return the ends of ``count`` items that begin at ``at``, both of one shape."""
    for k in range(int(count.max(initial=0)).bit_length()):
        at = at + np.where((count >> k) & 1, jumps[k][at & 7], 0)
    return at

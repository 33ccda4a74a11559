"""Transcode ROS 1 messages to CDR: the same values in order, aligned, with terminated strings.

The parser of messages (``crosscue.replay.decode.ros.walk``) records which bytes are copied. Once
the sizes of all messages are known, complete columns of values are copied at once.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Block, Bytes, Int64s, Messages, Topic
from crosscue.replay.decode.refuse import MISFIT, refuse
from crosscue.replay.decode.ros.definition import definitions_of
from crosscue.replay.decode.ros.plan import (
    FixedFields,
    Items,
    ParsingPlan,
    Text,
    compile_plan,
    jumped,
)
from crosscue.replay.decode.ros.type_names import ros2_spelling
from crosscue.replay.decode.ros.walk import Bools, Cursor, FieldPositions, Place, Rows, Walker
from crosscue.replay.errors import SchemaError
from crosscue.replay.ledger import Ledger

from .definitions import as_ros2, differs_in_ros2, text_of
from .outgoing import Outgoing, Ros2Type
from .template import ENCAPSULATION

# Max number of different lengths for copies length by length; with more, copies are single.
FEW_LENGTHS: Final = 32
# Mean size in bytes from which single copies are as fast.
LARGE: Final = 4096


def copy_ranges(
    target: NDArray[np.uint8],
    target_start: NDArray[np.int64],
    source: NDArray[np.uint8],
    source_start: NDArray[np.int64],
    length: NDArray[np.int64],
) -> None:
    """Copy N ranges of bytes; ranges of one length are copied together if there are few lengths."""
    if not len(length):
        return
    mean = int(length.sum()) // len(length)
    are_equal = bool((length == length[0]).all())
    lengths = length[:1] if are_equal or mean >= LARGE else np.unique(length)
    if mean >= LARGE or len(lengths) > FEW_LENGTHS:
        to, of = target.data, source.data
        rows = zip(target_start.tolist(), source_start.tolist(), length.tolist(), strict=True)
        for put, take, size in rows:
            to[put : put + size] = of[take : take + size]
        return
    for size in lengths.tolist():
        if size == 0:
            continue
        rows_ = slice(None) if len(lengths) == 1 else length == size
        to_view, of_view = _windows(target, size), _windows(source, size)
        to_view[target_start[rows_]] = of_view[source_start[rows_]]


def _windows(buffer: NDArray[np.uint8], width: int) -> NDArray[np.void]:
    """Return a view of a buffer with an item of ``width`` bytes at every position."""
    view: NDArray[np.void] = np.ndarray(
        (len(buffer) - width + 1,), f"V{width}", buffer.data, strides=(1,)
    )
    return view


HEAD: Final = len(ENCAPSULATION)


@dataclass(frozen=True, slots=True, eq=False)
class _Values:
    """M values of equal width to copy: message, position in the log, and in the new message."""

    rows: Rows
    source: Int64s
    target: Int64s
    width: int | Int64s


@dataclass(frozen=True, slots=True, eq=False)
class _Lengths:
    """M lengths to write."""

    rows: Rows
    target: Int64s
    length: Int64s


_Job: TypeAlias = _Values | _Lengths


@dataclass(slots=True, eq=False)
class _TwoCursors(Cursor):
    """Positions in the log and in the new messages.

    Attributes:
        out: Position in each new message's body.
    """

    out: Int64s

    def pick(self, which: Bools) -> _TwoCursors:
        """Return a separate cursor over some of the messages."""
        one = Cursor.pick(self, which)
        return _TwoCursors(one.rows, one.origin, one.at, one.stop, self.out[which])

    def put_back(self, which: Bools, moved: Cursor) -> None:
        """Copy the positions of a cursor from ``pick``."""
        assert isinstance(moved, _TwoCursors)
        Cursor.put_back(self, which, moved)
        self.out[which] = moved.out

    def numbers(self) -> Rows:
        """Row number of each message in the block."""
        if isinstance(self.rows, slice):
            return np.arange(len(self.stop))
        return self.rows


@dataclass(slots=True, eq=False)
class _Transcriber(Walker):
    """Parser of ROS 1 messages that records the copies for the CDR messages."""

    jobs: list[_Job] = field(default_factory=list)

    def run(self, run: FixedFields, cursor: Cursor, keep: bool) -> None:
        """Record the values of a run."""
        assert isinstance(cursor, _TwoCursors)
        self._values(run, cursor.numbers(), cursor.origin + cursor.at, cursor.out)
        cursor.out = cursor.out + run.cdr_size[cursor.out & 7]
        Walker.run(self, run, cursor, keep)

    def _values(self, run: FixedFields, rows: Rows, source: Int64s, target: Int64s) -> None:
        """Record copies; values that remain adjacent are copied together."""
        modulo = target & 7
        places = run.cdr_place[modulo[0]] if len(modulo) and (modulo == modulo[0]).all() else None
        k, last = 0, len(run.values)
        while k < last:
            begin, width = k, run.widths[k]
            k += 1
            if not run.cdr_widths[begin] or not width:
                continue
            while (
                places is not None
                and k < last
                and run.widths[k] == run.cdr_widths[k]
                and places[k] - places[begin] == run.place[0, k] - run.place[0, begin]
                and places[k] == places[begin] + width
            ):
                width += run.widths[k]
                k += 1
            put = places[begin] if places is not None else run.cdr_place[modulo, begin]
            self.jobs.append(_Values(rows, source + run.place[0, begin], target + put, width))

    def text(self, text: Text, cursor: Cursor, keep: bool) -> tuple[Place, Place]:
        """Record a string, and add its terminator."""
        assert isinstance(cursor, _TwoCursors)
        first, length = Walker.text(self, text, cursor, keep)
        at = (cursor.out + 3) & -4
        rows, size = cursor.numbers(), cursor.spread(length)
        self.jobs.append(_Lengths(rows, at, size + 1))
        self.jobs.append(_Values(rows, cursor.origin + first, at + 4, size))
        cursor.out = at + 5 + size
        return first, length

    def contents(self, items: Items, cursor: Cursor, count: Place) -> None:
        """Record a sequence's length and items."""
        assert isinstance(cursor, _TwoCursors)
        rows, counts = cursor.numbers(), cursor.spread(count)
        if items.count is None:
            at = (cursor.out + 3) & -4
            self.jobs.append(_Lengths(rows, at, counts))
            cursor.out = at + 4
        first, out = cursor.origin + cursor.at, cursor.out
        Walker.contents(self, items, cursor, count)
        if items.jumps is None or items.cdr_jumps is None:
            return
        fits = self.found.ok[cursor.rows]
        counts = np.where(fits, counts, 0)
        if items.code:
            width = int(items.code[1])
            at = np.where(counts > 0, -(-out // width) * width, out)
            self.jobs.append(_Values(rows, first, at, counts * width))
        else:
            self._all_items(items, rows, first, out, counts)
        cursor.out = jumped(items.cdr_jumps, out, counts)

    def _all_items(
        self, items: Items, rows: Rows, first: Int64s, out: Int64s, count: Int64s
    ) -> None:
        """Record all items of all messages as if each were a message."""
        assert items.jumps is not None
        assert items.cdr_jumps is not None
        owner = np.repeat(np.arange(len(count)), count)
        number = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
        source = first[owner] + number * items.jumps[0][0]
        target = jumped(items.cdr_jumps, out[owner], number)
        for step in items.item:
            assert isinstance(step, FixedFields)
            self._values(step, rows[owner], source, target)

    def write(self, out: Int64s) -> Messages:
        """Return the new messages, in order, for the messages that fit.

        Args:
            out: Shape (N,): bytes of each new message's body.
        """
        ok = self.found.ok
        size = np.where(ok, out + HEAD, 0)
        stop = np.cumsum(size)
        start = stop - size
        buffer = np.zeros(int(stop[-1]) if len(stop) else 0, np.uint8)
        for k, byte in enumerate(ENCAPSULATION):
            buffer[start[ok] + k] = byte
        for job in self.jobs:
            self._copy(job, buffer, start + HEAD)
        return Messages(buffer, start[ok], stop[ok])

    def _copy(self, job: _Job, buffer: Bytes, body: Int64s) -> None:
        keep: slice | NDArray[np.bool_] = slice(None)
        if self.damaged:
            keep = self.found.ok[job.rows]
        target = (body[job.rows] + job.target)[keep]
        if isinstance(job, _Lengths):
            raw = job.length[keep].astype("<u4").view(np.uint8).reshape(-1, 4)
            copy_ranges(buffer, target, raw.reshape(-1), np.arange(len(raw)) * 4, _of(4, target))
            return
        width = _of(job.width, target) if isinstance(job.width, int) else job.width[keep]
        copy_ranges(buffer, target, self.found.buffer, job.source[keep], width)


def _of(width: int, like: Int64s) -> Int64s:
    return np.full(len(like), width, np.int64)


@dataclass(frozen=True, slots=True)
class Ros1ToCdr:
    """Encoder from blocks of ROS 1 messages of one type to CDR.

    Attributes:
        type: ROS 2 type of the new messages.
        plan: Parsing plan of the ROS 1 messages.
        differs: True if ROS 2 has a different type with this name.
    """

    type: Ros2Type
    plan: ParsingPlan
    differs: bool

    def __call__(self, block: Block, ledger: Ledger) -> list[Outgoing]:
        """Transcode a block; messages that do not fit their definition are dropped."""
        assert isinstance(block.rows, Messages)
        messages = block.rows
        count, start = len(messages), messages.start
        no_heads = np.empty((count, 0), np.uint8)
        found = FieldPositions(messages.buffer, start, True, np.ones(count, np.bool_), no_heads)
        walker = _Transcriber(found, False)
        zero = np.zeros(count, np.int64)
        cursor = _TwoCursors(slice(None), start, zero, messages.stop - start, zero.copy())
        walker.whole(self.plan, cursor)
        for rows, why in found.refused:
            refuse(ledger, block, int(rows[0]), MISFIT, why, len(rows))
        if self.differs:
            ledger.notice(
                f"{block.topic}: {self.type.name} differs between ROS 1 and ROS 2; the file keeps "
                "the fields of ROS 1 and defines them"
            )
        if not found.ok.any():
            return []
        kept = block if found.ok.all() else block.take(found.ok)
        return [Outgoing(self.type, replace(kept, rows=walker.write(cursor.out)))]


def ros1_to_cdr(topic: Topic) -> Ros1ToCdr | None:
    """Return the encoder of a ROS 1 topic; None if the log does not define its type.

    Raises:
        SchemaError: The definition does not parse, or lacks a type.
    """
    name = ros2_spelling(topic.type_name)
    if not topic.schema and not topic.schema_encoding:
        return None
    try:
        known = definitions_of(name, topic.schema, topic.schema_encoding or "ros1msg")
        plan = compile_plan(name, known, is_cdr=False)
        modern = as_ros2(name, known)
        text, differs = text_of(name, modern), differs_in_ros2(name, modern)
    except SchemaError as error:
        raise SchemaError(f"{topic.name}: {error}") from None
    return Ros1ToCdr(Ros2Type(name, text.encode()), plan, differs)

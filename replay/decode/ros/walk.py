"""Parse N messages at once: one position per message, advanced step by step with NumPy.

Most messages of a topic repeat one layout. A position that all messages share is therefore one
number, and stays one for as long as their lengths of strings and sequences agree.

Every message must be consumed exactly. A message is refused, with the name of the field, if a field
extends past its end, has an implausible length or lacks a terminator, or if bytes are left over.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Bytes, Int64s, Messages
from crosscue.replay.decode.ros.plan import FixedFields, Items, ParsingPlan, Step, Text, jumped

Bools = NDArray[np.bool_]
Rows = NDArray[np.intp]

# Position or number in each of N messages, shape (N,); one number if all are equal.
Place: TypeAlias = Int64s | int

# Max bytes at the start of every message that are copied to one table, in which a field at one
# place is a column.
HEAD_BYTES: Final = 1024
# Bits that are set in eight bytes unless all are ASCII.
_HIGH_BITS: Final = 0x8080808080808080
# Max steps for nested items of varying size in one block, which bounds the time for any log.
MAX_ITEM_STEPS: Final = 50_000
# Max bytes of padding after a CDR message, to a multiple of four.
CDR_PADDING: Final = 3


@dataclass(slots=True, eq=False)
class FieldPositions:
    """Positions of all fields in N messages of one byte order, counted from the origins.

    Attributes:
        buffer: Bytes of all messages.
        origin: Shape (N,): first byte of each message, after the encapsulation.
        little: True if numbers are little endian.
        ok: Shape (N,): True if the message fits; positions of the others are meaningless.
        heads: Shape (N, K): the first bytes of each message.
        refused: Indices of others, and the field and fault for which they do not fit.
        places: By path of a value: start of its run, alignment of that start, and offset of the
            value by alignment (8,).
        texts: By path of a string: its first byte and length without terminator.
        sequences: By path of a sequence: its first item and length.
    """

    buffer: Bytes
    origin: Int64s
    little: bool
    ok: Bools
    heads: Bytes
    refused: list[tuple[Rows, str]] = field(default_factory=list)
    places: dict[str, tuple[Place, Place, Int64s]] = field(default_factory=dict)
    texts: dict[str, tuple[Place, Place]] = field(default_factory=dict)
    sequences: dict[str, tuple[Place, Place]] = field(default_factory=dict)

    def numbers(
        self, code: str, count: int, at: Place, rows: Rows | slice = slice(None)
    ) -> NDArray[np.generic]:
        """Return numbers at ``at`` in M of the messages: (M,) or, for ``count`` > 0, (M, count)."""
        code = ("<" if self.little else ">") + code
        if isinstance(at, int) and isinstance(rows, slice):
            end = at + int(code[2]) * (count or 1)
            if end <= self.heads.shape[1]:
                table: NDArray[np.generic] = self.heads[:, at:end].view(code)
                return table if count else table[:, 0]
        return gather(self.buffer, code, count, self.origin[rows] + at)


def gather(buffer: Bytes, code: str, count: int, place: Int64s) -> NDArray[np.generic]:
    """Return numbers that begin at ``place``, shape (N,) or, for ``count`` > 0, (N, count).

    A view of the buffer with an item at every byte reduces this to one indexing operation.
    """
    dtype = np.dtype(code)
    width = dtype.itemsize * max(count, 1)
    shape = (max(len(buffer) - width + 1, 0), *((count,) if count else ()))
    strides = (1, *((dtype.itemsize,) if count else ()))
    view: NDArray[np.generic] = np.ndarray(shape, dtype, buffer.data, 0, strides)
    return view[place]


@dataclass(slots=True, eq=False)
class Cursor:
    """Positions in some of the messages, relative to the start of each message's body."""

    rows: Rows | slice
    origin: Int64s
    at: Place
    stop: Int64s

    def pick(self, which: Bools) -> Cursor:
        """Return a separate cursor over some of the messages."""
        at = self.at if isinstance(self.at, int) else self.at[which]
        return Cursor(self.some_rows(which), self.origin[which], at, self.stop[which])

    def put_back(self, which: Bools, moved: Cursor) -> None:
        """Copy the positions of a cursor from ``pick``."""
        if isinstance(moved.at, int) and which.all():
            self.at = moved.at
            return
        at = np.array(self.spread(self.at))
        at[which] = moved.at
        self.at = at

    def spread(self, place: Place) -> Int64s:
        """Return a place as one number per message."""
        return np.broadcast_to(np.asarray(place, np.int64), self.stop.shape)

    def some_rows(self, which: Bools) -> Rows:
        """Return the row numbers in the block of some of the messages."""
        return np.flatnonzero(which) if isinstance(self.rows, slice) else self.rows[which]


def heads_of(messages: Messages) -> Bytes:
    """Return the first bytes of all messages, shape (N, K): as many as all of them have."""
    width = int((messages.stop - messages.start).min(initial=HEAD_BYTES))
    if not len(messages) or not width:
        return np.empty((len(messages), 0), np.uint8)
    every = gather(messages.buffer, f"V{width}", 0, messages.start)
    return every.view(np.uint8).reshape(-1, width)


def locate_fields(
    plan: ParsingPlan, messages: Messages, heads: Bytes, *, little: bool = True
) -> FieldPositions:
    """Find every field of every message.

    Args:
        plan: Parsing plan of the messages' type.
        messages: Messages; in CDR with the four bytes of encapsulation, which are ignored here.
        heads: Their first bytes.
        little: True if these messages are little endian.
    """
    head = 4 if plan.is_cdr else 0
    origin, ok = messages.start + head, np.ones(len(messages), np.bool_)
    found = FieldPositions(messages.buffer, origin, little, ok, heads[:, head:])
    Walker(found, plan.is_cdr).whole(plan, Cursor(slice(None), origin, 0, messages.stop - origin))
    return found


@dataclass(slots=True, eq=False)
class Walker:
    """Parser that moves cursors over messages step by step and records positions.

    Attributes:
        found: Positions recorded so far.
        is_cdr: True for CDR, False for ROS 1.
        damaged: True if a message was refused.
        spent: Number of steps inside sequences of items of varying size.
    """

    found: FieldPositions
    is_cdr: bool
    damaged: bool = False
    spent: int = 0

    def whole(self, plan: ParsingPlan, cursor: Cursor) -> None:
        """Parse from the first field to the last, and check that nothing is left over."""
        if not self.found.heads.shape[1]:
            self.refuse(cursor, cursor.stop < 0, "no room for the encapsulation")
        self.steps(plan.steps, cursor, keep=True)
        max_left = CDR_PADDING if plan.is_cdr else 0
        left = cursor.stop - cursor.at
        self.refuse(cursor, left > max_left, "bytes left over after the last field")

    def refuse(self, cursor: Cursor, bad: Bools | bool, why: str) -> None:
        """Mark the messages of ``cursor`` that are ``bad``, unless already marked."""
        if not np.count_nonzero(bad) or not len(cursor.stop):
            return
        bad = np.broadcast_to(bad, cursor.stop.shape)
        ok = self.found.ok
        rows = cursor.some_rows(bad)
        fresh = np.unique(rows[ok[rows]])
        if len(fresh):
            ok[fresh] = False
            self.found.refused.append((fresh, why))
        self.damaged = True
        # A refused message stays at its end, so that nothing is read past it.
        cursor.at = np.where(bad, cursor.stop, cursor.at)

    def _refuse_past(self, cursor: Cursor, what: str) -> None:
        """Refuse messages that end before the cursor; every head is inside its message."""
        if not isinstance(cursor.at, int) or cursor.at > self.found.heads.shape[1]:
            self.refuse(cursor, cursor.at > cursor.stop, f"{what} extends past the end")

    def steps(self, steps: Iterable[Step], cursor: Cursor, *, keep: bool) -> None:
        """Execute all steps; ``keep`` records positions, for fields outside sequences only."""
        for step in steps:
            if isinstance(step, FixedFields):
                self.run(step, cursor, keep)
            elif isinstance(step, Text):
                self.text(step, cursor, keep)
            else:
                self.items(step, cursor, keep)

    def run(self, run: FixedFields, cursor: Cursor, keep: bool) -> None:
        """Advance past fields of fixed size."""
        begin, modulo = cursor.at, _same(cursor.at & 7)
        size = run.size[modulo]
        cursor.at = begin + (int(size) if isinstance(modulo, int) else size)
        self._refuse_past(cursor, run.values[0].path)
        if keep:
            for k, value in enumerate(run.values):
                self.found.places[value.path] = (begin, modulo, run.place[:, k])

    def _length(self, path: str, cursor: Cursor) -> Place:
        """Read the 32-bit length at the cursor; 0 for refused messages."""
        at = (cursor.at + 3) & -4 if self.is_cdr else cursor.at
        cursor.at = at + 4
        self._refuse_past(cursor, path)
        if not self.damaged:
            every = self.found.numbers("u4", 0, at, cursor.rows)
            if isinstance(at, int) and len(every) and not np.count_nonzero(every != every[0]):
                return int(every[0])
            return every.astype(np.int64)
        good = self.found.ok[cursor.rows]
        rows = cursor.some_rows(good)
        lengths = np.zeros(len(good), np.int64)
        lengths[good] = self.found.numbers("u4", 0, cursor.spread(at)[good], rows)
        return lengths

    def text(self, text: Text, cursor: Cursor, keep: bool) -> tuple[Place, Place]:
        """Advance past a string; return its first byte and its length without terminator."""
        length = self._length(text.path, cursor)
        first = cursor.at
        cursor.at = first + length
        self._refuse_past(cursor, f"string {text.path}")
        is_plain = self._is_plain(cursor, first, length)
        if self.is_cdr:
            if not is_plain:
                self._check_terminator(text, cursor, length)
            length = max(length - 1, 0) if isinstance(length, int) else np.maximum(length - 1, 0)
        if text.bound:
            self.refuse(cursor, length > text.bound, f"string {text.path} is over its bound")
        if not is_plain:
            self._check_utf8(text, cursor, first, length)
        if keep:
            self.found.texts[text.path] = (first, length)
        return first, length

    def _is_plain(self, cursor: Cursor, first: Place, length: Place) -> bool:
        """Return whether all messages have ASCII here, which is checked faster, and terminated."""
        if not (
            isinstance(first, int) and isinstance(length, int) and isinstance(cursor.rows, slice)
        ):
            return False
        end, heads = first + length, self.found.heads
        if self.damaged or not length or end + 7 > heads.shape[1]:
            return False
        for at in range(first, end, 8):
            word = np.bitwise_or.reduce(heads[:, at : at + 8].view("<u8")[:, 0])
            if int(word) & _HIGH_BITS & (1 << 8 * (end - at)) - 1:
                return False
        return not (self.is_cdr and np.count_nonzero(heads[:, end - 1]))

    def _check_terminator(self, text: Text, cursor: Cursor, length: Place) -> None:
        good = self.found.ok[cursor.rows]
        bad = good & (length < 1)
        checked = good & ~bad
        last = cursor.origin + cursor.at - 1
        bad[checked] = self.found.buffer[last[checked]] != 0
        self.refuse(cursor, bad, f"string {text.path} has no terminator")

    def _check_utf8(self, text: Text, cursor: Cursor, first: Place, length: Place) -> None:
        good = self.found.ok[cursor.rows]
        begin, length = cursor.origin + first, np.where(good, length, 0)
        bad = good & ~are_utf8(self.found.buffer, begin, length)
        self.refuse(cursor, bad, f"string {text.path} is not UTF-8")

    def items(self, items: Items, cursor: Cursor, keep: bool) -> tuple[Place, Place]:
        """Advance past a sequence; return the position of its first item and its length."""
        count = self._count(items, cursor)
        width = int(items.code[1]) if items.code and self.is_cdr else 1
        if isinstance(count, int):
            # An empty sequence is not followed by its items' alignment.
            cursor.at = -(-cursor.at // width) * width if count else cursor.at
        else:
            cursor.at = np.where(count > 0, -(-cursor.at // width) * width, cursor.at)
        first = cursor.at
        self.contents(items, cursor, count)
        if keep:
            self.found.sequences[items.path] = (first, count)
        return first, count

    def _count(self, items: Items, cursor: Cursor) -> Place:
        count: Place
        if items.count is None:
            count = self._length(items.path, cursor)
            room = cursor.stop - cursor.at
            min_bytes = max(items.item_bytes, 1)
            self.refuse(
                cursor, count * min_bytes > room, f"sequence {items.path} extends past the end"
            )
            if items.bound:
                over = count > items.bound
                self.refuse(cursor, over, f"sequence {items.path} is over its bound")
        else:
            count = items.count
        return np.where(self.found.ok[cursor.rows], count, 0) if self.damaged else count

    def contents(self, items: Items, cursor: Cursor, count: Place) -> None:
        """Advance past the items: all at once if their sizes are known, else one by one."""
        if items.jumps is None:
            self._each(items, cursor, cursor.spread(count))
            return
        if items.code:
            cursor.at = cursor.at + count * int(items.code[1])
        else:
            ends = jumped(items.jumps, np.atleast_1d(cursor.at), np.atleast_1d(count))
            is_same = isinstance(cursor.at, int) and isinstance(count, int)
            cursor.at = int(ends[0]) if is_same else ends
        self._refuse_past(cursor, f"sequence {items.path}")

    def _each(self, items: Items, cursor: Cursor, count: Int64s) -> None:
        """Advance past items of varying size one by one, for all messages in parallel."""
        for i in range(int(count.max(initial=0))):
            active = count > i
            if self.damaged:
                active &= self.found.ok[cursor.rows]
                if not active.any():
                    return
            self.spent += len(items.item)
            if self.spent > MAX_ITEM_STEPS:
                self.refuse(cursor, active, f"{items.path}: over {MAX_ITEM_STEPS} nested items")
                return
            inner = cursor.pick(active)
            self.steps(items.item, inner, keep=False)
            cursor.put_back(active, inner)


def _same(column: Place) -> Place:
    """Return the number if a column is constant, as in most logs, else the column."""
    if isinstance(column, int):
        return column
    if len(column) and (column == column[0]).all():
        return int(column[0])
    return column


def are_utf8(buffer: Bytes, first: Int64s, length: Int64s) -> Bools:
    """Check that ranges of ``buffer`` are UTF-8 text; ranges of one length are checked together."""
    fine = np.ones(len(first), np.bool_)
    for rows, width in group_by_length(length):
        if width == 0:
            continue
        texts = gather(buffer, "u1", width, first[rows])
        # Comparing all bytes at once is faster than row by row, and nearly all text is ASCII.
        for row in rows[texts.max(axis=1) >= 0x80] if texts.max() >= 0x80 else ():
            fine[row] = _is_utf8(buffer[first[row] : first[row] + width].tobytes())
    return fine


def _is_utf8(text: bytes) -> bool:
    try:
        text.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return True


def group_by_length(length: Int64s) -> Iterable[tuple[Rows, int]]:
    """Yield rows grouped by length; nothing is sorted in the usual case of equal lengths."""
    if not len(length):
        return
    low, high = int(length.min()), int(length.max())
    if low == high:
        yield np.arange(len(length)), low
        return
    order = np.argsort(length, kind="stable")
    cuts = np.flatnonzero(np.diff(length[order])) + 1
    for rows in np.split(order, cuts):
        yield rows, int(length[rows[0]])

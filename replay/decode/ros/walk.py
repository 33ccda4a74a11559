"""Parse N messages at once: one position per message, advanced step by step with NumPy.

Every message must be consumed exactly. A message is refused, with the name of the field, if a field
extends past its end, has an implausible length or lacks a terminator, or if bytes are left over.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Bytes, Int64s, Messages
from crosscue.replay.decode.ros.plan import FixedFields, Items, ParsingPlan, Step, Text, jumped

Bools = NDArray[np.bool_]
Rows = NDArray[np.intp]

# Max steps for nested items of varying size in one block, which bounds the time for any log.
MAX_ITEM_STEPS: Final = 50_000
# Max bytes of padding after a CDR message, to a multiple of four.
CDR_PADDING: Final = 3


@dataclass(slots=True, eq=False)
class Refused:
    """Messages that do not fit, all for one reason.

    Attributes:
        rows: Indices of the messages.
        why: Name of the field and the fault.
    """

    rows: Rows
    why: str


@dataclass(slots=True, eq=False)
class FieldPositions:
    """Positions of all fields in N messages of one byte order.

    Attributes:
        buffer: Bytes of all messages.
        little: True if numbers are little endian.
        ok: Shape (N,): True if the message fits; positions of the others are meaningless.
        refused: Reasons of the others.
        places: By path of a value: absolute start of its run (N,), alignment of that start (N,), or
            one number if all are equal, and offset of the value by alignment (8,).
        texts: By path of a string: its first byte (N,) and length without terminator (N,).
        sequences: By path of a sequence: its first item (N,) and length (N,).
    """

    buffer: Bytes
    little: bool
    ok: Bools
    refused: list[Refused] = field(default_factory=list)
    places: dict[str, tuple[Int64s, Int64s | int, Int64s]] = field(default_factory=dict)
    texts: dict[str, tuple[Int64s, Int64s]] = field(default_factory=dict)
    sequences: dict[str, tuple[Int64s, Int64s]] = field(default_factory=dict)


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
    at: Int64s
    stop: Int64s

    def pick(self, which: Bools) -> Cursor:
        """Return a separate cursor over some of the messages."""
        return Cursor(self.some_rows(which), self.origin[which], self.at[which], self.stop[which])

    def put_back(self, which: Bools, moved: Cursor) -> None:
        """Copy the positions of a cursor from ``pick``."""
        self.at[which] = moved.at

    def some_rows(self, which: Bools) -> Rows:
        """Return the row numbers in the block of some of the messages."""
        return np.flatnonzero(which) if isinstance(self.rows, slice) else self.rows[which]


def locate_fields(plan: ParsingPlan, messages: Messages, *, little: bool = True) -> FieldPositions:
    """Find every field of every message.

    Args:
        plan: Parsing plan of the messages' type.
        messages: Messages; in CDR with the four bytes of encapsulation, which are ignored here.
        little: True if these messages are little endian.
    """
    head = 4 if plan.is_cdr else 0
    origin = messages.start + head
    found = FieldPositions(messages.buffer, little, np.ones(len(messages), np.bool_))
    cursor = Cursor(slice(None), origin, np.zeros_like(origin), messages.stop - origin)
    Walker(found, plan.is_cdr).whole(plan, cursor)
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
        self.refuse(cursor, cursor.stop < 0, "no room for the encapsulation")
        self.steps(plan.steps, cursor, keep=True)
        max_left = CDR_PADDING if plan.is_cdr else 0
        left = cursor.stop - cursor.at
        self.refuse(cursor, left > max_left, "bytes left over after the last field")

    def refuse(self, cursor: Cursor, bad: Bools, why: str) -> None:
        """Mark the messages of ``cursor`` that are ``bad``, unless already marked."""
        if not bad.any():
            return
        ok = self.found.ok
        rows = cursor.some_rows(bad)
        fresh = np.unique(rows[ok[rows]])
        if len(fresh):
            ok[fresh] = False
            self.found.refused.append(Refused(fresh, why))
        self.damaged = True
        # A refused message stays at its end, so that nothing is read past it.
        cursor.at[bad] = cursor.stop[bad]

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
        modulo = _same(cursor.at & 7)
        begin = cursor.origin + cursor.at
        cursor.at = cursor.at + run.size[modulo]
        self.refuse(cursor, cursor.at > cursor.stop, f"{run.values[0].path} extends past the end")
        if keep:
            for k, value in enumerate(run.values):
                self.found.places[value.path] = (begin, modulo, run.place[:, k])

    def _length(self, path: str, cursor: Cursor) -> Int64s:
        """Read the 32-bit length at the cursor; 0 for refused messages."""
        at = (cursor.at + 3) & -4 if self.is_cdr else cursor.at
        cursor.at = at + 4
        short = cursor.at > cursor.stop
        self.refuse(cursor, short, f"{path} extends past the end")
        place = cursor.origin + at
        code = "<u4" if self.found.little else ">u4"
        if not self.damaged:
            return gather(self.found.buffer, code, 0, place).astype(np.int64)
        good = self.found.ok[cursor.rows]
        lengths = np.zeros(len(at), np.int64)
        lengths[good] = gather(self.found.buffer, code, 0, place[good])
        return lengths

    def text(self, text: Text, cursor: Cursor, keep: bool) -> tuple[Int64s, Int64s]:
        """Advance past a string; return its first byte and its length without terminator."""
        length = self._length(text.path, cursor)
        first = cursor.origin + cursor.at
        cursor.at = cursor.at + length
        self.refuse(cursor, cursor.at > cursor.stop, f"string {text.path} extends past the end")
        if self.is_cdr:
            length = self._without_terminator(text, cursor, length)
        if text.bound:
            self.refuse(cursor, length > text.bound, f"string {text.path} is over its bound")
        self._check_utf8(text, cursor, first, length)
        if keep:
            self.found.texts[text.path] = (first, length)
        return first, length

    def _without_terminator(self, text: Text, cursor: Cursor, length: Int64s) -> Int64s:
        good = self.found.ok[cursor.rows]
        last = cursor.origin + cursor.at - 1
        bad = good & (length < 1)
        checked = good & ~bad
        bad[checked] = self.found.buffer[last[checked]] != 0
        self.refuse(cursor, bad, f"string {text.path} has no terminator")
        return np.maximum(length - 1, 0)

    def _check_utf8(self, text: Text, cursor: Cursor, first: Int64s, length: Int64s) -> None:
        good = self.found.ok[cursor.rows]
        bad = good & ~are_utf8(self.found.buffer, first, np.where(good, length, 0))
        self.refuse(cursor, bad, f"string {text.path} is not UTF-8")

    def items(self, items: Items, cursor: Cursor, keep: bool) -> tuple[Int64s, Int64s]:
        """Advance past a sequence; return the position of its first item and its length."""
        count = self._count(items, cursor)
        width = int(items.code[1]) if items.code and self.is_cdr else 1
        # An empty sequence is not followed by its items' alignment.
        cursor.at = np.where(count > 0, -(-cursor.at // width) * width, cursor.at)
        first = cursor.origin + cursor.at
        self.contents(items, cursor, count)
        if keep:
            self.found.sequences[items.path] = (first, count)
        return first, count

    def _count(self, items: Items, cursor: Cursor) -> Int64s:
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
            count = np.full(len(cursor.at), items.count, np.int64)
        return np.where(self.found.ok[cursor.rows], count, 0) if self.damaged else count

    def contents(self, items: Items, cursor: Cursor, count: Int64s) -> None:
        """Advance past the items: all at once if their sizes are known, else one by one."""
        if items.jumps is None:
            self._each(items, cursor, count)
            return
        if items.code:
            cursor.at = cursor.at + count * int(items.code[1])
        else:
            cursor.at = jumped(items.jumps, cursor.at, count)
        self.refuse(cursor, cursor.at > cursor.stop, f"sequence {items.path} extends past the end")

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


def _same(column: Int64s) -> Int64s | int:
    """Return the number if a column is constant, as in most logs, else the column."""
    if len(column) and (column == column[0]).all():
        return int(column[0])
    return column


def are_utf8(buffer: Bytes, first: Int64s, length: Int64s) -> Bools:
    """Check that ranges of ``buffer`` are UTF-8 text; ranges of one length are checked together."""
    fine = np.ones(len(first), np.bool_)
    for rows, width in group_by_length(length):
        if width == 0:
            continue
        high = gather(buffer, "u1", width, first[rows]).max(axis=1) >= 0x80
        for row in rows[high]:
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

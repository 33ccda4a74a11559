"""Walks N messages at once: one position per message, moved step by step with NumPy.

Every message must be consumed exactly; what passes its end, holds an implausible length, lacks a
terminator or leaves bytes over is refused with the field at which it happened.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Bytes, Int64s, Messages
from crosscue.replay.decode.ros.plan import Items, Plan, Run, Step, Text, jumped

Bools = NDArray[np.bool_]
Rows = NDArray[np.intp]

MAX_ITEM_STEPS: Final = 50_000
"""Steps that nested items of varying size may take in one block, so that no log can hang us."""
CDR_PADDING: Final = 3
"""Bytes that may follow a CDR message to fill it up to a multiple of four."""


@dataclass(slots=True, eq=False)
class Refused:
    """Messages that do not fit, all for one cause.

    Attributes:
        rows: Which.
        why: The field and what is wrong with it.
    """

    rows: Rows
    why: str


@dataclass(slots=True, eq=False)
class Found:
    """Where everything is in N messages of one byte order.

    Attributes:
        buffer: All bytes.
        little: Numbers are little endian.
        ok: Shape (N,): the message fits; places of others mean nothing.
        refused: Why not.
        places: From a value's path to its run's absolute begin (N,), that begin's alignment
            (N,), or one number where all are equal, and the value's offset by alignment (8,).
        texts: From a string's path to its first byte (N,) and length without terminator (N,).
        sequences: From a sequence's path to its first item (N,) and length (N,).
    """

    buffer: Bytes
    little: bool
    ok: Bools
    refused: list[Refused] = field(default_factory=list)
    places: dict[str, tuple[Int64s, Int64s | int, Int64s]] = field(default_factory=dict)
    texts: dict[str, tuple[Int64s, Int64s]] = field(default_factory=dict)
    sequences: dict[str, tuple[Int64s, Int64s]] = field(default_factory=dict)


def gather(buffer: Bytes, code: str, count: int, place: Int64s) -> NDArray[np.generic]:
    """Numbers that begin at ``place``, shape (N,) or, for ``count`` > 0, (N, count).

    A view of the buffer that has an item at every byte turns this into one indexing.
    """
    dtype = np.dtype(code)
    width = dtype.itemsize * max(count, 1)
    shape = (max(len(buffer) - width + 1, 0), *((count,) if count else ()))
    strides = (1, *((dtype.itemsize,) if count else ()))
    view: NDArray[np.generic] = np.ndarray(shape, dtype, buffer.data, 0, strides)
    return view[place]


@dataclass(slots=True, eq=False)
class Cursor:
    """Positions of some of the messages, relative to where each one's body begins."""

    rows: Rows | slice
    origin: Int64s
    at: Int64s
    stop: Int64s

    def pick(self, which: Bools) -> Cursor:
        """A cursor of its own over some of the messages."""
        return Cursor(self.some_rows(which), self.origin[which], self.at[which], self.stop[which])

    def put_back(self, which: Bools, moved: Cursor) -> None:
        """Take over where a cursor from ``pick`` has come to."""
        self.at[which] = moved.at

    def some_rows(self, which: Bools) -> Rows:
        """Numbers in the block of some of the messages."""
        return np.flatnonzero(which) if isinstance(self.rows, slice) else self.rows[which]


def walk(plan: Plan, messages: Messages, *, little: bool = True) -> Found:
    """Find every field of every message.

    Args:
        plan: For the messages' type.
        messages: For CDR with the four bytes of encapsulation, which are not examined here.
        little: Byte order of these messages.
    """
    head = 4 if plan.is_cdr else 0
    origin = messages.start + head
    found = Found(messages.buffer, little, np.ones(len(messages), np.bool_))
    cursor = Cursor(slice(None), origin, np.zeros_like(origin), messages.stop - origin)
    Walker(found, plan.is_cdr).whole(plan, cursor)
    return found


@dataclass(slots=True, eq=False)
class Walker:
    """Moves cursors over messages step by step, and keeps what it finds.

    Attributes:
        found: Filled as it goes.
        is_cdr: CDR, else ROS 1.
        damaged: Some message has been refused.
        spent: Steps taken inside sequences of items of varying size.
    """

    found: Found
    is_cdr: bool
    damaged: bool = False
    spent: int = 0

    def whole(self, plan: Plan, cursor: Cursor) -> None:
        """Walk from the first field to the last and see that nothing is left over."""
        self.refuse(cursor, cursor.stop < 0, "no room for the encapsulation")
        self.steps(plan.steps, cursor, keep=True)
        max_left = CDR_PADDING if plan.is_cdr else 0
        left = cursor.stop - cursor.at
        self.refuse(cursor, left > max_left, "bytes left over after the last field")

    def refuse(self, cursor: Cursor, bad: Bools, why: str) -> None:
        """Mark the messages of ``cursor`` that are ``bad``, unless they were already."""
        if not bad.any():
            return
        ok = self.found.ok
        rows = cursor.some_rows(bad)
        fresh = np.unique(rows[ok[rows]])
        if len(fresh):
            ok[fresh] = False
            self.found.refused.append(Refused(fresh, why))
        self.damaged = True
        # A refused message stays parked at its end: nothing is read behind it.
        cursor.at[bad] = cursor.stop[bad]

    def steps(self, steps: Iterable[Step], cursor: Cursor, *, keep: bool) -> None:
        """Take all steps; ``keep`` the places, which only fields outside sequences have."""
        for step in steps:
            if isinstance(step, Run):
                self.run(step, cursor, keep)
            elif isinstance(step, Text):
                self.text(step, cursor, keep)
            else:
                self.items(step, cursor, keep)

    def run(self, run: Run, cursor: Cursor, keep: bool) -> None:
        """Pass fields of fixed size."""
        modulo = _same(cursor.at & 7)
        begin = cursor.origin + cursor.at
        cursor.at = cursor.at + run.size[modulo]
        self.refuse(cursor, cursor.at > cursor.stop, f"{run.values[0].path} passes the end")
        if keep:
            for k, value in enumerate(run.values):
                self.found.places[value.path] = (begin, modulo, run.place[:, k])

    def _length(self, path: str, cursor: Cursor) -> Int64s:
        """Read the 32-bit length at the cursor; 0 for messages refused."""
        at = (cursor.at + 3) & -4 if self.is_cdr else cursor.at
        cursor.at = at + 4
        short = cursor.at > cursor.stop
        self.refuse(cursor, short, f"{path} passes the end")
        place = cursor.origin + at
        code = "<u4" if self.found.little else ">u4"
        if not self.damaged:
            return gather(self.found.buffer, code, 0, place).astype(np.int64)
        good = self.found.ok[cursor.rows]
        lengths = np.zeros(len(at), np.int64)
        lengths[good] = gather(self.found.buffer, code, 0, place[good])
        return lengths

    def text(self, text: Text, cursor: Cursor, keep: bool) -> tuple[Int64s, Int64s]:
        """Pass a string; its first byte and its length without terminator come back."""
        length = self._length(text.path, cursor)
        first = cursor.origin + cursor.at
        cursor.at = cursor.at + length
        self.refuse(cursor, cursor.at > cursor.stop, f"string {text.path} passes the end")
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
        """Pass a sequence; its first item's place and the number of items come back."""
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
            self.refuse(cursor, count * min_bytes > room, f"sequence {items.path} passes the end")
            if items.bound:
                over = count > items.bound
                self.refuse(cursor, over, f"sequence {items.path} is over its bound")
        else:
            count = np.full(len(cursor.at), items.count, np.int64)
        return np.where(self.found.ok[cursor.rows], count, 0) if self.damaged else count

    def contents(self, items: Items, cursor: Cursor, count: Int64s) -> None:
        """Pass the items: all at once where their sizes are known, else one by one."""
        if items.jumps is None:
            self._each(items, cursor, count)
            return
        if items.code:
            cursor.at = cursor.at + count * int(items.code[1])
        else:
            cursor.at = jumped(items.jumps, cursor.at, count)
        self.refuse(cursor, cursor.at > cursor.stop, f"sequence {items.path} passes the end")

    def _each(self, items: Items, cursor: Cursor, count: Int64s) -> None:
        """Pass items of varying size one by one, all messages that still have one at a time."""
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
    """The one number that a column repeats, or the column: most logs repeat one layout."""
    if len(column) and (column == column[0]).all():
        return int(column[0])
    return column


def are_utf8(buffer: Bytes, first: Int64s, length: Int64s) -> Bools:
    """Is each range of ``buffer`` UTF-8 text? Ranges of one length are examined together."""
    fine = np.ones(len(first), np.bool_)
    for rows, width in by_length(length):
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


def by_length(length: Int64s) -> Iterable[tuple[Rows, int]]:
    """Rows grouped by their length; nothing is sorted when all are equal, as they mostly are."""
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

"""Fast path for messages that repeat one layout, as most messages of a topic do.

The messages of a block need not be parsed if they all have the length of an earlier message, and
agree with it in all lengths of strings and sequences and in all strings. Every field is then at the
same position. Messages that end in a sequence of bytes (pictures) may differ in length, because the
part before those bytes repeats.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Bytes, Int64s, Messages
from crosscue.replay.decode.ros.plan import FixedFields, Items, ParsingPlan, Step, Text
from crosscue.replay.decode.ros.walk import Bools

# Max size of a message for this path; longer messages are few, and copying them costs more than
# parsing them.
MAX_BYTES: Final = 4096
# Number of bytes compared at once.
PROBE: Final = 8
MAX_ITEMS: Final = 64
LAYOUTS_KEPT: Final = 16


@dataclass(frozen=True, slots=True)
class MessageLayout:
    """Positions of all fields in a message, counted from its first byte.

    Attributes:
        raw: The message that the layout comes from, without the bytes at its end.
        places: First byte of each value.
        texts: First byte and length of each string.
        sequences: First byte of the items, and number of items.
        probes: Places where another message must agree with ``raw``: first of ``PROBE`` bytes,
            mask of the bits that count, and their values.
        tail: Path of the bytes at the end, whose number is in the last four bytes of ``raw``;
            empty if all messages have one length.
    """

    raw: bytes
    places: Mapping[str, int]
    texts: Mapping[str, tuple[int, int]]
    sequences: Mapping[str, tuple[int, int]]
    probes: tuple[tuple[int, np.uint64, np.uint64], ...]
    tail: str = ""


def tail_of(plan: ParsingPlan) -> str:
    """Return the path of the bytes at the end of a type; empty if it does not end in bytes."""
    last = plan.steps[-1] if plan.steps else None
    if not isinstance(last, Items) or last.count is not None or last.bound:
        return ""
    return last.path if last.code in ("u1", "i1") else ""


def layout_of(plan: ParsingPlan, raw: bytes) -> MessageLayout | None:
    """Return the layout of a little-endian message that was parsed without error.

    It is None for a message that is tiny or long, or that has many items of varying size.

    Args:
        plan: Parsing plan of its type.
        raw: The message; for a type with a tail, its first ``MAX_BYTES`` bytes suffice.
    """
    tail = tail_of(plan)
    if len(raw) < PROBE or len(raw) > MAX_BYTES:
        return None
    reading = _Reading(raw, 4 if plan.is_cdr else 0, plan.is_cdr)
    if plan.is_cdr:
        reading.fixed.append((0, 2))
    reading.steps(plan.steps[:-1] if tail else plan.steps, keep=True)
    if reading.items > MAX_ITEMS:
        return None
    if tail:
        fixed = tuple(reading.fixed)
        reading.take_length()
        size = reading.head + reading.at
        if not PROBE <= size <= len(raw):
            return None
        raw, reading.fixed = raw[:size], list(fixed)
        reading.sequences[tail] = (size, 0)
    return MessageLayout(
        raw,
        reading.places,
        reading.texts,
        reading.sequences,
        tuple(_probes(raw, reading.fixed)),
        tail,
    )


@dataclass(slots=True)
class _Reading:
    """A message that is read field by field."""

    raw: bytes
    head: int
    is_cdr: bool
    at: int = 0
    items: int = 0
    places: dict[str, int] = field(default_factory=dict)
    texts: dict[str, tuple[int, int]] = field(default_factory=dict)
    sequences: dict[str, tuple[int, int]] = field(default_factory=dict)
    fixed: list[tuple[int, int]] = field(default_factory=list)

    def steps(self, steps: tuple[Step, ...], *, keep: bool) -> None:
        """Execute all steps; ``keep`` records the positions."""
        for step in steps:
            if isinstance(step, FixedFields):
                self._run(step, keep)
            elif isinstance(step, Text):
                self._text(step, keep)
            else:
                self._sequence(step, keep)

    def _run(self, run: FixedFields, keep: bool) -> None:
        modulo = self.at & 7
        if keep:
            for k, value in enumerate(run.values):
                self.places[value.path] = self.head + self.at + int(run.place[modulo, k])
        self.at += int(run.size[modulo])

    def take_length(self) -> int:
        """Read a 32-bit length."""
        if self.is_cdr:
            self.at = (self.at + 3) & -4
        begin = self.head + self.at
        self.at += 4
        self.fixed.append((begin, begin + 4))
        return int.from_bytes(self.raw[begin : begin + 4], "little")

    def _text(self, text: Text, keep: bool) -> None:
        length = self.take_length()
        begin = self.head + self.at
        self.at += length
        self.fixed.append((begin, begin + length))
        if keep:
            self.texts[text.path] = (begin, length - 1 if self.is_cdr else length)

    def _sequence(self, items: Items, keep: bool) -> None:
        count = self.take_length() if items.count is None else items.count
        if count and items.code and self.is_cdr:
            width = int(items.code[1])
            self.at = -(-self.at // width) * width
        if keep:
            self.sequences[items.path] = (self.head + self.at, count)
        if items.jumps is not None:
            for k in range(count.bit_length()):
                if count >> k & 1:
                    self.at += int(items.jumps[k][self.at & 7])
            return
        self.items += count
        for _ in range(count):
            if self.items > MAX_ITEMS:
                return
            self.steps(items.item, keep=False)


def _probes(
    raw: bytes, ranges: list[tuple[int, int]]
) -> Iterator[tuple[int, np.uint64, np.uint64]]:
    """Yield the fewest probes that cover all ranges, which are in order."""
    left = [at for begin, end in ranges for at in range(begin, end)]
    while left:
        begin = min(left[0], len(raw) - PROBE)
        covered = [at - begin for at in left if at < begin + PROBE]
        left = left[len(covered) :]
        mask = bytes(0xFF if k in covered else 0 for k in range(PROBE))
        want = bytes(a & b for a, b in zip(raw[begin : begin + PROBE], mask, strict=True))
        yield (
            begin,
            np.uint64(int.from_bytes(mask, "little")),
            np.uint64(int.from_bytes(want, "little")),
        )


def repeats(layout: MessageLayout, messages: Messages) -> Bytes | None:
    """Return messages as rows, shape (N, len(``layout.raw``)), if all repeat it; else None.

    Args:
        layout: Layout of a message of the same length, or with a tail.
        messages: At least one message.
    """
    size = len(layout.raw)
    sizes = messages.stop - messages.start
    if layout.tail:
        if np.minimum.reduce(sizes) < size:
            return None
    elif np.count_nonzero(sizes != size):
        return None
    every: NDArray[np.void] = np.ndarray(
        (len(messages.buffer) - size + 1,), f"V{size}", messages.buffer.data, strides=(1,)
    )
    rows = every[messages.start].view(np.uint8).reshape(-1, size)
    for begin, mask, want in layout.probes:
        found = rows[:, begin : begin + PROBE].view("<u8")[:, 0]
        if np.count_nonzero(found & mask != want):
            return None
    return rows


def tail_counts(
    layout: MessageLayout, rows: Bytes, messages: Messages, padding: int
) -> Int64s | None:
    """Return the bytes in each message's tail, shape (N,), if they fill the messages; else None.

    Args:
        layout: Layout with a tail.
        rows: Rows from ``repeats``.
        messages: The messages passed to ``repeats``.
        padding: Max number of bytes left over.
    """
    counts = rows[:, -4:].view("<u4")[:, 0].astype(np.int64)
    left = messages.stop - messages.start - len(layout.raw) - counts
    fits = np.minimum.reduce(left) >= 0 and np.maximum.reduce(left) <= padding
    return counts if fits else None


@dataclass(slots=True, eq=False)
class RepeatedFields:
    """Columns of messages that repeat one layout; see ``fields.Fields``.

    Attributes:
        plan: Parsing plan of their type.
        layout: Their layout.
        rows: Bytes of the messages, shape (M, bytes of one message).
        buffer: Bytes of all messages.
        start: Shape (M,): first byte of each message.
        counts: Shape (M,): bytes in each message's tail; None without a tail.
        seen: Numbers decoded so far.
    """

    plan: ParsingPlan
    layout: MessageLayout
    rows: Bytes
    buffer: Bytes
    start: Int64s
    counts: Int64s | None = None
    seen: dict[str, NDArray[np.generic]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.rows)

    def number(self, path: str) -> NDArray[np.generic]:
        """Return values at ``path``: shape (M,), or (M, k) for an array of k."""
        if path not in self.seen:
            self.seen[path] = self._number(path)
        return self.seen[path]

    def _number(self, path: str) -> NDArray[np.generic]:
        value = self.plan.values[path]
        at = self.layout.places[path]
        if value.code in ("time", "duration"):
            return self._nanoseconds(at, value.code)
        got = self._view(at, "<" + value.code, max(value.count, 1))
        if not value.count:
            got = got[:, 0]
        return got != 0 if value.is_bool else got.copy()

    def _view(self, at: int, code: str, count: int) -> NDArray[np.generic]:
        raw = self.rows[:, at : at + int(code[2]) * count]
        view: NDArray[np.generic] = raw.view(code)
        return view

    def _nanoseconds(self, at: int, code: str) -> Int64s:
        signed = self.plan.is_cdr or code == "duration"
        whole = self._view(at, "<i4" if signed else "<u4", 1)[:, 0].astype(np.int64)
        is_signed_rest = not self.plan.is_cdr and code == "duration"
        rest = self._view(at + 4, "<i4" if is_signed_rest else "<u4", 1)[:, 0]
        return whole * 1_000_000_000 + rest.astype(np.int64)

    def text_ranges(self, path: str) -> tuple[Int64s, Int64s]:
        """Return first byte and length of the string at ``path``."""
        begin, length = self.layout.texts[path]
        return self.start + begin, np.full(len(self), length, np.int64)

    def texts(self, path: str) -> tuple[str, ...]:
        """Return strings at ``path``, which are all equal."""
        begin, length = self.layout.texts[path]
        return (self.layout.raw[begin : begin + length].decode("utf-8"),) * len(self)

    def items(self, path: str) -> tuple[Int64s, Int64s]:
        """Return first byte and number of items of the sequence at ``path``."""
        begin, count = self.layout.sequences[path]
        if path == self.layout.tail and self.counts is not None:
            return self.start + begin, self.counts
        return self.start + begin, np.full(len(self), count, np.int64)

    def padded(self, path: str, width: int) -> NDArray[np.float64]:
        """Return sequences of numbers as shape (M, k), k <= ``width``."""
        assert path != self.layout.tail, "the bytes at the end are a range, not numbers"
        begin, count = self.layout.sequences[path]
        code = "<" + self.plan.sequences[path].code
        return self._view(begin, code, count)[:, :width].astype(np.float64)

    def take(self, keep: Bools) -> RepeatedFields:
        """Return the selected messages."""
        if keep.all():
            return self
        counts = None if self.counts is None else self.counts[keep]
        return RepeatedFields(
            self.plan, self.layout, self.rows[keep], self.buffer, self.start[keep], counts
        )

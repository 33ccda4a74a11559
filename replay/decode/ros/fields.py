"""Values of parsed messages, decoded on demand."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.decode.ros.plan import ParsingPlan, Value
from crosscue.replay.decode.ros.walk import Bools, FieldPositions, Place, Rows

Scalar = TypeVar("Scalar", bound=np.generic)


@dataclass(slots=True, eq=False)
class MessageBatch:
    """Messages of one byte order.

    Attributes:
        found: Positions of their fields.
        rows: Shape (M,): indices of the messages that fit.
    """

    found: FieldPositions
    rows: Rows


@dataclass(slots=True, eq=False)
class FieldColumns:
    """Columns of parsed messages.

    Attributes:
        plan: Parsing plan of their type.
        buffer: Bytes of all messages.
        parts: Messages by byte order; nearly always one part.
        order: Permutation from the concatenated rows of all parts to the block's order.
        seen: Numbers decoded so far.
        ranges: Strings and sequences located so far.
    """

    plan: ParsingPlan
    buffer: NDArray[np.uint8]
    parts: tuple[MessageBatch, ...]
    order: Rows | None
    seen: dict[str, NDArray[np.generic]] = field(default_factory=dict)
    ranges: dict[str, tuple[NDArray[np.int64], NDArray[np.int64]]] = field(default_factory=dict)

    def __len__(self) -> int:
        return sum(len(part.rows) for part in self.parts)

    def number(self, path: str) -> NDArray[np.generic]:
        """Return values at ``path`` in native byte order: shape (M,), or (M, k) for arrays of k.

        Times and durations are int64 nanoseconds.
        """
        if path not in self.seen:
            value, is_cdr = self.plan.values[path], self.plan.is_cdr
            self.seen[path] = self._joined(lambda part: _numbers(part, value, is_cdr=is_cdr))
        return self.seen[path]

    def texts(self, path: str) -> tuple[str, ...]:
        """Return strings at ``path``; runs of equal strings share one object."""
        first, length = self._ranges(path, lambda found: found.texts)
        out: list[str] = []
        last, text = b"", ""
        for begin, size in zip(first.tolist(), length.tolist(), strict=True):
            raw = self.buffer[begin : begin + size].tobytes()
            if raw != last:
                last, text = raw, raw.decode("utf-8")
            out.append(text)
        return tuple(out)

    def items(self, path: str) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return first byte and number of items of the sequence at ``path``, each of shape (M,)."""
        return self._ranges(path, lambda found: found.sequences)

    def _ranges(
        self, path: str, of: Callable[[FieldPositions], Mapping[str, tuple[Place, Place]]]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        def first(part: MessageBatch) -> NDArray[np.int64]:
            return part.found.origin[part.rows] + _of(of(part.found)[path][0], part.rows)

        def length(part: MessageBatch) -> NDArray[np.int64]:
            return _spread(of(part.found)[path][1], part.rows)

        if path not in self.ranges:
            self.ranges[path] = self._joined(first), self._joined(length)
        return self.ranges[path]

    def padded(self, path: str, width: int) -> NDArray[np.float64]:
        """Return sequences of numbers as shape (M, k), k <= ``width``, padded with NaN."""
        code = self.plan.sequences[path].code

        def of(part: MessageBatch) -> NDArray[np.generic]:
            first, count = part.found.sequences[path]
            counts = _spread(count, part.rows)
            out = np.full((len(part.rows), width), np.nan)
            for k in range(min(int(counts.max(initial=0)), width)):
                has = counts > k
                rows = part.rows[has]
                place = _of(first, rows) + k * int(code[1])
                out[has, k] = part.found.numbers(code, 0, place, rows)
            return out

        _, count = self.items(path)
        joined = self._joined(of).astype(np.float64, copy=False)
        return joined[:, : min(int(count.max(initial=0)), width)]

    def _joined(self, of: Callable[[MessageBatch], NDArray[Scalar]]) -> NDArray[Scalar]:
        if len(self.parts) == 1:
            return of(self.parts[0])
        joined = np.concatenate([of(part) for part in self.parts])
        return joined if self.order is None else joined[self.order]

    def take(self, keep: Bools) -> FieldColumns:
        """Return the selected messages."""
        if keep.all():
            return self
        if self.order is not None:
            inverse = np.argsort(self.order)
            keep = keep[inverse]
        parts, at = [], 0
        for part in self.parts:
            size = len(part.rows)
            parts.append(MessageBatch(part.found, part.rows[keep[at : at + size]]))
            at += size
        order = None
        if self.order is not None:
            order = np.argsort(inverse[keep])
        return FieldColumns(self.plan, self.buffer, tuple(parts), order)


def _of(place: Place, rows: Rows | slice) -> Place:
    return place if isinstance(place, int) else place[rows]


def _spread(place: Place, rows: Rows) -> NDArray[np.int64]:
    return np.full(len(rows), place, np.int64) if isinstance(place, int) else place[rows]


def _numbers(part: MessageBatch, value: Value, *, is_cdr: bool) -> NDArray[np.generic]:
    found = part.found
    begin, modulo, offsets = found.places[value.path]
    rows: Rows | slice = slice(None) if len(part.rows) == len(found.ok) else part.rows
    offset = int(offsets[modulo]) if isinstance(modulo, int) else offsets[modulo[rows]]
    place = _of(begin, rows) + offset
    if value.code in ("time", "duration"):
        return _nanoseconds(found, place, rows, value.code, is_cdr=is_cdr)
    got = found.numbers(value.code, value.count, place, rows)
    # Always a copy: a view of a table of messages would keep them all.
    return got.astype(np.bool_ if value.is_bool else value.code)


def _nanoseconds(
    found: FieldPositions, place: Place, rows: Rows | slice, code: str, *, is_cdr: bool
) -> NDArray[np.int64]:
    """Decode times: only ROS 1 seconds are unsigned, only ROS 1 durations have signed fractions."""
    seconds = "i4" if is_cdr or code == "duration" else "u4"
    rest = "i4" if not is_cdr and code == "duration" else "u4"
    whole = found.numbers(seconds, 0, place, rows).astype(np.int64)
    whole *= 1_000_000_000
    whole += found.numbers(rest, 0, place + 4, rows).astype(np.int64)
    return whole

"""Values of parsed messages, decoded on demand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.decode.ros.plan import ParsingPlan, Value
from crosscue.replay.decode.ros.walk import Bools, FieldPositions, Rows, gather


@dataclass(slots=True, eq=False)
class MessageBatch:
    """Messages of one byte order.

    Attributes:
        found: Positions of their fields.
        rows: Shape (M,): indices of the messages that fit.
    """

    found: FieldPositions
    rows: Rows


class FieldColumns(Protocol):
    """Columns of the M messages that fit their definition."""

    @property
    def plan(self) -> ParsingPlan:
        """Parsing plan of their type."""
        ...

    @property
    def buffer(self) -> NDArray[np.uint8]:
        """Bytes of all messages, which positions refer to."""
        ...

    def __len__(self) -> int: ...

    def number(self, path: str) -> NDArray[np.generic]:
        """Return values at ``path`` in native byte order: shape (M,), or (M, k) for arrays of k.

        Times and durations are int64 nanoseconds.
        """
        ...

    def texts(self, path: str) -> tuple[str, ...]:
        """Return strings at ``path``."""
        ...

    def items(self, path: str) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return first byte and number of items of the sequence at ``path``, each of shape (M,)."""
        ...

    def padded(self, path: str, width: int) -> NDArray[np.float64]:
        """Return sequences of numbers as shape (M, k), k <= ``width``, padded with NaN."""
        ...

    def take(self, keep: Bools) -> Self:
        """Return the selected messages."""
        ...


@dataclass(slots=True, eq=False)
class WalkedFields:
    """Columns of parsed messages.

    Attributes:
        plan: Parsing plan of their type.
        buffer: Bytes of all messages.
        parts: Messages by byte order; nearly always one part.
        order: Permutation from the concatenated rows of all parts to the block's order.
        seen: Numbers decoded so far.
    """

    plan: ParsingPlan
    buffer: NDArray[np.uint8]
    parts: tuple[MessageBatch, ...]
    order: Rows | None
    seen: dict[str, NDArray[np.generic]] = field(default_factory=dict)

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

    def text_ranges(self, path: str) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return first byte and length of the string at ``path``, each of shape (M,)."""
        first = self._joined(lambda part: part.found.texts[path][0][part.rows])
        length = self._joined(lambda part: part.found.texts[path][1][part.rows])
        return first.astype(np.int64, copy=False), length.astype(np.int64, copy=False)

    def texts(self, path: str) -> tuple[str, ...]:
        """Return strings at ``path``; runs of equal strings share one object."""
        first, length = self.text_ranges(path)
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
        first = self._joined(lambda part: part.found.sequences[path][0][part.rows])
        count = self._joined(lambda part: part.found.sequences[path][1][part.rows])
        return first.astype(np.int64, copy=False), count.astype(np.int64, copy=False)

    def padded(self, path: str, width: int) -> NDArray[np.float64]:
        """Return sequences of numbers as shape (M, k), k <= ``width``, padded with NaN."""
        code = self.plan.sequences[path].code

        def of(part: MessageBatch) -> NDArray[np.generic]:
            first, count = (each[part.rows] for each in part.found.sequences[path])
            out = np.full((len(first), width), np.nan)
            for k in range(min(int(count.max(initial=0)), width)):
                has = count > k
                place = first[has] + k * int(code[1])
                out[has, k] = gather(part.found.buffer, _ordered(code, part.found), 0, place)
            return out

        _, count = self.items(path)
        joined = self._joined(of).astype(np.float64, copy=False)
        return joined[:, : min(int(count.max(initial=0)), width)]

    def _joined(self, of: Callable[[MessageBatch], NDArray[np.generic]]) -> NDArray[np.generic]:
        if len(self.parts) == 1:
            return of(self.parts[0])
        joined = np.concatenate([of(part) for part in self.parts])
        return joined if self.order is None else joined[self.order]

    def take(self, keep: Bools) -> WalkedFields:
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
        return WalkedFields(self.plan, self.buffer, tuple(parts), order)


def _ordered(code: str, found: FieldPositions) -> str:
    return ("<" if found.little else ">") + code


def _numbers(part: MessageBatch, value: Value, *, is_cdr: bool) -> NDArray[np.generic]:
    found = part.found
    begin, modulo, offsets = found.places[value.path]
    if len(part.rows) != len(found.ok):
        begin = begin[part.rows]
        modulo = modulo if isinstance(modulo, int) else modulo[part.rows]
    place = begin + offsets[modulo]
    if value.code in ("time", "duration"):
        return _nanoseconds(found, place, value.code, is_cdr=is_cdr)
    got = gather(found.buffer, _ordered(value.code, found), value.count, place)
    if value.is_bool:
        return got.astype(np.bool_)
    return got if found.little else got.astype(value.code)


def _nanoseconds(
    found: FieldPositions, place: NDArray[np.int64], code: str, *, is_cdr: bool
) -> NDArray[np.int64]:
    """Decode times: only ROS 1 seconds are unsigned, only ROS 1 durations have signed fractions."""
    seconds = "i4" if is_cdr or code == "duration" else "u4"
    rest = "i4" if not is_cdr and code == "duration" else "u4"
    whole = gather(found.buffer, _ordered(seconds, found), 0, place).astype(np.int64)
    fraction = gather(found.buffer, _ordered(rest, found), 0, place + 4).astype(np.int64)
    return whole * 1_000_000_000 + fraction

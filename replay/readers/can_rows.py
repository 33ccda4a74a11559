"""Functions shared by all readers of CAN logs: bus names, and division of rows by bus."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.base import Selection
from crosscue.replay.columns import BLOCK_ROWS, Block, CanFrames, Int64s, Topic
from crosscue.replay.ledger import Ledger

# Maximum number of buses of a log; more names are a sign of damage.
BUSES_MAX: Final = 256
TOO_MANY_BUSES: Final = "more buses than a log can have"

# Number of payload bytes by DLC code (ISO 11898-1).
FD_LENGTHS: Final = np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64], np.int64)
# True for numbers of payload bytes that a CAN FD frame can have.
IS_FD_LENGTH: Final = np.isin(np.arange(65), FD_LENGTHS)


def keep_memory() -> None:
    """Make the C library keep freed memory of this size for reuse.

    glibc raises its thresholds when a large block is freed. Otherwise every chunk's short-lived
    columns are mapped and cleared again, which takes a quarter of the reading time.
    """
    np.empty(31 << 20, np.uint8)


def bus_name(spelled: str) -> str:
    """Return the topic name of a bus: as in the log, but ``can/1`` for the bare number ``1``."""
    return f"can/{int(spelled)}" if spelled.isascii() and spelled.isdigit() else spelled


def bus_number(spelled: str, names: dict[str, int]) -> int:
    """Return a bus's index in ``names`` and add new names; -1 if there are ``BUSES_MAX``."""
    name = bus_name(spelled)
    if name not in names and len(names) >= BUSES_MAX:
        return -1
    return names.setdefault(name, len(names))


def named_buses(rows: FrameRows, names: dict[str, int]) -> FrameRows:
    """Replace channel numbers by indices in ``names``; rows of too many buses are left out."""
    if not len(rows):
        return rows
    if rows.bus.min() >= 0 and rows.bus.max() < BUSES_MAX:
        seen, codes = np.flatnonzero(np.bincount(rows.bus)), rows.bus
        numbers = np.zeros(BUSES_MAX, np.int64)
        numbers[seen] = [bus_number(str(channel), names) for channel in seen.tolist()]
    else:
        seen, codes = np.unique(rows.bus, return_inverse=True)
        numbers = np.array([bus_number(str(channel), names) for channel in seen.tolist()])
    named = replace(rows, bus=numbers.take(codes))
    return named.take(named.bus >= 0) if bool((numbers < 0).any()) else named


def bus_topic(name: str, declared: int | None = None) -> Topic:
    """Return the topic of a bus."""
    return Topic(name, "crosscue/CanFrames", "columns", declared=declared)


@dataclass(frozen=True, slots=True, eq=False)
class FrameRows:
    """N frames of several buses, in stored order.

    Attributes:
        place: Shape (N,), int64, ascending: line in its chunk, or byte offset.
        bus: Shape (N,), int64: index into the reader's bus names.
        log_ns: Shape (N,), int64: log times.
        frames: N frames.
    """

    place: Int64s
    bus: Int64s
    log_ns: Int64s
    frames: CanFrames

    def __len__(self) -> int:
        return len(self.place)

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_] | slice) -> FrameRows:
        """Return the selected rows."""
        if isinstance(index, np.ndarray) and index.dtype == np.bool_:
            index = np.flatnonzero(index)
        return FrameRows(
            self.place[index], self.bus[index], self.log_ns[index], self.frames.take(index)
        )


_NONE: Final = np.zeros(0, np.int64)
_NO_FLAGS, _NO_BYTES = np.zeros(0, np.bool_), np.zeros((0, 8), np.uint8)
NO_ROWS: Final = FrameRows(
    _NONE,
    _NONE,
    _NONE,
    CanFrames(
        _NONE.astype(np.uint32), _NO_FLAGS, _NO_BYTES[:, 0], _NO_BYTES[:, 0], _NO_BYTES, _NO_FLAGS
    ),
)


def merge_rows(all_rows: Sequence[FrameRows]) -> FrameRows:
    """Merge one or more groups of rows by place."""
    some = [rows for rows in all_rows if len(rows)] or [all_rows[0]]
    if len(some) == 1:
        return some[0]
    parts = [rows.frames for rows in some]
    width = max(one.data.shape[1] for one in parts)
    parts = [replace(one, data=widened(one.data, width)) for one in parts]
    joined: dict[str, NDArray[Any]] = {}
    for name in (column.name for column in fields(CanFrames)):
        columns = [getattr(one, name) for one in parts]
        if all(column is not None for column in columns):
            joined[name] = np.concatenate(columns)
    rows = FrameRows(
        np.concatenate([rows.place for rows in some]),
        np.concatenate([rows.bus for rows in some]),
        np.concatenate([rows.log_ns for rows in some]),
        CanFrames(**joined),
    )
    return rows.take(np.argsort(rows.place, kind="stable"))


def merged_by_time(streams: Sequence[Iterator[FrameRows]]) -> Iterator[FrameRows]:
    """Merge several streams of rows by time and keep the order within each stream.

    Only the next rows of each stream are in memory. A stream whose clock was set back also keeps
    its own order.
    """
    if len(streams) == 1:
        yield from streams[0]
        return
    held = [_next_by_time(stream) for stream in streams]
    while any(rows is not None for rows in held):
        horizon = min(int(rows.place[-1]) for rows in held if rows is not None)
        ready = []
        for k, rows in enumerate(held):
            if rows is None:
                continue
            count = int(np.searchsorted(rows.place, horizon, side="right"))
            if count:
                ready.append(rows.take(slice(0, count)))
            held[k] = rows.take(slice(count, None))
            if count == len(rows):
                held[k] = _next_by_time(streams[k], rows)
        yield merge_rows(ready)


def _next_by_time(stream: Iterator[FrameRows], before: FrameRows | None = None) -> FrameRows | None:
    """Return the stream's next rows, with places from their times; None at its end."""
    for rows in stream:
        if len(rows):
            place = rows.log_ns
            if bool((place[1:] < place[:-1]).any()):
                place = np.maximum.accumulate(place)
            if before is not None and place[0] < before.place[-1]:
                place = np.maximum(place, before.place[-1])
            return replace(rows, place=place)
    return None


def widened(payload: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    """Pad a payload of shape (N, W) with zero columns up to ``width``."""
    missing = width - payload.shape[1]
    return np.pad(payload, ((0, 0), (0, missing))) if missing else payload


def blocks_by_bus(
    rows: FrameRows, names: Sequence[str], ledger: Ledger, selection: Selection
) -> Iterator[Block]:
    """Account for ``rows`` and yield the selected ones in blocks of one bus and ``BLOCK_ROWS``."""
    for bus, name in enumerate(names):
        is_here = rows.bus == bus
        if not bool(is_here.any()):
            continue
        log_ns, frames = rows.log_ns, rows.frames
        if not bool(is_here.all()):
            at = np.flatnonzero(is_here)
            log_ns, frames = log_ns.take(at), frames.take(at)
        kept = selection.account(name, log_ns, ledger)
        if kept is not None:
            log_ns, frames = log_ns[kept], frames.take(kept)
        for k in range(0, len(log_ns), BLOCK_ROWS):
            part = slice(k, k + BLOCK_ROWS)
            yield Block(name, log_ns[part], narrowed(frames.take(part)))


def narrowed(frames: CanFrames) -> CanFrames:
    """Reduce the payload to eight columns if no frame is CAN FD."""
    if frames.data.shape[1] == 8 or bool(frames.is_fd.any()):
        return frames
    return replace(frames, data=np.ascontiguousarray(frames.data[:, :8]))

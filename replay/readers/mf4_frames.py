"""CAN frames out of the records of an MDF 4 bus logging group."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import DATA, ERROR, REMOTE, Bytes, CanFrames, Int64s

from .can_rows import IS_FD_LENGTH, FrameRows
from .mf4_blocks import VARIABLE, Blocks, Channel, Group, Piece
from .mf4_records import Records
from .mf4_values import is_numeric, raw

_KINDS: Final = {"CAN_DataFrame": DATA, "CAN_RemoteFrame": REMOTE, "CAN_ErrorFrame": ERROR}
_SPAN_MAX: Final = 16 << 20
_PAYLOAD_MAX: Final = 64
_RESTARTS_MAX: Final = 64
"""How often values may be stored in another order than their records."""


def can_layout(blocks: Blocks, group: Group) -> CanLayout | None:
    """How ``group`` holds CAN frames; None when it holds something else."""
    for channel in group.channels:
        if channel.name in _KINDS:
            prefix = channel.name + "."
            parts = {
                one.name.removeprefix(prefix): one
                for one in group.channels
                if one.name.startswith(prefix)
            }
            return CanLayout(blocks, group, _KINDS[channel.name], parts)
    return None


class CanLayout:
    """Where the fields of one kind of frame lie in its records."""

    def __init__(
        self, blocks: Blocks, group: Group, kind: int, parts: Mapping[str, Channel]
    ) -> None:
        self._group, self._kind, self._parts = group, kind, parts
        payload = parts.get("DataBytes")
        self.is_variable = payload is not None and payload.type == VARIABLE
        self._store = _Store(blocks, payload.data) if payload and self.is_variable else None

    @property
    def refusal(self) -> str:
        """Why these frames cannot be read; empty when they can."""
        if self._kind == ERROR:
            return ""
        numeric = [name for name in ("ID", "DataLength") if self._number(name) is None]
        if "ID" in numeric:
            return "bus group without identifiers"
        if self._kind == DATA and ("DataBytes" not in self._parts or "DataLength" in numeric):
            return "bus group without payloads"
        return ""

    def frames(self, records: Records, log_ns: Int64s) -> FrameRows:
        """The records that can be frames; ``bus`` holds channel numbers."""
        rows = records.rows
        count = len(rows)
        identifier = self._values("ID", rows, 0)
        marked = (identifier >> 31) & 1
        is_extended = self._values("IDE", rows, marked) != 0
        number = identifier & 0x1FFFFFFF
        is_fd = self._values("EDL", rows, 0) != 0
        length = np.zeros(count, np.int64)
        ok = np.ones(count, np.bool_)
        payload = np.zeros((count, _PAYLOAD_MAX), np.uint8)
        if self._kind == DATA:
            length = self._values("DataLength", rows, 0)
            payload, ok = self._payloads(rows, length)
            ok &= is_extended | (number <= 0x7FF)
            ok &= np.where(is_fd, IS_FD_LENGTH[np.clip(length, 0, 64)], length <= 8)
            ok &= length <= _PAYLOAD_MAX
        width = _PAYLOAD_MAX if bool(is_fd.any()) else 8
        frames = CanFrames(
            number.astype(np.uint32),
            is_extended,
            np.full(count, self._kind, np.uint8),
            np.minimum(length, width).astype(np.uint8),
            np.ascontiguousarray(payload[:, :width]),
            is_fd,
        )
        bus = self._values("BusChannel", rows, 1)
        place = np.arange(records.first, records.first + count)
        found = FrameRows(place, bus, log_ns, frames)
        return found if bool(ok.all()) else found.take(ok)

    def _number(self, name: str) -> Channel | None:
        channel = self._parts.get(name)
        if channel is None or not is_numeric(channel, self._group.value_bytes):
            return None
        return channel

    def _values(self, name: str, rows: Bytes, missing: int | Int64s) -> Int64s:
        channel = self._number(name)
        if channel is None:
            return np.zeros(len(rows), np.int64) + missing
        return raw(channel, rows, 0).astype(np.int64)

    def _payloads(self, rows: Bytes, length: Int64s) -> tuple[Bytes, NDArray[np.bool_]]:
        """Payloads of shape (N, 64), zero from ``length`` on, and which of them are whole."""
        channel = self._parts["DataBytes"]
        inside = np.arange(_PAYLOAD_MAX) < length[:, None]
        if self._store is None:
            stored = min(channel.bit_count // 8, _PAYLOAD_MAX)
            part = rows[:, channel.byte_offset : channel.byte_offset + stored]
            payload = np.zeros((len(rows), _PAYLOAD_MAX), np.uint8)
            payload[:, : part.shape[1]] = part
            return np.where(inside, payload, np.uint8(0)), length <= part.shape[1]
        offsets = rows[:, channel.byte_offset : channel.byte_offset + 8]
        if offsets.shape[1] < 8:
            return np.zeros((len(rows), _PAYLOAD_MAX), np.uint8), np.zeros(len(rows), np.bool_)
        at = np.ascontiguousarray(offsets).view("<u8")[:, 0]
        payload, stored_length = self._store.fetch(at)
        return np.where(inside, payload, np.uint8(0)), stored_length == length


class _Store:
    """Variable-length values of one channel, read along with the records that point at them."""

    def __init__(self, blocks: Blocks, link: int) -> None:
        self._blocks, self._link = blocks, link
        self._pieces: Iterator[Piece] = iter(())
        self._held, self._base, self._end, self._restarts = b"", 0, 0, 0
        self._damaged: list[tuple[int, int]] = []
        self._rewind()

    def fetch(self, at: NDArray[np.uint64]) -> tuple[Bytes, Int64s]:
        """The values at these offsets.

        Returns:
            Shape (N, 64): their first bytes; shape (N,): their lengths, -1 for unreadable ones.
        """
        payload = np.zeros((len(at), _PAYLOAD_MAX), np.uint8)
        length = np.full(len(at), -1, np.int64)
        if not len(at):
            return payload, length
        first = int(at.min())
        near = at - np.uint64(first) < _SPAN_MAX
        last = int(at[near].max()) + 4 + _PAYLOAD_MAX
        window = self._window(first, last)
        if self._base != first:
            return payload, length
        place = np.where(near, at - np.uint64(first), 0).astype(np.int64)
        room = len(window) - 4 - _PAYLOAD_MAX
        is_inside = near & (place < room)
        place = np.where(is_inside, place, 0)
        numbers: NDArray[np.uint32] = np.ndarray(
            (len(window) - 3,), np.dtype("<u4"), window.data, strides=(1,)
        )
        found = numbers[place].astype(np.int64)
        is_good = is_inside & (found <= _PAYLOAD_MAX) & ~self._is_damaged(first + place, found)
        # The window ends in padding, which no value may reach into.
        is_good &= first + place + 4 + found <= self._end
        view = np.lib.stride_tricks.sliding_window_view(window, _PAYLOAD_MAX)
        payload[is_good] = view[place[is_good] + 4]
        length[is_good] = found[is_good]
        return payload, length

    def _is_damaged(self, start: Int64s, length: Int64s) -> NDArray[np.bool_]:
        bad = np.zeros(len(start), np.bool_)
        for begin, end in self._damaged:
            bad |= (start < end) & (start + 4 + length > begin)
        return bad

    def _window(self, first: int, last: int) -> Bytes:
        """Bytes from ``first`` on, padded so that every value in it can be looked at."""
        if first < self._base and self._restarts < _RESTARTS_MAX:
            self._restarts += 1
            self._rewind()
        while self._end < last:
            piece = next(self._pieces, None)
            if piece is None:
                break
            content = piece.content
            if content is None:
                self._damaged.append((self._end, self._end + piece.byte_count))
                if not 0 < piece.byte_count <= _SPAN_MAX:
                    self._pieces = iter(())
                    break
                content = bytes(piece.byte_count)
            self._held += content
            self._end += len(content)
            self._drop(first)
        self._drop(first)
        return np.frombuffer(self._held + bytes(2 * _PAYLOAD_MAX + 8), np.uint8)

    def _drop(self, first: int) -> None:
        count = min(max(first - self._base, 0), len(self._held))
        self._held, self._base = self._held[count:], self._base + count

    def _rewind(self) -> None:
        self._pieces = self._blocks.pieces(self._link, is_open_ended=False)
        self._held, self._base, self._end = b"", 0, 0
        self._damaged = []

"""Parser of CAN frames in the records of an MDF 4 bus logging group."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import DATA, ERROR, REMOTE, Bytes, CanFrames, Int64s
from crosscue.replay.readers.can_rows import FD_LENGTHS, IS_FD_LENGTH, FrameRows

from .blocks import VARIABLE, VARIABLE_COMPACT, ChannelGroup, Mf4Channel
from .records import Records
from .values import Words, invalid, is_applied, is_numeric, is_plain, physical, raw
from .variable import VariableValues

_KINDS: Final = {
    "CAN_DataFrame": DATA,
    "CAN_RemoteFrame": REMOTE,
    "CAN_ErrorFrame": ERROR,
    "CAN_OverloadFrame": -1,
}
_CLASSIC, _FD = 8, 64
_MASK: Final = np.array([(1 << 8 * k) - 1 for k in range(9)], np.uint64)
_VALID_PARTS: Final = ("", "ID", "DataBytes", "DataLength")
_NUMBER: Final = re.compile(r"CAN[ _-]*(\d+)", re.IGNORECASE)


def can_layout(group: ChannelGroup) -> CanLayout | None:
    """Return the layout of CAN frames in ``group``; None if it has no CAN frames."""
    for name, kind in _KINDS.items():
        parts = {
            one.name.removeprefix(name).removeprefix("."): one
            for one in group.channels
            if one.name == name or one.name.startswith(name + ".")
        }
        if parts:
            return CanLayout(group, kind, parts)
    return None


@dataclass(frozen=True, slots=True)
class FrameBatch:
    """Frames of some records, and the number of records without a frame.

    Attributes:
        rows: The frames; ``bus`` contains channel numbers.
        impossible: Number of records that cannot be frames.
        unreadable: Number of records with a missing, truncated or damaged payload.
        invalid: Number of records that the logger marked as invalid.
    """

    rows: FrameRows
    impossible: int
    unreadable: int
    invalid: int


class CanLayout:
    """Positions of the fields of one kind of frame in its records.

    Attributes:
        variable: Channel of the payloads, if they have variable length.
    """

    def __init__(self, group: ChannelGroup, kind: int, parts: Mapping[str, Mf4Channel]) -> None:
        self._group, self._kind, self._parts = group, kind, parts
        self._numbers = {
            name: one for name, one in parts.items() if is_numeric(one, group.value_bytes)
        }
        payload = parts.get("DataBytes")
        is_variable = kind == DATA and payload is not None and payload.type == VARIABLE
        self.variable = payload if is_variable else None
        # The record contains an offset, whatever the type of the values.
        self._key = replace(payload, data_type=0) if payload and is_variable else None
        named = _NUMBER.search(group.name)
        self._bus = int(named[1][:3]) if named else 1

    @property
    def is_needed(self) -> bool:
        """False for overload frames, which contain no information."""
        return self._kind >= 0

    @property
    def refusal(self) -> str:
        """Reason why these frames cannot be read; empty if they can."""
        if self._kind < 0:
            return "overload frames, which contain no information"
        if self._kind == ERROR:
            return ""
        if "ID" not in self._numbers:
            return "bus group without identifiers"
        payload = self._parts.get("DataBytes")
        if self._kind == DATA and payload is None:
            return "bus group without payloads"
        if payload is not None and payload.type == VARIABLE_COMPACT:
            return "payloads stored as compact variable-length values (VLSC), not supported"
        if self._key is not None and not is_numeric(self._key, self._group.value_bytes):
            return "bus group whose payloads cannot be found"
        return ""

    def buses(self, records: Records) -> Int64s:
        """Return the channel numbers, shape (N,)."""
        return self._values("BusChannel", Words(records.rows, records.first), self._bus)

    def frames(
        self, records: Records, words: Words, log_ns: Int64s, values: VariableValues | None
    ) -> FrameBatch:
        """Parse the records into frames."""
        identifier = self._values("ID", words, 0)
        number = identifier & 0x1FFFFFFF
        is_long = number > 0x7FF
        if "IDE" in self._numbers:
            is_extended = self._flags("IDE", words)
        else:
            is_extended = ((identifier >> 31) & 1 != 0) | is_long
        ok = is_extended | ~is_long | np.bool_(self._kind == ERROR)
        count = len(words)
        if self._kind != DATA:
            length, is_fd = np.zeros(count, np.int64), np.zeros(count, np.bool_)
            payload, whole = np.zeros((count, _CLASSIC), np.uint8), np.ones(count, np.bool_)
        else:
            length, is_fd = self._lengths(words)
            if count and (length.min() < 0 or length.max() > _CLASSIC):
                is_fd_length = IS_FD_LENGTH[np.clip(length, 0, _FD)]
                possible = np.where(is_fd, is_fd_length, length <= _CLASSIC)
                ok = ok & possible & (length >= 0) & (length <= _FD)
                length = np.where(ok, length, 0)
            payload, whole = self._payloads(words, length, values, bool(is_fd.any()))
        frames = CanFrames(
            number.astype(np.uint32),
            is_extended,
            np.full(count, self._kind, np.uint8),
            length.astype(np.uint8),
            payload,
            is_fd,
            self._flags("Dir", words) if "Dir" in self._numbers else None,
        )
        rows = FrameRows(
            records.place, self._values("BusChannel", words, self._bus), log_ns, frames
        )
        marked = self._marked(words)
        is_valid = ok & whole & ~marked
        if bool(is_valid.all()):
            return FrameBatch(rows, 0, 0, 0)
        masks = ~ok & ~marked, ok & ~whole & ~marked, marked
        return FrameBatch(rows.take(is_valid), *(int(np.count_nonzero(mask)) for mask in masks))

    def _marked(self, words: Words) -> NDArray[np.bool_]:
        """Return a mask of the records marked as invalid by the logger."""
        marked = np.zeros(len(words), np.bool_)
        for name in _VALID_PARTS:
            if name in self._parts:
                one = invalid(self._parts[name], words.records, self._group.value_bytes)
                if one is not None:
                    marked |= one
        return marked

    def _lengths(self, words: Words) -> tuple[Int64s, NDArray[np.bool_]]:
        """Return the numbers of payload bytes, and a mask of the CAN FD frames."""
        length = self._values("DataLength", words, -1)
        if "DataLength" not in self._numbers and "DLC" in self._numbers:
            length = FD_LENGTHS[np.clip(self._values("DLC", words, 0), 0, 15)]
        is_long = length > _CLASSIC
        stored = self._parts["DataBytes"].bit_count // 8
        can_be_fd = self.variable is not None or stored > _CLASSIC
        is_fd = is_long & can_be_fd
        if "EDL" in self._numbers:
            is_fd = self._flags("EDL", words)
        if bool(is_long.any()):
            # In classic frames, the codes 9 to 15 also mean eight bytes.
            is_long &= ~is_fd & (self._values("DLC", words, 0) > _CLASSIC)
            length = np.where(is_long, _CLASSIC, length)
        return length, is_fd

    def _flags(self, name: str, words: Words) -> NDArray[np.bool_]:
        is_set: NDArray[np.bool_] = self._values(name, words, 0) != 0
        return is_set

    def _values(self, name: str, words: Words, missing: int) -> Int64s:
        channel = self._numbers.get(name)
        if channel is None:
            return np.full(len(words), missing, np.int64)
        conversion = channel.conversion
        if conversion.type == 1 and conversion.values[1:2] == (0.0,):
            only = _whole(np.array(conversion.values[:1]))[0]
            return np.full(len(words), only, np.int64)
        if is_plain(channel) and channel.bit_count < 64:
            bits = words.bits(channel.byte_offset, channel.bit_offset, channel.bit_count)
            if not conversion.type or not is_applied(conversion):
                return bits.view(np.int64)
            if channel.bit_count <= 8:
                # Few values are possible, so each value is converted once.
                table = _whole(physical(conversion, np.arange(1 << channel.bit_count)))
                return table.take(bits.view(np.int64))
        values = raw(channel, words)
        return _whole(physical(conversion, values) if is_applied(conversion) else values)

    def _payloads(
        self, words: Words, length: Int64s, values: VariableValues | None, is_any_fd: bool
    ) -> tuple[Bytes, NDArray[np.bool_]]:
        """Return payloads of 8 or 64 columns, zero from ``length`` on, and a validity mask."""
        width = _FD if is_any_fd else _CLASSIC
        channel, rows = self._parts["DataBytes"], words.records
        if values is None or self._key is None:
            stored = min(channel.bit_count // 8, width)
            if stored == _CLASSIC == width and channel.byte_offset + 8 <= rows.shape[1]:
                # Reading one word per record is five times faster than copying eight columns.
                word = words.bits(channel.byte_offset, 0, 64)
                return _cut(word.view(np.uint8).reshape(-1, _CLASSIC), length), length <= _CLASSIC
            part = rows[:, channel.byte_offset : channel.byte_offset + stored]
            payload = np.zeros((len(rows), width), np.uint8)
            payload[:, : part.shape[1]] = part
            return _cut(payload, length), length <= part.shape[1]
        key = raw(self._key, words).astype(np.int64)
        payload, stored_length = values.fetch(key, words.first, width)
        return _cut(payload, length), stored_length >= length


def _whole(values: NDArray[np.generic]) -> Int64s:
    """Convert values to integers; -1 for values that are not integers."""
    if values.dtype.kind == "f":
        values = np.rint(np.nan_to_num(values, nan=-1.0, posinf=-1.0, neginf=-1.0))
    return values.astype(np.int64)


def _cut(payload: Bytes, length: Int64s) -> Bytes:
    """Set the payload bytes from ``length`` on to zero."""
    width = payload.shape[1]
    if bool((length == width).all()):
        return payload
    if width == _CLASSIC:
        words: NDArray[np.uint64] = _MASK.take(length)
        words &= payload.view(np.uint64)[:, 0]
        return words.view(np.uint8).reshape(-1, _CLASSIC)
    return np.where(np.arange(width) < length[:, None], payload, np.uint8(0))

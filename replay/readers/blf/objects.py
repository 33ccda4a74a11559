"""Columnar parsing of the objects in BLF containers.

No official specification of the format is public; the layouts are those that Vector's tools and
python-can write. Every object starts with ``LOBJ``, its header's size and version, its own size
and its type. The next object follows at its end, after at most seven bytes of padding. All
occurrences of ``LOBJ`` are found at once. Objects are examined one by one only where the
occurrences do not form a chain (a payload that contains ``LOBJ``, or damage).
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from crosscue.replay.columns import DATA, ERROR, REMOTE, Bytes, CanFrames, Int64s
from crosscue.replay.readers.can_rows import (
    FD_LENGTHS,
    IS_FD_LENGTH,
    NO_ROWS,
    FrameRows,
    merge_rows,
    widened,
)

MAGIC: Final = b"LOBJ"
PADDING_MAX: Final = 8
BASE_BYTES: Final = 16
CONTAINER: Final = 10
# Object type that the file header does not count.
RESTORE_POINT: Final = 115
# Maximum plausible object type; no known type is above 150.
TYPE_MAX: Final = 255
# Number of bytes after an object that are too few to detect the next one.
_UNSEEN_MAX: Final = BASE_BYTES + PADDING_MAX
_PLACES_KEPT: Final = 5
_SIGNATURE: Final = int.from_bytes(MAGIC, "little")
_EXTENDED: Final = 0x80000000
_ID_MASK: Final = 0x1FFFFFFF
_TEN_MICROSECONDS: Final = 1
# Maximum time from the start, 36 years; a later time is damage.
_NANOS_MAX: Final = 1 << 60


@dataclass(slots=True)
class ObjectCounts:
    """Counts of one pass, which are compared with the file header.

    Attributes:
        counted: Number of objects of the types that the header counts, used or not.
        others: Number of objects that are not CAN frames, by reason.
        reasons: Number of damaged places, by reason.
        places: The first damaged places.
        padded: Number of frames that store fewer bytes than their length.
        last_tick_ns: Latest time, from the start of the recording.
    """

    counted: int = 0
    others: Counter[str] = field(default_factory=Counter)
    reasons: Counter[str] = field(default_factory=Counter)
    places: list[str] = field(default_factory=list)
    padded: int = 0
    last_tick_ns: int = 0

    def damage(self, reason: str, place: str) -> None:
        """Record an unreadable part of the file."""
        self.reasons[reason] += 1
        if len(self.places) < _PLACES_KEPT:
            self.places.append(f"{reason}: {place}" if place else reason)


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """Consecutive complete objects.

    Attributes:
        start: Shape (N,), int64: offset of each object.
        rest: Offset of the first incomplete object, which is kept until more bytes are read.
    """

    start: Int64s
    rest: int


def chain_of(
    stream: Bytes, *, is_resumed: bool, is_end: bool, size_max: int, tally: ObjectCounts, place: str
) -> Chain:
    """Find the complete objects in ``stream``.

    Args:
        stream: Bytes of consecutive containers.
        is_resumed: True if the preceding bytes are lost, so that the first object may start
            anywhere.
        is_end: True if no more bytes follow.
        size_max: Maximum size of an incomplete object for which more bytes are read.
        tally: Records damage.
        place: Place of the stream in the file, for messages.
    """
    at = _signatures(stream)
    words = _u32(stream)
    size = words[at + 8].astype(np.int64)
    header = words[at + 4] & 0xFFFF
    is_sound = (header >= BASE_BYTES) & (size >= header) & (size <= size_max)
    end = at + size
    following = np.append(at[1:], len(stream))
    links = is_sound & (following >= end) & (following - end < PADDING_MAX)
    if not len(at):
        return _without_objects(stream, is_resumed, is_end, tally, place)
    if not is_resumed and at[0] >= PADDING_MAX:
        tally.damage("bytes between objects", f"{place}, offset 0")
        is_resumed = True
    keep = np.ones(len(at), np.bool_)
    if is_resumed:
        first = int(np.argmax(links)) if bool(links.any()) else len(at)
        keep[:first] = False
    else:
        first = 0
    rest = len(stream)
    candidates = _Candidates(at, end, is_sound, links, keep)
    for k in np.flatnonzero(~links[first:]) + first:
        if not keep[k]:
            continue
        rest = _repair(int(k), candidates, len(stream), is_end)
        if rest < 0:
            tally.damage("object of wrong size", f"{place}, offset {at[k]}")
            rest = len(stream)
        elif rest < len(stream):
            break
    is_whole = keep & (at < rest)
    last = int(end[is_whole][-1]) if bool(is_whole.any()) else rest
    if not is_end and rest == len(stream) and last < rest <= last + _UNSEEN_MAX:
        # Padding, or an incomplete header of the next object.
        rest = last
    return Chain(at[is_whole], rest)


class _Candidates(NamedTuple):
    """Possible objects of a stream: where they start and end, and what is known of them."""

    at: Int64s
    end: Int64s
    is_sound: NDArray[np.bool_]
    links: NDArray[np.bool_]
    keep: NDArray[np.bool_]


def _repair(k: int, candidates: _Candidates, length: int, is_end: bool) -> int:
    """Examine object ``k``, whose end is not followed by the next signature.

    Returns:
        The stream's length if the chain continues, the start of object ``k`` if it needs more
        bytes, or -1 if it is damaged.
    """
    at, end, is_sound, links, keep = candidates
    if is_sound[k] and end[k] <= length:
        following = int(np.searchsorted(at, end[k]))
        near = at[following] if following < len(at) else length
        if near - end[k] < PADDING_MAX:
            keep[k + 1 : following] = False
            return length
        if not is_end and following == len(at) and length - end[k] < _UNSEEN_MAX:
            keep[k + 1 :] = False
            return length
    if is_sound[k] and end[k] > length and not is_end:
        keep[k:] = False
        return int(at[k])
    sound_after = np.flatnonzero(links[k + 1 :])
    following = k + 1 + int(sound_after[0]) if len(sound_after) else len(at)
    keep[k:following] = False
    return -1


def _without_objects(
    stream: Bytes, is_resumed: bool, is_end: bool, tally: ObjectCounts, place: str
) -> Chain:
    rest = max(len(stream) - len(MAGIC) - PADDING_MAX, 0) if not is_end else len(stream)
    if len(stream) - rest != len(stream) and not is_resumed and bool(stream.any()):
        tally.damage("bytes without an object", f"{place}, {len(stream)} bytes")
    return Chain(np.zeros(0, np.int64), rest)


def _signatures(stream: Bytes) -> Int64s:
    """Return the offsets at which a complete object header could start."""
    if len(stream) < BASE_BYTES:
        return np.zeros(0, np.int64)
    letter = np.flatnonzero(stream[: len(stream) - BASE_BYTES + 1] == MAGIC[0])
    found: Int64s = letter[_u32(stream)[letter] == _SIGNATURE]
    return found


def _u32(stream: Bytes) -> NDArray[np.uint32]:
    """Return a view of every four consecutive bytes as a number."""
    numbers: NDArray[np.uint32] = np.ndarray(
        (max(len(stream) - 3, 0),), np.dtype("<u4"), stream.data, strides=(1,)
    )
    return numbers


_HEADER: Final = [
    ("signature", "<u4"), ("header", "<u2"), ("version", "<u2"), ("size", "<u4"), ("type", "<u4"),
    ("flags", "<u4"), ("skip", "<u4"), ("ticks", "<u8"),
]  # fmt: skip
_TIMED: Final = np.dtype(_HEADER)
_CLASSIC: Final = np.dtype(
    [("bus", "<u2"), ("flags", "u1"), ("code", "u1"), ("id", "<u4"), ("payload", "u1", 8)]
)
_FD: Final = np.dtype(
    [
        ("bus", "<u2"), ("flags", "u1"), ("code", "u1"), ("id", "<u4"), ("time", "<u4"),
        ("bits", "u1"), ("fd", "u1"), ("count", "u1"), ("skip", "u1", 5), ("payload", "u1", 64),
    ]
)  # fmt: skip
_FD64: Final = np.dtype(
    [
        ("bus", "u1"), ("code", "u1"), ("count", "u1"), ("tx", "u1"), ("id", "<u4"),
        ("time", "<u4"), ("flags", "<u4"), ("skip", "<u4", 4), ("bits", "<u2"), ("way", "u1"),
        ("extra", "u1"), ("crc", "<u4"),
    ]
)  # fmt: skip
_ERROR_EXT: Final = np.dtype(
    [
        ("bus", "<u2"), ("length", "<u2"), ("flags", "<u4"), ("ecc", "u1"), ("position", "u1"),
        ("code", "u1"), ("skip", "u1"), ("time", "<u4"), ("id", "<u4"), ("more", "<u2"),
        ("pad", "<u2"), ("payload", "u1", 8),
    ]
)  # fmt: skip
_ERROR_PLAIN: Final = np.dtype([("bus", "<u2"), ("length", "<u2")])
_ERROR_FD64: Final = np.dtype([("bus", "u1"), ("code", "u1"), ("count", "u1"), ("ecc", "u1")])


class _Objects(NamedTuple):
    """N objects of one kind: the stream with padding, their offsets and headers, and the counts."""

    stream: Bytes
    start: Int64s
    header: NDArray[np.void]
    tally: ObjectCounts


_Parsed: TypeAlias = tuple[CanFrames, NDArray[np.bool_]]


def parse_frames(
    stream: Bytes, start: Int64s, start_ns: int, tally: ObjectCounts, place: str
) -> FrameRows:
    """Parse the CAN frames among the objects at ``start``; ``bus`` contains channel numbers.

    Args:
        stream: Bytes of the objects.
        start: Offsets of the objects, from ``chain_of``.
        start_ns: Log time of the recording's start.
        tally: Records the counts and damage.
        place: Place of the stream in the file, for messages.
    """
    if not len(start):
        return NO_ROWS
    padded = np.concatenate((stream, np.zeros(256, np.uint8)))
    words = _u32(padded)
    type_ = words[start + 12]
    tally.counted += len(start) - int(np.count_nonzero(type_ == RESTORE_POINT))
    rows = NO_ROWS
    is_frame = np.zeros(len(start), np.bool_)
    for types, body, parse in _KINDS:
        is_kind = np.isin(type_, types)
        if bool(is_kind.any()):
            is_frame |= is_kind
            at = start[is_kind]
            objects = _Objects(padded, at, _records(padded, at, _TIMED), tally)
            rows = merge_rows((rows, _kind_rows(objects, body, parse, start_ns, place)))
    for kind, count in zip(*np.unique(type_[~is_frame], return_counts=True), strict=True):
        if not 0 < kind <= TYPE_MAX:
            tally.damage("object of impossible type", f"{place}, type {kind}")
            tally.counted -= int(count)
        elif kind != RESTORE_POINT:
            tally.others[f"object of type {kind} is not a CAN frame"] += int(count)
    return rows


def _kind_rows(
    objects: _Objects,
    body: np.dtype[np.void],
    parse: Callable[[NDArray[np.void], _Objects], _Parsed],
    start_ns: int,
    place: str,
) -> FrameRows:
    stream, start, header, tally = objects
    is_known = ((header["version"] == 1) & (header["header"] == 32)) | (
        (header["version"] == 2) & (header["header"] == 40)
    )
    inside = header["size"] >= header["header"].astype(np.int64) + body.itemsize
    ticks, flags = header["ticks"], header["flags"]
    step = np.where(flags == _TEN_MICROSECONDS, 10_000, 1)
    is_timed = (flags <= 2) & (ticks < _NANOS_MAX // step)
    ok = is_known & inside & is_timed
    tick_ns = np.where(ok, ticks, 0).astype(np.int64) * step
    record = _records(stream, np.where(ok, start + header["header"], 0), body)
    frames, frame_ok = parse(record, objects)
    ok &= frame_ok & (record["bus"] > 0)
    for k in np.flatnonzero(~ok).tolist():
        tally.damage("object that cannot be a frame", f"{place}, offset {start[k]}")
        tally.counted -= 1
    if bool(ok.any()):
        tally.last_tick_ns = max(tally.last_tick_ns, int(tick_ns[ok].max()))
    rows = FrameRows(start, record["bus"].astype(np.int64), tick_ns + start_ns, frames)
    return rows if bool(ok.all()) else rows.take(ok)


def _records(stream: Bytes, start: Int64s, layout: np.dtype[np.void]) -> NDArray[np.void]:
    """Copy the structures at ``start``."""
    rows = sliding_window_view(stream, layout.itemsize)[start]
    return np.ascontiguousarray(rows).view(layout)[:, 0]


def _classic(record: NDArray[np.void], _: _Objects) -> _Parsed:
    kind = np.where(record["flags"] & 0x80, REMOTE, DATA)
    length = np.where(kind == REMOTE, 0, np.minimum(record["code"] & 15, 8)).astype(np.int64)
    frames, ok = _frames(record["id"], kind, length, record["payload"], np.zeros(len(kind), bool))
    return frames, ok & (record["code"] <= 15)


def _fd(record: NDArray[np.void], _: _Objects) -> _Parsed:
    is_fd = (record["fd"] & 1) != 0
    kind = np.where(record["flags"] & 0x80, REMOTE, DATA)
    length = np.where(kind == REMOTE, 0, record["count"]).astype(np.int64)
    frames, ok = _frames(record["id"], kind, length, record["payload"], is_fd)
    return frames, ok & _fits_code(record["code"], length, is_fd, kind)


def _fd64(record: NDArray[np.void], of: _Objects) -> _Parsed:
    is_fd = (record["flags"] & 0x1000) != 0
    kind = np.where(record["flags"] & 0x10, REMOTE, DATA)
    length = np.where(kind == REMOTE, 0, record["count"]).astype(np.int64)
    before = of.header["header"].astype(np.int64) + _FD64.itemsize
    limit = np.where(record["extra"] > 0, record["extra"], of.header["size"]).astype(np.int64)
    stored = np.clip(limit - before, 0, np.minimum(length, 64))
    text = sliding_window_view(of.stream, 64)[np.minimum(of.start + before, len(of.stream) - 64)]
    payload = np.where(np.arange(64) < stored[:, None], text, np.uint8(0))
    frames, ok = _frames(record["id"], kind, length, payload, is_fd)
    ok &= _fits_code(record["code"], length, is_fd, kind)
    of.tally.padded += int(np.count_nonzero(ok & (stored < length)))
    return frames, ok


def _fits_code(
    code: NDArray[np.uint8], length: Int64s, is_fd: NDArray[np.bool_], kind: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Return whether each payload length is consistent with its length code."""
    promised = FD_LENGTHS[code & 15]
    promised = np.where(is_fd, promised, np.minimum(promised, 8))
    fits: NDArray[np.bool_] = (kind == REMOTE) | (length == promised)
    fits &= code <= 15
    return fits


def _error_ext(record: NDArray[np.void], _: _Objects) -> _Parsed:
    length = np.minimum(record["code"] & 15, 8).astype(np.int64)
    return _errors(record["id"], length, record["payload"])


def _error(record: NDArray[np.void], _: _Objects) -> _Parsed:
    nothing = np.zeros(len(record), np.int64)
    return _errors(nothing, nothing, np.zeros((len(record), 8), np.uint8))


def _errors(identifier: NDArray[np.integer], length: Int64s, payload: Bytes) -> _Parsed:
    n = len(length)
    return _frames(identifier, np.full(n, ERROR), length, payload, np.zeros(n, bool))


_KINDS: Final = (
    ((1, 86), _CLASSIC, _classic),
    ((100,), _FD, _fd),
    ((101,), _FD64, _fd64),
    ((73,), _ERROR_EXT, _error_ext),
    ((2,), _ERROR_PLAIN, _error),
    ((104,), _ERROR_FD64, _error),
)
FRAME_TYPES: Final = frozenset(type_ for types, _, _ in _KINDS for type_ in types)


def _frames(
    identifier: NDArray[np.integer],
    kind: NDArray[np.int64],
    length: Int64s,
    payload: Bytes,
    is_fd: NDArray[np.bool_],
) -> _Parsed:
    """Return frames with the bytes beyond their length cleared, and a mask of the valid frames."""
    is_extended = (identifier & _EXTENDED) != 0
    number = identifier & _ID_MASK
    width = 64 if payload.shape[1] > 8 else 8
    payload = widened(payload, width)
    if int(length.min(initial=width)) < width:
        payload = np.where(np.arange(width) < length[:, None], payload, np.uint8(0))
    ok = (length <= width) & ((kind == ERROR) | is_extended | (number <= 0x7FF))
    ok &= np.where(is_fd, IS_FD_LENGTH[np.clip(length, 0, 64)], length <= 8)
    frames = CanFrames(
        number.astype(np.uint32),
        is_extended,
        kind.astype(np.uint8),
        np.minimum(length, 64).astype(np.uint8),
        payload,
        is_fd,
    )
    return frames, ok

"""Which containers of a BLF log may hold frames of a window, told from the first time in each.

BLF has no index. But each container says how long it is, and its first few hundred bytes hold an
object with a time, so that a container costs one small read instead of being inflated whole.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from io import BufferedReader
from typing import Final, NamedTuple

from crosscue.replay.base import Selection

from .objects import BASE_BYTES, CONTAINER, FRAME_TYPES, MAGIC, PADDING_MAX

SLACK_NS: Final = 1_200_000_000
"""How far frames of several channels may be out of order."""
_HEAD: Final = struct.Struct("<4sHHLLH6xL4x")
_OBJECT: Final = struct.Struct("<4sHHLLLLQ")
_STORED, _DEFLATED = 0, 2
_PEEKED_BYTES: Final = 1024
_INFLATED_BYTES: Final = 4096
_TICK_NS: Final = {1: 10_000, 2: 1}
_HEADERS: Final = {1: 32, 2: 40}
"""Bytes of an object's header, by its version."""


class _Container(NamedTuple):
    """Where a container begins and ends, and the first time in it; None where none was found."""

    start: int
    end: int
    first_ns: int | None


def unwanted(
    file: BufferedReader, position: int, size: int, start_ns: int, selection: Selection
) -> Mapping[int, int]:
    """Stretches of containers that no frame of the window can be in.

    A container is left out when it and its neighbors begin well before the window or after it.
    Where the file is not one chain of whole containers, nothing is.

    Args:
        file: The log.
        position: Where its first container begins.
        size: Bytes of the file.
        start_ns: Log time of the recording's start.
        selection: What is asked for.

    Returns:
        From the start of each stretch to its end.
    """
    if selection.start_ns is None and selection.end_ns is None:
        return {}
    containers = _containers(file, position, size, start_ns)
    skips: dict[int, int] = {}
    begun: int | None = None
    for k, one in enumerate(containers):
        # An object may run on into the next container, so both neighbors count as well.
        around = containers[max(k - 1, 0) : k + 3]
        if _is_outside([c.first_ns for c in around], selection):
            begun = one.start if begun is None else begun
            skips[begun] = containers[k + 1].start if k + 1 < len(containers) else one.end
        else:
            begun = None
    return skips


def _is_outside(times_ns: list[int | None], selection: Selection) -> bool:
    known = [t for t in times_ns if t is not None]
    # The last container's frames run on for an unknown time.
    is_last = len(times_ns) < 3
    if len(known) < len(times_ns):
        return False
    before, after = selection.start_ns, selection.end_ns
    is_before = before is not None and not is_last and max(known) + SLACK_NS < before
    return is_before or (after is not None and min(known) - SLACK_NS >= after)


def _containers(file: BufferedReader, position: int, size: int, start_ns: int) -> list[_Container]:
    """All containers of the file, or none of them where their chain is broken."""
    found = []
    while position < size:
        file.seek(position)
        head = file.read(_HEAD.size + _PEEKED_BYTES)
        at = head[: PADDING_MAX + len(MAGIC) - 1].find(MAGIC)
        if at < 0 and not head.strip(b"\0"):
            break
        if at < 0 or len(head) < at + _HEAD.size:
            return []
        _, header_bytes, _, object_bytes, type_, method, _ = _HEAD.unpack_from(head, at)
        end = position + at + object_bytes
        if type_ != CONTAINER or header_bytes != BASE_BYTES or end > size:
            return []
        if object_bytes < _HEAD.size:
            return []
        body = head[at + _HEAD.size : at + object_bytes]
        first_ns = _first_ns(body, method)
        found.append(
            _Container(position + at, end, None if first_ns is None else start_ns + first_ns)
        )
        position = end
    return found


def _first_ns(body: bytes, method: int) -> int | None:
    """Time of the first frame in a container's content, from the recording's start."""
    if method == _DEFLATED:
        try:
            body = zlib.decompressobj().decompress(body, _INFLATED_BYTES)
        except zlib.error:
            return None
    elif method != _STORED:
        return None
    at = body.find(MAGIC)
    while 0 <= at <= len(body) - _OBJECT.size:
        _, header_bytes, version, size, type_, flags, _, ticks = _OBJECT.unpack_from(body, at)
        near = body[at + size : at + size + PADDING_MAX + len(MAGIC) - 1]
        is_frame = type_ in FRAME_TYPES and header_bytes == _HEADERS.get(version)
        if is_frame and size > header_bytes and MAGIC in near:
            return int(ticks) * _TICK_NS.get(flags, 1)
        at = body.find(MAGIC, at + 1)
    return None

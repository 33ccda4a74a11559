"""Selection of the containers of a BLF log that may contain frames of a time window.

BLF has no index. But each container states its size, and its first few hundred bytes contain an
object with a time. Examining a container therefore takes one small read instead of a complete
decompression.
"""

import struct
import zlib
from collections.abc import Mapping
from io import BufferedReader
from typing import Final, NamedTuple

from crosscue.replay.base import Selection

from .objects import BASE_BYTES, CONTAINER, FRAME_TYPES, MAGIC, PADDING_MAX

# Maximum time by which frames of several channels are out of order.
SLACK_NS: Final = 1_200_000_000
_HEAD: Final = struct.Struct("<4sHHLLH6xL4x")
_OBJECT: Final = struct.Struct("<4sHHLLLLQ")
_STORED, _DEFLATED = 0, 2
_PEEKED_BYTES: Final = 1024
_INFLATED_BYTES: Final = 4096
_TICK_NS: Final = {1: 10_000, 2: 1}
# Size of an object's header in bytes, by version.
_HEADERS: Final = {1: 32, 2: 40}


class _Container(NamedTuple):
    """Start and end of a container, and the first time in it, or None if none was found."""

    start: int
    end: int
    first_ns: int | None


def unwanted(
    file: BufferedReader, position: int, size: int, start_ns: int, selection: Selection
) -> Mapping[int, int]:
    """Find sequences of containers that cannot contain frames of the window.

    A container is skipped if it and its neighbors start well before the window or after it. If the
    file is not one chain of complete containers, none is skipped.

    Args:
        file: The log.
        position: Offset of the first container.
        size: Size of the file in bytes.
        start_ns: Log time of the recording's start.
        selection: The selected time range.

    Returns:
        The end of each sequence by its start.
    """
    if not selection.is_timed:
        return {}
    containers = _containers(file, position, size, start_ns)
    skips: dict[int, int] = {}
    begun: int | None = None
    for k, one in enumerate(containers):
        # An object may continue in the next container, so both neighbors must be outside too.
        around = containers[max(k - 1, 0) : k + 3]
        if _is_outside([c.first_ns for c in around], selection):
            begun = one.start if begun is None else begun
            skips[begun] = containers[k + 1].start if k + 1 < len(containers) else one.end
        else:
            begun = None
    return skips


def _is_outside(times_ns: list[int | None], selection: Selection) -> bool:
    known = [t for t in times_ns if t is not None]
    # The time of the last container's last frame is unknown.
    is_last = len(times_ns) < 3
    if len(known) < len(times_ns):
        return False
    before, after = selection.start_ns, selection.end_ns
    is_before = before is not None and not is_last and max(known) + SLACK_NS < before
    return is_before or (after is not None and min(known) - SLACK_NS >= after)


def _containers(file: BufferedReader, position: int, size: int, start_ns: int) -> list[_Container]:
    """List all containers of the file; empty if their chain is broken."""
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
    """Return the time of the first frame in a container, from the recording's start."""
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

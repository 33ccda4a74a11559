"""Search for readable records of a ROS 1 bag after damaged bytes outside its chunks.

Outside chunks, only a record's own length states its end. A message there is accepted if its end is
the start of another record, of a record with a damaged but recognisable header, or the file's end.
After damage, reading resumes at the next indexed chunk, or at earlier consecutive records that are
plausible by their kinds, sizes, connections and times.
"""

import re
from collections.abc import Callable, Collection, Sequence
from typing import Final

from .records import BAG_HEADER, CHUNK, CHUNK_INFO, INDEX, MESSAGE, BagFile, BagRecord, record_at

# Number of consecutive plausible records that are accepted, or fewer up to the file's end.
IN_A_ROW: Final = 3
_SEARCHED_AT_ONCE: Final = 4 << 20
_OP: Final = b"\x04\x00\x00\x00op="
_CHUNK_OP: Final = _OP + bytes([CHUNK])
_BEFORE_OP: Final = 128
# Maximum header length of a record at which reading resumes.
_HEADER_MAX: Final = 256
_DAY_NS: Final = 86_400 * 10**9
_FIELD: Final = re.compile(
    rb"(.{4})(op|conn|time|compression|size|ver|count|topic|chunk_pos|start_time|end_time)=",
    re.DOTALL,
)


class BagResync:
    """Checks records outside chunks, and finds the next records after damage."""

    def __init__(self, file: BagFile, known: Sequence[int], connections: Collection[int]) -> None:
        """Prepare a search.

        Args:
            file: The bag.
            known: Sorted byte offsets of the chunks in the index.
            connections: Numbers of the connections found so far; may be extended later. If empty,
                any number is accepted.
        """
        self._file = file
        self._known = known
        self._connections = connections
        self._near_ns: int | None = None

    def is_believed(self, record: BagRecord) -> bool:
        """Return whether the length of a record outside chunks is confirmed."""
        if record.end > self._file.size:
            return False
        if record.op != MESSAGE:
            return True
        is_right = record.end == self._file.size or self.is_head(record.end)
        if is_right:
            self._near_ns = record.time_ns(b"time")
        return is_right

    def next(self, at: int) -> int | None:
        """Return the offset at or after ``at`` at which reading resumes; None if none exists."""
        place = self._known_chunk(at)
        stop = self._file.size if place is None else place
        found = self._searched(at, stop, _OP, self._goes_on)
        return place if found is None else found

    def next_chunk(self, at: int) -> int | None:
        """Return the start of the next chunk at or after ``at``, by the index or by search."""
        place = self._known_chunk(at)
        if place is not None:
            return place
        return self._searched(at, self._file.size, _CHUNK_OP, self._is_whole_chunk)

    def _known_chunk(self, at: int) -> int | None:
        return next((k for k in self._known if k >= at and self._is_chunk(k)), None)

    def _is_chunk(self, at: int) -> bool:
        record = self._file.record(at)
        return record is not None and record.op == CHUNK

    def _is_whole_chunk(self, at: int) -> bool:
        return self._is_chunk(at) and self._file.whole_record(at) is not None

    def is_head(self, at: int) -> bool:
        """Return whether a record starts at ``at``, possibly with a damaged header."""
        return self._file.record(at) is not None or _was_head(
            self._file.bytes_at(at, at + _HEADER_MAX)
        )

    def _searched(
        self, at: int, stop: int, op: bytes, is_wanted: Callable[[int], bool]
    ) -> int | None:
        """Return the first record from ``at`` on and before ``stop`` with this field, if wanted."""
        while at < stop:
            window = self._file.bytes_at(at, at + _SEARCHED_AT_ONCE + _HEADER_MAX)
            found = -1
            while (found := window.find(op, found + 1)) >= 0:
                for start in range(max(0, found - _BEFORE_OP), found):
                    if at + start >= stop:
                        return None
                    if _heads_record(window, start, found + len(op)) and is_wanted(at + start):
                        return at + start
            at += _SEARCHED_AT_ONCE
        return None

    def _goes_on(self, at: int) -> bool:
        """Return whether consecutive plausible records start at ``at``."""
        near_ns = self._near_ns
        for n in range(IN_A_ROW):
            if at == self._file.size:
                return n > 0
            record = self._file.record(at)
            if record is None or not self._is_plausible(record, near_ns):
                return False
            if record.end > self._file.size:
                return n > 0
            if record.op == CHUNK:
                return True
            near_ns = record.time_ns(b"time") if record.op == MESSAGE else near_ns
            at = record.end
        return True

    def _is_plausible(self, record: BagRecord, near_ns: int | None) -> bool:
        if record.op == INDEX:
            return record.u32(b"ver") == 1 and record.size == 12 * record.u32(b"count")
        if record.op == CHUNK_INFO:
            return record.u32(b"ver") == 1 and record.size == 8 * record.u32(b"count")
        if record.op != MESSAGE:
            return record.op != BAG_HEADER
        if self._connections and record.u32(b"conn") not in self._connections:
            return False
        return near_ns is None or abs(record.time_ns(b"time") - near_ns) <= _DAY_NS


def _heads_record(window: bytes, start: int, op_end: int) -> bool:
    length = int.from_bytes(window[start : start + 4], "little")
    if not op_end <= start + 4 + length <= start + _HEADER_MAX:
        return False
    return record_at(window, start) is not None


def _was_head(head: bytes) -> bool:
    """Return whether these bytes start a record with one damaged header field or length."""
    fields = [
        (found[2], found.start(), found.start() + 4 + int.from_bytes(found[1], "little"))
        for found in _FIELD.finditer(head)
    ]
    if len(fields) < 2 or fields[0][1] < 4:
        return False
    if any(end == 4 + int.from_bytes(head[:4], "little") for _, _, end in fields):
        return True
    first, second = fields[:2]
    return first[0] == b"op" and first[1] == 4 and first[2] == second[1]

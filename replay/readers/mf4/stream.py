"""Random access to the data of an MDF 4 data link as one stream of bytes."""

from bisect import bisect_right
from typing import Final, cast

import numpy as np
from isal import isal_zlib

from .blocks import Blocks, BrokenBlockError, StoredPart

_DAMAGED: Final = cast("type[Exception]", isal_zlib.error)
# Number of decompressed blocks kept, because a record may extend over two blocks.
_KEPT: Final = 3


class LinkedData:
    """All bytes of one data link, independent of their division into blocks.

    Attributes:
        size: Declared size in bytes, including unreadable parts.
        broken: Reason why the following data are unknown; empty if the chain of blocks is intact.
    """

    def __init__(self, blocks: Blocks, link: int, unfinished: int) -> None:
        """Find the blocks by reading their headers."""
        self._blocks = blocks
        self._stretches: list[StoredPart] = []
        self.broken = ""
        try:
            self._stretches.extend(
                stretch for stretch in blocks.stretches(link, unfinished) if stretch.size
            )
        except BrokenBlockError as broken:
            self.broken = str(broken)
        self._starts = [stretch.start for stretch in self._stretches]
        self._damage = {k: one.damage for k, one in enumerate(self._stretches) if one.damage}
        self._inflated: dict[int, bytes] = {}
        last = self._stretches[-1] if self._stretches else None
        self.size = last.start + last.size if last else 0

    @property
    def missing(self) -> str:
        """Describe damage that is known without reading the data; empty for none."""
        for k, one in enumerate(self._stretches):
            if k in self._damage:
                return self._damage[k]
            if one.at + one.stored > self._blocks.size:
                return f"the file ends before byte {one.at + one.stored}"
        return self.broken

    def read(self, start: int, count: int) -> bytes:
        """Read ``count`` bytes from ``start`` on, or fewer up to damage or the stream's end."""
        parts: list[bytes] = []
        k, end = max(bisect_right(self._starts, start) - 1, 0), min(start + count, self.size)
        while start < end:
            part = self._part(k, start, end)
            if not part:
                break
            parts.append(part)
            start += len(part)
            k += 1
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def hole(self, start: int, stop: int) -> tuple[int, str] | None:
        """Return the end and the damage of the first known unreadable part in these bytes."""
        for k in range(max(bisect_right(self._starts, start) - 1, 0), len(self._stretches)):
            one = self._stretches[k]
            if one.start >= stop:
                break
            if k in self._damage and one.start + one.size > start:
                return one.start + one.size, self._damage[k]
        return None

    def _part(self, k: int, start: int, end: int) -> bytes:
        one = self._stretches[k]
        if k in self._damage:
            return b""
        skip, count = start - one.start, min(end, one.start + one.size) - start
        if one.method >= 0:
            return self._content(k)[skip : skip + count]
        part = self._blocks.read(one.at + skip, count)
        if len(part) < count:
            self._damage[k] = f"the file ends before byte {one.at + skip + count}"
        return part

    def _content(self, k: int) -> bytes:
        if k not in self._inflated:
            one = self._stretches[k]
            content, damage = _inflated(one, self._blocks.read(one.at, one.stored))
            if damage:
                self._damage[k] = f"compressed block at byte {one.at - 48} {damage}"
                return b""
            while len(self._inflated) >= _KEPT:
                del self._inflated[next(iter(self._inflated))]
            self._inflated[k] = content
        return self._inflated[k]


def _inflated(one: StoredPart, stored: bytes) -> tuple[bytes, str]:
    """Decompress a block; return its content, or empty bytes and the problem."""
    if one.method not in (0, 1):
        return b"", f"has the unknown method {one.method}"
    inflater = isal_zlib.decompressobj()
    try:
        content = inflater.decompress(stored, one.size + 1)
    except _DAMAGED:
        return b"", "fails its checksum"
    if not inflater.eof or len(content) != one.size:
        found = f"more than {one.size}" if len(content) > one.size else str(len(content))
        return b"", f"is cut or damaged: inflates to {found} bytes, declares {one.size}"
    return (_transposed(content, one.parameter) if one.method == 1 else content), ""


def _transposed(content: bytes, columns: int) -> bytes:
    """Undo the transposition of compressed records."""
    if columns < 2 or columns > len(content):
        return content
    rows = len(content) // columns
    whole = np.frombuffer(content, np.uint8, rows * columns).reshape(columns, rows)
    return whole.T.tobytes() + content[rows * columns :]

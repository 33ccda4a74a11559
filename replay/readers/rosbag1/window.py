"""Location of a time range in a ROS 1 bag by its index section.

The index has no checksum, so it is trusted only if an error would be detected. It must list as many
chunks as the bag's header states, and the chunks must be in order of time. The neighbors of the
selected chunks are examined too. A wrong time then violates the order, or belongs to an examined
chunk that contradicts it.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from crosscue.replay.base import Selection
from crosscue.replay.limits import Limits

from .index import BytesBetween, ChunkUnit, Contents, units
from .records import BagFile, BagRecord, ChunkInfo


@dataclass(frozen=True, slots=True)
class BagWindow:
    """The location of a time range.

    Attributes:
        infos: All chunks, in the order of the file.
        is_read: True for each chunk that is read: the selected chunks and their neighbors.
        index_at: End of the chunks.
        is_asked: True for each chunk that the index places in the time range.
    """

    infos: tuple[ChunkInfo, ...]
    is_read: tuple[bool, ...]
    index_at: int
    is_asked: tuple[bool, ...]

    @property
    def left(self) -> tuple[ChunkInfo, ...]:
        """Chunks that are not read."""
        return self._those(is_read=False)

    def ranges(self) -> list[tuple[int, int]]:
        """Return the ranges of the selected chunks and their index records."""
        edges = pairwise([*(info.at for info in self.infos), self.index_at])
        return [edge for edge, asked in zip(edges, self.is_asked, strict=True) if asked]

    def units(
        self, file: BagFile, limits: Limits, connections: Collection[int], *, is_read: bool = True
    ) -> Iterator[ChunkUnit | BagRecord | BytesBetween]:
        """Yield the units of the chunks that are read, or of the others, in stored order."""
        known = [info.at for info in self.infos]
        after = dict(pairwise([*known, self.index_at]))
        for info in self._those(is_read=is_read):
            for unit in units(file, info.at, known, limits, connections):
                yield unit
                end = unit.stop if isinstance(unit, BytesBetween) else unit.end
                if end >= after[info.at]:
                    break

    def _those(self, *, is_read: bool) -> tuple[ChunkInfo, ...]:
        return tuple(i for i, r in zip(self.infos, self.is_read, strict=True) if r is is_read)


def find_bag_window(contents: Contents, selection: Selection) -> BagWindow | str:
    """Locate the selected time range, or return the reason why the index cannot be used."""
    infos = tuple(contents.infos[at] for at in sorted(contents.infos))
    if not contents.is_complete or not infos:
        return "it has no usable index of chunks"
    if not selection.is_timed:
        return "its index of chunks has no checksum"
    if contents.chunk_count != len(infos):
        return f"its index lists {len(infos)} chunks, its header states {contents.chunk_count}"
    if infos[0].at != contents.first or infos[-1].at >= contents.index_at:
        return "its index does not cover exactly the chunks before it"
    if any(info.start_ns > info.end_ns for info in infos) or any(
        a.start_ns > b.start_ns or a.end_ns > b.end_ns for a, b in pairwise(infos)
    ):
        return "its index has no checksum, and its chunks are not in order of time"
    if not all(info.counts.keys() <= contents.connections.keys() for info in infos):
        return "its index refers to connections that it does not describe"
    spans = np.array([(info.start_ns, info.end_ns) for info in infos], np.int64)
    asked = selection.overlaps(spans[:, 0], spans[:, 1]).tolist()
    is_asked = tuple(asked)
    if not any(asked):  # between two chunks, or beyond the bag's ends
        begins = selection.start_ns if selection.start_ns is not None else infos[0].start_ns
        place = sum(info.end_ns < begins for info in infos)
        asked[min(place, len(infos) - 1)] = True
    around = zip([False, *asked], asked, [*asked[1:], False], strict=False)
    return BagWindow(infos, tuple(any(three) for three in around), contents.index_at, is_asked)

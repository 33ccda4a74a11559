"""Which bytes of a ROS 1 bag hold a span of time, by its index section alone.

The index carries no checksum, so it is trusted only where it cannot well be wrong unseen: it names
as many chunks as the bag's header, these follow each other in time, and the chunks next to those
asked for are examined, too. A wrong time then stands out of order, or belongs to a chunk that is
examined and says something else itself.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from itertools import pairwise

from crosscue.replay.base import Limits, Selection

from .index import ChunkUnit, Contents, Gap, units
from .records import BagFile, ChunkInfo, Record


@dataclass(frozen=True, slots=True)
class BagWindow:
    """Where a span of time lies.

    Attributes:
        infos: All chunks, in the order of the file.
        is_read: For each, whether it may hold messages of that span.
        index_at: Where the chunks end.
        is_asked: For each, whether the index says so; the others that are read are neighbors.
    """

    infos: tuple[ChunkInfo, ...]
    is_read: tuple[bool, ...]
    index_at: int
    is_asked: tuple[bool, ...]

    @property
    def left(self) -> tuple[ChunkInfo, ...]:
        """The chunks that are not read."""
        return self._those(is_read=False)

    def ranges(self) -> list[tuple[int, int]]:
        """Where the chunks asked for and their index records are."""
        edges = pairwise([*(info.at for info in self.infos), self.index_at])
        return [edge for edge, asked in zip(edges, self.is_asked, strict=True) if asked]

    def units(
        self,
        file: BagFile,
        limits: Limits,
        connections: Collection[int],
        *,
        is_read: bool = True,
    ) -> Iterator[ChunkUnit | Record | Gap]:
        """What is in the chunks that are read, or in the others, in the order of the file."""
        known = [info.at for info in self.infos]
        after = dict(pairwise([*known, self.index_at]))
        for info in self._those(is_read=is_read):
            for unit in units(file, info.at, known, limits, connections):
                yield unit
                end = unit.stop if isinstance(unit, Gap) else unit.end
                if end >= after[info.at]:
                    break

    def _those(self, *, is_read: bool) -> tuple[ChunkInfo, ...]:
        return tuple(i for i, r in zip(self.infos, self.is_read, strict=True) if r is is_read)


def find_bag_window(
    contents: Contents, first: int, index_at: int, chunk_count: int, selection: Selection
) -> BagWindow | str:
    """Where the span of time asked for lies, or why the index cannot tell.

    Args:
        contents: What the index section says.
        first: Where the bag's first record stands.
        index_at: Where the index section begins.
        chunk_count: Chunks as the bag's header counts them.
        selection: What is asked for.
    """
    infos = tuple(contents.infos[at] for at in sorted(contents.infos))
    if not contents.is_complete or not infos:
        return "it has no index of chunks that can be used"
    if selection.start_ns is None and selection.end_ns is None:
        return "its index of chunks carries no checksum"
    if chunk_count != len(infos):
        return f"its index names {len(infos)} chunks, its header counts {chunk_count}"
    if infos[0].at != first or infos[-1].at >= index_at:
        return "its index does not begin with its first chunk and end before itself"
    if any(info.start_ns > info.end_ns for info in infos) or any(
        a.start_ns > b.start_ns or a.end_ns > b.end_ns for a, b in pairwise(infos)
    ):
        return "its index carries no checksum, and its chunks are not in order of time"
    if not all(info.counts.keys() <= contents.connections.keys() for info in infos):
        return "its index names connections that it does not describe"
    asked = [
        (selection.start_ns is None or info.end_ns >= selection.start_ns)
        and (selection.end_ns is None or info.start_ns < selection.end_ns)
        for info in infos
    ]
    is_asked = tuple(asked)
    if not any(asked):  # between two chunks, or beyond the bag's ends
        begins = selection.start_ns if selection.start_ns is not None else infos[0].start_ns
        place = sum(info.end_ns < begins for info in infos)
        asked[min(place, len(infos) - 1)] = True
    around = zip([False, *asked], asked, [*asked[1:], False], strict=False)
    return BagWindow(infos, tuple(any(three) for three in around), index_at, is_asked)

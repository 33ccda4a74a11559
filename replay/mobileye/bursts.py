"""Which frames of an image belong together.

A status frame (0x738) opens the burst of one image and says how many obstacles follow; each comes
as a triple A, B, C in its slot. Nothing is joined across two status frames, and a frame that fits
nowhere is reported with its reason, never joined.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .bits import Words

Int64s: TypeAlias = NDArray[np.int64]

NO_STATUS: Final = "obstacle before the first status frame"
LATE: Final = "too long after its status frame"
REPEATED: Final = "repeated frame"
NEXT_BURST: Final = "slot sent twice: the status frame between is missing"
BEYOND_COUNT: Final = "slot beyond the count of its status frame"
CUT: Final = "obstacle cut: A, B or C is missing"
LANE_A_ALONE: Final = "lane A without its B"
LANE_B_ALONE: Final = "lane B without its A"

NO_BURST: Final = -1
SLOTS_AT_MOST: Final = 16


@dataclass(frozen=True, slots=True, eq=False)
class Status:
    """Status frames that open a burst, and the bursts' numbers.

    Attributes:
        number: Shape (M,), int64, rising by one: the burst.
        log_ns: Shape (M,).
        image_ns: Shape (M,).
        count: Shape (M,), int64: obstacles announced.
        variant: Shape (M,), int8: revision.
    """

    number: Int64s
    log_ns: Int64s
    image_ns: Int64s
    count: Int64s
    variant: NDArray[np.int8]

    def __len__(self) -> int:
        return len(self.number)

    def at(self, burst: Int64s) -> Int64s:
        """Places of bursts by their numbers; numbers of none of them give places outside."""
        places: Int64s = burst - self.number[0]
        return places

    def take(self, index: NDArray[np.intp] | slice) -> Status:
        """The statuses picked by ``index``."""
        return Status(
            self.number[index],
            self.log_ns[index],
            self.image_ns[index],
            self.count[index],
            self.variant[index],
        )

    def __add__(self, later: Status) -> Status:
        return Status(
            np.concatenate([self.number, later.number]),
            np.concatenate([self.log_ns, later.log_ns]),
            np.concatenate([self.image_ns, later.image_ns]),
            np.concatenate([self.count, later.count]),
            np.concatenate([self.variant, later.variant]),
        )


def no_status() -> Status:
    """No status frame yet."""
    none = np.zeros(0, dtype=np.int64)
    return Status(none, none, none, none, np.zeros(0, dtype=np.int8))


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """Frames that are one part of something of several parts, in the order of the log.

    Attributes:
        burst: Shape (N,), int64: number of the last status frame before, or ``NO_BURST``.
        place: Shape (N,), int64: obstacle slot, or instance of a lane.
        part: Shape (N,), int64: 0 for A, 1 for B, 2 for C.
        log_ns: Shape (N,).
        words: Shape (N,): payloads.
    """

    burst: Int64s
    place: Int64s
    part: Int64s
    log_ns: Int64s
    words: Words

    def __len__(self) -> int:
        return len(self.burst)

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_] | slice) -> Parts:
        """The frames picked by ``index``."""
        return Parts(
            self.burst[index],
            self.place[index],
            self.part[index],
            self.log_ns[index],
            self.words[index],
        )

    def __add__(self, later: Parts) -> Parts:
        return Parts(
            np.concatenate([self.burst, later.burst]),
            np.concatenate([self.place, later.place]),
            np.concatenate([self.part, later.part]),
            np.concatenate([self.log_ns, later.log_ns]),
            np.concatenate([self.words, later.words]),
        )


def no_parts() -> Parts:
    """No frames."""
    none = np.zeros(0, dtype=np.int64)
    return Parts(none, none, none, none, np.zeros(0, dtype=np.uint64))


class Fault(NamedTuple):
    """Frames not joined, and why.

    Attributes:
        reason: Short, the same for all of a kind.
        log_ns: Shape (K,): of each frame.
        burst: Shape (K,): the burst each is in.
    """

    reason: str
    log_ns: Int64s
    burst: Int64s


class Triples(NamedTuple):
    """Whole obstacles: rows of A, B and C, ordered by burst and slot."""

    a: Parts
    b: Parts
    c: Parts


class Shortage(NamedTuple):
    """Frames that status frames announced and that did not come.

    Attributes:
        number: Shape (K,): the burst.
        log_ns: Shape (K,): of its status frame.
        frames: Shape (K,): how many are missing.
    """

    number: Int64s
    log_ns: Int64s
    frames: Int64s


def sift(
    parts: Parts, status: Status, within_ns: int, kept: int = 0, is_closed: bool = False
) -> tuple[Parts, list[Fault], bool]:
    """Leave out obstacle frames that belong to no burst, or to one that cannot be determined.

    Args:
        parts: In the order of the log.
        status: Holds every burst that ``parts`` name.
        within_ns: How far from its status frame a frame may be.
        kept: So many at the front were sifted before.
        is_closed: The first burst of ``status`` can take no further frame.

    Returns:
        The frames left; the others; and whether the last burst can take no further frame.
    """
    faults: list[Fault] = []
    parts = _leave(parts, parts.burst == NO_BURST, NO_STATUS, faults)
    if not len(parts):
        return parts, faults, is_closed and len(status) == 1
    at = status.at(parts.burst)
    parts = _leave(parts, np.abs(parts.log_ns - status.log_ns[at]) > within_ns, LATE, faults)
    at = status.at(parts.burst)
    parts = _leave(parts, parts.place >= status.count[at], BEYOND_COUNT, faults)
    first = _first_of_slot(parts)
    is_again = first != np.arange(len(parts))
    # From the first slot that comes again with other content on, frames are of another image.
    is_next = _from_first(is_again & (parts.words != parts.words[first]), parts.burst)
    if is_closed:
        is_next |= (np.arange(len(parts)) >= kept) & (parts.burst == status.number[0])
    is_shut = bool(is_next[parts.burst == status.number[-1]].any())
    _leave(parts, is_again & ~is_next, REPEATED, faults)
    _leave(parts, is_next, NEXT_BURST, faults)
    parts = parts.take(~is_again & ~is_next)
    return parts, faults, is_shut or (is_closed and len(status) == 1)


def join(parts: Parts) -> tuple[Triples, list[Fault]]:
    """Obstacles of finished bursts; ``parts`` are sifted, so no part comes twice."""
    obstacle = parts.burst * SLOTS_AT_MOST + parts.place
    order = np.lexsort((parts.part, obstacle))
    obstacle = obstacle[order]
    _, size = np.unique(obstacle, return_counts=True)
    is_whole = np.repeat(size == 3, size)
    whole = parts.take(order[is_whole])
    cut = parts.take(np.sort(order[~is_whole]))
    faults = [Fault(CUT, cut.log_ns, cut.burst)] if len(cut) else []
    return Triples(
        whole.take(np.s_[0::3]), whole.take(np.s_[1::3]), whole.take(np.s_[2::3])
    ), faults


def shortage(parts: Parts, status: Status, slots: int) -> Shortage:
    """What finished bursts lack: three frames an obstacle announced, less those that came."""
    wanted = 3 * np.minimum(status.count, slots)
    at = status.at(parts.burst) if len(parts) else parts.burst
    came = np.bincount(at, minlength=len(status))
    lacking = wanted - came
    short = lacking > 0
    return Shortage(status.number[short], status.log_ns[short], lacking[short])


def pair(parts: Parts, within_ns: int, is_last: bool) -> tuple[Parts, Parts, Parts, list[Fault]]:
    """Lanes: each A with the B of the same lane that follows it in the same burst.

    Args:
        parts: In the order of the log; those kept from before first.
        within_ns: How long after its A a B may come.
        is_last: No more frames will follow.

    Returns:
        The A and the B of whole lanes, ordered as the B in the log; A that may yet get their B;
        the others.
    """
    order = np.argsort(parts.place, kind="stable")
    ordered = parts.take(order)
    n = len(parts)
    fits = (ordered.part[:-1] == 0) & (ordered.part[1:] == 1)
    fits &= (ordered.place[:-1] == ordered.place[1:]) & (ordered.burst[:-1] == ordered.burst[1:])
    fits &= np.abs(ordered.log_ns[1:] - ordered.log_ns[:-1]) <= within_ns
    a_at = np.flatnonzero(fits)
    alone = np.ones(n, dtype=np.bool_)
    alone[a_at] = alone[a_at + 1] = False
    is_newest = np.ones(n, dtype=np.bool_)
    is_newest[:-1] = ordered.place[:-1] != ordered.place[1:]
    waits = alone & is_newest & (ordered.part == 0) & (not is_last)
    faults: list[Fault] = []
    for part, reason in ((0, LANE_A_ALONE), (1, LANE_B_ALONE)):
        _leave(ordered, alone & ~waits & (ordered.part == part), reason, faults)
    by_log = np.argsort(order[a_at + 1])
    waiting = ordered.take(np.flatnonzero(waits)[np.argsort(order[waits])])
    return ordered.take(a_at[by_log]), ordered.take(a_at[by_log] + 1), waiting, faults


def _leave(parts: Parts, out: NDArray[np.bool_], reason: str, faults: list[Fault]) -> Parts:
    if not out.any():
        return parts
    faults.append(Fault(reason, parts.log_ns[out], parts.burst[out]))
    return parts.take(~out)


def _first_of_slot(parts: Parts) -> NDArray[np.intp]:
    """For each frame, the first one with the same burst, slot and part."""
    key = (parts.burst * SLOTS_AT_MOST + parts.place) * 3 + parts.part
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    places: NDArray[np.intp] = first[inverse]
    return places


def _from_first(is_mark: NDArray[np.bool_], burst: Int64s) -> NDArray[np.bool_]:
    """True from the first mark of each burst to its end; ``burst`` never decreases."""
    marks = np.cumsum(is_mark, dtype=np.int64)
    before = marks - is_mark.astype(np.int64)
    _, start, inverse = np.unique(burst, return_index=True, return_inverse=True)
    return marks > before[start][inverse] if len(burst) else is_mark


def events(fault: Fault, at_most: int) -> Iterator[tuple[int, int, int]]:
    """Of each burst that a fault concerns: its number, first log time and frames; then the rest.

    Beyond ``at_most`` bursts the remaining frames come as one, under the next burst's number.
    """
    number, start, count = np.unique(fault.burst, return_index=True, return_counts=True)
    for k in range(min(len(number), at_most)):
        yield int(number[k]), int(fault.log_ns[start[k]]), int(count[k])
    if len(number) > at_most:
        k = at_most
        yield int(number[k]), int(fault.log_ns[start[k]]), int(count[at_most:].sum())

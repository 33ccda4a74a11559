"""Join the frames of an image.

A status frame (0x738) starts the burst of one image and announces the number of obstacles. Each
obstacle is a triple of frames A, B, C in its slot. Frames are never joined across two status
frames, and a frame that cannot be assigned is reported with its reason.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import ColumnSet, Int64s

from .bits import Words

NO_STATUS: Final = "obstacle before the first status frame"
LATE: Final = "too long after its status frame"
REPEATED: Final = "repeated frame"
NEXT_BURST: Final = "slot sent twice: the status frame in between is missing"
BEYOND_COUNT: Final = "slot beyond the count of its status frame"
CUT: Final = "incomplete obstacle: A, B or C is missing"
LANE_A_ALONE: Final = "lane A without its B"
LANE_B_ALONE: Final = "lane B without its A"

NO_BURST: Final = -1
SLOTS_AT_MOST: Final = 16


@dataclass(frozen=True, slots=True, eq=False)
class Status(ColumnSet):
    """Status frames that start a burst, and the bursts' numbers.

    Attributes:
        number: Number of the burst, shape (M,), int64, increasing by one.
        log_ns: Log time, shape (M,).
        image_ns: Image time, shape (M,).
        count: Number of announced obstacles, shape (M,), int64.
        variant: Revision, shape (M,), int8.
    """

    number: Int64s
    log_ns: Int64s
    image_ns: Int64s
    count: Int64s
    variant: NDArray[np.int8]

    def at(self, burst: Int64s) -> Int64s:
        """Return the indices of bursts by number; unknown numbers yield indices out of range."""
        places: Int64s = burst - self.number[0]
        return places


def no_status() -> Status:
    """Return an empty ``Status``."""
    none = np.zeros(0, dtype=np.int64)
    return Status(none, none, none, none, np.zeros(0, dtype=np.int8))


@dataclass(frozen=True, slots=True, eq=False)
class FrameParts(ColumnSet):
    """Frames that are parts of obstacles or lanes, in the order of the log.

    Attributes:
        burst: Number of the last status frame before, or ``NO_BURST``, shape (N,), int64.
        place: Obstacle slot, or instance of a lane, shape (N,), int64.
        part: 0 for A, 1 for B, 2 for C, shape (N,), int64.
        log_ns: Log time, shape (N,).
        words: Payloads, shape (N,).
    """

    burst: Int64s
    place: Int64s
    part: Int64s
    log_ns: Int64s
    words: Words


def no_parts() -> FrameParts:
    """Return an empty ``FrameParts``."""
    none = np.zeros(0, dtype=np.int64)
    return FrameParts(none, none, none, none, np.zeros(0, dtype=np.uint64))


class Fault(NamedTuple):
    """Frames that were not joined, and the reason.

    Attributes:
        reason: Short reason, equal for all frames of a kind.
        log_ns: Log time of each frame, shape (K,).
        burst: Burst of each frame, shape (K,).
    """

    reason: str
    log_ns: Int64s
    burst: Int64s


def sift(
    parts: FrameParts, status: Status, within_ns: int, kept: int = 0, is_closed: bool = False
) -> tuple[FrameParts, list[Fault], bool]:
    """Remove obstacle frames that belong to no burst, or whose burst is ambiguous.

    Args:
        parts: Frames in the order of the log.
        status: Status frames of all bursts of ``parts``.
        within_ns: Max time from its status frame to a frame.
        kept: Number of frames at the front that were sifted before.
        is_closed: True if the first burst of ``status`` accepts no further frames.

    Returns:
        The remaining frames; the others; and whether the last burst accepts no further frames.
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
    # A slot that is repeated with other content belongs to another image, like all later frames.
    is_next = _from_first(is_again & (parts.words != parts.words[first]), parts.burst)
    if is_closed:
        is_next |= (np.arange(len(parts)) >= kept) & (parts.burst == status.number[0])
    is_shut = bool(is_next[parts.burst == status.number[-1]].any())
    _leave(parts, is_again & ~is_next, REPEATED, faults)
    _leave(parts, is_next, NEXT_BURST, faults)
    parts = parts.take(~is_again & ~is_next)
    return parts, faults, is_shut or (is_closed and len(status) == 1)


def join_obstacles(parts: FrameParts) -> tuple[list[FrameParts], list[Fault]]:
    """Join the obstacles of finished bursts; ``parts`` are sifted, so that no part is repeated.

    Returns:
        The rows of A, B and C of complete obstacles, ordered by burst and slot; the others.
    """
    obstacle = parts.burst * SLOTS_AT_MOST + parts.place
    order = np.lexsort((parts.part, obstacle))
    obstacle = obstacle[order]
    _, size = np.unique(obstacle, return_counts=True)
    is_whole = np.repeat(size == 3, size)
    whole = parts.take(order[is_whole])
    cut = parts.take(np.sort(order[~is_whole]))
    faults = [Fault(CUT, cut.log_ns, cut.burst)] if len(cut) else []
    return [whole.take(np.s_[k::3]) for k in range(3)], faults


def shortage(parts: FrameParts, status: Status, slots: int) -> tuple[Int64s, Int64s, Int64s]:
    """Find missing frames of finished bursts: three per announced obstacle, minus those found.

    Returns:
        Shape (K,) each: number of the burst, log time of its status frame, and missing frames.
    """
    wanted = 3 * np.minimum(status.count, slots)
    at = status.at(parts.burst) if len(parts) else parts.burst
    came = np.bincount(at, minlength=len(status))
    lacking = wanted - came
    short = lacking > 0
    return status.number[short], status.log_ns[short], lacking[short]


def pair_lanes(
    parts: FrameParts, within_ns: int, is_last: bool
) -> tuple[FrameParts, FrameParts, FrameParts, list[Fault]]:
    """Pair each frame A of a lane with the B of the same lane that follows in the same burst.

    Args:
        parts: Frames in the order of the log; frames kept from before are first.
        within_ns: Max time from A to its B.
        is_last: True if no more frames will follow.

    Returns:
        The A and the B of complete lanes, ordered like the B in the log; frames A whose B may still
        follow; the others.
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


def _leave(
    parts: FrameParts, out: NDArray[np.bool_], reason: str, faults: list[Fault]
) -> FrameParts:
    if not out.any():
        return parts
    faults.append(Fault(reason, parts.log_ns[out], parts.burst[out]))
    return parts.take(~out)


def _first_of_slot(parts: FrameParts) -> NDArray[np.intp]:
    """Return, for each frame, the first frame with the same burst, slot and part."""
    key = (parts.burst * SLOTS_AT_MOST + parts.place) * 3 + parts.part
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    places: NDArray[np.intp] = first[inverse]
    return places


def _from_first(is_mark: NDArray[np.bool_], burst: Int64s) -> NDArray[np.bool_]:
    """Return a mask from the first mark of each burst to its end; ``burst`` never decreases."""
    marks = np.cumsum(is_mark, dtype=np.int64)
    before = marks - is_mark.astype(np.int64)
    _, start, inverse = np.unique(burst, return_index=True, return_inverse=True)
    return marks > before[start][inverse] if len(burst) else is_mark


def events(fault: Fault, at_most: int) -> Iterator[tuple[int, int, int]]:
    """Yield number, first log time and number of frames of each burst with a fault.

    Beyond ``at_most`` bursts, the remaining frames are one event with the next burst's number.
    """
    number, start, count = np.unique(fault.burst, return_index=True, return_counts=True)
    for k in range(min(len(number), at_most)):
        yield int(number[k]), int(fault.log_ns[start[k]]), int(count[k])
    if len(number) > at_most:
        k = at_most
        yield int(number[k]), int(fault.log_ns[start[k]]), int(count[at_most:].sum())

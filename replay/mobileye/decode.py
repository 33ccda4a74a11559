"""Frames of a Mobileye's bus to tables, in columns.

Obstacles are joined by burst and slot, lanes from their two halves; see ``bursts``. What cannot be
joined or understood is reported to the ledger under the bus's name, with its log time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from crosscue.replay.columns import Block, CanFrames, Int64s
from crosscue.replay.ledger import Ledger

from .admit import Admission, Admitted
from .bits import Words
from .bursts import (
    CUT,
    NO_BURST,
    Fault,
    Parts,
    Status,
    events,
    join,
    no_parts,
    pair,
    shortage,
    sift,
)
from .clock import CounterClock
from .family import FamilyEvidence
from .layout import UNKNOWN, Message, layout
from .settings import DEFAULTS, MobileyeSettings, mounting_of
from .status import Statuses, by_length
from .tables import lane_places, table_block, to_vehicle
from .wire import Columns, Variant, columns_of, values_of, variant_number

CUT_AT_END: Final = "obstacle cut by the end of the log"
NOT_COME: Final = "obstacle frames announced by a status frame that did not come"
_EVENTS_TOLD: Final = 50
_OBSTACLE_PARTS: Final = ("obstacle_a", "obstacle_b", "obstacle_c")
_LANE_PARTS: Final = {
    "lanes": ("lane_a", "lane_b"),
    "next_lanes": ("next_lane_a", "next_lane_b"),
}


class MobileyeDecoder:
    """Decodes the frames of one Mobileye's bus, a block at a time.

    Give it the blocks of the bus in the order of the log, then call ``flush`` once: the last burst
    is held back until it is known to be whole. How the log is cut into blocks changes nothing.
    """

    def __init__(self, bus: str, ledger: Ledger, settings: MobileyeSettings = DEFAULTS) -> None:
        """Prepare.

        Args:
            bus: Topic of the frames; tables are called ``BUS/mobileye/TABLE``.
            ledger: Reported of every frame not used; the reader has counted those found.
            settings: How to read this device.
        """
        self._bus = bus
        self._ledger = ledger
        self._settings = settings
        self._admit = Admission(bus, ledger, settings)
        self._clock = CounterClock(settings.least_latency_ns)
        self._family = FamilyEvidence(bus, settings.family)
        self._statuses = Statuses(bus, ledger, settings, self._clock)
        self._open = no_parts()
        self._is_closed = False
        self._lanes = {table: no_parts() for table in _LANE_PARTS}
        self._mounting = mounting_of(settings, bus, ledger)

    def __call__(self, block: Block) -> list[Block]:
        """Decode the frames of a block.

        Returns:
            One block for each table that gained rows. Rows of obstacles carry the log time of their
            status frame, and their image time as ``header_ns``.

        Raises:
            ValueError: The rows are no ``CanFrames``.
        """
        if not isinstance(block.rows, CanFrames):
            raise ValueError(f"{block.topic}: want CanFrames, got {type(block.rows).__name__}")
        frames = self._admit(block.rows, block.log_ns)
        before = self._statuses.last
        opened, status_block, burst_at = self._statuses(frames)
        known = before + opened
        given = [] if status_block is None else [status_block]
        given += self._obstacles(frames, burst_at, known)
        for table in _LANE_PARTS:
            given += self._lane_rows(table, frames, burst_at)
        for number, message in enumerate(layout().messages):
            if message.table in ("status", "obstacles", *_LANE_PARTS):
                continue
            rows = np.flatnonzero(frames.message == number)
            if len(rows):
                given.append(self._plain(message, frames.take(rows), burst_at[rows], known))
        return given

    def flush(self) -> list[Block]:
        """The last burst, as far as it came, and what a person should know about the whole."""
        given = self._finish(self._open, self._statuses.last, is_end=True)
        self._open = no_parts()
        for table in _LANE_PARTS:
            given += self._pair(table, self._lanes[table], is_last=True)
        for notice in self._clock.notices:
            self._ledger.notice(f"{self._bus}: {notice}")
        for notice in self._family.notices():
            self._ledger.notice(notice)
        return given

    def _obstacles(self, frames: Admitted, burst_at: Int64s, known: Status) -> list[Block]:
        parts = self._open + _parts_of(frames, burst_at, _OBSTACLE_PARTS)
        kept, faults, is_closed = sift(
            parts, known, self._settings.within_ns, len(self._open), self._is_closed
        )
        self._report(faults)
        if not len(known):
            return []
        last = int(known.number[-1])
        is_open = kept.burst == last
        self._open = kept.take(is_open)
        self._is_closed = is_closed
        return self._finish(kept.take(~is_open), known.take(np.s_[:-1]), is_end=False)

    def _finish(self, parts: Parts, status: Status, is_end: bool) -> list[Block]:
        triples, faults = join(parts)
        if is_end:
            faults = [f._replace(reason=CUT_AT_END) if f.reason == CUT else f for f in faults]
        self._report(faults)
        lacking = shortage(parts, status, self._settings.slots)
        for number, log_ns, count in zip(*(c.tolist() for c in lacking), strict=True):
            if is_end:
                self._ledger.notice(
                    f"{self._bus}: the log ends within an image's burst; {count} obstacle frames "
                    "of it are not there"
                )
            else:
                self._ledger.drop(self._bus, NOT_COME, count, f"burst {number}", log_ns)
        if not len(triples.a):
            return []
        at = status.at(triples.a.burst)
        image_ns, log_ns_of_row = status.image_ns[at], status.log_ns[at]
        columns: Columns = {
            "t_ns": image_ns,
            "status_log_ns": log_ns_of_row,
            "burst": triples.a.burst,
            "slot": triples.a.place.astype(np.int8),
        }
        for name, part in zip(_OBSTACLE_PARTS, triples, strict=True):
            columns |= _columns(layout()[name], part.words, _unknown(len(part)))
        columns = to_vehicle("obstacles", columns, self._mounting)
        return [table_block(self._bus, "obstacles", log_ns_of_row, columns, image_ns)]

    def _lane_rows(self, table: str, frames: Admitted, burst_at: Int64s) -> list[Block]:
        fresh = _parts_of(frames, burst_at, _LANE_PARTS[table])
        return self._pair(table, self._lanes[table] + fresh, is_last=False) if len(fresh) else []

    def _pair(self, table: str, parts: Parts, is_last: bool) -> list[Block]:
        a, b, self._lanes[table], faults = pair(parts, self._settings.within_ns, is_last)
        self._report(faults)
        if not len(a):
            return []
        columns: Columns = {"t_ns": a.log_ns, "burst": a.burst, **lane_places(table, a.place)}
        for name, part in zip(_LANE_PARTS[table], (a, b), strict=True):
            columns |= _columns(layout()[name], part.words, _unknown(len(part)))
        return [table_block(self._bus, table, a.log_ns, to_vehicle(table, columns, self._mounting))]

    def _plain(self, message: Message, frames: Admitted, burst: Int64s, known: Status) -> Block:
        columns: Columns = {"t_ns": frames.log_ns, "burst": burst}
        if message.name == "sign":
            columns["sign"] = (frames.instance + 1).astype(np.int8)
        variant = self._variant(message, frames, burst, known)
        if message.variant:
            columns["layout"] = variant
        columns |= _columns(message, frames.words, variant)
        columns = to_vehicle(message.table, columns, self._mounting)
        return table_block(self._bus, message.table, frames.log_ns, columns)

    def _variant(self, message: Message, frames: Admitted, burst: Int64s, known: Status) -> Variant:
        if message.variant == "family":
            return self._family(frames.words)
        if message.variant == "length":
            return by_length(message, frames.length, self._settings)
        if message.variant != "revision":
            return _unknown(len(frames))
        if self._settings.revision != "auto":
            number = variant_number(self._settings.revision)
            return np.full(len(frames), number, dtype=np.int8)
        is_early = burst == NO_BURST
        if is_early.any():
            self._ledger.notice(
                f"{self._bus}: frames 0x{message.ids[0]:03X} before the first status frame; what "
                "depends on the protocol revision is missing there; set the revision"
            )
        if is_early.all():
            return _unknown(len(frames))
        at = np.maximum(known.at(burst), 0)
        return np.where(is_early, UNKNOWN, known.variant[at]).astype(np.int8)

    def _report(self, faults: Sequence[Fault]) -> None:
        for fault in faults:
            for burst, log_ns, count in events(fault, _EVENTS_TOLD):
                where = f"burst {burst}" if burst != NO_BURST else "no burst"
                self._ledger.skip(self._bus, fault.reason, count, where, log_ns)


def _parts_of(frames: Admitted, burst_at: Int64s, names: Sequence[str]) -> Parts:
    messages = layout().messages
    numbers = np.array([next(k for k, m in enumerate(messages) if m.name == n) for n in names])
    part = np.full(len(messages), -1, dtype=np.int64)
    part[numbers] = np.arange(len(names))
    of_frame = part[frames.message]
    rows = np.flatnonzero(of_frame >= 0)
    return Parts(
        burst_at[rows],
        frames.instance[rows],
        of_frame[rows],
        frames.log_ns[rows],
        frames.words[rows],
    )


def _columns(message: Message, words: Words, variant: Variant) -> Columns:
    return columns_of(message, values_of(message, words, variant))


def _unknown(n: int) -> Variant:
    return np.full(n, UNKNOWN, dtype=np.int8)

"""Decode the frames of a Mobileye's bus into tables.

Obstacles are joined by burst and slot, lanes from their two halves; see ``bursts``. Frames that
cannot be joined or decoded are reported in the ledger under the bus's name, with their log time.

Two families of devices define the bits of 0x700 differently. The family is decided by a set bit
that only one of them defines. If bits of both are set in one log, it is undecided.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Block, CanFrames, Int64s
from crosscue.replay.ledger import Ledger
from crosscue.replay.mobileye.bits import Words, extract
from crosscue.replay.mobileye.bursts import (
    CUT,
    NO_BURST,
    Fault,
    FrameParts,
    Status,
    events,
    join_obstacles,
    no_parts,
    no_status,
    pair_lanes,
    shortage,
    sift,
)
from crosscue.replay.mobileye.clock import CounterClock
from crosscue.replay.mobileye.layout import (
    LANE_PARTS,
    OBSTACLE_PARTS,
    UNKNOWN,
    VARIANTS,
    BitField,
    Columns,
    Message,
    Variant,
    layout,
    variant_number,
)
from crosscue.replay.mobileye.settings import DEFAULTS, Family, MobileyeSettings, device_mounting
from crosscue.replay.mobileye.tables import lane_places, table_block, to_vehicle
from crosscue.replay.mobileye.wire import si_columns, values_of

from .admit import Admission, Admitted


def _mask(*bits: int) -> np.uint64:
    return np.uint64(sum(1 << b for b in bits))


# Bits that only the extended family defines: sound suppressed, left and right crossing.
ONLY_EXTENDED: Final = _mask(7, 36, 37)
# Bits that only the TSR family defines: zero speed, high beam, error (inverted, so usually set),
# reminders, TSR, repeatable headway.
ONLY_TSR: Final = _mask(13, 14, 15, *range(24, 32), *range(43, 51), 58)


class FamilyEvidence:
    """Evidence of the family from the frames so far."""

    def __init__(self, bus: str, family: Family) -> None:
        self._bus = bus
        self._set = variant_number(family)
        self._extended = False
        self._tsr = False
        self._undecided = 0

    def __call__(self, words: Words) -> Variant:
        """Return the family of each frame, from the evidence of all frames up to it."""
        if self._set != UNKNOWN:
            return np.full(len(words), self._set, dtype=np.int8)
        extended = np.logical_or.accumulate(words & ONLY_EXTENDED != 0) | self._extended
        tsr = np.logical_or.accumulate(words & ONLY_TSR != 0) | self._tsr
        if len(words):
            self._extended, self._tsr = bool(extended[-1]), bool(tsr[-1])
        family = np.where(extended, variant_number("extended"), variant_number("tsr"))
        family = np.where(extended == tsr, UNKNOWN, family)
        self._undecided += int((extended == tsr).sum())
        return family.astype(np.int8)

    def notices(self) -> list[str]:
        """Return notices for the end of the log."""
        if not self._undecided:
            return []
        why = "has bits of both" if self._extended and self._tsr else "at first has bits of neither"
        return [
            f"{self._bus}: 0x700 {why} families of devices; in {self._undecided} frames the bits "
            "that they define differently are missing; set the family (extended or tsr)"
        ]


CUT_AT_END: Final = "incomplete obstacle at the end of the log"
NOT_COME: Final = "obstacle frames announced by a status frame but missing"
_EVENTS_TOLD: Final = 50
REPEATED_STATUS: Final = "repeated status frame"
# Known protocol versions with status frames of 6 bytes.
KNOWN_PROTOCOLS: Final = (1, 3)


class Statuses:
    """Reader of the status frames of one bus, in the order of the log.

    Attributes:
        last: The last status frame that started a burst, if any.
    """

    def __init__(
        self, bus: str, ledger: Ledger, settings: MobileyeSettings, clock: CounterClock
    ) -> None:
        self.last = no_status()
        self._bus = bus
        self._ledger = ledger
        self._settings = settings
        self._clock = clock
        self._message = layout()["status"]
        self._number = [*layout()].index("status")
        self._fields: dict[str, BitField] = {f.name: f for f in self._message.fields}
        self._opened = 0
        self._word = np.zeros(0, dtype=np.uint64)
        self._log_ns = np.zeros(0, dtype=np.int64)

    def __call__(self, frames: Admitted) -> tuple[Status, Block | None, Int64s]:
        """Return the bursts that start, their rows, and the burst of each frame."""
        at = np.flatnonzero(frames.message == self._number)
        opens = self._opens(frames.words[at], frames.log_ns[at])
        repeated_ns = frames.log_ns[at[~opens]]
        if len(repeated_ns):
            count, first_ns = len(repeated_ns), int(repeated_ns[0])
            self._ledger.skip(self._bus, REPEATED_STATUS, count, "0x738", first_ns)
        at = at[opens]
        burst_at = np.zeros(len(frames), dtype=np.int64)
        burst_at[at] = 1
        burst_at = np.cumsum(burst_at) + self._opened - 1
        if not len(at):
            return no_status(), None, burst_at
        opened, block = self._rows(frames.take(at))
        self._opened += len(at)
        self.last = opened.take(np.s_[-1:])
        return opened, block, burst_at

    def _opens(self, words: Words, log_ns: Int64s) -> NDArray[np.bool_]:
        word = np.concatenate([self._word, words])
        log = np.concatenate([self._log_ns, log_ns])
        is_repeated = word[1:] == word[:-1]
        is_repeated &= np.abs(log[1:] - log[:-1]) < self._settings.repeat_within_ns
        opens = np.ones(len(words), dtype=np.bool_)
        opens[len(words) - len(is_repeated) :] = ~is_repeated
        self._word, self._log_ns = word[-1:], log[-1:]
        return opens

    def _rows(self, frames: Admitted) -> tuple[Status, Block]:
        variant = variant_by_length(self._message, frames.length, self._settings)
        columns = si_columns(self._message, values_of(self._message, frames.words, variant))
        counter_ms = self._raw("counter_ms", frames.words)
        image_ns = self._clock.feed(counter_ms, frames.log_ns)
        number = self._opened + np.arange(len(frames), dtype=np.int64)
        self._check(variant, self._raw("protocol_version", frames.words))
        count = self._raw("count", frames.words)
        slots = self._settings.slots
        if (count > slots).any():
            self._ledger.notice(
                f"{self._bus}: a status frame announces {int(count.max())} obstacles; "
                f"there are {slots} slots"
            )
        leading: Columns = {
            "t_ns": image_ns,
            "burst": number,
            "latency_ns": frames.log_ns - image_ns,
            "layout": variant,
        }
        block = table_block(self._bus, "status", frames.log_ns, leading | columns, image_ns)
        return Status(number, frames.log_ns, image_ns, count, variant), block

    def _raw(self, name: str, words: Words) -> Int64s:
        f = self._fields[name]
        return extract(words, f.start, f.bits, f.signed, False)

    def _check(self, variant: Variant, protocol: Int64s) -> None:
        earlier = self.last.variant
        both = np.concatenate([earlier, variant])
        if len(np.unique(both)) > 1:
            self._ledger.notice(
                f"{self._bus}: status frames of both revisions (6 and 7 bytes) on one bus; each "
                "frame is read by its own revision; check whether there are two devices"
            )
        is_classic = variant == variant_number("classic")
        strange = np.setdiff1d(protocol[is_classic], KNOWN_PROTOCOLS)
        if len(strange):
            self._ledger.notice(
                f"{self._bus}: protocol version {int(strange[0])} with status frames of 6 bytes is "
                "unknown; read with the classic layout; check a known drive, or set the revision"
            )


class MobileyeDecoder:
    """Decoder of the frames of one Mobileye's bus, a block at a time.

    Pass the blocks of the bus in the order of the log, then call ``flush`` once: the last burst is
    held back while it may be incomplete. The result does not depend on the division into blocks.
    """

    def __init__(self, bus: str, ledger: Ledger, settings: MobileyeSettings = DEFAULTS) -> None:
        """Prepare the decoder.

        Args:
            bus: Topic of the frames; tables have the topic ``BUS/mobileye/TABLE``.
            ledger: Records every unused frame; the reader has counted those found.
            settings: Settings of this device.
        """
        self._bus = bus
        self._ledger = ledger
        self._settings = settings
        self._admit = Admission(bus, ledger, settings)
        self._clock = CounterClock()
        self._family = FamilyEvidence(bus, settings.family)
        self._statuses = Statuses(bus, ledger, settings, self._clock)
        self._open = no_parts()
        self._is_closed = False
        self._lanes = {table: no_parts() for table in LANE_PARTS}
        self._mounting = device_mounting(settings, bus, ledger)

    def __call__(self, block: Block) -> list[Block]:
        """Decode the frames of a block.

        Returns:
            One block for each table with new rows. Rows of obstacles have the log time of their
            status frame, and their image time as ``header_ns``.

        Raises:
            ValueError: The rows are not ``CanFrames``.
        """
        if not isinstance(block.rows, CanFrames):
            raise ValueError(f"{block.topic}: expected CanFrames, got {type(block.rows).__name__}")
        frames = self._admit(block.rows, block.log_ns)
        before = self._statuses.last
        opened, status_block, burst_at = self._statuses(frames)
        known = before + opened
        given = [] if status_block is None else [status_block]
        given += self._obstacles(frames, burst_at, known)
        for table in LANE_PARTS:
            given += self._lane_rows(table, frames, burst_at)
        for number, message in enumerate(layout().values()):
            if message.table in ("status", "obstacles", *LANE_PARTS):
                continue
            rows = np.flatnonzero(frames.message == number)
            if len(rows):
                given.append(self._plain(message, frames.take(rows), burst_at[rows], known))
        return given

    def flush(self) -> list[Block]:
        """Return the rows of the last, possibly incomplete burst, and report final notices."""
        given = self._finish(self._open, self._statuses.last, is_end=True)
        self._open = no_parts()
        for table in LANE_PARTS:
            given += self._pair(table, self._lanes[table], is_last=True)
        for notice in self._clock.notices:
            self._ledger.notice(f"{self._bus}: {notice}")
        for notice in self._family.notices():
            self._ledger.notice(notice)
        return given

    def _obstacles(self, frames: Admitted, burst_at: Int64s, known: Status) -> list[Block]:
        parts = self._open + _parts_of(frames, burst_at, OBSTACLE_PARTS)
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

    def _finish(self, parts: FrameParts, status: Status, is_end: bool) -> list[Block]:
        triples, faults = join_obstacles(parts)
        if is_end:
            faults = [f._replace(reason=CUT_AT_END) if f.reason == CUT else f for f in faults]
        self._report(faults)
        lacking = shortage(parts, status, self._settings.slots)
        for number, log_ns, count in zip(*(c.tolist() for c in lacking), strict=True):
            if is_end:
                self._ledger.notice(
                    f"{self._bus}: the log ends within an image's burst; {count} obstacle frames "
                    "of it are missing"
                )
            else:
                self._ledger.drop(self._bus, NOT_COME, count, f"burst {number}", log_ns)
        first = triples[0]
        if not len(first):
            return []
        at = status.at(first.burst)
        image_ns, log_ns_of_row = status.image_ns[at], status.log_ns[at]
        columns: Columns = {
            "t_ns": image_ns,
            "status_log_ns": log_ns_of_row,
            "burst": first.burst,
            "slot": first.place.astype(np.int8),
        }
        for name, part in zip(OBSTACLE_PARTS, triples, strict=True):
            columns |= _columns(layout()[name], part.words, _unknown(len(part)))
        columns = to_vehicle("obstacles", columns, self._mounting)
        return [table_block(self._bus, "obstacles", log_ns_of_row, columns, image_ns)]

    def _lane_rows(self, table: str, frames: Admitted, burst_at: Int64s) -> list[Block]:
        fresh = _parts_of(frames, burst_at, LANE_PARTS[table])
        return self._pair(table, self._lanes[table] + fresh, is_last=False) if len(fresh) else []

    def _pair(self, table: str, parts: FrameParts, is_last: bool) -> list[Block]:
        a, b, self._lanes[table], faults = pair_lanes(parts, self._settings.within_ns, is_last)
        self._report(faults)
        if not len(a):
            return []
        columns: Columns = {"t_ns": a.log_ns, "burst": a.burst, **lane_places(table, a.place)}
        for name, part in zip(LANE_PARTS[table], (a, b), strict=True):
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
            return variant_by_length(message, frames.length, self._settings)
        if message.variant != "revision":
            return _unknown(len(frames))
        if self._settings.revision != "auto":
            number = variant_number(self._settings.revision)
            return np.full(len(frames), number, dtype=np.int8)
        is_early = burst == NO_BURST
        if is_early.any():
            self._ledger.notice(
                f"{self._bus}: frames 0x{message.ids[0]:03X} before the first status frame; fields "
                "that depend on the protocol revision are missing there; set the revision"
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


def _parts_of(frames: Admitted, burst_at: Int64s, names: Sequence[str]) -> FrameParts:
    messages = [*layout()]
    part = np.full(len(messages), -1, dtype=np.int64)
    part[[messages.index(name) for name in names]] = np.arange(len(names))
    of_frame = part[frames.message]
    rows = np.flatnonzero(of_frame >= 0)
    return FrameParts(
        burst_at[rows],
        frames.instance[rows],
        of_frame[rows],
        frames.log_ns[rows],
        frames.words[rows],
    )


def _columns(message: Message, words: Words, variant: Variant) -> Columns:
    return si_columns(message, values_of(message, words, variant))


def _unknown(n: int) -> Variant:
    return np.full(n, UNKNOWN, dtype=np.int8)


def variant_by_length(
    message: Message, length: NDArray[np.uint8], settings: MobileyeSettings
) -> Variant:
    """Return the variant of frames by length; if the log has no lengths, by the set revision."""
    stand_in = variant_number(settings.revision) if message.name == "status" else UNKNOWN
    of_length = np.full(256, stand_in, dtype=np.int8)
    for n, name in message.variants.items():
        of_length[n] = VARIANTS.index(name)
    variant: Variant = of_length[length]
    return variant

"""One pass over an MCAP recording: blocks, and the account of every message."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, pairwise
from typing import Final

import numpy as np

from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.columns import Block, Bytes
from crosscue.replay.ledger import DAMAGED_RECORD, Ledger
from crosscue.replay.limits import Limits
from crosscue.replay.readers.can_rows import keep_memory
from crosscue.replay.readers.mcap.chunks.blocks import BlockBuilder
from crosscue.replay.readers.mcap.chunks.load import ChunkRecords, Load, Loader
from crosscue.replay.readers.mcap.chunks.rows import (
    NEVER_IN_A_CHUNK,
    Rows,
    contradicts,
    rows_by_index,
    rows_by_scan,
)
from crosscue.replay.readers.mcap.damage.resync import McapResync, Plausible

from .bytes import ByteFile
from .channels import Declarations, TopicBook
from .checks import Checks
from .records import PREFIX, BrokenRecordError
from .segments import RecordingSegment, Summary
from .walk import (
    STOPS_A_RUN,
    Attachment,
    End,
    How,
    Ignored,
    Item,
    LooseRecords,
    Oversized,
    Stray,
    UnreadableBytes,
    UnreadChunk,
    Walk,
)
from .window import ChunkWindow, find_window

DAMAGED_CHUNK: Final = "damaged chunk"
DAMAGED_SECTION: Final = "the data section does not match its checksum"
MISSING: Final = "declared by the format, not in its bytes"
INCOMPLETE: Final = "the file does not end as it should"
CUT: Final = "the file is cut"
BEFORE_A_GAP: Final = "extends into damaged bytes"
DETAILS_JOINED: Final = 10


@dataclass(frozen=True, slots=True)
class DamagedPart:
    """A damaged part that may have contained messages.

    Attributes:
        reason: Short reason, as in the ledger.
        detail: Place and cause.
        t_ns: Log time, if known.
        counts: Number of messages by channel number, if a trusted index states it.
    """

    reason: str
    detail: str
    t_ns: int | None = None
    counts: Mapping[int, int] = field(default_factory=dict)


def read_segments(
    file: ByteFile,
    segments: Sequence[RecordingSegment],
    book: TopicBook,
    limits: Limits,
    ledger: Ledger,
    selection: Selection,
) -> Iterator[Block]:
    """Yield all blocks of a file, then settle the ledger."""
    keep_memory()
    checks = Checks()
    if len(segments) > 1:
        ledger.notice(f"the file contains {len(segments)} consecutive recordings; all are read")
    declared: Counter[str] | None = Counter()
    for segment in segments:
        where = "" if len(segments) == 1 else f"recording at byte {segment.base}: "
        with Loader(file, limits) as loader:
            known = segment.declarations(book)
            part = SegmentPass(
                file, segment, known, limits, ledger, selection, checks, loader, where
            )
            yield from part.blocks()
            counts = part.settle()
        declared = None if declared is None or counts is None else declared + counts
    for sentence in book.notices:
        ledger.notice(sentence)
    for topic in book.topics:
        if declared is not None:
            ledger.declare(topic.name, declared[topic.name])
            ledger.settle(topic.name)
        else:
            ledger.declare(topic.name, None)
    checks.report(ledger)


@dataclass(eq=False)
class SegmentPass:
    """One pass over a recording of a file."""

    _file: ByteFile
    _segment: RecordingSegment
    _declarations: Declarations
    _limits: Limits
    _ledger: Ledger
    _selection: Selection
    _checks: Checks
    _loader: Loader
    _where: str
    _inside: ChunkWindow | None = None
    _doubt: str = ""
    _damages: list[DamagedPart] = field(default_factory=list)
    _rows_doubted: int = 0
    _is_short: bool | None = None
    _section: Callable[[], int | None] | None = None
    _attachments: list[tuple[int, int, Callable[[], int | None]]] = field(default_factory=list)
    _waiting: list[tuple[UnreadChunk, ChunkRecords]] = field(default_factory=list)

    def __post_init__(self) -> None:
        segment, selection = self._segment, self._selection
        self._summary = segment.summary or Summary()
        self._may_skip = selection != EVERYTHING
        self._builder = BlockBuilder(self._ledger, selection, self._limits, self._declarations)
        self._search = McapResync(self._file, segment.end, segment.has_end, (), self._plausible())

    def blocks(self) -> Iterator[Block]:
        """Yield the blocks of the recording."""
        segment = self._segment
        for notice in segment.notices:
            self._notice(notice)
        if segment.has_end and segment.summary is None:
            self._notice("it has no usable summary; topics were found by reading")
        self._checks.summaries_right += self._summary.is_verified
        window = self._window()
        if window is not None:
            yield from self._windowed(window)
        else:
            if segment.data_crc and not self._may_skip:
                self._section = self._loader.crc(segment.base, segment.end)
            yield from self._walked(iter(self._walk()))
        if segment.after:
            self._ledger.drop("", INCOMPLETE, None, self._where + segment.after)
        self._finish_checks()

    def _window(self) -> ChunkWindow | None:
        """Locate the selection by the index; if it cannot be trusted, report the reason."""
        if not self._may_skip or not self._segment.has_end:
            return None
        found = find_window(self._segment, self._declarations, self._selection)
        if isinstance(found, ChunkWindow):
            return found
        self._notice(f"the requested part was found by reading the complete file: {found}")
        return None

    def _windowed(self, window: ChunkWindow) -> Iterator[Block]:
        """Yield blocks of the indexed chunks in the window, and of all records outside chunks."""
        if self._segment.data_crc:
            # This checksum covers all bytes of the section.
            self._checks.sections_unread += 1
            self._segment = replace(self._segment, data_crc=0)
        self._inside = window
        self._file.expect(window.ranges())
        yield from self._walked(window.items(self._file, self._limits))
        self._inside = None
        held = self._builder.met + self._builder.dropped
        doubt = self._doubt or ("it has damage" if self._damages else "")
        rest = window.rest(self._summary, held)
        if doubt or rest is None:
            doubt = doubt or "it contradicts the statistics"
            self._notice(f"the index proved unreliable ({doubt}); every chunk was examined")
            yield from self._walked(window.others(self._file, self._limits))
            return
        self._checks.chunks += window.left
        self._checks.chunks_unread += window.left
        for channel_id, count in rest.items():
            self._builder.skip_counted(channel_id, count)

    def _walked(self, walk: Iterator[Item]) -> Iterator[Block]:
        items = self._loader.ahead(walk, self._is_wanted)
        for (item, load), (following, _) in pairwise(chain(items, [(None, None)])):
            if isinstance(item, UnreadChunk):
                yield from self._chunk(item, load)
            elif isinstance(item, LooseRecords):
                yield from self._run(
                    item, following if isinstance(following, UnreadableBytes) else None
                )
            else:
                self._note(item)

    def _walk(self) -> Walk:
        segment = self._segment
        known = segment.known_chunks(self._file, self._limits)
        return Walk(self._file, segment.begin, segment.end, known, self._limits, self._plausible())

    def _plausible(self) -> Plausible:
        """Return the criteria for messages after damaged bytes."""
        statistics = self._summary.statistics
        channels = [channel.id for channel in self._segment.channels]
        if statistics is None or not statistics.message_count:
            return Plausible(channels)
        return Plausible(channels, (statistics.start, statistics.end))

    def _is_wanted(self, chunk: UnreadChunk) -> bool:
        """Return whether the chunk must be read, as chunks with inconsistent indexes must."""
        index, head = chunk.index, chunk.head
        if not self._may_skip or any(self._builder.wants(m) for m in chunk.messages):
            return True
        if index is None or head is None or not chunk.messages:
            return True
        if chunk.fault or chunk.differs or chunk.index_fault or chunk.is_cut:
            return True
        filled = [m for m in chunk.messages if m.count]
        ids = {m.channel_id for m in filled}
        if ids != index.channels or not ids <= self._declarations.complete:
            return True
        if not filled or min(int(m.entries["log"].min()) for m in filled) != head.start:
            return True
        return max(int(m.entries["log"].max()) for m in filled) != head.end

    def _chunk(self, chunk: UnreadChunk, load: Load | None) -> Iterator[Block]:
        self._checks.chunks += 1
        if self._inside is not None and not _is_as_indexed(chunk):
            self._doubt = self._doubt or f"it does not match the chunk at byte {chunk.at}"
        if load is None and not any(self._builder.wants(m) for m in chunk.messages):
            self._checks.chunks_unread += 1
            for index in chunk.messages:
                self._builder.skip_unread(index)
            return
        try:
            stretch = self._stretch(chunk, load)
        except BrokenRecordError as error:
            yield from self._waiting_blocks()
            self._drop_chunk(chunk, str(error))
            return
        self._waiting.append((chunk, stretch))
        if load is None or load.is_last:
            yield from self._waiting_blocks()

    def _stretch(self, chunk: UnreadChunk, load: Load | None) -> ChunkRecords:
        if load is not None:
            return load.stretch()
        # The chunk is selected only now, because a channel has been declared again.
        records = self._loader.load(chunk)
        return ChunkRecords(records, 0, len(records))

    def _waiting_blocks(self) -> Iterator[Block]:
        """Yield the messages of the loaded chunks of one group."""
        waiting, self._waiting = self._waiting, []
        rows = self._joined_rows(waiting)
        if rows is not None:
            yield from self._builder.build(rows, self._checks, 0)
            return
        for chunk, stretch in waiting:
            read = self._cut_rows if chunk.is_cut else self._rows
            try:
                rows = read(chunk, stretch.records)
            except BrokenRecordError as error:
                self._drop_chunk(chunk, str(error))
                continue
            yield from self._builder.build(rows, self._checks, chunk.at)

    def _joined_rows(self, waiting: Sequence[tuple[UnreadChunk, ChunkRecords]]) -> Rows | None:
        """Parse the messages of several chunks at once; None if any of them needs its own care."""
        entries = sum(index.count for chunk, _ in waiting for index in chunk.messages)
        has_crc = all(chunk.head is not None and chunk.head.crc for chunk, _ in waiting)
        if len(waiting) < 2 or not has_crc or entries > self._limits.records_per_chunk:
            return None
        first, last = waiting[0][1], waiting[-1][1]
        rows = rows_by_index(
            first.whole[first.begin : last.end],
            [(at.begin - first.begin, at.end - first.begin, of.messages) for of, at in waiting],
        )
        if rows is None or not all(map(self._declarations.has, rows.definitions)):
            return None
        for (chunk, _), times in zip(waiting, rows.times, strict=True):
            self._count_verification(chunk, rows, times)
        return rows

    def _rows(self, chunk: UnreadChunk, buffer: Bytes) -> Rows:
        """Parse the messages of a chunk with all possible checks.

        Raises:
            BrokenRecordError: A check failed, or there are too many messages.
        """
        max_records = self._limits.records_per_chunk
        if sum(index.count for index in chunk.messages) > max_records:
            raise BrokenRecordError(f"its index names more than {max_records} messages")
        one = [(0, len(buffer), chunk.messages)]
        rows = rows_by_index(buffer, one) if chunk.messages else None
        if rows is None:
            if chunk.messages or chunk.index_fault:
                self._checks.bad_indexes.add(f"that of the chunk at byte {chunk.at}")
            rows = rows_by_scan(buffer, NEVER_IN_A_CHUNK, max_records)
            if rows.end != len(buffer):
                raise BrokenRecordError(f"its records end at byte {rows.end} of {len(buffer)}")
        times = (np.minimum.reduce(rows.log), np.maximum.reduce(rows.log)) if len(rows) else (0, 0)
        self._count_verification(chunk, rows, times)
        return rows

    def _count_verification(self, chunk: UnreadChunk, rows: Rows, times: tuple[int, int]) -> None:
        """Count the kind of verification of a chunk's bytes, with its first and last log time.

        Raises:
            BrokenRecordError: The chunk has no verification, and is inconsistent.
        """
        head = chunk.head
        assert head is not None, "a chunk with rows has a head"
        doubt = chunk.differs
        if not doubt and (head.start or head.end):
            if not len(rows):
                doubt = "it declares a time range but has no message"
            elif times[0] < head.start or times[1] > head.end:
                doubt = "its messages are outside its declared time range"
        if head.crc or (self._segment.data_crc and self._section_is_right()):
            self._checks.chunks_right += 1
            if doubt:
                self._checks.bad_heads.add(f"the chunk at byte {chunk.at}: {doubt}")
            return
        if self._segment.data_crc:
            self._rows_doubted += len(rows)
        self._checks.chunks_bare += 1 if head.size else 0
        self._checks.chunks_right += 0 if head.size else 1
        if doubt or contradicts(rows, chunk.messages):
            doubt = doubt or "its message index names other messages"
            raise BrokenRecordError(f"has no checksum, and {doubt}")

    def _cut_rows(self, chunk: UnreadChunk, buffer: Bytes) -> Rows:
        rows = rows_by_scan(buffer, NEVER_IN_A_CHUNK, self._limits.records_per_chunk)
        head = chunk.head
        assert head is not None, "a chunk with rows has a head"
        has = self._file.size - chunk.body_at
        self._damages.append(
            DamagedPart(
                CUT,
                f"the chunk at byte {chunk.at} ends after {has} of {head.body_size} bytes; of its "
                f"start {len(rows)} messages are read, which no checksum covers",
                head.start if head.start < 1 << 63 else None,
            )
        )
        self._checks.rows_bare += len(rows)
        return rows

    def _drop_chunk(self, chunk: UnreadChunk, why: str) -> None:
        source = chunk.index or chunk.head
        t_ns = None if source is None or source.start >= 1 << 63 else source.start
        span = "" if source is None else f"; log times {source.start} to {source.end}"
        detail = f"{self._where}chunk at byte {chunk.at}: {why}{span}"
        reason = CUT if chunk.is_cut else DAMAGED_CHUNK
        counts = {m.channel_id: m.count for m in chunk.messages if m.count}
        for channel_id, count in counts.items():
            self._builder.drop_of_channel(channel_id, reason, count, detail, t_ns)
        held = chunk.index.channels if chunk.index is not None else frozenset[int]()
        if not counts or chunk.index_fault or not held <= counts.keys():
            self._damages.append(DamagedPart(reason, detail, t_ns))

    def _run(self, run: LooseRecords, gap: UnreadableBytes | None) -> Iterator[Block]:
        """Yield the messages of a run outside chunks, up to a gap that may overlap it."""
        rows = run.rows
        if gap is not None:
            rows = self._before_gap(run, gap)
        if self._segment.data_crc and self._section_is_right():
            yield from self._builder.build(rows, self._checks, run.at)
            return
        for at, part in self._parts(run.at, rows):
            sound = self._plausible_rows(part, at)
            if self._segment.data_crc:
                self._rows_doubted += len(sound)
            else:
                self._checks.rows_bare += len(sound)
            yield from self._builder.build(sound, self._checks, at)

    def _parts(self, at: int, rows: Rows) -> Iterator[tuple[int, Rows]]:
        """Split a run at messages whose damaged lengths include the following records."""
        self._search.plausible.learn(rows)
        while (found := self._search.swallowed(at, rows)) is not None:
            i, begin = found
            place = f"{self._where}bytes {at + int(rows.offset[i])} to {at + begin}"
            if not self._is_some_missing():
                self._report_suspicion(place)
                break
            detail = f"{place}: its length includes the following records"
            self._builder.drop(rows.take(slice(i, i + 1)), DAMAGED_RECORD, detail)
            definitions = [one for one in rows.definitions if one.at < begin]
            yield at, replace(rows.take(slice(i)), definitions=definitions)
            at, buffer = at + begin, rows.buffer[begin : rows.end]
            rows = rows_by_scan(buffer, STOPS_A_RUN, len(buffer))
        yield at, rows

    def _is_some_missing(self) -> bool:
        """Return whether messages outside chunks are missing, by another walk over the file."""
        statistics = self._summary.statistics
        if statistics is None:
            return bool(self._segment.data_crc)  # the checksum is wrong: something is damaged
        if self._is_short is None:
            count, has_chunks = 0, False
            for item in self._walk():
                has_chunks |= isinstance(item, UnreadChunk)
                count += len(item.rows) if isinstance(item, LooseRecords) else 0
            self._is_short = count < statistics.message_count and not has_chunks
        return self._is_short

    def _report_suspicion(self, place: str) -> None:
        if self._summary.statistics is None and not self._segment.data_crc:
            detail = f"{place}: its end seems to consist of other records of this recording"
            self._damages.append(DamagedPart(DAMAGED_RECORD, detail))

    def _plausible_rows(self, rows: Rows, at: int) -> Rows:
        """Select the messages without a valid checksum that agree with the statistics.

        Statistics that contradict most of the messages are considered wrong.
        """
        plausible = self._plausible()
        if not plausible.is_declared:
            return rows
        good = plausible.messages(rows)
        if 2 * np.count_nonzero(good) < len(good):
            return rows
        for i in np.flatnonzero(~good).tolist():
            detail = (
                f"{self._where}bytes {at + int(rows.offset[i])} to {at + int(rows.stop[i])}: log "
                f"time {int(rows.log[i])} or channel {int(rows.channel[i])} contradicts the summary"
            )
            self._builder.drop(rows.take(slice(i, i + 1)), DAMAGED_RECORD, detail)
        return rows if good.all() else rows.take(np.flatnonzero(good))

    def _before_gap(self, run: LooseRecords, gap: UnreadableBytes) -> Rows:
        """Return the messages of a run before a gap, and drop the others."""
        end = min(gap.at - run.at, run.rows.end)
        count = int(np.searchsorted(run.rows.offset, end))
        detail = f"{self._where}bytes {gap.at} to {gap.to}: {gap.why}"
        self._builder.drop(run.rows.take(slice(count, None)), BEFORE_A_GAP, detail)
        definitions = [found for found in run.rows.definitions if found.at < end]
        return replace(run.rows.take(slice(count)), definitions=definitions, end=end)

    def _section_is_right(self) -> bool:
        """Wait for the checksum of the data section, and return whether it matches."""
        if self._section is None:
            self._section = self._loader.crc(self._segment.base, self._segment.end)
        return self._section() == self._segment.data_crc

    def _note(self, item: Item | None) -> None:
        """Account for an item without readable messages."""
        match item:
            case Attachment() if self._inside is not None:
                self._checks.attachments += 1
                self._checks.attachments_unread += 1
            case UnreadableBytes(at, to, why):
                self._damages.append(
                    DamagedPart(DAMAGED_RECORD, f"{self._where}bytes {at} to {to}: {why}")
                )
            case Stray(at, index):
                detail = f"{self._where}message index at byte {at}: no chunk precedes it"
                counts = {index.channel_id: index.count}
                self._damages.append(DamagedPart(DAMAGED_CHUNK, detail, None, counts))
            case End(at, how):
                self._end(at, how)
            case Oversized(at, size, channel_id, log):
                self._builder.skip_oversized(channel_id, log, size, at)
            case Ignored(at, opcode):
                self._checks.ignored.add(f"kind {opcode:#04x} at byte {at}")
            case Attachment(at, crc_at, crc):
                self._checks.attachments += 1
                if crc:
                    content_at = at + PREFIX.size
                    self._attachments.append((at, crc, self._loader.crc(content_at, crc_at)))
            case _:
                raise AssertionError(f"{type(item).__name__} is read, not noted")

    def _end(self, at: int, how: How) -> None:
        if how is How.CUT:
            detail = f"{self._where}the record at byte {at} extends beyond the end of the file"
            self._damages.append(DamagedPart(CUT, detail))
        elif how is How.BARE:
            detail = f"{self._where}it ends at byte {at} without a data end record and a footer"
            self._damages.append(DamagedPart(CUT, detail))
        elif how is How.FOOTER:
            self._notice("it has no data end record")

    def _finish_checks(self) -> None:
        for at, reported, found in self._attachments:
            if found() == reported:
                self._checks.attachments_right += 1
            else:
                self._checks.bad_attachments.add(f"at byte {at}")
        if not self._segment.data_crc:
            return
        if self._section is None:
            self._checks.sections_unread += 1
        elif self._section_is_right():
            self._checks.sections_right += 1
        else:
            self._checks.sections_wrong += 1
            self._report_doubt()

    def _report_doubt(self) -> None:
        """Report that the data section is damaged in an unknown place."""
        segment = self._segment
        if not self._rows_doubted:
            self._notice(
                "its data section does not match its checksum; all messages in it are in chunks "
                "that match theirs"
            )
            return
        detail = (
            f"{self._where}bytes {segment.base} to {segment.end} do not match their checksum; "
            f"{self._rows_doubted} messages there have no other checksum and were read; which of "
            "them have changed bytes is unknown"
        )
        self._ledger.drop("", DAMAGED_SECTION, None, detail)

    def settle(self) -> Counter[str] | None:
        """Compare with the statistics and report losses; return the declared counts by topic."""
        statistics = self._summary.statistics
        if statistics is None:
            for damage in self._damages:
                self._report(damage)
            return None
        met = self._builder.met + self._builder.dropped
        if self._summary.counts_channels:
            missing = Counter(statistics.by_channel) - met
        else:
            missing = Counter({-1: max(statistics.message_count - met.total(), 0)})
        for damage in self._damages:
            ending = "" if missing.total() else "; by the statistics no message is missing"
            self._notice(f"{damage.reason}: {damage.detail}{ending}")
        self._drop_missing(missing, statistics.message_count)
        if self._declarations.redefined or not self._summary.counts_channels:
            return None
        declared: Counter[str] = Counter()
        for channel_id, topic in self._declarations.topics():
            declared[topic] += statistics.by_channel.get(channel_id, 0)
        return declared

    def _drop_missing(self, missing: Counter[int], declared: int) -> None:
        reason = self._damages[0].reason if self._damages else MISSING
        details = [damage.detail for damage in self._damages[:DETAILS_JOINED]]
        detail = "; ".join(details) or f"the statistics declare {declared} messages in all"
        t_ns = self._damages[0].t_ns if self._damages else None
        for channel_id, count in sorted(missing.items()):
            known = self._ledger.claim(self._declarations.topic(channel_id), count)
            self._builder.drop_of_channel(channel_id, reason, count - known, detail, t_ns)

    def _report(self, damage: DamagedPart) -> None:
        if not damage.counts:
            self._ledger.drop("", damage.reason, None, damage.detail, damage.t_ns)
        for channel_id, count in damage.counts.items():
            self._builder.drop_of_channel(
                channel_id, damage.reason, count, damage.detail, damage.t_ns
            )

    def _notice(self, sentence: str) -> None:
        self._ledger.notice(self._where + sentence)


def _is_as_indexed(chunk: UnreadChunk) -> bool:
    """Return whether the chunk and its message indexes agree with the summary."""
    index = chunk.index
    if index is None or chunk.fault or chunk.differs:
        return False
    held = {m.channel_id for m in chunk.messages if m.count}
    return held <= index.channels or not index.channels

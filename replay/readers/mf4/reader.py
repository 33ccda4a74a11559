"""Reader of ASAM MDF 4 logs: bus logging groups as CAN frames, other channel groups as tables.

Channels with a numeric conversion (linear, rational, table) are converted to physical values.
Formulas and texts are not evaluated. A topic's rows are yielded group by group, as stored.
Attachments are never opened. Compressed blocks have a checksum, which is verified.
"""

from collections.abc import Callable, Collection, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.columns import BLOCK_ROWS, Block, Int64s, Table, Topic
from crosscue.replay.errors import LogFormatError
from crosscue.replay.files.closing import Closing
from crosscue.replay.ledger import NOT_ASKED_TIME, NOT_ASKED_TOPIC, Ledger
from crosscue.replay.limits import Limits
from crosscue.replay.readers.can_rows import (
    NO_ROWS,
    TOO_MANY_BUSES,
    FrameRows,
    blocks_by_bus,
    bus_number,
    bus_topic,
    keep_memory,
    merge_rows,
    merged_by_time,
    named_buses,
)
from crosscue.replay.seal.touched import Touched

from .blocks import (
    CYCLE_COUNTERS,
    MASTER,
    REMOTE_MASTER,
    TIME,
    VARIABLE_OFFSETS,
    VIRTUAL_MASTER,
    VLSD_GROUP,
    Blocks,
    BrokenBlockError,
    ChannelGroup,
    DataGroup,
    Mf4Channel,
)
from .frames import CanLayout, can_layout
from .records import LAST_CUT, Records, UnsortedData, Walked, sorted_records
from .stream import LinkedData
from .values import Words, invalid, is_applied, is_numeric, physical, raw, times_ns
from .variable import GroupValues, StoredValues, VariableValues

_NAMES_SHOWN: Final = 5
_PEEK_ROWS: Final = 4096
# Size of the units of records that are read or skipped when a time range is selected.
_CHUNK_BYTES: Final = 1 << 16


@dataclass(frozen=True, slots=True, eq=False)
class _Source:
    """A channel group, with its layout or the reason why it cannot be read.

    Attributes:
        index: Index among the groups of its data stream.
        declared: Number of records that the file declares, or None if it was not written.
    """

    index: int
    group: ChannelGroup
    master: Mf4Channel | None
    can: CanLayout | None
    topic: str
    refusal: str
    declared: int | None

    @property
    def has_frames(self) -> bool:
        """True if its records are CAN frames that can be read."""
        return self.can is not None and not self.refusal


@dataclass(slots=True, eq=False)
class _Account:
    """Counts of a group's records so far."""

    met: int = 0
    dropped: int = 0
    unread: int = 0


class _UnreadableError(Exception):
    """A record's time cannot be read."""


@dataclass(frozen=True, slots=True, eq=False)
class _Stored:
    """Groups that share one data stream.

    Attributes:
        unsorted: The records of all groups, if they are mixed.
        sources: The groups, except those that only contain values of other groups.
        values: Payloads of a source that are not in its records, by the source's index.
    """

    stream: LinkedData
    unsorted: UnsortedData | None
    sources: tuple[_Source, ...]
    values: Mapping[int, VariableValues]


class Mf4Log(Closing):
    """An open MDF 4 log (``Log``)."""

    format: Final = "mf4"

    def __init__(self, path: Path, limits: Limits) -> None:
        """Read the structure, and the first records of bus groups to find the buses' names.

        Raises:
            LogFormatError: The file is not MDF 4, or its header or all its groups are damaged.
        """
        self.path: Final = path
        self._limits = limits
        keep_memory()
        self.touched: Final = Touched()
        self._file = path.open("rb")
        note = partial(self.touched.add, path)
        self._blocks = Blocks(self._file, path.stat().st_size, limits, note)
        self.buses: dict[str, int] = {}
        self._broken = ""
        try:
            self.header = self._blocks.header(str(path))
            self._stored = tuple(self._found())
            if self._broken and not self._stored:
                raise LogFormatError(f"{path}: no channel group can be read: {self._broken}")
            self._peek()
        except BaseException:
            self._file.close()
            raise

    @property
    def topics(self) -> tuple[Topic, ...]:
        """Tables, and the buses found so far: in the first records, or all after a pass."""
        tables = tuple(
            Topic(s.topic, "crosscue/Table", "columns", declared=s.declared)
            for s in self._sources()
            if s.topic
        )
        return tuple(bus_topic(name) for name in self.buses) + tables

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Yield all rows, group by group; see ``Log.read``."""
        for topic in self.topics:
            ledger.declare(topic.name, topic.declared)
        if self.header.is_local:
            ledger.notice("the log states no time zone; its start time is read as UTC")
        accounts = {source: _Account() for source in self._sources()}
        yield from _Pass(self, accounts, ledger, selection).blocks(self._stored)
        for source, account in accounts.items():
            _settle(source, account, ledger)
        self._close_account(accounts.values(), ledger)

    def report_missing(self, ledger: Ledger) -> None:
        """Report damaged blocks, and data beyond the file's end; see ``KnowsItsEnd``."""
        if self._broken:
            ledger.drop("", "structure damaged", None, self._broken)
        for stored in self._stored:
            if stored.stream.missing:
                ledger.drop("", "damaged data", None, stored.stream.missing)
            elif not stored.unsorted:
                for source in stored.sources:
                    size = source.group.record_bytes
                    there = stored.stream.size // size if size else 0
                    _settle(source, _Account(met=min(there, source.declared or 0)), ledger)
        if not self.header.is_finalized:
            ledger.notice("not finalized by the logger; only reading it can detect a cut")

    def _sources(self) -> Iterator[_Source]:
        return (source for stored in self._stored for source in stored.sources)

    def _close_account(self, accounts: Collection[_Account], ledger: Ledger) -> None:
        met = sum(account.met for account in accounts)
        if not self.header.is_finalized:
            ledger.notice(
                f"not finalized by the logger; {met} records recovered from the data block"
            )
        if self._broken:
            ledger.drop("", "structure damaged", None, self._broken)
        for name in self.buses:
            ledger.topic(name)
        ledger.integrity = (
            "checksums of compressed blocks verified; MDF has none for the rest of the file"
        )
        if not self.header.is_finalized and any(one.declared is None for one in self._sources()):
            ledger.integrity += "; not finalized: a cut between two records cannot be detected"
        if unread := sum(account.unread for account in accounts):
            ledger.integrity += f"; {unread} of {met} records, of other times, were not read"

    def _peek(self) -> None:
        for stored in self._stored:
            for source in stored.sources:
                if source.can is None or source.refusal:
                    continue
                if stored.unsorted:
                    piece = stored.unsorted.piece(0)
                    some = stored.unsorted.rows(0, source.index) if piece else None
                else:
                    records = sorted_records(stored.stream, source.group, 0, _PEEK_ROWS)
                    some = next(records, None)
                if some is not None:
                    for channel in np.unique(source.can.buses(some)).tolist():
                        bus_number(str(channel), self.buses)

    def _found(self) -> Iterator[_Stored]:
        names: set[str] = set()
        try:
            for data in self._blocks.data_groups(self.header.first_group, self.header.unfinished):
                stream = LinkedData(self._blocks, data.data, self.header.unfinished)
                unsorted = None
                if data.id_bytes:
                    unsorted = UnsortedData(stream, data, self._limits.message_bytes)
                sources = tuple(self._sources_of(data, stream, names))
                values = {
                    source.index: self._values(source.can.variable, data, unsorted)
                    for source in sources
                    if source.can and source.can.variable
                }
                yield _Stored(stream, unsorted, sources, values)
        except BrokenBlockError as broken:
            self._broken = str(broken)

    def _values(
        self, channel: Mf4Channel, data: DataGroup, unsorted: UnsortedData | None
    ) -> VariableValues:
        for k, group in enumerate(data.groups):
            if unsorted and group.flags & VLSD_GROUP and group.at == channel.data:
                by_order = bool(self.header.unfinished & VARIABLE_OFFSETS)
                return GroupValues(unsorted, k, by_order)
        return StoredValues(LinkedData(self._blocks, channel.data, self.header.unfinished))

    def _sources_of(
        self, data: DataGroup, stream: LinkedData, names: set[str]
    ) -> Iterator[_Source]:
        for k, group in enumerate(data.groups):
            declared = None if self.header.unfinished & CYCLE_COUNTERS else group.records
            # A group of mixed data that declares no records may still have some.
            is_empty = stream.size < group.record_bytes + data.id_bytes and not stream.broken
            if group.flags & VLSD_GROUP or (is_empty and not declared):
                continue
            masters = [c for c in group.channels if c.type in (MASTER, VIRTUAL_MASTER)]
            master = next((c for c in masters if c.sync == TIME), None)
            can = can_layout(group)
            refusal = _refusal(group, master, can)
            topic = ""
            if can is None and not refusal:
                topic = _free(group.name or "group", names)
                names.add(topic)
            yield _Source(k, group, master, can, topic, refusal, declared)


@dataclass(frozen=True, slots=True, eq=False)
class _Pass:
    """One pass over the records of all groups."""

    _log: Mf4Log
    _accounts: Mapping[_Source, _Account]
    _ledger: Ledger
    _selection: Selection

    def blocks(self, groups: Sequence[_Stored]) -> Iterator[Block]:
        """Yield the rows of unsorted data, then all other frames by time, then other rows."""
        for stored in groups:
            if stored.unsorted:
                yield from self._mixed(stored, stored.unsorted)
        alone = [(one, source) for one in groups if not one.unsorted for source in one.sources]
        frames = [self._alone_frames(*pair) for pair in alone if pair[1].has_frames]
        for rows in merged_by_time(frames):
            yield from self._by_bus(rows)
        for stored, source in alone:
            if not source.has_frames:
                yield from self._alone(stored, source)

    def _by_bus(self, rows: FrameRows) -> Iterator[Block]:
        yield from blocks_by_bus(rows, tuple(self._log.buses), self._ledger, self._selection)

    def _mixed(self, stored: _Stored, data: UnsortedData) -> Iterator[Block]:
        """Yield the records of unsorted data piece by piece, with frames in stored order."""
        last = None
        for k, piece in data.pieces():
            last = piece
            present = np.bincount(piece.group, minlength=len(data.data.groups))
            frames = []
            for source in stored.sources:
                if not present[source.index]:
                    continue
                self._accounts[source].met += int(present[source.index])
                records = data.rows(k, source.index)
                if source.has_frames:
                    frames.append(self._frames(stored, source, records))
                elif self._is_left_out(source, len(records.rows)):
                    continue
                else:
                    yield from self._table(source, records)
            if frames:
                yield from self._by_bus(merge_rows(frames))
        if last is not None and last.damage:
            self._drop_rest(stored, last)

    def _drop_rest(self, stored: _Stored, last: Walked) -> None:
        """Account for the records in a damaged end of unsorted data."""
        if all(source.declared is not None for source in stored.sources):
            for source in stored.sources:
                account = self._accounts[source]
                missing = max((source.declared or 0) - account.met, 0)
                account.dropped += missing
                self._ledger.drop(source.topic, "damaged data", missing, last.damage)
        elif last.cut < 0:
            is_cut = last.damage == LAST_CUT
            self._ledger.drop("", "damaged data", 1 if is_cut else None, last.damage)
        elif not any(
            isinstance(one, GroupValues) and one.group == last.cut and one.first_missed is not None
            for one in stored.values.values()
        ):  # else a frame was already dropped because its payload is truncated
            self._ledger.drop("", "damaged data", 1, last.damage)

    def _alone_frames(self, stored: _Stored, source: _Source) -> Iterator[FrameRows]:
        for records in self._records(stored, source):
            yield self._frames(stored, source, records)

    def _alone(self, stored: _Stored, source: _Source) -> Iterator[Block]:
        """Yield the rows of a group without frames that has a separate data stream."""
        size = source.group.record_bytes
        there = stored.stream.size // size if size else 0
        count = there if source.declared is None else source.declared
        if self._is_left_out(source, count):
            self._accounts[source].met += count
            return
        for records in self._records(stored, source):
            yield from self._table(source, records)

    def _is_left_out(self, source: _Source, count: int) -> bool:
        """Return whether a group is unsupported or not selected, and account for its rows then."""
        if not source.refusal and self._selection.wants(source.topic):
            return False
        if source.refusal and source.can and source.can.is_needed:
            self._ledger.drop("", source.refusal, count, source.group.name)
        else:
            self._ledger.find(source.topic, count)
            reason = source.refusal or NOT_ASKED_TOPIC
            self._ledger.skip(source.topic, reason, count, source.group.name)
        return True

    def _records(self, stored: _Stored, source: _Source) -> Iterator[Records]:
        """Yield records of sorted data, and account for unreadable ones."""
        account = self._accounts[source]
        first, stop = self._span(stored, source)
        if stop is not None:
            unread = stored.stream.size // source.group.record_bytes - (stop - first)
            account.met += unread
            account.unread += unread
            self._ledger.find(source.topic, unread)
            self._ledger.skip(source.topic, NOT_ASKED_TIME, unread)
        for records in sorted_records(stored.stream, source.group, first, stop):
            if not records.damage:
                account.met += len(records.rows)
                yield records
                continue
            count = records.dropped
            if source.declared is not None:
                count = min(count, max(source.declared - account.met - account.dropped, 0))
            account.dropped += count
            if count or records.dropped == 0:
                self._ledger.drop(source.topic, "damaged data", count or None, records.damage)

    def _span(self, stored: _Stored, source: _Source) -> tuple[int, int | None]:
        """Return the range of records that may be selected; stop is None for all.

        The first records of chunks are found by bisection, because times ascend in MDF.
        """
        size, asked = source.group.record_bytes, self._selection
        if not size or not asked.is_timed or stored.stream.broken:
            return 0, None
        total = stored.stream.size // size
        rows = max(_CHUNK_BYTES // size, 1)

        @cache
        def time_ns(chunk: int) -> int:
            content = stored.stream.read(chunk * rows * size, size)
            if len(content) < size:
                raise _UnreadableError
            record = np.frombuffer(content, np.uint8).reshape(1, size)
            times = self._times(source, Words(record, chunk * rows))
            if times is None:
                raise _UnreadableError
            return int(times[0])

        count = -(-total // rows)
        try:
            if count < 2 or time_ns(count - 1) < time_ns(0):
                return 0, None
            first, stop = 0, count
            if asked.start_ns is not None:
                first = max(_first_from(asked.start_ns, count, time_ns) - 1, 0)
            if asked.end_ns is not None:
                stop = _first_from(asked.end_ns, count, time_ns)
        except _UnreadableError:
            return 0, None
        return first * rows, max(min(stop * rows, total), first * rows)

    def _times(self, source: _Source, words: Words) -> Int64s | None:
        assert source.master is not None
        since = times_ns(source.master, raw(source.master, words))
        if since is not None:
            since += self._log.header.start_ns
        return since

    def _frames(self, stored: _Stored, source: _Source, records: Records) -> FrameRows:
        assert source.can is not None
        ledger, words = self._ledger, Words(records.rows, records.first)
        log_ns = self._times(source, words)
        if log_ns is None:
            ledger.drop("", "time out of range", len(words), source.group.name)
            return NO_ROWS
        found = source.can.frames(records, words, log_ns, stored.values.get(source.index))
        detail = f"{source.group.name}, from record {records.first} on"
        ledger.drop("", "record that cannot be a frame", found.impossible, detail)
        ledger.drop("", "payload cut or damaged", found.unreadable, detail)
        ledger.find("", found.invalid)
        ledger.skip("", "marked as invalid by the logger", found.invalid, detail)
        named = named_buses(found.rows, self._log.buses)
        ledger.drop("", TOO_MANY_BUSES, len(found.rows) - len(named))
        return named

    def _table(self, source: _Source, records: Records) -> Iterator[Block]:
        words = Words(records.rows, records.first)
        log_ns = self._times(source, words)
        if log_ns is None:
            detail = f"from record {records.first} on"
            self._ledger.drop(source.topic, "time out of range", len(words), detail)
            return
        kept = self._selection.account(source.topic, log_ns, self._ledger)
        if kept is not None and not bool(kept.any()):
            return
        table = self._columns(source, words)
        if kept is not None:
            log_ns, table = log_ns[kept], table.take(kept)
        for k in range(0, len(log_ns), BLOCK_ROWS):
            part = slice(k, k + BLOCK_ROWS)
            yield Block(source.topic, log_ns[part], table.take(part))

    def _columns(self, source: _Source, words: Words) -> Table:
        columns: dict[str, NDArray[np.generic]] = {}
        units: dict[str, str] = {}
        left_out, unconverted = [], []
        for channel in source.group.channels:
            if channel is source.master:
                continue
            if not _is_column(channel, source.group):
                left_out.append(channel.name)
                continue
            name = _free(channel.name or "channel", columns)
            values = physical(channel.conversion, raw(channel, words))
            bad = invalid(channel, words.records, source.group.value_bytes)
            if bad is not None:
                values = np.where(bad, np.nan, values.astype(np.float64))
            columns[name] = values
            if not is_applied(channel.conversion):
                unconverted.append(name)
            elif channel.unit:
                units[name] = channel.unit
        for names, what in (
            (left_out, "are not single numbers and are omitted"),
            (unconverted, "have an unsupported conversion; raw values are used"),
        ):
            if names:
                some = ", ".join(names[:_NAMES_SHOWN])
                some += ", ..." if len(names) > _NAMES_SHOWN else ""
                self._ledger.notice(f"{source.topic}: {len(names)} channels {what}: {some}")
        return Table(columns, units)


def _first_from(t_ns: int, count: int, time_ns: Callable[[int], int]) -> int:
    """Return the first of ``count`` chunks that starts at ``t_ns`` or later.

    The search interpolates, because examining a chunk may require its decompression. Every second
    step is a bisection, so that a log with pauses takes at most twice the steps of a bisection.
    """
    low, high = 0, count - 1
    if time_ns(low) >= t_ns:
        return low
    if time_ns(high) < t_ns:
        return count
    is_guess = True
    while high - low > 1:
        middle = (low + high) // 2
        if is_guess:
            fraction = (t_ns - time_ns(low)) / max(time_ns(high) - time_ns(low), 1)
            middle = low + round(fraction * (high - low))
            middle = min(max(middle, low + 1), high - 1)
        is_guess = not is_guess
        if time_ns(middle) < t_ns:
            low = middle
        else:
            high = middle
    return high


def _settle(source: _Source, account: _Account, ledger: Ledger) -> None:
    """Compare the records found with the declared number."""
    if source.declared is None:
        return
    missing = source.declared - account.met - account.dropped
    name = source.group.name
    if missing > 0:
        detail = f"{name}: declared {source.declared}, found {account.met}"
        ledger.drop(source.topic, "declared by the format, not in its bytes", missing, detail)
    elif account.met > source.declared:
        ledger.notice(f"{name}: {source.declared} records declared, {account.met} in the file")


def _refusal(group: ChannelGroup, master: Mf4Channel | None, can: CanLayout | None) -> str:
    """Return the reason why a group cannot be read; empty if it can."""
    if group.flags & REMOTE_MASTER:
        return "column-oriented storage, not supported"
    if master is None:
        return "group without a time channel"
    if master.type == MASTER and not is_numeric(master, group.value_bytes):
        return "time channel is not a number"
    if can is None:
        names = {channel.name for channel in group.channels}
        if any(name.startswith(("LIN_", "ETH_", "FLX_", "MOST_", "K_LINE_")) for name in names):
            return "bus that is not CAN"
        has_numbers = any(_is_column(c, group) for c in group.channels if c is not master)
        return "" if has_numbers else "group without numbers"
    return can.refusal


def _is_column(channel: Mf4Channel, group: ChannelGroup) -> bool:
    return not channel.is_array and is_numeric(channel, group.value_bytes)


def _free(name: str, taken: Container[str]) -> str:
    """Return ``name``, with a number appended if it is already used."""
    if name not in taken:
        return name
    number = 2
    while f"{name} ({number})" in taken:
        number += 1
    return f"{name} ({number})"

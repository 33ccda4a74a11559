"""ASAM MDF 4 logs: bus logging groups as CAN frames, other channel groups as tables.

Channels come out as physical values where their conversion is numeric (linear, rational, table);
formulas and texts are not evaluated. A topic's rows come group by group, as the file holds them.
Attachments are never opened. Compressed blocks carry a checksum, which is verified.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.closing import Closing
from crosscue.replay.columns import (
    Block,
    Bytes,
    Int64s,
    Table,
    Topic,
)
from crosscue.replay.errors import LogFormatError
from crosscue.replay.ledger import NOT_ASKED_TIME, NOT_ASKED_TOPIC, Ledger
from crosscue.replay.limits import Limits
from crosscue.replay.log import EVERYTHING, Log, Selection

from .can_rows import FrameRows, blocks_by_bus, bus_number, bus_topic, in_time
from .mf4_blocks import (
    MASTER,
    REMOTE_MASTER,
    TIME,
    VIRTUAL_MASTER,
    VLSD_GROUP,
    Blocks,
    BrokenBlockError,
    Channel,
    DataGroup,
    Group,
    Header,
)
from .mf4_frames import CanLayout, can_layout
from .mf4_records import Records, records_of
from .mf4_values import invalid, is_applied, is_numeric, physical, raw, times_ns

_NAMES_TOLD: Final = 5
_LAST_LENGTH_MISSING: Final = 4
_VLSD_OFFSETS_MISSING: Final = 64


@dataclass(frozen=True, slots=True)
class _Source:
    """One channel group that can be read, or the reason why not."""

    data: DataGroup
    group: Group
    master: Channel | None
    can: CanLayout | None
    topic: str
    refusal: str


def open_mf4(path: Path, limits: Limits) -> Log:
    """Open an MDF 4 log.

    Raises:
        LogFormatError: It is no MDF 4 file, or its header or all of its groups are damaged.
    """
    return Mf4Log(path, limits)


class Mf4Log(Closing):
    """An open MDF 4 log (``Log``)."""

    def __init__(self, path: Path, limits: Limits) -> None:
        """Read the structure, and the first records of bus groups for the names of buses.

        Raises:
            LogFormatError: It is no MDF 4 file, or its header or all of its groups are damaged.
        """
        self._path, self._limits = path, limits
        self._file = path.open("rb")
        self._blocks = Blocks(self._file, path.stat().st_size, limits)
        self._buses: dict[str, int] = {}
        self._broken = ""
        try:
            self._header = self._blocks.header(str(path))
            self._sources = tuple(self._found())
            if self._broken and not self._sources:
                raise LogFormatError(f"{path}: no channel group can be read: {self._broken}")
            self._peek()
        except BaseException:
            self._file.close()
            raise

    @property
    def path(self) -> Path:
        """Where it lies."""
        return self._path

    @property
    def format(self) -> str:
        """Short name of the format."""
        return "mf4"

    @property
    def topics(self) -> tuple[Topic, ...]:
        """Tables, and the buses seen so far: those of first records, after a pass all of them."""
        tables = tuple(
            Topic(s.topic, "crosscue/Table", "columns", declared=self._declared(s.group))
            for s in self._sources
            if s.topic and not s.refusal
        )
        return tuple(bus_topic(name) for name in self._buses) + tables

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """All rows, group by group; see ``Log.read``."""
        for topic in self.topics:
            ledger.declare(topic.name, topic.declared)
        self._say(ledger)
        for source in self._sources:
            if source.refusal:
                count = source.group.records
                ledger.find("", count)
                ledger.skip("", source.refusal, count, source.group.name)
            elif source.can is None and not selection.wants(source.topic):
                ledger.find(source.topic, source.group.records)
                ledger.skip(source.topic, NOT_ASKED_TOPIC, source.group.records)
            else:
                yield from self._blocks_of(source, ledger, selection)
        if self._broken:
            ledger.drop("", "structure damaged", None, self._broken)
        for name in self._buses:
            ledger.topic(name)
        ledger.integrity = (
            "checksums of compressed blocks verified; MDF has none for the rest of the file"
        )

    def _say(self, ledger: Ledger) -> None:
        if self._header.is_local:
            ledger.notice("the log states no time zone; its start time is read as UTC")
        if not self._header.is_finalized:
            ledger.notice(
                "the recorder never finalized the file, so nothing declares how much it must hold"
            )

    def _declared(self, group: Group) -> int | None:
        return group.records if self._header.is_finalized else None

    def _blocks_of(self, source: _Source, ledger: Ledger, selection: Selection) -> Iterator[Block]:
        met = lost = 0
        topic = "" if source.can else source.topic
        declared = self._declared(source.group)
        for records in self._records(source):
            if records.damage:
                left = (declared if declared is not None else records.lost) - met - lost
                count = min(records.lost, max(left, 0))
                lost += count
                ledger.drop(topic, "damaged data", count or None, records.damage)
                continue
            met += len(records.rows)
            if source.can:
                yield from self._frames(source, source.can, records, ledger, selection)
            else:
                yield from self._table(source, records, ledger, selection)
        if declared is not None and met + lost < declared:
            detail = f"{source.group.name}: declared {declared}, found {met}"
            missing = declared - met - lost
            ledger.drop(topic, "declared by the format, not in its bytes", missing, detail)
        elif declared is not None and met > declared:
            ledger.notice(f"{source.group.name}: {declared} records declared, {met} in the file")

    def _records(self, source: _Source) -> Iterator[Records]:
        is_open_ended = bool(self._header.unfinished & _LAST_LENGTH_MISSING)
        return records_of(self._blocks, source.data, source.group, is_open_ended)

    def _times(self, source: _Source, records: Records) -> Int64s | None:
        assert source.master is not None
        values = raw(source.master, records.rows, records.first)
        since = times_ns(source.master, values)
        return None if since is None else since + self._header.start_ns

    def _frames(
        self,
        source: _Source,
        layout: CanLayout,
        records: Records,
        ledger: Ledger,
        selection: Selection,
    ) -> Iterator[Block]:
        log_ns = self._times(source, records)
        if log_ns is None:
            ledger.drop("", "time out of range", len(records.rows), source.group.name)
            return
        rows = layout.frames(records, log_ns)
        bad = len(records.rows) - len(rows)
        detail = f"{source.group.name}, from record {records.first} on"
        ledger.drop("", "record that cannot be a frame", bad, detail)
        rows = self._named(rows, ledger)
        yield from blocks_by_bus(rows, tuple(self._buses), ledger, selection)

    def _named(self, rows: FrameRows, ledger: Ledger) -> FrameRows:
        channels, codes = np.unique(rows.bus, return_inverse=True)
        bus = np.array(
            [bus_number(str(channel), self._buses) for channel in channels.tolist()], np.int64
        )
        named = FrameRows(
            rows.place, bus[codes] if len(bus) else rows.bus, rows.log_ns, rows.frames
        )
        is_known = named.bus >= 0
        if not bool(is_known.all()):
            extra = len(rows) - int(np.count_nonzero(is_known))
            ledger.drop("", "more buses than a log can have", extra)
            return named.take(is_known)
        return named

    def _table(
        self, source: _Source, records: Records, ledger: Ledger, selection: Selection
    ) -> Iterator[Block]:
        count = len(records.rows)
        log_ns = self._times(source, records)
        if log_ns is None:
            ledger.drop(source.topic, "time out of range", count, f"from record {records.first} on")
            return
        ledger.find(source.topic, count)
        inside = in_time(log_ns, selection)
        rows = records.rows
        if inside is not None:
            ledger.skip(source.topic, NOT_ASKED_TIME, count - int(np.count_nonzero(inside)))
            log_ns, rows = log_ns[inside], rows[inside]
        if len(rows):
            yield Block(source.topic, log_ns, self._columns(source, rows, ledger))

    def _columns(self, source: _Source, rows: Bytes, ledger: Ledger) -> Table:
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
            values = physical(channel.conversion, raw(channel, rows, 0))
            bad = invalid(channel, rows, source.group.value_bytes)
            if bad is not None:
                values = np.where(bad, np.nan, values.astype(np.float64))
            columns[name] = values
            if not is_applied(channel.conversion):
                unconverted.append(name)
            elif channel.unit:
                units[name] = channel.unit
        for names, what in (
            (left_out, "are no single numbers and are left out"),
            (unconverted, "have a conversion that is not evaluated; raw values are given"),
        ):
            if names:
                some = ", ".join(names[:_NAMES_TOLD]) + (", ..." if len(names) > 5 else "")
                ledger.notice(f"{source.topic}: {len(names)} channels {what}: {some}")
        return Table(columns, units)

    def _peek(self) -> None:
        scratch = Ledger(str(self._path))
        for source in self._sources:
            if source.can and not source.refusal:
                for records in self._records(source):
                    if not records.damage:
                        for _ in self._frames(source, source.can, records, scratch, EVERYTHING):
                            pass
                        break

    def _found(self) -> Iterator[_Source]:
        names: dict[str, NDArray[np.generic]] = {}
        try:
            for data in self._blocks.data_groups(self._header.first_group):
                for group in data.groups:
                    if group.flags & VLSD_GROUP or not (group.records or self._may_hold(data)):
                        continue
                    yield self._source(data, group, names)
        except BrokenBlockError as broken:
            self._broken = str(broken)

    def _may_hold(self, data: DataGroup) -> bool:
        return not self._header.is_finalized and bool(data.data)

    def _source(
        self, data: DataGroup, group: Group, names: dict[str, NDArray[np.generic]]
    ) -> _Source:
        masters = [c for c in group.channels if c.type in (MASTER, VIRTUAL_MASTER)]
        master = next((c for c in masters if c.sync == TIME), None)
        can = can_layout(self._blocks, group)
        refusal = _refusal(data, group, master, can, self._header)
        topic = ""
        if can is None and not refusal:
            topic = _free(group.name or "group", names)
            names[topic] = np.zeros(0)
        return _Source(data, group, master, can, topic, refusal)


def _refusal(
    data: DataGroup, group: Group, master: Channel | None, can: CanLayout | None, header: Header
) -> str:
    """Why a group cannot be read; empty when it can."""
    if group.flags & REMOTE_MASTER:
        return "column-oriented storage, not supported"
    if master is None:
        return "group without a time channel"
    if master.type == MASTER and not is_numeric(master, group.value_bytes):
        return "time channel is no number"
    if can is None:
        names = {channel.name for channel in group.channels}
        if any(name.startswith(("LIN_", "ETH_", "FLX_", "MOST_", "K_LINE_")) for name in names):
            return "bus that is no CAN"
        has_numbers = any(_is_column(c, group) for c in group.channels if c is not master)
        return "" if has_numbers else "group without numbers"
    if can.is_variable and (data.id_bytes or header.unfinished & _VLSD_OFFSETS_MISSING):
        return "variable-length payloads in unsorted data, not supported; finalize the file first"
    return can.refusal


def _is_column(channel: Channel, group: Group) -> bool:
    return not channel.is_array and is_numeric(channel, group.value_bytes)


def _free(name: str, taken: dict[str, NDArray[np.generic]]) -> str:
    """``name``, or with the first number that makes it new."""
    if name not in taken:
        return name
    number = 2
    while f"{name} ({number})" in taken:
        number += 1
    return f"{name} ({number})"

"""One pass over a ROS 1 bag: blocks, and the account of every message."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.columns import BLOCK_BYTES, BLOCK_ROWS, Block, Bytes, Int64s, Topic
from crosscue.replay.ledger import DAMAGED_RECORD, OTHER_TYPE, Ledger
from crosscue.replay.limits import Limits
from crosscue.replay.readers.mixed import MixedRows, blocks_of

from .chunk import CUT, TOO_LARGE, ChunkRows, Inflated, inflate_records, read_chunk
from .index import BytesBetween, ChunkUnit, Contents, units
from .records import (
    CHUNK_INFO,
    CONNECTION,
    MESSAGE,
    BagFile,
    BagRecord,
    ChunkInfo,
    Connection,
    connection_of,
    tally,
)
from .window import BagWindow, find_bag_window

# Size of the buffers into which chunks are copied, unless a chunk is larger. NumPy requests huge
# pages from 4 MiB on. Separate buffers for all chunks would take more time for page faults than the
# copies take.
BATCH_BYTES: Final = BLOCK_BYTES // 2

NO_CONNECTION: Final = "message of an unknown connection"
TWO_RECORDS: Final = "the records of a connection differ"


class Roster:
    """Topics of ``contents`` by connection; those that a chunk declares are added."""

    def __init__(self, contents: Contents) -> None:
        self.contents = contents
        self._topics: dict[str, Topic] = {}
        self._first: dict[str, Connection] = {}
        for number in sorted(contents.connections):
            self.add(contents.connections[number])

    def add(self, connection: Connection) -> None:
        """Add a connection; the first connection of a topic determines its type."""
        self.contents.connections[connection.conn] = connection
        if connection.topic in self._topics:
            return
        self._first[connection.topic] = connection
        self._topics[connection.topic] = Topic(
            connection.topic,
            connection.type_name,
            encoding="ros1",
            schema=connection.definition,
            schema_encoding="ros1msg",
        )

    @property
    def topics(self) -> tuple[Topic, ...]:
        """Return all topics known so far, with the counts declared in the index section."""
        counts = self._declared()
        return tuple(replace(t, declared=counts.get(t.name)) for t in self._topics.values())

    def topic_of(self, conn: int) -> str:
        """Return the topic of a connection; empty if unknown."""
        connection = self.contents.connections.get(conn)
        return connection.topic if connection is not None else ""

    def fits_topic(self, conn: int) -> bool:
        """Return whether a connection has the type of its topic's first connection."""
        connection = self.contents.connections[conn]
        first = self._first[connection.topic]
        return (connection.type_name, connection.md5sum) == (first.type_name, first.md5sum)

    def knows(self, conn: int) -> bool:
        """Return whether a connection has a record."""
        return conn in self.contents.connections

    def _declared(self) -> dict[str, int]:
        if not self.contents.is_complete:
            return {}
        counts: Counter[str] = Counter(dict.fromkeys(self._topics, 0))
        for info in self.contents.infos.values():
            for conn, count in info.counts.items():
                counts[self.topic_of(conn)] += count
        return dict(counts)


@dataclass(slots=True)
class _Checked:
    """Numbers of checked chunks by kind of checksum, and of messages outside chunks."""

    bz2: int = 0
    lz4: int = 0
    unchecked: int = 0
    left: int = 0
    loose: int = 0

    def words(self) -> str:
        """Return the sentence for ``Ledger.integrity``."""
        said = [
            f"{name} checksums verified in {count} chunks"
            for name, count in (("bz2", self.bz2), ("lz4", self.lz4))
            if count
        ]
        if self.unchecked:
            said.append(
                f"{self.unchecked} chunks have no checksum: a changed payload byte in them cannot "
                "be detected"
            )
        if self.loose:
            said.append(
                f"{self.loose} messages outside chunks have no checksum: a changed byte in them "
                "cannot be detected"
            )
        if self.left:
            read = self.bz2 + self.lz4 + self.unchecked
            verb = "was" if read == 1 else "were"
            verified = " and verified" if read and not self.unchecked else ""
            said.append(
                f"of {read + self.left} chunks {read} {verb} read{verified}; the rest was not"
            )
        return "; ".join(said) or "no chunk read, nothing to check"


@dataclass(slots=True)
class _Batch:
    """Rows of several chunks, collected for the next blocks.

    Attributes:
        parts: Columns of rows: connection, log time, start and stop of the payload.
    """

    buffer: Bytes | None = None
    parts: list[tuple[Int64s, ...]] = field(default_factory=list)
    size: int = 0
    count: int = 0

    def has_room(self, raw: bytes) -> bool:
        """Return whether ``raw`` can be added; an empty batch accepts any size."""
        return not self.size or (self.size + len(raw) <= BATCH_BYTES and self.count < BLOCK_ROWS)

    def add(self, raw: bytes, rows: ChunkRows) -> None:
        """Add a chunk for which ``has_room`` is true."""
        content = np.frombuffer(raw, dtype=np.uint8)
        if self.buffer is None:
            is_large = len(raw) > BATCH_BYTES
            self.buffer = content if is_large else np.empty(BATCH_BYTES, dtype=np.uint8)
        if self.buffer is not content:
            self.buffer[self.size : self.size + len(raw)] = content
        starts, stops = rows.start + self.size, rows.stop + self.size
        self.parts.append((rows.conn, rows.log_ns, starts, stops))
        self.size += len(raw)
        self.count += len(rows.conn)


@dataclass(eq=False)
class Pass:
    """The state of one ``read``."""

    _file: BagFile
    _roster: Roster
    _limits: Limits
    _ledger: Ledger
    _selection: Selection
    _inside: BagWindow | None = None
    _doubt: str = ""
    _batch: _Batch = field(default_factory=_Batch)
    _owed: Counter[int] = field(default_factory=Counter)
    _owed_by: tuple[int, int] | None = None
    _checked: _Checked = field(default_factory=_Checked)

    def __post_init__(self) -> None:
        self._contents = self._roster.contents

    def blocks(self) -> Iterator[Block]:
        """Yield all blocks in stored order."""
        for topic in self._roster.topics:
            self._ledger.declare(topic.name, topic.declared)
        for connection in self._contents.connections.values():
            self._say_if_renamed(connection)
        try:
            window = self._window()
            if window is None:
                held = self._contents
                known = sorted(held.infos)
                yield from self._taken(
                    units(self._file, held.first, known, self._limits, held.connections)
                )
            else:
                yield from self._windowed(window)
        except OSError as error:
            self._ledger.drop("", "reading the file failed", None, str(error.strerror or error))
        yield from self._flush()
        for name in [t.name for t in self._roster.topics]:
            self._ledger.settle(name)
        self._ledger.integrity = self._checked.words()

    def _window(self) -> BagWindow | None:
        """Locate the selection by the index; if it cannot be trusted, report the reason."""
        if self._selection == EVERYTHING:
            return None
        found = find_bag_window(self._contents, self._selection)
        if isinstance(found, BagWindow):
            return found
        self._ledger.notice(f"the requested part was found by reading the complete bag: {found}")
        return None

    def _windowed(self, window: BagWindow) -> Iterator[Block]:
        """Yield blocks of the indexed chunks; if the index is wrong, examine the others too."""
        self._inside = window
        self._file.expect(window.ranges())
        connections = self._contents.connections
        yield from self._taken(window.units(self._file, self._limits, connections))
        self._inside = None
        if self._doubt:
            self._ledger.notice(
                f"the index proved unreliable ({self._doubt}); every chunk was examined"
            )
            others = window.units(self._file, self._limits, connections, is_read=False)
            yield from self._taken(others)
            return
        for info in window.left:
            self._checked.left += 1
            self._pass_over(info)

    def _taken(self, found: Iterator[ChunkUnit | BagRecord | BytesBetween]) -> Iterator[Block]:
        for unit in found:
            taken = None
            if not isinstance(unit, BagRecord):
                self._settle_owed()
            if isinstance(unit, ChunkUnit):
                taken = self._chunk(unit)
            elif isinstance(unit, BytesBetween):
                self._doubt = self._doubt or f"bytes {unit.at} to {unit.stop} are damaged"
                self._gap(unit)
            else:
                taken = self._record(unit)
            if taken is not None:
                if not self._batch.has_room(taken[0]):
                    yield from self._flush()
                self._batch.add(*taken)
        self._settle_owed()

    def _pass_over(self, info: ChunkInfo) -> None:
        """Account for a chunk of unselected messages without reading them."""
        for conn, count in info.counts.items():
            self._selection.leave(self._roster.topic_of(conn), count, self._ledger)

    def _record(self, record: BagRecord) -> tuple[bytes, ChunkRows] | None:
        """Process a record outside chunks; return a message as a separate chunk."""
        if record.op == MESSAGE:
            self._checked.loose += 1
            conn_number = record.u32(b"conn")
            if not self._roster.knows(conn_number):
                where = f"connection {conn_number}, bytes {record.at} to {record.end}"
                self._ledger.drop("", NO_CONNECTION, 1, where)
                return None
            if self._owed[conn_number] > 0:
                self._owed[conn_number] -= 1
            if record.size > self._limits.message_bytes:
                self._ledger.drop(
                    self._roster.topic_of(conn_number),
                    "message over the size limit",
                    1,
                    f"{record.size} bytes at byte {record.at}",
                )
                return None
            raw = self._file.bytes_at(record.body, record.end)
            conn, log_ns, start, stop = (
                np.array([value], dtype=np.int64)
                for value in (conn_number, record.time_ns(b"time"), 0, len(raw))
            )
            return raw, ChunkRows(conn, log_ns, start, stop)
        if record.op == CONNECTION and record.size <= 2 * self._limits.schema_bytes:
            body = self._file.bytes_at(record.body, record.end)
            connection = connection_of(record, body, self._limits.schema_bytes)
            if connection is not None:
                self._meet(connection, is_checked=False)
        elif record.op == CHUNK_INFO and record.u64(b"chunk_pos") not in self._contents.infos:
            self._ledger.notice(f"damaged chunk info at byte {record.at}; it is only an index")
        return None

    def _meet(self, connection: Connection, is_checked: bool) -> None:
        known = self._contents.connections.get(connection.conn)
        if known is None:
            self._roster.add(connection)
            self._say_if_renamed(connection)
        elif known != connection:
            detail = (
                f"connection {connection.conn}: {known.topic} ({known.type_name}) and "
                f"{connection.topic} ({connection.type_name})"
            )
            if is_checked:
                self._roster.add(connection)
                self._ledger.notice(f"{TWO_RECORDS}, the one with a checksum was used: {detail}")
            else:
                self._ledger.drop(known.topic, TWO_RECORDS, None, detail)

    def _say_if_renamed(self, connection: Connection) -> None:
        if connection.topic != connection.published:
            self._ledger.notice(
                f"connection {connection.conn} is stored as {connection.topic}, but was published "
                f"as {connection.published}: renamed, or damaged"
            )

    def _gap(self, gap: BytesBetween) -> None:
        where = f"bytes {gap.at} to {gap.stop}"
        within = [info for at, info in self._contents.infos.items() if gap.at <= at < gap.stop]
        if (
            self._contents.infos
            and self._contents.is_complete
            and (within or not self._checked.loose)
        ):
            # The messages of a chunk without its header may be found singly after the gap.
            self._owed_by = gap.at, gap.stop
            for info in within:
                self._owed.update(info.counts)
        elif 0 < self._contents.index_at <= gap.at:
            self._ledger.notice(f"the index section is damaged: {where}")
        else:
            reason = CUT if gap.stop == self._file.size else DAMAGED_RECORD
            self._ledger.drop("", reason, None, where)

    def _settle_owed(self) -> None:
        """Account for the messages hidden by a gap, after reading the messages that follow it."""
        if self._owed_by is not None:
            self._lose(self._owed, DAMAGED_RECORD, "bytes {} to {}".format(*self._owed_by))
        self._owed, self._owed_by = Counter(), None

    def _lose(self, missing: Counter[int], reason: str, detail: str) -> None:
        """Account for a known number of rows by connection; add a notice if it is zero."""
        for conn, count in missing.items():
            self._ledger.drop(self._roster.topic_of(conn), reason, max(count, 0), detail)
        if not any(count > 0 for count in missing.values()):
            self._ledger.notice(f"{reason}, no message lost: {detail}")

    def _chunk(self, unit: ChunkUnit) -> tuple[bytes, ChunkRows] | None:
        """Return the records of a chunk and their messages, and account for them."""
        if self._inside is not None and not self._is_as_indexed(unit):
            self._doubt = self._doubt or f"it does not match the chunk at byte {unit.record.at}"
        if self._is_skipped(unit):
            return None
        size = unit.record.u32(b"size")
        where = f"chunk at byte {unit.record.at}"
        if max(size, unit.stored_stop - unit.record.body) > self._limits.chunk_bytes and (
            unit.is_framed or size > self._limits.chunk_bytes
        ):
            detail = f"{where}: {size} bytes, limit {self._limits.chunk_bytes} (--max-chunk)"
            self._short(unit, Counter(), TOO_LARGE, detail)
            return None
        stop = min(unit.stored_stop, unit.record.body + self._limits.chunk_bytes)
        stored = self._file.bytes_at(unit.record.body, stop)
        inflated = inflate_records(unit.record.fields[b"compression"], stored, size, unit.is_framed)
        limits = self._limits
        rows = read_chunk(inflated, unit.entries, limits.schema_bytes, limits.records_per_chunk)
        for connection in rows.connections:
            self._meet(connection, inflated.is_checked)
        self._say_if_misframed(unit, inflated, where)
        self._count_check(unit, inflated)
        self._compare(unit, inflated, rows, where)
        return inflated.raw, self._of_known(rows, where)

    def _say_if_misframed(self, unit: ChunkUnit, inflated: Inflated, where: str) -> None:
        """Report a wrong length of a chunk, and account for the bytes after its content."""
        if unit.record.end != unit.stored_stop:
            self._ledger.notice(f"the length of the {where} is damaged; its content was found")
        if inflated.unused and not unit.is_framed:
            begin = unit.stored_stop - inflated.unused
            self._ledger.drop("", DAMAGED_RECORD, None, f"bytes {begin} to {unit.stored_stop}")

    def _of_known(self, rows: ChunkRows, where: str) -> ChunkRows:
        """Drop the messages of connections without a record, and return the others."""
        unknown = [conn for conn in rows.counts() if not self._roster.knows(conn)]
        for conn in unknown:
            count = rows.counts()[conn]
            self._ledger.drop("", NO_CONNECTION, count, f"connection {conn}, {where}")
        return rows.take(~np.isin(rows.conn, unknown)) if unknown else rows

    def _count_check(self, unit: ChunkUnit, inflated: Inflated) -> None:
        if not inflated.is_checked:
            self._checked.unchecked += 1
        elif unit.record.fields[b"compression"] == b"bz2":
            self._checked.bz2 += 1
        else:
            self._checked.lz4 += 1

    def _compare(self, unit: ChunkUnit, inflated: Inflated, rows: ChunkRows, where: str) -> None:
        found = Counter(rows.counts())
        if rows.fault:
            inside = f", byte {rows.fault_at} of it" if rows.fault_at >= 0 else ""
            sizes = f": {inflated.sizes}" if inflated.sizes else ""
            self._short(unit, found, rows.fault, where + inside + sizes)
            return
        if unit.entries is not None and unit.entries.counts() != found:
            self._ledger.notice(f"the index after the {where} is damaged; it was not used")
            if not inflated.is_checked:
                self._lose(Counter(unit.entries.counts()) - found, "listed in the index", where)

    def _short(self, unit: ChunkUnit, found: Counter[int], reason: str, detail: str) -> None:
        """Account for the messages that a damaged chunk must have had, beyond those found."""
        expected: Counter[int] = Counter()
        info = self._contents.infos.get(unit.record.at)
        if info is not None:
            expected |= Counter(info.counts)
        if unit.entries is not None:
            expected |= Counter(unit.entries.counts())
        if expected:
            self._lose(expected - found, reason, detail)
        else:
            self._ledger.drop("", reason, None, detail)

    def _is_as_indexed(self, unit: ChunkUnit) -> bool:
        """Return whether the index section agrees with the index records after the chunk."""
        info, entries = self._contents.infos.get(unit.record.at), unit.entries
        if info is None or entries is None or not len(entries) or not unit.is_framed:
            return False
        span = int(entries.log_ns.min()), int(entries.log_ns.max())
        return (*span, entries.counts()) == (info.start_ns, info.end_ns, info.counts)

    def _is_skipped(self, unit: ChunkUnit) -> bool:
        """Skip a chunk if both of its indexes agree that none of its messages is selected."""
        asked = self._selection
        info = self._contents.infos.get(unit.record.at)
        if info is None or not self._is_as_indexed(unit):
            return False
        if not all(self._roster.knows(conn) for conn in info.counts):
            return False
        is_outside = (asked.start_ns is not None and info.end_ns < asked.start_ns) or (
            asked.end_ns is not None and info.start_ns >= asked.end_ns
        )
        names = {conn: self._roster.topic_of(conn) for conn in info.counts}
        if not is_outside and any(asked.wants(name) for name in names.values()):
            return False
        self._checked.left += 1
        self._pass_over(info)
        return True

    def _flush(self) -> Iterator[Block]:
        batch, self._batch = self._batch, _Batch()
        if batch.buffer is None or not batch.count:
            return
        conn, *columns = (np.concatenate(parts) for parts in zip(*batch.parts, strict=True))
        names: list[str] = []
        place: dict[int, int] = {}
        for number, count in tally(conn).items():
            name = self._roster.topic_of(number)
            if not self._roster.fits_topic(number):
                self._ledger.find(name, count)
                self._ledger.skip(name, OTHER_TYPE, count, f"connection {number}")
            else:
                if name not in names:
                    names.append(name)
                place[number] = names.index(name)
        topic = _looked_up(conn, place)
        keep = topic >= 0
        rows = MixedRows(batch.buffer[: batch.size], topic[keep], *(each[keep] for each in columns))
        yield from blocks_of(rows, names, self._selection, self._limits, self._ledger)


def _looked_up(conn: Int64s, place: dict[int, int]) -> Int64s:
    """Return ``place`` of each connection number, -1 if missing."""
    numbers = np.array(sorted(place), dtype=np.int64)
    if not len(numbers):
        return np.full(len(conn), -1, dtype=np.int64)
    places = np.array([place[int(n)] for n in numbers], dtype=np.int64)
    at = np.minimum(np.searchsorted(numbers, conn), len(numbers) - 1)
    return np.where(numbers[at] == conn, places[at], -1)

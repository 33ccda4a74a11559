"""Reader of ROS 2 bags in SQLite (.db3): yields all readable rows and reports the others.

SQLite has no checksums. The reader therefore checks the file's structure, with SQLite's own
integrity check where the file is unusual, damaged or read in part, and the types and the order of
the rows, and the file's length. In an undamaged file, common rows are read directly from the pages.
All other rows are read through SQLite.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.columns import Block, Int64s, Messages, Topic
from crosscue.replay.files.closing import Closing
from crosscue.replay.ledger import OTHER_TYPE, Ledger
from crosscue.replay.limits import DEFAULT_LIMITS, Limits
from crosscue.replay.readers.can_rows import keep_memory
from crosscue.replay.readers.mixed import MixedRows, blocks_of

from .inflate import DAMAGED, inflated
from .page_file import Soundness
from .pages import page_rows
from .rows import FIRST_ROWID, LAST_ROWID, Row, RowColumns, RowScan, index_times
from .soundness import soundness
from .sqlite import FAULTS, Database, open_database
from .tables import StorageTables, fetched, read_storage_tables

DAMAGED_PAGE: Final = "damaged page in the database"
DISORDER: Final = "row out of order in a damaged page"
UNSOUND: Final = "SQLite's integrity check finds damage"
NO_TOPIC: Final = "message without a topic"
NOT_A_TIME: Final = "timestamp is not an integer"
NOT_BYTES: Final = "payload is not a blob"
_SMALL: Final = 1 << 16
DELETED: Final = "row numbers missing"
INDEX_DIFFERS: Final = "row and time index disagree"


class Db3Log(Closing):
    """An open ROS 2 SQLite bag; see ``crosscue.replay.base.Log``."""

    format: Final = "rosbag2-sqlite3"

    def __init__(self, path: Path, limits: Limits = DEFAULT_LIMITS) -> None:
        """Open the file and find its topics.

        Raises:
            LogFormatError: Not a SQLite file, or without the tables of a ROS 2 bag.
            LogError: SQLite cannot open the file.
            OSError: The file cannot be read.
        """
        self.path: Final = path
        self._limits = limits
        self._stamp = _stamp(path)
        self._database = open_database(path, limits)
        try:
            self._tables = read_storage_tables(self._database, path, limits)
        except BaseException:
            self.close()
            raise

    @property
    def topics(self) -> tuple[Topic, ...]:
        """Topics in order of their numbers; the format declares no counts."""
        return tuple(self._tables.topics.values())

    @property
    def time_range_ns(self) -> tuple[int, int] | None:
        """Return the first and last timestamp; None without rows or if SQLite fails."""
        try:
            # Each is found in the index at once; asked for together, they need every row.
            first, last = (
                fetched(self._database, f"SELECT {end}(timestamp) FROM messages")[0][0]  # noqa: S608
                for end in ("MIN", "MAX")
            )
        except FAULTS:
            return None
        return (first, last) if isinstance(first, int) and isinstance(last, int) else None

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Yield blocks of messages in the order of their row ids; see ``Log.read``."""
        one = _Pass(self._database, self._tables, self._limits, ledger, selection)
        yield from one.blocks()
        if _stamp(self.path) != self._stamp:
            ledger.drop("", "file changed while it was read", None, "read it again")

    def report_missing(self, ledger: Ledger) -> None:
        """Report bytes or committed rows that SQLite cannot read; see ``KnowsItsEnd``."""
        if self._database.damage:
            ledger.drop("", DAMAGED_PAGE, None, self._database.damage)

    def close(self) -> None:
        """Close the file and remove any temporary copy."""
        self._database.close()


class _Pass:
    """One pass over the rows."""

    def __init__(
        self,
        database: Database,
        tables: StorageTables,
        limits: Limits,
        ledger: Ledger,
        selection: Selection,
    ) -> None:
        self._database = database
        self._tables = tables
        self._limits = limits
        self._ledger = ledger
        self._selection = selection
        self._names = list(tables.topics)
        self._place = tables.places()
        self._places = _place_table(self._place)
        self._fetched = self._numbers_asked()
        self._scan = RowScan(database, FIRST_ROWID, LAST_ROWID, self._fetched)
        self._counts: dict[str, int] | None = None
        self._indexed: tuple[Int64s, Int64s] | None = None
        self._sound: Soundness | None = None
        self._in_time_by_index: int | None = None
        self._in_time = 0
        self._met = 0

    def _numbers_asked(self) -> frozenset[int] | None:
        """Return the numbers of the selected topics, or None for all."""
        asked = frozenset(
            n for n, at in self._place.items() if self._selection.wants(self._names[at])
        )
        return None if len(asked) == len(self._place) else asked

    def blocks(self) -> Iterator[Block]:
        """Yield the selected blocks and account for all rows."""
        keep_memory()
        for sentence in (*self._database.notices, *self._tables.notices):
            self._ledger.notice(sentence)
        for topic in self._tables.topics.values():
            self._ledger.declare(topic.name, topic.declared)
        self._narrow()
        problems = ""
        if self._in_time_by_index is None:
            with _lock(self._database) as is_locked:
                is_plain = is_locked and not self._database.damage
                if is_plain and self._fetched is None:
                    self._sound = soundness(self._database, self._limits)
                if self._sound is None:
                    problems = self._problems()
                if is_plain and not problems:
                    yield from self._plain_blocks()
                # The chains of pages of long rows are checked when they are read.
                if self._sound is not None and not self._sound.is_complete:
                    problems = self._problems()
        for rows in self._scan.batches():
            yield from self._blocks_of(rows)
        self._finish(problems)

    def _plain_blocks(self) -> Iterator[Block]:
        """Yield rows directly from the pages, up to the first unusual one."""
        for rows in page_rows(self._database, self._fetched, self._limits, self._sound):
            self._met += len(rows)
            self._scan = RowScan(self._database, int(rows.ids[-1]) + 1, LAST_ROWID, self._fetched)
            yield from self._grouped(rows.messages, self._placed(rows.topics), rows.times)

    def _narrow(self) -> None:
        """Restrict the scan to the row ids of the selected times, if the index is complete."""
        asked, index = self._selection, self._tables.index
        if index is None or not asked.is_timed:
            return
        counts = self._tables.counts(self._database)
        if counts is None:
            return
        start = FIRST_ROWID if asked.start_ns is None else asked.start_ns
        end = LAST_ROWID if asked.end_ns is None else asked.end_ns
        try:
            total = fetched(self._database, f"SELECT COUNT(*) FROM messages INDEXED BY {index}")  # noqa: S608
            query = (
                f"SELECT MIN(rowid), MAX(rowid), COUNT(*) FROM messages INDEXED BY {index} "  # noqa: S608
                "WHERE timestamp >= ? AND timestamp < ?"
            )
            first, last, count = fetched(self._database, query, (start, end))[0]
        except FAULTS:
            return
        if total[0][0] == sum(counts.values()):
            self._in_time_by_index, self._counts = count, counts
            first, last = (0, -1) if first is None else (first, last)
            self._scan = RowScan(self._database, first, last, self._fetched)

    def _problems(self) -> str:
        """Return the problems that SQLite's integrity check finds; empty for none."""
        try:
            said = [str(row[0]) for row in fetched(self._database, "PRAGMA integrity_check(5)")]
        except FAULTS as error:
            said = [str(error)]
        if said == ["ok"]:
            return ""
        if self._tables.index is not None:
            self._indexed = index_times(self._database, self._tables.index)
        return "; ".join(said).replace("\n", " ")

    def _blocks_of(self, rows: RowColumns) -> Iterator[Block]:
        self._met += len(rows)
        for row in rows.odd:
            self._skip_odd(row)
        if not len(rows.ids):
            return
        stop = np.cumsum(rows.length)
        messages = Messages(np.frombuffer(rows.payloads, np.uint8), stop - rows.length, stop)
        place = self._placed(rows.topics)
        if self._indexed is not None:
            self._drop_disputed(rows.ids, rows.times, place)
        if self._in_time_by_index is not None:
            self._in_time += int(self._selection.inside(rows.times).sum())
        yield from self._grouped(messages, place, rows.times)

    def _grouped(self, messages: Messages, place: Int64s, log_ns: Int64s) -> Iterator[Block]:
        for part, plain, damaged in inflated(messages, self._limits):
            topic, times = place[part].copy(), log_ns[part]
            for i, why in damaged.items():
                if topic[i] >= 0:
                    name = self._names[int(topic[i])]
                    self._ledger.drop(name, DAMAGED, 1, why, int(times[i]))
            topic[list(damaged)] = -1
            keep = topic >= 0
            start, stop = plain.start[keep], plain.stop[keep]
            rows = MixedRows(plain.buffer, topic[keep], times[keep], start, stop)
            yield from blocks_of(rows, self._names, self._selection, self._limits, self._ledger)

    def _skip_odd(self, row: Row) -> None:
        """Skip a row with values of wrong types, by reason."""
        number, topic, time, payload = row
        if not isinstance(topic, int):
            reason = NO_TOPIC
        elif not isinstance(time, int):
            reason = NOT_A_TIME
        else:
            reason = NOT_BYTES
        place = self._place.get(topic, -1) if isinstance(topic, int) else -1
        name = self._names[place] if place >= 0 else ""
        detail = (
            f"row {number}: topic {topic!r:.40}, timestamp {time!r:.40}, "
            f"payload {type(payload).__name__}"
        )
        self._ledger.find(name, 1)
        self._ledger.skip(name, reason, 1, detail)

    def _placed(self, numbers: Int64s) -> Int64s:
        """Return the index of each row's topic name; -1 for rows that are not yielded."""
        if numbers.min() >= 0 and numbers.max() < len(self._places):
            known = self._places[numbers]
            if known.min() >= 0:
                return known
        distinct, which, counts = np.unique(numbers, return_inverse=True, return_counts=True)
        place = np.array([self._place.get(int(n), -1) for n in distinct], dtype=np.int64)
        for i in np.flatnonzero(place < 0):
            number, count = int(distinct[i]), int(counts[i])
            name = next((s.name for s in self._tables.stored if s.number == number), "")
            self._ledger.find(name, count)
            reason = OTHER_TYPE if name else NO_TOPIC
            self._ledger.skip(name, reason, count, f"topic number {number}")
        return place[which]

    def _drop_disputed(self, ids: Int64s, log_ns: Int64s, place: Int64s) -> None:
        """Drop rows that contradict the index, because no checksum decides which time is right."""
        if self._indexed is None or not len(self._indexed[0]):
            return
        listed, times = self._indexed
        at = np.minimum(np.searchsorted(listed, ids), len(listed) - 1)
        for i in np.flatnonzero((listed[at] == ids) & (times[at] != log_ns) & (place >= 0)):
            detail = f"row {ids[i]}: row {log_ns[i]}, index {times[at[i]]}"
            self._ledger.drop(self._names[int(place[i])], INDEX_DIFFERS, 1, detail)
            place[i] = -1

    def _finish(self, problems: str) -> None:
        """Compare with SQLite's counts, and report the checks."""
        ledger, scan = self._ledger, self._scan
        is_part = self._in_time_by_index is not None
        ledger.integrity = (
            "SQLite has no checksums: a changed payload byte, length or topic number cannot be "
            "detected"
        )
        self._declare(is_doubtful=bool(problems or scan.holes or scan.disordered))
        if is_part and self._in_time_by_index != self._in_time:
            detail = f"index {self._in_time_by_index}, rows {self._in_time}"
            ledger.drop("", INDEX_DIFFERS, None, detail)
        if is_part and not scan.holes:
            self._skip_rest()
        for name in self._names:
            ledger.settle(name, DAMAGED_PAGE)
        if not is_part and not problems and ledger.is_whole:
            self._drop_deleted()
        if scan.disordered and ledger.is_whole:
            ledger.drop("", DISORDER, scan.disordered)
        if scan.holes and ledger.is_whole:
            ledger.drop("", DAMAGED_PAGE, self._missing(), "; ".join(scan.holes[:3]))
        if self._database.damage and ledger.is_whole:
            ledger.drop("", DAMAGED_PAGE, None, self._database.damage)
        if is_part:
            ledger.integrity += "; a part was read, the file's structure was not checked"
        elif not problems:
            ledger.integrity += "; the check of its structure finds no fault"
        else:
            ledger.integrity += "; SQLite's check finds damage"
            if ledger.is_whole:
                ledger.drop("", UNSOUND, None, problems)
            else:
                ledger.notice(f"{UNSOUND}: {problems}")

    def _drop_deleted(self) -> None:
        """Drop rows whose numbers are missing, because recorders number rows consecutively."""
        try:
            # Asked for together, they make SQLite read every row.
            first, last = (
                fetched(self._database, f"SELECT {one}(rowid) FROM messages")[0][0]  # noqa: S608
                for one in ("MIN", "MAX")
            )
        except FAULTS:
            return
        count = self._total()
        if count:
            detail = f"rows {first} to {last}, of which {count} exist"
            self._ledger.drop("", DELETED, last - first + 1 - count, detail)

    def _missing(self) -> int | None:
        """Return the number of rows in the time index beyond those found; None if unknown."""
        if self._indexed is None or len(self._indexed[0]) <= self._met:
            return None
        return len(self._indexed[0]) - self._met

    def _declare(self, *, is_doubtful: bool) -> None:
        """Declare the number of rows that SQLite counts, if it may differ from those found.

        Counting by topic reads the complete table again. After a full pass, it is done only if
        there is a problem, or if the time index has a different number of rows.
        """
        if self._counts is None and (is_doubtful or self._total() != self._met):
            self._counts = self._tables.counts(self._database)
        for name, count in (self._counts or {}).items():
            if name:
                self._ledger.declare(name, count)

    def _total(self) -> int | None:
        """Return SQLite's number of rows, which it counts in the smallest index."""
        if self._sound is not None:
            return self._sound.rows
        try:
            return int(fetched(self._database, "SELECT COUNT(*) FROM messages")[0][0])
        except FAULTS:
            return None

    def _skip_rest(self) -> None:
        """Count the rows outside the scan, which were not read, as skipped."""
        for name, declared in (self._counts or {}).items():
            if not name:
                continue
            rest = declared - self._ledger.topic(name).in_file
            if rest > 0:
                self._selection.leave(name, rest, self._ledger)


def _place_table(places: Mapping[int, int]) -> Int64s:
    """Return places by topic number, -1 if missing, for the small numbers that recorders use."""
    small = {number: at for number, at in places.items() if 0 <= number < _SMALL}
    table = np.full(max(small, default=-1) + 1, -1, dtype=np.int64)
    table[list(small)] = list(small.values())
    return table


@contextmanager
def _lock(database: Database) -> Iterator[bool]:
    """Prevent writing with an open SQLite statement; yield whether that succeeded."""
    try:
        statement = database.connection.execute("SELECT 1 FROM messages")
        is_open = statement.fetchone() is not None
    except FAULTS:
        yield False
        return
    try:
        yield is_open
    finally:
        # An unfinished iterator may outlive the connection.
        with suppress(*FAULTS):
            statement.close()


def _stamp(path: Path) -> tuple[int, int, int]:
    at = path.stat()
    return at.st_ino, at.st_size, at.st_mtime_ns

"""Check of the structure of a recorder's file, in place of SQLite's integrity check.

SQLite reads every page and looks up every row in the time index, one by one. This check does so for
batches of pages. It can only confirm that a file is sound. SQLite must check a file that this
check does not understand completely, because of a fault, another schema or a pointer map.
"""

import re
from collections.abc import Callable
from typing import Final

import numpy as np

from crosscue.replay.columns import BLOCK_BYTES, Int64s
from crosscue.replay.limits import Limits

from .page_file import (
    INDEX_LEAF,
    INTEGER_BYTES,
    TABLE_LEAF,
    Lot,
    PageFile,
    Soundness,
    UnusualError,
    integers,
    shifted,
)
from .pages import lot_rows
from .rows import FIRST_ROWID, LAST_ROWID
from .sqlite import FAULTS, Database
from .tables import fetched

_SCHEMA: Final = {
    "messages": (
        "CREATE TABLE messages ( id INTEGER PRIMARY KEY , topic_id INTEGER NOT NULL , "
        "timestamp INTEGER NOT NULL , data BLOB NOT NULL )"
    ),
    "timestamp_idx": "CREATE INDEX timestamp_idx ON messages ( timestamp ASC )",
}
# SQLite locks bytes of the page at this position, which contains no data.
_LOCK_BYTE: Final = 1 << 30
# The table's pages are kept if they are not larger.
_KEPT_BYTES: Final = 2 * BLOCK_BYTES
# More free blocks of a page, or pages of a row in the small tables, are left to SQLite.
_MAX_CHAIN: Final = 1000
_SIZE_BITS: Final = 17
# Multipliers of SplitMix64.
_MIX: Final = (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)


def soundness(database: Database, limits: Limits) -> Soundness | None:
    """Check the file except for the chains of pages of long rows; None if SQLite must check it.

    A statement must be open meanwhile, because its lock prevents a recorder from writing.
    """
    if database.plain is None:
        return None
    try:
        roots = _roots(database)
        with database.plain.open("rb", buffering=0) as file:
            return _Check(PageFile(file, limits)).run(roots)
    except (UnusualError, OSError, *FAULTS):
        return None


def _roots(database: Database) -> dict[str, int]:
    """Return the first pages of all tables and of the time index, with the schema's own.

    Raises:
        UnusualError: The schema is not a recorder's, or SQLite finds a fault in a small table.
    """
    roots = {"sqlite_master": 1}
    query = "SELECT type, name, tbl_name, rootpage, sql FROM sqlite_master"
    for kind, name, table, root, sql in fetched(database, query):
        text = " ".join(re.findall(r"\w+|[^\w \n]", str(sql)))
        is_usual = text.startswith(f"CREATE {str(kind).upper()} {name} ")
        is_usual &= table == ("messages" if kind == "index" else name) and name not in roots
        if not is_usual or text != _SCHEMA.get(name, text) or type(root) is not int:
            raise UnusualError
        roots[name] = root
    # SQLite ignores entries of the schema that contradict each other.
    indices = [row[1] for row in fetched(database, "PRAGMA index_list(messages)")]
    if "messages" not in roots or indices != [name for name in roots if name == "timestamp_idx"]:
        raise UnusualError
    for name in roots.keys() - _SCHEMA.keys():
        if fetched(database, f'PRAGMA integrity_check("{name}")') != [("ok",)]:
            raise UnusualError
    return roots


class _Check:
    """The check of one file; every method raises ``UnusualError`` at the first doubt."""

    def __init__(self, file: PageFile) -> None:
        self._file = file
        self._found = Soundness(np.zeros(file.count + 2, np.int64))
        self._kept = 0
        # Sum of hashes of the rows less that of the entries of the time index. Like a checksum, it
        # is zero by chance once in 2^64 times.
        self._balance = 0

    def run(self, roots: dict[str, int]) -> Soundness:
        words = np.frombuffer(self._file.head, ">u4")
        # Size in pages, the same change counter twice, and no pointer map.
        if words[7] != self._file.count or words[6] != words[23] or words[13] or words[16]:
            raise UnusualError
        self._use(np.arange(_LOCK_BYTE // self._file.size + 1, self._file.count + 1)[:1])
        self._free_pages(int(words[8]), int(words[9]))
        for name, root in roots.items():
            if name == "messages":
                self._tree(root, TABLE_LEAF, self._row_keys)
            elif name == "timestamp_idx":
                self._tree(root, INDEX_LEAF, self._entry_keys)
            else:
                self._small_table(root)
        if "timestamp_idx" in roots and self._balance % 2**64:
            raise UnusualError
        return self._found

    def _use(self, pages: Int64s) -> None:
        if len(pages) and (pages.min() < 1 or pages.max() > self._file.count):
            raise UnusualError
        self._found.use(pages)

    def _free_pages(self, trunk: int, left: int) -> None:
        """Follow the list of free pages."""
        while trunk:
            words = self._file.page(trunk).view(">u4").astype(np.int64)
            free = words[2 : 2 + words[1]]
            left -= 1 + len(free)
            if len(free) != words[1] or len(free) > self._file.usable // 4 - 2 or left < 0:
                raise UnusualError
            self._use(np.append(free, trunk))
            trunk = int(words[0])
        if left:
            raise UnusualError

    def _small_table(self, root: int) -> None:
        """Count the uses of pages by a table in which SQLite finds no fault."""
        for pages, kind in self._file.levels(root, TABLE_LEAF):
            self._use(pages)
            for lot in self._file.lots(pages, kind):
                lot.require_plain()
                words = shifted(lot.buffer, ">u4")
                for i in np.flatnonzero(lot.local < lot.total):
                    page = int(words[lot.start[i] + lot.local[i]])
                    for _ in range(_MAX_CHAIN):
                        self._use(np.array([page]))
                        page = int(self._file.page(page).view(">u4")[0])
                        if not page:
                            break
                    else:
                        raise UnusualError

    def _tree(
        self, root: int, leaf: int, keys: Callable[[Lot, bool], tuple[Int64s, Int64s]]
    ) -> None:
        """Check a tree by levels; cells are sorted by two keys, below those of the page above."""
        uppers = np.array([[LAST_ROWID], [LAST_ROWID]])
        for pages, kind in self._file.levels(root, leaf):
            self._use(pages)
            done, parts, last = 0, [], np.array([[FIRST_ROWID], [FIRST_ROWID]])
            for lot in self._file.lots(pages, kind):
                self._require_full(lot)
                upper = uppers[:, done : done + len(lot.base)]
                done += len(lot.base)
                key = np.stack(keys(lot, kind == leaf))
                key = np.insert(key, np.cumsum(lot.count), upper, axis=1)
                (a, b), (c, d) = np.concatenate((last, key[:, :-1]), axis=1), key
                if not ((a < c) | (a == c) & (b < d)).all():
                    raise UnusualError
                last = key[:, -1:]
                if kind != leaf:
                    parts.append(key)
            uppers = np.concatenate(parts, axis=1) if parts else uppers

    def _require_full(self, lot: Lot) -> None:
        """Require that cells and free blocks fill their part of each page, without overlaps."""
        lot.require_plain()
        usable, shorts, size = self._file.usable, shifted(lot.buffer, ">u2"), lot.stop - lot.at
        # Zero stands for 65,536.
        top = (shorts[lot.head + 5].astype(np.int64) - 1 & 0xFFFF) + 1
        filled = np.bincount(lot.page, size, len(top)) + top + lot.buffer[lot.head + 7]
        spans = [lot.at << _SIZE_BITS | size]
        live, place = np.arange(len(top)), shorts[lot.head + 1].astype(np.int64)
        for _ in range(_MAX_CHAIN):
            live, place = live[place > 0], place[place > 0]
            at = np.minimum(lot.base[live] + place, len(lot.buffer) - 4)
            after, size = shorts[at].astype(np.int64), shorts[at + 2].astype(np.int64)
            is_apart = (after == 0) | (after > place + size + 3)
            if not (is_apart & (place >= top[live]) & (size >= 4) & (place + size <= usable)).all():
                raise UnusualError
            filled[live] += size
            spans.append(at << _SIZE_BITS | size)
            place = after
            if not place.any():
                break
        else:
            raise UnusualError
        listed = lot.head + 8 + 4 * (lot.buffer[lot.head] < INDEX_LEAF) + 2 * lot.count
        is_filled = (
            lot.count.all() and (filled == usable).all() and (listed <= lot.base + top).all()
        )
        if not is_filled or (lot.at < (lot.base + top)[lot.page]).any():
            raise UnusualError
        # Recorders fill most pages from their ends.
        if len(live) or not ((lot.stop[1:] <= lot.at[:-1]) | np.diff(lot.page)).all():
            ordered = np.sort(np.concatenate(spans))
            start = ordered >> _SIZE_BITS
            if (np.diff(start) < (ordered & (1 << _SIZE_BITS) - 1)[:-1]).any():
                raise UnusualError

    def _row_keys(self, lot: Lot, is_leaf: bool) -> tuple[Int64s, Int64s]:
        if is_leaf:
            rows, is_plain = lot_rows(lot, None)
            if not is_plain:
                raise UnusualError
            self._weigh(rows.times, rows.ids, 1)
            self._found.rows += len(rows.ids)
            self._kept += len(lot.buffer)
            kept = [*self._found.lots, lot] if self._kept <= _KEPT_BYTES else []
            self._found.lots = kept
        # A row id in an interior page follows the same id in a leaf page.
        return lot.ids, np.full(len(lot.ids), int(not is_leaf))

    def _entry_keys(self, lot: Lot, _is_leaf: bool) -> tuple[Int64s, Int64s]:
        words, head = shifted(lot.buffer, ">i8"), lot.start
        time_type, id_type = lot.buffer[head + 1], lot.buffer[head + 2]
        time_bytes, id_bytes = INTEGER_BYTES[time_type], INTEGER_BYTES[id_type]
        is_plain = (lot.buffer[head] == 3) & (time_bytes >= 0) & (id_bytes >= 0)
        if not (is_plain & (3 + time_bytes + id_bytes == lot.total)).all():
            raise UnusualError
        times = integers(words, head + 3 + time_bytes, time_bytes, time_type)
        ids = integers(words, head + lot.total, id_bytes, id_type)
        self._weigh(times, ids, -1)
        return times, ids

    def _weigh(self, times: Int64s, ids: Int64s, sign: int) -> None:
        mixed = times.view(np.uint64) * np.uint64(_MIX[0]) + ids.view(np.uint64)
        for multiplier in _MIX[1:]:
            mixed = (mixed ^ mixed >> np.uint64(31)) * np.uint64(multiplier)
        self._balance += sign * int((mixed ^ mixed >> np.uint64(31)).sum())

"""What a ROS 2 SQLite bag says of itself: topics, definitions, row counts, its time index."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from crosscue.replay.base import Limits, LogFormatError, Topic

from .definitions import known_definition
from .sqlite import FAULTS, Database, explained

_TABLES: Final = {
    "messages": frozenset({"topic_id", "timestamp", "data"}),
    "topics": frozenset({"id", "name", "type"}),
}
_DEFINITIONS: Final = frozenset({"topic_type", "encoding", "encoded_message_definition"})


@dataclass(frozen=True, slots=True)
class Stored:
    """One line of the topics table."""

    number: int
    name: str
    type_name: str
    encoding: str


@dataclass(frozen=True, slots=True)
class Tables:
    """What the tables other than the messages hold.

    Attributes:
        stored: Lines of the topics table.
        topics: By name; the first line of a name decides its type.
        index: Quoted name of an index that begins with the timestamp, or None.
        notices: What is odd about them.
    """

    stored: tuple[Stored, ...]
    topics: dict[str, Topic]
    index: str | None
    notices: tuple[str, ...]

    def places(self) -> dict[int, int]:
        """From topic number to place among ``topics``; none for a second type under one name."""
        place = {name: i for i, name in enumerate(self.topics)}
        return {
            one.number: place[one.name]
            for one in self.stored
            if self.topics[one.name].type_name == one.type_name
        }

    def counts(self, database: Database) -> dict[str, int] | None:
        """Rows by topic name, "" for those of no topic; None if a damaged page hides some.

        SQLite goes through all rows for it, but not through their payloads.
        """
        query = "SELECT topic_id, COUNT(*) FROM messages NOT INDEXED GROUP BY topic_id"
        try:
            by_number = fetched(database, query)
        except FAULTS:
            return None
        names = {one.number: one.name for one in self.stored}
        counts = dict.fromkeys(self.topics, 0)
        for number, count in by_number:
            name = names.get(number, "")
            counts[name] = counts.get(name, 0) + int(count)
        return counts


def read_tables(database: Database, path: Path, limits: Limits) -> Tables:
    """Everything but the messages.

    Raises:
        LogFormatError: The tables of a ROS 2 bag are missing or damaged.
    """
    try:
        kinds = _kinds(database)
        _require(database, kinds, path)
        notices: list[str] = []
        stored = _stored(database, notices)
        # Not through the index, which a cut takes away first.
        is_empty = not fetched(database, "SELECT 1 FROM messages NOT INDEXED LIMIT 1")
        definitions = _definitions(database, kinds, limits)
        topics = _topics(stored, 0 if is_empty else None, definitions, notices)
        index = _time_index(database)
    except FAULTS as error:
        raise LogFormatError(f"{path}: {explained(error)}") from None
    return Tables(tuple(stored), topics, index, tuple(notices))


def fetched(database: Database, query: str, values: Sequence[int] = ()) -> list[Any]:
    """All rows of a query that has few."""
    return database.connection.execute(query, values).fetchall()


def _kinds(database: Database) -> dict[str, str]:
    """Kind of each table-like thing by name; a virtual table may run code of its own."""
    kinds: dict[str, str] = {}
    for name, kind, sql in fetched(database, "SELECT name, type, sql FROM sqlite_master"):
        if kind in ("table", "view"):
            is_virtual = str(sql).upper().lstrip().startswith("CREATE VIRTUAL")
            kinds[str(name)] = "virtual table" if is_virtual else str(kind)
    return kinds


def _columns(database: Database, table: str) -> frozenset[str]:
    return frozenset(str(row[1]) for row in fetched(database, f"PRAGMA table_info({table})"))


def _require(database: Database, kinds: dict[str, str], path: Path) -> None:
    for table, columns in _TABLES.items():
        if kinds.get(table) != "table" or not columns <= _columns(database, table):
            held = ", ".join(sorted(kinds)) or "nothing"
            raise LogFormatError(
                f"{path}: no ROS 2 bag: expected a table {table!r} with columns "
                f"{', '.join(sorted(columns))}; it holds {held}"
            )


def _stored(database: Database, notices: list[str]) -> list[Stored]:
    has_format = "serialization_format" in _columns(database, "topics")
    coding = "serialization_format" if has_format else "'cdr'"
    stored: list[Stored] = []
    query = f"SELECT id, name, type, {coding} FROM topics ORDER BY id"  # noqa: S608
    for number, name, type_name, encoding in fetched(database, query):
        if isinstance(number, int) and isinstance(name, str) and name:
            stored.append(Stored(number, name, str(type_name or ""), str(encoding or "cdr")))
        else:
            notices.append(f"the topics table has a line without a name: id {number!r:.40}")
    return stored


def _time_index(database: Database) -> str | None:
    for _, name, _, _, is_partial in fetched(database, "PRAGMA index_list(messages)"):
        quoted = '"' + str(name).replace('"', '""') + '"'
        columns = fetched(database, f"PRAGMA index_info({quoted})")
        if not is_partial and columns and columns[0][2] == "timestamp":
            return quoted
    return None


def _definitions(
    database: Database, kinds: dict[str, str], limits: Limits
) -> dict[str, tuple[str, bytes]]:
    """Coding and text of each type's definition, as far as the file has them."""
    if kinds.get("message_definitions") != "table":
        return {}
    if not _columns(database, "message_definitions") >= _DEFINITIONS:
        return {}
    query = (
        "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions "
        "WHERE length(encoded_message_definition) <= ?"
    )
    return {
        str(name): (str(coding), text.encode() if isinstance(text, str) else text)
        for name, coding, text in fetched(database, query, (limits.schema_bytes,))
        if isinstance(text, (str, bytes)) and text
    }


def _topics(
    stored: list[Stored],
    count: int | None,
    definitions: dict[str, tuple[str, bytes]],
    notices: list[str],
) -> dict[str, Topic]:
    topics: dict[str, Topic] = {}
    for one in stored:
        if one.name in topics:
            continue
        coding, text = definitions.get(one.type_name, ("", b""))
        if not text and (text := known_definition(one.type_name)):
            coding = "ros2msg"
            notices.append(
                f"{one.type_name} is not defined in the file; the ROS 2 Humble definition is used"
            )
        topics[one.name] = Topic(one.name, one.type_name, one.encoding, text, coding, count)
    return topics

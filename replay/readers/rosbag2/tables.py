"""Tables of a ROS 2 SQLite bag other than the messages: topics, definitions and time index."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

from crosscue.replay.columns import Topic
from crosscue.replay.errors import LogFormatError
from crosscue.replay.limits import Limits

from .sqlite import FAULTS, Database, explained

_TABLES: Final = {
    "messages": frozenset({"topic_id", "timestamp", "data"}),
    "topics": frozenset({"id", "name", "type"}),
}
_DEFINITIONS: Final = frozenset({"topic_type", "encoding", "encoded_message_definition"})


@dataclass(frozen=True, slots=True)
class StoredTopic:
    """One row of the topics table."""

    number: int
    name: str
    type_name: str
    encoding: str


@dataclass(frozen=True, slots=True)
class StorageTables:
    """Contents of the tables other than the messages.

    Attributes:
        stored: Rows of the topics table.
        topics: Topics by name; the first row of a name determines its type.
        index: Quoted name of an index that starts with the timestamp, or None.
        notices: Remarks on the tables, one sentence each.
    """

    stored: tuple[StoredTopic, ...]
    topics: dict[str, Topic]
    index: str | None
    notices: tuple[str, ...]

    def places(self) -> dict[int, int]:
        """Return indices in ``topics`` by topic number, without second types of a name."""
        place = {name: i for i, name in enumerate(self.topics)}
        return {
            one.number: place[one.name]
            for one in self.stored
            if self.topics[one.name].type_name == one.type_name
        }

    def counts(self, database: Database) -> dict[str, int] | None:
        """Count rows by topic name, with "" for rows without a topic; None on a damaged page.

        SQLite reads all rows for this, but not their payloads.
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


def read_storage_tables(database: Database, path: Path, limits: Limits) -> StorageTables:
    """Read all tables except the messages.

    Raises:
        LogFormatError: The tables of a ROS 2 bag are missing or damaged.
    """
    try:
        kinds = _kinds(database)
        _require(database, kinds, path)
        notices: list[str] = []
        stored = _stored(database, notices)
        # Without the index, which is the first part that a truncated file lacks.
        is_empty = not fetched(database, "SELECT 1 FROM messages NOT INDEXED LIMIT 1")
        definitions = _definitions(database, kinds, limits)
        topics = _topics(stored, 0 if is_empty else None, definitions, notices)
        index = _time_index(database)
    except FAULTS as error:
        raise LogFormatError(f"{path}: {explained(error)}") from None
    return StorageTables(tuple(stored), topics, index, tuple(notices))


def fetched(database: Database, query: str, values: Sequence[int] = ()) -> list[Any]:
    """Return all rows of a query with few rows."""
    return database.connection.execute(query, values).fetchall()


def _kinds(database: Database) -> dict[str, str]:
    """Return the kinds of tables and views by name, because a virtual table may run code."""
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
                f"{path}: not a ROS 2 bag: expected a table {table!r} with columns "
                f"{', '.join(sorted(columns))}; it holds {held}"
            )


def _stored(database: Database, notices: list[str]) -> list[StoredTopic]:
    has_format = "serialization_format" in _columns(database, "topics")
    coding = "serialization_format" if has_format else "'cdr'"
    stored: list[StoredTopic] = []
    query = f"SELECT id, name, type, {coding} FROM topics ORDER BY id"  # noqa: S608
    for number, name, type_name, encoding in fetched(database, query):
        if isinstance(number, int) and isinstance(name, str) and name:
            stored.append(StoredTopic(number, name, str(type_name or ""), str(encoding or "cdr")))
        else:
            notices.append(f"the topics table has a row without a name: id {number!r:.40}")
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
    """Return the encoding and text of each type's definition, where available."""
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
    stored: list[StoredTopic],
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


@cache
def known_definition(type_name: str) -> bytes:
    """Return the ROS 2 Humble definition of ``type_name`` and of the types it uses, or empty."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    if type_name not in store.fielddefs:
        return b""
    text, _ = store.generate_msgdef(type_name, ros_version=2)
    return text.encode()

"""The one printer of results: text, JSON and the view in a notebook, from a record's fields."""

from __future__ import annotations

import html
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from operator import attrgetter
from pathlib import PurePath
from typing import (
    Any,
    ClassVar,
    Final,
    Literal,
    Protocol,
    Self,
    TypeVar,
    overload,
    runtime_checkable,
)

from crosscue.replay.safe_text import table, terminal_width, visible

T = TypeVar("T")
# Metadata of a field that is not in the JSON form.
HIDDEN: Final = {"json": ""}


def json_key(name: str) -> dict[str, str]:
    """Return metadata for a field whose key in JSON is not its name."""
    return {"json": name}


@runtime_checkable
class HasJson(Protocol):
    """A record of a run's files, which has its own form in JSON."""

    def as_json(self) -> object:
        """Return dictionaries, lists and scalars."""
        ...


@runtime_checkable
class HasDump(Protocol):
    """A record of pydantic."""

    def model_dump(self, *, mode: Literal["json"]) -> Any:
        """Return dictionaries, lists and scalars."""
        ...


class Result:
    """Base of what verbs return. Subclasses are frozen dataclasses with ``repr=False``.

    JSON has one key for each field, and those of ``also``. Text is one line for each of them,
    unless ``lines`` says otherwise. A verb may emit parts of its result before it ends, see
    ``crosscue.replay.progress``; the command prints them at once.

    Attributes:
        also: Paths of attributes that are in JSON besides the fields, by key.
        formats: Methods that return another text, by name of the option, with its help.
        json_is: Path of the attribute that is the JSON; empty for the fields.
        is_printed_in_parts: True if the command prints only the parts, unless as JSON.
        max_lines: Number of lines that the command prints without ``--verbose``; 0 for all.
    """

    __slots__ = ()
    also: ClassVar[Mapping[str, str]] = {}
    formats: ClassVar[Mapping[str, str]] = {}
    json_is: ClassVar[str] = ""
    is_printed_in_parts: ClassVar[bool] = False
    max_lines: ClassVar[int] = 0

    @property
    def exit_status(self) -> int:
        """Exit status of the command: 0, 1 for a failed gate, 3 for reported losses.

        A result that may have losses says so in ``is_whole``.
        """
        return 0 if getattr(self, "is_whole", True) else 3

    @property
    def reported(self) -> Result:
        """The result that the command prints."""
        return self

    def as_dict(self) -> Any:
        """Return the JSON output of the command, as dictionaries, lists and scalars."""
        return plain(attrgetter(self.json_is)(self) if self.json_is else _entries(self))

    def lines(self) -> Iterator[str]:
        """Yield the text output of the command; a piece of text may have several lines."""
        entries = {name: value for name, value in _entries(self).items() if value is not None}
        width = max(map(len, entries), default=0)
        for name, value in entries.items():
            yield f"{name.replace('_', ' '):{width}}  {visible(_in_words(value))}"

    def messages(self) -> Iterator[str]:
        """Yield lines that the command prints on stderr after the text."""
        return iter(())

    def closing(self) -> Iterator[str]:
        """Yield the last lines, which are always printed, such as files to open."""
        return iter(())

    def brief(self) -> str:
        """Return the text of the command without ``--verbose``: at most ``max_lines`` lines."""
        lines, last = printed(self.lines()), printed(self.closing())
        kept = self.max_lines - len(last) - 1
        if 0 < kept < len(lines) - 1:
            lines[kept:] = [f"... and {len(lines) - kept} lines more: add -v"]
        return "\n".join([*lines, *last])

    def __repr__(self) -> str:
        return "\n".join([*printed(self.lines()), *printed(self.closing())])

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(repr(self))}</pre>"


def printed(texts: Iterator[str]) -> list[str]:
    """Return the lines of texts, with control characters escaped."""
    return [visible(line) for text in texts for line in text.split("\n")]


class Listing(Result, Sequence[T]):
    """Sequence of records; its text is a table.

    Attributes:
        head: Names of the columns.
        root: Key in JSON of the list of records; empty for a list without a key.
    """

    head: ClassVar[tuple[str, ...]]
    root: ClassVar[str] = ""

    def __init__(self, rows: Sequence[T]) -> None:
        """Store the records."""
        self._rows = tuple(rows)

    @abstractmethod
    def cells(self, row: T) -> tuple[object, ...]:
        """Return the cells of a record, in the order of ``head``."""

    @overload
    def __getitem__(self, which: int) -> T: ...
    @overload
    def __getitem__(self, which: slice) -> Self: ...
    def __getitem__(self, which: int | slice) -> T | Self:
        return self._rows[which] if isinstance(which, int) else type(self)(self._rows[which])

    def __len__(self) -> int:
        return len(self._rows)

    def as_dict(self) -> Any:
        """Return one dictionary for each record."""
        rows = [plain(row) for row in self]
        return {self.root: rows} if self.root else rows

    def lines(self) -> Iterator[str]:
        """Yield the lines of a table."""
        yield from listing(
            self.head, [self.cells(row) for row in self], len(self.head)
        ).splitlines()

    def _repr_html_(self) -> str:
        rows = [[_cell(cell) for cell in self.cells(row)] for row in self]
        body = "".join(f"<tr>{_html_cells('td', row)}</tr>" for row in rows)
        return f"<table><tr>{_html_cells('th', self.head)}</tr>{body}</table>"


def plain(value: object) -> Any:
    """Return records as dictionaries, lists and scalars; control characters are escaped."""
    if isinstance(value, Result) and not isinstance(value, dict):
        return value.as_dict()
    if isinstance(value, HasJson):
        return value.as_json()
    if isinstance(value, HasDump):
        return plain(value.model_dump(mode="json"))
    if is_dataclass(value) and not isinstance(value, type):
        return plain(_entries(value))
    if isinstance(value, Enum):
        return plain(value.value)
    if isinstance(value, Mapping):
        return {visible(str(key)): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    if isinstance(value, str | PurePath | BaseException):
        return visible(str(value))
    # An array or a number of NumPy.
    return value.tolist() if hasattr(value, "tolist") else value


def listing(head: Sequence[str], rows: Sequence[Sequence[object]], text_columns: int = 1) -> str:
    """Return the text of a table, with a dash for unknown values.

    Args:
        head: Column names.
        rows: Cells; None where unknown.
        text_columns: Number of leading columns that contain text instead of numbers.
    """
    cells = [[_cell(cell) for cell in row] for row in rows]
    return "\n".join(table(head, cells, terminal_width(), range(text_columns)))


def _entries(record: Any) -> dict[str, object]:
    """Return the values of fields and properties by their key in JSON."""
    named = {one.metadata.get("json", one.name): one.name for one in fields(record)}
    named |= getattr(record, "also", {})
    return {key: attrgetter(name)(record) for key, name in named.items() if key}


def _cell(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.4g}"
    is_count = isinstance(value, int) and not isinstance(value, bool)
    return f"{value:,}" if is_count else str(value)


def _in_words(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_in_words(item)}" for key, item in value.items()) or "none"
    if isinstance(value, list | tuple):
        return ", ".join(map(_in_words, value)) or "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return _cell(value)


def _html_cells(tag: str, cells: Sequence[str]) -> str:
    return "".join(f"<{tag}>{html.escape(visible(cell))}</{tag}>" for cell in cells)

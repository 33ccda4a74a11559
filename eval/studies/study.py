"""What all studies share: a grid of cases, a function that computes one, metrics, and a page.

A study claims its folder, so that results of other settings are not mixed, and computes the missing
cases; each study says how. From all cases it makes tables. They are printed, and written to a page
with its pictures and to a JSON file with its settings and results.
"""

from __future__ import annotations

import base64
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Final, TypeVar

from crosscue.eval.report.html import write_page
from crosscue.replay.errors import RunError
from crosscue.replay.files import door
from crosscue.replay.files.tree_text import json_tree, strict_json
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.safe_text import table
from crosscue.results import Result

T = TypeVar("T")
PAGE: Final = "study.html"


@dataclass(frozen=True, slots=True)
class PageTable:
    """A table of text.

    Attributes:
        heading: Heading above the table.
        head: Column names.
        rows: Rows with one entry per column.
    """

    heading: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    @classmethod
    def of(
        cls, heading: str, rows: Iterable[T], *columns: tuple[str, Callable[[T], str]]
    ) -> PageTable:
        """Return the table of records, with the name and the text of each column."""
        texts = tuple(tuple(text(row) for _, text in columns) for row in rows)
        return cls(heading, tuple(name for name, _ in columns), texts)

    def as_text(self) -> str:
        """Return the table as text with aligned columns, of any width."""
        return "\n".join([self.heading, *table(self.head, self.rows, sys.maxsize, (0,))])


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class StudyResult(Result):
    """A finished study; its repr is tables, with the published numbers where there are some.

    Attributes:
        folder: Its folder.
        tables: Results as text.
        notes: Notes on the results.
    """

    folder: Path
    tables: Sequence[PageTable]
    notes: Sequence[str]

    json_is: ClassVar = "content"
    # Files of the folder that are named last, with what they are; the first has all results.
    files: ClassVar[Mapping[str, str]] = {"study.json": "tables"}

    @property
    def page(self) -> Path:
        """The page with tables and figures."""
        return self.folder / PAGE

    @property
    def content(self) -> Any:
        """Content of the file of all results."""
        return json_tree(door.read(self.folder / next(iter(self.files))))

    def lines(self) -> Iterator[str]:
        """Yield the tables, the notes, and the paths of the page and of other files."""
        yield "\n\n".join(one.as_text() for one in self.tables)
        yield from ("", *self.notes, "", f"page       {self.page}")
        yield from (f"{what:10} {self.folder / name}" for name, what in self.files.items())


@dataclass(frozen=True, slots=True)
class Written:
    """Content of a study's files.

    Attributes:
        title: Title of the page.
        notes: Notes on the results, on the page.
        tables: Tables of the page.
        pictures: Pictures of the page.
        content: Settings and results, for the JSON file.
    """

    title: str
    notes: Sequence[str]
    tables: Sequence[PageTable]
    content: Mapping[str, Any]
    pictures: Sequence[Path] = field(default=())

    def write(self, folder: Path, name: str) -> None:
        """Write the page, which needs no network and runs no script, and the JSON file.

        Raises:
            OutputError: A file cannot be written.
        """
        drawn = [(one.stem, base64.b64encode(door.read(one)).decode()) for one in self.pictures]
        page = {"title": self.title, "notes": self.notes, "tables": self.tables, "pictures": drawn}
        write_page(folder / PAGE, "study.html.j2", page)
        write_text(folder / name, strict_json(self.content) + "\n")


def claim(path: Path, settings: object, key: str | None = None, *, overwrite: bool) -> None:
    """Refuse the folder of a study with other settings, and make the folder.

    Args:
        path: File in which a study stores its settings.
        settings: Settings of this study, as in the file.
        key: Key of the settings in the file; None if it has nothing else.
        overwrite: True to replace the other study.

    Raises:
        RunError: The file has other settings.
    """
    if path.exists() and not overwrite:
        try:
            before = json_tree(door.read(path))
            before = before if key is None else before[key]
        except (OSError, ValueError, KeyError, TypeError):
            before = None
        if before != settings:
            raise RunError(
                f"{path.parent}: contains a study with other settings; use another folder or "
                "--overwrite"
            )
    path.parent.mkdir(parents=True, exist_ok=True)


def without_nan(tree: Any) -> Any:
    """Return results for JSON, with None in place of NaN."""
    if isinstance(tree, Mapping):
        return {str(key): without_nan(value) for key, value in tree.items()}
    return None if isinstance(tree, float) and math.isnan(tree) else tree

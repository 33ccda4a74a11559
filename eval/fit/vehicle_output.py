"""What fits share: a result with charts and a section of the vehicle file, and writing them.

A fit reads its inputs, fits, and returns a ``Fitted``. It is printed as a report and the section,
or the section is written: to a file of its own, or into a copy of a vehicle file. ``--page`` writes
all of it as a page.
"""

import json
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Final

import tomlkit

from crosscue.eval.report.chart import Chart
from crosscue.eval.report.html import write_page
from crosscue.replay.errors import OutputError, UsageError
from crosscue.replay.files.tree_text import toml_document
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.vehicle.vehicle import Vehicle, parse
from crosscue.results import HIDDEN, Result, printed

# Vehicle file with only default values.
DEFAULTS: Final = "version = 1\n"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Fitted(Result):
    """Result of a fit.

    Attributes:
        path: File that the fit was written to; None without one.
        belongs_in: File that its section belongs in.
    """

    path: Path | None = field(default=None, kw_only=True, metadata=HIDDEN)
    belongs_in: ClassVar[str] = "vehicle file"

    @property
    @abstractmethod
    def toml(self) -> str:
        """The section with the fit; empty if nothing was fitted."""

    @abstractmethod
    def report(self) -> Iterator[str]:
        """Yield what was fitted, and how well."""

    @abstractmethod
    def charts(self) -> Iterator[Chart]:
        """Yield charts of what was fitted to, what was held out, and the fit."""

    def lines(self) -> Iterator[str]:
        """Yield the report, and the section unless it was written."""
        yield from self.report()
        if self.path is not None:
            yield f"written to {self.path}"
        elif self.toml:
            yield from ("", self.toml)

    def write_page(self, path: Path | str, losses: Sequence[str] = ()) -> None:
        """Write the report, the charts and the section as one HTML page, replacing a file.

        Args:
            path: The page.
            losses: What was dropped when the inputs were read.

        Raises:
            OutputError: The page cannot be written.
        """
        content = {
            "title": (type(self).__doc__ or "").partition(".\n")[0],
            "report": "\n".join(printed(self.report())),
            "charts": [one for one in self.charts() if not one.is_empty],
            "section": self.toml,
            "belongs_in": self.belongs_in,
            "losses": losses,
            "is_whole": getattr(self, "is_whole", True),
        }
        write_page(Path(path), "fit.html.j2", content)


def new_file(output: Path | str | None, *, overwrite: bool) -> Path | None:
    """Return the path of an output, after checking that it may be written.

    Raises:
        OutputError: It exists.
    """
    path = None if output is None else Path(output)
    if path is not None and path.exists() and not overwrite:
        raise OutputError(f"{path}: exists; give another name or --overwrite")
    return path


def section_text(
    name: str, values: Mapping[str, Any], comments: Mapping[str, Sequence[str]] | None = None
) -> str:
    """Return a section as TOML, with four digits; a list of tables has one inline table a line.

    Args:
        name: Name of the section.
        values: Scalars, lists, tables, and lists of tables.
        comments: Comments on the entries of a table or of a list of tables, by its key.
    """
    lines, tables = [f"[{name}]"], list[str]()
    for key, value in values.items():
        notes = [f"  # {note}" for note in (comments or {}).get(key, ())]
        if isinstance(value, Mapping):
            entries = [f"{_key(one)} = {_inline(item)}" for one, item in value.items()]
            notes = notes or [""] * len(entries)
            tables += ["", f"[{name}.{key}]"]
            tables += [a + b for a, b in zip(entries, notes, strict=True)]
        elif isinstance(value, list | tuple) and value and isinstance(value[0], Mapping):
            notes = notes or [""] * len(value)
            rows = [f"  {_inline(one)},{note}" for one, note in zip(value, notes, strict=True)]
            lines += [f"{key} = [", *rows, "]"]
        elif value is not None:
            lines.append(f"{key} = {_inline(value)}")
    return "\n".join([*lines, *tables]) + "\n"


def _key(name: str) -> str:
    return name if name.replace("_", "").isalnum() else json.dumps(name)


def _inline(value: Any) -> str:
    if isinstance(value, Mapping):
        known = {key: item for key, item in value.items() if item not in (None, ())}
        return f"{{ {', '.join(f'{key} = {_inline(item)}' for key, item in known.items())} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_inline, value))}]"
    return str(float(f"{value:.4g}")) if isinstance(value, float) else json.dumps(value)


def with_section(text: str, name: str, values: Mapping[str, object]) -> str:
    """Return a vehicle file's text with values of a section replaced and comments kept."""
    document = toml_document(text)
    document.setdefault(name, tomlkit.table()).update(values)
    return tomlkit.dumps(document)


def check_output(
    vehicle: Vehicle | Path | str | None, output: Path | str | None, *, overwrite: bool
) -> None:
    """Check, before any work, that the output can be written.

    Raises:
        UsageError: The vehicle settings are not a file, so there is no text to insert the fit into.
        OutputError: The output is another existing file.
    """
    if output is None:
        return
    if isinstance(vehicle, Vehicle):
        raise UsageError(
            "output: expected a vehicle file to insert the fit into, found settings; pass its path"
        )
    path = Path(output)
    is_itself = vehicle is not None and path.exists() and path.samefile(vehicle)
    new_file(path, overwrite=overwrite or is_itself)


def write_fit(
    vehicle: Vehicle | Path | str | None, output: Path | str | None, with_fit: Callable[[str], str]
) -> Path | None:
    """Write the vehicle file with the fit to ``output``, unless it is None; return its path.

    Without a vehicle file, the fit is inserted into a new file with default values. Call
    ``check_output`` first.
    """
    if output is None:
        return None
    assert not isinstance(vehicle, Vehicle)
    given = DEFAULTS if vehicle is None else Path(vehicle).read_text(encoding="utf-8")
    text = with_fit(given)
    parse(text, str(vehicle))
    write_text(Path(output), text)
    return Path(output)

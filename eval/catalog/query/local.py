"""Runs below a local folder, and the stamps that show changes."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from crosscue.eval.runs.folder import FAILURE, INPUT, MANIFEST, MAX_MANIFEST_BYTES, TAGS, TIMINGS
from crosscue.replay.errors import UnreadableRunError
from crosscue.replay.files import door
from crosscue.replay.files.tree_text import spelled, unspelled

if TYPE_CHECKING:
    import pyarrow.fs

# Max depth of runs below the searched folder, local or on a store.
DEPTH: Final = 6
SCORED: Final = "metrics.json"
SCORE: Final = "score"
# Files of a run that are not tables.
BESIDE: Final = (TAGS, FAILURE, TIMINGS)

Stamp: TypeAlias = tuple[int, int, int, int]
CUT_SHORT: Final[Stamp] = (0, 0, 0, 0)


class FoundRun(NamedTuple):
    """A run folder.

    Attributes:
        run: Spelling of its path in the searched folder; ``.`` for that folder itself.
        stamp: Value that changes with the content of the run; ``CUT_SHORT`` without a manifest.
        made_ns: Time since 1970 when the manifest was written or the attempt failed.
        file: The file that records the outcome: the manifest, or the log of a failed run.
    """

    run: str
    stamp: Stamp
    made_ns: int
    file: str = MANIFEST


class LocalRuns:
    """The runs below a folder."""

    def __init__(self, folder: Path) -> None:
        """Use a folder, without accessing it yet."""
        self.folder: Final = folder

    @property
    def name(self) -> str:
        """Name used in messages."""
        return str(self.folder)

    @property
    def home(self) -> Path | None:
        """The folder, if an index can be written to it; None if it is read-only."""
        return self.folder if os.access(self.folder, os.W_OK) else None

    def find(self) -> Iterator[FoundRun]:
        """Yield every run folder, complete or interrupted; only the folder itself if it is a run.

        Raises:
            UnreadableRunError: A folder cannot be listed.
        """
        itself = _found(str(self.folder), ".")
        if itself is not None:
            yield itself
        else:
            yield from _below(str(self.folder), "", DEPTH)

    def files(self, run: str) -> list[str]:
        """Return the names of a run's tables, then of those of its score, and what is beside them.

        Raises:
            OSError: The folder cannot be listed, or a file is not a regular one.
        """
        folder = self.path(run)
        tables = _tables(folder, BESIDE)
        if (folder / SCORE).is_dir():
            tables += [f"{SCORE}/{name}" for name in _tables(door.inside(folder, SCORE))]
        return tables

    def read(self, run: str, file: str) -> bytes:
        """Return the content of one of a run's files.

        Raises:
            OSError: The file cannot be read.
        """
        place = door.inside(self.path(run), file)
        return door.read(place, door.SMALL_BYTES if file in BESIDE else MAX_MANIFEST_BYTES)

    def place(self, run: str, file: str) -> str:
        """Return the path of a file in ``filesystem``."""
        return str(self.path(run) / file)

    def path(self, run: str) -> Path:
        """Return the folder of a run."""
        return self.folder / unspelled(run)

    @property
    def filesystem(self) -> pyarrow.fs.FileSystem:
        """Arrow's local file system."""
        import pyarrow.fs

        return pyarrow.fs.LocalFileSystem()


def _tables(folder: Path, also: Sequence[str] = ()) -> list[str]:
    """Return the names of a folder's tables, examined because Arrow opens them by name."""
    names = []
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.endswith(".parquet") or entry.name in also:
                if not entry.is_file(follow_symlinks=False):
                    os.close(door.opened(Path(entry.path)))
                names.append(entry.name)
    return sorted(names)


def _below(folder: str, prefix: str, depth: int) -> Iterator[FoundRun]:
    try:
        with os.scandir(folder) as listed:
            entries = [entry for entry in listed if not entry.name.startswith(".")]
    except OSError as error:
        raise UnreadableRunError(f"{folder}: {error.strerror}; check its owner and mode") from None
    names = {entry.name for entry in entries}
    if prefix and FAILURE in names:
        made_ns = _time(f"{folder}/{FAILURE}")
        yield FoundRun(prefix[:-1], (made_ns, 0, _time(folder), 0), made_ns, FAILURE)
    elif prefix and is_cut_short(names):
        yield FoundRun(prefix[:-1], CUT_SHORT, 0)
        return
    if not depth:
        return
    for entry in sorted(entries, key=lambda entry: entry.name):
        if not entry.is_dir():
            continue
        name = prefix + spelled(entry.name)
        found = _found(entry.path, name)
        if found is not None:
            yield found
        elif not entry.is_symlink():
            yield from _below(entry.path, f"{name}/", depth - 1)


def _found(folder: str, run: str) -> FoundRun | None:
    try:
        manifest = os.stat(f"{folder}/{MANIFEST}")  # noqa: PTH116 (there may be 100,000)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise UnreadableRunError(f"{folder}: {error.strerror}; check its owner and mode") from None
    made_ns = manifest.st_mtime_ns
    # Replacing a file changes the modification time of its folder.
    stamp = (made_ns, manifest.st_size, _time(folder), _time(f"{folder}/{SCORE}"))
    return FoundRun(run, stamp, made_ns)


def _time(path: str) -> int:
    try:
        return os.stat(path).st_mtime_ns  # noqa: PTH116
    except OSError:
        return 0


def is_cut_short(names: set[str]) -> bool:
    """Return whether files are those of a run that has not written its manifest.

    A folder of pooled scores has tables, too, but is not a run.
    """
    has_tables = any(name.endswith(".parquet") for name in names)
    return INPUT in names or (has_tables and SCORED not in names)

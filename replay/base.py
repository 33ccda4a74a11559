"""What every module may ask of a log, and the names that nearly every module imports.

What every open recording can do, whatever its format, is written here (``opening.open_log`` opens
one). With it comes the ground that all of crosscue stands on, so that one line imports it: what a
log gives (``columns``), the account of it (``ledger``), how much it may cost (``limits``), what is
raised (``errors``), and files read and written with care. Whoever stands above imports these names
from here; the modules that define them import nothing but each other.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Final, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from .columns import (
    BLOCK_BYTES,
    BLOCK_ROWS,
    DATA,
    ERROR,
    LENGTH_UNKNOWN,
    REMOTE,
    Block,
    Bytes,
    CanFrames,
    Floats,
    ImageCoding,
    Images,
    Int64s,
    Messages,
    Rows,
    Table,
    Topic,
)
from .errors import (
    AccountError,
    AnnotationError,
    CanDatabaseError,
    CrosscueError,
    EmptyResultError,
    LogError,
    LogFormatError,
    LogTooLargeError,
    LossWarning,
    MissingTopicError,
    OutputError,
    RunError,
    SchemaError,
    StudyFileError,
    UnknownFormatError,
    UnreadableRunError,
    UsageError,
    VehicleError,
    WorkerError,
    one_line,
)
from .files.bounded import PIECE_BYTES, read_at_most
from .files.closing import Closing
from .files.tree_text import MAX_DEPTH, json_tree, strict_json, toml_tree
from .files.whole_file import (
    cannot_write,
    file_sha256,
    sha256_of,
    write_bytes,
    write_text,
    write_whole,
)
from .ledger import (
    CHANGED,
    DETAILS_KEPT,
    DIFFERS,
    NOT_ASKED_TIME,
    NOT_ASKED_TOPIC,
    Detail,
    Ledger,
    TopicAccount,
    warn_of,
)
from .limits import DEFAULT_LIMITS, MIB, Limits
from .losses import losses_heard, warn_again, with_losses
from .safe_text import visible
from .versions import installed, versions, versions_and_commit

__all__ = [
    "BLOCK_BYTES",
    "BLOCK_ROWS",
    "CHANGED",
    "DATA",
    "DEFAULT_LIMITS",
    "DETAILS_KEPT",
    "DIFFERS",
    "ERROR",
    "EVERYTHING",
    "LENGTH_UNKNOWN",
    "MAX_DEPTH",
    "MIB",
    "NOT_ASKED_TIME",
    "NOT_ASKED_TOPIC",
    "PIECE_BYTES",
    "REMOTE",
    "AccountError",
    "AnnotationError",
    "Block",
    "Bytes",
    "CanDatabaseError",
    "CanFrames",
    "Closing",
    "CrosscueError",
    "Detail",
    "EmptyResultError",
    "Floats",
    "ImageCoding",
    "Images",
    "Int64s",
    "KnowsItsEnd",
    "Ledger",
    "Limits",
    "Log",
    "LogError",
    "LogFormatError",
    "LogTooLargeError",
    "LossWarning",
    "Messages",
    "MissingTopicError",
    "OutputError",
    "Readable",
    "Rows",
    "RunError",
    "SchemaError",
    "Selection",
    "StudyFileError",
    "Table",
    "Topic",
    "TopicAccount",
    "UnknownFormatError",
    "UnreadableRunError",
    "UsageError",
    "VehicleError",
    "WorkerError",
    "cannot_write",
    "file_sha256",
    "installed",
    "is_remote",
    "json_tree",
    "losses_heard",
    "name_of",
    "one_line",
    "origin",
    "read_at_most",
    "report_missing",
    "sha256_of",
    "strict_json",
    "toml_tree",
    "versions",
    "versions_and_commit",
    "visible",
    "warn_again",
    "warn_of",
    "with_losses",
    "write_bytes",
    "write_text",
    "write_whole",
]


@dataclass(frozen=True, slots=True)
class Selection:
    """What of a log is wanted.

    Attributes:
        topics: Names, or None for all.
        start_ns: First log time wanted, or None.
        end_ns: First log time no longer wanted (half open), or None.
    """

    topics: frozenset[str] | None = None
    start_ns: int | None = None
    end_ns: int | None = None

    def wants(self, topic: str) -> bool:
        """Is ``topic`` wanted?"""
        return self.topics is None or topic in self.topics

    def inside(self, t_ns: Int64s) -> NDArray[np.bool_]:
        """Which of these times are wanted, shape (N,)."""
        keep = np.ones(len(t_ns), dtype=np.bool_)
        if self.start_ns is not None:
            keep &= t_ns >= self.start_ns
        if self.end_ns is not None:
            keep &= t_ns < self.end_ns
        return keep


EVERYTHING: Final = Selection()
_URL: Final = re.compile(r"^[a-z][a-z0-9+.-]+://")


class Readable(Protocol):
    """A source of blocks: a log, or one that is read on another time."""

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """As ``Log.read``."""
        ...


class Log(Protocol):
    """An open recording. Use it as a context manager."""

    @property
    def path(self) -> Path:
        """Where it is."""
        ...

    @property
    def format(self) -> str:
        """Short name of the format, as in ``FORMATS``."""
        ...

    @property
    def topics(self) -> tuple[Topic, ...]:
        """What it holds, known without reading the body wherever the format allows.

        A topic may come to light only while reading (a cut file without a summary): readers then
        put it into the ledger and into the tuple returned by a later call.
        """
        ...

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """The log's rows in stored order, a block at a time, accounting as it goes.

        Every row met is ``ledger.find``-ed; rows read but outside ``selection`` are skipped with
        the reasons ``NOT_ASKED_TIME`` and ``NOT_ASKED_TOPIC``; an index may be used to avoid
        reading them, and the declared counts then say how many were skipped. Once exhausted,
        declared counts have been settled and ``ledger.integrity`` is set. Damage never raises here
        after the log was opened: what is readable is given, the rest is ``ledger.lose``-d. A row
        whose bytes are known to be damaged is never given; where a checksum only says that one of
        many rows is damaged, all that are structurally sound are given and the log is not whole.
        (A seal knows of damage by the MiB, not by the row, see ``sealed_log``.)
        """
        ...

    def close(self) -> None:
        """Release files."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...


@runtime_checkable
class HasUrl(Protocol):
    """A log that was opened by a URL; asking for its path may fetch all of it."""

    @property
    def url(self) -> str:
        """As it was given."""
        ...


def origin(log: Log) -> Path | str:
    """Where a log comes from: a path or a URL."""
    return log.url if isinstance(log, HasUrl) else log.path


def is_remote(path: Path | str) -> bool:
    """Is it a URL? A ``Path`` never is: it would have lost one of the slashes."""
    return isinstance(path, str) and _URL.match(path) is not None


def name_of(log: Log) -> str:
    """What a log is called in accounts: its URL, else its path."""
    return str(origin(log))


@runtime_checkable
class KnowsItsEnd(Protocol):
    """A log that can tell without reading its body that something is missing."""

    def report_missing(self, ledger: Ledger) -> None:
        """Drop what its opening, or a look at its end, shows to be missing.

        Reading the log reports it as well, with more detail; only one of both is asked for.
        """
        ...


def report_missing(log: Log, ledger: Ledger) -> None:
    """As ``KnowsItsEnd.report_missing``, of a log that knows; else nothing."""
    if isinstance(log, KnowsItsEnd):
        log.report_missing(ledger)

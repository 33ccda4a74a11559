"""The interface of an open log, and what is selected of it.

``Log`` is the interface of an open recording of any format (``opening.open_log`` opens one).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Final, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from .columns import Block, Int64s, Topic
from .files.closing import Closing
from .ledger import NOT_ASKED_TIME, NOT_ASKED_TOPIC, Ledger


@dataclass(frozen=True, slots=True)
class Selection:
    """The topics and the time range to read from a log.

    Attributes:
        topics: Names of the selected topics, or None for all.
        start_ns: First selected log time, or None for no lower bound.
        end_ns: End of the selected log times, exclusive, or None for no upper bound.
    """

    topics: frozenset[str] | None = None
    start_ns: int | None = None
    end_ns: int | None = None

    def wants(self, topic: str) -> bool:
        """Return whether ``topic`` is selected."""
        return self.topics is None or topic in self.topics

    def inside(self, t_ns: NDArray[np.integer]) -> NDArray[np.bool_]:
        """Return a mask of the times inside the range, shape (N,)."""
        return self.overlaps(t_ns, t_ns)

    def overlaps(
        self, first_ns: NDArray[np.integer], last_ns: NDArray[np.integer]
    ) -> NDArray[np.bool_]:
        """Return a mask of the stretches with a time inside the range, shape (N,)."""
        keep = np.ones(len(first_ns), dtype=np.bool_)
        if self.start_ns is not None:
            keep &= last_ns >= self.start_ns
        if self.end_ns is not None:
            keep &= first_ns < self.end_ns
        return keep

    @property
    def is_timed(self) -> bool:
        """True if the time range has a bound."""
        return self.start_ns is not None or self.end_ns is not None

    def account(self, topic: str, t_ns: Int64s, ledger: Ledger) -> NDArray[np.bool_] | None:
        """Count rows found in a log, and return a mask of the selected ones; None for all."""
        ledger.find(topic, len(t_ns))
        if not self.wants(topic):
            ledger.skip(topic, NOT_ASKED_TOPIC, len(t_ns))
            return np.zeros(len(t_ns), np.bool_)
        if not self.is_timed:
            return None
        keep = self.inside(t_ns)
        ledger.skip(topic, NOT_ASKED_TIME, len(t_ns) - int(np.count_nonzero(keep)))
        return keep

    def leave(self, topic: str, count: int, ledger: Ledger) -> None:
        """Count rows that are not read, because none of them is selected."""
        ledger.find(topic, count)
        ledger.skip(topic, NOT_ASKED_TIME if self.wants(topic) else NOT_ASKED_TOPIC, count)


EVERYTHING: Final = Selection()


class Readable(Protocol):
    """A source of blocks: a log, or a log whose times are mapped to another clock."""

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Read the rows, as ``Log.read`` does."""


class Log(Protocol):
    """An open recording. Use it as a context manager."""

    @property
    def path(self) -> Path:
        """Path of the file or folder."""

    @property
    def format(self) -> str:
        """Short name of the format, a key of ``FORMATS``."""

    @property
    def topics(self) -> tuple[Topic, ...]:
        """Topics of the log, listed without reading the body wherever the format allows.

        Some topics are discovered only while reading (a truncated file without a summary). The
        reader then adds them to the ledger, and later calls return them too.
        """

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Yield the log's rows in stored order, one block at a time, and account for each row.

        Every row found is counted with ``ledger.find``. Rows outside ``selection`` are skipped with
        the reasons ``NOT_ASKED_TIME`` and ``NOT_ASKED_TOPIC``. A reader may use an index to avoid
        reading them; it then takes the number of skipped rows from the declared counts. When the
        iterator is exhausted, the declared counts are settled and ``ledger.integrity`` is set.

        Once the log is open, damage raises no exception: the reader yields the readable rows and
        counts the others with ``ledger.drop``. It never yields a row whose bytes are known to be
        damaged. If a checksum covers many rows and fails, the reader yields all structurally sound
        rows, and the log is not complete. (A seal locates damage to the MiB, not to the row; see
        ``sealed_log``.)
        """

    def close(self) -> None:
        """Close the files."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...


@runtime_checkable
class HasUrl(Protocol):
    """A log that was opened from a URL; reading its ``path`` may fetch the complete log."""

    @property
    def url(self) -> str:
        """The URL, without user, password and query; see ``remote.address``."""


def origin(log: Log) -> Path | str:
    """Return the path or the URL that a log was opened from."""
    return log.url if isinstance(log, HasUrl) else log.path


def name_of(log: Log) -> str:
    """Return the name of a log in accounts: its URL, else its path."""
    return str(origin(log))


@runtime_checkable
class KnowsItsEnd(Protocol):
    """A log that detects missing data without reading its body."""

    def report_missing(self, ledger: Ledger) -> None:
        """Count as dropped the rows that the log's header, index or end shows to be missing.

        ``Log.read`` reports them too, with more detail. Callers use only one of the two.
        """


def report_missing(log: Log, ledger: Ledger) -> None:
    """Call ``log.report_missing`` if the log supports it."""
    if isinstance(log, KnowsItsEnd):
        log.report_missing(ledger)


@runtime_checkable
class KnowsItsStart(Protocol):
    """A log that finds its start faster than by reading its first block."""

    def start_ns(self) -> int | None:
        """Return the log time of the first stored row; None if it has to be read."""


def start_ns(log: Log) -> int | None:
    """Return the log time of the first stored row; None without a row."""
    known = log.start_ns() if isinstance(log, KnowsItsStart) else None
    return known if known is not None else first_stored_ns(log.read(Ledger(name_of(log))))


def first_stored_ns(blocks: Iterator[Block]) -> int | None:
    """Return the lowest log time of the first block with a row; None without a row."""
    return next((int(block.log_ns.min()) for block in blocks if len(block)), None)


class WrappedLog(Closing):
    """A log that wraps another log; subclasses change how it is read or closed."""

    def __init__(self, log: Log) -> None:
        """Wrap ``log``."""
        self._log: Final = log

    @property
    def path(self) -> Path:
        """Path of the log."""
        return self._log.path

    @property
    def format(self) -> str:
        """Format of the log."""
        return self._log.format

    @property
    def topics(self) -> tuple[Topic, ...]:
        """Topics of the log."""
        return self._log.topics

    def report_missing(self, ledger: Ledger) -> None:
        """Report missing rows of the log; see ``KnowsItsEnd``."""
        report_missing(self._log, ledger)

    def start_ns(self) -> int | None:
        """Return the log time of the first stored row, if the log knows it."""
        return self._log.start_ns() if isinstance(self._log, KnowsItsStart) else None

    def close(self) -> None:
        """Close the log."""
        self._log.close()

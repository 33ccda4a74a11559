"""Seal logs, and compare logs with their seals."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Final

from crosscue.replay.errors import CrosscueError, LogError, UsageError
from crosscue.replay.formats import format_of
from crosscue.replay.progress import Progress, emit
from crosscue.replay.safe_text import counted
from crosscue.replay.seal.seal import (
    HASH,
    SUFFIX,
    Check,
    Sealing,
    Span,
    seal_over,
    seal_path,
    write_seal,
)
from crosscue.results import HIDDEN, Listing, Result, json_key

MEGABYTE: Final = 1_000_000
SHOWN: Final = 20


@dataclass(frozen=True, slots=True, repr=False)
class Sealed(Result):
    """A log and its seal.

    Attributes:
        log: The sealed log.
        seal: The seal file, next to the log.
        is_new: True if the seal was written now; False if it existed and matches.
        files: Number of files it covers.
        size_bytes: Total size of those files.
        blocks: Number of blocks of 1 MiB that were hashed.
        is_whole: True, because a seal that was just written or verified matches the log.
    """

    log: Path
    seal: Path
    is_new: bool
    files: int
    size_bytes: int = field(metadata=json_key("bytes"))
    blocks: int
    is_whole: bool = True

    def lines(self) -> Iterator[str]:
        """Yield one line on the seal."""
        what = "written" if self.is_new else "unchanged, the log matches it"
        yield (
            f"{self.seal}: {what}; {counted(self.files, 'file')}, {self.size_bytes} bytes, "
            f"{HASH} of {counted(self.blocks, 'block')} of 1 MiB"
        )


@dataclass(frozen=True, slots=True, repr=False)
class SealCheck(Result):
    """Result of checking a log against its seal.

    Attributes:
        log: The log.
        seal: Its seal, or that of a folder that contains it.
        sealed_at: Time of sealing, UTC, ISO 8601.
        blocks: Number of its blocks of 1 MiB in the seal.
        checked: Number of blocks that were read.
        files_changed: Files that are missing, new, or of another size, one sentence each.
        spans: Byte ranges that differ.
    """

    log: Path
    seal: Path
    sealed_at: str
    blocks: int
    checked: int
    files_changed: tuple[str, ...]
    spans: tuple[Span, ...] = field(metadata=HIDDEN)

    also: ClassVar = {"is_whole": "is_whole", "damaged": "damaged"}

    @property
    def is_whole(self) -> bool:
        """True if the log matches its seal."""
        return not self.spans and not self.files_changed

    @property
    def damaged(self) -> list[dict[str, object]]:
        """Byte ranges that differ, by file."""
        return [{"file": one.name, "from": one.start, "to": one.stop} for one in self.spans]

    def lines(self) -> Iterator[str]:
        """Yield one line if the log matches, else one for each difference."""
        if self.is_whole:
            all_blocks = counted(self.blocks, "block matches", "blocks match")
            yield f"{self.log}: {all_blocks} the seal of {self.sealed_at}, none differs"
        for sentence in self.files_changed:
            yield f"{self.log}: {sentence}"
        for one in self.spans[:SHOWN]:
            yield f"{self.log}: {one.name}: bytes {one.start} to {one.stop} differ from the seal"
        if len(self.spans) > SHOWN:
            yield f"and {len(self.spans) - SHOWN} more; --json lists them"


class Seals(Listing[Sealed]):
    """Logs and their seals; its repr is a table."""

    head = ("log", "seal", "blocks", "state")
    root = "logs"
    is_printed_in_parts = True

    def cells(self, row: Sealed) -> tuple[object, ...]:
        """Return the cells of a row."""
        return (row.log, row.seal.name, row.blocks, "written" if row.is_new else "unchanged")


def seal(*logs: str | Path, overwrite: bool = False) -> Seals:
    """Write a checksum of each MiB beside a log.

    ROS 1 bags, .db3, candump, ASC and TRC logs, videos and .npy data sets contain no checksum, so a
    flipped payload byte goes unnoticed. Seal a log once it is known to be good. Every later command
    verifies the parts of the log that it reads, and reports damaged byte ranges. A seal that no
    longer matches its log is replaced only with --overwrite; run crosscue check LOG.seal first,
    which verifies the entire log. URLs cannot be sealed.

    Examples:
        crosscue seal drive.bag can0.log        writes drive.bag.seal and can0.log.seal
        crosscue seal segment/                  writes segment.seal, for all files of the folder

    Args:
        logs: Recordings on this machine, files or folders.
        overwrite: Replace a seal that does not match the log.

    Raises:
        UsageError: A log is a URL or a seal; nothing is sealed.
        LogError: A log cannot be read, or its seal is damaged.
        OutputError: A log differs from its seal, or the seal cannot be written.
    """
    rows = []
    for log in [_place(log) for log in logs]:
        rows.append(_sealed(log, overwrite=overwrite))
        emit(rows[-1])
    return Seals(rows)


def _sealed(log: Path, *, overwrite: bool) -> Sealed:
    sealing = Sealing(log)
    doing = f"sealing {log.name}"
    for done in sealing:
        emit(Progress(doing, done / MEGABYTE, sealing.total / MEGABYTE, "MB"))
    made = sealing.seal
    is_new = write_seal(log, made, overwrite=overwrite)
    return Sealed(log, seal_path(log), is_new, len(made.files), sealing.total, made.blocks)


def _place(name: str | Path) -> Path:
    if isinstance(name, str) and "://" in name:
        raise UsageError(f"{name}: a URL cannot be sealed; download the log, and seal the file")
    log = Path(name)
    if log.name.endswith(SUFFIX):
        raise UsageError(f"{log}: is a seal itself; name the log, {log.with_suffix('')}")
    format_of(log)
    return log


def check_seal(name: Path | str) -> SealCheck:
    """Compare a whole log with its seal.

    Raises:
        UsageError: The log is a URL or a seal.
        LogError: The log cannot be read, or its seal is damaged.
        CrosscueError: The log has no seal to check.
    """
    log = _place(name)
    found = seal_over(log)
    if found is None:
        name = seal_path(log).name
        raise CrosscueError(f"{log}: not sealed, there is no {name}; run 'crosscue seal'")
    path, known = found
    try:
        check = Check(log, known)
    except OSError as error:
        raise LogError(f"{error.filename or log}: {error.strerror or error}") from None
    for _ in check.everything():
        emit(Progress(f"checking {log.name}", check.checked, known.blocks, "MiB"))
    spans = tuple(check.damaged())
    return SealCheck(log, path, known.sealed_at, known.blocks, check.checked, check.oddities, spans)

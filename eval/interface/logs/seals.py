"""Write and verify seals of logs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from crosscue.eval.interface.show import Listing
from crosscue.replay.base import CrosscueError, LogError, UsageError, visible
from crosscue.replay.formats import format_of
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


@dataclass(frozen=True, slots=True, repr=False)
class Sealed:
    """A log and its seal.

    Attributes:
        log: The sealed log.
        seal: The seal file, next to the log.
        is_new: True if the seal was written now; False if it existed and matches.
        files: Number of files it covers.
        size_bytes: Total size of those files.
        blocks: Number of blocks of 1 MiB that were hashed.
    """

    log: Path
    seal: Path
    is_new: bool
    files: int
    size_bytes: int
    blocks: int

    @property
    def is_whole(self) -> bool:
        """True, because a seal that was just written or verified matches the log."""
        return True

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output of ``crosscue seal``."""
        return {
            "log": str(self.log),
            "seal": str(self.seal),
            "is_new": self.is_new,
            "is_whole": self.is_whole,
            "files": self.files,
            "bytes": self.size_bytes,
            "blocks": self.blocks,
        }

    def __repr__(self) -> str:
        what = "written" if self.is_new else "unchanged, the log matches it"
        return (
            visible(f"{self.seal}: {what}; {self.files} files, {self.size_bytes} bytes, {HASH} of ")
            + f"{self.blocks} blocks of 1 MiB"
        )


@dataclass(frozen=True, slots=True, repr=False)
class SealCheck:
    """Result of checking a log against its seal.

    Attributes:
        log: The log.
        seal: Its seal, or that of a folder that contains it.
        sealed_at: Time of sealing, UTC, ISO 8601.
        blocks: Number of its blocks of 1 MiB in the seal.
        checked: Number of blocks that were read.
        files_changed: Files that are missing, new, or of another size, one sentence each.
        damaged: Byte ranges that differ.
    """

    log: Path
    seal: Path
    sealed_at: str
    blocks: int
    checked: int
    files_changed: tuple[str, ...]
    damaged: tuple[Span, ...]

    @property
    def is_whole(self) -> bool:
        """True if the log matches its seal."""
        return not self.damaged and not self.files_changed

    @property
    def differences(self) -> list[str]:
        """Byte ranges that differ, one line each."""
        return [
            visible(f"{self.log}: {one.name}: bytes {one.start} to {one.stop} differ from the seal")
            for one in self.damaged
        ]

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output of ``crosscue seal --check``."""
        return {
            "log": str(self.log),
            "seal": str(self.seal),
            "sealed_at": self.sealed_at,
            "is_whole": self.is_whole,
            "blocks": self.blocks,
            "checked": self.checked,
            "files_changed": list(self.files_changed),
            "damaged": [
                {"file": one.name, "from": one.start, "to": one.stop} for one in self.damaged
            ],
        }

    def __repr__(self) -> str:
        if not self.is_whole:
            changed = [visible(f"{self.log}: {sentence}") for sentence in self.files_changed]
            return "\n".join([*changed, *self.differences])
        return visible(f"{self.log}: all {self.blocks} blocks match the seal of {self.sealed_at}")


class Seals(Listing[Sealed]):
    """Sealed logs; its repr is a table."""

    head = ("log", "seal", "files", "blocks", "state")

    def cells(self, row: Sealed) -> tuple[object, ...]:
        """Return the cells of a row."""
        state = "written" if row.is_new else "unchanged"
        return (row.log, row.seal.name, row.files, row.blocks, state)


class SealChecks(Listing[SealCheck]):
    """Results of checking logs against their seals; its repr is a table."""

    head = ("log", "seal", "sealed at", "blocks", "state")

    def cells(self, row: SealCheck) -> tuple[object, ...]:
        """Return the cells of a row."""
        state = "matches" if row.is_whole else "differs"
        return (row.log, row.seal.name, row.sealed_at, row.blocks, state)


def seal(
    *logs: Path | str,
    overwrite: bool = False,
    on_bytes: Callable[[Path, int, int], None] = lambda log, done, of: None,
    on_log: Callable[[Sealed], None] = lambda sealed: None,
) -> Seals:
    """Write a hash of each MiB of a log next to it, so that later damage is detected and located.

    Args:
        logs: Files or folders on this machine.
        overwrite: Replace a seal that does not match the log.
        on_bytes: Called with the log, the number of bytes hashed, and their total.
        on_log: Called with each log after it is sealed.

    Raises:
        UsageError: A log is a URL or a seal; nothing is sealed.
        LogError: A log cannot be read.
        OutputError: A log differs from its seal, or the seal cannot be written.
    """
    found = []
    for log in [_place(log) for log in logs]:
        sealing = Sealing(log)
        for done in sealing:
            on_bytes(log, done, sealing.total)
        made, path = sealing.seal, seal_path(log)
        is_new = write_seal(log, made, overwrite=overwrite)
        one = Sealed(log, path, is_new, len(made.files), sealing.total, made.blocks)
        found.append(one)
        on_log(one)
    return Seals(found)


def check_seal(
    *logs: Path | str,
    on_blocks: Callable[[Path, int, int], None] = lambda log, done, of: None,
    on_log: Callable[[SealCheck], None] = lambda checked: None,
) -> SealChecks:
    """Read complete logs and compare them with their seals.

    Args:
        logs: Files or folders on this machine.
        on_blocks: Called with the log, the number of blocks checked, and their total.
        on_log: Called with each log after it is checked.

    Raises:
        UsageError: A log is a URL or a seal.
        LogError: A log cannot be read, or its seal is damaged.
        CrosscueError: A log has no seal.
    """
    found = []
    for log in [_place(log) for log in logs]:
        one = _checked(log, on_blocks)
        found.append(one)
        on_log(one)
    return SealChecks(found)


def _place(name: Path | str) -> Path:
    if isinstance(name, str) and "://" in name:
        raise UsageError(f"{name}: a URL cannot be sealed; download the log, and seal the file")
    log = Path(name)
    if log.name.endswith(SUFFIX):
        raise UsageError(f"{log}: is a seal itself; name the log, {log.with_suffix('')}")
    format_of(log)
    return log


def _checked(log: Path, on_blocks: Callable[[Path, int, int], None]) -> SealCheck:
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
        on_blocks(log, check.checked, known.blocks)
    damaged = tuple(check.damaged())
    return SealCheck(
        log, path, known.sealed_at, known.blocks, check.checked, check.oddities, damaged
    )

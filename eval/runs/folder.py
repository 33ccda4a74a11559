"""The run folder: where stages meet on disk.

Files get their final name only when whole. One lock file names the process at work. The records of
the manifest, the account and what became of candidates are imported from here as well.
"""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from crosscue.eval.runs.tables.parquet import TableFolder
from crosscue.replay.base import (
    DEFAULT_LIMITS,
    Limits,
    RunError,
    UnreadableRunError,
    cannot_write,
    read_at_most,
    strict_json,
    write_text,
)
from crosscue.replay.files.partial_file import is_partial, is_still, lock, sweep

from .account import (
    UNATTRIBUTED,
    Account,
    Line,
    ScoredAccount,
    SummedAccount,
    account,
    account_lines,
    check,
    details_of,
    detecting_of,
    joined_accounts,
    line,
    reading_of,
    summed,
)
from .candidates import CandidateRow, candidate_lines, candidate_rows, not_looked_lines
from .manifest import (
    FORMAT_VERSION,
    OWN_FRAME,
    ApproachRow,
    DecodeManifest,
    DetectCounts,
    DetectManifest,
    DetectorRow,
    DetectTimings,
    DriveManifest,
    EstimateCounts,
    EstimateManifest,
    EstimateTimings,
    LandmarksUsed,
    LogRow,
    Manifest,
    MergedDrive,
    MergedLog,
    MergedManifest,
    OtherVersionError,
    PoseSummary,
    SceneSummary,
    TimeSegments,
    json_schema,
    parse_manifest,
    part_of,
)

__all__ = [
    "FAILURE",
    "FORMAT_VERSION",
    "INPUT",
    "LOCK",
    "MANIFEST",
    "MAX_MANIFEST_BYTES",
    "OWN_FRAME",
    "STAGED",
    "TAGS",
    "UNATTRIBUTED",
    "Account",
    "ApproachRow",
    "CandidateRow",
    "DecodeManifest",
    "DetectCounts",
    "DetectManifest",
    "DetectTimings",
    "DetectorRow",
    "DriveManifest",
    "EstimateCounts",
    "EstimateManifest",
    "EstimateTimings",
    "LandmarksUsed",
    "Line",
    "LogRow",
    "Manifest",
    "MergedDrive",
    "MergedLog",
    "MergedManifest",
    "PoseSummary",
    "RunFolder",
    "SceneSummary",
    "ScoredAccount",
    "SummedAccount",
    "TableFolder",
    "TimeSegments",
    "account",
    "account_lines",
    "candidate_lines",
    "candidate_rows",
    "check",
    "clear",
    "create",
    "details_of",
    "detecting_of",
    "is_alive",
    "joined_accounts",
    "json_schema",
    "line",
    "locked",
    "not_looked_lines",
    "open_run",
    "part_of",
    "reading_of",
    "signature",
    "staged",
    "summed",
    "write_input",
    "write_manifest",
]

MANIFEST: Final = "manifest.json"
LOCK: Final = ".lock"
INPUT: Final = "input.json"
"""What a run is made of, written before anything else: a run cut short has no manifest."""
FAILURE: Final = "failure.log"
"""Why the last attempt at a run failed; a finished run takes its place."""
MAX_MANIFEST_BYTES: Final = 256 << 20
TAGS: Final = "tags.json"
"""What its users call a run; it stays when the run is made again. See ``tags``."""
STAGED: Final = ".new"
"""Folder inside a run that holds what is to replace it, until that is whole."""


@dataclass(frozen=True, slots=True)
class RunFolder(TableFolder):
    """A run's folder; make one with ``create`` or ``open_run``.

    Attributes:
        logs: A folder that its logs have moved to, or None where they are as the manifest says.
        without_images: Is it to be shown without the pictures in its logs?
        limits: What its logs are read with.
        home: Where it will lie, if it is still being made elsewhere; see ``staged``.
    """

    logs: Path | None = None
    without_images: bool = False
    limits: Limits = DEFAULT_LIMITS
    home: Path | None = None

    def manifest(self) -> Manifest:
        """The manifest as read.

        Raises:
            RunError: Not there, damaged, or of another version of crosscue.
        """
        path = self.file(MANIFEST)
        try:
            content = read_at_most(path, MAX_MANIFEST_BYTES)
            if content is None:
                raise ValueError(f"over {MAX_MANIFEST_BYTES >> 20} MiB")
            return parse_manifest(content)
        except FileNotFoundError:
            raise UnreadableRunError(
                f"{self.path}: no {MANIFEST}: not a run folder, or its run was cut short; "
                "run crosscue replay again"
            ) from None
        except OtherVersionError as error:
            raise UnreadableRunError(f"{path}: {error}: replay again") from None
        except (OSError, ValueError) as error:
            raise UnreadableRunError(
                f"{path}: unreadable ({error}); run crosscue replay again"
            ) from None

    def drive_manifest(self) -> DriveManifest:
        """The manifest of a run of one drive.

        Raises:
            RunError: It holds many drives, or tables of ``crosscue decode``; else as ``manifest``.
        """
        found = self.manifest()
        if isinstance(found, MergedManifest):
            raise RunError(
                f"{self.path}: holds the tables of many drives; give one of the runs beside it"
            )
        if isinstance(found, DecodeManifest):
            raise RunError(f"{self.path}: holds tables of crosscue decode; give a run of replay")
        return found

    def refuse_set_back(self, what: str) -> None:
        """Refuse a run whose times do not fit the truth's, for ``what`` compares them.

        Raises:
            RunError: A clock was set back during the drive; else as ``drive_manifest``.
        """
        if self.drive_manifest().timeline.was_set_back:
            raise RunError(
                f"{self.path}: a clock was set back during the drive, so its times are not the "
                f"truth's; {what} takes drives without: replay each side alone with --from and --to"
            )


def create(path: Path, *, overwrite: bool) -> RunFolder:
    """An empty run folder.

    Raises:
        RunError: It exists and is not empty, or is not a folder, and ``overwrite`` is not given.
        OutputError: It cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        leftovers = [entry for entry in path.iterdir() if entry.name not in (LOCK, FAILURE)]
    except FileExistsError:
        raise RunError(f"{path}: is a file; give a folder for the run") from None
    except OSError as error:
        raise cannot_write(path, error) from None
    if leftovers and not overwrite:
        raise RunError(f"{path}: holds files already; give another folder or --overwrite")
    if leftovers and not _looks_like_run(leftovers):
        names = ", ".join(sorted(entry.name for entry in leftovers)[:3])
        raise RunError(f"{path}: holds files that are no run's ({names}); give another folder")
    return RunFolder(path)


@contextmanager
def created(path: Path, *, overwrite: bool) -> Iterator[RunFolder]:
    """As ``create``; a folder that was not there before goes again if it stays empty.

    Raises:
        RunError: As ``create``.
        OutputError: As ``create``.
    """
    is_new = not path.exists()
    run = create(path, overwrite=overwrite)
    try:
        yield run
    except BaseException:
        if is_new:
            # Not where a run cut short has left files.
            with suppress(OSError):
                path.rmdir()
        raise


def clear(run: RunFolder, content: Mapping[str, object] | None = None) -> None:
    """Delete an earlier run's files; the lock and its tags stay. Call it while holding the lock.

    The manifest goes first: a folder that has one is a whole run, even if this is cut short.

    Args:
        run: The folder.
        content: Of ``input.json``, which says from now on what is being made here.

    Raises:
        OutputError: One cannot be deleted.
    """
    try:
        run.file(MANIFEST).unlink(missing_ok=True)
        if content is not None:
            write_input(run, content)
        for entry in run.path.iterdir():
            if entry.name in (LOCK, TAGS) or (entry.name == INPUT and content is not None):
                continue
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry)
            else:
                entry.unlink()
    except OSError as error:
        place = Path(error.filename) if error.filename else run.path
        raise cannot_write(place, error) from None


@contextmanager
def staged(
    run: RunFolder, *, keep: bool = False, until: Manifest | None = None
) -> Iterator[RunFolder]:
    """A place to write what replaces a finished run; that is touched only once this is whole.

    Without a finished run there is nothing to protect, and the place is the run itself. Call it
    while holding the lock.

    Args:
        run: The run.
        keep: Begin with its files, and leave those that nothing replaces.
        until: What the manifest says while files are replaced; without it none exists so long.

    Raises:
        OutputError: The folder cannot be written.
    """
    if not run.file(MANIFEST).exists():
        yield run
        return
    new = replace(run, path=run.path / STAGED, home=run.home or run.path)
    try:
        shutil.rmtree(new.path, ignore_errors=True)
        new.path.mkdir()
        if keep:
            _link_files(run, new)
    except OSError as error:
        raise cannot_write(new.path, error) from None
    try:
        yield new
        try:
            _swap(run, new, keep, until)
        except OSError as error:
            raise cannot_write(run.path, error) from None
    finally:
        shutil.rmtree(new.path, ignore_errors=True)


def _link_files(run: RunFolder, new: RunFolder) -> None:
    """The run's files under a second name each: a file is never changed, only replaced."""
    for entry in run.path.iterdir():
        if entry.name == LOCK or not entry.is_file():
            continue
        try:
            new.file(entry.name).hardlink_to(entry)
        except OSError:
            shutil.copy2(entry, new.file(entry.name))


def _swap(run: RunFolder, new: RunFolder, keep: bool, until: Manifest | None) -> None:
    """Put the new files in place of the old ones; the manifest goes first and comes last."""
    if until is None:
        run.file(MANIFEST).unlink()
    else:
        write_manifest(run, until)
    names = {entry.name for entry in new.path.iterdir()}
    for entry in run.path.iterdir():
        if entry.name in (LOCK, STAGED, TAGS) or (keep and entry.name not in names):
            continue
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry)
        elif entry.name not in names | {MANIFEST}:
            entry.unlink()
    for name in sorted(names, key=lambda name: name == MANIFEST):
        new.file(name).replace(run.file(name))


def open_run(
    path: Path,
    logs: Path | None = None,
    *,
    without_images: bool = False,
    limits: Limits = DEFAULT_LIMITS,
) -> RunFolder:
    """An existing run folder, its manifest checked.

    Args:
        path: The folder.
        logs: Where its logs have moved to, if they have.
        without_images: Show it without the pictures in its logs.
        limits: What its logs are read with.

    Raises:
        RunError: As ``RunFolder.manifest``; ``logs`` is not a folder.
    """
    if logs is not None and not logs.is_dir():
        raise UnreadableRunError(f"{logs}: not a folder; give the one that the logs have moved to")
    run = RunFolder(path, logs, without_images, limits)
    run.manifest()
    return run


def _looks_like_run(entries: list[Path]) -> bool:
    ours = {MANIFEST, FAILURE, STAGED, "score", "view", "pictures"}
    return all(
        e.name in ours or e.suffix in (".parquet", ".rrd", ".json") or is_partial(e.name)
        for e in entries
    )


@contextmanager
def locked(run: RunFolder) -> Iterator[None]:
    """Hold the folder for this process.

    The kernel keeps the lock and drops it when its holder dies, however that happens; the file's
    text says who holds it, which is all there is where a network file system has no such locks.

    Raises:
        RunError: Another living process holds it; it is named.
        OutputError: The folder cannot be written.
    """
    path = run.file(LOCK)
    try:
        handle = _lock_file(path)
    except OSError as error:
        raise cannot_write(path, error) from None
    try:
        sweep(run.path, again=True)
        shutil.rmtree(run.file(STAGED), ignore_errors=True)
        yield
    finally:
        # Gone from the folder before it is free, so that nobody waits for a file without a name.
        path.unlink(missing_ok=True)
        os.close(handle)


def _lock_file(path: Path) -> int:
    """The folder's lock file, open, locked, and with our name in it."""
    while True:
        handle = os.open(path, os.O_CREAT | os.O_RDWR, 0o644)
        try:
            is_ours = lock(handle)
            _refuse_if_held(path, os.read(handle, 4096), is_ours=is_ours)
            if is_still(handle, path):
                _sign(handle, path)
                return handle
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)


def _sign(handle: int, path: Path) -> None:
    """Write into the lock who holds it; a lock that cannot be written is taken away."""
    try:
        os.ftruncate(handle, 0)
        os.pwrite(handle, signature().encode(), 0)
    except OSError:
        with suppress(OSError):
            path.unlink(missing_ok=True)
        raise


def _refuse_if_held(path: Path, text: bytes, *, is_ours: bool | None) -> None:
    """Refuse when the kernel knows of a holder, or, where it cannot, the lock's text names one.

    Args:
        path: The lock.
        text: What it says.
        is_ours: Did the kernel give it to us? None where it keeps no locks.
    """
    try:
        pid, host, started = text.decode().split(" ", 2)
    except ValueError:
        # Nobody is named: taken this moment, or its holder died before writing.
        pid = host = started = ""
    if host not in ("", socket.gethostname()):
        raise RunError(f"{path}: held by process {pid} on {host}; delete the file if that is over")
    is_other = pid.isdigit() and int(pid) != os.getpid()
    is_alive = is_other and started == _started(int(pid))
    if is_ours is False or (is_ours is None and is_alive):
        who = f"process {pid} on {host}" if pid else "another process"
        raise RunError(f"{path.parent}: {who} is writing it; wait or stop that")


def signature() -> str:
    """This process: its number, its host, and when it began."""
    return f"{os.getpid()} {socket.gethostname()} {_started(os.getpid())}"


def is_alive(signed: str) -> bool | None:
    """Does the process of a signature still run? None where it is another machine's."""
    pid, host, started = [*signed.split(" ", 2), "", "", ""][:3]
    if host != socket.gethostname():
        return None
    return pid.isdigit() and started == _started(int(pid)) != ""


def _started(pid: int) -> str:
    """When a process began, boot included: its number alone is used again. Empty if it is gone."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        ticks = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return ""
    return f"{boot} {ticks}"


def write_manifest(run: RunFolder, content: Manifest) -> None:
    """Write the manifest, last of all: a folder that has one is a finished run."""
    write_text(run.file(MANIFEST), strict_json(content.as_json()) + "\n")


def write_input(run: RunFolder, content: Mapping[str, object]) -> None:
    """Write what the run is made of."""
    whole = {"format_version": FORMAT_VERSION, **content}
    write_text(run.file(INPUT), strict_json(whole) + "\n")

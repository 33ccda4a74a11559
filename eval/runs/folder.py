"""The run folder, in which the stages exchange their results.

A file gets its final name only when it is complete. A lock file names the process that is writing.
"""

import os
import re
import shutil
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from crosscue.eval.runs.tables.parquet import TableFolder
from crosscue.replay.errors import RunError, UnreadableRunError
from crosscue.replay.files import door
from crosscue.replay.files.partial_file import is_partial, is_still, lock, sweep
from crosscue.replay.files.tree_text import json_tree, spelled, strict_json, unspelled
from crosscue.replay.files.whole_file import cannot_write, write_text
from crosscue.replay.limits import DEFAULT_LIMITS, Limits

from . import owned
from .manifest import (
    FORMAT_VERSION,
    DecodeManifest,
    DriveManifest,
    Manifest,
    MergedManifest,
    OtherVersionError,
    Timings,
    parse_manifest,
)

MANIFEST: Final = "manifest.json"
LOCK: Final = ".lock"
# Inputs of a run, written first, because an interrupted run has no manifest.
INPUT: Final = "input.json"
# Error of the last attempt at a run; removed when the run finishes.
FAILURE: Final = "failure.log"
# The user's tags of a run, see ``tags``; they are kept when the run is made again.
TAGS: Final = "tags.json"
# Wall times of a run, which is complete without them.
TIMINGS: Final = "timings.json"
# Folder inside a run with the files that will replace it when they are complete.
STAGED: Final = ".new"
MAX_MANIFEST_BYTES: Final = 256 << 20
_RECORDS: Final = frozenset({MANIFEST, INPUT, FAILURE, LOCK, TAGS, TIMINGS})
_RUN: Final = re.compile(
    r"drive\.rrd|report\.html|(?:frames|detections|road|skipped|pose|measurements|mobileye_(?:obstacles|lanes)"
    r"|cues|range|belief|ranged_objects|visual_odometry)\.parquet"
    r"|score/(?:(?:metrics|truth_file|smoother|detector_[\w.-]+)\.json|junit\.xml|(?:truth|estimate)\.tum"
    r"|(?:report|detector_[\w.-]+)\.html|(?:curves|cue_frames|approaches|by_drive)\.parquet"
    r"|pose_(?:plan|error|heading|nees|major_axis)\.png)"
)
_PICTURE: Final = re.compile(r"pictures/(-?\d{1,19})\.jpg")


@dataclass(frozen=True, slots=True)
class RunFolder(TableFolder):
    """A run's folder; make one with ``create`` or ``open_run``.

    Attributes:
        logs: Folder to which the logs have moved; None if they are where the manifest states.
        without_images: True to show the run without the pictures in its logs.
        limits: Limits for reading the logs.
        home: Final location of a run that is being written elsewhere, see ``staged``.
    """

    logs: Path | None = None
    without_images: bool = False
    limits: Limits = DEFAULT_LIMITS
    home: Path | None = None

    def manifest(self) -> Manifest:
        """Read the manifest.

        Raises:
            RunError: The manifest is missing, damaged, or of another version of crosscue.
        """
        path = self.file(MANIFEST)
        try:
            found = parse_manifest(door.read(path, MAX_MANIFEST_BYTES))
        except (FileNotFoundError, NotADirectoryError):
            raise UnreadableRunError(
                f"{self.path}: no {MANIFEST}: not a run folder, or its run was cut short; "
                "run crosscue replay again"
            ) from None
        except OtherVersionError as error:
            raise UnreadableRunError(f"{path}: {error}: replay again") from None
        except OSError as error:
            raise UnreadableRunError(f"{path}: {error.strerror}; then replay again") from None
        except ValueError as error:
            raise UnreadableRunError(
                f"{path}: unreadable ({error}); run crosscue replay again"
            ) from None
        if isinstance(found, MergedManifest):
            return found
        return found.with_files(lambda name: os.path.normpath(self.absolute(name)))

    def relative(self, place: Path | str) -> str:
        """Return a path relative to the run's folder, as it is spelled in its files."""
        whole, home = Path(place).absolute(), (self.home or self.path).resolve()
        return spelled(os.path.relpath(whole.parent.resolve() / whole.name, home))

    def absolute(self, path: str) -> Path:
        """Return the path that ``relative`` has spelled."""
        return (self.home or self.path).resolve() / unspelled(path)

    def timings(self) -> Timings | None:
        """Read how long the run took; None if that is missing, damaged or of another version."""
        try:
            return Timings.model_validate_json(door.read(self.file(TIMINGS)))
        except (OSError, ValueError):
            return None

    def drive_manifest(self) -> DriveManifest:
        """Read the manifest of a run of one drive.

        Raises:
            RunError: The folder holds many drives or tables of ``crosscue decode``, or as for
                ``manifest``.
        """
        found = self.manifest()
        if isinstance(found, MergedManifest):
            raise RunError(
                f"{self.path}: contains tables of many drives; give one of the runs next to it"
            )
        if isinstance(found, DecodeManifest):
            raise RunError(f"{self.path}: holds tables of crosscue decode; give a run of replay")
        return found

    def refuse_set_back(self, what: str) -> None:
        """Refuse a run whose times are not those of the truth, because ``what`` compares them.

        Raises:
            RunError: A clock was set back during the drive, or as for ``drive_manifest``.
        """
        if self.drive_manifest().timeline.was_set_back:
            raise RunError(
                f"{self.path}: a clock was set back during the drive, so its times are not the "
                f"truth's, as {what} needs; replay each side alone with --from and --to"
            )


def own_files(run: RunFolder) -> owned.IsOurs:
    """Return which files of a folder are those of its run; without a run, a lock and a failure.

    The manifest of a finished run, or the ``input.json`` of an unfinished one, says by which stage
    the folder was made, and each stage writes files of known names. Every other file is the user's.
    """
    tables, is_finished = frozenset[str](), True
    try:
        manifest = run.manifest()
    except RunError:
        is_finished, is_drive = False, _is_begun(run)
    else:
        is_drive = manifest.stage in ("detect", "estimate")
        if manifest.stage == "decode":
            named = {*manifest.tables.values(), "skipped.parquet"}
            tables = frozenset(name for name in named if name.endswith(".parquet"))
        elif manifest.stage == "merged":
            tables = frozenset(f"{name}.parquet" for name in manifest.tables)
    is_run = is_finished or is_drive
    drawn = _drawn(run) if is_drive else frozenset[int]()

    def is_ours(name: str) -> bool:
        if name.startswith(f"{STAGED}/") or is_partial(name.rpartition("/")[2]):
            return True
        picture = _PICTURE.fullmatch(name)
        if picture is not None:
            return int(picture[1]) in drawn
        is_table = name in tables or (is_drive and _RUN.fullmatch(name) is not None)
        return is_table or name in (_RECORDS if is_run else {LOCK, FAILURE})

    return is_ours


def refuse_files_of_user(path: Path) -> None:
    """Refuse to replace a run in whose folder there are other files, too.

    Raises:
        UsageError: There are; the message names them.
        OSError: A folder cannot be listed.
    """
    owned.refuse_others(path, own_files(RunFolder(path)))


def _is_begun(run: RunFolder) -> bool:
    try:
        tree = json_tree(door.read(run.file(INPUT)))
        return bool(tree["format_version"] and tree["identity"] and tree["settings"])
    except (RunError, OSError, ValueError, KeyError, TypeError):
        return False


def _drawn(run: RunFolder) -> frozenset[int]:
    """Return the times of the frames, by which pictures are named."""
    with suppress(RunError):
        table = run.table("frames", ["t_ns", "log_t_ns"])
        return frozenset(t for name in table.column_names for t in table[name].to_pylist())
    return frozenset()


def create(path: Path, *, overwrite: bool, resume: bool = False) -> RunFolder:
    """Create an empty run folder.

    Args:
        path: The folder.
        overwrite: Accept the files of an earlier run, which will be deleted.
        resume: Accept an earlier run, which will be continued.

    Raises:
        RunError: The path is a file, or a folder that is not empty.
        UsageError: ``overwrite`` would delete files that are not of the earlier run.
        OutputError: The folder cannot be created.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        is_empty = all(entry.name in (LOCK, FAILURE) for entry in path.iterdir())
        if not is_empty and overwrite:
            refuse_files_of_user(path)
    except FileExistsError:
        raise RunError(f"{path}: is a file; give a folder for the run") from None
    except OSError as error:
        raise cannot_write(path, error) from None
    if not (is_empty or overwrite or resume):
        raise RunError(f"{path}: holds files already; give another folder or --overwrite")
    return RunFolder(path)


@contextmanager
def created(path: Path, *, overwrite: bool, resume: bool = False) -> Iterator[RunFolder]:
    """Create a run folder as ``create`` does, and empty it again if no result gets into it.

    Raises:
        CrosscueError: As for ``create``.
    """
    is_new = not path.exists()
    was_empty = is_new or (path.is_dir() and not any(path.iterdir()))
    run = create(path, overwrite=overwrite, resume=resume)
    try:
        yield run
    except BaseException:
        # Files of an interrupted run are kept. A description alone would only block the next run.
        with suppress(OSError):
            if was_empty and [entry.name for entry in path.iterdir()] == [INPUT]:
                run.file(INPUT).unlink()
            if is_new:
                path.rmdir()
        raise


def clear(run: RunFolder, content: Mapping[str, object] | None = None) -> None:
    """Delete an earlier run's files except the lock and the tags; call it while holding the lock.

    The manifest is deleted first, so that a folder with a manifest is a complete run even if this
    is interrupted.

    Args:
        run: The folder.
        content: New content of ``input.json``, which describes the run that follows.

    Raises:
        OutputError: A file cannot be deleted.
    """
    is_ours = own_files(run)
    kept = {LOCK, TAGS} if content is None else {LOCK, TAGS, INPUT}
    try:
        run.file(MANIFEST).unlink(missing_ok=True)
        if content is not None:
            write_input(run, content)
        owned.remove(run.path, lambda name: name not in kept and is_ours(name))
    except OSError as error:
        place = Path(error.filename) if error.filename else run.path
        raise cannot_write(place, error) from None


@contextmanager
def staged(
    run: RunFolder, *, keep: bool = False, until: Manifest | None = None, always: bool = False
) -> Iterator[RunFolder]:
    """Yield a folder for files that replace a finished run once they are complete.

    Without a finished run there is nothing to protect, and the folder is the run itself, unless
    ``always`` is set. Call it while holding the lock.

    Args:
        run: The run.
        keep: Start with the run's files, and keep those that are not replaced.
        until: Manifest while files are being replaced; None for no manifest during that time.
        always: Also use another folder for the first files, whose names nothing records until they
            are complete.

    Raises:
        OutputError: The folder cannot be written.
    """
    if not (always or run.file(MANIFEST).exists()):
        yield run
        return
    new = replace(run, path=run.path / STAGED, home=run.home or run.path)
    try:
        shutil.rmtree(new.path, ignore_errors=True)
        new.path.mkdir()
        if keep:
            copy_files(run, new, is_linked=True)
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


def copy_files(run: RunFolder, new: RunFolder, *, is_linked: bool) -> None:
    """Copy the run's own files except its scores, or hard-link its tables and records.

    Links are safe because files are replaced and never modified.

    Raises:
        OSError: A file cannot be copied.
    """
    is_ours = own_files(run)
    for name in sorted(owned.files_in(run.path)):
        source, folder = run.path / name, name.rpartition("/")[0]
        is_wanted = folder in ({""} if is_linked else {"", "pictures"}) and name != LOCK
        if not (is_wanted and is_ours(name)) or source.is_symlink() or not source.is_file():
            continue
        target = new.file(name)
        target.parent.mkdir(exist_ok=True)
        try:
            if is_linked:
                target.hardlink_to(source)
                continue
        except OSError:
            target.unlink(missing_ok=True)
        shutil.copy2(source, target)


def _swap(run: RunFolder, new: RunFolder, keep: bool, until: Manifest | None) -> None:
    """Replace the old files by the new ones; remove the manifest first and write it last."""
    is_ours = own_files(run)
    if until is None:
        run.file(MANIFEST).unlink(missing_ok=True)
    else:
        write_manifest(run, until)
    names = {entry.name for entry in new.path.iterdir()}

    def is_gone(name: str) -> bool:
        top = name.partition("/")[0]
        is_kept = top in (LOCK, STAGED, TAGS) or name in names | {MANIFEST}
        return not (is_kept or (keep and top not in names)) and is_ours(name)

    owned.remove(run.path, is_gone)
    for name in sorted(names, key=lambda name: name == MANIFEST):
        new.file(name).replace(run.file(name))


def open_run(
    path: Path,
    logs: Path | None = None,
    *,
    without_images: bool = False,
    limits: Limits = DEFAULT_LIMITS,
) -> RunFolder:
    """Open an existing run folder and check its manifest.

    Args:
        path: The folder.
        logs: Folder to which its logs have moved, if any.
        without_images: Show the run without the pictures in its logs.
        limits: Limits for reading its logs.

    Raises:
        RunError: As for ``RunFolder.manifest``, or ``logs`` is not a folder.
    """
    if logs is not None and not logs.is_dir():
        raise UnreadableRunError(f"{logs}: not a folder; give the one that the logs have moved to")
    run = RunFolder(path, logs, without_images, limits)
    run.manifest()
    return run


@contextmanager
def locked(run: RunFolder) -> Iterator[None]:
    """Lock the folder for this process.

    The kernel releases the lock when its holder dies for any reason. The file's text names the
    holder, which is the only protection on network file systems without locks.

    Raises:
        RunError: Another living process holds the lock; the message names it.
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
        # Delete the file before releasing it, so that no process waits for a deleted file.
        path.unlink(missing_ok=True)
        os.close(handle)


def _lock_file(path: Path) -> int:
    """Return the folder's lock file, opened, locked and signed by this process."""
    while True:
        handle = door.opened(path, os.O_CREAT | os.O_RDWR)
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
    """Write the holder into the lock file; delete the file if that fails."""
    try:
        os.ftruncate(handle, 0)
        os.pwrite(handle, signature().encode(), 0)
    except OSError:
        with suppress(OSError):
            path.unlink(missing_ok=True)
        raise


def _refuse_if_held(path: Path, text: bytes, *, is_ours: bool | None) -> None:
    """Refuse a lock held by another process.

    Args:
        path: The lock file.
        text: Its content, which names the holder if the file system has no locks.
        is_ours: True if the kernel granted the lock; None if the file system has no locks.
    """
    try:
        pid, host, started = text.decode().split(" ", 2)
    except ValueError:
        # No holder is named: it has just locked the file, or died before signing.
        pid = host = started = ""
    if host not in ("", socket.gethostname()):
        raise RunError(f"{path}: held by process {pid} on {host}; delete the file if it has ended")
    is_other = pid.isdigit() and int(pid) != os.getpid()
    is_alive = is_other and started == _started(int(pid))
    if is_ours is False or (is_ours is None and is_alive):
        who = f"process {pid} on {host}" if pid else "another process"
        raise RunError(f"{path.parent}: {who} is writing it; wait or stop it")


def signature() -> str:
    """Return the id, host and start time of this process."""
    return f"{os.getpid()} {socket.gethostname()} {_started(os.getpid())}"


def is_alive(signed: str) -> bool | None:
    """Return whether the process of a signature is still running; None for another machine's."""
    pid, host, started = [*signed.split(" ", 2), "", "", ""][:3]
    if host != socket.gethostname():
        return None
    return pid.isdigit() and started == _started(int(pid)) != ""


def _started(pid: int) -> str:
    """Return boot id and start time of a process, because ids are reused; empty if it has ended."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        ticks = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return ""
    return f"{boot} {ticks}"


def write_manifest(run: RunFolder, content: Manifest) -> None:
    """Write the manifest; call it last, because a folder with a manifest is a finished run."""
    stored = content if isinstance(content, MergedManifest) else content.with_files(run.relative)
    write_text(run.file(MANIFEST), strict_json(stored.as_json()) + "\n")


def write_timings(run: RunFolder, content: Timings) -> None:
    """Write ``timings.json``; the manifest has no times, so that the same input has the same."""
    write_text(run.file(TIMINGS), strict_json(content.as_json()) + "\n")


def write_input(run: RunFolder, content: Mapping[str, object]) -> None:
    """Write the inputs of a run to ``input.json``."""
    whole = {"format_version": FORMAT_VERSION, **content}
    write_text(run.file(INPUT), strict_json(whole) + "\n")

"""Partial files: written in the final folder, held by a lock, and removed when abandoned.

Every writer of crosscue writes a file with a temporary name in the final folder and renames it when
it is complete. Meanwhile its process holds a lock (``flock``) on the file, which the kernel
releases when the process exits for any reason. The next writer in that folder removes the files
that are not locked. A process number would not suffice, because the system reuses it.
"""

import errno
import fcntl
import os
import re
import secrets
import shutil
import stat
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, Final

PARTIAL: Final = ".partial"
# Max bytes of the final name in the temporary name, which file systems limit in length.
NAME_BYTES: Final = 200
# Min time between sweeps of a folder, because a process may write thousands of files.
SWEEP_S: Final = 1.0
# Errors of file systems that do not support locks.
WITHOUT_LOCKS: Final = frozenset({errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL})
SCRATCH: Final = "crosscue-scratch-"

_OURS: Final = re.compile(r"\..*\.crosscue-[0-9a-f]{16}\.partial", re.DOTALL)
_swept_s: dict[Path, float] = {}


def is_partial(name: str) -> bool:
    """Return whether this is the name of a partial file of crosscue."""
    return _OURS.fullmatch(name) is not None


class PartialFile:
    """A file that is being written; ``keep`` renames it to its final name, ``drop`` removes it.

    Write to ``path`` in place, because a file that replaces it would not be locked.
    """

    def __init__(self, final: Path) -> None:
        """Sweep the folder, then create an empty file in it.

        Raises:
            OSError: The folder does not exist or cannot be written.
        """
        self.final: Final = final
        sweep(final.parent)
        name = os.fsdecode(os.fsencode(final.name)[:NAME_BYTES])
        while True:
            self.path = final.with_name(f".{name}.crosscue-{secrets.token_hex(8)}{PARTIAL}")
            self._hold = os.open(self.path, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666)
            try:
                # Another process may have removed it before it was locked.
                if lock(self._hold) is not False and is_still(self._hold, self.path):
                    return
            except BaseException:
                self.drop()
                raise
            os.close(self._hold)

    def open(self) -> BinaryIO:
        """Return the empty file, to be written and closed before ``keep``."""
        return os.fdopen(self._hold, "wb", closefd=False)

    def keep(self) -> None:
        """Flush the file to the disk and rename it to its final name.

        Raises:
            OSError: Flushing or renaming failed; the file remains under its temporary name.
        """
        sync(self.path)
        self.path.replace(self.final)
        self._release()
        sync(self.final.parent)

    def drop(self) -> None:
        """Remove the file; errors are ignored in favour of the error that led here."""
        with suppress(OSError):
            self.path.unlink(missing_ok=True)
        self._release()

    def _release(self) -> None:
        hold, self._hold = self._hold, -1
        if hold >= 0:
            os.close(hold)


def sweep(folder: Path, *, again: bool = False) -> None:
    """Remove partial files of crosscue in ``folder`` that no running process holds.

    Args:
        folder: Folder to sweep, without its subfolders.
        again: Sweep even if the folder was swept a moment ago.
    """
    now = time.monotonic()
    if not again and now - _swept_s.get(folder, -SWEEP_S) < SWEEP_S:
        return
    _swept_s[folder] = now
    with suppress(OSError):
        for entry in list(os.scandir(folder)):
            if is_partial(entry.name) and _is_abandoned(Path(entry.path), stat.S_ISREG):
                with suppress(OSError):
                    os.unlink(entry.path)  # noqa: PTH108 (names need not be text)


class Scratch:
    """Folder for temporary files, removed on exit; folders of killed processes are removed too."""

    def __init__(self) -> None:
        """Sweep, then create a folder.

        Raises:
            OSError: No folder can be created.
        """
        for entry in Path(tempfile.gettempdir()).glob(f"{SCRATCH}*"):
            if _is_abandoned(entry, stat.S_ISDIR):
                shutil.rmtree(entry, ignore_errors=True)
        while True:
            self.path = Path(tempfile.mkdtemp(prefix=SCRATCH))
            self._hold = os.open(self.path, os.O_RDONLY)
            if lock(self._hold) is not False and is_still(self._hold, self.path):
                return
            os.close(self._hold)

    def close(self) -> None:
        """Remove the folder and its contents."""
        shutil.rmtree(self.path, ignore_errors=True)
        with suppress(OSError):
            os.close(self._hold)

    def __enter__(self) -> Path:
        return self.path

    def __exit__(self, *failure: object) -> None:
        self.close()


def _is_abandoned(path: Path, is_kind: Callable[[int], bool]) -> bool:
    """Return whether no process holds it; False if that is unknown."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return False
    try:
        found = os.fstat(handle)
        is_ours = is_kind(found.st_mode) and found.st_uid == os.geteuid()
        return is_ours and lock(handle) is True
    except OSError:
        return False
    finally:
        os.close(handle)


def lock(handle: int) -> bool | None:
    """Lock an open file for this process: False if another holds it, None if that is unknown.

    Raises:
        OSError: Locking failed for another reason.
    """
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in WITHOUT_LOCKS:
            raise
        return None
    return True


def is_still(handle: int, path: Path) -> bool:
    """Return whether the open file is still the one at this path."""
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except FileNotFoundError:
        return False


def sync(path: Path) -> None:
    """Flush a file's bytes, or the names in a folder, to the disk.

    Raises:
        OSError: It does not exist, or flushing failed.
    """
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)

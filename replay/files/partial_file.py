"""Files on their way: written beside their final place, held by a lock, swept when abandoned.

Every writer of crosscue fills a file with a temporary name in the final folder and renames it when
it is whole. While a process works on one it holds a lock (``flock``) on the file itself, which the
kernel drops when the process dies, however that happens. Whoever writes next in that folder takes
away what nobody holds. A process number would not do: the system reuses it for another program.
"""

from __future__ import annotations

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
NAME_BYTES: Final = 200
"""Kept of the final name, so that the temporary one is not too long for the file system."""
SWEEP_S: Final = 1.0
"""A folder is not swept again within this time: some get thousands of files from one process."""
WITHOUT_LOCKS: Final = frozenset({errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL})
"""What file systems answer that cannot lock."""
SCRATCH: Final = "crosscue-scratch-"

_OURS: Final = re.compile(r"\..*\.crosscue-[0-9a-f]{16}\.partial", re.DOTALL)
_swept_s: dict[Path, float] = {}


def is_partial(name: str) -> bool:
    """Is this the name of a file that crosscue has begun and not finished?"""
    return _OURS.fullmatch(name) is not None


class PartialFile:
    """One file being written; ``keep`` gives it its final name, ``drop`` takes it away.

    Write to ``path``, in place: another file put there under its name would not be held.
    """

    def __init__(self, final: Path) -> None:
        """Sweep the folder, then begin an empty file in it.

        Raises:
            OSError: The folder is not there or cannot be written.
        """
        self.final: Final = final
        sweep(final.parent)
        name = os.fsdecode(os.fsencode(final.name)[:NAME_BYTES])
        while True:
            self.path = final.with_name(f".{name}.crosscue-{secrets.token_hex(8)}{PARTIAL}")
            self._hold = os.open(self.path, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666)
            try:
                # Another process may have swept it away before it was locked.
                if lock(self._hold) is not False and is_still(self._hold, self.path):
                    return
            except BaseException:
                self.drop()
                raise
            os.close(self._hold)

    def open(self) -> BinaryIO:
        """The file itself, empty, to be written and closed before ``keep``."""
        return os.fdopen(self._hold, "wb", closefd=False)

    def keep(self) -> None:
        """Have its bytes on the disk and give it its final name.

        Raises:
            OSError: The disk cannot; the file is still there under its temporary name.
        """
        sync(self.path)
        self.path.replace(self.final)
        self._release()
        sync(self.final.parent)

    def drop(self) -> None:
        """Take it away; the error that led here matters more than one of this."""
        with suppress(OSError):
            self.path.unlink(missing_ok=True)
        self._release()

    def _release(self) -> None:
        hold, self._hold = self._hold, -1
        if hold >= 0:
            os.close(hold)


def sweep(folder: Path, *, again: bool = False) -> None:
    """Take away files that crosscue began in ``folder`` and that no living process holds.

    Args:
        folder: Looked into, but not below.
        again: Also if it was swept a moment ago.
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
    """A folder for temporary files, removed when closed; those of killed processes are, too."""

    def __init__(self) -> None:
        """Sweep, then make one.

        Raises:
            OSError: There is no place for one.
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
        """Remove it with all that is in it."""
        shutil.rmtree(self.path, ignore_errors=True)
        with suppress(OSError):
            os.close(self._hold)

    def __enter__(self) -> Path:
        return self.path

    def __exit__(self, *failure: object) -> None:
        self.close()


def _is_abandoned(path: Path, is_kind: Callable[[int], bool]) -> bool:
    """Does no process hold it? False, too, where that cannot be known."""
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
    """Lock an open file for this process: False if another holds it, None if that is not known.

    Raises:
        OSError: Anything else went wrong.
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
    """Is the open file the one that has this name now?"""
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except FileNotFoundError:
        return False


def sync(path: Path) -> None:
    """Have a file's bytes, or the names in a folder, on the disk itself.

    Raises:
        OSError: Not there, or the disk cannot.
    """
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)

"""The door of crosscue's own files: those of a run, a batch, a catalog, a cache, and seals.

Whoever can write into a folder could plant a link, a FIFO or a huge file under a name that crosscue
reads or writes. All are refused here: only a regular file is opened, never through a link and
without waiting, and reading stops at a limit. New files are written by ``whole_file``, which
replaces a name instead of opening it.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Final

from crosscue.replay.errors import UsageError

from .bounded import read_pieces, too_large

if TYPE_CHECKING:
    import pyarrow as pa

# Max size of files such as tags, failure logs and entries of a journal.
SMALL_BYTES: Final = 16 << 20
_LINK: Final = "a link, which is not followed here; delete it, or put the file in its place"
_SPECIAL: Final = "not a regular file; delete it"


def user_cache(variable: str) -> Path:
    """The user's cache folder for crosscue, below ``$XDG_CACHE_HOME``.

    Args:
        variable: Environment variable that can name another folder, for the error message.

    Raises:
        UsageError: The user has no home folder.
    """
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    try:
        base = base if base.is_absolute() else Path.home() / ".cache"
    except RuntimeError:
        raise UsageError(
            f"no home folder for the cache; name another folder in the variable {variable}"
        ) from None
    return base / "crosscue"


def inside(folder: Path, name: str) -> Path:
    """Return the path of a file or folder of ours below ``folder``, refusing links on the way.

    Raises:
        OSError: The name leads out of the folder, or a part of it is a link.
    """
    path, parts = folder, PurePosixPath(name).parts
    if not parts or ".." in parts or PurePosixPath(name).is_absolute():
        raise OSError(errno.EINVAL, f"{name!r} leads out of the folder", str(folder))
    for part in parts:
        path /= part
        if path.is_symlink():
            raise OSError(errno.ELOOP, _LINK, str(path))
    return path


def opened(path: Path, flags: int = os.O_RDONLY) -> int:
    """Open a file of ours and return its descriptor.

    Raises:
        OSError: It is missing, a link, not a regular file, or not permitted.
    """
    safe = flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        handle = os.open(path, safe, 0o644)
    except OSError as error:
        why = {errno.ELOOP: _LINK, errno.ENXIO: _SPECIAL}.get(error.errno or 0)
        raise error if why is None else OSError(error.errno, why, str(path)) from None
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(errno.EINVAL, _SPECIAL, str(path))
    return handle


def read(path: Path, max_bytes: int = SMALL_BYTES) -> bytes:
    """Return the content of a file of ours.

    Raises:
        OSError: As for ``opened``, or it is larger than ``max_bytes``.
    """
    with os.fdopen(opened(path), "rb") as file:
        content = read_pieces(file, max_bytes)
    if content is None:
        raise too_large(path, max_bytes)
    return content


def arrow_file(path: Path) -> pa.NativeFile:
    """Open a file of ours for pyarrow.

    When pyarrow reads ahead through a Python file, its threads release Python's memory at any time.
    After the interpreter has exited, this aborts the process ("terminate called without an active
    exception"), although all output is correct. So it opens the descriptor again itself.

    Raises:
        OSError: As for ``opened``.
    """
    import pyarrow as pa

    handle = opened(path)
    try:
        return pa.OSFile(f"/dev/fd/{handle}")
    finally:
        os.close(handle)

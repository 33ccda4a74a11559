"""Write files atomically, and compute hashes of files.

A file is written under a temporary name in the same folder, flushed to the disk, and then renamed,
so that a file with the final name is always complete.
"""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final

from crosscue.replay.errors import OutputError

from .partial_file import PartialFile
from .tree_text import valid_text

if TYPE_CHECKING:
    import pyarrow as pa

# Size up to which a table is written without compression.
SMALL_TABLE_BYTES: Final = 64 << 10


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Call ``write`` on a temporary file, then rename it to its final name.

    Raises:
        OutputError: The disk is full or the folder cannot be written; no partial file remains.
    """
    partial: PartialFile | None = None
    try:
        if not path.parent.is_dir():
            path.parent.mkdir(parents=True, exist_ok=True)
        partial = PartialFile(path)
        write(partial.path)
        partial.keep()
    except OSError as error:
        if partial is not None:
            partial.drop()
        raise cannot_write(path, error) from None
    except BaseException:
        if partial is not None:
            partial.drop()
        raise


def cannot_write(path: Path, error: OSError) -> OutputError:
    """Return the error to raise when writing ``path`` failed with ``error``."""
    if error.errno == errno.ENOSPC:
        try:
            free = shutil.disk_usage(path.parent).free // (1 << 20)
        except OSError:
            free = 0
        return OutputError(f"{path}: the disk is full ({free} MiB free); make room and run again")
    return OutputError(f"{path}: {error.strerror or error}; choose a writable folder")


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file atomically."""
    write_whole(path, lambda partial: partial.write_bytes(content))


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    write_bytes(path, valid_text(text).encode("utf-8"))


def write_table(path: Path, table: pa.Table) -> None:
    """Write a table atomically, with page checksums.

    Raises:
        OutputError: The file cannot be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    def write(partial: Path) -> None:
        with pa.OSFile(os.fsencode(partial), "wb") as file:
            # Preparing to inflate each column takes longer than reading a few rows.
            compression = "zstd" if table.nbytes > SMALL_TABLE_BYTES else "none"
            pq.write_table(table, file, compression=compression, write_page_checksum=True)

    write_whole(path, write)


def sha256_of(path: Path) -> dict[str, str]:
    """Return the SHA-256 of a file, or of every file below a folder, by relative name.

    Raises:
        OSError: A file cannot be read.
    """
    if path.is_file():
        return {path.name: file_sha256(path)}
    files = sorted(entry for entry in path.rglob("*") if entry.is_file())
    return {entry.relative_to(path).as_posix(): file_sha256(entry) for entry in files}


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of one file, in hexadecimal.

    Raises:
        OSError: It cannot be read.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()

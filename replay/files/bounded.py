"""Read complete files up to a max size, because a device or a pipe may be endless."""

import errno
import os
from pathlib import Path
from typing import IO, Final

PIECE_BYTES: Final = 1 << 20


def read_at_most(path: Path, max_bytes: int) -> bytes | None:
    """Return the content of a file, or None if it is larger than ``max_bytes``.

    The reported size of the file is not trusted, because that of a device or a pipe is 0.

    Raises:
        OSError: The file cannot be read.
    """
    with path.open("rb") as file:
        return read_pieces(file, max_bytes)


def read_whole(path: Path, max_bytes: int) -> bytes:
    """Return the content of a file.

    Raises:
        OSError: The file cannot be read, or is larger than ``max_bytes``.
    """
    content = read_at_most(path, max_bytes)
    if content is None:
        raise too_large(path, max_bytes)
    return content


def too_large(path: Path, max_bytes: int) -> OSError:
    """Return the error of a file that is larger than ``max_bytes``."""
    return OSError(errno.EFBIG, f"over {max_bytes / (1 << 20):g} MiB", str(path))


def read_pieces(file: IO[bytes], max_bytes: int) -> bytes | None:
    """Return the rest of an open file, or None if it is larger than ``max_bytes``.

    Memory is allocated for the content, not for the limit.
    """
    size = os.fstat(file.fileno()).st_size
    if size > max_bytes:
        return None
    # A file with a correct size is read in one piece, which avoids a copy.
    pieces = [file.read(size)]
    room = max_bytes - len(pieces[0])
    while piece := file.read(min(PIECE_BYTES, room + 1)):
        room -= len(piece)
        if room < 0:
            return None
        pieces.append(piece)
    return b"".join(pieces)


def read_text(
    path: Path, max_bytes: int, refused: type[Exception], remedy: str, errors: str = "strict"
) -> str:
    """Return the text of a file in UTF-8.

    Args:
        path: The file.
        max_bytes: Max size of the file.
        refused: Error that is raised if the file cannot be read, is larger, or is not UTF-8.
        remedy: End of its message: what was expected, or what to do.
        errors: How bytes that are not UTF-8 are decoded.
    """
    try:
        return read_whole(path, max_bytes).decode("utf-8", errors)
    except OSError as error:
        raise refused(f"{path}: {error.strerror or error}; {remedy}") from None
    except UnicodeDecodeError:
        raise refused(f"{path}: not UTF-8 text; {remedy}") from None

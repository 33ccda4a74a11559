"""Read complete files up to a max size, because a device or a pipe may be endless."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

PIECE_BYTES: Final = 1 << 20


def read_at_most(path: Path, max_bytes: int) -> bytes | None:
    """Return the content of a file, or None if it is larger than ``max_bytes``.

    The reported size of the file is not trusted, because that of a device or a pipe is 0.

    Raises:
        OSError: The file cannot be read.
    """
    pieces, room = [], max_bytes
    with path.open("rb") as file:
        # A file with a correct size is read in one piece, which avoids a copy.
        step = max(PIECE_BYTES, os.fstat(file.fileno()).st_size)
        while piece := file.read(min(step, room + 1)):
            room -= len(piece)
            if room < 0:
                return None
            pieces.append(piece)
    return b"".join(pieces)

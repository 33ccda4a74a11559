"""Files read whole, but never more of them than is sensible: a device or a pipe may have no end."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

PIECE_BYTES: Final = 1 << 20


def read_at_most(path: Path, max_bytes: int) -> bytes | None:
    """What a file holds, or None when that is more than ``max_bytes``.

    Its size is not believed: that of a device or a pipe is 0.

    Raises:
        OSError: It cannot be read.
    """
    pieces, room = [], max_bytes
    with path.open("rb") as file:
        # A file with an honest size comes in one piece, which is then not copied.
        step = max(PIECE_BYTES, os.fstat(file.fileno()).st_size)
        while piece := file.read(min(step, room + 1)):
            room -= len(piece)
            if room < 0:
                return None
            pieces.append(piece)
    return b"".join(pieces)

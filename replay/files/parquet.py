"""Opening Parquet files for reading."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    import pyarrow as pa


def opened(path: Path) -> pa.NativeFile:
    """A file for pyarrow to read, opened by pyarrow itself.

    What pyarrow reads ahead through one of Python's files is Python's memory, and its threads give
    it back whenever they come round to it: after the interpreter has gone, that aborts the process
    ("terminate called without an active exception") although all it wrote is right.

    Raises:
        OSError: Not there, not a file, not readable.
    """
    import pyarrow as pa

    # As bytes: a name may hold what is no UTF-8.
    return pa.OSFile(os.fsencode(path))

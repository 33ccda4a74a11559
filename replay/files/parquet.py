"""Open Parquet files for reading."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    import pyarrow as pa


def opened(path: Path) -> pa.NativeFile:
    """Open a file with pyarrow for pyarrow to read.

    When pyarrow reads ahead through a Python file, its threads release Python's memory at any time.
    After the interpreter has exited, this aborts the process ("terminate called without an active
    exception"), although all output is correct.

    Raises:
        OSError: It does not exist, is not a file or is not readable.
    """
    import pyarrow as pa

    # As bytes, because a name may not be UTF-8.
    return pa.OSFile(os.fsencode(path))

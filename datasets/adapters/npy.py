"""Read complete or truncated .npy files of NumPy, without pickle or trust in their header."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from crosscue.replay.errors import LogFormatError


@dataclass(frozen=True, slots=True, eq=False)
class ArrayColumn:
    """The readable rows of one array file.

    Attributes:
        path: Path of the file.
        rows: Complete rows, shape (N, ...); mapped from the file if its layout allows.
        declared: Number of rows declared in the header.
    """

    path: Path
    rows: NDArray[np.generic]
    declared: int

    @property
    def missing(self) -> int:
        """Number of missing rows."""
        return self.declared - len(self.rows)


def read_column(path: Path) -> ArrayColumn:
    """Map an array file, or the complete rows of a truncated file.

    Raises:
        LogFormatError: The file is not an .npy file, or contains Python objects.
    """
    try:
        with path.open("rb") as file:
            version = npy_format.read_magic(file)
            if version == (1, 0):
                shape, by_columns, dtype = npy_format.read_array_header_1_0(file)
            elif version == (2, 0):
                shape, by_columns, dtype = npy_format.read_array_header_2_0(file)
            else:
                raise ValueError(f"version {version}")
            offset = file.tell()
    except (ValueError, UnicodeDecodeError, SyntaxError, TypeError, EOFError) as error:
        raise LogFormatError(f"{path}: not a NumPy array file ({error}); copy it again") from None
    if dtype.hasobject or not shape or dtype.itemsize == 0 or any(side < 0 for side in shape):
        raise LogFormatError(f"{path}: expected an array of plain numbers, got {dtype} {shape}")
    width = int(np.prod(shape[1:], dtype=np.int64))
    cells = max(0, path.stat().st_size - offset) // dtype.itemsize
    present = min(shape[0], cells // width if width else 0)
    if by_columns and len(shape) > 1:
        # In column-major order, a row is complete only if the last column contains it.
        present = max(0, min(shape[0], cells - (width - 1) * shape[0]))
    if present == 0:
        return ArrayColumn(path, np.empty((0, *shape[1:]), dtype), shape[0])
    if by_columns and len(shape) > 1:
        flat = np.memmap(path, dtype, "r", offset, ((width - 1) * shape[0] + present,))
        by_column = [flat[i * shape[0] : i * shape[0] + present] for i in range(width)]
        return ArrayColumn(path, np.stack(by_column, axis=1).reshape(present, *shape[1:]), shape[0])
    mapped = np.memmap(path, dtype, "r", offset, (present, *shape[1:]))
    return ArrayColumn(path, mapped, shape[0])

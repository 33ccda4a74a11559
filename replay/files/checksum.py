"""CRC-32 (that of zip, PNG and MCAP), by the fastest way that is installed.

``isal`` computes it about ten times as fast as most builds of zlib, which matters where every byte
of a log is verified; without it the result is the same, later.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray


def _fastest() -> Callable[[bytes | memoryview | NDArray[np.uint8], int], int]:
    for module in ("isal.isal_zlib", "zlib"):
        try:
            found = import_module(module).crc32
        except ImportError:
            continue
        return cast("Callable[[bytes | memoryview | NDArray[np.uint8], int], int]", found)
    raise AssertionError("zlib belongs to Python")


_crc32: Final = _fastest()


def crc32(content: bytes | memoryview | NDArray[np.uint8], value: int = 0) -> int:
    """CRC-32 of ``content`` that follows on bytes whose CRC-32 is ``value``."""
    return _crc32(content, value)

"""CRC-32 of zip, PNG and MCAP, computed by the fastest installed library.

``isal`` is about ten times as fast as most builds of zlib, which matters where every byte of a log
is verified. The result is the same without it.
"""

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
    """Return the CRC-32 of ``content`` after bytes whose CRC-32 is ``value``."""
    return _crc32(content, value)

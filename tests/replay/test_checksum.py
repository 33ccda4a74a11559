"""CRC-32: every library computes the value of zlib."""

from __future__ import annotations

import importlib
import sys
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.replay.files import checksum


@given(st.binary(max_size=9000), st.binary(max_size=300))
def test_crc32_equals_zlib_in_one_or_two_pieces(first: bytes, second: bytes) -> None:
    expected = zlib.crc32(first + second)
    assert checksum.crc32(first + second) == expected
    assert checksum.crc32(memoryview(second), checksum.crc32(first)) == expected
    assert checksum.crc32(np.frombuffer(first, np.uint8)) == zlib.crc32(first)


def test_zlib_is_used_without_isal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "isal.isal_zlib", None)
    try:
        importlib.reload(checksum)
        assert checksum._crc32 is zlib.crc32
        assert checksum.crc32(b"123456789") == 0xCBF43926
    finally:
        monkeypatch.undo()
        importlib.reload(checksum)

"""The MCAP project's 416 conformance files: exact messages, with the summary and without."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import pytest

from support.mcap_conformance import Conformance, load
from support.mcap_files import MAGIC, read_back, record

FOLDER = os.environ.get("MCAP_CONFORMANCE", "")
SUITE_SIZE = 416


@pytest.fixture(scope="module")
def suite() -> list[Conformance]:
    if not FOLDER:
        pytest.skip("set MCAP_CONFORMANCE to the folder tests/conformance/data of foxglove/mcap")
    return [load(path) for path in sorted(Path(FOLDER).rglob("*.json"))]


def without_summary(coded: bytes) -> bytes:
    """Return the file up to its data end record, with an empty summary."""
    footer_at = len(coded) - 8 - 29
    summary_at = struct.unpack_from("<Q", coded, footer_at + 9)[0] or footer_at
    return coded[:summary_at] + record(2, struct.pack("<QQI", 0, 0, 0)) + MAGIC


def test_suite_has_all_files(suite: list[Conformance]) -> None:
    assert len(suite) == SUITE_SIZE
    assert all(file.is_exact for file in suite)


@pytest.mark.parametrize("has_summary", [True, False], ids=["with summary", "without summary"])
def test_every_file_yields_exactly_its_messages(
    suite: list[Conformance], has_summary: bool, tmp_path: Path
) -> None:
    path = tmp_path / "file.mcap"
    wrong: list[str] = []
    for file in suite:
        path.write_bytes(file.coded if has_summary else without_summary(file.coded))
        reading = read_back(path)
        is_right = reading.messages == file.messages
        is_listed = set(file.messages) <= set(reading.names)
        if not (is_right and is_listed and reading.ledger.is_whole and reading.adds_up()):
            wrong.append(file.name)

    assert wrong == []

"""The MCAP project's 416 conformance files, and 416 with a ROS 2 type: exact messages.

Each is read whole, and with its summary cut off: once closed by an empty footer, and once ending
inside the summary, as after a crash.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import pytest

from support.mcap_conformance import Conformance, suite
from support.mcap_files import MAGIC, read_back, record

# The only notice about a valid file, and only about one without a summary.
ALLOWED = "it has no usable summary; topics were found by reading"


@pytest.fixture(scope="module")
def files() -> list[Conformance]:
    return list(suite())


def _summary_at(coded: bytes) -> int:
    footer_at = len(coded) - 8 - 29
    return int(struct.unpack_from("<Q", coded, footer_at + 9)[0]) or footer_at


def without_summary(coded: bytes) -> bytes:
    """Return the file up to its data end record, with an empty summary."""
    empty = record(2, struct.pack("<QQI", 0, 0, 0))
    return coded[: _summary_at(coded)] + empty + MAGIC


def cut_off(coded: bytes) -> bytes:
    """Return the file up to its data end record."""
    return coded[: _summary_at(coded)]


def _fault(file: Conformance, path: Path, is_cut: bool) -> str:
    """Return what was read wrong, or an empty string."""
    reading = read_back(path)
    types = {topic: file.types.get(topic) for topic in reading.names}
    losses = [(one.reason, one.count) for one in reading.ledger.details]
    notices = [one for one in reading.ledger.notices if one != ALLOWED]
    if reading.messages != file.messages:
        return f"{reading.names}: {reading.count()} messages"
    if types != file.types:
        return f"topics {types}"
    if losses != ([("the file does not end as it should", None)] if is_cut else []):
        return f"losses {losses}"
    return "" if not notices and reading.adds_up() else f"notices {notices}"


FORMS: dict[str, Callable[[bytes], bytes]] = {
    "whole": bytes,
    "without summary": without_summary,
    "cut off": cut_off,
}


@pytest.mark.parametrize("form", FORMS)
def test_every_file_yields_exactly_its_topics_and_messages(
    files: list[Conformance], form: str, tmp_path: Path
) -> None:
    change = FORMS[form]
    path = tmp_path / "file.mcap"
    faults = {}
    for file in files:
        path.write_bytes(change(file.coded))
        fault = _fault(file, path, is_cut=form == "cut off")
        if fault:
            faults[file.name] = fault

    assert faults == {}, f"{len(faults)} of {len(files)}"

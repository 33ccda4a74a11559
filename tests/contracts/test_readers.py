"""Every reader keeps the contract of ``crosscue.testing.check_reader``, and one row is one row."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import pytest

from crosscue.replay.formats import FORMATS
from crosscue.testing import check_reader
from support.every_format import EVERY_FORMAT
from support.one_row import ONE_ROW

WITHOUT_ROWS_OF_THEIR_OWN: Final = {
    "mf4": "records have a fixed size and no mark or checksum: a damaged one cannot be reported",
    "comma2k19": "an .npy array has neither: a damaged number is another number",
    "kitti-raw": "a row is a line in each of several files",
    "video": "a damaged packet is found when it is decoded, and may take others with it",
}


def test_every_format_is_here() -> None:
    assert EVERY_FORMAT.keys() == FORMATS.keys()
    assert ONE_ROW.keys() | WITHOUT_ROWS_OF_THEIR_OWN.keys() == FORMATS.keys()


@pytest.mark.parametrize("name", sorted(EVERY_FORMAT))
def test_every_reader_keeps_the_contract(name: str, tmp_path: Path) -> None:
    check_reader(EVERY_FORMAT[name](tmp_path), is_in_order=name != "video")


@pytest.mark.parametrize("name", sorted(ONE_ROW))
def test_one_damaged_row_is_one_lost_row(name: str, tmp_path: Path) -> None:
    write, damage = ONE_ROW[name]

    check_reader(write(tmp_path), damage)

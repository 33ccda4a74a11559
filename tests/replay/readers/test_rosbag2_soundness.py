"""Our check of a .db3 file's structure: never less strict than SQLite's."""

from collections import Counter
from pathlib import Path

import pytest

from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.errors import CrosscueError
from crosscue.replay.readers.rosbag2 import db3
from support.db3_damage import SHAPES, copies, own_verdict, sqlite_verdict, write_shape
from support.rosbag_files import read_rows


@pytest.mark.parametrize("name", SHAPES)
def test_sound_file_of_a_recorder_is_not_given_to_sqlite(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    path = write_shape(tmp_path / "a.db3", SHAPES[name])
    asked: list[object] = []

    def problems(reading: object) -> str:
        asked.append(reading)
        return ""

    monkeypatch.setattr(db3._Pass, "_problems", problems)
    reading = read_rows(path, Selection(topics=frozenset({"/a", "/b"})))

    assert len(asked) == (not SHAPES[name].is_understood)
    assert "finds no fault" in reading.ledger.integrity


@pytest.mark.parametrize("name", SHAPES)
def test_no_copy_is_found_sound_in_which_sqlite_finds_a_fault(tmp_path: Path, name: str) -> None:
    path = write_shape(tmp_path / "a.db3", SHAPES[name])
    verdicts: Counter[tuple[bool | None, bool]] = Counter()
    for how, copy in copies(path.read_bytes(), 20, seed=5):
        path.write_bytes(copy)
        verdict = own_verdict(path), sqlite_verdict(path)
        verdicts[verdict] += 1
        assert verdict != (True, False), how

    assert verdicts[False, False] > 5


def test_file_cut_inside_a_long_row_is_not_sound(tmp_path: Path) -> None:
    for name in ("very long payloads", "deleted long payloads"):
        path = write_shape(tmp_path / "a.db3", SHAPES[name])
        intact = path.read_bytes()
        for pages in range(2, len(intact) // 512):
            # A header that agrees with the shorter file.
            copy = bytearray(intact[: 512 * pages])
            copy[28:32] = pages.to_bytes(4, "big")
            path.write_bytes(copy)
            assert not own_verdict(path), (name, pages)
        path.unlink()


def test_damaged_copies_are_read_as_after_sqlites_check(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("pages of 512", "long payloads", "without an index", "free pages"):
        path = write_shape(tmp_path / "a.db3", SHAPES[name])
        for how, copy in copies(path.read_bytes(), 30, seed=8):
            path.write_bytes(copy)
            ours = account(path)
            with monkeypatch.context() as patch:
                patch.setattr(db3, "soundness", lambda *_: None)
                assert account(path) == ours, (name, how)
        path.unlink()


def account(path: Path) -> object:
    """Return the rows and the complete account of a file."""
    try:
        reading = read_rows(path, EVERYTHING)
    except CrosscueError as error:
        return str(error)
    ledger = reading.ledger
    return reading.rows, ledger.accounts, ledger.notices, ledger.integrity, tuple(ledger.drops())

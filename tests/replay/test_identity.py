"""The identity of a log: unique, independent of its path, and fast for a large log."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

import pytest

from crosscue.replay.errors import LogError
from crosscue.replay.files.identity import SHARE_BYTES, identity_of_all, log_identity

LARGE: int = 3 * SHARE_BYTES
# Position between the last sample and the tail, where only an index is hashed.
BEFORE_TAIL: int = LARGE - SHARE_BYTES // 4 - SHARE_BYTES // 64 - 3


def _log(path: Path, content: bytes | bytearray = b"rows") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


def test_identity_depends_on_name_but_not_folder_or_age(tmp_path: Path) -> None:
    first = _log(tmp_path / "a" / "drive.mcap")
    second = _log(tmp_path / "b" / "drive.mcap")
    os.utime(second, (0, 0))

    assert log_identity(first) == log_identity(second) == log_identity(str(first))
    assert log_identity(first).digest != log_identity(_log(tmp_path / "other.mcap")).digest


@pytest.mark.parametrize("at", [0, 1, SHARE_BYTES // 3, SHARE_BYTES // 2 + 7, SHARE_BYTES - 1])
def test_any_byte_of_a_small_log_changes_identity(tmp_path: Path, at: int) -> None:
    content = bytearray(SHARE_BYTES)
    before = log_identity(_log(tmp_path / "a.mcap", content))
    content[at] ^= 1

    assert log_identity(_log(tmp_path / "a.mcap", content)).digest != before.digest


@pytest.mark.parametrize(
    "at", [0, SHARE_BYTES // 4 - 1, LARGE - 1, LARGE - SHARE_BYTES // 4, SHARE_BYTES // 4 + 1]
)
def test_head_tail_and_samples_of_large_log_change_identity(tmp_path: Path, at: int) -> None:
    content = bytearray(LARGE)
    before = log_identity(_log(tmp_path / "a.mcap", content))
    content[at] ^= 1

    assert log_identity(_log(tmp_path / "a.mcap", content)).digest != before.digest
    assert log_identity(_log(tmp_path / "a.mcap", content + b"x")).digest != before.digest


def _with_index(kind: str, start: int) -> bytearray:
    """Return a large file of zeros, whose header or footer places the index at ``start``."""
    content = bytearray(LARGE)
    if kind == "mcap":
        content[:8] = b"\x89MCAP0\r\n"
        footer = bytes([2]) + (20).to_bytes(8, "little") + start.to_bytes(8, "little")
        content[-37:] = footer + bytes(12) + b"\x89MCAP0\r\n"
    else:
        head = b"#ROSBAG V2.0\n" + (0).to_bytes(4, "little") + b"index_pos="
        content[: len(head) + 8] = head + start.to_bytes(8, "little")
    return content


@pytest.mark.parametrize("kind", ["mcap", "bag"])
def test_any_index_byte_of_large_log_changes_identity(tmp_path: Path, kind: str) -> None:
    for start, counts in ((BEFORE_TAIL - 10, True), (BEFORE_TAIL + 1, False)):
        content = _with_index(kind, start)
        before = log_identity(_log(tmp_path / f"a.{kind}", content))
        content[BEFORE_TAIL] ^= 1
        assert (log_identity(_log(tmp_path / f"a.{kind}", content)) != before) is counts


@pytest.mark.parametrize("start", [0, 1 << 63, LARGE * 2])
def test_identity_ignores_invalid_index_position(tmp_path: Path, start: int) -> None:
    for kind in ("mcap", "bag"):
        content = _with_index(kind, start)
        before = log_identity(_log(tmp_path / f"a.{kind}", content))
        content[BEFORE_TAIL] ^= 1
        assert log_identity(_log(tmp_path / f"a.{kind}", content)) == before


def test_folder_identity_covers_all_files_except_our_own(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "images"
    for i in range(5):
        _log(folder / f"{i}.png", bytes([i]))
    _log(folder / "deep" / "x.png")
    before = log_identity(folder)

    for name in ("truth.json", "vehicle.toml", ".DS_Store", "x.seal"):
        _log(folder / name)
    assert log_identity(folder) == before
    assert log_identity(shutil.copytree(folder, tmp_path / "b" / "images")) == before

    changed = []
    for change in (
        lambda: _log(folder / "deep" / "x.png", b"other"),
        lambda: (folder / "4.png").rename(folder / "5.png"),
        lambda: (folder / "3.png").unlink(),
        lambda: _log(folder.with_name("images.csv"), b"0.1"),
    ):
        change()
        changed.append(log_identity(folder).digest)
    assert len({before.digest, *changed}) == 5


def test_companion_files_change_identity(tmp_path: Path) -> None:
    for log, companion in (
        ("a.db3", "a.db3-wal"),
        ("b.db3", "b.db3-journal"),
        ("v.mp4", "v.csv"),
        ("v.mp4", "v.txt"),
    ):
        path = _log(tmp_path / log)
        before = log_identity(path)
        _log(tmp_path / companion, b"more")
        assert log_identity(path) != before


def test_drive_identity_is_independent_of_log_order(tmp_path: Path) -> None:
    logs = [log_identity(_log(tmp_path / name, name.encode())) for name in ("a.mcap", "b.blf")]

    assert identity_of_all(logs) == identity_of_all(logs[::-1])
    assert identity_of_all(logs[:1]) == logs[0]
    assert "a.mcap + b.blf" in str(identity_of_all(logs))


def test_identity_of_100_gib_log_is_fast(tmp_path: Path) -> None:
    path = tmp_path / "large.bag"
    with path.open("wb") as file:
        file.truncate(100 << 30)
    began = time.process_time()

    assert log_identity(path).size == 100 << 30
    assert time.process_time() - began < 5.0


def test_identity_of_missing_log_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="gone"):
        log_identity(tmp_path / "gone.mcap")

"""Identity of logs, checksums and versions."""

import shutil
import subprocess
from pathlib import Path

import pytest

from crosscue.replay.files.identity import SHARE_BYTES, log_identity
from crosscue.replay.versions import commit
from support.trees import written

LARGE: int = 3 * SHARE_BYTES
# Position between the last sample and the tail, where only an index is hashed.
BEFORE_TAIL: int = LARGE - SHARE_BYTES // 4 - SHARE_BYTES // 64 - 3


EDGE = SHARE_BYTES // 4
SMALL_AT = (0, 1, SHARE_BYTES // 3, SHARE_BYTES // 2 + 7, SHARE_BYTES - 1)
LARGE_AT = (0, EDGE - 1, LARGE - 1, LARGE - EDGE, EDGE + 1)


@pytest.mark.parametrize(
    ("size", "at"), [*((SHARE_BYTES, at) for at in SMALL_AT), *((LARGE, at) for at in LARGE_AT)]
)
def test_bytes_of_small_log_and_edges_and_samples_of_large_one_change_identity(
    tmp_path: Path, size: int, at: int
) -> None:
    content = bytearray(size)
    before = log_identity(written(tmp_path / "a.mcap", content))
    content[at] ^= 1

    assert log_identity(written(tmp_path / "a.mcap", content)).digest != before.digest
    assert log_identity(written(tmp_path / "a.mcap", content + b"x")).digest != before.digest


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
        before = log_identity(written(tmp_path / f"a.{kind}", content))
        content[BEFORE_TAIL] ^= 1
        assert (log_identity(written(tmp_path / f"a.{kind}", content)) != before) is counts


def test_folder_identity_covers_all_files_except_our_own(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "images"
    for i in range(5):
        written(folder / f"{i}.png", bytes([i]))
    written(folder / "deep" / "x.png", "rows")
    before = log_identity(folder)

    for name in ("truth.json", "vehicle.toml", ".DS_Store", "x.seal"):
        written(folder / name, "rows")
    assert log_identity(folder) == before
    assert log_identity(shutil.copytree(folder, tmp_path / "b" / "images")) == before

    changed = []
    for change in (
        lambda: written(folder / "deep" / "x.png", b"other"),
        lambda: (folder / "4.png").rename(folder / "5.png"),
        lambda: (folder / "3.png").unlink(),
        lambda: written(folder.with_name("images.csv"), b"0.1"),
    ):
        change()
        changed.append(log_identity(folder).digest)
    assert len({before.digest, *changed}) == 5


def _git(folder: Path, *words: str) -> str:
    """Run git without user settings, and return its output."""
    identity = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "init.defaultBranch=main"]
    command = ["git", *identity, *words]
    return subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Create a repository with one commit."""
    folder = tmp_path_factory.mktemp("checkout")
    _git(folder, "init")
    _git(folder, "commit", "--allow-empty", "-m", "first")
    return folder


def test_commit_equals_git_head(checkout: Path) -> None:
    head = _git(checkout, "rev-parse", "HEAD").strip()

    assert commit(checkout) == head
    _git(checkout, "pack-refs", "--all")
    commit.cache_clear()
    assert commit(checkout) == head
    _git(checkout, "worktree", "add", "-b", "other", "../worktree")
    assert commit(checkout.parent / "worktree") == head
    _git(checkout, "checkout", "--detach")
    commit.cache_clear()
    assert commit(checkout) == head

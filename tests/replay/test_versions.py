"""Versions and the commit of crosscue."""

import subprocess
from pathlib import Path

import pytest

from crosscue.replay.versions import commit


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

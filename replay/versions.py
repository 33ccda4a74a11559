"""Versions of what is installed, for manifests, model cards and ``crosscue --version``."""

from __future__ import annotations

import platform
import re
from functools import cache
from pathlib import Path


@cache
def installed(package: str) -> str:
    """The version of ``package``, or "unknown" where its metadata is missing or not readable."""
    from importlib.metadata import version  # 20 ms, which ``crosscue --help`` need not wait for

    try:
        return version(package)
    except ImportError:
        return "unknown"


def versions() -> dict[str, str]:
    """Of crosscue, Python and the libraries that results depend on."""
    libraries = ("crosscue", "numpy", "numba", "cantools", "rosbags", "mcap", "pyarrow")
    return {"python": platform.python_version(), **{name: installed(name) for name in libraries}}


def versions_and_commit() -> dict[str, str]:
    """The same for a manifest: with the commit of crosscue, where it is known.

    It is not part of ``versions``, which decide whether a run can be resumed.
    """
    found = commit(Path(__file__).resolve().parents[1])
    return versions() if found is None else {**versions(), "crosscue_commit": found}


@cache
def commit(folder: Path) -> str | None:
    """The commit that is checked out in ``folder``, or that crosscue was installed from.

    None for a release; uncommitted changes do not show.
    """
    try:
        text = _head(folder)
    except OSError:
        text = _installed_from()
    return text if re.fullmatch("[0-9a-f]{40,64}", text) else None


def _head(folder: Path) -> str:
    """What HEAD of a checkout is; its files are read, as git need not be installed."""
    git = folder / ".git"
    if git.is_file():
        # A worktree: its own folder is inside that of the repository.
        git = folder / git.read_text().removeprefix("gitdir:").strip()
    head = (git / "HEAD").read_text().strip()
    if not head.startswith("ref:"):
        return head
    name = head.removeprefix("ref:").strip()
    shared = git / "commondir"
    common = git / shared.read_text().strip() if shared.exists() else git
    for place in (git / name, common / name):
        if place.exists():
            return place.read_text().strip()
    packed = (common / "packed-refs").read_text().splitlines()
    return next((line.split()[0] for line in packed if line.endswith(f" {name}")), "")


def _installed_from() -> str:
    """The commit in what pip writes beside a package that it took from a repository."""
    from importlib.metadata import distribution

    from crosscue.replay.files.tree_text import json_tree  # not for ``--help``

    try:
        text = distribution("crosscue").read_text("direct_url.json") or "{}"
        return str(json_tree(text).get("vcs_info", {}).get("commit_id", ""))
    except (ImportError, OSError, ValueError, AttributeError):
        return ""

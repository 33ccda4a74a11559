"""Versions of installed packages, for manifests, model cards and ``crosscue --version``."""

import platform
import re
from functools import cache
from pathlib import Path


@cache
def installed(package: str) -> str:
    """Return the version of ``package``, or "unknown" if its metadata is missing or unreadable."""
    from importlib.metadata import version  # takes 20 ms, which would delay ``crosscue --help``

    try:
        return version(package)
    except ImportError:
        return "unknown"


def versions() -> dict[str, str]:
    """Return the versions of crosscue, Python and the libraries that results depend on."""
    libraries = ("crosscue", "numpy", "numba", "cantools", "rosbags", "mcap", "pyarrow")
    return {"python": platform.python_version(), **{name: installed(name) for name in libraries}}


def versions_and_commit() -> dict[str, str]:
    """Return ``versions`` and, where known, the commit of crosscue, for a manifest.

    The commit is not part of ``versions``, because those decide whether a run can be resumed.
    """
    found = commit(Path(__file__).resolve().parents[1])
    return versions() if found is None else {**versions(), "crosscue_commit": found}


@cache
def commit(folder: Path) -> str | None:
    """Return the commit that is checked out in ``folder``, or that crosscue was installed from.

    None for a release. Uncommitted changes are not detected.
    """
    try:
        text = _head(folder)
    except OSError:
        text = _installed_from()
    return text if re.fullmatch("[0-9a-f]{40,64}", text) else None


def _head(folder: Path) -> str:
    """Return the commit of a checkout's HEAD, read from its files because git may be missing."""
    git = folder / ".git"
    if git.is_file():
        # In a worktree, ``.git`` is a file with the path of the worktree's git folder.
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
    """Return the commit that pip records for a package installed from a repository."""
    from importlib.metadata import distribution

    from crosscue.replay.files.tree_text import json_tree  # not for ``--help``

    try:
        text = distribution("crosscue").read_text("direct_url.json") or "{}"
        return str(json_tree(text).get("vcs_info", {}).get("commit_id", ""))
    except (ImportError, OSError, ValueError, AttributeError):
        return ""

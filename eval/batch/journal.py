"""What becomes of each drive of a batch, in a file each beside the run folders.

An entry is written when a drive is begun and again when it ends. In between the worker touches it
every few seconds, so that anyone who sees the folder, on whatever machine, knows it is alive. The
time of an end is that of the file: it contains no clock.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

from crosscue.replay.base import json_tree, strict_json, write_text

JOURNAL: Final = ".drives"
PLANS: Final = "plans"
FORMAT_VERSION: Final = 2
BEAT_S: Final = 10.0
STALE_S: Final = 12.0 * BEAT_S
"""A worker of another machine that has been silent so long is taken for dead."""


def entry_path(run: Path) -> Path:
    """Where the entry of a drive with this run folder is."""
    return run.parent / JOURNAL / f"{run.name}.json"


def write_entry(run: Path, entry: dict[str, object]) -> None:
    """Write a drive's entry, whole."""
    write_text(entry_path(run), strict_json({"format_version": FORMAT_VERSION, **entry}) + "\n")


def read_entry(run: Path) -> dict[str, Any] | None:
    """A drive's entry; None where none exists, or none that can be believed."""
    try:
        entry = json_tree(entry_path(run).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    is_ours = isinstance(entry, dict) and entry.get("format_version") == FORMAT_VERSION
    return entry if is_ours and "inputs" in entry else None


def error_of(run: Path) -> str | None:
    """Why a drive has no run, where its last attempt failed."""
    entry = read_entry(run) or {}
    error = entry.get("error")
    return error if isinstance(error, str) else None


def has_journal(folder: Path) -> bool:
    """Has a batch of drives written into this folder of runs?"""
    return (folder / JOURNAL).is_dir()


def names_in(folder: Path) -> set[str]:
    """Of drives that have an entry in a folder of runs, or that a start there has planned."""
    journal = folder / JOURNAL
    planned = {name for path in journal.glob(f"{PLANS}/*.json") for name in _planned(path)}
    return planned | {path.stem for path in journal.glob("*.json")}


def _planned(path: Path) -> list[str]:
    try:
        tree = json_tree(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return []
    names = tree.get("drives") if isinstance(tree, dict) else None
    return [name for name in names if isinstance(name, str)] if isinstance(names, list) else []


def write_plan(folder: Path, names: Sequence[str], part: str) -> None:
    """Write down which drives a start is about to do; a later start of this part replaces it.

    Args:
        folder: The folder of run folders.
        names: Of the drives.
        part: ``all``, or which shard.
    """
    path = folder / JOURNAL / PLANS / f"{part.replace('/', '-of-')}.json"
    write_text(path, strict_json({"format_version": FORMAT_VERSION, "drives": [*names]}) + "\n")


def started_s(folder: Path) -> float | None:
    """When the first of the plans in a folder was written, in seconds since 1970."""
    times = []
    for path in folder.glob(f"{JOURNAL}/{PLANS}/*.json"):
        with suppress(OSError):
            times.append(path.stat().st_mtime)
    return min(times, default=None)


def silent_s(run: Path) -> float:
    """Seconds since a drive's entry was written or touched."""
    try:
        return max(0.0, time.time() - entry_path(run).stat().st_mtime)
    except OSError:
        return float("inf")


@contextmanager
def beating(run: Path) -> Iterator[None]:
    """Touch a drive's entry every ``BEAT_S`` while the block runs."""
    stop = threading.Event()

    def beat() -> None:
        while not stop.wait(BEAT_S):
            with suppress(OSError):
                os.utime(entry_path(run))

    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()

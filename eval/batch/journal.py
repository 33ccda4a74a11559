"""Journal of a batch: one file for each drive, next to the run folders.

An entry is written when a drive starts and again when it ends. In between, the worker touches the
file every few seconds, so that every machine that shares the folder can see that the worker is
alive. The end time of a drive is the modification time of its file; entries contain no time.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

from crosscue.replay.files import door
from crosscue.replay.files.tree_text import json_tree, strict_json
from crosscue.replay.files.whole_file import write_text

JOURNAL: Final = ".drives"
PLANS: Final = "plans"
FORMAT_VERSION: Final = 2
BEAT_S: Final = 10.0
# Silence after which a worker of another machine is considered dead, seconds.
STALE_S: Final = 12.0 * BEAT_S


def entry_path(run: Path) -> Path:
    """Return the path of the entry of the drive with this run folder."""
    return door.inside(run.parent, f"{JOURNAL}/{run.name}.json")


def write_entry(run: Path, entry: dict[str, object]) -> None:
    """Write a drive's entry atomically."""
    write_text(entry_path(run), strict_json({"format_version": FORMAT_VERSION, **entry}) + "\n")


def read_entry(run: Path) -> dict[str, Any] | None:
    """Return a drive's entry; None if it does not exist or is damaged."""
    try:
        entry = json_tree(door.read(entry_path(run)))
    except (OSError, ValueError):
        return None
    is_ours = isinstance(entry, dict) and entry.get("format_version") == FORMAT_VERSION
    return entry if is_ours and "inputs" in entry else None


def error_of(run: Path) -> str | None:
    """Return the error of a drive's last attempt, or None if that did not fail."""
    entry = read_entry(run) or {}
    error = entry.get("error")
    return error if isinstance(error, str) else None


def has_journal(folder: Path) -> bool:
    """Return whether a batch of drives has written to this folder of runs."""
    return (folder / JOURNAL).is_dir()


def names_in(folder: Path) -> set[str]:
    """Return the names of the drives that have an entry or are planned in a folder of runs."""
    journal = folder / JOURNAL
    planned = {name for path in journal.glob(f"{PLANS}/*.json") for name in _planned(path)}
    return planned | {path.stem for path in journal.glob("*.json")}


def _planned(path: Path) -> list[str]:
    try:
        tree = json_tree(door.read(path))
    except (OSError, ValueError):
        return []
    names = tree.get("drives") if isinstance(tree, dict) else None
    listed = names if isinstance(names, list) else []
    return [name for name in listed if isinstance(name, str) and Path(name).name == name]


def write_plan(folder: Path, names: Sequence[str], part: str) -> None:
    """Record which drives a start plans to process; a later start of this part replaces it.

    Args:
        folder: The folder of run folders.
        names: Names of the drives.
        part: ``all``, or the name of the shard.
    """
    path = door.inside(folder, f"{JOURNAL}/{PLANS}/{part.replace('/', '-of-')}.json")
    write_text(path, strict_json({"format_version": FORMAT_VERSION, "drives": [*names]}) + "\n")


def started_s(folder: Path) -> float | None:
    """Return when the first plan in a folder was written, in seconds since 1970."""
    times = []
    for path in folder.glob(f"{JOURNAL}/{PLANS}/*.json"):
        with suppress(OSError):
            times.append(path.stat().st_mtime)
    return min(times, default=None)


def silent_s(run: Path) -> float:
    """Return the seconds since a drive's entry was written or touched."""
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

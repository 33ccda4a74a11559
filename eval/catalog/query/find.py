"""Runs below a folder and what shows that one has changed."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Final, NamedTuple, TypeAlias

from crosscue.eval.runs.folder import INPUT, MANIFEST
from crosscue.replay.base import UnreadableRunError

DEPTH: Final = 6
"""Of folders below the catalog's."""
SCORED: Final = "metrics.json"

Stamp: TypeAlias = tuple[int, int, int, int]
"""Time and size of the manifest, then time of the run's folder and of its score's."""
CUT_SHORT: Final[Stamp] = (0, 0, 0, 0)


class Found(NamedTuple):
    """A run folder.

    Attributes:
        run: Its path from the folder that was looked through, with slashes; ``.`` for that itself.
        stamp: Another one shows that something has changed; ``CUT_SHORT`` without a manifest.
    """

    run: str
    stamp: Stamp


def find_runs(folder: str) -> Iterator[Found]:
    """Every run folder below a folder, whole or cut short, or that folder alone if it is one.

    Raises:
        UnreadableRunError: A folder cannot be listed.
    """
    stamp = _stamp(folder)
    if stamp is not None:
        yield Found(".", stamp)
    else:
        yield from _below(folder, "", DEPTH)


def _below(folder: str, prefix: str, depth: int) -> Iterator[Found]:
    try:
        with os.scandir(folder) as listed:
            entries = [entry for entry in listed if not entry.name.startswith(".")]
    except OSError as error:
        raise UnreadableRunError(f"{folder}: {error.strerror}; check its owner and mode") from None
    if prefix and _is_cut_short({entry.name for entry in entries}):
        yield Found(prefix[:-1], CUT_SHORT)
        return
    for entry in sorted(entries, key=lambda entry: entry.name):
        if not entry.is_dir():
            continue
        stamp = _stamp(entry.path)
        if stamp is not None:
            yield Found(prefix + entry.name, stamp)
        elif depth > 1 and not entry.is_symlink():
            yield from _below(entry.path, f"{prefix}{entry.name}/", depth - 1)


def _stamp(folder: str) -> Stamp | None:
    try:
        manifest = os.stat(f"{folder}/{MANIFEST}")  # noqa: PTH116 there may be 100,000
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise UnreadableRunError(f"{folder}: {error.strerror}; check its owner and mode") from None
    return (manifest.st_mtime_ns, manifest.st_size, _time(folder), _time(f"{folder}/score"))


def _time(path: str) -> int:
    try:
        return os.stat(path).st_mtime_ns  # noqa: PTH116
    except OSError:
        return 0


def _is_cut_short(names: set[str]) -> bool:
    """Does a folder without a manifest hold what a run writes before it?

    A folder of pooled scores has tables, too.
    """
    has_tables = any(name.endswith(".parquet") for name in names)
    return INPUT in names or (has_tables and SCORED not in names)

"""How far the drives of a folder of runs have come, as its files say; nothing is written."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Final

from crosscue.eval.runs.folder import FAILURE, MANIFEST, is_alive
from crosscue.replay.base import UnreadableRunError

from .journal import STALE_S, has_journal, names_in, read_entry, silent_s, started_s

MERGED: Final = "merged"
"""What the merged run is called among those that it was made of."""
WINDOW_S: Final = 3600.0
"""The rate is that of the last hour, or since the start."""
NO_RUN: Final = "no run yet"


class DriveState(StrEnum):
    """How far a drive has come."""

    DONE = "done"
    RUNNING = "running"
    FAILED = "failed"
    STALE = "stale"
    WAITING = "waiting"


@dataclass(frozen=True, slots=True)
class DriveStatus:
    """One drive of a batch.

    Attributes:
        run: Its run folder.
        state: ``stale``: begun by a worker that is gone. ``waiting``: not begun yet.
        silent_s: Since its worker was last heard of, or since it ended; infinite if never.
        error: Why it failed, or None.
        host: Machine of the worker that began it and has not ended it; empty without.
    """

    run: Path
    state: DriveState
    silent_s: float
    error: str | None = None
    host: str = ""

    @property
    def log(self) -> Path | None:
        """What is known of its failure, or None."""
        path = self.run / FAILURE
        return path if self.error is not None and path.exists() else None


@dataclass(frozen=True, slots=True)
class Pace:
    """How fast drives end.

    Attributes:
        per_hour: Of those that ended, done or failed; NaN where none has.
        left_s: Until the last one ends at this rate; NaN where nobody works on any.
    """

    per_hour: float
    left_s: float


def drives_of_folder(folder: Path) -> tuple[DriveStatus, ...]:
    """Every drive that a batch in this folder has planned, begun or ended, and other runs, by name.

    A shard may have none.

    Raises:
        UnreadableRunError: It is not there, or no batch has written into it.
    """
    if not folder.is_dir():
        raise UnreadableRunError(f"{folder}: no such folder; give the one that replay writes to")
    whole = {path.parent.name for path in folder.glob(f"*/{MANIFEST}")} - {MERGED}
    if not (whole or has_journal(folder)):
        raise UnreadableRunError(
            f"{folder}: no batch of drives; give the folder that replay of many drives writes to"
        )
    return tuple(drive_status(folder / name) for name in sorted(whole | names_in(folder)))


def drive_status(run: Path) -> DriveStatus:
    """How far the drive of a run folder has come."""
    entry = read_entry(run)
    is_whole = (run / MANIFEST).exists()
    silent = silent_s(run)
    if entry is None:
        return DriveStatus(run, DriveState.DONE if is_whole else DriveState.WAITING, silent)
    if isinstance(entry.get("error"), str):
        return DriveStatus(run, DriveState.FAILED, silent, entry["error"])
    if "manifest" in entry:
        return DriveStatus(run, DriveState.DONE if is_whole else DriveState.STALE, silent)
    worker = str(entry.get("worker", ""))
    alive = is_alive(worker)
    is_running = silent <= STALE_S if alive is None else alive
    state = DriveState.RUNNING if is_running else DriveState.STALE
    return DriveStatus(run, state, silent, host="".join(worker.split(" ")[1:2]))


def pace_of(drives: Sequence[DriveStatus], folder: Path) -> Pace:
    """The rate at which the drives of a folder end, and how long the others take at this rate."""
    began = started_s(folder)
    window_s = WINDOW_S if began is None else min(max(time.time() - began, 1.0), WINDOW_S)
    ended = (DriveState.DONE, DriveState.FAILED)
    count = sum(one.state in ended and one.silent_s <= window_s for one in drives)
    if not count:
        return Pace(float("nan"), float("nan"))
    left = sum(one.state in (DriveState.RUNNING, DriveState.WAITING) for one in drives)
    is_worked_on = any(one.state is DriveState.RUNNING for one in drives)
    each_s = window_s / count
    return Pace(3600.0 / each_s, left * each_s if is_worked_on else float("nan"))


def unfinished(folder: Path) -> dict[str, str]:
    """By name of a drive that has no run here, why."""
    found = {}
    for name in names_in(folder):
        one = drive_status(folder / name)
        if one.error is not None:
            found[name] = one.error
        elif one.state is not DriveState.DONE:
            found[name] = f"{NO_RUN} ({one.state.value}); replay again"
    return found

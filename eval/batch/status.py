"""Progress of the drives in a folder of runs, read from its files; nothing is written."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import ClassVar, Final

from crosscue.eval.runs.folder import FAILURE, MANIFEST, is_alive
from crosscue.replay.errors import UnreadableRunError

from .journal import STALE_S, has_journal, names_in, read_entry, silent_s, started_s

# Name of the merged run's folder.
MERGED: Final = "merged"
# Time over which the rate is measured, seconds; less if the batch started later.
WINDOW_S: Final = 3600.0
NO_RUN: Final = "no run yet"


class DriveState(StrEnum):
    """Progress of a drive."""

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
        state: ``stale``: its worker died before it ended. ``waiting``: not started yet.
        silent_s: Seconds since its worker was last active, or since it ended; infinite if never.
        error: Error message of a failed drive, or None.
        host: Machine of the worker that is processing it; empty if none is.
    """

    run: Path
    state: DriveState
    silent_s: float
    error: str | None = None
    host: str = ""

    also: ClassVar = {"log": "log"}

    @property
    def log(self) -> Path | None:
        """File with the details of its failure, or None."""
        path = self.run / FAILURE
        return path if self.error is not None and path.exists() else None


@dataclass(frozen=True, slots=True)
class Pace:
    """Rate at which drives end.

    Attributes:
        per_hour: Drives per hour that ended, done or failed; NaN if none has.
        left_s: Seconds until the last drive ends at this rate; NaN if no worker is active.
    """

    per_hour: float
    left_s: float


def drives_of_folder(folder: Path) -> tuple[DriveStatus, ...]:
    """Return every planned, started or ended drive and every other run of a folder, by name.

    The result may be empty, because a shard may have no drives.

    Raises:
        UnreadableRunError: The folder does not exist, or no batch has written to it.
    """
    if not folder.is_dir():
        raise UnreadableRunError(
            f"{folder}: no such folder; expected the one that replay writes to"
        )
    complete = {path.parent.name for path in folder.glob(f"*/{MANIFEST}")} - {MERGED}
    if not (complete or has_journal(folder)):
        raise UnreadableRunError(
            f"{folder}: no batch of drives; expected the folder that replay writes many drives to"
        )
    return tuple(drive_status(folder / name) for name in sorted(complete | names_in(folder)))


def drive_status(run: Path) -> DriveStatus:
    """Return the progress of the drive of a run folder."""
    entry = read_entry(run)
    is_complete = (run / MANIFEST).exists()
    silent = silent_s(run)
    if entry is None:
        return DriveStatus(run, DriveState.DONE if is_complete else DriveState.WAITING, silent)
    if isinstance(entry.get("error"), str):
        return DriveStatus(run, DriveState.FAILED, silent, entry["error"])
    if "manifest" in entry:
        return DriveStatus(run, DriveState.DONE if is_complete else DriveState.STALE, silent)
    worker = str(entry.get("worker", ""))
    alive = is_alive(worker)
    is_running = silent <= STALE_S if alive is None else alive
    state = DriveState.RUNNING if is_running else DriveState.STALE
    return DriveStatus(run, state, silent, host="".join(worker.split(" ")[1:2]))


def pace_of(drives: Sequence[DriveStatus], folder: Path) -> Pace:
    """Return the rate at which the drives of a folder end, and the time left at this rate."""
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
    """Return the reason why a drive has no run here, by drive name."""
    found = {}
    for name in names_in(folder):
        one = drive_status(folder / name)
        if one.error is not None:
            found[name] = one.error
        elif one.state is not DriveState.DONE:
            found[name] = f"{NO_RUN} ({one.state.value}); replay again"
    return found

"""Journal of a batch, one file for each drive, and the progress of batches read from it.

An entry is written when a drive starts and again when it ends. In between, the worker touches the
file every few seconds, so that every machine that shares the folder can see that the worker is
alive. The end time of a drive is the modification time of its file; entries contain no time.
"""

import math
import os
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

from crosscue.eval.runs.folder import FAILURE, MANIFEST, is_alive
from crosscue.replay.errors import UnreadableRunError, UsageError
from crosscue.replay.files import door
from crosscue.replay.files.tree_text import json_tree, strict_json
from crosscue.replay.files.whole_file import write_text
from crosscue.results import HIDDEN, Result
from crosscue.verb import Option

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
    if not (complete or (folder / JOURNAL).is_dir()):
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


@dataclass(frozen=True, slots=True, repr=False)
class BatchStatus(Result):
    """Progress of batches of drives; its text is the output of ``crosscue status``.

    Attributes:
        drives: Run folder, state and error of each drive.
        pace: Drives per hour and seconds left, over all folders.
    """

    drives: tuple[DriveStatus, ...]
    pace: Pace = field(metadata=HIDDEN)

    also: ClassVar = {"per_hour": "pace.per_hour", "seconds_left": "pace.left_s"}

    def count(self, state: str) -> int:
        """Return the number of drives in a state: done, running, failed, stale or waiting."""
        return sum(one.state == state for one in self.drives)

    @property
    def is_whole(self) -> bool:
        """True if no drive has failed or is stale."""
        return not any(self.count(state) for state in (DriveState.FAILED, DriveState.STALE))

    @property
    def counts(self) -> dict[str, int]:
        """Number of drives in each state."""
        return {state.value: self.count(state) for state in DriveState}

    def as_dict(self) -> dict[str, object]:
        """Return the number of drives in each state, the pace, and each drive."""
        return {**self.counts, **Result.as_dict(self)}

    def lines(self) -> Iterator[str]:
        """Yield failed and stale drives, the number in each state, and the pace."""
        for one in self.drives:
            if one.error is not None:
                yield f"failed    {one.run.name}: {one.error}"
                if one.log is not None:
                    yield f"          {one.log}"
            elif one.state is DriveState.STALE:
                where = f" on {one.host}" if one.host else ""
                is_known = math.isfinite(one.silent_s)
                when = f"last update {_duration(one.silent_s)} ago; " if is_known else ""
                yield f"stale     {one.run.name}: its worker{where} is gone, {when}replay again"
        counted = (f"{count} {state}" for state, count in self.counts.items())
        yield f"drives    {len(self.drives)}: {', '.join(counted)}"
        if math.isfinite(self.pace.per_hour):
            digits = 0 if self.pace.per_hour >= 10.0 else 1
            yield f"rate      {self.pace.per_hour:,.{digits}f} drives per hour"
        if math.isfinite(self.pace.left_s):
            yield f"time left {_duration(self.pace.left_s)}"


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60.0)
    if minutes < 2:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


def batch_status(*folders: Annotated[Path | str, Option(metavar="RUNS")]) -> BatchStatus:
    """Show the progress of batches of drives.

    A drive is done, running, failed, stale or waiting. It is stale when its worker's process has
    ended or, on another machine, has been silent for two minutes. To process stale and failed
    drives, start the same replay again; to process only failed drives, use replay --retry-failed.
    Nothing is written, so any machine that has access to the folders can show it. The exit status
    is 3 when a drive has failed or is stale.

    Examples:
        crosscue status runs
        crosscue status shards/1 shards/2 --json

    Args:
        folders: Folders that replay writes runs to.

    Raises:
        UsageError: There is no folder, or one is named twice.
        RunError: A folder is missing, or no batch has been written to it.
    """
    places = [Path(folder) for folder in folders]
    if not places or len({place.resolve() for place in places}) < len(places):
        raise UsageError("status: expected folders of runs, each named once")
    found = {place: drives_of_folder(place) for place in places}
    paces = [pace_of(drives, place) for place, drives in found.items()]
    rates = [pace.per_hour for pace in paces if math.isfinite(pace.per_hour)]
    left = [pace.left_s for pace in paces if math.isfinite(pace.left_s)]
    return BatchStatus(
        tuple(one for drives in found.values() for one in drives),
        Pace(sum(rates) if rates else math.nan, max(left, default=math.nan)),
    )

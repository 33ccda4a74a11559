"""Many drives: found by folder, pattern or list, and replayed side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from crosscue.eval.batch.drive_list import DriveInput, DriveList, drives_of
from crosscue.eval.batch.engine import engine_of
from crosscue.eval.batch.jobs import (
    Done,
    Job,
    Progress,
    exit_status_of,
    fingerprint_of,
    planned,
    run_many,
)
from crosscue.eval.batch.merge import FOLDER, gathered, merge_runs
from crosscue.eval.interface.logs.log import open as open_drive
from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.runs.folder import FAILURE, create
from crosscue.eval.runs.logs import files_named_in
from crosscue.replay.base import DEFAULT_LIMITS, CrosscueError, Limits, versions, visible
from crosscue.replay.logs.log_part import part_in_words
from crosscue.replay.logs.opening import unless_damaged
from crosscue.replay.vehicle.pose import GnssUse
from crosscue.replay.vehicle.vehicle import Vehicle, vehicle_given

from .make import replay_drive


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class ReplayedDrives:
    """The outcomes of many drives; printed in a line each.

    Attributes:
        drives: Each with its job, what the replay counted, or why it failed.
        merged: Folder of the tables of all runs; None of a shard, whose runs are merged with those
            of the others when all are done.
        not_merged: Why they could not be merged, or None.
        shard: Which part of how many drives these are, as ``2/4 of 100 drives``; empty for all.
    """

    drives: tuple[Done[Outcome], ...]
    merged: Path | None
    not_merged: str | None
    shard: str = ""

    @property
    def exit_status(self) -> int:
        """0 when all is whole; 3 for losses, some failures, or no merged tables; else theirs."""
        status = exit_status_of(self.drives)
        return status if self.not_merged is None else status or 3

    def as_dict(self) -> dict[str, object]:
        """What ``crosscue replay --json`` prints of many drives."""
        return {
            "drives": [_as_dict(one) for one in self.drives],
            "merged": None if self.merged is None else str(self.merged),
            "not_merged": self.not_merged,
            "shard": self.shard or None,
        }

    def __repr__(self) -> str:
        lines = []
        for one in self.drives:
            if one.error is not None:
                lines.append(f"failed   {one.job.name}: {one.error}")
                log = one.job.run / FAILURE
                lines += [f"         {log}"] if log.exists() else []
            elif one.is_earlier:
                lines.append(f"earlier  {one.job.name}: done before, kept")
            else:
                lost = "" if not one.exit_status else ", with losses"
                lines.append(f"done     {one.job.name}: {one.seconds:.1f} s{lost}")
        failed = sum(one.error is not None for one in self.drives)
        lines.append(f"drives   {len(self.drives) - failed} of {len(self.drives)}, {failed} failed")
        if self.shard:
            lines.append(f"shard    {self.shard}; crosscue merge them when every shard is done")
        if self.not_merged is not None:
            lines.append(f"tables   not merged: {self.not_merged}")
        elif self.merged is not None:
            lines.append(f"tables   {self.merged}")
        return "\n".join(map(visible, lines))


def _as_dict(one: Done[Outcome]) -> dict[str, object]:
    return {
        "name": one.job.name,
        "run": str(one.job.run),
        "exit_status": one.exit_status,
        "error": one.error,
        "earlier": one.is_earlier,
        "attempts": one.attempts,
        "seconds": one.seconds,
        "result": None if one.result is None else one.result.as_dict(),
    }


@dataclass(frozen=True, slots=True)
class _Work:
    """One of many drives, here or in another process; attributes as of ``replay_drives``."""

    vehicle: Vehicle | Path | str | None
    detectors: Sequence[str] | None
    start: str | None
    end: str | None
    topics: Sequence[str] | None
    limits: Limits
    gnss: GnssUse | None
    landmarks: Path | None
    cache: Path | str | None
    draw: int
    resume: bool

    def __call__(self, job: Job) -> Outcome:
        """Replay it into its run folder."""
        with open_drive(*job.logs, limits=self.limits) as log, unless_damaged(log.logs):
            part = part_in_words(log.logs, self.start, self.end, self.topics)
            run = replay_drive(
                replace(log, selection=part),
                job.run,
                self.settings(job),
                self.detectors,
                gnss=self.gnss,
                landmarks=self.landmarks,
                cache=self.cache,
                draw=self.draw,
                # Whether it may be replaced was decided before the drive was handed out.
                overwrite=True,
                resume=self.resume,
            )
        assert isinstance(run.outcome, Outcome)
        return run.outcome

    def settings(self, drive: DriveInput | Job) -> Vehicle:
        """The vehicle file asked for, else the drive's own."""
        return vehicle_given(drive.vehicle if self.vehicle is None else self.vehicle)

    def fingerprint(self, drive: DriveInput) -> str:
        """Of everything that decides a drive's run besides its logs."""
        names = self.detectors
        flags = {
            "detectors": None if names is None else ",".join(names) if names else "none",
            "draw": str(self.draw),
            "start": self.start,
            "end": self.end,
            "gnss": self.gnss,
            "topics": None if self.topics is None else str([*self.topics]),
            "landmarks": None if self.landmarks is None else str(self.landmarks.resolve()),
        }
        try:
            settings: object = self.settings(drive).model_dump(mode="json")
        except CrosscueError as error:
            # This drive's own attempt reports it; the others must not suffer.
            settings = str(error)
        return fingerprint_of(settings, flags, versions(), files_named_in([settings, flags]))


def find_drives(*logs: Path | str, each: bool = False, shard: str | None = None) -> DriveList:
    """The drives that paths mean: several logs are one drive, merged by time.

    Many drives are a folder of drives, a pattern (``drives/*/drive.mcap``), or ``@drives.txt``, a
    list with a line for each.

    Args:
        logs: Paths or URLs.
        each: Every one of them is a drive, or a folder of drives.
        shard: ``2/4``: only the drives of the second of four parts, chosen by a hash of each
            drive's identity; ``auto``: the part that the scheduler's variables say,
            ``SLURM_ARRAY_TASK_ID`` and ``_COUNT``, or ``RANK`` and ``WORLD_SIZE``.

    Returns:
        ``drives``, each with its logs, and the vehicle file and the truth beside them; and
        ``is_many``.

    Raises:
        UsageError: Nothing matches, a list cannot be read, a drive is named twice, or ``shard`` is
            neither or of one drive.
        LogError: A place that is not there or may not be looked into.
    """
    return drives_of([str(log) for log in logs], each=each, shard=shard)


def replay_drives(
    drives: DriveList | Sequence[Path | str] | Path | str,
    output: Path | str,
    vehicle: Vehicle | Path | str | None = None,
    detectors: Sequence[str] | None = None,
    *,
    start: float | str | None = None,
    end: float | str | None = None,
    topics: Sequence[str] | None = None,
    limits: Limits = DEFAULT_LIMITS,
    gnss: GnssUse | None = None,
    landmarks: Path | str | None = None,
    cache: Path | str | None = None,
    draw: int = 0,
    workers: int | None = None,
    ray: str | None = None,
    cores: int | None = None,
    memory_gib: float | None = None,
    overwrite: bool = False,
    resume: bool = False,
    retry_failed: bool = False,
    on_progress: Callable[[Progress], None] = lambda progress: None,
) -> ReplayedDrives:
    """Replay many drives as ``replay_drive`` does; a second start does only what is missing.

    One that fails does not stop the others. The tables of all runs are merged.

    Args:
        drives: What ``find_drives`` returns; or logs, each of them a drive, and folders of drives.
        output: Folder that gets one run folder per drive, and ``merged``.
        vehicle: The vehicle file of all drives; None for the ``vehicle.toml`` beside each.
        detectors: As in ``replay_drive``.
        start: Seconds after a drive's first row, or as text, absolute: ``17...ns``.
        end: Likewise, no longer wanted.
        topics: Names; None for all.
        limits: What the logs are read with.
        gnss: As in ``replay_drive``.
        landmarks: As in ``replay_drive``.
        cache: As in ``replay_drive``.
        draw: As in ``replay_drive``.
        workers: Drives side by side; one, or the cores of the cluster, if left out.
        ray: Address of a Ray cluster to work on.
        cores: What a drive declares to Ray; one core if left out.
        memory_gib: The same of memory; 2 GiB if left out.
        overwrite: Replace runs of other logs or settings.
        resume: As in ``replay_drive``.
        retry_failed: Only the drives whose last attempt failed; without it they are begun again
            with all others that are not done.
        on_progress: Called about once a second with ``total``, ``earlier``, ``done`` and
            ``failed`` drives.

    Raises:
        UsageError: No drive is found, or too few workers.
    """
    found = drives if isinstance(drives, DriveList) else find_drives(*_several(drives), each=True)
    engine = engine_of(workers, ray, cores, memory_gib)
    folder = Path(output)
    work = _Work(
        vehicle,
        detectors,
        None if start is None else str(start),
        None if end is None else str(end),
        topics,
        limits,
        gnss,
        None if landmarks is None else Path(landmarks),
        cache,
        draw,
        resume,
    )
    jobs = [
        Job(one.name, one.logs, folder / one.name, work.fingerprint(one), one.vehicle, one.truth)
        for one in found.drives
    ]
    shard = "" if found.shard is None else f"{found.shard} of {found.of} drives"
    asked = planned(folder, jobs, str(found.shard or "all"), retry_failed=retry_failed)
    done = run_many(asked, work, engine, overwrite=overwrite, on_progress=on_progress)
    if shard:
        return ReplayedDrives(done, None, None, shard)
    why = None
    try:
        _merge(done, folder)
    except CrosscueError as error:
        # The drives are done, and that must be reported, whether or not they could be merged.
        why = str(error)
    return ReplayedDrives(done, folder / FOLDER, why)


def _several(drives: Sequence[Path | str] | Path | str) -> Sequence[Path | str]:
    return [drives] if isinstance(drives, Path | str) else drives


def _merge(done: Sequence[Done[Outcome]], output: Path) -> None:
    """One table of all runs in the folder, those of earlier batches too."""
    runs, failures = gathered([output])
    ended = {one.job.name: one.error for one in done}
    # A drive that failed now has no run, though an earlier start may have left one that was cut.
    runs = {name: run for name, run in runs.items() if ended.get(name) is None}
    failed = {name: why for name, why in ended.items() if why is not None}
    merge_runs(runs, create(output / FOLDER, overwrite=True), {**failures, **failed})

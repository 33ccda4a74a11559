"""Find many drives by folder, pattern or list, and replay them in parallel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
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
from crosscue.eval.logs.log import UnopenedLog
from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.runs.folder import FAILURE, create
from crosscue.eval.runs.logs import files_named_in
from crosscue.replay.base import (
    DEFAULT_LIMITS,
    CrosscueError,
    Limits,
    UsageError,
    versions,
    visible,
)
from crosscue.replay.logs.log_part import LogPart
from crosscue.replay.vehicle.pose import GnssUse
from crosscue.replay.vehicle.vehicle import Vehicle, vehicle_given

from .make import check_inputs, replay_drive


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class ReplayedDrives:
    """Outcomes of many drives; its repr has one line per drive.

    Attributes:
        drives: Job of each drive, with the counts of its replay or with its error.
        merged: Folder with the tables of all runs; None for a shard, whose runs are merged with
            those of the other shards at the end.
        not_merged: Reason why the runs could not be merged, or None.
        shard: Part of the drives, such as ``2/4 of 100 drives``; empty for all drives.
    """

    drives: tuple[Done[Outcome], ...]
    merged: Path | None
    not_merged: str | None
    shard: str = ""

    @property
    def exit_status(self) -> int:
        """Exit status of the batch.

        0 if all runs are complete; 3 for losses, some failures, or tables that could not be merged;
        if every drive failed, their common status, or 1.
        """
        status = exit_status_of(self.drives)
        return status if self.not_merged is None else status or 3

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output of ``crosscue replay`` for many drives."""
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
                lines.append(f"earlier  {one.job.name}: already done, kept")
            else:
                lost = "" if not one.exit_status else ", with losses"
                lines.append(f"done     {one.job.name}: {one.seconds:.1f} s{lost}")
        failed = sum(one.error is not None for one in self.drives)
        lines.append(f"drives   {len(self.drives) - failed} of {len(self.drives)}, {failed} failed")
        if self.shard:
            lines.append(f"shard    {self.shard}; run crosscue merge when every shard is done")
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
    """Replay of one of many drives, in any process; attributes as in ``replay_drives``."""

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
        """Replay the drive into its run folder."""
        run = replay_drive(
            UnopenedLog(job.logs, LogPart(self.start, self.end, self.topics), self.limits),
            job.run,
            self.settings(job),
            self.detectors,
            gnss=self.gnss,
            landmarks=self.landmarks,
            cache=self.cache,
            draw=self.draw,
            # The caller has already decided that an existing run may be replaced.
            overwrite=True,
            resume=self.resume,
        )
        assert isinstance(run.outcome, Outcome)
        return run.outcome

    def settings(self, drive: DriveInput | Job) -> Vehicle:
        """Return the settings of the requested vehicle file, or else of the drive's."""
        return vehicle_given(drive.vehicle if self.vehicle is None else self.vehicle)

    def fingerprint(self, drive: DriveInput) -> str:
        """Return a hash of everything besides the logs that determines a drive's run."""
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
            # Reported when this drive is replayed; the other drives must not fail.
            settings = str(error)
        return fingerprint_of(settings, flags, versions(), files_named_in([settings, flags]))


def find_drives(*logs: Path | str, each: bool = False, shard: str | None = None) -> DriveList:
    """Find one drive, whose logs are merged by time, or many drives.

    Many drives are a folder of drives, a pattern (``drives/*/drive.mcap``), or ``@drives.txt``, a
    list with one drive per line.

    Args:
        logs: Paths or URLs.
        each: Treat each path as a separate drive, or as a folder of drives.
        shard: ``2/4`` selects the second of four parts, divided by a hash of each drive's identity;
            ``auto`` selects the part that the scheduler's variables define,
            ``SLURM_ARRAY_TASK_ID`` and ``_COUNT``, or ``RANK`` and ``WORLD_SIZE``.

    Returns:
        ``drives``, each with its logs and the vehicle file and truth next to them; and ``is_many``.

    Raises:
        UsageError: Nothing matches, a list cannot be read, a drive is named twice, or ``shard`` is
            not valid or set for one drive.
        LogError: A path does not exist, or may not be read.
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
    """Replay many drives as ``replay_drive`` does; a second start processes only missing ones.

    A drive that fails does not stop the others. The tables of all runs are merged.

    Args:
        drives: Result of ``find_drives``; or logs, each of them a drive, and folders of drives.
        output: Output folder, with one run folder per drive, and ``merged``.
        vehicle: The vehicle file of all drives; None for the ``vehicle.toml`` next to each.
        detectors: Names, as in ``replay_drive``; other processes cannot import an object.
        start: Start, in seconds after a drive's first row, or absolute as text, ``17...ns``.
        end: End (exclusive), in the same form.
        topics: Names of topics; None for all.
        limits: Limits for reading the logs.
        gnss: As in ``replay_drive``.
        landmarks: As in ``replay_drive``.
        cache: As in ``replay_drive``.
        draw: As in ``replay_drive``.
        workers: Number of drives in parallel; default: 1, or with ``ray`` the cluster's cores.
        ray: Address of a Ray cluster to run on.
        cores: Number of cores that a drive declares to Ray; default: 1.
        memory_gib: Memory that a drive declares to Ray; default: 2 GiB.
        overwrite: Replace runs of other logs or settings.
        resume: As in ``replay_drive``.
        retry_failed: Process only the drives whose last attempt failed; default: all drives that
            are not done.
        on_progress: Called about once a second with the numbers of drives ``total``, ``earlier``,
            ``done`` and ``failed``.

    Raises:
        UsageError: No drive is found, ``workers`` is below 1, or a detector is not a name.
    """
    nameless = [one for one in detectors or () if not isinstance(one, str)]
    if nameless:
        raise UsageError(f"detectors: {nameless[0]!r}: many drives need names, as module:Class")
    check_inputs(vehicle, detectors, None, landmarks)
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
        # The drives are reported as done even if their tables cannot be merged.
        why = str(error)
    return ReplayedDrives(done, folder / FOLDER, why)


def _several(drives: Sequence[Path | str] | Path | str) -> Sequence[Path | str]:
    return [drives] if isinstance(drives, Path | str) else drives


def _merge(done: Sequence[Done[Outcome]], output: Path) -> None:
    """Merge the tables of all runs in the folder, including those of earlier batches."""
    runs, failures = gathered([output])
    ended = {one.job.name: one.error for one in done}
    # A drive that failed now has no run, even if an earlier start left an interrupted one.
    runs = {name: run for name, run in runs.items() if ended.get(name) is None}
    failed = {name: why for name, why in ended.items() if why is not None}
    merge_runs(runs, create(output / FOLDER, overwrite=True), {**failures, **failed})

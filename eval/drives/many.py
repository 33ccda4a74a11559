"""Find many drives by folder, pattern or list, and replay them in parallel."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from crosscue.eval.batch.drive_list import DriveInput, DriveList, find_drives
from crosscue.eval.logs.log import UnopenedLog
from crosscue.eval.pipeline.outcome import MAX_LINES, Outcome
from crosscue.eval.pipeline.run import Run
from crosscue.eval.runs.folder import FAILURE, create
from crosscue.eval.runs.logs import files_named_in
from crosscue.replay.errors import CrosscueError, UsageError
from crosscue.replay.limits import DEFAULT_LIMITS, LimitsGiven
from crosscue.replay.logs.log_part import EVERY_PART, LogPart
from crosscue.replay.vehicle.vehicle import Vehicle, vehicle_given
from crosscue.replay.versions import versions
from crosscue.results import HIDDEN, Result, plain
from crosscue.verb import Option, compared, keywords

from .replay import ReplaySettings, check_inputs, replay_with

if TYPE_CHECKING:
    from crosscue.eval.batch.jobs import Job, JobOutcome


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class ReplayedDrives(Result):
    """Outcomes of many drives; its repr has one line per drive.

    Attributes:
        drives: Job of each drive, with the counts of its replay or with its error.
        merged: Folder with the tables of all runs; None for a shard, whose runs are merged with
            those of the other shards at the end.
        not_merged: Reason why the runs could not be merged, or None.
        shard: Part of the drives, such as ``2/4 of 100 drives``; None for all drives.
    """

    drives: tuple[JobOutcome[Outcome], ...] = field(metadata=HIDDEN)
    merged: Path | None
    not_merged: str | None
    shard: str | None = None

    also: ClassVar = {"drives": "entries"}
    max_lines: ClassVar = MAX_LINES

    @property
    def exit_status(self) -> int:
        """Exit status of the batch.

        0 if all runs are complete; 3 for losses, some failures, or tables that could not be merged;
        if every drive failed, their common status, or 1.
        """
        from crosscue.eval.batch.jobs import exit_status_of  # one drive is no batch

        status = exit_status_of(self.drives)
        return status if self.not_merged is None else status or 3

    @property
    def entries(self) -> list[dict[str, object]]:
        """Each drive with its status, error and counts."""
        return [
            {
                "name": one.job.name,
                "run": str(one.job.run),
                "exit_status": one.exit_status,
                "error": one.error,
                "earlier": one.is_earlier,
                "attempts": one.attempts,
                "seconds": one.seconds,
                "result": one.result,
            }
            for one in self.drives
        ]

    def lines(self) -> Iterator[str]:
        """Yield one line for each drive, failed ones first."""
        for one in sorted(self.drives, key=lambda one: one.error is None):
            if one.error is not None:
                yield f"failed   {one.job.name}: {one.error}"
                log = one.job.run / FAILURE
                if log.exists():
                    yield f"         {log}"
            elif one.is_earlier:
                yield f"earlier  {one.job.name}: already done, kept"
            else:
                lost = "" if not one.exit_status else ", with losses"
                yield f"done     {one.job.name}: {one.seconds:.1f} s{lost}"

    def closing(self) -> Iterator[str]:
        """Yield the number of drives, and where the tables are."""
        failed = sum(one.error is not None for one in self.drives)
        yield f"drives   {len(self.drives) - failed} of {len(self.drives)}, {failed} failed"
        if self.shard:
            yield f"shard    {self.shard}; run crosscue merge when every shard is done"
        if self.not_merged is not None:
            yield f"tables   not merged: {self.not_merged}"
        elif self.merged is not None:
            yield f"tables   {self.merged}"


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchSettings(ReplaySettings):
    """Settings of a replay of many drives.

    Attributes:
        part: Part of each drive to read.
        limits: Limits for reading the logs.
        workers: Number of drives in parallel (default: 1; with --ray, the cluster's cores).
        ray: Run on a Ray cluster: its address, auto, or local.
        cores_per_drive: Cores declared to Ray (default: 1).
        memory_per_drive_gib: Memory declared to Ray for each drive (default: 2).
        retry_failed: Process only the drives whose last attempt failed.
    """

    part: LogPart = EVERY_PART
    limits: LimitsGiven = field(default=DEFAULT_LIMITS, compare=False)
    workers: int | None = field(default=None, compare=False)
    ray: str | None = field(default=None, compare=False)
    cores_per_drive: int | None = field(default=None, compare=False)
    memory_per_drive_gib: Annotated[float | None, Option("--memory-per-drive")] = field(
        default=None, compare=False
    )
    retry_failed: bool = field(default=False, compare=False)

    def fingerprint(self, drive: DriveInput) -> str:
        """Return a hash of everything besides the logs that determines a drive's run."""
        from crosscue.eval.batch.jobs import fingerprint_of

        flags = compared(self)
        if self.detector_names is not None and not isinstance(self.detector_names, str):
            flags["detectors"] = ",".join(map(str, self.detector_names)) or "none"
        if self.landmarks is not None:
            flags["landmarks"] = str(Path(self.landmarks).resolve())
        try:
            vehicle: object = self.vehicle_of(drive).model_dump(mode="json")
        except CrosscueError as error:
            # Reported when this drive is replayed; the other drives must not fail.
            vehicle = str(error)
        stored = plain({**flags, "vehicle": vehicle})
        return fingerprint_of(stored, versions(), files_named_in([stored]))

    def vehicle_of(self, drive: DriveInput | Job) -> Vehicle:
        """Return the settings of the requested vehicle file, or else of the drive's."""
        return vehicle_given(drive.vehicle if self.vehicle is None else self.vehicle)


@dataclass(frozen=True, slots=True)
class _Work:
    settings: BatchSettings

    def __call__(self, job: Job) -> Outcome:
        settings = self.settings
        # The caller has already decided that an existing run may be replaced.
        ours = replace(settings, vehicle=settings.vehicle_of(job), overwrite=True)
        log = UnopenedLog(job.logs, settings.part, settings.limits)
        run = replay_with(log, job.run, ours)
        assert isinstance(run.outcome, Outcome)
        return run.outcome


@keywords(BatchSettings, 2)
def replay_drives(
    drives: DriveList | Sequence[Path | str] | Path | str,
    output: Path | str,
    settings: BatchSettings,
) -> ReplayedDrives:
    """Replay many drives as ``replay_drive`` does; a second start processes only missing ones.

    A drive that fails does not stop the others. The tables of all runs are merged.

    Args:
        drives: Result of ``find_drives``; or logs, each of them a drive, and folders of drives.
        output: Output folder, with one run folder per drive, and ``merged``.
        settings: How to replay.

    Raises:
        UsageError: No drive is found, ``workers`` is below 1, or a detector is not a name.
    """
    return replay_many(drives, output, settings)


def replay_many(
    drives: DriveList | Sequence[Path | str] | Path | str,
    output: Path | str,
    settings: BatchSettings,
) -> ReplayedDrives:
    """Replay many drives, as ``replay_drives``."""
    from crosscue.eval.batch.jobs import Job, planned, run_many
    from crosscue.eval.batch.merge import FOLDER
    from crosscue.eval.batch.ray_jobs import engine_of

    nameless = [one for one in settings.detector_names or () if not isinstance(one, str)]
    if nameless:
        raise UsageError(f"detectors: {nameless[0]!r}: many drives need names, as module:Class")
    check_inputs(settings)
    named = [drives] if isinstance(drives, Path | str) else drives
    found = named if isinstance(named, DriveList) else find_drives(*named, each=True)
    engine = engine_of(
        settings.workers, settings.ray, settings.cores_per_drive, settings.memory_per_drive_gib
    )
    folder = Path(output)
    jobs = [
        Job(
            one.name, one.logs, folder / one.name, settings.fingerprint(one), one.vehicle, one.truth
        )
        for one in found.drives
    ]
    shard = None if found.shard is None else f"{found.shard} of {found.of} drives"
    asked = planned(folder, jobs, str(found.shard or "all"), retry_failed=settings.retry_failed)
    done = run_many(asked, _Work(settings), engine, overwrite=settings.overwrite)
    if shard:
        return ReplayedDrives(done, None, None, shard)
    why = None
    try:
        _merge(done, folder)
    except CrosscueError as error:
        # The drives are reported as done even if their tables cannot be merged.
        why = str(error)
    return ReplayedDrives(done, folder / FOLDER, why)


def replay(
    *logs: str,
    output: Annotated[Path | str, Option(metavar="RUN")],
    each: bool = False,
    shard: Annotated[str | None, Option(metavar="I/N")] = None,
    settings: BatchSettings,
) -> Run | ReplayedDrives:
    """Detect and estimate: from a log to a run folder.

    The run folder contains all tables and a manifest that accounts for every message. Detections
    are cached by the content of each picture, so a second run is quick. --resume keeps the finished
    parts of an interrupted run.

    With many drives (a folder of drives, a quoted pattern, @list.txt, or --each), each drive gets
    its own run folder below the output folder. They run in parallel with --workers, or on a Ray
    cluster with --ray. A drive that fails does not stop the rest, and a second start processes only
    the missing drives. --shard divides the drives among the tasks of a scheduler; crosscue status
    shows their progress, and crosscue merge joins their results.

    Examples:
        crosscue replay drive.mcap --vehicle car.toml -o runs/drive
        crosscue replay 'drives/*/drive.mcap' --vehicle car.toml -o runs --workers 8
        crosscue replay drives -o runs --shard 2/4

    Args:
        logs: Recordings of one drive, or drives; paths or URLs.
        output: Run folder; for many drives, the folder of their run folders.
        each: Treat each LOG as a separate drive.
        shard: Process only part I of N of the drives, divided by a hash of each drive's identity.
        settings: How to replay.
    """
    check_inputs(settings)
    found = find_drives(*logs, each=each, shard=shard)
    if found.is_many:
        if settings.start is not None:
            first = found.drives[0].logs[0]
            raise UsageError(
                f"start: applies to one drive, and {', '.join(logs)} is a folder or list of "
                f"{len(found.drives)}; name the drive itself, such as {first}"
            )
        return replay_many(found, output, settings)
    if settings.workers is not None or settings.ray is not None or settings.retry_failed:
        raise UsageError(
            "workers, ray, retry_failed: expected many drives, found one; add --each to treat each "
            "log as a drive"
        )
    (drive,) = found.drives
    ours = replace(settings, vehicle=settings.vehicle_of(drive))
    return replay_with(UnopenedLog(drive.logs, settings.part, settings.limits), output, ours)


def _merge(done: Sequence[JobOutcome[Outcome]], output: Path) -> None:
    from crosscue.eval.batch.merge import FOLDER, gathered, merge_runs

    runs, failures = gathered([output])
    ended = {one.job.name: one.error for one in done}
    # A drive that failed now has no run, even if an earlier start left an interrupted one.
    runs = {name: run for name, run in runs.items() if ended.get(name) is None}
    failed = {name: why for name, why in ended.items() if why is not None}
    merge_runs(runs, create(output / FOLDER, overwrite=True), {**failures, **failed})

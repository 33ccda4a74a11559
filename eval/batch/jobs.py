"""Processing of many drives, in turn or in parallel; a drive that fails does not stop the others.

A drive is a ``Job``: its logs, its run folder and a fingerprint of every setting. Engines process
jobs: ``in_turn`` in this process, ``processes.Processes`` on this machine's cores,
``ray_jobs.OnRay`` on a Ray cluster. Progress is recorded in a ``journal`` next to the run folders,
which is written before and after each drive. A second start therefore does only what is missing,
however the first one ended. The reason of a failure is recorded in ``failure.log`` in the drive's
run folder.
"""

import hashlib
import time
import traceback
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Final, Generic, Protocol, TypeAlias, TypeVar

from crosscue.eval.runs.folder import (
    FAILURE,
    LOCK,
    MANIFEST,
    MAX_MANIFEST_BYTES,
    RunFolder,
    is_alive,
    refuse_files_of_user,
    signature,
)
from crosscue.replay.errors import CrosscueError, RunError, UsageError, one_line, without_secrets
from crosscue.replay.files import door
from crosscue.replay.files.identity import identity_of_all, log_identity
from crosscue.replay.files.log_identity import as_row
from crosscue.replay.files.tree_text import spelled, strict_json
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.losses import losses_heard, warn_again
from crosscue.replay.progress import Progress, emit
from crosscue.replay.versions import versions

from .journal import STALE_S, beating, error_of, read_entry, silent_s, write_entry, write_plan

MAX_LOCK_BYTES: Final = 4096


class JobResult(Protocol):
    """Result of processing a drive; it must be picklable."""

    @property
    def exit_status(self) -> int:
        """0, or 3 when something was dropped."""
        ...


R = TypeVar("R", bound=JobResult)


@dataclass(frozen=True, slots=True)
class Job:
    """One drive to process.

    Attributes:
        name: Unique among the jobs, and valid as a file name.
        logs: Paths or URLs of the drive's logs.
        run: The run folder.
        fingerprint: Hash of all settings that affect the result, see ``fingerprint_of``.
        vehicle: The drive's own vehicle file, if it has one.
        truth: The drive's own ground truth, if it has one.
    """

    name: str
    logs: tuple[str, ...]
    run: Path
    fingerprint: str
    vehicle: Path | None = None
    truth: Path | None = None


@dataclass(frozen=True, slots=True)
class JobOutcome(Generic[R]):
    """The outcome of a job.

    Attributes:
        job: The job.
        exit_status: The status with which the command would have exited for this drive alone.
        error: Error message of one line, or None.
        result: Return value of the work; None after an error, and for an earlier run.
        seconds: Wall time of the last attempt.
        attempts: Number of attempts; 0 for an earlier run.
        losses: Losses outside any ledger, see ``replay.losses``; the parent process warns of
            them.
    """

    job: Job
    exit_status: int
    error: str | None = None
    result: R | None = None
    seconds: float = 0.0
    attempts: int = 1
    losses: tuple[str, ...] = ()

    @property
    def is_earlier(self) -> bool:
        """True if the job was done before this start."""
        return self.attempts == 0 and self.error is None


Events: TypeAlias = Generator[JobOutcome[R] | None, None, None]


class Engine(Protocol):
    """Strategy that processes jobs."""

    def __call__(self, jobs: Sequence[Job], work: Callable[[Job], R]) -> Events[R]:
        """Yield each job once, when it ends, and None about once a second in between.

        Closing the generator stops all work within seconds and leaves no process behind.
        """
        ...


class JobState(StrEnum):
    """Content of a job's run folder."""

    MISSING = "nothing there"
    CUT_SHORT = "cut short"
    DONE = "done"
    OTHER = "another run"


def run_many(
    jobs: Sequence[Job],
    work: Callable[[Job], R],
    engine: Engine,
    *,
    overwrite: bool = False,
    doing: str = "replaying",
) -> tuple[JobOutcome[R], ...]:
    """Process every drive that is not done yet, and report the progress about once a second.

    Args:
        jobs: Drives with unique names.
        work: Function that processes one drive; an importable function, or a ``partial`` of one.
            It clears the run folder itself and writes its manifest last.
        engine: Engine that runs the work.
        overwrite: Replace run folders that hold a run of other logs or settings.
        doing: The work, in reports of the progress.

    Returns:
        One outcome for each job, in the order of ``jobs``.

    Raises:
        UsageError: Two jobs have the same name or the same run folder.
    """
    _check_unique(jobs)
    found: dict[str, JobOutcome[R]] = {}
    missing: list[Job] = []
    for job in jobs:
        earlier: JobOutcome[R] | None = _earlier(job, overwrite)
        if earlier is None:
            missing.append(job)
        else:
            found[job.name] = earlier
    earlier_count = len(found)
    refused = failed = sum(done.error is not None for done in found.values())

    def report() -> None:
        counted = f"{doing}, {failed} failed" if failed else doing
        total = len(jobs) - (earlier_count - refused)
        emit(Progress(counted, len(found) - earlier_count, total, "drives"))

    if missing:
        # Close the engine explicitly, so that no worker outlives an interrupt.
        with closing(engine(missing, work)) as events:
            for done in events:
                if done is not None:
                    found[done.job.name] = done
                    warn_again(done.losses)
                    failed += done.error is not None
                report()
    return tuple(found[job.name] for job in jobs)


def planned(
    folder: Path, jobs: Sequence[Job], part: str, *, retry_failed: bool = False
) -> Sequence[Job]:
    """Record the jobs that a start is about to process, so that others see what is left.

    Args:
        folder: The folder of the run folders.
        jobs: All jobs.
        part: ``all``, or the name of the shard.
        retry_failed: Select only the jobs whose last attempt failed, and keep the recorded plan.

    Returns:
        The jobs to process.
    """
    if retry_failed:
        return [job for job in jobs if error_of(job.run) is not None]
    write_plan(folder, [job.name for job in jobs], part)
    return jobs


def in_turn(jobs: Sequence[Job], work: Callable[[Job], R]) -> Events[R]:
    """Process jobs in turn in this process; a crash in a library ends the whole batch."""
    for job in jobs:
        yield attempt(work, job)


def exit_status_of(results: Iterable[JobOutcome[R]]) -> int:
    """Return one exit status for many drives.

    0 when all are complete; 3 when rows were dropped or some drives failed; when all failed, their
    common status, or 1.
    """
    results = tuple(results)
    failures = {done.exit_status for done in results if done.error is not None}
    if failures and all(done.error is not None for done in results):
        return failures.pop() if len(failures) == 1 else 1
    return 3 if failures or any(done.exit_status for done in results) else 0


def fingerprint_of(*settings: object) -> str:
    """Return a hash of everything besides the logs that affects a result.

    Args:
        settings: Settings, flags and versions; values that JSON can represent.
    """
    return hashlib.sha256(strict_json(settings).encode()).hexdigest()


def attempt(work: Callable[[Job], R], job: Job) -> JobOutcome[R]:
    """Process one drive in this process and keep its journal; engines call this in workers."""
    began = time.monotonic()
    with losses_heard() as losses:
        done = _attempted(work, job, losses)
    return replace(done, losses=tuple(losses), seconds=time.monotonic() - began)


def _attempted(work: Callable[[Job], R], job: Job, losses: Sequence[str]) -> JobOutcome[R]:
    try:
        _check_free(job)
    except (CrosscueError, OSError) as error:
        # Another process works on the drive and owns its entry.
        return JobOutcome(job, *reported_error(error))
    inputs: dict[str, object] | None = None
    try:
        inputs = _inputs(job)
        write_entry(job.run, {"inputs": inputs, "worker": signature()})
        with beating(job.run):
            result = work(job)
        manifest = _manifest_hash(job)
        status = result.exit_status or (3 if losses else 0)
        write_entry(job.run, {"inputs": inputs, "manifest": manifest, "exit_status": status})
    except Exception as error:
        failed: JobOutcome[R] = JobOutcome(job, *reported_error(error))
        record_failure(failed, inputs, traceback.format_exc())
        return failed
    return JobOutcome(job, status, None, result)


def _check_free(job: Job) -> None:
    """Refuse a drive that a worker on another machine is processing, unless that worker died.

    The worker's process is not visible from here, but while it lives it touches its entry.
    """
    worker, lock = str((read_entry(job.run) or {}).get("worker", "")), job.run / LOCK
    if not worker or is_alive(worker) is not None or not lock.exists():
        return
    silent = silent_s(job.run)
    if silent <= STALE_S:
        process = " on ".join(worker.split(" ")[:2])
        raise RunError(
            f"{job.run}: process {process} is writing it; wait, or if it is gone start again in "
            f"{STALE_S - silent:.0f} s"
        )
    if door.read(lock, MAX_LOCK_BYTES) == worker.encode():
        lock.unlink()


def record_failure(failed: JobOutcome[R], inputs: dict[str, object] | None, details: str) -> None:
    """Record a failure in the drive's journal entry and, if possible, in its run folder.

    Args:
        failed: The outcome with its error.
        inputs: Identity of the logs and the settings, where known.
        details: A traceback, or how the worker ended.
    """
    job = failed.job
    lines = {
        "drive": job.name,
        "logs": " ".join(map(spelled, job.logs)),
        "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "worker": signature(),
        "versions": ", ".join(f"{name} {version}" for name, version in versions().items()),
        "status": str(failed.exit_status),
        "error": str(failed.error),
    }
    text = "".join(f"{name:10}{value}\n" for name, value in lines.items())
    # The disk may be full or unmounted; the original error matters more than this one.
    with suppress(CrosscueError, OSError):
        write_text(job.run / FAILURE, without_secrets(f"{text}\n{details.rstrip()}\n"))
    with suppress(CrosscueError, OSError):
        entry = {"error": failed.error, "exit_status": failed.exit_status}
        write_entry(job.run, {"inputs": inputs, **entry})


def reported_error(error: Exception) -> tuple[int, str]:
    """Return the exit status of a command that fails with this error, and a message of one line."""
    if isinstance(error, CrosscueError):
        return error.exit_status, one_line(error)
    if isinstance(error, MemoryError):
        return 1, "out of memory; use fewer workers or a machine with more"
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return 1, f"{where}{error.strerror or error}; check the path, its mode and the disk"
    text = f"{type(error).__name__}: {one_line(error)}"
    return 1, f"{text}; a bug in crosscue: replay this drive alone with -v and report it"


def state_of(job: Job) -> JobState:
    """Return the state of the job's run folder.

    Raises:
        CrosscueError: A log cannot be examined.
    """
    entry = read_entry(job.run)
    inside = job.run.iterdir() if job.run.is_dir() else ()
    if all(path.name == FAILURE for path in inside):
        return JobState.MISSING
    if not job.run.joinpath(MANIFEST).exists():
        return JobState.CUT_SHORT
    if entry is None:
        return JobState.OTHER
    if "manifest" not in entry:
        return JobState.CUT_SHORT
    is_same = (
        entry["inputs"] == _inputs(job)
        and entry["manifest"] == _manifest_hash(job)
        and isinstance(entry.get("exit_status"), int)
    )
    return JobState.DONE if is_same else JobState.OTHER


def _check_unique(jobs: Sequence[Job]) -> None:
    for of in (lambda job: job.name, lambda job: str(job.run)):
        seen: set[str] = set()
        for job in jobs:
            if of(job) in seen:
                raise UsageError(f"{of(job)}: two drives have this name; rename a folder")
            seen.add(of(job))


def _earlier(job: Job, overwrite: bool) -> JobOutcome[R] | None:
    """Return the outcome of an earlier start, or None if the job must be processed."""
    try:
        door.inside(job.run.parent, job.run.name)
        state = state_of(job)
        if state is JobState.DONE:
            entry = read_entry(job.run)
            return JobOutcome(job, 0 if entry is None else int(entry["exit_status"]), attempts=0)
        if state is JobState.OTHER and not overwrite:
            raise RunError(
                f"{job.run}: holds a run of other logs, settings or versions; "
                "give another folder or --overwrite"
            )
        if state is not JobState.MISSING:
            refuse_files_of_user(job.run)
    except (CrosscueError, OSError) as error:
        status, line = reported_error(error)
        return JobOutcome(job, status, line, attempts=0)
    return None


def _inputs(job: Job) -> dict[str, object]:
    """Return what determines the result: the identity of the logs and the settings."""
    identity = identity_of_all([log_identity(log) for log in job.logs])
    return {"fingerprint": job.fingerprint, "identity": as_row(identity)}


def _manifest_hash(job: Job) -> str:
    RunFolder(job.run).manifest()
    return hashlib.sha256(door.read(job.run / MANIFEST, MAX_MANIFEST_BYTES)).hexdigest()


def worker_crashed(done: JobOutcome[R], attempts: int, how: str) -> JobOutcome[R]:
    """Return the failure of a job whose worker died in every allowed attempt, and record it."""
    line = f"{done.job.name}: its worker {how}, {attempts} times; replay this drive alone"
    failed = replace(done, error=line, attempts=attempts)
    record_failure(failed, None, f"its worker {how}: it left no traceback")
    return failed

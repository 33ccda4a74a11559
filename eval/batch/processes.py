"""Processing of drives in parallel worker processes on this machine.

Each worker has its own pipe. When a worker dies (killed, out of memory, a crash in a library), its
drive is therefore known: it is started again in a fresh process, and fails if that process dies,
too. The standard library's pool would lose every drive in progress.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from pickle import PicklingError
from typing import Any, Final

from crosscue.replay.processes import Worker, stop

from .jobs import Events, Job, JobOutcome, R, attempt, reported_error, worker_crashed

TICK_S: Final = 1.0
THREAD_VARIABLES: Final = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
    "RAYON_NUM_THREADS",
    "POLARS_MAX_THREADS",
)


@dataclass(frozen=True, slots=True)
class Processes:
    """An engine of worker processes.

    Attributes:
        workers: Number of drives processed at the same time.
        attempts: Max number of attempts when a drive's worker dies.
        threads: Threads of each worker's numerical libraries; None divides the machine's cores.
    """

    workers: int
    attempts: int = 2
    threads: int | None = None

    def __post_init__(self) -> None:
        """Refuse counts below one.

        Raises:
            ValueError: Naming the count.
        """
        if min(self.workers, self.attempts, self.threads or 1) < 1:
            raise ValueError(f"expected counts of 1 or more, got {self}")

    def __call__(self, jobs: Sequence[Job], work: Callable[[Job], R]) -> Events[R]:
        """Process jobs, see ``jobs.Engine``."""
        waiting = deque((job, 1) for job in jobs)
        threads = self.threads or max(1, (os.cpu_count() or 1) // self.workers)
        idle: list[_Worker] = []
        busy: list[_Worker] = []
        try:
            while waiting or busy:
                while waiting and len(busy) < self.workers:
                    worker = idle.pop() if idle else _Worker(work, threads)
                    busy.append(worker)
                    worker.begin(*waiting.popleft())
                ready = wait([worker.pipe for worker in busy], timeout=TICK_S)
                for worker in [one for one in busy if one.pipe in ready]:
                    busy.remove(worker)
                    done = worker.take()
                    if isinstance(done, JobOutcome):
                        idle.append(worker)
                        yield done
                    elif worker.number < self.attempts:
                        waiting.appendleft((worker.job, worker.number + 1))
                    else:
                        yield worker_crashed(JobOutcome(worker.job, 1), worker.number, done)
                if not ready:
                    yield None
        finally:
            stop(idle, busy)


class _Worker(Worker):
    """A process and its current job."""

    def __init__(self, work: Callable[[Job], Any], threads: int) -> None:
        super().__init__(_serve, threads)
        self._work = work
        self.job: Job
        self.number = 0

    def begin(self, job: Job, number: int) -> None:
        """Send a job to the process as attempt ``number``."""
        is_first = self.number == 0
        self.job, self.number = job, number
        try:
            if is_first:
                self.pipe.send(self._work)
            self.pipe.send(job)
        except OSError:
            # The process is already dead; ``take`` reports that.
            return

    def take(self) -> JobOutcome[Any] | str:
        """Return the job's outcome, or how the process died."""
        try:
            done = self.pipe.recv()
        except (EOFError, OSError):
            self.pipe.close()
            return self.end()
        return replace(done, attempts=self.number) if isinstance(done, JobOutcome) else str(done)


def _serve(pipe: Connection, threads: int) -> None:
    """Process jobs from the pipe until it closes."""
    # Libraries read these when loaded; nothing numerical has been loaded here yet.
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(threads)))
    work = pipe.recv()
    while True:
        job: Job = pipe.recv()
        done = attempt(work, job)
        try:
            pipe.send(done)
        except (PicklingError, AttributeError, TypeError) as error:
            pipe.send(JobOutcome(job, *reported_error(error)))

"""Processing of drives in parallel worker processes on this machine.

Each worker has its own pipe. When a worker dies (killed, out of memory, a crash in a library), its
drive is therefore known: it is started again in a fresh process, and fails if that process dies,
too. The standard library's pool would lose every drive in progress.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pickle import PicklingError
from types import FrameType
from typing import Any, Final, NoReturn

from .jobs import Done, Events, Job, R, attempt, reported_error, worker_crashed

TICK_S: Final = 1.0
GRACE_S: Final = 5.0
"""Time for a stopped worker to remove its incomplete files, seconds."""
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
                    if isinstance(done, Done):
                        idle.append(worker)
                        yield done
                    elif worker.number < self.attempts:
                        waiting.appendleft((worker.job, worker.number + 1))
                    else:
                        yield worker_crashed(Done(worker.job, 1), worker.number, done)
                if not ready:
                    yield None
        finally:
            _stop(idle, busy)


class _Worker:
    """A process and its current job."""

    def __init__(self, work: Callable[[Job], Any], threads: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process: BaseProcess = context.Process(
            target=_serve, args=(theirs, threads), daemon=True
        )
        self.process.start()
        theirs.close()
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

    def take(self) -> Done[Any] | str:
        """Return the job's outcome, or how the process died."""
        try:
            done = self.pipe.recv()
        except (EOFError, OSError):
            self.pipe.close()
            self.process.join(GRACE_S)
            return _cause_of_death(self.process.exitcode)
        return replace(done, attempts=self.number) if isinstance(done, Done) else str(done)


def _cause_of_death(code: int | None) -> str:
    if code is not None and code < 0:
        why = " (out of memory?)" if code == -signal.SIGKILL else ""
        return f"was killed by {signal.Signals(-code).name}{why}"
    return f"ended with status {code}"


def _stop(idle: Sequence[_Worker], busy: Sequence[_Worker]) -> None:
    """Stop all processes: idle ones by closing their pipe, busy ones by SIGTERM, then SIGKILL."""
    for worker in busy:
        worker.process.terminate()
    for worker in idle:
        worker.pipe.close()
    until = time.monotonic() + GRACE_S
    for worker in (*busy, *idle):
        worker.process.join(max(0.0, until - time.monotonic()))
        if worker.process.is_alive():
            worker.process.kill()
            worker.process.join()
        worker.pipe.close()
        worker.process.close()


class _StoppedError(BaseException):
    """Raised in a worker on SIGTERM; a BaseException, so that only cleanup code handles it."""


def _raise_stopped(number: int, frame: FrameType | None) -> NoReturn:
    raise _StoppedError


def _serve(pipe: Connection, threads: int) -> None:
    """Process jobs from the pipe until it closes; the main function of a worker."""
    # Libraries read these when loaded; nothing numerical has been loaded here yet.
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(threads)))
    # Ctrl-C reaches the whole foreground process group; only the parent reacts to it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _raise_stopped)
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    try:
        work = pipe.recv()
        while True:
            job: Job = pipe.recv()
            done = attempt(work, job)
            try:
                pipe.send(done)
            except (PicklingError, AttributeError, TypeError) as error:
                pipe.send(Done(job, *reported_error(error)))
    except (EOFError, OSError):
        # The parent was killed, and its end of the pipe is gone.
        return
    except _StoppedError:
        sys.exit(143)
    finally:
        # A signal that arrives later must not interrupt the exit with a traceback.
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _leave_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)

"""Processing of drives on a Ray cluster, an engine like ``processes.Processes``.

Every node needs this version of crosscue, and sees logs and run folders under the same paths (a
shared file system, or logs on an object store). A drive is one task that declares its cores and
memory, so that no node receives more drives than fit. When a node is lost, its drives are started
again on other nodes. Ray's own retries are off: a drive whose worker died is restarted here, so
that its lock is removed first and the number of attempts is correct.
"""

from __future__ import annotations

import os
import sys
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Final

from crosscue.eval.runs.folder import LOCK
from crosscue.replay.processes import GRACE_S

from .jobs import Events, Job, JobOutcome, R, attempt, reported_error, worker_crashed
from .processes import THREAD_VARIABLES, TICK_S
from .ray_cluster import GIB, LOCAL, check_fits, connect_ray

# Memory of a drive with a camera and a neural network, on one core.
MEMORY_BYTES: Final = 2 * GIB


@dataclass(frozen=True, slots=True)
class OnRay:
    """An engine on a Ray cluster.

    Attributes:
        address: An address of Ray's clients (``auto``, ``10.0.0.1:6379``), or ``local``.
        workers: Max number of drives at the same time; None uses all cores.
        attempts: Max number of attempts when a drive's worker dies.
        cores: Cores of each drive.
        memory_bytes: Memory of each drive.
    """

    address: str
    workers: int | None = None
    attempts: int = 3
    cores: int = 1
    memory_bytes: int = MEMORY_BYTES

    def __call__(self, jobs: Sequence[Job], work: Callable[[Job], R]) -> Events[R]:
        """Process jobs, see ``jobs.Engine``.

        Raises:
            UsageError: Ray is not installed.
            CrosscueError: The cluster cannot be reached or started.
        """
        with connect_ray(self.address, self.workers) as ray:
            yield from self._on(ray, jobs, work)

    def _on(self, ray: Any, jobs: Sequence[Job], work: Callable[[Job], R]) -> Events[R]:
        running: dict[Any, tuple[Job, int]] = {}
        try:
            check_fits(ray, self.address, self.cores, self.memory_bytes)
            cores = int(ray.cluster_resources().get("CPU", 1))
            limit = self.workers or max(1, cores // self.cores)
            declared = {"num_cpus": self.cores, "memory": self.memory_bytes}
            task = ray.remote(max_retries=0, **declared)(attempt).options(
                runtime_env={"env_vars": self._environment()}
            )
            shared = ray.put(work)
            waiting = deque((job, 1) for job in jobs)
            while waiting or running:
                while waiting and len(running) < limit:
                    job, number = waiting.popleft()
                    running[task.remote(shared, job)] = (job, number)
                ready, _ = ray.wait(list(running), num_returns=1, timeout=TICK_S)
                for reference in ready:
                    job, number = running.pop(reference)
                    done = _result_of(ray, reference, job)
                    if isinstance(done, JobOutcome):
                        yield replace(done, attempts=number)
                    elif number < self.attempts:
                        # The dead worker may have been on another machine, whose processes are
                        # not visible from here; no other worker has this drive.
                        job.run.joinpath(LOCK).unlink(missing_ok=True)
                        waiting.appendleft((job, number + 1))
                    else:
                        yield worker_crashed(JobOutcome(job, 1), number, done)
                if not ready:
                    yield None
        finally:
            _cancel(ray, list(running))

    def _environment(self) -> dict[str, str]:
        """Environment of a worker; a local one finds the same modules as this process."""
        found = dict.fromkeys(THREAD_VARIABLES, str(self.cores))
        return found | ({"PYTHONPATH": os.pathsep.join(sys.path)} if self.address == LOCAL else {})


def _result_of(ray: Any, reference: Any, job: Job) -> JobOutcome[Any] | str:
    """Return the outcome of a task, or how its worker died."""
    try:
        done: JobOutcome[Any] = ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        # ``attempt`` handles the drive's own errors; this is an error of Ray's transport.
        return JobOutcome(
            job, *reported_error(RuntimeError(str(error.cause).strip().splitlines()[-1]))
        )
    except ray.exceptions.OutOfMemoryError:
        return "was killed by Ray, since its machine ran out of memory"
    except ray.exceptions.RayError as error:
        first = next(iter(str(error).splitlines()), "").strip()
        return f"died ({type(error).__name__}: {first})"
    return done


def _cancel(ray: Any, references: Sequence[Any]) -> None:
    """Interrupt running tasks, so that incomplete files are removed; then end them."""
    for reference in references:
        with suppress(Exception):
            ray.cancel(reference, force=False)
    if not references:
        return
    _, late = ray.wait(references, num_returns=len(references), timeout=GRACE_S)
    for reference in late:
        with suppress(Exception):
            ray.cancel(reference, force=True)

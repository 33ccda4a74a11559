"""Drives on a Ray cluster, with the interface of ``worker_pool``.

Every node needs this version of crosscue, and sees logs and run folders under the same paths (a
shared file system, or logs on an object store). A drive is one task that declares its cores and
memory, so that no node gets more drives than it holds. A node that is lost costs the drives that
were running there, which are begun again on others. Ray's own retries are off: a drive whose worker
died is begun again here, so that its lock is taken away first and the count of attempts is true.
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

from .jobs import Done, Events, Job, R, attempt, reported_error, worker_crashed
from .processes import GRACE_S, THREAD_VARIABLES, TICK_S
from .ray_cluster import GIB, LOCAL, check_fits, joined

MEMORY_BYTES: Final = 2 * GIB
"""Of a drive with a camera and a network, on one core."""


@dataclass(frozen=True, slots=True)
class OnRay:
    """An engine on a Ray cluster.

    Attributes:
        address: As Ray's clients take it (``auto``, ``10.0.0.1:6379``), or ``local``.
        workers: At most so many drives at a time; None takes all cores there are.
        attempts: How often a drive is begun when its worker dies.
        cores: Of each drive.
        memory_bytes: Of each drive.
    """

    address: str
    workers: int | None = None
    attempts: int = 3
    cores: int = 1
    memory_bytes: int = MEMORY_BYTES

    def __call__(self, jobs: Sequence[Job], work: Callable[[Job], R]) -> Events[R]:
        """Work; see ``many_drives.Engine``.

        Raises:
            UsageError: Ray is not installed.
            CrosscueError: The cluster cannot be reached or started.
        """
        with joined(self.address, self.workers) as ray:
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
                    done = _taken(ray, reference, job)
                    if isinstance(done, Done):
                        yield replace(done, attempts=number)
                    elif number < self.attempts:
                        # The dead worker may have been on another machine, whose processes cannot
                        # be seen from here; nobody else was given this drive.
                        job.run.joinpath(LOCK).unlink(missing_ok=True)
                        waiting.appendleft((job, number + 1))
                    else:
                        yield worker_crashed(Done(job, 1), number, done)
                if not ready:
                    yield None
        finally:
            _cancel(ray, list(running))

    def _environment(self) -> dict[str, str]:
        """Of a worker; on this machine it finds the modules that this process finds."""
        found = dict.fromkeys(THREAD_VARIABLES, str(self.cores))
        return found | ({"PYTHONPATH": os.pathsep.join(sys.path)} if self.address == LOCAL else {})


def _taken(ray: Any, reference: Any, job: Job) -> Done[Any] | str:
    """What a task returned, or how its worker died."""
    try:
        done: Done[Any] = ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        # ``attempt`` answers for the drive's own errors; this is one of Ray's way to and from it.
        return Done(job, *reported_error(RuntimeError(str(error.cause).strip().splitlines()[-1])))
    except ray.exceptions.OutOfMemoryError:
        return "was killed by Ray, since its machine ran out of memory"
    except ray.exceptions.RayError as error:
        first = next(iter(str(error).splitlines()), "").strip()
        return f"died ({type(error).__name__}: {first})"
    return done


def _cancel(ray: Any, references: Sequence[Any]) -> None:
    """Interrupt what still runs, so that half-written files are taken away; then end it."""
    for reference in references:
        with suppress(Exception):
            ray.cancel(reference, force=False)
    if not references:
        return
    _, late = ray.wait(references, num_returns=len(references), timeout=GRACE_S)
    for reference in late:
        with suppress(Exception):
            ray.cancel(reference, force=True)

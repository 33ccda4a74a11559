"""Choice of the engine of a batch, and the one that processes drives on a Ray cluster.

Every node needs this version of crosscue, and sees logs and run folders under the same paths (a
shared file system, or logs on an object store). A drive is one task that declares its cores and
memory, so that no node receives more drives than fit. When a node is lost, its drives are started
again on other nodes. Ray's own retries are off: a drive whose worker died is restarted here, so
that its lock is removed first and the number of attempts is correct.

Each worker has its own pipe. When a worker dies (killed, out of memory, a crash in a library), its
drive is therefore known: it is started again in a fresh process, and fails if that process dies,
too. The standard library's pool would lose every drive in progress.
"""

import os
import signal
import socket
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from pickle import PicklingError
from typing import Any, Final

from crosscue.eval.runs.folder import LOCK
from crosscue.replay.errors import CrosscueError, UsageError, one_line
from crosscue.replay.processes import GRACE_S, Worker, stop

from .jobs import Engine, Events, Job, JobOutcome, R, attempt, reported_error, worker_crashed

GIB: Final = 1 << 30
LOCAL: Final = "local"
WAIT_S: Final = 5.0
# Size of a local cluster's object store; results are small.
STORE_BYTES: Final = 96 << 20

# Memory of a drive with a camera and a neural network, on one core.
MEMORY_BYTES: Final = 2 * GIB
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


@contextmanager
def connect_ray(address: str, workers: int | None = None) -> Iterator[Any]:
    """Yield the module ``ray``, connected; disconnect at the end unless it was connected before.

    Args:
        address: An address of Ray's clients (``auto``, ``10.0.0.1:6379``), or ``local``.
        workers: Cores of a local cluster; None uses all cores.

    Raises:
        UsageError: Ray is not installed.
        CrosscueError: The cluster cannot be reached or started.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError:
        raise UsageError("--ray: Ray is not installed; pip install ray") from None
    is_ours = not ray.is_initialized()
    if is_ours:
        _connect(ray, address, workers)
    try:
        yield ray
    finally:
        if is_ours:
            ray.shutdown()


def check_fits(ray: Any, address: str, cores: int, memory_bytes: int) -> None:
    """Refuse requirements that no node meets, because Ray would wait for such a node indefinitely.

    Raises:
        CrosscueError: No node is large enough; states the needs of a drive and the largest nodes.
    """
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    has = [(int(one.get("CPU", 0)), int(one.get("memory", 0))) for one in nodes]
    if not any(its_cores >= cores and its_bytes >= memory_bytes for its_cores, its_bytes in has):
        max_cores = max((one for one, _ in has), default=0)
        max_bytes = max((one for _, one in has), default=0)
        raise CrosscueError(
            f"--ray {address}: a drive declares {cores} cores and {memory_bytes / GIB:.3g} GiB; no "
            f"node has both: the largest have {max_cores} cores and {max_bytes / GIB:.3g} GiB; "
            "declare less with --cores-per-drive and --memory-per-drive"
        )


def _check_reachable(address: str) -> None:
    """Refuse an address that accepts no connection, because Ray itself retries for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not (host and port.isdecimal()):
        return
    try:
        socket.create_connection((host.strip("[]"), int(port)), WAIT_S).close()
    except (OSError, OverflowError) as error:
        raise CrosscueError(
            f"--ray {address}: no connection ({one_line(error)}); start a cluster with ray start, "
            f"or use {LOCAL}"
        ) from None


def _connect(ray: Any, address: str, workers: int | None) -> None:
    is_main = threading.current_thread() is threading.main_thread()
    before = signal.getsignal(signal.SIGTERM) if is_main else None
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
    if address == LOCAL:
        options |= {
            "num_cpus": workers,
            "include_dashboard": False,
            "object_store_memory": STORE_BYTES,
            "_node_ip_address": "127.0.0.1",
        }
    _check_reachable(address)
    try:
        ray.init(address=address, **options)
    except (ConnectionError, RuntimeError, ValueError, OSError) as error:
        raise CrosscueError(
            f"--ray {address}: no cluster ({one_line(error)}); start one with ray start, or use "
            f"{LOCAL}"
        ) from None
    finally:
        if is_main:
            # Ray installs its own handler, which would hide SIGTERM from the command.
            signal.signal(signal.SIGTERM, before)
    # Ray reports dead workers on stdout, which is reserved for results; we report them ourselves.
    ray._private.worker._worker_logs_enabled = False


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


def engine_of(
    workers: int | None,
    ray: str | None,
    cores: int | None = None,
    memory_gib: float | None = None,
) -> Engine:
    """Return the engine that the options of a command select.

    Args:
        workers: Number of drives processed in parallel.
        ray: Address of a Ray cluster; None selects local processes.
        cores: Cores of each drive on the cluster; default 1.
        memory_gib: Memory of each drive on the cluster; default 2.

    Raises:
        UsageError: A number is too small, or cores or memory are set without a cluster.
    """
    if ray is None and (cores is not None or memory_gib is not None):
        raise UsageError(
            "cores_per_drive, memory_per_drive_gib: need a cluster; name its address with ray"
        )
    if (cores is not None and cores < 1) or (memory_gib is not None and not memory_gib > 0.0):
        raise UsageError(
            f"cores_per_drive, memory_per_drive_gib: {cores} and {memory_gib}; expected 1 core or "
            "more and GiB above 0"
        )
    if workers is not None and workers < 1:
        raise UsageError(f"workers: {workers}, expected 1 or more")
    if ray is not None:
        memory_bytes = MEMORY_BYTES if memory_gib is None else int(memory_gib * (1 << 30))
        return OnRay(ray, workers, cores=cores or 1, memory_bytes=memory_bytes)
    return Processes(workers or 1)


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
    def __init__(self, work: Callable[[Job], Any], threads: int) -> None:
        super().__init__(_serve, threads)
        self._work = work
        self.job: Job
        self.number = 0

    def begin(self, job: Job, number: int) -> None:
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

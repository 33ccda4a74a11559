"""Worker processes, and a function applied to many items in parallel, with results in order.

Workers are connected by pipes only. The standard library's pool shares semaphores and both ends of
its queues: workers of a killed parent would wait forever, or fail while starting.
"""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from multiprocessing.connection import Connection
from queue import SimpleQueue
from types import FrameType
from typing import Final, NoReturn, TypeVar, cast

from .errors import CrosscueError
from .losses import warn_again, with_losses

T = TypeVar("T")
R = TypeVar("R")
# Time for a stopped worker to remove its incomplete files, seconds.
GRACE_S: Final = 5.0
# Time between two checks whether the parent still lives, seconds.
PARENT_S: Final = 0.2


def in_processes(work: Callable[[T], R], things: Sequence[T], workers: int) -> Iterator[R]:
    """Yield ``work(thing)`` for each of ``things``, in order, as results become available.

    Loss warnings of the worker processes are issued again in this process.

    Args:
        work: An importable function, or a ``partial`` of one.
        things: Picklable arguments.
        workers: Number of processes; with 1, or for a single item, this process does the work.

    Raises:
        CrosscueError: A worker was killed.
    """
    if workers == 1 or len(things) <= 1:
        yield from map(work, things)
        return
    told = partial(with_losses, work)
    team = [Worker(_answer, told) for _ in range(min(workers, len(things)))]
    free: SimpleQueue[Worker] = SimpleQueue()

    def ask(thing: T) -> tuple[R, tuple[str, ...]]:
        worker = free.get()
        try:
            worker.pipe.send(thing)
            result, error = worker.pipe.recv()
        except (EOFError, OSError):
            raise CrosscueError(f"a worker process {worker.end()}; run again") from None
        finally:
            free.put(worker)
        if error is not None:
            raise error
        return cast("tuple[R, tuple[str, ...]]", result)

    for worker in team:
        free.put(worker)
    with ThreadPoolExecutor(len(team)) as threads:
        try:
            for result, losses in threads.map(ask, things):
                warn_again(losses)
                yield result
        finally:
            stop((), team)


def _answer(pipe: Connection, work: Callable[[T], R]) -> None:
    while True:
        thing = pipe.recv()
        try:
            answer: tuple[R | None, Exception | None] = (work(thing), None)
        except Exception as error:
            answer = (None, error)
        pipe.send(answer)


class Worker:
    """A process that serves a pipe.

    It is started here, because a process of ``multiprocessing`` whose parent is killed before it
    has sent all prints a traceback.

    Attributes:
        pipe: The end of this process.
        process: The worker.
    """

    def __init__(self, serve: Callable[..., None], *args: object) -> None:
        """Start a process that calls ``serve`` with its end of the pipe, and ``args``."""
        self.pipe, theirs = multiprocessing.Pipe()
        program = (
            f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import serve_pipe, Connection"
            f"; serve_pipe(Connection({theirs.fileno()}), {os.getpid()})"
        )
        # Ctrl-C reaches the whole foreground process group; only this process reacts to it.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self.process = subprocess.Popen(
                [sys.executable, "-c", program],
                stdin=subprocess.DEVNULL,
                pass_fds=(theirs.fileno(),),
            )
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        theirs.close()
        # If the process is already dead, the answer that never comes reports that.
        with suppress(OSError):
            self.pipe.send((serve, args))

    def end(self) -> str:
        """Return how the process died, after its pipe was closed."""
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(GRACE_S)
        code = self.process.returncode
        if code is not None and code < 0:
            why = " (out of memory?)" if code == -signal.SIGKILL else ""
            return f"was killed by {signal.Signals(-code).name}{why}"
        return f"ended with status {code}"


def stop(idle: Sequence[Worker], busy: Sequence[Worker]) -> None:
    """Stop all processes: idle ones by closing their pipe, busy ones by SIGTERM, then SIGKILL."""
    for worker in busy:
        worker.process.terminate()
    for worker in idle:
        worker.pipe.close()
    until = time.monotonic() + GRACE_S
    for worker in (*busy, *idle):
        try:
            worker.process.wait(max(0.0, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            worker.process.kill()
            worker.process.wait()
        worker.pipe.close()


class _StoppedError(BaseException):
    """Raised in a worker on SIGTERM; a BaseException, so that only cleanup code handles it."""


def _raise_stopped(number: int, frame: FrameType | None) -> NoReturn:
    raise _StoppedError


def serve_pipe(pipe: Connection, parent_pid: int) -> None:
    """Serve a pipe until it closes or SIGTERM arrives; the main function of a worker."""
    try:
        try:
            signal.signal(signal.SIGTERM, _raise_stopped)
            threading.Thread(target=_leave_with, args=(parent_pid,), daemon=True).start()
            serve, args = pipe.recv()
            serve(pipe, *args)
        except (EOFError, OSError):
            # The parent was killed, and its end of the pipe is gone.
            return
        finally:
            # A signal that arrives later must not interrupt the exit with a traceback.
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
    except _StoppedError:
        # It may also arrive while the closed pipe is handled.
        sys.exit(143)


def _leave_with(parent_pid: int) -> None:
    while os.getppid() == parent_pid:
        time.sleep(PARENT_S)
    os.kill(os.getpid(), signal.SIGTERM)

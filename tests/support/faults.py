"""Commands in a forked process in which file operations kill the process or fail.

The parent process has everything imported and compiled, so that dozens of runs are fast.
"""

import errno
import io
import os
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn, cast

from crosscue.eval import cli

SECONDS = 60
WRITES = frozenset({"open", "os.rename", "os.mkdir"})
CHANGES = WRITES | {"os.remove", "os.rmdir"}


@dataclass(frozen=True, slots=True)
class Ended:
    """Outcome of a forked command.

    Attributes:
        status: Exit status; minus the signal's number if it was killed.
        said: Text on stderr.
    """

    status: int
    said: str


def forked(prepare: Callable[[], None], argv: Sequence[str]) -> Ended:
    """Run one command line in a forked process, after ``prepare``."""
    # A pipe, because the command may be unable to write files.
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        _run(prepare, argv, write)
    os.close(write)
    with os.fdopen(read, "rb") as pipe:
        said = pipe.read().decode()
    _, status = os.waitpid(child, 0)
    return Ended(os.waitstatus_to_exitcode(status), said)


def _run(prepare: Callable[[], None], argv: Sequence[str], said: int) -> NoReturn:
    status = 70
    try:
        signal.alarm(SECONDS)
        sys.stdout = io.StringIO()
        sys.stderr = io.StringIO()
        prepare()
        status = cli.run(argv)
    except BaseException:
        traceback.print_exc()
    os.write(said, cast("io.StringIO", sys.stderr).getvalue().encode())
    os._exit(status)


def watched(folder: Path, names: frozenset[str], then: Callable[[int, str], None]) -> None:
    """Call ``then`` before every operation that changes ``folder``, until the process ends.

    Its arguments are the operation's number, starting at 0, and a description.
    """
    count = 0
    inside = str(folder)

    def hook(event: str, args: tuple[object, ...]) -> None:
        nonlocal count
        if event not in names or not args or not str(args[0]).startswith(inside):
            return
        if event == "open" and not _writes(args):
            return
        number, count = count, count + 1
        then(number, f"{event} {Path(str(args[0])).name.replace(str(os.getpid()), 'PID')}")

    sys.addaudithook(hook)


def _writes(args: tuple[object, ...]) -> bool:
    flags = args[2]
    return isinstance(flags, int) and bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))


def operations(folder: Path, names: frozenset[str], argv: Sequence[str]) -> list[str]:
    """Return all operations on ``folder`` of a run without faults."""
    with tempfile.NamedTemporaryFile("r") as reported:

        def prepare() -> None:
            handle = os.open(reported.name, os.O_WRONLY | os.O_APPEND)

            def then(_: int, what: str) -> None:
                os.write(handle, f"{what}\n".encode())

            watched(folder, names, then)

        ended = forked(prepare, argv)
        assert ended.status == 0, ended.said
        return reported.read().splitlines()


def killed_before(folder: Path, operation: int, argv: Sequence[str]) -> Ended:
    """Kill the command, as ``kill -9`` does, before its ``operation``-th change of ``folder``."""

    def then(number: int, _: str) -> None:
        if number == operation:
            os.kill(os.getpid(), signal.SIGKILL)

    return forked(lambda: watched(folder, CHANGES, then), argv)


def failing_from(folder: Path, operation: int, argv: Sequence[str], *, once: bool) -> Ended:
    """Let the ``operation``-th write into ``folder`` fail, and all later ones unless ``once``."""

    def then(number: int, what: str) -> None:
        if number == operation or (number > operation and not once):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), what)

    return forked(lambda: watched(folder, WRITES, then), argv)

"""Parallel work returns the same results in the same order for any number of processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Final

import pytest

from crosscue.replay.processes import in_processes


def fail_at_two(number: int) -> int:
    if number == 2:
        raise ValueError("two")
    return number


@pytest.mark.parametrize("workers", [1, 2])
def test_failure_is_raised_after_earlier_results(workers: int) -> None:
    found = in_processes(fail_at_two, range(4), workers)

    assert [next(found), next(found)] == [0, 1]
    with pytest.raises(ValueError, match="two"):
        next(found)


SLEEPS: Final = """
import sys, time
from crosscue.replay.errors import CrosscueError
from crosscue.replay.processes import in_processes
if __name__ == "__main__":
    try:
        list(in_processes(time.sleep, [0.05] * 200, 2))
    except CrosscueError as error:
        sys.exit(str(error))
"""
# After the first worker was started: it imports modules, then works.
MOMENTS_S: Final = (0.0, 0.03, 0.1, 0.3, 0.8)


def _children(pid: int) -> list[int]:
    """Return the worker processes of a process."""
    pids = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    command = {int(one): Path(f"/proc/{one}/cmdline").read_bytes() for one in pids}
    return [one for one, words in command.items() if b"serve_pipe" in words]


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds workers in /proc")
@pytest.mark.parametrize("killed", ["parent", "workers", "all", "one worker"])
def test_killed_processes_leave_neither_traceback_nor_processes(
    killed: str, tmp_path: Path
) -> None:
    (tmp_path / "sleeps.py").write_text(SLEEPS)
    for moment_s in MOMENTS_S:
        parent = subprocess.Popen(
            [sys.executable, tmp_path / "sleeps.py"], stderr=subprocess.PIPE, text=True
        )
        while not (workers := _children(parent.pid)):
            assert parent.poll() is None
            time.sleep(0.002)
        time.sleep(moment_s)
        workers = _children(parent.pid)[: 1 if killed == "one worker" else None]

        for pid in {"parent": [parent.pid], "all": [parent.pid, *workers]}.get(killed, workers):
            os.kill(pid, signal.SIGKILL)

        # The end of stderr shows that the last process has ended.
        _, error = parent.communicate(timeout=20)
        assert "Traceback" not in error
        if killed in ("parent", "all"):
            assert (parent.returncode, error) == (-signal.SIGKILL, "")
        else:
            assert parent.returncode == 1
            assert error == "a worker process was killed by SIGKILL (out of memory?); run again\n"

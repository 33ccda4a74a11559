"""Partial files and processes that end early."""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import pytest

from crosscue.eval import cli
from crosscue.eval.runs.folder import create, locked
from crosscue.replay.files import partial_file
from crosscue.replay.files.partial_file import PARTIAL, Scratch, sweep
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.processes import in_processes
from support import faults, scenes


def _partials(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.rglob(f".*{PARTIAL}"))


@contextmanager
def _child_process(code: str) -> Iterator[subprocess.Popen[str]]:
    """Run ``code`` in a process that prints a line once it has started, and kill it at the end."""
    lines = f"{code}\nprint('begun', flush=True)\nimport time; time.sleep(60)\n"
    with subprocess.Popen(
        [sys.executable, "-c", lines], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "begun\n"
        try:
            yield process
        finally:
            process.kill()


def test_only_partial_files_of_dead_processes_are_swept(tmp_path: Path) -> None:
    code = (
        "from pathlib import Path\nfrom crosscue.replay.files.partial_file import PartialFile\n"
        f"held = PartialFile(Path({str(tmp_path)!r}, 'a.txt'))"
    )
    with _child_process(code) as process:
        sweep(tmp_path, again=True)
        write_text(tmp_path / "b.txt", "b")
        assert len(_partials(tmp_path)) == 1
        process.send_signal(signal.SIGKILL)
        process.wait()

    # The process number may be in use again by now; it is not examined.
    sweep(tmp_path, again=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b.txt"]


def test_temporary_folders_of_killed_processes_are_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    code = (
        "from crosscue.replay.files.partial_file import Scratch\n"
        "held = Scratch(); (held.path / 'copy.db3').write_text('large')"
    )
    with _child_process(code) as process:
        with Scratch():
            assert len(list(tmp_path.iterdir())) == 2
        assert len(list(tmp_path.iterdir())) == 1
        process.kill()
        process.wait()

    with Scratch() as folder:
        assert list(tmp_path.iterdir()) == [folder]
    assert not list(tmp_path.iterdir())


def test_run_of_dead_process_is_unlocked_despite_reused_pid(tmp_path: Path) -> None:
    run = create(tmp_path / "run", overwrite=False)
    code = (
        "from pathlib import Path\nfrom crosscue.eval.runs.folder import RunFolder, locked\n"
        f"held = locked(RunFolder(Path({str(run.path)!r}))); held.__enter__()"
    )
    with _child_process(code) as process:
        process.kill()
        process.wait()
    text = run.file(".lock").read_text()
    assert text.startswith(f"{process.pid} ")
    # The process number is replaced by that of a running process, the parent.
    run.file(".lock").write_text(text.replace(str(process.pid), str(os.getppid()), 1))

    with locked(run):
        pass


def _convert(folder: Path) -> list[str]:
    log = folder / "can0.log"
    log.write_text(
        "".join(f"(1700000000.{i:06d}) can0 123#{i % 256:02X}\n" for i in range(0, 9000, 3))
    )
    return ["convert", str(log), "-o", str(folder / "out" / "a.mcap"), "--overwrite", "-q"]


def _simulate(folder: Path) -> list[str]:
    out = str(folder / "out")
    return ["simulate", "C", "-o", out, "--width", "64", "--overwrite", "-q"]


@pytest.mark.slow
@pytest.mark.parametrize("command", [_convert, _simulate])
def test_run_after_kill_leaves_no_partial_files(
    tmp_path: Path, command: Callable[[Path], list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Forked processes inherit the patch.
    scenes.shorten(monkeypatch, pictures=5)
    argv = command(tmp_path)
    out = tmp_path / "out"
    count = len(faults.operations(out, faults.CHANGES, argv))
    left = 0

    for operation in (2, count // 2, count - 2):
        shutil.rmtree(out)
        assert faults.killed_before(out, operation, argv).status == -signal.SIGKILL
        left += len(_partials(out))
        time.sleep(partial_file.SWEEP_S)
        assert cli.run(argv) == 0
        assert not _partials(out)
    assert left


def test_files_of_other_programs_are_not_swept(tmp_path: Path) -> None:
    others = [".a.txt.1234.partial", "a.partial", ".drive.crosscue-xyz.partial", ".a.partial"]
    for name in others:
        (tmp_path / name).write_text("of another program")
    (tmp_path / f".folder.crosscue-{'0' * 16}.partial").mkdir()
    (tmp_path / f".link.crosscue-{'0' * 16}.partial").symlink_to(tmp_path / others[0])
    os.mkfifo(tmp_path / f".pipe.crosscue-{'0' * 16}.partial")
    before = sorted(path.name for path in tmp_path.iterdir())

    sweep(tmp_path, again=True)

    assert sorted(path.name for path in tmp_path.iterdir()) == before


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

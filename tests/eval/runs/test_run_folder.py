"""A run folder contains only complete files and has one writer at a time."""

import errno
import json
import os
import socket
from pathlib import Path

import pytest

from crosscue.eval.runs import folder
from crosscue.eval.runs.folder import create, locked, open_run
from crosscue.replay.errors import OutputError, RunError
from crosscue.replay.files.whole_file import write_text, write_whole


def test_failed_write_keeps_the_old_file(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "old")

    def fail(partial: Path) -> None:
        partial.write_text("half")
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OutputError, match="disk is full"):
        write_whole(tmp_path / "a.txt", fail)

    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "old"


def test_lock_file_names_its_holder_without_kernel_locks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = create(tmp_path / "run", overwrite=False)
    boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    parent = os.getppid()
    ticks = Path(f"/proc/{parent}/stat").read_text().rpartition(")")[2].split()[19]
    monkeypatch.setattr(folder, "lock", lambda _: None)

    run.file(".lock").write_text(f"{parent} {socket.gethostname()} {boot} {ticks}")
    with pytest.raises(RunError, match=f"process {parent} "), locked(run):
        pass
    # The same process id with another start time: the id was reused.
    run.file(".lock").write_text(f"{parent} {socket.gethostname()} {boot} {int(ticks) + 1}")
    with locked(run):
        pass


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "unreadable"),
        (json.dumps({"format_version": 99}), "format 99"),
        (json.dumps([1]), "format None"),
    ],
)
def test_damaged_or_unsupported_manifest_is_refused(
    tmp_path: Path, text: str, message: str
) -> None:
    (tmp_path / "manifest.json").write_text(text)

    with pytest.raises(RunError, match=message):
        open_run(tmp_path)

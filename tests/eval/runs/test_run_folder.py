"""A run folder contains only complete files and has one writer at a time."""

import errno
import json
import os
import socket
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from crosscue.eval.runs import folder
from crosscue.eval.runs.folder import create, locked, open_run
from crosscue.eval.runs.tables.parquet import TableSink
from crosscue.replay.errors import OutputError, RunError, UsageError
from crosscue.replay.files.whole_file import write_text, write_whole

SCHEMA = pa.schema([("t_ns", pa.int64())])


def test_failed_write_keeps_the_old_file(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "old")

    def fail(partial: Path) -> None:
        partial.write_text("half")
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OutputError, match="disk is full"):
        write_whole(tmp_path / "a.txt", fail)

    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "old"


def test_incomplete_table_is_not_left_in_the_folder(tmp_path: Path) -> None:
    run = create(tmp_path / "run", overwrite=False)

    def write_and_fail() -> None:
        with TableSink(run, "pose", SCHEMA) as sink:
            sink.write({"t_ns": np.arange(3)})
            raise RuntimeError("killed")

    with pytest.raises(RuntimeError, match="killed"):
        write_and_fail()

    assert list(run.path.iterdir()) == []


def test_damaged_table_is_reported(tmp_path: Path) -> None:
    run = create(tmp_path / "run", overwrite=False)
    with TableSink(run, "pose", SCHEMA) as sink:
        sink.write({"t_ns": np.arange(10_000)})
    assert run.table("pose").num_rows == 10_000
    raw = bytearray(run.file("pose.parquet").read_bytes())
    raw[len(raw) // 4] ^= 0x10
    run.file("pose.parquet").write_bytes(raw)

    with pytest.raises(RunError, match=r"pose\.parquet: damaged"):
        run.table("pose")


def test_equal_rows_yield_equal_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        run = create(tmp_path / name, overwrite=False)
        with TableSink(run, "pose", SCHEMA) as sink:
            sink.write({"t_ns": np.arange(100)})

    first, second = ((tmp_path / n / "pose.parquet").read_bytes() for n in ("a", "b"))
    assert first == second


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


def test_lock_of_dead_process_is_taken_over(tmp_path: Path) -> None:
    run = create(tmp_path / "run", overwrite=False)
    run.file(".lock").write_text(f"4194305 {socket.gethostname()} some-other-boot")

    with locked(run):
        assert run.file(".lock").read_text().startswith(str(os.getpid()))
    assert not run.file(".lock").exists()


def test_folder_with_other_files_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")

    with pytest.raises(UsageError, match=r"thesis\.tex"):
        create(tmp_path, overwrite=True)
    with pytest.raises(RunError, match="--overwrite"):
        create(tmp_path, overwrite=False)


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


def test_folder_without_manifest_is_an_incomplete_run(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="cut short"):
        open_run(tmp_path)

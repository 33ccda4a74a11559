"""Progress of a batch, and details of its failures."""

import json
import math
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

import crosscue
from crosscue.eval.batch import journal
from crosscue.eval.batch.jobs import Job, in_turn, run_many
from crosscue.eval.batch.journal import (
    DriveState,
    drives_of_folder,
    entry_path,
    error_of,
    pace_of,
    write_entry,
    write_plan,
)
from crosscue.eval.cli import run
from crosscue.eval.runs.folder import FAILURE, LOCK, signature
from support.drive_work import letters, write_jobs

WORDS = ("plain", "damaged", "bug", "loss")


@pytest.fixture
def batch(tmp_path: Path) -> list[Job]:
    """Four processed drives, two of which failed, and one planned drive."""
    jobs = write_jobs(tmp_path, WORDS)
    write_plan(tmp_path / "runs", [*(job.name for job in jobs), "later"], "all")
    run_many(jobs, letters, in_turn)
    return jobs


def states(folder: Path) -> dict[str, str]:
    return {one.run.name: one.state.value for one in drives_of_folder(folder)}


def test_each_planned_drive_has_one_state(batch: list[Job], tmp_path: Path) -> None:
    folder = tmp_path / "runs"

    assert states(folder) == {
        "drive0": "done",
        "drive1": "failed",
        "drive2": "failed",
        "drive3": "done",
        "later": "waiting",
    }
    found = crosscue.batch_status(folder)
    assert [found.count(state) for state in DriveState] == [2, 0, 2, 0, 1]
    # Four drives have just ended, and no worker processes the last.
    assert found.pace.per_hour > 4.0
    assert math.isnan(found.pace.left_s)


def test_failed_drive_writes_failure_log_to_its_run_folder(
    batch: list[Job], tmp_path: Path
) -> None:
    text = (batch[2].run / FAILURE).read_text()

    assert "error     ZeroDivisionError: a bug; a bug in crosscue" in text
    assert "Traceback" in text
    assert str(error_of(batch[1].run)).endswith("cut; copy it again")
    assert f"{batch[2].run / FAILURE}" in repr(crosscue.batch_status(tmp_path / "runs"))

    Path(batch[2].logs[0]).write_text("healed")
    run_many(batch, letters, in_turn)
    assert not (batch[2].run / FAILURE).exists()
    assert states(tmp_path / "runs")["drive2"] == "done"


def test_drive_of_a_dead_worker_is_stale(
    batch: list[Job], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "runs"
    later = folder / "later"
    gone = subprocess.run(
        [sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, check=True
    )
    pid, host, started = signature().split(" ", 2)
    dead = f"{int(gone.stdout)} {host} {started}"
    elsewhere = f"{pid} another-machine {started}"

    for worker, state in ((signature(), "running"), (dead, "stale"), (elsewhere, "running")):
        write_entry(later, {"inputs": None, "worker": worker})
        assert states(folder)["later"] == state
    assert pace_of(drives_of_folder(folder), folder).left_s > 0.0

    monkeypatch.setattr(journal, "STALE_S", 60.0)
    os.utime(entry_path(later), (1.0e9, 1.0e9))
    assert states(folder)["later"] == "stale"
    assert "later: its worker on another-machine is gone, last update" in repr(
        crosscue.batch_status(folder)
    )
    assert run(["status", str(folder), "-q"]) == 3


def test_stale_drive_of_another_machine_is_processed_again(tmp_path: Path) -> None:
    (job,) = write_jobs(tmp_path, ["plain"])
    dead = "4711 another-machine boot 99"
    job.run.mkdir(parents=True)

    def error_of_abandoned_drive(entry_s: float) -> str | None:
        """Return the error of a drive that a worker began at ``entry_s`` and left locked."""
        write_entry(job.run, {"inputs": None, "worker": dead})
        os.utime(entry_path(job.run), (entry_s, entry_s))
        job.run.joinpath(LOCK).write_text(dead)
        (done,) = run_many([job], letters, in_turn)
        return done.error

    assert "process 4711 on another-machine is writing it" in str(
        error_of_abandoned_drive(time.time())
    )
    assert states(tmp_path / "runs") == {"drive0": "running"}
    assert error_of_abandoned_drive(1.0e9) is None
    assert states(tmp_path / "runs") == {"drive0": "done"}


@pytest.mark.parametrize("torn", ["", "[]", '{"drives": 3}', "{"])
def test_invalid_plan_does_not_hide_started_drives(
    batch: list[Job], tmp_path: Path, torn: str
) -> None:
    folder = tmp_path / "runs"
    (folder / ".drives" / "plans" / "all.json").write_text(torn)

    assert len(states(folder)) == len(batch)
    assert json.loads((folder / ".drives" / "drive0.json").read_text())["exit_status"] == 0

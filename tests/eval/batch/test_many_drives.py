"""Many drives in parallel: progress, shards, and failures that affect only their drive."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import crosscue
from crosscue.eval.batch import journal
from crosscue.eval.batch.drive_list import Shard, read_shard
from crosscue.eval.batch.jobs import (
    Engine,
    Job,
    JobOutcome,
    JobState,
    exit_status_of,
    in_turn,
    run_many,
    state_of,
)
from crosscue.eval.batch.journal import (
    DriveState,
    drives_of_folder,
    entry_path,
    error_of,
    pace_of,
    write_entry,
    write_plan,
)
from crosscue.eval.batch.ray_jobs import Processes
from crosscue.eval.cli import run
from crosscue.eval.drives.many import ReplayedDrives
from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.runs.folder import FAILURE, LOCK, signature
from crosscue.replay.errors import UsageError
from crosscue.replay.losses import losses_heard
from support.drive_work import letters, write_jobs
from support.trees import tree

TWO = Processes(2)


@pytest.mark.slow
def test_one_failing_drive_does_not_stop_the_rest(tmp_path: Path) -> None:
    words = ["plain", "damaged", "dies", "bug", "loss", "memory", "leaves", "dies once", "last"]
    jobs = write_jobs(tmp_path, words)

    results = run_many(jobs, letters, TWO)

    assert [done.job for done in results] == jobs
    errors = {word: done.error for word, done in zip(words, results, strict=True)}
    assert [word for word, error in errors.items() if error is None] == [
        "plain",
        "loss",
        "dies once",
        "last",
    ]
    assert errors["damaged"] == f"{jobs[1].logs[0]}: cut; copy it again"
    assert "killed by SIGKILL (out of memory?), 2 times" in str(errors["dies"])
    assert "ended with status 7, 2 times" in str(errors["leaves"])
    assert str(errors["bug"]).startswith("ZeroDivisionError: a bug; a bug in crosscue")
    assert "out of memory" in str(errors["memory"])
    attempts = {word: done.attempts for word, done in zip(words, results, strict=True)}
    assert (attempts["dies once"], attempts["plain"]) == (2, 1)
    assert results[1].exit_status == 4
    assert exit_status_of(results) == 3


@pytest.mark.slow
@pytest.mark.parametrize("engine", [in_turn, TWO])
def test_losses_in_a_worker_are_reported_to_the_caller(tmp_path: Path, engine: Engine) -> None:
    jobs = write_jobs(tmp_path, ["plain", "warns"])

    with losses_heard() as heard:
        results = run_many(jobs, letters, engine)
        again = run_many(jobs, letters, engine)

    assert heard == [f"{jobs[1].logs[0]}: bytes 0 to 5 differ from the seal"]
    assert [done.exit_status for done in results] == [0, 3]
    assert [(done.exit_status, done.is_earlier) for done in again] == [(0, True), (3, True)]
    assert exit_status_of(results) == 3


def test_second_start_processes_only_missing_drives(tmp_path: Path) -> None:
    jobs = write_jobs(tmp_path, ["plain", "damaged", "loss", "last"])
    first = run_many(jobs, letters, in_turn)
    before = {job.name: tree(job.run) for job in jobs}
    Path(jobs[1].logs[0]).write_text("healed")

    second = run_many(jobs, letters, in_turn)

    assert [done.error is None for done in first] == [True, False, True, True]
    assert [done.is_earlier for done in second] == [True, False, True, True]
    assert [done.exit_status for done in second] == [0, 0, 3, 0]
    assert all(state_of(job) is JobState.DONE for job in jobs)
    for i in (0, 2, 3):
        assert tree(jobs[i].run) == before[jobs[i].name]


def test_run_of_changed_log_or_settings_needs_overwrite(tmp_path: Path) -> None:
    jobs = write_jobs(tmp_path, ["plain", "other"])
    run_many(jobs, letters, in_turn)
    Path(jobs[0].logs[0]).write_text("longer")
    changed = [jobs[0], Job("drive1", jobs[1].logs, jobs[1].run, "settings 2")]

    refused = run_many(changed, letters, in_turn)
    replaced = run_many(changed, letters, in_turn, overwrite=True)

    assert all("give another folder or --overwrite" in str(done.error) for done in refused)
    assert exit_status_of(refused) == 1
    assert [done.attempts for done in replaced] == [1, 1]
    assert [state_of(job) for job in changed] == [JobState.DONE, JobState.DONE]


@pytest.mark.parametrize("torn", ["", "{", "[]", '{"format_version": 1}', '{"format_version": 9}'])
def test_run_with_invalid_journal_entry_is_not_done(tmp_path: Path, torn: str) -> None:
    jobs = write_jobs(tmp_path, ["plain"])
    run_many(jobs, letters, in_turn)
    (tmp_path / "runs" / ".drives" / "drive0.json").write_text(torn)

    assert state_of(jobs[0]) is JobState.OTHER


@pytest.mark.slow
def test_one_and_two_workers_write_equal_bytes(tmp_path: Path) -> None:
    words = ["plain", "loss", "some", "more"]
    engines: dict[str, Engine] = {"one": in_turn, "two": Processes(2, threads=1)}
    found = [
        run_many(write_jobs(tmp_path, words, name), letters, engine)
        for name, engine in engines.items()
    ]

    assert tree(tmp_path / "one") == tree(tmp_path / "two") != {}
    workers = [done.result for done in found[1] if done.result is not None]
    assert {one.threads for one in workers} == {"1"}
    assert len({one.pid for one in workers} - {os.getpid()}) in (1, 2)


RUNNER = """
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from crosscue.eval.cli import _guarded
from crosscue.eval.batch.jobs import run_many
from crosscue.eval.batch.ray_jobs import Processes
from crosscue.eval.drives.many import ReplayedDrives
from crosscue.eval.pipeline.outcome import Outcome
from support.drive_work import letters, write_jobs
import argparse

def run(args):
    run_many(write_jobs(Path(sys.argv[1]), ["slow", "slow", "slow"]), letters, Processes(2))

if __name__ == "__main__":
    # Tests started in the background of a shell ignore this signal.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    args = argparse.Namespace(verbose=False, quiet=True, json=False)
    sys.exit(_guarded(run, args, argparse.ArgumentParser(), []))
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGINT, 130), (signal.SIGKILL, -signal.SIGKILL)]
)
def test_signal_to_the_parent_stops_all_workers(
    tmp_path: Path, number: signal.Signals, status: int
) -> None:
    script = tmp_path / "runner.py"
    script.write_text(RUNNER)
    here = os.pathsep.join(sys.path)
    parent = subprocess.Popen(
        [sys.executable, str(script), str(tmp_path / "drives")],
        env={**os.environ, "PYTHONPATH": here},
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    with parent:
        drives = tmp_path / "drives"
        _wait_until(lambda: len([p for p in drives.glob("*.begun") if p.read_text()]) == 2)
        pids = [int(path.read_text()) for path in drives.glob("*.begun")]
        parent.send_signal(number)
        stderr_text = parent.communicate(timeout=20)[1].decode()

    assert parent.returncode == status, stderr_text
    _wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in pids))
    assert not list(tmp_path.rglob("*.partial"))
    assert not list(tmp_path.rglob(".lock"))
    assert "Traceback" not in stderr_text

    for log in (tmp_path / "drives").glob("*.txt"):
        log.write_text("healed")
    again = run_many(write_jobs(tmp_path / "drives", ["healed"] * 3), letters, in_turn)
    assert [(done.error, done.attempts) for done in again] == [(None, 1)] * 3


def _wait_until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < end, "waited 20 s"
        time.sleep(0.02)


def test_forty_drives_print_25_lines_with_the_failed_ones_first() -> None:
    jobs = [Job(f"d{i}", ("a.mcap",), Path(f"runs/d{i}"), "") for i in range(40)]
    drives: tuple[JobOutcome[Outcome], ...] = tuple(
        JobOutcome(job, 4 if job.name == "d39" else 0, "a.mcap: cut" if job.name == "d39" else None)
        for job in jobs
    )

    printed = ReplayedDrives(drives, Path("runs/merged"), None).brief().splitlines()

    assert len(printed) == 25
    assert printed[0] == "failed   d39: a.mcap: cut"
    assert printed[-2:] == ["drives   39 of 40, 1 failed", "tables   runs/merged"]


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


IDENTITIES = st.sets(st.text("0123456789abcdef", min_size=8, max_size=8), max_size=40)


@given(IDENTITIES, st.integers(1, 9))
def test_every_drive_is_in_exactly_one_shard(identities: set[str], count: int) -> None:
    shards = [Shard(number, count) for number in range(1, count + 1)]

    for identity in identities:
        assert sum(shard.holds(identity) for shard in shards) == 1


def test_shard_option_is_read() -> None:
    assert read_shard("2/4") == Shard(2, 4)
    assert read_shard(str(Shard(2, 4))) == Shard(2, 4)


@pytest.mark.parametrize("text", ["0/4", "5/4", "1/0", "two"])
def test_invalid_shard_option_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="expected i/n with i from 1 to n"):
        read_shard(text)

"""The index of a catalog: it saves reading and does not change the content."""

import errno
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import pytest

import crosscue
from crosscue.eval.batch.jobs import Job, attempt
from crosscue.eval.catalog.query import index, records
from crosscue.eval.catalog.query.index import NAME
from crosscue.eval.runs.folder import RunFolder
from crosscue.replay.errors import UnreadableRunError
from crosscue.replay.files.partial_file import PartialFile
from support.catalog_runs import add_run, approach_row, change, runs_below, scene

ALL = "select run, vehicle, approaches, settings_sha256 from runs order by run"


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Two drives, each with two settings."""
    return runs_below(tmp_path / "fleet")


@pytest.fixture
def manifests_read(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Record the names of the runs whose manifests are read."""
    names: list[str] = []
    rows_of = records.run_rows

    def counted(found: object, *rest: object) -> object:
        names.append(getattr(found, "run", ""))
        return rows_of(found, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(index, "run_rows", counted)
    return names


def test_only_changed_and_new_runs_are_read_again(runs: Path, manifests_read: list[str]) -> None:
    crosscue.catalog(runs)
    manifests_read.clear()
    change(RunFolder(runs / "a/monday"), scene=scene(approach_row(1, 9.0), approach_row(2, None)))
    add_run(runs / "a/wednesday", "wednesday")

    rows = crosscue.catalog(runs).query("select run, approaches as n from runs order by run")

    assert sorted(manifests_read) == ["a/monday", "a/wednesday"]
    assert [(row["run"], row["n"]) for row in rows.to_pylist()] == [
        ("a/monday", 2),
        ("a/tuesday", 1),
        ("a/wednesday", 1),
        ("b/monday", 1),
        ("b/tuesday", 1),
    ]
    counted = crosscue.catalog(runs).query("select count(*) as n from approaches")
    assert counted.to_pylist() == [{"n": 6}]


def fail(job: Job) -> NoReturn:
    raise UnreadableRunError(f"{job.logs[0]}: no log; check the path")


def test_failed_run_is_a_row_with_status_and_reason(runs: Path, manifests_read: list[str]) -> None:
    log = runs.parent / "drive.mcap"
    log.touch()
    attempt(fail, Job("sunday", (str(log),), runs / "a/sunday", ""))
    # A failed drive with a complete earlier run, and a failure.log outside of any run.
    attempt(fail, Job("monday", (str(log),), runs / "a/monday", ""))
    (runs / "b/failure.log").write_text("the coffee machine is out of order\n")

    found = crosscue.catalog(runs)

    rows = found.query("select run, outcome, exit_status, error from runs order by run").to_pylist()
    monday, sunday, *others = (tuple(row.values()) for row in rows)
    reason = f"{log}: no log; check the path"
    assert sunday == ("a/sunday", "failed", 4, reason)
    assert monday == ("a/monday", "whole", 0, reason)
    assert {row[1:] for row in others} == {("whole", 0, None)}
    assert not found.left_out
    assert runs / "a/sunday" not in found.runs
    assert found.select("outcome = 'failed'") == (runs / "a/sunday",)
    manifests_read.clear()
    assert crosscue.catalog(runs).query("select count(*) as n from runs").to_pylist() == [{"n": 5}]
    assert manifests_read == []
    # Once complete, it is a run like the others.
    add_run(runs / "a/sunday", "sunday")
    (runs / "a/sunday/failure.log").unlink()
    assert crosscue.catalog(runs).select("outcome = 'failed'") == ()


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: path.unlink(),
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(path.read_bytes()[:-200]),
        lambda path: path.write_bytes(path.read_bytes().replace(b"PAR1", b"RAP1")),
        lambda path: path.write_bytes(bytes(range(256))),
    ],
    ids=["missing", "empty", "cut", "damaged", "noise"],
)
def test_missing_or_damaged_index_is_rebuilt(
    runs: Path, manifests_read: list[str], damage: Callable[[Path], object]
) -> None:
    first = crosscue.catalog(runs).query(ALL)
    damage(runs / NAME)
    manifests_read.clear()

    assert crosscue.catalog(runs).query(ALL).equals(first)
    assert len(manifests_read) == 4
    manifests_read.clear()
    crosscue.catalog(runs)
    assert manifests_read == []


def test_catalog_on_a_full_disk_works_without_index(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: PartialFile) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(PartialFile, "keep", full)

    found = crosscue.catalog(runs)

    assert found.query(ALL).num_rows == 4
    assert "the disk is full" in found.notices[0]
    assert found.left_out == {}
    assert [path.name for path in runs.iterdir() if path.is_file()] == []

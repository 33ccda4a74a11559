"""The index of a catalog: it saves reading, and never changes the content of a catalog."""

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import pytest

import crosscue
from crosscue.eval.batch.jobs import Job, attempt
from crosscue.eval.catalog.find_runs import runs_of
from crosscue.eval.catalog.query import index, records
from crosscue.eval.catalog.query.index import NAME
from crosscue.eval.runs.folder import RunFolder
from crosscue.replay.base import UnreadableRunError
from crosscue.replay.files.partial_file import PartialFile
from support.catalog_runs import add_run, change, runs_below, scene, seen

ALL = "select run, vehicle, approaches, settings_sha256 from runs order by run"


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Two drives, each with two settings."""
    return runs_below(tmp_path / "fleet")


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the runs whose manifests are read."""
    names: list[str] = []
    rows_of = records.rows_of

    def counted(found: object, *rest: object) -> object:
        names.append(getattr(found, "run", ""))
        return rows_of(found, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(index, "rows_of", counted)
    return names


def test_a_second_opening_reads_no_run(runs: Path, read: list[str]) -> None:
    first = crosscue.catalog(runs).query(ALL)
    assert len(read) == 4
    read.clear()

    assert crosscue.catalog(runs).query(ALL).equals(first)
    assert read == []


def test_only_what_changed_is_read_again(runs: Path, read: list[str]) -> None:
    crosscue.catalog(runs)
    read.clear()
    change(RunFolder(runs / "a/monday"), scene=scene(seen(1, 9.0), seen(2, None)))
    add_run(runs / "a/wednesday", "wednesday")

    rows = crosscue.catalog(runs).query("select run, approaches as n from runs order by run")

    assert sorted(read) == ["a/monday", "a/wednesday"]
    assert [(row["run"], row["n"]) for row in rows.to_pylist()] == [
        ("a/monday", 2),
        ("a/tuesday", 1),
        ("a/wednesday", 1),
        ("b/monday", 1),
        ("b/tuesday", 1),
    ]
    counted = crosscue.catalog(runs).query("select count(*) as n from approaches")
    assert counted.to_pylist() == [{"n": 6}]


def test_a_deleted_run_goes(runs: Path, read: list[str]) -> None:
    crosscue.catalog(runs)
    read.clear()
    for file in (runs / "b/monday").iterdir():
        file.unlink()
    (runs / "b/monday").rmdir()

    found = crosscue.catalog(runs)

    assert read == []
    assert len(found.runs) == 3
    assert found.query("select count(*) as n from approaches").to_pylist() == [{"n": 3}]


def fails(job: Job) -> NoReturn:
    raise UnreadableRunError(f"{job.logs[0]}: no log; check the path")


def test_a_failed_run_is_a_row_with_its_status_and_reason(runs: Path, read: list[str]) -> None:
    log = runs.parent / "drive.mcap"
    log.touch()
    attempt(fails, Job("sunday", (str(log),), runs / "a/sunday", ""))
    # A failed drive whose earlier run still exists, and a file that only looks like a failure.
    attempt(fails, Job("monday", (str(log),), runs / "a/monday", ""))
    (runs / "b/failure.log").write_text("the coffee machine is out of order\n")

    found = crosscue.catalog(runs)

    rows = found.query("select run, outcome, exit_status, error from runs order by run").to_pylist()
    monday, sunday, *others = (tuple(row.values()) for row in rows)
    why = f"{log}: no log; check the path"
    assert sunday == ("a/sunday", "failed", 4, why)
    assert monday == ("a/monday", "whole", 0, why)
    assert {row[1:] for row in others} == {("whole", 0, None)}
    assert not found.left_out
    assert runs / "a/sunday" not in found.runs
    assert found.select("outcome = 'failed'") == (runs / "a/sunday",)
    read.clear()
    assert crosscue.catalog(runs).query("select count(*) as n from runs").to_pylist() == [{"n": 5}]
    assert read == []
    # Once complete, it is a run like the others.
    add_run(runs / "a/sunday", "sunday")
    (runs / "a/sunday/failure.log").unlink()
    assert crosscue.catalog(runs).select("outcome = 'failed'") == ()


def test_commands_and_catalog_find_the_same_runs_equally_deep(runs: Path) -> None:
    deep = runs / "1/2/3/4/5"
    add_run(deep / "friday", "friday")
    add_run(deep / "6/deeper", "deeper")
    (deep / "cut").mkdir()
    (deep / "cut/input.json").touch()

    found = crosscue.catalog(runs)

    there = {*found.runs, *(runs / run for run in found.left_out)}
    assert {*runs_of([str(runs)])} == there
    assert {deep / "friday", deep / "cut"} < there
    assert deep / "6/deeper" not in there


def test_a_run_that_cannot_be_read_is_not_read_again(runs: Path, read: list[str]) -> None:
    (runs / "a/monday/manifest.json").write_text("{}")
    first = crosscue.catalog(runs).left_out
    read.clear()

    assert crosscue.catalog(runs).left_out == first
    assert first.keys() == {"a/monday"}
    assert read == []


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
def test_an_index_that_is_missing_or_broken_is_made_again(
    runs: Path, read: list[str], damage: Callable[[Path], object]
) -> None:
    first = crosscue.catalog(runs).query(ALL)
    damage(runs / NAME)
    read.clear()

    assert crosscue.catalog(runs).query(ALL).equals(first)
    assert len(read) == 4
    read.clear()
    crosscue.catalog(runs)
    assert read == []


def test_an_index_of_other_columns_is_made_again(
    runs: Path, read: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    crosscue.catalog(runs)
    read.clear()
    monkeypatch.setattr(index, "_MARK", "another")

    crosscue.catalog(runs)

    assert len(read) == 4


def test_a_read_only_folder_is_indexed_in_the_cache(
    runs: Path, read: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    first = crosscue.catalog(runs).query(ALL)
    read.clear()

    assert crosscue.catalog(runs).query(ALL).equals(first)
    assert read == []
    assert not (runs / NAME).exists()
    assert len(list((tmp_path / "cache/crosscue/catalogs").iterdir())) == 1


def test_a_full_disk_costs_the_index_only(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: PartialFile) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(PartialFile, "keep", full)

    found = crosscue.catalog(runs)

    assert found.query(ALL).num_rows == 4
    assert "the disk is full" in found.notices[0]
    assert found.left_out == {}
    assert [path.name for path in runs.iterdir() if path.is_file()] == []


def test_a_run_alone_gets_no_index(runs: Path) -> None:
    crosscue.catalog(runs / "a/monday")

    assert not (runs / "a/monday" / NAME).exists()

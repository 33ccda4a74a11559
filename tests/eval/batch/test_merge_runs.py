"""Merging of the runs of many drives."""

from pathlib import Path

import pyarrow as pa
import pytest

from crosscue.eval.batch.jobs import in_turn, run_many
from crosscue.eval.batch.merge import is_merged, merge_runs
from crosscue.eval.runs.folder import RunFolder, create, open_run, write_manifest
from crosscue.eval.runs.manifest import MergedManifest
from crosscue.eval.runs.tables.parquet import TableSink
from crosscue.replay.errors import RunError
from support.drive_work import letters, write_jobs
from support.manifests import estimated
from support.trees import tree


def _merged(folder: Path, words: list[str], out: str = "merged") -> RunFolder:
    jobs = write_jobs(folder, words)
    results = run_many(jobs, letters, in_turn)
    runs = {one.job.name: open_run(one.job.run) for one in results if one.error is None}
    failures = {one.job.name: one.error for one in results if one.error is not None}
    return merge_runs(runs, create(folder / out, overwrite=True), failures).run


def _run(path: Path, **columns: "pa.Array") -> RunFolder:
    run = create(path, overwrite=False)
    table = pa.table(columns)
    with TableSink(run, "belief", table.schema) as sink:
        sink.write({name: table[name] for name in table.column_names})
    write_manifest(run, estimated())
    return run


def test_merged_rows_keep_their_order_and_name_their_drive(tmp_path: Path) -> None:
    run = _merged(tmp_path, ["abc", "damaged", "de"])

    table = run.table("pose")
    assert table.column_names == ["drive", "t_ns", "letter"]
    assert table["drive"].to_pylist() == ["drive0"] * 3 + ["drive2"] * 2
    assert table["letter"].to_pylist() == list("abcde")


def test_merged_manifest_lists_failures_and_sums_accounts(tmp_path: Path) -> None:
    manifest = _merged(tmp_path, ["abc", "damaged", "de"]).manifest()
    assert isinstance(manifest, MergedManifest)

    assert manifest.failures.keys() == {"drive1"}
    assert "cut; copy it again" in manifest.failures["drive1"]
    letters = manifest.account.reading["letters"]
    assert (letters.runs, letters.entered, letters.used) == (2, 5, 3)
    assert letters.skipped == {"dull": 2}
    assert letters.entered == letters.used + sum(letters.skipped.values())
    assert [one.rows for one in manifest.drives] == [{"pose": 3}, {"pose": 2}]


def test_merging_twice_writes_equal_bytes(tmp_path: Path) -> None:
    first = tree(_merged(tmp_path, ["abc", "de"]).path)

    assert tree(_merged(tmp_path, ["abc", "de"]).path) == first
    assert is_merged(open_run(tmp_path / "merged"))
    assert not is_merged(open_run(tmp_path / "runs" / "drive0"))


def test_column_missing_from_a_run_is_null_after_merging(tmp_path: Path) -> None:
    runs = {
        "plain": _run(tmp_path / "a", t_ns=pa.array([1])),
        "own": _run(tmp_path / "b", t_ns=pa.array([2]), roundabout=pa.array([0.5])),
    }

    table = merge_runs(runs, create(tmp_path / "out", overwrite=False), {}).run.table("belief")

    assert table["drive"].to_pylist() == ["own", "plain"]
    assert table["roundabout"].to_pylist() == [0.5, None]


def test_columns_of_different_types_are_refused(tmp_path: Path) -> None:
    runs = {
        "one": _run(tmp_path / "a", t_ns=pa.array([1])),
        "two": _run(tmp_path / "b", t_ns=pa.array(["noon"])),
    }

    with pytest.raises(RunError, match=r"belief\.parquet does not fit those of other drives"):
        merge_runs(runs, create(tmp_path / "out", overwrite=False), {})
    assert not (tmp_path / "out" / "manifest.json").exists()


def test_merging_no_runs_writes_an_empty_run(tmp_path: Path) -> None:
    merged = merge_runs({}, create(tmp_path / "out", overwrite=False), {"a": "cut"})

    assert (merged.drives, merged.rows, merged.drive_seconds) == (0, {}, 0.0)
    manifest = merged.run.manifest()
    assert isinstance(manifest, MergedManifest)
    assert manifest.failures == {"a": "cut"}

"""Merging of the runs of many drives, of remote logs and of replaced ones."""

import json
from pathlib import Path

import pyarrow as pa
import pytest

from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import write_drive
from crosscue.eval.batch.jobs import in_turn, run_many
from crosscue.eval.batch.merge import merge_runs
from crosscue.eval.catalog.find_runs import runs_of
from crosscue.eval.runs.folder import RunFolder, create, open_run, write_manifest
from crosscue.eval.runs.manifest import MergedManifest
from crosscue.eval.runs.tables.parquet import TableSink
from crosscue.replay.errors import RunError
from support.commands import output_of
from support.drive_work import letters, write_jobs
from support.manifests import estimated


def _merged(folder: Path, words: list[str], out: str = "merged") -> RunFolder:
    jobs = write_jobs(folder, words)
    results = run_many(jobs, letters, in_turn)
    runs = {one.job.name: open_run(one.job.run) for one in results if one.error is None}
    failures = {one.job.name: one.error for one in results if one.error is not None}
    merged = create(folder / out, overwrite=True)
    merge_runs(runs, merged, failures)
    return merged


def _run(path: Path, **columns: "pa.Array") -> RunFolder:
    run = create(path, overwrite=False)
    table = pa.table(columns)
    with TableSink(run, "belief", table.schema) as sink:
        sink.write({name: table[name] for name in table.column_names})
    write_manifest(run, estimated())
    return run


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


def test_columns_of_different_types_are_refused(tmp_path: Path) -> None:
    runs = {
        "one": _run(tmp_path / "a", t_ns=pa.array([1])),
        "two": _run(tmp_path / "b", t_ns=pa.array(["noon"])),
    }

    with pytest.raises(RunError, match=r"belief\.parquet does not fit those of other drives"):
        merge_runs(runs, create(tmp_path / "out", overwrite=False), {})
    assert not (tmp_path / "out" / "manifest.json").exists()


@pytest.fixture
def drives(tmp_path: Path) -> Path:
    for name, seed in (("monday", 1), ("tuesday", 2)):
        write_drive(tmp_path / "drives" / name, DriveSettings(seed=seed, blocks=2))
    return tmp_path / "drives"


@pytest.mark.slow
def test_invalid_vehicle_file_fails_only_its_drive_and_edited_dbc_is_detected(
    drives: Path, tmp_path: Path
) -> None:
    (drives / "tuesday" / "vehicle.toml").write_text("version = ")
    argv = ["replay", str(drives), "-o", str(tmp_path / "runs"), "--json"]

    reported = {one["name"][:-9]: one for one in json.loads(output_of(*argv, status=3))["drives"]}
    assert reported["monday"]["error"] is None
    assert "not TOML" in reported["tuesday"]["error"]
    assert runs_of([str(tmp_path / "runs")]) == (tmp_path / "runs" / reported["monday"]["name"],)
    merged = open_run(tmp_path / "runs" / "merged")
    assert set(merged.table("pose")["drive"].to_pylist()) == {reported["monday"]["name"]}
    manifest = merged.manifest()
    assert isinstance(manifest, MergedManifest)
    assert list(manifest.failures) == [reported["tuesday"]["name"]]
    accounts = manifest.account.reading.values()
    assert sum(one.used for one in accounts) > 1000
    for one in accounts:
        assert one.entered == one.used + sum(one.skipped.values())

    (dbc,) = drives.joinpath("monday").glob("*.dbc")
    dbc.write_text(dbc.read_text() + "\n")
    reported = {
        one["name"][:-9]: one for one in json.loads(output_of(*argv, "-q", status=1))["drives"]
    }
    assert "other logs, settings or versions" in reported["monday"]["error"]

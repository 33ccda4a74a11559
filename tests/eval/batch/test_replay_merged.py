"""Merged tables of many drives, remote logs and replaced logs."""

import json
from pathlib import Path

import pytest

from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import write_drive
from crosscue.eval.catalog.find_runs import runs_of
from crosscue.eval.runs.folder import open_run
from crosscue.eval.runs.manifest import MergedManifest
from support.commands import output_of


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

"""Many drives by the command line: failures are reported, a second start does what is missing."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

import crosscue
from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import write_drive
from crosscue.eval.cli import run

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short drives, one that is no recording, and a folder of notes."""
    folder = tmp_path_factory.mktemp("drives")
    for name, seed in (("monday", 1), ("tuesday", 2)):
        write_drive(folder / name, DriveSettings(seed=seed))
    shutil.copytree(folder / "monday", folder / "broken")
    (folder / "broken" / "drive.mcap").write_bytes(b"junk")
    return folder


def _tables(runs: Path) -> dict[str, bytes]:
    return {
        f"{file.parent.name}/{file.name}": file.read_bytes()
        for file in sorted(runs.glob("*/*.parquet"))
    }


def test_one_failing_drive_does_not_stop_the_rest(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "runs"

    assert run(["replay", str(drives), "-o", str(out), "--json"]) == 3

    reported = {one["name"][:-9]: one for one in json.loads(capsys.readouterr().out)["drives"]}
    assert set(reported) == {"monday", "tuesday", "broken"}
    assert "does not begin like MCAP" in reported["broken"]["error"]
    assert reported["monday"]["result"]["pose"]["rows"] > 1000
    assert not (out / reported["broken"]["name"] / "manifest.json").exists()

    assert run(["replay", str(drives), "-o", str(out), "--json"]) == 3
    reported = {one["name"][:-9]: one for one in json.loads(capsys.readouterr().out)["drives"]}
    assert reported["monday"]["earlier"]
    assert reported["tuesday"]["earlier"]
    assert not reported["broken"]["earlier"]


def test_two_workers_give_the_bytes_of_one(drives: Path, tmp_path: Path) -> None:
    pattern = str(drives / "*day" / "drive.mcap")
    for workers in ("1", "2"):
        arguments = ["replay", pattern, "-o", str(tmp_path / workers), "--workers", workers, "-q"]
        assert run(arguments) == 0

    assert len(_tables(tmp_path / "1")) >= 6
    assert _tables(tmp_path / "1") == _tables(tmp_path / "2")


def test_workers_for_a_single_drive_are_refused(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = str(drives / "monday" / "drive.mcap")

    assert run(["replay", log, "-o", str(tmp_path / "run"), "--workers", "2"]) == 2

    assert "--each makes it many" in capsys.readouterr().err


def test_a_drive_folder_brings_its_vehicle_file(drives: Path, tmp_path: Path) -> None:
    assert run(["replay", str(drives / "monday"), "-o", str(tmp_path / "run"), "-q"]) == 0

    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text())
    assert manifest["settings"]["can"]["dbc"]
    assert manifest["pose"]["rows"] > 1000


def test_python_replays_many_drives_as_the_command_does(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "runs"
    reported: list[int] = []

    done = crosscue.replay_drives(
        [drives / "monday", drives / "broken"],
        out,
        end=2.0,
        on_progress=lambda at: reported.append(at.done),
    )

    assert [one.error is None for one in done.drives] == [True, False]
    assert done.exit_status == 3
    assert reported[-1] == 2
    assert "drives   1 of 2, 1 failed" in repr(done)
    assert done.merged == out / "merged"
    assert crosscue.find_drives(drives).is_many
    pattern = str(drives / "monday" / "*.mcap")
    assert run(["replay", pattern, "-o", str(out), "--to", "2.0", "--json"]) == 0
    assert [one["earlier"] for one in json.loads(capsys.readouterr().out)["drives"]] == [True]

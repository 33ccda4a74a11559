"""Valid input without a result: one line and no files, and what was there stays."""

import json
import shutil
from pathlib import Path

import pytest

from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import DriveFiles, write_drive
from crosscue.eval import cli
from crosscue.eval.runs.folder import MANIFEST
from support.commands import output_of
from support.empty_inputs import COMMANDS, empty_inputs
from support.pictures import picture_folder
from support.refusals import refusal
from support.trees import contents


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> DriveFiles:
    folder = tmp_path_factory.mktemp("drive")
    return write_drive(folder, DriveSettings(seed=3, blocks=1, block_m=60.0))


@pytest.mark.parametrize("command", ["replay", "estimate", "decode", "detect"])
def test_finished_run_is_unchanged_if_next_result_is_empty(
    drive: DriveFiles, tmp_path: Path, command: str
) -> None:
    out, car = tmp_path / "out", tmp_path / "car.toml"
    first = "replay" if command == "estimate" else command
    log, flags = str(drive.log), ["--vehicle", str(drive.vehicle), "-o", str(out)]
    if command == "detect":
        log = str(picture_folder(tmp_path / "front", 3, "rate_hz: 10\n"))
        flags = ["--detectors", "signs", "--no-cache", "-o", str(out)]
    assert cli.run([first, log, *flags]) == 0
    before = contents(out)
    car.write_text("version = 1\n")
    argv = ["--overwrite", "--from", "100000", *flags]

    if command == "estimate":
        refusal(1, "estimate", out, "--vehicle", car)
    else:
        refusal(1, command, log, *argv)

    assert contents(out) == before


def test_overwritten_run_contains_only_new_files(drive: DriveFiles, tmp_path: Path) -> None:
    out, fresh = tmp_path / "out", tmp_path / "fresh"
    argv = ["replay", str(drive.log), "--vehicle", str(drive.vehicle)]
    assert cli.run([*argv, "-o", str(out)]) == 0
    (out / "score").mkdir()
    (out / "cues.parquet").write_bytes(b"")
    message = output_of(*argv, "-o", out, "--overwrite", "--to", "5", "--json")
    assert cli.run([*argv, "-o", str(fresh), "--to", "5"]) == 0

    assert json.loads(message)["run"] == str(out)
    timed = {MANIFEST, "timings.json"}
    kept = {name: data for name, data in contents(out).items() if name not in timed}
    assert kept == {name: data for name, data in contents(fresh).items() if name not in timed}


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A drive and its run, and valid empty inputs of every kind."""
    return empty_inputs(tmp_path_factory.mktemp("inputs"))


@pytest.mark.parametrize("command", COMMANDS)
def test_empty_result_is_reported_in_one_line_without_files(
    command: str, names: dict[str, Path], tmp_path: Path
) -> None:
    shutil.rmtree(names["run"] / "score", ignore_errors=True)
    argv = COMMANDS[command].format(**names, out=tmp_path / "out").split()

    refusal(1, *command.split(), *argv)
    assert not list(tmp_path.iterdir())
    assert not (names["run"] / "score").exists()

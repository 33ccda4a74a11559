"""An empty result is an error with exit status 1, and leaves no finished result."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import DriveFiles, write_drive
from crosscue.eval import cli
from crosscue.eval.runs.folder import MANIFEST
from support.every_format import EVERY_FORMAT
from support.pictures import picture_folder


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> DriveFiles:
    """A short simulated drive."""
    folder = tmp_path_factory.mktemp("drive")
    return write_drive(folder, DriveSettings(seed=3, blocks=1, block_m=60.0))


def _fails(capsys: pytest.CaptureFixture[str], out: Path, *argv: object) -> str:
    """Run a command that fails with one line and without output, and return the line."""
    assert cli.run([str(one) for one in argv]) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("crosscue: ")
    assert captured.err.count("\n") == 1
    assert not out.exists()
    return captured.err


@pytest.mark.parametrize("command", ["replay", "decode"])
def test_part_after_end_of_log_reports_topics_without_rows(
    drive: DriveFiles, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    out = tmp_path / "out"

    message = _fails(
        capsys, out, command, drive.log, "--vehicle", drive.vehicle, "-o", out, "--from", "100000"
    )

    assert "wheel speeds" in message if command == "replay" else "no topic yielded a row" in message
    assert "/can (" in message
    assert "--from" in message


def test_convert_of_part_after_end_writes_no_file(
    drive: DriveFiles, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.mcap"

    assert "no row to write" in _fails(
        capsys, out, "convert", drive.log, "-o", out, "--from", "100000"
    )


def test_replay_with_vehicle_file_of_another_car_is_refused(
    drive: DriveFiles, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dbc = next(drive.vehicle.parent.glob("*.dbc")).read_text()
    (tmp_path / "other.dbc").write_text(
        "\n".join(
            f"BO_ {int(line.split()[1]) ^ 0x400} {line.split(maxsplit=2)[2]}"
            if line.startswith("BO_ ")
            else line
            for line in dbc.splitlines()
            if line.startswith(("VERSION", "BO_ ", " SG_", "BU_"))
        )
        + "\n"
    )
    text = drive.vehicle.read_text()
    name = next(drive.vehicle.parent.glob("*.dbc")).name
    (tmp_path / "car.toml").write_text(text.replace(name, "other.dbc"))
    out = tmp_path / "out"

    message = _fails(
        capsys, out, "replay", drive.log, "--vehicle", tmp_path / "car.toml", "-o", out
    )

    assert "the wheel speeds, planned from /can, found no rows" in message


def test_replay_of_log_without_wheel_speeds_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, out = EVERY_FORMAT["candump"](tmp_path), tmp_path / "out"

    assert "no wheel speeds" in _fails(capsys, out, "replay", log, "-o", out)


@pytest.mark.parametrize(
    "damage", [lambda path: path.write_bytes(b"\x89PNG"), lambda path: path.write_bytes(b"")]
)
def test_detect_without_usable_pictures_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], damage: Callable[[Path], object]
) -> None:
    log, out = picture_folder(tmp_path / "front", 3, "rate_hz: 10\n"), tmp_path / "out"
    for picture in log.glob("*.png"):
        damage(picture)

    message = _fails(capsys, out, "detect", log, "--detectors", "signs", "-o", out)

    assert "found no frames" in message


def _content(folder: Path) -> dict[str, bytes]:
    """Return the content of every file of a folder."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.mark.parametrize("command", ["replay", "estimate", "decode", "detect"])
def test_finished_run_is_unchanged_if_next_result_is_empty(
    drive: DriveFiles, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    out, car = tmp_path / "out", tmp_path / "car.toml"
    first = "replay" if command == "estimate" else command
    log, flags = str(drive.log), ["--vehicle", str(drive.vehicle), "-o", str(out)]
    if command == "detect":
        log = str(picture_folder(tmp_path / "front", 3, "rate_hz: 10\n"))
        flags = ["--detectors", "signs", "--no-cache", "-o", str(out)]
    assert cli.run([first, log, *flags]) == 0
    capsys.readouterr()
    before = _content(out)
    car.write_text("version = 1\n")
    argv = ["--overwrite", "--from", "100000", *flags]

    if command == "estimate":
        status = cli.run(["estimate", str(out), "--vehicle", str(car)])
    else:
        status = cli.run([command, log, *argv])

    assert status == 1
    assert capsys.readouterr().err.count("\n") == 1
    assert _content(out) == before


def test_overwritten_run_contains_only_new_files(
    drive: DriveFiles, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, fresh = tmp_path / "out", tmp_path / "fresh"
    argv = ["replay", str(drive.log), "--vehicle", str(drive.vehicle)]
    assert cli.run([*argv, "-o", str(out)]) == 0
    (out / "score").mkdir()
    capsys.readouterr()
    (out / "cues.parquet").write_bytes(b"")
    assert cli.run([*argv, "-o", str(out), "--overwrite", "--to", "5", "--json"]) == 0
    message = capsys.readouterr().out
    assert cli.run([*argv, "-o", str(fresh), "--to", "5"]) == 0

    assert json.loads(message)["run"] == str(out)
    timed = {MANIFEST, "timings.json"}
    kept = {name: data for name, data in _content(out).items() if name not in timed}
    assert kept == {name: data for name, data in _content(fresh).items() if name not in timed}

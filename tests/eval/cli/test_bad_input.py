"""Bad input on the command line: readable parts are read, and the rest is reported in one line."""

from pathlib import Path

import pytest

from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import DriveFiles, write_drive
from crosscue.eval import cli


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> DriveFiles:
    """A short simulated drive."""
    folder = tmp_path_factory.mktemp("drive")
    return write_drive(folder, DriveSettings(seed=3, blocks=1, block_m=60.0))


def _is_one_line(err: str) -> bool:
    return err.startswith("crosscue: ") and err.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "status", "message"),
    [
        ("", 4, "car.dbc:1: empty"),
        ("BO_ 1 A: 8 X\n SG_ S : 0|8@1+ (1,0", 2, "the file is truncated"),
        ("\0\0\0", 4, "car.dbc:1: contains zero bytes"),
    ],
    ids=["empty", "cut", "binary"],
)
def test_invalid_dbc_file_is_refused_in_one_line(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    drive: DriveFiles,
    text: str,
    status: int,
    message: str,
) -> None:
    (tmp_path / "car.dbc").write_text(text)
    vehicle = drive.vehicle.read_text().replace("simulated_car.dbc", "car.dbc")
    (tmp_path / "car.toml").write_text(vehicle)
    argv = ["replay", str(drive.log), "--vehicle", str(tmp_path / "car.toml"), "-o"]

    assert cli.run([*argv, str(tmp_path / "run")]) == status

    err = capsys.readouterr().err
    assert _is_one_line(err)
    assert message in err
    assert not (tmp_path / "run" / "manifest.json").exists()

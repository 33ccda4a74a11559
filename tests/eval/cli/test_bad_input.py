"""Bad input on the command line: readable parts are read, and the rest is reported in one line."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import DriveFiles, write_drive
from crosscue.eval import cli


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> DriveFiles:
    """A short simulated drive."""
    folder = tmp_path_factory.mktemp("drive")
    return write_drive(folder, DriveSettings(seed=3, blocks=1, block_m=60.0))


def _info(path: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    status = cli.run(["info", str(path)])
    captured = capsys.readouterr()
    assert "Traceback" not in captured.err
    return status, captured.out, captured.err


def _is_one_line(err: str) -> bool:
    return err.startswith("crosscue: ") and err.count("\n") == 1


def _write_empty(path: Path) -> None:
    path.write_bytes(b"")


def _write_noise(path: Path) -> None:
    path.write_bytes(np.random.default_rng(1).bytes(5000))


@pytest.mark.parametrize(
    "suffix", [".mcap", ".bag", ".db3", ".log", ".asc", ".blf", ".trc", ".mf4"]
)
@pytest.mark.parametrize("write_content", [_write_empty, _write_noise], ids=["empty", "noise"])
def test_file_without_log_content_is_refused(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    suffix: str,
    write_content: Callable[[Path], None],
) -> None:
    path = tmp_path / f"drive{suffix}"
    write_content(path)

    status, _, err = _info(path, capsys)

    assert status == 4
    assert _is_one_line(err)
    assert path.name in err


def test_damage_to_the_only_chunk_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], drive: DriveFiles
) -> None:
    damaged = bytearray(drive.log.read_bytes())
    damaged[len(damaged) // 3] ^= 0x40
    path = tmp_path / "flipped.mcap"
    path.write_bytes(damaged)
    argv = ["replay", str(path), "--vehicle", str(drive.vehicle), "-o", str(tmp_path / "run")]

    assert cli.run(argv) == 4
    message = capsys.readouterr().err
    assert "damaged chunk" in message
    assert "not one row is left" in message
    assert not (tmp_path / "run" / "manifest.json").exists()


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

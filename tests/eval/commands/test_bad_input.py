"""Bad input on the command line: readable parts are read, and the rest is reported in one line."""

import json
import os
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import DriveFiles, write_drive
from crosscue.eval import cli

MAGIC = b"\x89MCAP0\r\n"


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


def _write_huge_chunk_header(path: Path) -> None:
    # A chunk record that declares 2**40 bytes in a file of 100 bytes.
    path.write_bytes(MAGIC + struct.pack("<BQ", 0x06, 1 << 40) + bytes(80))


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


def test_huge_declared_chunk_size_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "drive.mcap"
    _write_huge_chunk_header(path)

    status, _, err = _info(path, capsys)

    assert status == 4
    assert _is_one_line(err)


@pytest.mark.parametrize("fraction", [0.02, 0.35, 0.8, 0.999])
def test_truncated_log_reports_dropped_rows(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], drive: DriveFiles, fraction: float
) -> None:
    content = drive.log.read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(content[: int(len(content) * fraction)])

    status, out, _ = _info(path, capsys)

    assert status == 3
    assert "dropped" in out


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


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_log_without_read_permission_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "drive.mcap"
    path.write_bytes(MAGIC)
    path.chmod(0)

    status, _, err = _info(path, capsys)

    assert status == 4
    assert "permission" in err


@pytest.mark.parametrize("kind", ["missing", "fifo", "loop", "folder without log", "empty folder"])
def test_path_that_is_not_a_log_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    path = tmp_path / "drive.mcap"
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "loop":
        path.symlink_to(path)
    elif "folder" in kind:
        path.mkdir()
        if kind == "folder without log":
            (path / "thesis.tex").write_text("no drive")

    status, _, err = _info(path, capsys)

    assert status == 4
    assert _is_one_line(err)
    assert str(path) in err


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


def test_full_disk_leaves_no_run_folder(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    drive: DriveFiles,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    argv = ["replay", str(drive.log), "--vehicle", str(drive.vehicle), "-o", str(tmp_path / "run")]

    assert cli.run(argv) == 1
    assert "disk is full" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_converted_log_replays_to_the_same_pose(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], drive: DriveFiles
) -> None:
    copy = tmp_path / "copy.mcap"
    assert cli.run(["convert", str(drive.log), "-o", str(copy), "--compression", "lz4"]) == 0
    for name, log in (("a", drive.log), ("b", copy)):
        argv = ["replay", str(log), "--vehicle", str(drive.vehicle), "-o", str(tmp_path / name)]
        assert cli.run(argv) == 0
    capsys.readouterr()

    one, other = ((tmp_path / name / "pose.parquet").read_bytes() for name in ("a", "b"))
    assert one == other


def test_info_json_is_strict(capsys: pytest.CaptureFixture[str], drive: DriveFiles) -> None:
    assert cli.run(["info", str(drive.log), "--json"]) == 0

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    json.loads(capsys.readouterr().out, parse_constant=refuse)

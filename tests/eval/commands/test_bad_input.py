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


def _one_line(err: str) -> bool:
    return err.startswith("crosscue: ") and err.count("\n") == 1


def _nothing(path: Path) -> None:
    path.write_bytes(b"")


def _noise(path: Path) -> None:
    path.write_bytes(np.random.default_rng(1).bytes(5000))


def _declares_gigabytes(path: Path) -> None:
    # A chunk record that declares 2**40 bytes in a file of 100 bytes.
    path.write_bytes(MAGIC + struct.pack("<BQ", 0x06, 1 << 40) + bytes(80))


@pytest.mark.parametrize(
    "suffix", [".mcap", ".bag", ".db3", ".log", ".asc", ".blf", ".trc", ".mf4"]
)
@pytest.mark.parametrize("spoil", [_nothing, _noise], ids=["empty", "noise"])
def test_a_file_without_a_log_in_it(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    suffix: str,
    spoil: Callable[[Path], None],
) -> None:
    path = tmp_path / f"drive{suffix}"
    spoil(path)

    status, _, err = _info(path, capsys)

    # In text formats, an empty or unsupported file looks like a log without readable rows.
    assert status in (3, 4)
    assert status == 3 or (_one_line(err) and path.name in err)


def test_a_declared_size_of_gigabytes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "drive.mcap"
    _declares_gigabytes(path)

    status, _, _ = _info(path, capsys)

    assert status in (3, 4)


@pytest.mark.parametrize("fraction", [0.02, 0.35, 0.8, 0.999])
def test_a_cut_log_gives_what_is_there_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], drive: DriveFiles, fraction: float
) -> None:
    whole = drive.log.read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole[: int(len(whole) * fraction)])

    status, out, _ = _info(path, capsys)

    assert status == 3
    assert "dropped" in out


def test_a_flipped_byte_in_the_only_chunk_leaves_nothing_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], drive: DriveFiles
) -> None:
    damaged = bytearray(drive.log.read_bytes())
    damaged[len(damaged) // 3] ^= 0x40
    path = tmp_path / "flipped.mcap"
    path.write_bytes(damaged)
    argv = ["replay", str(path), "--vehicle", str(drive.vehicle), "-o", str(tmp_path / "run")]

    assert cli.run(argv) == 4
    said = capsys.readouterr().err
    assert "damaged chunk" in said
    assert "not one row is left" in said
    assert not (tmp_path / "run" / "manifest.json").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_no_permission(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "drive.mcap"
    path.write_bytes(MAGIC)
    path.chmod(0)

    status, _, err = _info(path, capsys)

    assert status == 4
    assert "permission" in err


@pytest.mark.parametrize("kind", ["missing", "fifo", "loop", "foreign folder", "empty folder"])
def test_what_is_no_file_is_refused_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    path = tmp_path / "drive.mcap"
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "loop":
        path.symlink_to(path)
    elif "folder" in kind:
        path.mkdir()
        if kind == "foreign folder":
            (path / "thesis.tex").write_text("no drive")

    status, _, err = _info(path, capsys)

    assert status == 4
    assert _one_line(err)
    assert str(path) in err


@pytest.mark.parametrize(
    ("text", "said"),
    [("", "car.dbc"), ("BO_ 1 A: 8 X\n SG_ S : 0|8@1+ (1,0", "car.dbc"), ("\0\0\0", "car.dbc")],
    ids=["empty", "cut", "binary"],
)
def test_a_dbc_that_does_not_parse(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], drive: DriveFiles, text: str, said: str
) -> None:
    (tmp_path / "car.dbc").write_text(text)
    vehicle = drive.vehicle.read_text().replace("simulated_car.dbc", "car.dbc")
    (tmp_path / "car.toml").write_text(vehicle)
    argv = ["replay", str(drive.log), "--vehicle", str(tmp_path / "car.toml"), "-o"]

    status = cli.run([*argv, str(tmp_path / "run")])

    err = capsys.readouterr().err
    assert status in (2, 4)
    assert _one_line(err)
    assert said in err
    assert not (tmp_path / "run" / "manifest.json").exists()


def test_a_disk_that_fills_up_leaves_nothing_half(
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


def test_the_same_drive_through_other_clothes_gives_the_same_pose(
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


def test_json_is_strict(capsys: pytest.CaptureFixture[str], drive: DriveFiles) -> None:
    assert cli.run(["info", str(drive.log), "--json"]) == 0

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    json.loads(capsys.readouterr().out, parse_constant=refuse)

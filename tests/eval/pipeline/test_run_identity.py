"""Runs record their inputs: no other run overwrites them, and merging keeps all of them."""

from __future__ import annotations

import json
import random
import shutil
from pathlib import Path
from typing import Any

import pytest

from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import write_drive
from crosscue.eval.cli import run
from crosscue.eval.runs.manifest import FORMAT_VERSION
from crosscue.replay.files.log_identity import of_row
from support.trees import tree

pytestmark = pytest.mark.slow
# A few seconds of each drive are enough to distinguish runs.
PART = ("--to", "4", "-q")

DRIVES: int = 4
REFUSAL: str = f"format 1, this crosscue reads {FORMAT_VERSION}: replay again"


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Some short drives, one of which is not a recording."""
    folder = tmp_path_factory.mktemp("place") / "drives"
    for i in range(DRIVES):
        write_drive(folder / f"D-{i}", DriveSettings(seed=i, block_m=40.0))
    (folder / "D-3" / "drive.mcap").write_bytes(b"junk")
    return folder


def _bytes(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def _replay(place: Path | str, out: Path, *more: str) -> int:
    return run(["replay", str(place), "-o", str(out), "-q", *more])


def test_resume_with_another_log_or_setting_is_refused_and_changes_nothing(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    keep = tmp_path / "keep"
    assert _replay(drives / "D-0", keep) == 0
    before, replayed = _bytes(keep), tree(keep)
    theirs = of_row(json.loads((keep / "input.json").read_text())["identity"])

    assert _replay(drives / "D-1", keep, "--resume") == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert theirs.short in message
    assert "drive.mcap" in message
    assert _bytes(keep) == before

    assert _replay(drives / "D-0", keep, "--resume", "--to", "2") == 2
    assert "selection.end_ns: null there, " in capsys.readouterr().err
    assert _bytes(keep) == before

    assert _replay(drives / "D-0", keep, "--resume") == 0
    assert tree(keep) == replayed
    (keep / "input.json").unlink()
    assert _replay(drives / "D-1", keep, "--resume") == 2
    assert "without input.json" in capsys.readouterr().err


def test_incomplete_run_is_identified_by_input_file(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut = tmp_path / "cut"
    assert _replay(drives / "D-0", cut) == 0
    expected = tree(cut)
    (cut / "manifest.json").unlink()

    assert _replay(drives / "D-1", cut, "--resume") == 2
    assert "--resume would destroy it" in capsys.readouterr().err
    assert _replay(drives / "D-0", cut, "--resume") == 0
    assert tree(cut) == expected
    assert _replay(drives / "D-1", cut, "--overwrite", "--resume") == 0
    assert tree(cut) != expected


def test_run_of_older_format_is_refused(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    manifest = tmp_path / "old" / "manifest.json"
    manifest.parent.mkdir()
    manifest.write_text('{"format_version": 1}')

    for argv in (
        ["estimate", "old"],
        ["view", "old", "-o", "x.rrd"],
        ["score", "old"],
        ["merge", "old", "-o", "all"],
    ):
        argv = [str(tmp_path / word) if word in ("old", "all") else word for word in argv]
        assert run(argv) == 4
        assert REFUSAL in capsys.readouterr().err
    assert _replay(drives / "D-0", manifest.parent, "--resume") == 4
    assert REFUSAL in capsys.readouterr().err


def test_run_has_same_bytes_from_any_working_directory(
    drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(drives.parent)
    assert _replay("drives/D-0", Path("out/run")) == 0
    first = tree(drives.parent / "out")
    text = (drives.parent / "out" / "run" / "manifest.json").read_text()
    shutil.rmtree(drives.parent / "out")
    monkeypatch.chdir(drives)
    assert _replay("D-0/drive.mcap", Path("../out/run"), "--vehicle", "D-0/vehicle.toml") == 0

    assert tree(drives.parent / "out") == first
    assert (drives.parent / "out" / "run" / "manifest.json").read_text() == text
    assert json.loads(text)["logs"][0]["path"] == "../../drives/D-0/drive.mcap"
    shutil.rmtree(drives.parent / "out")


def test_moved_logs_are_accepted_and_changed_logs_refused(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "one"
    shutil.copytree(drives / "D-0", place / "drive")
    assert _replay(place / "drive", place / "run") == 0
    vehicle = str(drives / "D-0" / "vehicle.toml")
    estimate = ["estimate", str(place / "run"), "--vehicle", vehicle, "-q"]
    assert run(estimate) == 0

    # If run and logs move together, no option is needed.
    (tmp_path / "one").rename(tmp_path / "two")
    estimate[1] = str(tmp_path / "two" / "run")
    assert run(estimate) == 0
    log = tmp_path / "two" / "drive" / "drive.mcap"
    moved = tmp_path / "elsewhere" / "deep" / "drive.mcap"
    moved.parent.mkdir(parents=True)
    log.rename(moved)
    assert run(estimate) == 4
    assert "is gone; name its folder with --logs DIR" in capsys.readouterr().err
    shutil.copy(drives / "D-1" / "drive.mcap", log)
    assert run(estimate) == 4
    assert "has changed since" in capsys.readouterr().err
    assert run([*estimate, "--logs", str(drives / "D-1")]) == 4
    assert run([*estimate, "--logs", str(tmp_path / "elsewhere")]) == 0


def _merged(argv: list[str], out: Path, status: int) -> dict[str, bytes]:
    assert run([*argv, "-o", str(out), "-q"]) == status
    return _bytes(out)


@pytest.mark.parametrize("seed", [1, 2])
def test_merged_shards_equal_single_batch(drives: Path, tmp_path: Path, seed: int) -> None:
    """Check a property over random splits, orders, overlaps and numbers of workers."""
    rng = random.Random(seed)
    logs = [str(path) for path in sorted(drives.glob("*/drive.mcap"))]
    single = tmp_path / "single"
    assert run(["replay", *logs, "--each", "-o", str(single), *PART]) == 3
    expected = _bytes(single / "merged")

    shards: list[list[str]] = [[], [], []]
    for log in logs:
        for shard in rng.sample(shards, rng.choice([1, 1, 2])):
            shard.append(log)
    folders = []
    for number, shard in enumerate(shards):
        rng.shuffle(shard)
        folder = tmp_path / "deep" / "er" / str(number)
        if shard:
            workers = ["--workers", rng.choice(["1", "2"])]
            run(["replay", *shard, "--each", "-o", str(folder), *PART, *workers])
            folders.append(str(folder))
    folders = [folder for folder in folders if Path(folder, "merged").exists()]
    rng.shuffle(folders)

    assert _merged(["merge", *folders], tmp_path / "all", 3) == expected
    assert _merged(["merge", *folders, *folders[:1]], tmp_path / "twice", 3) == expected


def test_reused_folder_keeps_drives_of_both_batches(drives: Path, tmp_path: Path) -> None:
    first, second = (str(drives / name / "drive.mcap") for name in ("D-0", "D-1"))
    for log in (first, second):
        assert run(["replay", log, "--each", "-o", str(tmp_path / "again"), *PART]) == 0
    assert run(["replay", second, first, "--each", "-o", str(tmp_path / "once"), *PART]) == 0

    assert _bytes(tmp_path / "again" / "merged") == _bytes(tmp_path / "once" / "merged")
    names = {one["name"] for one in _manifest(tmp_path / "again" / "merged")["drives"]}
    assert {name[:-9] for name in names} == {"D-0", "D-1"}


def test_merge_refuses_different_runs_with_same_name(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = str(drives / "D-0" / "drive.mcap")
    assert run(["replay", log, "--each", "-o", str(tmp_path / "a"), "-q"]) == 0
    assert run(["replay", log, "--each", "-o", str(tmp_path / "b"), "-q", "--to", "2"]) == 0

    assert run(["merge", str(tmp_path / "a"), str(tmp_path / "b"), "-o", str(tmp_path / "c")]) == 2
    assert "two different runs have one name" in capsys.readouterr().err
    assert not (tmp_path / "c").exists()


def _manifest(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "manifest.json").read_text())
    return found


def test_estimate_finds_logs_of_relative_run_below_symlink(
    drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = tmp_path / "disk" / "deep"
    real.mkdir(parents=True)
    (tmp_path / "runs").symlink_to(real)
    monkeypatch.chdir(tmp_path)
    assert _replay(drives / "D-0", Path("runs/a")) == 0
    monkeypatch.chdir(real)
    assert run(["estimate", "a", "-q"]) == 0

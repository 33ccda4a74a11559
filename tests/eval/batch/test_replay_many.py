"""Many drives on the command line: failures are reported, and a second start continues."""

import json
import shutil
from pathlib import Path

import pytest

from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import write_drive
from crosscue.eval.cli import run
from support.commands import json_of
from support.refusals import refusal

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write two short drives and one whose log is not a recording."""
    folder = tmp_path_factory.mktemp("drives")
    for name, seed in (("monday", 1), ("tuesday", 2)):
        write_drive(folder / name, DriveSettings(seed=seed, blocks=2))
    shutil.copytree(folder / "monday", folder / "broken")
    (folder / "broken" / "drive.mcap").write_bytes(b"junk")
    return folder


def test_merged_shards_equal_one_batch(drives: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(drives, elsewhere)
    quick = ["--to", "2.0", "-q"]
    assert run(["replay", str(drives), "-o", str(tmp_path / "all"), *quick]) == 3

    folders = []
    for number in (3, 1, 2):
        folders.append(str(tmp_path / f"shard{number}"))
        arguments = ["replay", str(elsewhere), "-o", folders[-1], "--shard", f"{number}/3", *quick]
        assert run(arguments) in (0, 3, 4)
        assert not Path(folders[-1], "merged").exists()
    seen = json_of("status", *folders, status=3)
    assert (seen["done"], seen["failed"], len(seen["drives"])) == (2, 1, 3)
    assert run(["merge", *folders, "-o", str(tmp_path / "merged"), "-q"]) == 3

    merged_folder, batch_folder = ((tmp_path / name) for name in ("merged", "all/merged"))
    for table in batch_folder.glob("*.parquet"):
        assert (merged_folder / table.name).read_bytes() == table.read_bytes()
    shards, batch = (
        json.loads((at / "manifest.json").read_text()) for at in (merged_folder, batch_folder)
    )
    assert shards.pop("failures").keys() == batch.pop("failures").keys()
    assert shards == batch


def test_workers_for_a_single_drive_are_refused(drives: Path, tmp_path: Path) -> None:
    log = str(drives / "monday" / "drive.mcap")

    assert "add --each" in refusal(2, "replay", log, "-o", tmp_path / "run", "--workers", "2")

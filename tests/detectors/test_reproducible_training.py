"""Tests that the same seed yields the same weights, bit for bit, in separate processes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from support.mask_rcnn import write_bars
from support.pictures import picture

ROAD = "road --data set --steps 2 --batch 2 --width 128"
MASKS = (
    "mask-rcnn --data bars/coco.json --images bars/images --classes car --steps 2 --batch 2 "
    "--width 128 --window 96 64"
)
RUN = f"""
from crosscue.eval.cli import run
for line in ({ROAD!r}, {MASKS!r}):
    words = line.split()
    output = f"{{words[0]}}.safetensors"
    assert run(["train", *words, "--device", "cpu", "--threads", "2", "-o", output, "-q"]) == 0
"""


def _road_set(folder: Path, numbers: list[int]) -> None:
    """Write pictures and masks in this order, which is often that of the folder's entries."""
    for name in ("images", "masks"):
        (folder / "set" / name).mkdir(parents=True)
    for number in numbers:
        shade = picture(number, ".png", 160, 96)
        (folder / "set" / "images" / f"{number}.png").write_bytes(shade)
        mask = picture(29 * (number % 2), ".png", 160, 96)
        (folder / "set" / "masks" / f"{number}.png").write_bytes(mask)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Folders of two processes that each train both networks."""
    made = []
    for hash_seed, numbers in ((1, [0, 1, 2, 3]), (2, [3, 1, 0, 2])):
        folder = tmp_path_factory.mktemp("trained")
        _road_set(folder, numbers)
        write_bars(folder / "bars", 4)
        env = os.environ | {"PYTHONHASHSEED": str(hash_seed)}
        command = [sys.executable, "-c", RUN]
        subprocess.run(command, cwd=folder, env=env, check=True, timeout=300)
        made.append(folder)
    return made


@pytest.mark.slow
@pytest.mark.parametrize("network", ["road", "mask-rcnn"])
def test_two_trainings_write_identical_files(folders: list[Path], network: str) -> None:
    one, other = (folder.joinpath(f"{network}.safetensors").read_bytes() for folder in folders)

    assert one == other

"""The same seed gives the same weights, bit for bit, in processes of their own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from crosscue.detectors.training.reproducible import decides_bits, reproducible
from crosscue.detectors.weights_file import serialised
from support.mask_rcnn import write_bars
from support.pictures import picture

RUN = "from crosscue.eval.cli import main; main()"


def _trained(folder: Path, argv: list[str], hash_seed: int) -> bytes:
    output = folder / "out.safetensors"
    command = [sys.executable, "-c", RUN, *argv, "-o", str(output), "-q"]
    env = os.environ | {"PYTHONHASHSEED": str(hash_seed)}
    subprocess.run(command, cwd=folder, env=env, check=True, timeout=300)
    return output.read_bytes()


def _road_set(folder: Path, numbers: list[int]) -> None:
    """Pictures and masks, made in this order, which is often that of the folder's entries."""
    for name in ("images", "masks"):
        (folder / "set" / name).mkdir(parents=True)
    for number in numbers:
        shade = picture(number, ".png", 160, 96)
        (folder / "set" / "images" / f"{number}.png").write_bytes(shade)
        mask = picture(29 * (number % 2), ".png", 160, 96)
        (folder / "set" / "masks" / f"{number}.png").write_bytes(mask)


@pytest.mark.slow
def test_two_trainings_of_the_road_network_are_the_same_bytes(tmp_path: Path) -> None:
    argv = [
        "train",
        "road",
        "--data",
        "set",
        "--steps",
        "2",
        "--batch",
        "2",
        "--width",
        "128",
        "--device",
        "cpu",
        "--threads",
        "2",
    ]
    found = []
    for hash_seed, numbers in ((1, [0, 1, 2, 3]), (2, [3, 1, 0, 2])):
        folder = tmp_path / str(hash_seed)
        _road_set(folder, numbers)
        found.append(_trained(folder, argv, hash_seed))

    assert found[0] == found[1]


@pytest.mark.slow
def test_two_trainings_of_mask_rcnn_are_the_same_bytes(tmp_path: Path) -> None:
    argv = [
        "train",
        "mask-rcnn",
        "--data",
        "set/coco.json",
        "--images",
        "set/images",
        "--classes",
        "car",
        "--steps",
        "2",
        "--batch",
        "2",
        "--width",
        "128",
        "--window",
        "96",
        "64",
        "--device",
        "cpu",
        "--threads",
        "2",
    ]
    found = []
    for hash_seed in (1, 2):
        folder = tmp_path / str(hash_seed)
        folder.mkdir()
        write_bars(folder / "set", 4)
        found.append(_trained(folder, argv, hash_seed))

    assert found[0] == found[1]


def test_words_are_written_in_one_order() -> None:
    tensors = {"b": torch.ones(3), "a": torch.zeros(2, dtype=torch.float16)}
    words = {name: name for name in "zyxwvu"}
    backwards = dict(reversed(words.items()))

    assert serialised(tensors, words) == serialised(tensors, backwards)


def test_words_of_any_kind_and_weights_come_back(tmp_path: Path) -> None:
    from safetensors import safe_open

    words = {"b": 'é"\\\n\u2028', "a": "x" * 101}
    path = tmp_path / "w.safetensors"
    path.write_bytes(serialised({"t": torch.arange(5.0)}, words))

    with safe_open(path, "pt") as file:
        assert file.metadata() == words
        np.testing.assert_array_equal(file.get_tensor("t").numpy(), np.arange(5.0))


def test_what_decides_the_bits_is_named() -> None:
    found = decides_bits(torch.device("cpu"))

    assert found["on.torch"] == torch.__version__.partition("+")[0]
    assert found["on.threads"] == torch.get_num_threads()
    assert found["on.is_reproducible"] == "bit for bit"


def test_the_setting_is_taken_back() -> None:
    before = torch.are_deterministic_algorithms_enabled()
    with reproducible(torch.device("cpu")):
        assert torch.are_deterministic_algorithms_enabled()
    assert torch.are_deterministic_algorithms_enabled() == before
